"""The calibration report for people: verdict, statistics, residuals, parameters; lengths in mm, angles in degrees.

It is made of a typed result and its tables, so that a loaded calibration prints like a new one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from fg_calib.assessment import Assessment
from fg_calib.diagnostics import chi2_in_words, predicted_in_words, probability
from fg_calib.graph import Solution
from fg_calib.inputs import LIMITED, Booleans, Floats
from fg_calib.io import Result, key_of
from fg_calib.measurements import LANDMARKS
from fg_calib.prediction import ExpectedError, PredictedErrors, ToolPoseUncertainty, predict_errors
from fg_calib.report import tables
from fg_calib.report.tables import Section, figure, in_order, in_words, line, quantities, section, shortened, table_of
from fg_calib.robot import Robot
from fg_calib.statistics import (
    OUTLIER_WEIGHT,
    PREDICTION_VERDICTS,
    VERDICTS,
    Judgement,
    KindFit,
    ParameterEstimate,
    TangentCovariance,
)

if TYPE_CHECKING:
    import polars as pl

UNMOVED = 1e-9
"""How far an estimate that no step meant to move may be from its start, [m] and [rad]."""


@dataclass(frozen=True)
class ReportData:
    """What the report, the page and the figures of a calibration are made of.

    Attributes:
        result: The result.
        robot: The calibrated robot.
        posterior: The covariance of its parameters.
        configurations: Every measured configuration; None if they were not saved.
        residuals: Every scalar residual; None if they were not saved.
    """

    result: Result
    robot: Robot
    posterior: TangentCovariance
    configurations: pl.DataFrame | None
    residuals: pl.DataFrame | None

    @property
    def split(self) -> str:
        """The rows that accuracy is shown of: `test` if there are any, else `train`."""
        return "test" if self.result.rms_after("test") else "train"

    @cached_property
    def readings(self) -> Floats:
        """Readings of the measured configurations, shape (n, n_joints), [rad] (prismatic: [m])."""
        assert self.configurations is not None
        return self.configurations.select(f"q{i + 1}" for i in range(self.robot.n_joints)).to_numpy()

    @cached_property
    def held_out(self) -> Booleans:
        """Which configurations were held out, shape (n,)."""
        assert self.configurations is not None
        return (self.configurations["split"] == "test").to_numpy()

    @cached_property
    def workspace(self) -> PredictedErrors | None:
        """Expected errors over the workspace; None where nothing says what was measured."""
        if self.configurations is None or not len(self.configurations):
            return None
        model = ToolPoseUncertainty.of(self.posterior, self.readings)
        return predict_errors(self.robot, model, self.readings, fitted=self.result.free_of_frame)

    @cached_property
    def rms(self) -> tuple[str, Floats] | None:
        """The kind of residual that is nearest to the tool's position, and its RMS by configuration in the unit shown.

        Shape (n,), nan where a configuration has none; None where there is no such kind.
        """
        if self.configurations is None:
            return None
        kinds = [name.removeprefix("rms_") for name in self.configurations.columns if name.startswith("rms_")]
        for kind in sorted(kinds, key=lambda k: ["position", "distance", "point", "pixel", k].index(k)):
            values = self.configurations[f"rms_{kind}"].cast(float).fill_null(np.nan).to_numpy()
            if np.isfinite(values).any():
                return kind, values * tables.factor(self.result.unit_of(kind))
        return None


def format_result(found: ReportData, width: int = tables.WIDTH) -> str:
    """The report as plain text."""
    return tables.plain_text(build_report(found), width)


def build_report(found: ReportData) -> Group:
    """The report, to be printed by rich."""
    return tables.report(*_verdict(found.result), *build_sections(found))


def build_sections(found: ReportData, most: int = 5) -> list[Section]:
    """The sections of the report, for the terminal and the page.

    Args:
        found: The calibration.
        most: Suspicious rows that are listed, and weak directions.
    """
    result = found.result
    joint_noise = ", with joint noise" if np.any(result.sigma_joint > 0.0) else ""
    notes = [*(text for text in result.cautions if result.findings or text not in result.reservations), *result.notes]
    parameters = parameter_table(result) if result.estimated or not result.evaluated_only else ""
    return [
        *section("Fit statistics", _statistics(result)),
        *section(f"Goodness of fit (1 sigma of a row{joint_noise})", *_goodness(result, found.robot)),
        *_prediction(result),
        *_cross_validation(result),
        *expected_tool_error(result.expected_error),
        *section(RESIDUALS, _residuals(result)),
        *section(PARAMETERS, *([parameters] if parameters else [])),
        *section("Prior sigmas estimated (ratio to the specified ones, with its 95 % interval)", _tolerances(result)),
        *section("Combinations that the kept parameters stand for", _combinations(result)),
        *_suspicious_rows(found.residuals, most),
        *section("Suspicious configurations", *_suspicious_configurations(result)),
        *_joint_values(found),
        *_frames(result),
        *_landmarks(result),
        *section("Not identifiable from these data", tables.lost_directions(result.observability.lost)),
        *section(tables.WEAKLY, tables.weak_directions(result.observability.observability, most)),
        *section(NOTES, *notes),
    ]


RESIDUALS, PARAMETERS, NOTES = "Residuals (RMS)", "Parameters", "Notes"
"""Titles of sections to which the page adds charts, or which it shows first."""


def verdict_word(result: Result) -> str:
    """`GOOD`, with its warnings if there are any, or `DOUBTFUL`."""
    return "DOUBTFUL" if result.findings else "GOOD, with warnings" if result.reservations else "GOOD"


def judged(judgements: Iterable[Judgement]) -> list[str]:
    """A line a limit: `PASS: position 0.31 mm (RMS of 30 held-out measurements), limit 0.5 mm`."""
    lines = []
    for one in judgements:
        unit = LIMITED[one.kind]
        error = "" if one.error is None else f" {in_words(one.error, unit)} (RMS of {one.n} held-out measurements)"
        reason = f": {one.reason}" if one.reason else ""
        of = f" of {one.table}" if one.table else ""
        lines.append(f"{one.verdict.upper()}: {one.kind}{of}{error}, limit {in_words(one.limit, unit)}{reason}")
    return lines


def _verdict(result: Result) -> Iterator[Text | str]:
    several = len(result.tables) > 1
    measured = "; ".join(f"{label} ({words})" if several else words for label, words in result.tables)
    joints = ", joint positions estimated" if result.joint_values is not None else ""
    loss = "" if result.loss == "none" else f", loss {result.loss}"
    yield line(f"{result.robot}: {measured}{joints}{loss}")
    if result.evaluated_only:
        yield line("EVALUATED ONLY: all rows are test rows, nothing of the arm was calibrated")
    yield from (line(f"DOUBTFUL: {finding}", "bold red") for finding in result.findings)
    if not result.findings:
        yield line(f"{verdict_word(result)}: {result.solver.message}", "bold green")
        yield from result.reservations
    if result.acceptance is not None:
        colour = {"pass": "bold green", "fail": "bold red"}.get(result.acceptance.verdict, "bold yellow")
        yield from (line(text, colour) for text in judged(result.acceptance.judgements))
    if result.evaluated_only and result.chi2_p_value is not None:
        yield line(f"test rows: {chi2_in_words(result.chi2, result.chi2_expected, result.chi2_p_value)}")
    elif result.test is not None and result.test.n:
        yield line(predicted_in_words(result.test))


def _statistics(result: Result) -> Table:
    (low, high), reduced, solver = result.chi2_bounds, "unknown", result.solver
    if result.reduced_chi2 is not None:
        p = "" if result.chi2_p_value is None else f", p-value {probability(result.chi2_p_value)}"
        reduced = f"{result.reduced_chi2:.4g} (good from {low:.3g} to {high:.3g}){p}"
    cost = f"cost {solver.initial_cost:.6g} -> {solver.cost:.6g}"
    rows = {
        "configurations": f"{result.n_configurations}",
        "pairs": f"{result.n_pairs or ''}",
        "residuals": f"{result.n_residuals}, and {result.n_priors} priors",
        "estimated": f"{result.n_unknowns} unknowns, {result.n_determined} directions determined",
        "chi-square": f"{result.chi2:.6g} with {result.dof} degrees of freedom",
        "reduced chi-square": reduced,
        "solver": f"{solver.iterations} iterations, {solver.seconds:.2f} s, {cost}",
    }
    return table_of(("", ""), [row for row in rows.items() if row[1]], left="ll")


def _named(result: Result, fit: KindFit) -> str:
    return fit.kind if len(result.tables) == 1 else f"{fit.kind} of {result.tables[fit.table][0]}"


def _p_value(p: float | None) -> str:
    return "-" if p is None else probability(p)


def _goodness(result: Result, robot: Robot) -> list[Table | str]:
    """Specified and estimated noise by kind, and what their ratio means."""
    factors, fits, rows = result.noise_factors, tuple(result.goodness.values()), list[tuple[str, ...]]()
    for fit in fits:
        specified, ratio, words = fit.stated_sigma_rms, fit.seen_over_stated, VERDICTS[fit.verdict]
        if factors is not None:
            specified, ratio, words = fit.own_sigma_rms, fit.own_factor, _estimated_noise(result, key_of(fit, fits))
        sigmas = quantities(fit.unit, specified, ratio * specified, none="-")
        rows.append((_named(result, fit), *sigmas, _ratio(ratio), _p_value(fit.p_value), words))
    joint = (factors or {}).get("joint")
    for unit in dict.fromkeys(one.unit for one in robot.joints) if joint is not None else ():
        sigma = result.sigma_joint[[one.unit == unit for one in robot.joints]]
        rms = np.sqrt(np.mean(sigma[sigma > 0.0] ** 2)) if np.any(sigma > 0.0) else np.nan
        words = _estimated_noise(result, "joint")
        rows.append(("joint readings", *quantities(unit, rms / (joint or 1.0), rms), f"{joint:.3f}", "-", words))
    headings = ("", "", "specified", "observed" if factors is None else "estimated", "ratio", "p-value", "")
    level = f"no row (|studentised residual| above {result.suspect_level:.2f}) and no configuration is suspicious"
    none = not result.suspect_configurations and not any(fit.n_beyond for fit in fits)
    return [
        table_of(headings, rows, left="llrrrrl", wrap=True),
        *([level] if none and np.isfinite(result.suspect_level) else []),
    ]


def _ratio(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "-"


def _estimated_noise(result: Result, key: str) -> str:
    if key in result.noise_kept:
        return "cannot be estimated from these rows: as specified"
    return "estimated" if result.solver.converged else "not settled: the estimate has not converged"


def _prediction(result: Result) -> list[Section]:
    """How well the test rows are predicted, by kind."""
    fit, rows, notes = result.test, [], []
    if fit is None:
        return []
    for kind in fit.kinds:
        cells = f"{kind.n}", f"{kind.chi2:.4g}", f"{kind.expected:.4g}", _ratio(kind.seen_over_stated / kind.factor)
        rows.append((_named(result, kind), *cells, _p_value(kind.p_value), PREDICTION_VERDICTS[kind.verdict]))
    if fit.n_outliers:
        notes.append(f"{fit.n_outliers} of {fit.n_measurements} measurements do not count: outliers by the loss")
    if fit.n_unknown:
        notes.append(f"{fit.n_unknown} rows are not judged: they depend on what is not determined")
    headings = ("", "rows", "chi-square", "expected", "ratio", "p-value", "")
    return section("Prediction of the test rows", table_of(headings, rows, left="lrrrrrl", wrap=True), *notes)


def _cross_validation(result: Result) -> list[Section]:
    """How well configurations are predicted by calibrations without them, and how parameters spread."""
    found = result.folds
    if found is None:
        return []
    rows = []
    for kind in in_order(found.kinds):
        held = found.kinds[kind]
        unit, *values = quantities(result.unit_of(kind), held.before, held.after, held.noise, form=".4f")
        rows.append((kind, unit, f"{held.n}", *values))
    lines, (ratio, wide) = [], found.beyond({p.name: p.sigma for p in result.estimated})
    if ratio:
        median = f"{np.median(list(ratio.values())):.2f}" + " (pairs: expect 1.4 to 1.7)" * found.of_pairs
        lines.append(f"spread of a parameter between folds over its sigma: median {median}, below 1 where priors act")
    if wide:
        named = shortened([f"{name} {ratio[name]:.1f}" for name in wide], 5)
        lines.append(f"spread significantly larger than sigma: {named}; the model lacks an effect, or rows are wrong")
    if found.not_converged:
        lines.append(f"{found.not_converged} of {found.n} calibrations did not converge")
    title = f"Cross-validation ({found.n} folds of configurations, each predicted without it; RMS)"
    return section(title, table_of(("", "", "held out", "before", "after", "specified noise"), rows, left="ll"), *lines)


def expected_tool_error(expected: ExpectedError | None) -> list[Section]:
    """The section on the expected error of the tool, by the covariance; none for an evaluation."""
    if expected is None:
        return []
    rows = [
        (kind, *quantities(unit, *(getattr(rms, kind) for rms in (expected.base, expected.fitted))))
        for kind, unit in tables.POSE_KINDS.items()
    ]
    which = "" if expected.n == expected.of else f" of {expected.of}"
    title = f"Expected tool error (RMS at {expected.n}{which} {expected.at} configurations)"
    return section(title, table_of(("", "", "in the base frame", "after the best rigid fit"), rows, left="ll"))


def _residuals(result: Result) -> Table:
    """By kind; by table where several tables have it."""
    names, rows = list(result.residual_rms["train"]), []
    for kind in in_order(name for name in names if ", table" not in name):
        for name in [name for name in names if name.startswith(f"{kind}, table ")] or [kind]:
            both = [result.residual_rms[split].get(name) for split in ("train", "test")]
            values = (getattr(rms, when, None) for rms in both for when in ("before", "after"))
            if any(both):
                rows.append((name, *quantities(result.unit_of(kind), *values, form=".4f", none="-")))
    return table_of(("", "", "train before", "after", "test before", "after"), rows, left="ll")


def parameter_table(result: Result) -> Table:
    """Every parameter; base and tool fixed at zero are left out, and all fixed ones of an evaluation."""
    rows: list[tuple[str, ...]] = []
    for p in result.parameters:
        unit, estimate, sigma, nominal = quantities(p.unit, p.estimate, p.sigma, p.nominal)
        if p.identifiability != "fixed":
            more = figure(p.correction, p.unit, "+"), nominal, figure(p.prior_sigma, p.unit, none="")
            rows.append((p.name, estimate, sigma, unit, *more, p.identifiability))
        elif not result.evaluated_only and (p.nominal != 0.0 or not p.name.startswith(("base.", "tool."))):
            rows.append((p.name, estimate, "", unit, "", "", "", "fixed"))
    headings = ("", "estimate", "± sigma", "", "correction", "nominal", "prior", "class")
    return table_of(headings, rows, left="lrrlrrrl")


def _tolerances(result: Result) -> Table:
    """Each scale of prior sigmas; these themselves only where those of a scale are all the same."""
    sigma_of, rows = {p.name: (p.unit, p.prior_sigma) for p in result.parameters}, []
    for one in result.tolerance_scales or ():
        (unit, sigma), *others = {sigma_of[name] for name in one.parameters}
        same = not others and sigma is not None
        shown, specified, estimated = quantities(unit, *((sigma or 0.0) / s for s in (one.scale, 1.0)), form=".3g")
        cells = (specified, estimated, shown) if same else ("", "", "")
        ratios = f"{one.scale:.3g}", f"{one.low:.2g}", f"{one.high:.2g}", f"{one.seen:.1f} of {len(one.parameters)}"
        rows.append((one.group, *cells, *ratios))
    headings = ("", "specified", "estimated", "", "ratio", "from", "to", "corrections that count")
    return table_of(headings, rows, left="rrrl")


def _combinations(result: Result) -> Table:
    rows = []
    for p in result.parameters:
        unit, sigma = quantities(p.unit, p.sigma_of_combination)
        if p.stands_for:
            rows.append((p.name, sigma, unit, format_combination(p.stands_for)))
    return table_of(("", "sigma", "", "of the sum"), rows, left="lrll", wrap=True)


def format_combination(factors: Mapping[str, float]) -> str:
    """`d5 + d3 + d4`, `a7 + 0.5 beta5`: errors of the parameters, each with its factor."""
    sizes = {name: "" if abs(f) == 1.0 else f"{abs(f):.4g} " for name, f in factors.items()}
    terms = (f"{'-' if f < 0.0 else '+'} {sizes[name]}{name}" for name, f in factors.items())
    return " ".join(terms).removeprefix("+ ")


def _suspicious_rows(residuals: pl.DataFrame | None, most: int) -> list[Section]:
    """The fitted rows that are larger than noise, then the test rows, the worst first; none if they were not saved."""
    sections: list[Section] = []
    for split, word in (("train", ""), ("test", "test ")):
        if residuals is None:
            break
        suspects = residuals.filter(residuals["suspect"] & (residuals["split"] == split))
        suspects = suspects[suspects["studentised"].abs().fill_nan(0.0).arg_sort(descending=True)]
        more = [name for name in ("table", "of") if name in suspects.columns]
        rows: list[tuple[Any, ...]] = []
        for row in suspects.head(most).fill_null("").iter_rows(named=True):
            residual = figure(row["residual"], row["unit"], "+"), tables.unit_shown(row["unit"])
            names = row["a"], row["b"], row["kind"], *(row[name] for name in more)
            rows.append((*names, *residual, f"{row['studentised']:+.1f}", row["flag"]))
        if len(suspects) > most:
            rows.append(("", "", f"and {len(suspects) - most} more", *[""] * (4 + len(more))))
        headings = ("a", "b", "", *more, "residual", "", "in its sigma", "")
        sections += section(f"Suspicious {word}rows", table_of(headings, rows, left=f"lll{'l' * len(more)}rlrl"))
    return sections


def _suspicious_configurations(result: Result, most: int = 8) -> list[Table | str]:
    """The configurations whose residuals together are larger than noise."""
    found = result.suspect_configurations
    rows = [(c.id, c.n, f"{c.chi2:.4g}", f"{c.expected:.4g}") for c in found[:most]]
    more = [f"and {shortened([c.id for c in found[most:]], 8)}"] if len(found) > most else []
    return [table_of(("", "rows", "chi-square", "expected"), rows), *more]


def _joint_values(found: ReportData, most: int = 5) -> list[Section]:
    """Estimated joint positions compared with the readings, joint by joint, and the suspicious readings."""
    values, configurations = found.result.joint_values, found.configurations
    if values is None:
        return []
    units = [found.robot.joints[j].unit for j in values.joints]
    sigma = "specified" if (found.result.noise_factors or {}).get("joint", 1.0) == 1.0 else "estimated"
    rows, wrong = [], []
    for k, (name, unit) in enumerate(zip(values.names, units, strict=True)):
        shown, size = quantities(unit, values.sigma[k])
        rows.append((name, size, shown, f"{values.mean[k]:+z.3f}", _ratio(values.scatter[k])))
    for i, k in values.suspects[:most]:
        at = int(values.configurations[i])
        name = str(at) if configurations is None else configurations["id"][at]
        shown, error = quantities(units[k], values.error[i, k], form="+")
        wrong.append((name, values.names[k], error, shown, f"{values.studentised[i, k]:+.1f}"))
    if len(values.suspects) > most:
        wrong.append(("", f"and {len(values.suspects) - most} more", "", "", ""))
    title = f"Joint readings (estimate minus reading; scatter is 1 where all is as {sigma})"
    return [
        *section(title, table_of(("", sigma, "", f"mean error / {sigma}", "scatter"), rows, left="lrl")),
        *section("Suspicious joint readings", table_of(("", "", "error", "", "in its sigma"), wrong, left="llrl")),
    ]


def _landmarks(result: Result, most: int = 8) -> list[Section]:
    """Estimated contact points, targets, anchors, planes and boards; `result.json` has all of many."""
    sections: list[Section] = []
    for kind, title in ((kind.name, kind.heading) for kind in LANDMARKS.values() if kind.heading):
        chosen, rows = [p for p in result.groups if p.kind == kind], []
        for p in chosen[:most]:
            units = ["" if kind == "unknown" else unit for unit in p.units]
            sigma = _vector(p.sigma, *units) if p.sigma.any() else "known"
            rows.append((p.name, f"{p.n}", _vector(p.xyz, *units), "±", sigma))
        if len(chosen) > most:
            rows.append((f"and {len(chosen) - most} more", "", "", "", ""))
        sections += section(title, table_of(("", "rows", "estimate", "", "sigma"), rows, left="lrrlr"))
    return sections


def _frames(result: Result) -> list[Section]:
    """The estimated measurement frames."""
    sections: list[Section] = []
    for symbol, frame in result.frames.items():
        which = "" if len(result.tables) == 1 else f" of {result.tables[int(symbol[2:-1])][0]}"
        rows = [
            ("xyz", _vector(frame.xyz, *"mmm"), "mm"),
            ("± along its axes", _vector(frame.sigma[3:], *"mmm"), "mm"),
            ("quaternion xyzw", "  ".join(f"{v:z.8f}" for v in frame.quaternion_xyzw.tolist()), ""),
            ("± about its axes", _vector(frame.sigma[:3], *["rad"] * 3), "deg"),
        ]
        sections += section(f"Measurement frame (world_T_base{which})", table_of(("", "", ""), rows, left="lrl"))
    return sections


def _vector(values: Floats, *units: str) -> str:
    return "  ".join(figure(v, unit) for v, unit in zip(values.tolist(), units, strict=True))


def summary(result: Result, most: int = 3) -> list[str]:
    """Robot, verdict, counts and residuals in at most ten lines.

    Args:
        result: The result.
        most: How many errors or warnings are shown.
    """
    texts = [f"DOUBTFUL: {finding}" for finding in result.findings]
    texts = texts or [f"{verdict_word(result)}: {result.solver.message}", *result.reservations]
    more = [f"... and {len(texts) - most} more findings"] if len(texts) > most else []
    chi2 = "" if result.reduced_chi2 is None else f", reduced chi-square {result.reduced_chi2:.3g}"
    known = sum(p.sigma is not None for p in result.estimated)
    lines = [
        f"{result.robot}: {'; '.join(words for _, words in result.tables)}",
        *([] if result.acceptance is None else judged(result.acceptance.judgements)),
        *texts[:most],
        *more,
        f"{result.n_configurations} configurations, {result.n_residuals} residuals{chi2}",
        f"{len(result.estimated)} of {len(result.parameters)} parameters estimated, {known} of them with a known sigma",
        *_rms_lines(result),
    ]
    return [str(line(text if len(text) <= tables.WIDTH else f"{text[: tables.WIDTH - 4]} ...")) for text in lines]


def _rms_lines(result: Result) -> Iterator[str]:
    for split, kinds in result.residual_rms.items():
        found = [
            f"{kind} {in_words(rms.before, result.unit_of(kind))} -> {in_words(rms.after, result.unit_of(kind))}"
            for kind, rms in kinds.items()
            if rms is not None
        ]
        if found:
            yield f"{split} residuals, RMS: {', '.join(found)}"


def notes_of(solution: Solution, assessed: Assessment) -> Iterator[str]:
    """What a reader of the report should know besides, a sentence each."""
    problem, goodness = solution.problem, assessed.fit.goodness
    for reason, count in problem.n_excluded.items():
        if count:
            yield f"{count} train rows are excluded: {reason.replace('_', ' ')}"
    if same := problem.data.n_train(lambda kind: kind.is_contact and kind.ends == 2):
        yield f"{same} train pairs touch one point twice: three coordinates each instead of a distance"
    for table in problem.data.tables:
        if not table.uses_pairs and table.measurements.pairs is not None:
            yield f"{table.measurements.pairs.source} is not used: model {table.model} is of poses, not of pairs"
    if problem.added:
        values = problem.variables.values(solution.parameters)
        chi2 = 2.0 * sum(factor.error(values) for factor in problem.added)
        yield f"{len(problem.added)} added factors with {problem.n_added} rows: chi-square {chi2:.6g}"
    if problem.formed and problem.missing_correlation and problem.n_pairs >= problem.n_configurations:
        yield (
            f"{problem.n_pairs} pairs are formed from {problem.n_configurations} poses and counted as independent: the"
            " sigmas are too small where there are many more pairs than poses"
        )
    yield from _noise_notes(solution, assessed)
    weights, series = problem.state.weights, problem.data.series
    if weights is not None:
        n = sum(int(np.sum(w[s.train] < OUTLIER_WEIGHT)) for s, w in zip(series, weights, strict=True))
        yield (
            f"loss {problem.options.loss}: {n} of {sum(len(s.train) for s in series)} measurements lost more than half"
            " their weight and do not count in chi-square"
        )
    yield from _undetermined(solution, assessed)
    for frame in sorted({p.name.split(".")[0] for p in assessed.estimates.parameters if _is_rotation(p)}):
        yield f"{frame} is pitched near 90 degrees: corrections of its angles are rotations about its own axes"
    if not assessed.fit.residuals.split.any():
        yield "no test rows: the prediction of new configurations was not checked"
    if goodness.suspects.size and weights is None:
        yield "suspicious rows may be weighted down by a robust loss: loss in the job"


def _noise_notes(solution: Solution, assessed: Assessment) -> Iterator[str]:
    """What the ratio of observed to specified noise means, and how to estimate the noise."""
    estimated, joint_noise = solution.estimated_noise, bool(np.any(solution.problem.data.sigma_joint > 0.0))
    verdicts = {fit.verdict for fit in assessed.fit.goodness.kinds}
    if estimated and solution.converged:
        kinds = " and ".join(dict.fromkeys(kind for _, kind in estimated))
        yield (
            f"{kinds} noise was estimated from these residuals: chi-square does not test it, and {len(estimated)}"
            " degrees of freedom are used for it"
        )
    elif estimated is None and verdicts & {"too large", "too small", "both"} and assessed.noise_may_be_estimated:
        if joint_noise and "too large" in verdicts:
            yield (
                "the specified joint noise may be too large (one value a joint: noise: {joint: [...]}); estimate: true"
                " separates it from that of the measurements where possible"
            )
        else:
            yield "to use the observed noise instead of the specified one: estimate: true in noise of the job"


def _is_rotation(p: ParameterEstimate) -> bool:
    """Whether a correction is about a frame's own axis, not the difference of an angle (see `corrections_of`)."""
    off = p.estimate - p.nominal - p.correction
    return p.unit == "rad" and abs(np.remainder(off + np.pi, 2.0 * np.pi) - np.pi) > UNMOVED


def _undetermined(solution: Solution, assessed: Assessment) -> Iterator[str]:
    """What fixes the parameters that the data alone do not determine."""
    estimated, keep = set(assessed.names), solution.problem.options.gauge == "keep"
    fixed: dict[str, list[ParameterEstimate]] = {}
    for p in assessed.estimates.parameters:
        if p.identifiability in ("relative", "ineffective"):
            if p.name in estimated and p.prior_sigma is not None:
                what = "not identifiable from these data, fixed by their priors: {}"
            elif abs(p.correction) <= UNMOVED:
                what = "not identifiable from these data, kept at nominal: {}"
            elif keep:
                what = "standing for combinations with parameters that stay at nominal: {}"
            elif p.sigma is not None:
                what = "not identifiable from these data, fixed by priors of parameters in combination with them: {}"
            else:
                what = "fixed by nothing, moved from nominal by steps of minimum norm: {}"
            fixed.setdefault(what, []).append(p)
    for what, parameters in fixed.items():
        yield what.format(shortened([p.name for p in parameters], 12))
