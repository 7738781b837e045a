"""Notes on a calibration: rows that do not count, undetermined parameters, and what was not checked."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fg_calib.assessment import Assessment
from fg_calib.graph.solver import Solution
from fg_calib.report.tables import SHOWN, rounded, shortened
from fg_calib.robot.model import names_of
from fg_calib.statistics.estimates import ParameterEstimate
from fg_calib.statistics.goodness_of_fit import OUTLIER_WEIGHT

UNMOVED = 1e-9
"""How far an estimate that no step meant to move may be from its start, [m] and [rad]."""


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
        chi2 = 2.0 * sum(factor.error(solution.values) for factor in problem.added)
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
    estimated, before = set(assessed.names), solution.before[solution.problem.variables.robot_span]
    at_start = dict(zip(names_of(solution.problem.robot.parameters), before, strict=True))

    def what_fixes(p: ParameterEstimate) -> str:
        if p.name in estimated and p.prior_sigma is not None:
            return "{} are not identifiable from these data; their priors fix them"
        if abs(p.correction) <= UNMOVED:
            return "{} are not identifiable from these data; they stay at nominal"
        if solution.problem.options.gauge == "keep":
            return "{} stand for their combinations with parameters that stay at nominal"
        if p.sigma is not None:
            return "{} are not identifiable from these data; priors of parameters in combination with them fix them"
        if abs(p.estimate - at_start[p.name]) <= UNMOVED:
            return "nothing fixes {}: they are where the first fit, of frame, base and tool alone, left them"
        return "nothing fixes {} completely: they are where steps of minimum norm left them, which is not nominal"

    fixed: dict[str, list[ParameterEstimate]] = {}
    for p in assessed.estimates.parameters:
        if p.identifiability in ("relative", "ineffective"):
            fixed.setdefault(what_fixes(p), []).append(p)
    for sentence, parameters in fixed.items():
        names = [p.name for p in parameters]
        if sentence.startswith("nothing"):
            shown = ((p, *SHOWN[p.unit]) for p in parameters)
            names = [f"{p.name} ({rounded(p.correction * f, digits, '+')} {unit})" for p, f, unit, digits in shown]
        text = sentence.format(shortened(names, 6 if sentence.startswith("nothing") else 12))
        yield text if len(parameters) > 1 else text.replace(" are ", " is ").replace("they stay", "it stays")
