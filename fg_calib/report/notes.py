"""Notes below the calibration report: what took no part, what became of the undetermined, what was not checked."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fg_calib.analysis.goodness import OUTLIER_WEIGHT
from fg_calib.analysis.uncertainty import ParameterEstimate, Uncertainty
from fg_calib.graph.problem import Problem
from fg_calib.graph.solver import Solution
from fg_calib.report.tables import SHOWN, rounded
from fg_calib.robot.model import names_of

_UNMOVED = 1e-9
"""Metres or radians by which an estimate that no step meant to move may differ from where it was."""


def notes(solution: Solution, uncertainty: Uncertainty) -> Iterable[str]:
    """What a reader of the report should know besides, a sentence each."""
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
    """How errors that pairs share were dealt with."""
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
        shown = ((p, *SHOWN[p.unit]) for p in parameters)
        names = [f"{p.name} ({rounded(p.correction * f, digits, '+')} {unit})" for p, f, unit, digits in shown]
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")
