"""What would still be undetermined, and which kind of measurement would cure it.

Directions that no kind of measurement sees are told first; of the others as many as are left beside these. A kind cures
a direction if what would still be undetermined with it, at random configurations, has no share of that direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.designs.task import Posterior
from fg_calib.graph.build import random_problem
from fg_calib.graph.information import named_triangle, observability_of
from fg_calib.graph.problem import Problem
from fg_calib.observability.indices import Observability
from fg_calib.observability.reasons import NOT_EXCITED, explain_relations
from fg_calib.options import FrameKnowledge, Model

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Relation = dict[str, float]

KINDS: tuple[tuple[str, Model, FrameKnowledge], ...] = (
    ("distances between configurations", "distance", "known"),
    ("angles between configurations", "rotation", "known"),
    ("positions in an unknown frame", "position", "unknown"),
    ("orientations in an unknown frame", "orientation", "unknown"),
    ("poses in an unknown frame", "pose", "unknown"),
    ("positions in the base frame", "position", "known"),
    ("poses in the base frame", "pose", "known"),
)
"""Kinds of measurement that are asked, what is easier to have first."""

SEEN = 1e-4
"""Part of the largest effect of any parameter above which a direction is seen.

What is lost has less than a thousandth of a sigma; of axes that a calibration left parallel within some millionths of
a radian, poses would see shifts along them as little. Where the largest effect is some ten sigma, this is the same.
"""

_SHARE = 1e-4
"""Share of a direction above which another is not independent of it; far above the rounding of both."""


NEARLY = "others move the arm nearly the same"
"""Why a direction that poses see a little is not determined by them either."""

_LEFT = 0.05
"""Share of a direction that may stay undetermined of one that is cured: of axes that are nearly parallel, a little of
many directions goes with what hardly anything sees."""


@dataclass(frozen=True)
class Cure:
    """A direction that stays undetermined.

    Attributes:
        relation: The change of each parameter, [m] and [rad], the largest being 1 or -1.
        reason: Why, in words.
        by: Kinds of measurement that would determine it, what is easier to have first; none where nothing does.
    """

    relation: dict[str, float]
    reason: str
    by: tuple[str, ...]


def cures_of(posterior: Posterior) -> tuple[Cure, ...]:
    """The directions that stay undetermined, with what would cure each.

    Args:
        posterior: What would be known.
    """
    observability = posterior.observability
    if not observability.lost:
        return ()
    problem = posterior.problem
    robot = problem.robot.with_values(problem.start[problem.variables.robot_span])
    scales = np.array([robot.scale_of(p.unit) for p in problem.estimated])
    kinds = [(name, random_problem(robot, model, frame)) for name, model, frame in KINDS]
    relations, by = _with_unseen_first(observability, kinds[-1][1], scales), dict[str, Booleans]()
    directions = np.array([_direction(one, observability, scales) for one in relations])
    for name, anywhere in kinds:
        J = named_triangle(anywhere, anywhere.start) * scales
        by[name] = _cured(J @ directions.T, SEEN * float(np.linalg.norm(J, axis=0).max()))
    here, of_poses = (
        explain_relations(one, observability.names, relations, one.start) for one in (problem, kinds[-1][1])
    )
    cures = [tuple(name for name in by if by[name][k]) for k in range(len(relations))]
    reasons = (one if found else other for one, other, found in zip(here, of_poses, cures, strict=True))
    return tuple(
        Cure(relation, NEARLY if why.reason == NOT_EXCITED and not found else why.reason, found)
        for relation, why, found in zip(relations, reasons, cures, strict=True)
    )


def _direction(relation: Relation, observability: Observability, scales: Floats) -> Floats:
    """A relation as a unit vector, in changes of ordinary size."""
    moved = np.array([relation.get(name, 0.0) for name in observability.names]) / scales
    out: Floats = moved / np.linalg.norm(moved)
    return out


def _with_unseen_first(observability: Observability, poses: Problem, scales: Floats) -> list[Relation]:
    """As many relations, of the same directions: what poses do not see, then what is left of the others.

    Of shifts along parallel axes that are all lost, base and all, poses would still see their sum alone: named one by
    one, each would seem to be cured.
    """
    unseen = observability_of(poses, poses.start).lost
    lost = np.array([_direction(one, observability, scales) for one in observability.lost])
    inside = np.linalg.qr(lost.T)[0]
    kept: list[Relation] = []
    basis = np.zeros((0, len(scales)))
    for relation in (*unseen, *observability.lost):
        v = _direction(relation, observability, scales)
        if np.linalg.norm(v - inside @ (inside.T @ v)) > _SHARE:
            continue
        v = v - basis.T @ (basis @ v)
        if np.linalg.norm(v) > _SHARE:
            basis = np.vstack([basis, v / np.linalg.norm(v)])
            kept.append(relation)
    return kept


def _cured(effects: Floats, floor: float) -> Booleans:
    """Which directions, of these effects in the columns, have no share in what has no effect."""
    _, s, Vt = np.linalg.svd(effects)
    left = Vt[int(np.sum(s > floor)) :]
    out: Booleans = np.linalg.norm(left, axis=0) <= _LEFT
    return out
