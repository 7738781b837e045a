"""What would still be undetermined, and which kind of measurement would cure it.

A direction that the rows leave undetermined is moved at random configurations; a kind of measurement cures it if it
would see that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fg_calib.analysis.identifiability import identifiability_of
from fg_calib.designs.task import Posterior
from fg_calib.graph.build import random_problem
from fg_calib.graph.information import named_triangle
from fg_calib.options import FrameKnowledge, Model

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

SEEN = 1e-6
"""Part of the largest effect of any parameter above which a direction is seen."""


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
    reasons = {
        tuple(one.relation.items()): one.reason for one in identifiability_of(problem, problem.start, "practical").lost
    }
    robot = problem.robot.with_values(problem.start[problem.variables.robot_span])
    scales = np.array([robot.scale_of(p.unit) for p in problem.estimated])
    effects = []
    for name, model, frame in KINDS:
        anywhere = random_problem(robot, model, frame)
        effects.append((name, named_triangle(anywhere, anywhere.start) * scales))
    found = []
    for relation in observability.lost:
        moved = np.array([relation.get(name, 0.0) for name in observability.names]) / scales
        moved /= np.linalg.norm(moved)
        by = [name for name, J in effects if np.linalg.norm(J @ moved) > SEEN * np.linalg.norm(J, axis=0).max()]
        found.append(Cure(relation, reasons.get(tuple(relation.items()), ""), tuple(by)))
    return tuple(found)
