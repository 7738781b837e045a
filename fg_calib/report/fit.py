"""Sections of the calibration report on the fit: goodness, prediction of the test rows, and what is suspicious."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from fg_calib.analysis.findings import LIKE_NOISE
from fg_calib.analysis.goodness import FLAGS, PREDICTION_VERDICTS, VERDICTS, KindFit, SuspectConfiguration
from fg_calib.analysis.uncertainty import Uncertainty
from fg_calib.analysis.verdict import probability
from fg_calib.graph.solver import Solution
from fg_calib.report.tables import SHOWN, indented, plain_table, rounded, section

Integers = NDArray[np.int64]


def goodness_of_fit(solution: Solution, uncertainty: Uncertainty) -> Iterable[RenderableType]:
    """Noise stated and noise seen by kind, what the difference means, and what can be done about it."""
    estimated = solution.estimated_noise
    table = plain_table(
        *(("", "left"), ("", "left"), ("stated", "right"), ("seen" if estimated is None else "estimated", "right")),
        *(("ratio", "right"), ("p-value", "right"), ("", "left")),
    )
    table.columns[-1].no_wrap = False
    for fit in uncertainty.goodness.kinds:
        factor, shown, decimals = SHOWN[fit.unit]
        seen, words = fit.seen_over_stated, VERDICTS[fit.verdict]
        if estimated is not None:
            seen = fit.factor
            settled = "estimated" if solution.converged else "not settled: the estimate has not converged"
            words = settled if (fit.table, fit.kind) in estimated else "too few rows to estimate it: as stated"
        table.add_row(
            _of_table(solution, fit),
            shown,
            f"{fit.stated_sigma_rms * factor:.{decimals}f}",
            "-" if np.isnan(seen) else f"{seen * fit.stated_sigma_rms * factor:.{decimals}f}",
            "-" if np.isnan(seen) else f"{seen:.3f}",
            "-" if fit.p_value is None else probability(fit.p_value),
            words,
        )
    yield table
    yield from indented(_goodness_lines(solution, uncertainty))


def _goodness_lines(solution: Solution, uncertainty: Uncertainty) -> Iterable[str]:
    goodness, estimated = uncertainty.goodness, solution.estimated_noise
    verdicts = {fit.verdict for fit in goodness.kinds}
    if estimated and solution.converged:
        kinds = " and ".join(dict.fromkeys(kind for _, kind in estimated))
        yield (
            f"{kinds} noise was estimated from these residuals: chi-square says nothing about it, and"
            f" {len(estimated)} of its degrees of freedom went there"
        )
    elif estimated is None and verdicts & {"too large", "too small", "both"} and uncertainty.noise_may_be_estimated:
        joint_noise = bool(np.any(solution.problem.measurements.sigma_joint > 0.0))
        if joint_noise and "too large" in verdicts:
            yield (
                "the joint noise stated may be what is too large (one figure a joint: noise: {joint: [...]}); estimate:"
                " true would make all noise smaller by the same"
            )
            return
        yield "to take the noise seen for the noise there is: estimate: true beside the figures of noise in the job"
    if uncertainty.noise_like is not None and uncertainty.noise_like < LIKE_NOISE:
        yield "the residuals follow the arm, as noise does not: effects that are not modelled"
    if estimated is None and verdicts & {"outliers", "both"}:
        may_weigh = solution.problem.state.weights is None
        yield "look at the suspicious rows below" + (", or let a robust loss weigh them: loss in the job" * may_weigh)
    if not len(goodness.suspects) and not goodness.configurations:
        yield f"no row (|studentised residual| above {goodness.level:.2f}) and no configuration is suspicious"


def with_joint_noise(solution: Solution) -> str:
    """Words for the heading where `stated` has more than the noise of the measurement itself."""
    return ", stated with joint noise" if np.any(solution.problem.measurements.sigma_joint > 0.0) else ""


def _of_table(solution: Solution, fit: KindFit) -> str:
    """A kind of noise, with its table where there are several."""
    labels = solution.problem.data.labels
    return fit.kind if len(labels) == 1 else f"{fit.kind} of {labels[fit.table]}"


def prediction(solution: Solution, uncertainty: Uncertainty) -> list[RenderableType]:
    """How well the test rows are predicted, by kind; no section without test rows."""
    fit = uncertainty.goodness.test
    if fit is None:
        return []
    headings = ("rows", "chi-square", "expected", "ratio", "p-value")
    table = plain_table(("", "left"), *((heading, "right") for heading in headings), ("", "left"))
    table.columns[0].no_wrap, table.columns[-1].no_wrap = True, False
    for kind in fit.kinds:
        ratio = kind.seen_over_stated / kind.factor
        table.add_row(
            _of_table(solution, kind),
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
    return section("Prediction of the test rows", table, *indented(notes))


def suspicious(solution: Solution, uncertainty: Uncertainty) -> list[RenderableType]:
    """Fitted rows and configurations that are too large, then the same of the test rows."""
    fit = uncertainty.goodness
    found: list[tuple[str, Integers, tuple[SuspectConfiguration, ...]]] = [("", fit.suspects, fit.configurations)]
    if fit.test is not None:
        found.append(("test ", fit.test.suspects, fit.test.configurations))
    parts: list[RenderableType] = []
    for split, rows, configurations in found:
        if len(rows):
            behind = _poses_behind(solution, uncertainty, rows)
            parts += section(f"Suspicious {split}rows", *behind, _suspects(solution, uncertainty, rows))
        if configurations:
            parts += section(f"Suspicious {split}configurations", _suspect_configurations(solution, configurations))
    return parts


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
        name = problem.data.names[worst]
        lines.append(f"pose {name} is in {n} of {n_suspicious} suspicious pairs, and in {all_of_it} pairs in all")
        left = {pair for pair in left if worst not in pair}
    if len(lines) > limit:
        lines[limit:] = [f"and {len(lines) - limit} more such poses"]
    yield from indented(lines)


def _suspects(solution: Solution, uncertainty: Uncertainty, suspects: Integers, limit: int = 5) -> RenderableType:
    """The rows least likely, by studentised residual."""
    rows, goodness, names = uncertainty.residuals, uncertainty.goodness, solution.problem.end_names
    table = plain_table(
        *(("a", "left"), ("b", "left"), ("", "left"), ("residual", "right"), ("", "left")),
        *(("in its sigma", "right"), ("", "left")),
    )
    for i in suspects[:limit]:
        factor, shown, decimals = SHOWN[rows.kinds[rows.kind_code[i]].unit]
        table.add_row(
            names[rows.a[i] + 1],
            names[rows.b[i] + 1],
            rows.kinds[rows.kind_code[i]].name,
            rounded(rows.after[i] * factor, decimals, "+"),
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
    names = solution.problem.end_names
    table = plain_table(("", "left"), ("rows", "right"), ("chi-square", "right"), ("expected", "right"))
    for c in found[:limit]:
        table.add_row(names[c.configuration + 1], f"{c.n}", f"{c.chi2:.4g}", f"{c.expected:.4g}")
    if len(found) > limit:
        table.add_row(f"and {len(found) - limit} more")
    return table
