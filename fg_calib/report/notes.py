"""Notes below the calibration report: what took no part, what became of the undetermined, what was not checked."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fg_calib.assessment import Assessment as Uncertainty
from fg_calib.graph.problem import Problem
from fg_calib.graph.solver import Solution
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import rounded
from fg_calib.robot.model import names_of
from fg_calib.statistics.estimates import ParameterEstimate
from fg_calib.statistics.goodness_of_fit import OUTLIER_WEIGHT

_UNMOVED = 1e-9
"""Metres or radians by which an estimate that no step meant to move may differ from where it was."""


def notes(solution: Solution, uncertainty: Uncertainty) -> Iterable[str]:
    """What a reader of the report should know besides, a sentence each."""
    for reason, count in solution.problem.n_excluded.items():
        if count:
            yield f"{count} train rows take no part: {reason.replace('_', ' ')}"
    if same := solution.problem.data.n_train(lambda kind: kind.is_contact and kind.ends == 2):
        yield f"{same} train pairs are one point twice: three coordinates each instead of a distance"
    for table in solution.problem.data.tables:
        if not table.uses_pairs and table.measurements.pairs is not None:
            yield f"{table.measurements.pairs.source} is not used: model {table.model} is of poses, not of pairs"
    yield from _sharing_notes(solution.problem)
    on_top = () if uncertainty.findings else uncertainty.reservations
    yield from (text for text in uncertainty.cautions if text not in on_top)
    weights, series = solution.problem.state.weights, solution.problem.data.series
    if weights is not None:
        n = sum(int(np.sum(w[s.train] < OUTLIER_WEIGHT)) for s, w in zip(series, weights, strict=True))
        n_train = sum(len(s.train) for s in series)
        kinds = {("touches", "poses", "pairs")[s.kind.ends if not s.kind.n_nuisances else 0] for s in series}
        what = kinds.pop() if len(kinds) == 1 else "measurements"
        yield (
            f"loss {solution.problem.options.loss}: {n} of {n_train} {what} lost more than half"
            " their weight and count for nothing in chi-square"
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
    """How errors that pairs share were dealt with."""
    pairs, configurations = problem.n_pairs, problem.n_configurations
    if problem.formed and problem.missing_correlation and pairs >= configurations:
        yield (
            f"{pairs} pairs are formed from {configurations} poses and counted as independent: the sigmas are too"
            " small, by a factor where there are many more pairs than poses"
        )


def _listed(parameters: list[ParameterEstimate], *, with_values: bool = False) -> str:
    names, limit = [p.name for p in parameters], 12
    if with_values:
        limit = 6
        shown = ((p, *SHOWN[p.unit]) for p in parameters)
        names = [f"{p.name} ({rounded(p.correction * f, digits, '+')} {unit})" for p, f, unit, digits in shown]
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")
