"""Sections of the calibration report on the fit: goodness, prediction of the test rows, and what is suspicious."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from fg_calib.assessment import Assessment as Uncertainty
from fg_calib.diagnostics.verdict import probability
from fg_calib.graph.noise import JOINT_NOISE, NoiseName
from fg_calib.graph.solver import Solution
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import indented, plain_table, rounded, section
from fg_calib.statistics.goodness_of_fit import FLAGS, PREDICTION_VERDICTS, VERDICTS, KindFit, SuspectConfiguration

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
        if uncertainty.change is not None and fit.verdict in ("too small", "outliers", "others", "both", "many"):
            words = "too large: see what moved, on top"
        stated = fit.stated_sigma_rms
        if estimated is not None:
            stated, seen = fit.own_sigma_rms, fit.own_factor
            words = _of_estimate(solution, (fit.table, fit.kind))
        table.add_row(
            _of_table(solution, fit),
            shown,
            f"{stated * factor:.{decimals}f}",
            "-" if np.isnan(seen) else f"{seen * stated * factor:.{decimals}f}",
            "-" if np.isnan(seen) else f"{seen:.3f}",
            "-" if fit.p_value is None else probability(fit.p_value),
            words,
        )
    if estimated is not None and np.any(solution.problem.data.sigma_joint > 0.0):
        for name, unit, stated in _joint_noise(solution):
            factor, shown, decimals = SHOWN[unit]
            ratio = solution.problem.state.factors.get(JOINT_NOISE, 1.0)
            figures = f"{stated * factor:.{decimals}f}", f"{ratio * stated * factor:.{decimals}f}", f"{ratio:.3f}"
            table.add_row(name, shown, *figures, "-", _of_estimate(solution, JOINT_NOISE))
    yield table
    yield from indented(_goodness_lines(solution, uncertainty))


def _of_estimate(solution: Solution, name: NoiseName) -> str:
    """What became of noise that was to be estimated."""
    if name in (solution.estimated_noise or ()):
        return "estimated" if solution.converged else "not settled: the estimate has not converged"
    if np.any(solution.problem.data.sigma_joint > 0.0):
        return "not to be told from other noise: as stated"
    return "too few rows to estimate it: as stated"


def _joint_noise(solution: Solution) -> Iterable[tuple[str, str, float]]:
    """Words, unit and RMS sigma as stated of the joint readings, joints that turn and those that slide apart."""
    sigma, joints = solution.problem.data.sigma_joint, solution.problem.robot.joints
    for unit in dict.fromkeys(joint.unit for joint in joints):
        of_unit = np.array([s for s, joint in zip(sigma, joints, strict=True) if joint.unit == unit and s > 0.0])
        if len(of_unit):
            yield "joint readings", unit, float(np.sqrt(np.mean(of_unit**2)))


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
                " true tells it from that of the measurements where these can"
            )
            return
        yield "to take the noise seen for the noise there is: estimate: true beside the figures of noise in the job"
    if estimated is None and verdicts & {"outliers", "both"} and uncertainty.change is None:
        may_weigh = solution.problem.state.weights is None
        yield "look at the suspicious rows below" + (", or let a robust loss weigh them: loss in the job" * may_weigh)
    if not len(goodness.suspects) and not goodness.configurations:
        yield f"no row (|studentised residual| above {goodness.level:.2f}) and no configuration is suspicious"


def with_joint_noise(solution: Solution) -> str:
    """Words for the heading where `stated` has more than the noise of the measurement itself."""
    if not np.any(solution.problem.measurements.sigma_joint > 0.0):
        return ""
    return ", stated with joint noise" if solution.estimated_noise is None else ", joint noise apart"


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
            behind = *_poses_behind(solution, uncertainty, rows), *indented(_in_common(solution, uncertainty, rows))
            parts += section(f"Suspicious {split}rows", *behind, _suspects(solution, uncertainty, rows))
        if configurations:
            table = _suspect_configurations(solution, uncertainty, configurations, rows)
            parts += section(f"Suspicious {split}configurations", table)
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


def _in_common(solution: Solution, uncertainty: Uncertainty, suspects: Integers) -> Iterable[str]:
    """The target, anchor, corner or table that most of several suspicious rows are of, where most others are not."""
    rows, tables = uncertainty.residuals, solution.problem.data.labels
    judged = (rows.reason_code == 0) & (rows.test == rows.test[suspects[0]])
    of_table = np.array([kind.table for kind in rows.kinds])[rows.kind_code]
    for names, codes in ((rows.labels, rows.label_code), (tables, of_table)):
        found = np.bincount(codes[suspects], minlength=len(names))
        most, n = int(np.argmax(found)), len(suspects)
        there = judged & (codes == most)
        mine = suspects[codes[suspects] == most]
        one_measurement = len({(rows.series[i], rows.measurement[i]) for i in mine.tolist()}) == 1
        share = float(np.sum(there)) / float(np.sum(judged))
        if not names[most] or one_measurement or 2 * found[most] <= n or 2.0 * share * n > found[most]:
            continue
        count = f"{found[most]} of {n}" if found[most] < n else "both" if n == 2 else f"all {n}"
        yield f"{count} suspicious rows are of {names[most]}, as are {np.sum(there)} of all {np.sum(judged)} rows"


def _suspects(solution: Solution, uncertainty: Uncertainty, suspects: Integers, limit: int = 5) -> RenderableType:
    """The rows least likely, by studentised residual."""
    rows, goodness, names = uncertainty.residuals, uncertainty.goodness, solution.problem.end_names
    labelled, tables = len(rows.labels) > 1, solution.problem.data.labels
    table = plain_table(
        *(("a", "left"), ("b", "left"), ("", "left"), *[("of", "left")] * labelled, ("residual", "right")),
        *(("", "left"), ("in its sigma", "right"), ("", "left")),
    )
    for i in suspects[:limit]:
        kind = rows.kinds[rows.kind_code[i]]
        factor, shown, decimals = SHOWN[kind.unit]
        table.add_row(
            names[rows.a[i] + 1],
            names[rows.b[i] + 1],
            kind.name if len(tables) == 1 else f"{kind.name} of {tables[kind.table]}",
            *[rows.labels[rows.label_code[i]]] * labelled,
            rounded(rows.after[i] * factor, decimals, "+"),
            shown,
            f"{goodness.studentised[i]:+.1f}",
            FLAGS[goodness.flag[i]],
        )
    if len(suspects) > limit:
        table.add_row("", "", f"and {len(suspects) - limit} more")
    return table


def _suspect_configurations(
    solution: Solution,
    uncertainty: Uncertainty,
    found: tuple[SuspectConfiguration, ...],
    suspects: Integers,
    limit: int = 3,
) -> RenderableType:
    """The configurations least likely, by all the rows that they take part in, and what the suspicious ones are of."""
    names, rows = solution.problem.end_names, uncertainty.residuals
    labelled = len(rows.labels) > 1
    headings = (("rows", "right"), ("chi-square", "right"), ("expected", "right"))
    table = plain_table(("", "left"), *headings, *[("suspicious rows are of", "left")] * labelled)
    for c in found[:limit]:
        mine = suspects[(rows.a[suspects] == c.configuration) | (rows.b[suspects] == c.configuration)]
        of = list(dict.fromkeys(rows.labels[code] for code in rows.label_code[mine].tolist() if code))
        of[limit:] = [f"{len(of) - limit} more"] if len(of) > limit else []
        cells = f"{c.n}", f"{c.chi2:.4g}", f"{c.expected:.4g}"
        table.add_row(names[c.configuration + 1], *cells, *[", ".join(of) or "-"] * labelled)
    if len(found) > limit:
        table.add_row(f"and {len(found) - limit} more")
    return table
