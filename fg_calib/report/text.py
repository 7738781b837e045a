"""The calibration report for people: verdict, statistics, residuals, parameters; lengths in mm, angles in degrees."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Column, Table
from rich.text import Text

from fg_calib.analysis.accuracy import ExpectedError
from fg_calib.analysis.goodness import FLAGS, OUTLIER_WEIGHT, PREDICTION_VERDICTS, VERDICTS, SuspectConfiguration
from fg_calib.analysis.joint_values import JointValues
from fg_calib.analysis.residual_table import FAMILIES, ROW_KINDS
from fg_calib.analysis.uncertainty import LIKE_NOISE, FrameEstimate, ParameterEstimate, Uncertainty
from fg_calib.analysis.verdict import chi2_in_words, probability
from fg_calib.graph.observability import CORRELATED, Observability
from fg_calib.graph.problem import Problem
from fg_calib.graph.solver import Solution
from fg_calib.options import check_number
from fg_calib.robot.model import AXIS_OF_KIND, Axis, Robot, names_of

if TYPE_CHECKING:  # a calibration is reported without the baseline
    from fg_calib.analysis.identifiability import Identifiability
    from fg_calib.analysis.reasons import LostDirection
    from fg_calib.baseline.comparison import Comparison, Estimate, PoseError

Integers = NDArray[np.int64]

WIDTH = 100
"""Columns of the plain report."""

_SHOWN = {"m": (1e3, "mm", 4), "rad": (180.0 / np.pi, "deg", 5)}
"""Factor, unit and decimals in which a quantity is shown."""

_WEAK = "sigma above a tenth of the tolerance, or of 1 mrad at the reach"

_UNMOVED = 1e-9
"""Metres or radians by which an estimate that no step meant to move may differ from where it was."""

_FAMILY_UNIT = {"position": "m", "orientation": "rad", "distance": "m", "angle": "rad", "point": "m"}


def format_report(solution: Solution, uncertainty: Uncertainty, width: int = WIDTH) -> str:
    """The report as plain text."""
    return _plain_text(build_report(solution, uncertainty), width)


def _plain_text(report: RenderableType, width: int) -> str:
    check_number("width", width, least=1, whole=True)
    text = io.StringIO()
    console = Console(
        file=text, width=width_for(report, width), color_system=None, highlight=False, legacy_windows=False
    )
    console.print(report)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def build_report(solution: Solution, uncertainty: Uncertainty) -> RenderableType:
    """The report, to be printed by rich."""
    parts: list[RenderableType] = [
        _verdict(solution, uncertainty),
        *_section("Fit statistics", _statistics(solution, uncertainty)),
        *_section(
            f"Goodness of fit (1 sigma of a row{_with_joint_noise(solution)})", *_goodness(solution, uncertainty)
        ),
        *_test_rows(uncertainty),
        *_expected_error(uncertainty.expected_error),
        *_section("Residuals (RMS)", _residuals(uncertainty)),
    ]
    if uncertainty.names or not solution.problem.evaluated:
        parts += _section("Parameters", _parameters(uncertainty))
    if any(p.stands_for for p in uncertainty.parameters):
        parts += _section("What kept parameters were estimated for", _combinations(uncertainty))
    parts += _suspicious(solution, uncertainty)
    parts += _joint_values(solution, uncertainty.joint_values)
    if uncertainty.frame is not None:
        parts += _section("Measurement frame (world_T_base)", _frame(uncertainty.frame))
    if uncertainty.identifiability.lost:
        parts += _section("What the data do not determine", _lost(uncertainty.identifiability.lost))
    weak = _weak(uncertainty.observability)
    if weak is not None:
        parts += _section(f"What they determine badly ({_WEAK})", weak)
    notes = list(_notes(solution, uncertainty))
    if notes:
        parts += _section("Notes", *(Padding(Text(note), (0, 0, 0, 2)) for note in notes))
    return Group(*parts)


def _section(title: str, *content: RenderableType) -> list[RenderableType]:
    return [Text(f"\n{title}", style="bold"), *content]


def _verdict(solution: Solution, uncertainty: Uncertainty) -> RenderableType:
    settings = solution.problem.options
    what = f"{solution.problem.robot.name}: {settings.model}"
    if settings.uses_pairs:
        points, measured = solution.problem.points, solution.problem.measurements.pairs is not None
        if measured or solution.problem.formed:
            what += ", measured pairs" if measured else f", pairs: {settings.pairing}"
        what += "" if points is None else f", {len(points.estimated)} touched points"
    elif settings.frame == "unknown":
        what += ", measurement frame unknown"
    if solution.problem.adjustment.joint_errors is not None or solution.problem.joints is not None:
        what += ", joint values estimated"
    what += "" if settings.loss == "none" else f", loss {settings.loss}"
    lines = [Text(what), *(Text(f"DOUBTFUL: {finding}", style="bold red") for finding in uncertainty.findings)]
    if uncertainty.trustworthy:
        lines.append(Text(f"GOOD: {solution.message}", style="bold green"))
    if solution.problem.evaluated:
        lines.insert(1, Text("EVALUATED ONLY: all rows are test rows, nothing of the arm was calibrated"))
        if uncertainty.p_value is not None:
            figures = chi2_in_words(uncertainty.chi2, uncertainty.expected_chi2, uncertainty.p_value)
            lines.append(Text(f"test rows: {figures}"))
    test = uncertainty.goodness.test
    if test is not None and test.n:
        lines.append(Text(f"test rows: {chi2_in_words(test.chi2, test.expected, test.p_value)}"))
    return Group(*lines)


class _WholeWords(Table):
    """A table without a frame that breaks no word: it wraps at spaces, or gives each row a paragraph of its own."""

    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        """Add a row of cells; text in brackets is no markup."""
        super().add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in cells), **options)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        widths = self._widths(options.max_width)
        if widths is None:
            yield from self._paragraphs()
            return
        for column, width in zip(self.columns, widths, strict=True):
            column.width = width
        yield from super().__rich_console__(console, options.update_width(options.max_width + 1))  # not one blank less

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        words = [_longest_word(text) for column in self.columns for text in self._texts(column)]
        return Measurement(max(words, default=0) + _INDENT, options.max_width)

    def _texts(self, column: Column) -> list[str]:
        """The cells of a column, its heading first."""
        heading = str(column.header) if self.show_header else ""
        return [heading, *(str(cell) for cell in column.cells)]

    def _widths(self, most: int) -> list[int] | None:
        """Widths that the columns have room in, the widest wrapped most; None if there are none."""
        texts = [self._texts(column) for column in self.columns]
        widths = [max(map(len, cells)) for cells in texts]
        least = [
            width if column.no_wrap else max(map(_longest_word, cells))
            for column, width, cells in zip(self.columns, widths, texts, strict=True)
        ]
        room = most - len(widths) + 1  # a blank between columns
        while sum(widths) > room:
            can = [i for i, width in enumerate(widths) if width > least[i]]
            if not can:
                return None
            widths[max(can, key=lambda i: widths[i])] -= 1
        return widths

    def _paragraphs(self) -> Iterable[RenderableType]:
        """The rows one below the other: the first cell, then the others behind their headings."""
        columns = [self._texts(column) for column in self.columns]
        for i, row in enumerate(self.rows, start=1):
            words = [f"{cells[0]} {cells[i]}".strip() for cells in columns if cells[i]]
            style = row.style or ""
            yield Text("".join(words[:1]), style=style)
            if words[1:]:
                yield Padding(Text("  ".join(words[1:]), style=style), (0, 0, 0, _INDENT))


_INDENT = 2

_WIDEST = 10_000


def _longest_word(text: str) -> int:
    return max(map(len, text.split()), default=0)


def width_for(report: RenderableType, width: int) -> int:
    """`width`, or more where the longest word of a report needs it."""
    return max(width, Console(width=_WIDEST).measure(report).minimum)


def _plain_table(*columns: tuple[str, str], wrap: bool = False) -> Table:
    """A table without a frame; columns as (heading, justification), which wrap at spaces with `wrap`."""
    table = _WholeWords(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="italic")
    for heading, justify in columns:
        table.add_column(heading, justify=justify, no_wrap=not wrap, overflow="fold")  # type: ignore[arg-type]
    return table


def _figure(value: float, decimals: int, sign: str = "") -> str:
    """A figure with `decimals`; one that rounds to zero has no minus, which rounding errors alone would decide on."""
    return f"{value:{sign}z.{decimals}f}"


def _statistics(solution: Solution, uncertainty: Uncertainty) -> RenderableType:
    problem = solution.problem
    rows = [("configurations", f"{problem.n_configurations}")]
    if problem.options.uses_pairs and (problem.points is None or problem.n_pairs):
        rows.append(("pairs", f"{problem.n_pairs}"))
    if problem.points is not None:
        rows.append(("touches", f"{problem.points.train.sum()} of {len(problem.points.estimated)} points"))
        rows.append(("distances of points", f"{problem.points.used.sum()}"))
    reduced = uncertainty.reduced_chi2
    low, high = uncertainty.chi2_bounds
    determined = uncertainty.spread.rank
    rows += [
        ("residuals", f"{problem.n_residuals}, and {problem.n_priors} priors"),
        ("estimated", f"{len(problem.variables.all_scales)} unknowns, {determined} directions determined"),
        ("chi-square", f"{uncertainty.chi2:.6g} with {uncertainty.dof} degrees of freedom"),
        (
            "reduced chi-square",
            "unknown"
            if reduced is None
            else f"{reduced:.4g} (good from {low:.3g} to {high:.3g}){_of_p(uncertainty.p_value)}",
        ),
        (
            "solver",
            f"{solution.iterations} iterations, {solution.seconds:.2f} s,"
            f" cost {solution.initial_cost:.6g} -> {solution.cost:.6g}",
        ),
    ]
    table = _plain_table(("", "left"), ("", "left"))
    table.show_header = False
    for row in rows:
        table.add_row(*row)
    return table


def _of_p(p: float | None) -> str:
    return "" if p is None else f", p-value {probability(p)}"


def _with_joint_noise(solution: Solution) -> str:
    """What a reader must know of `stated`: it is more than the noise of the measurement itself."""
    return ", stated with joint noise" if np.any(solution.problem.measurements.sigma_joint > 0.0) else ""


def _goodness(solution: Solution, uncertainty: Uncertainty) -> Iterable[RenderableType]:
    """Noise stated and noise seen by kind, what the difference means, and what can be done about it."""
    estimated = solution.estimated_noise
    table = _plain_table(
        *(("", "left"), ("", "left"), ("stated", "right"), ("seen" if estimated is None else "estimated", "right")),
        *(("ratio", "right"), ("p-value", "right"), ("", "left")),
    )
    table.columns[-1].no_wrap = False
    for fit in uncertainty.goodness.kinds:
        factor, shown, decimals = _SHOWN[fit.unit]
        seen, words = fit.seen_over_stated, VERDICTS[fit.verdict]
        if estimated is not None:
            seen = fit.factor
            settled = "estimated" if solution.converged else "not settled: the estimate has not converged"
            words = settled if fit.kind in estimated else "too few rows to estimate it: as stated"
        table.add_row(
            fit.kind,
            shown,
            f"{fit.stated_sigma_rms * factor:.{decimals}f}",
            "-" if np.isnan(seen) else f"{seen * fit.stated_sigma_rms * factor:.{decimals}f}",
            "-" if np.isnan(seen) else f"{seen:.3f}",
            "-" if fit.p_value is None else probability(fit.p_value),
            words,
        )
    yield table
    yield from (Padding(Text(line), (0, 0, 0, 2)) for line in _goodness_lines(solution, uncertainty))


def _goodness_lines(solution: Solution, uncertainty: Uncertainty) -> Iterable[str]:
    goodness, estimated = uncertainty.goodness, solution.estimated_noise
    verdicts = {fit.verdict for fit in goodness.kinds}
    if estimated and solution.converged:
        yield (
            f"{' and '.join(estimated)} noise was estimated from these residuals: chi-square says nothing about it, and"
            f" {len(estimated)} of its degrees of freedom went there"
        )
    elif estimated is None and verdicts & {"too large", "too small", "both"} and uncertainty.noise_may_be_estimated:
        yield "to take the noise seen for the noise there is: estimate: true beside the figures of noise in the job"
    if uncertainty.noise_like is not None and uncertainty.noise_like < LIKE_NOISE:
        yield "the residuals follow the arm, as noise does not: effects that are not modelled"
    if estimated is None and verdicts & {"outliers", "both"}:
        may_weigh = solution.problem.adjustment.weights is None and not uncertainty.points
        yield "look at the suspicious rows below" + (", or let a robust loss weigh them: loss in the job" * may_weigh)
    if not len(goodness.suspects) and not goodness.configurations:
        yield f"no row (|studentised residual| above {goodness.level:.2f}) and no configuration is suspicious"


def _poses_behind(
    solution: Solution, uncertainty: Uncertainty, suspects: Integers, limit: int = 5
) -> Iterable[RenderableType]:
    """The poses that suspicious pairs come from: one wrong pose makes all its pairs suspicious.

    Those more than half of whose pairs are suspicious, the one in most of them first, each with the pairs that the
    poses before it do not explain. A pose with one such pair alone is not told from the other pose of the pair.
    """
    rows, problem = uncertainty.residuals, solution.problem
    if not problem.formed:
        return
    judged = np.flatnonzero((rows.reason_code == 0) & (rows.test == rows.test[suspects[0]]))
    all_pairs, left = ({(int(rows.a[i]), int(rows.b[i])) for i in some} for some in (judged, suspects))
    n_pairs, n_suspicious = Counter(chain.from_iterable(all_pairs)), len(left)
    lines = []
    while left:
        of_pose = Counter(chain.from_iterable(left))
        wrong = [pose for pose, n in of_pose.items() if n > 1 and 2 * n > n_pairs[pose]]
        if not wrong:
            break
        worst = max(wrong, key=lambda pose: (of_pose[pose], -pose))
        n, all_of_it = of_pose[worst], n_pairs[worst]
        name = problem.measurements.ids[worst]
        lines.append(f"pose {name} is in {n} of {n_suspicious} suspicious pairs, and in {all_of_it} pairs in all")
        left = {pair for pair in left if worst not in pair}
    if len(lines) > limit:
        lines[limit:] = [f"and {len(lines) - limit} more such poses"]
    yield from (Padding(Text(line), (0, 0, 0, _INDENT)) for line in lines)


def _test_rows(uncertainty: Uncertainty) -> list[RenderableType]:
    """How well the test rows are predicted, by kind; nothing without any."""
    fit = uncertainty.goodness.test
    if fit is None:
        return []
    headings = ("rows", "chi-square", "expected", "ratio", "p-value")
    table = _plain_table(("", "left"), *((heading, "right") for heading in headings), ("", "left"))
    table.columns[0].no_wrap, table.columns[-1].no_wrap = True, False
    for kind in fit.kinds:
        ratio = kind.seen_over_stated / kind.factor
        table.add_row(
            kind.kind,
            f"{kind.n}",
            f"{kind.chi2:.4g}",
            f"{kind.expected:.4g}",
            "-" if np.isnan(ratio) else f"{ratio:.3f}",
            "-" if kind.p_value is None else probability(kind.p_value),
            PREDICTION_VERDICTS[kind.verdict],
        )
    notes = []
    if fit.outliers.test:
        count = f"{fit.outliers.test} of {fit.outliers.of_test} measurements"
        notes.append(f"{count} count for nothing: the loss would take them for outliers")
    if fit.n_unknown:
        notes.append(f"{fit.n_unknown} rows are not judged: they depend on what is not determined")
    return _section("Prediction of the test rows", table, *(Padding(Text(note), (0, 0, 0, 2)) for note in notes))


def _expected_error(expected: ExpectedError | None) -> list[RenderableType]:
    """How far off the tool is expected to be, by the covariance."""
    if expected is None:
        return []
    table = _plain_table(
        ("", "left"), ("", "left"), ("in the base frame", "right"), ("after the best rigid fit", "right")
    )
    for kind, unit in (("position", "m"), ("orientation", "rad")):
        factor, shown, decimals = _SHOWN[unit]
        values = (getattr(rms, kind) for rms in (expected.base, expected.fitted))
        table.add_row(kind, shown, *("unknown" if v is None else f"{v * factor:.{decimals}f}" for v in values))
    which = "" if expected.n == expected.of else f" of {expected.of}"
    return _section(f"Expected tool error (RMS at {expected.n}{which} {expected.at} configurations)", table)


def _suspicious(solution: Solution, uncertainty: Uncertainty) -> list[RenderableType]:
    """Fitted rows and configurations that are too large, then the same of the test rows."""
    fit = uncertainty.goodness
    found: list[tuple[str, Integers, tuple[SuspectConfiguration, ...]]] = [("", fit.suspects, fit.configurations)]
    if fit.test is not None:
        found.append(("test ", fit.test.suspects, fit.test.configurations))
    parts: list[RenderableType] = []
    for split, rows, configurations in found:
        if len(rows):
            behind = _poses_behind(solution, uncertainty, rows)
            parts += _section(f"Suspicious {split}rows", *behind, _suspects(solution, uncertainty, rows))
        if configurations:
            parts += _section(f"Suspicious {split}configurations", _suspect_configurations(solution, configurations))
    return parts


def _joint_values(solution: Solution, found: JointValues | None, limit: int = 5) -> list[RenderableType]:
    """How estimated joint values lie about their readings, joint by joint, and the readings that are suspect."""
    if found is None:
        return []
    table = _plain_table(("", "left"), *((h, "right") for h in ("stated", "", "mean error / stated", "scatter")))
    joints = solution.problem.robot.joints
    for k, name in enumerate(found.names):
        factor, shown, decimals = _SHOWN[joints[found.joints[k]].unit]
        scatter = "-" if np.isnan(found.scatter[k]) else f"{found.scatter[k]:.3f}"
        table.add_row(name, f"{found.sigma[k] * factor:.{decimals}f}", shown, _figure(found.mean[k], 3, "+"), scatter)
    parts = _section("Joint readings (estimate minus reading; scatter is 1 where all is as stated)", table)
    if not found.suspects:
        return parts
    wrong = _plain_table(("", "left"), ("", "left"), ("error", "right"), ("", "left"), ("in its sigma", "right"))
    names = solution.problem.measurements.end_names
    for i, k in found.suspects[:limit]:
        factor, shown, decimals = _SHOWN[joints[found.joints[k]].unit]
        error = _figure(found.error[i, k] * factor, decimals, "+")
        wrong.add_row(
            names[found.configurations[i] + 1], found.names[k], error, shown, f"{found.studentised[i, k]:+.1f}"
        )
    if len(found.suspects) > limit:
        wrong.add_row("", f"and {len(found.suspects) - limit} more")
    return parts + _section("Suspicious joint readings", wrong)


def _suspects(solution: Solution, uncertainty: Uncertainty, suspects: Integers, limit: int = 5) -> RenderableType:
    """The rows least likely, by studentised residual."""
    rows, goodness, names = uncertainty.residuals, uncertainty.goodness, solution.problem.measurements.end_names
    table = _plain_table(
        *(("a", "left"), ("b", "left"), ("", "left"), ("residual", "right"), ("", "left")),
        *(("in its sigma", "right"), ("", "left")),
    )
    for i in suspects[:limit]:
        factor, shown, decimals = _SHOWN[_FAMILY_UNIT[FAMILIES[rows.family[i]]]]
        table.add_row(
            names[rows.a[i] + 1],
            names[rows.b[i] + 1],
            ROW_KINDS[rows.kind_code[i]],
            _figure(rows.after[i] * factor, decimals, "+"),
            shown,
            f"{goodness.studentised[i]:+.1f}",
            FLAGS[goodness.flag[i]],
        )
    if len(suspects) > limit:
        table.add_row("", "", f"and {len(suspects) - limit} more")
    return table


def _suspect_configurations(
    solution: Solution, found: tuple[SuspectConfiguration, ...], limit: int = 3
) -> RenderableType:
    """The configurations least likely, by all the rows that they take part in."""
    names = solution.problem.measurements.end_names
    table = _plain_table(("", "left"), ("rows", "right"), ("chi-square", "right"), ("expected", "right"))
    for c in found[:limit]:
        table.add_row(names[c.configuration + 1], f"{c.n}", f"{c.chi2:.4g}", f"{c.expected:.4g}")
    if len(found) > limit:
        table.add_row(f"and {len(found) - limit} more")
    return table


def _residuals(uncertainty: Uncertainty) -> RenderableType:
    rms = uncertainty.residuals.rms()
    table = _plain_table(
        ("", "left"), ("", "left"), *[(h, "right") for h in ("train before", "after", "test before", "after")]
    )
    for family, unit in _FAMILY_UNIT.items():
        if family not in rms["train"] and family not in rms["test"]:
            continue
        factor, shown, _ = _SHOWN[unit]
        figures = [
            f"{rms[split][family][when] * factor:.4f}" if family in rms[split] else "-"
            for split in ("train", "test")
            for when in ("before", "after")
        ]
        table.add_row(family, shown, *figures)
    return table


def _parameters(uncertainty: Uncertainty) -> RenderableType:
    headings = [("", "left"), ("estimate", "right"), ("", "left"), ("sigma", "right"), ("", "left")]
    table = _plain_table(
        *headings, ("correction", "right"), ("nominal", "right"), ("prior", "right"), ("class", "left")
    )
    for p in uncertainty.parameters:
        if p.identifiability == "fixed" and uncertainty.residuals.evaluated:
            continue
        if p.identifiability == "fixed" and p.name.startswith(("base.", "tool.")) and p.nominal == 0.0:
            continue
        factor, unit, decimals = _SHOWN[p.unit]
        nominal = _figure(p.nominal * factor, decimals)
        if p.identifiability == "fixed":
            table.add_row(p.name, nominal, "", "", unit, "", "", "", "fixed", style="dim")
            continue
        table.add_row(
            p.name,
            _figure(p.estimate * factor, decimals),
            "±",
            "unknown" if p.sigma is None else f"{p.sigma * factor:.{decimals}f}",
            unit,
            _figure(p.correction * factor, decimals, "+"),
            nominal,
            "" if p.prior_sigma is None else f"{p.prior_sigma * factor:.{decimals}f}",
            p.identifiability,
        )
    return table


def _combinations(uncertainty: Uncertainty) -> RenderableType:
    """The combinations that kept parameters stand for, whose sigmas are those of the estimates."""
    table = _plain_table(("", "left"), ("sigma", "right"), ("", "left"), ("of the sum", "left"), wrap=True)
    for p in uncertainty.parameters:
        if p.stands_for:
            factor, unit, decimals = _SHOWN[p.unit]
            sigma = p.sigma_of_combination
            shown = "unknown" if sigma is None else f"{sigma * factor:.{decimals}f}"
            table.add_row(p.name, shown, unit, format_combination(p.stands_for))
    return table


def format_combination(factors: Mapping[str, float]) -> str:
    """`d5 + d3 + d4`, `a7 + 0.5 beta5`: errors of the parameters, each by its factor."""
    sizes = {name: "" if abs(f) == 1.0 else f"{abs(f):.4g} " for name, f in factors.items()}
    terms = (f"{'-' if f < 0.0 else '+'} {sizes[name]}{name}" for name, f in factors.items())
    return " ".join(terms).removeprefix("+ ")


def _frame(frame: FrameEstimate) -> RenderableType:
    xyz = "  ".join(_figure(v * 1e3, 4) for v in frame.xyz)
    q = "  ".join(_figure(v, 8) for v in frame.quaternion_xyzw)

    def sigmas(values: Iterable[float], factor: float, decimals: int) -> str:
        return "  ".join(f"{v * factor:.{decimals}f}" if np.isfinite(v) else "unknown" for v in values)

    table = _plain_table(("", "left"), ("", "right"), ("", "left"))
    table.show_header = False
    table.add_row("xyz", xyz, "mm")
    table.add_row("± along its axes", sigmas(frame.sigma[3:], 1e3, 4), "mm")
    table.add_row("quaternion xyzw", q, "")
    table.add_row("± about its axes", sigmas(frame.sigma[:3], 180.0 / np.pi, 5), "deg")
    return table


def _notes(solution: Solution, uncertainty: Uncertainty) -> Iterable[str]:
    for reason, count in solution.problem.n_excluded.items():
        if count:
            yield f"{count} train rows take no part: {reason.replace('_', ' ')}"
    judgement, pairs = solution.problem.judgement, solution.problem.pairs
    if judgement is not None and pairs is not None and (same := int(np.sum(judgement.same_point & ~pairs.test))):
        yield f"{same} train pairs are one point twice: three coordinates each instead of a distance"
    if pairs is None and solution.problem.measurements.pairs is not None:
        unused, model = solution.problem.measurements.pairs.source, solution.problem.options.model
        yield f"{unused} is not used: model {model} is of poses, not of pairs"
    yield from _sharing_notes(solution.problem)
    yield from uncertainty.cautions
    weights = solution.problem.adjustment.weights
    if weights is not None:
        test = solution.problem.measurements.test if pairs is None else pairs.test
        n, what = int(np.sum(weights[~test] < OUTLIER_WEIGHT)), "poses" if pairs is None else "pairs"
        yield (
            f"loss {solution.problem.options.loss}: {n} of {int(np.sum(~test))} {what} lost more than half their"
            " weight and count for nothing in chi-square"
        )
    yield from _open_notes(solution, uncertainty)
    turned = {p.name.split(".")[0] for p in uncertainty.parameters if _is_a_turn(p)}
    for frame in sorted(turned):
        yield f"{frame} is pitched near a quarter turn: corrections of its angles are its turn about its own axes"
    if not uncertainty.residuals.split.any():
        yield "no test rows: how well this predicts new configurations was not checked"


def _is_a_turn(parameter: ParameterEstimate) -> bool:
    """Whether a correction is about a frame's own axis, not the difference of an angle (see `corrections_of`)."""
    off = parameter.estimate - parameter.nominal - parameter.correction
    return parameter.unit == "rad" and abs(np.remainder(off + np.pi, 2.0 * np.pi) - np.pi) > 1e-9


def _open_notes(solution: Solution, uncertainty: Uncertainty) -> Iterable[str]:
    """What became of the parameters that the data alone do not determine."""
    held = [p for p in uncertainty.parameters if p.identifiability in ("relative", "ineffective")]
    estimated, before = set(uncertainty.names), solution.before[solution.problem.variables.robot_span]
    at_start = dict(zip(names_of(solution.problem.robot.parameters), before, strict=True))

    def what_became(p: ParameterEstimate) -> str:
        if p.name in estimated and p.prior_sigma is not None:
            return "what the data leave open of {} is held by their priors"
        if abs(p.correction) <= _UNMOVED:
            return "what the data leave open of {} stays at nominal"
        if solution.problem.options.gauge == "keep":
            return "{} stand for their combinations with what stays at nominal"
        if p.sigma is not None:
            return "what the data leave open of {} is held by the priors of others that act with them"
        if abs(p.estimate - at_start[p.name]) <= _UNMOVED:
            return "nothing holds {}: they are where the first fit, of frame, base and tool alone, left them"
        return "nothing holds {} in part: they are where steps of least change left them, which is not nominal"

    became: dict[str, list[ParameterEstimate]] = {}
    for p in held:
        became.setdefault(what_became(p), []).append(p)
    for sentence, parameters in became.items():
        yield sentence.format(_listed(parameters, with_values=sentence.startswith("nothing")))


def _sharing_notes(problem: Problem) -> Iterable[str]:
    """What became of errors that pairs share."""
    pairs, configurations = problem.n_pairs, problem.n_configurations
    if problem.approximate:
        yield (
            f"{pairs} pairs share the errors of {configurations} configurations, too many to carry them: pairs are"
            " weighted as independent, and sigmas account for what they share"
        )
        if problem.formed and pairs > 2 * configurations:
            yield "model pose with frame unknown uses all that these poses hold, at less cost"
    elif problem.formed and problem.sharing != problem.common and pairs >= configurations:
        yield (
            f"{pairs} pairs are formed from {configurations} poses and counted as independent: the sigmas are too"
            " small, by a factor where there are many more pairs than poses"
        )


def _listed(parameters: list[ParameterEstimate], *, with_values: bool = False) -> str:
    names, limit = [p.name for p in parameters], 12
    if with_values:
        limit = 6
        shown = ((p, *_SHOWN[p.unit]) for p in parameters)
        names = [f"{p.name} ({_figure(p.correction * f, digits, '+')} {unit})" for p, f, unit, digits in shown]
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")


def format_identifiability(found: Identifiability, width: int = WIDTH) -> str:
    """`build_identifiability_report` as plain text."""
    return _plain_text(build_identifiability_report(found), width)


def build_identifiability_report(found: Identifiability) -> RenderableType:
    """What can be identified, as in the paper's Tables 3 and 4, and why the rest cannot."""
    where = "random configurations" if found.kind == "structural" else "configurations"
    title = f"{found.robot}: {found.model}, {found.kind}, {found.n_configurations} {where}"
    parts: list[RenderableType] = [Text(title, style="bold")]
    parts += (Text(f"NOT MODELLED: {m}", style="bold red") for m in found.missing)
    parts += _classes(found)
    known = found.with_fixed_known
    if known is not None:
        parts += [
            Text(f"\nWith {', '.join(found.fixed)} known, as the robot's file says", style="bold"),
            *_classes(known),
        ]
    return Group(*parts)


def _classes(found: Identifiability) -> list[RenderableType]:
    o = found.observability
    table = _plain_table(("Identifiability", "left"), ("Kinematic parameters", "left"), wrap=True)
    table.add_row("Independent", ", ".join(o.named("independent")) or "None")
    relations = (f"[{' '.join(relation)}]" for group in o.relative for relation in group.relations)
    table.add_row("Relative", Text(", ".join(relations) or "None"))
    table.add_row("Ineffective", ", ".join(o.named("ineffective")) or "None")
    table.add_row("Kept", ", ".join(o.kept) or "None")
    parts: list[RenderableType] = [Text(f"rank {o.rank} of {len(o.names)}\n"), table]
    if found.lost:
        parts += _section("Lost directions", _lost(found.lost))
    practical = found.kind == "practical"
    parts += _section("Singular values" + (" (signal-to-noise ratios)" if practical else ""), _singular_values(o))
    if practical:
        indices = "  ".join(f"{name} {value:.4g}" for name, value in o.indices.items())
        parts += _section("Observability indices", Text(f"{indices}  condition number {o.condition_number:.4g}"))
        weak = _weak(o)
        if weak is not None:
            parts += _section(f"Weak directions ({_WEAK})", weak)
        parts += _section("Sigma of what is kept, the rest at nominal", _sigmas(o))
        if o.correlations:
            correlated = (Text(f"{a}, {b}: {rho:+.3f}") for a, b, rho in o.correlations)
            parts += _section(f"Correlations above {CORRELATED:g}", *correlated)
    return parts


def _lost(lost: Sequence[LostDirection]) -> RenderableType:
    """One line a reason, with the directions that have it."""
    by_reason: dict[str, list[str]] = {}
    for direction in lost:
        by_reason.setdefault(direction.reason, []).append(format_relation(direction.relation))
    table = _plain_table(("", "left"), ("because", "left"), wrap=True)
    for reason, relations in by_reason.items():
        table.add_row(", ".join(relations), reason)
    return table


def format_relation(relation: Mapping[str, float]) -> str:
    """`d3 - d4` where sizes are equal, else `d6 by +0.5 m with alpha7 by +1 rad`."""
    names, values = list(relation), list(relation.values())
    if all(abs(v) == 1.0 for v in values):
        return names[0] + "".join(f" {'+' if v > 0 else '-'} {n}" for n, v in zip(names[1:], values[1:], strict=True))
    large = {n: v for n, v in relation.items() if abs(v) >= 0.01}  # the largest is 1
    text = " with ".join(f"{n} by {v:+.4g} {unit_of(n)}" for n, v in large.items())
    n_small = len(relation) - len(large)
    return text + (f" and a little of {n_small} more" if n_small else "")


def unit_of(name: str) -> str:
    """`m` or `rad`, by a parameter's name."""
    kind = name.rsplit(".", 1)[-1].rstrip("0123456789") if "." not in name else name.rsplit(".", 1)[-1]
    return "m" if AXIS_OF_KIND[kind] < Axis.RX else "rad"


def _weak(observability: Observability) -> RenderableType | None:
    """Weak directions by their largest members; None if there are none."""
    if not observability.weak:
        return None
    table = _plain_table(("sigma / tolerance", "right"), ("largest members", "left"), wrap=True)
    for weak in observability.weak[:5]:
        members = ", ".join(f"{name} {share:+.2f}" for name, share in list(weak.members.items())[:6])
        table.add_row(f"{1.0 / weak.signal_to_noise:.3g}", members)
    if len(observability.weak) > 5:
        table.add_row("", f"and {len(observability.weak) - 5} more")
    return table


def _singular_values(observability: Observability) -> RenderableType:
    o = observability
    kept, dropped = o.singular_values[: o.rank], o.singular_values[o.rank :]
    lines = [" ".join(f"{v:.3g}" for v in kept) or "none"]
    if len(dropped):
        lines.append(f"gap of {o.gap:.1e}, then {len(dropped)} of at most {dropped[0]:.1e}")
    return Text("\n".join(lines))


def _sigmas(observability: Observability) -> RenderableType:
    table = _plain_table(("", "left"), ("sigma", "right"), ("", "left"), ("stands for", "left"))
    for name, sigma in observability.sigma.items():
        factor, unit, decimals = _SHOWN[unit_of(name)]
        others = [g for g in observability.relative if name in g.keep]
        stands = " ".join(others[0].parameters) if others else ""
        table.add_row(name, f"{sigma * factor:.{decimals}f}", unit, stands)
    return table


_ESTIMATORS = {
    "graph": "graph",
    "graph-keep": "graph kept",
    "gauss-newton": "plain GN",
    "weighted-gauss-newton": "weighted GN",
    "scipy": "scipy",
}
"""Headings of `comparison.ESTIMATORS`."""

_POSE_ERROR: tuple[tuple[str, str, Callable[[PoseError], float]], ...] = (
    ("position, max", "m", lambda e: e.max),
    ("position, mean", "m", lambda e: e.mean),
    ("position, RMS", "m", lambda e: e.rms),
    ("orientation, RMS", "rad", lambda e: e.orientation_rms),
)


def format_comparison(comparison: Comparison, width: int = WIDTH) -> str:
    """`build_comparison_report` as plain text."""
    return _plain_text(build_comparison_report(comparison), width)


def build_comparison_report(comparison: Comparison) -> RenderableType:
    """The estimators side by side: errors, residuals, effort, then the parameters that each found."""
    job = comparison.job
    title = (
        f"{job.robot.name}: {job.options.model}, judged at {comparison.n_judged} {comparison.judged_on} configurations"
    )
    parts: list[RenderableType] = [Text(title)]
    parts += [Text(f"DOUBTFUL: {finding}", style="bold red") for finding in comparison.findings]
    parts += [Text(""), _accuracy(comparison)]
    parts += _section("Corrections (± sigma claimed)", _corrections(comparison))
    parts += _section("Estimators", _estimators(comparison))
    notes = list(_comparison_notes(comparison))
    return Group(*parts, *_section("Notes", *(Padding(Text(note), (0, 0, 0, 2)) for note in notes)))


def _accuracy(comparison: Comparison) -> RenderableType:
    estimates = comparison.estimates
    headings = ("nominal", *(_ESTIMATORS[e.name] for e in estimates))
    table = _plain_table(("", "left"), ("", "left"), *((heading, "right") for heading in headings))

    def row(label: str, unit: str, values: Iterable[float | None]) -> None:
        factor, shown, decimals = _SHOWN[unit]
        figures = ("-" if v is None else _large(v * factor, decimals - 1) for v in values)
        table.add_row(f"  {label}", shown, *figures)

    errors = [comparison.errors_before, *(e.errors for e in estimates)]
    sections: tuple[tuple[str, list[PoseError | None]], ...] = (
        ("Real error in the base frame", [None if e is None else e.base for e in errors]),
        ("Real error after the best rigid fit", [None if e is None else e.fitted for e in errors]),
    )
    for heading, chosen in sections:
        if not any(chosen):
            continue
        table.add_row(Text(heading, style="bold"))
        for label, unit, figure in _POSE_ERROR:
            row(label, unit, [None if e is None else figure(e) for e in chosen])
    table.add_row(Text("Error predicted by its sigmas", style="bold"))
    row("position, RMS", "m", [None, *(e.predicted_rms for e in estimates)])
    row("after best rigid fit", "m", [None, *(e.predicted_fitted_rms for e in estimates)])
    before = estimates[0].residual_rms or {}
    for split in ("train", "test"):
        families = [f for f in _FAMILY_UNIT if f in before.get(split, {})]
        if families:
            table.add_row(Text(f"Residuals, {split} rows (RMS)", style="bold"))
        for family in families:
            after = [None if e.residual_rms is None else e.residual_rms[split][family]["after"] for e in estimates]
            row(family, _FAMILY_UNIT[family], [before[split][family]["before"], *after])
    table.add_row(Text("Effort", style="bold"))
    ran = [e.robot is not None for e in estimates]
    table.add_row(
        "  parameters", "", "-", *(f"{len(e.sigma)}" if r else "-" for e, r in zip(estimates, ran, strict=True))
    )
    table.add_row(
        "  iterations", "", "-", *(f"{e.iterations}" if r else "-" for e, r in zip(estimates, ran, strict=True))
    )
    table.add_row(
        "  time", "ms", "-", *(f"{e.seconds * 1e3:.1f}" if r else "-" for e, r in zip(estimates, ran, strict=True))
    )
    table.add_row("  converged", "", "-", *("yes" if e.converged else "NO" for e in estimates))
    return table


def _large(value: float, decimals: int, sign: str = "") -> str:
    """A figure with `decimals`, or in powers of ten where an estimate went astray."""
    return _figure(value, decimals, sign) if abs(value) < 1e5 else f"{value:{sign}.1e}"


def _corrections(comparison: Comparison) -> RenderableType:
    job, estimates = comparison.job, comparison.estimates
    truth = [("truth", "right")] if job.truth is not None else []
    headings = [(_ESTIMATORS[e.name], "right") for e in estimates]
    table = _plain_table(("", "left"), ("", "left"), *truth, *headings, wrap=True)
    for p in job.robot.parameters:
        if not p.estimated:
            continue
        factor, unit, decimals = _SHOWN[p.unit]

        def correction(robot: Robot, name: str, factor: float = factor, decimals: int = decimals - 1) -> str:
            return _large(comparison.correction(robot, name) * factor, decimals, "+")

        def cell(e: Estimate, name: str, factor: float = factor, decimals: int = decimals - 1) -> str:
            if e.robot is None:
                return "-"
            if name not in e.sigma:
                return "held"
            sigma = e.sigma[name]
            claimed = _large(sigma * factor, decimals) if np.isfinite(sigma) else "unknown"
            return f"{correction(e.robot, name)} ±{claimed}"

        true = [correction(job.truth, p.name)] if job.truth is not None else []
        table.add_row(p.name, unit, *true, *(cell(e, p.name) for e in estimates))
    return table


def _estimators(comparison: Comparison) -> RenderableType:
    table = _plain_table(("", "left"), ("", "left"), wrap=True)
    table.show_header = False
    table.columns[0].no_wrap = True
    table.add_row("  nominal", "the arm before calibration, its tool and measurement frame fitted where unknown")
    for e in comparison.estimates:
        table.add_row(f"  {_ESTIMATORS[e.name]}", f"{e.description}; {e.message}")
    return table


def _comparison_notes(comparison: Comparison) -> Iterable[str]:
    if comparison.judged_on == "train":
        yield "no test rows: judged at the train configurations, which flatters every estimator"
    if comparison.errors_before is None:
        yield "the truth is not known: no real errors (key truth of a job)"
    if any(e.robot is not None and len(e.sigma) < len(comparison.estimates[0].sigma) for e in comparison.estimates):
        yield "where others are held a parameter stands for its combination with them: compare errors, not corrections"
    yield "predicted errors take what was held at nominal for known, so they may be too small in the base frame"
    yield "residuals are of the rows that the graph uses; plain least squares fits those near kinks too"
