"""Mirror images: planes whose normal may point the other way, anchors that may be on the other side of the tool points.

Where readings about a plane are small beside what the nominal arm is off by, and where tool points about an anchor lie
nearly in a plane, nominal explains both sides alike. Which side it is shows only after the calibration, and no descent
leads from one to the other: the normal would have to turn by half a turn, the anchor to pass through the points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.problem import Problem, assembled, at_parameters
from fg_calib.graph.rows import At
from fg_calib.graph.solver import Solution
from fg_calib.measurements.kinds.anchor import AnchorContact, AnchorDistance
from fg_calib.measurements.kinds.plane import PlaneDistance
from fg_calib.measurements.landmarks import Landmarks
from fg_calib.robot.kinematics import forward

Floats = NDArray[np.float64]

LEAST_POINTS = 4
"""Lengths that tell an anchor from its mirror image."""


@dataclass(frozen=True)
class MirrorImage:
    """A solution's problem with one thing at its mirror image.

    Attributes:
        problem: The problem, started there; of a plane with another point behind it (see `PlaneDistance`).
        before: The parameter vector with the arm at nominal, near to where it is with that.
    """

    problem: Problem
    before: Floats


def mirror_images(solution: Solution) -> Iterator[MirrorImage]:
    """Every plane and anchor of a solution at its mirror image, one at a time."""
    unknowns = solution.problem.data.unknowns
    at = at_parameters(solution.problem, solution.parameters)
    first = np.cumsum([0, *unknowns.sizes])
    for index, letter in enumerate(unknowns.letters):
        if letter in "AF" and at.columns[first[index]] >= 0:
            image = (_anchor if letter == "A" else _plane)(solution, at, int(first[index]))
            if image is not None:
                yield image


def _plane(solution: Solution, at: At, first: int) -> MirrorImage | None:
    """A plane with its normal the other way; None where all readings are the same, and tell no side.

    It is shifted to where the readings are those from the other side, in the mean.
    """
    problem, data, behind = solution.problem, [np.zeros(0)], -1
    for s in problem.data.series:
        if isinstance(s.kind, PlaneDistance):
            rows = s.train[s.nuisances[s.train, 3] == first]
            data.append(s.data[rows, 0])
            behind = int(s.nuisances[rows[0], 0]) if len(rows) else behind
    reading = np.concatenate(data)
    if np.ptp(reading) == 0.0:
        return None
    c, f = (at.coordinates[k : k + 3] for k in (behind, first))
    normal = (f - c) / np.linalg.norm(f - c)
    through, start = f + 2.0 * float(np.mean(reading)) * normal, solution.parameters.copy()
    start[problem.variables.coordinates[first : first + 3]] = through
    unknowns = problem.data.unknowns.with_start(behind, through + (f - c))
    return MirrorImage(_with_constants(problem, unknowns, start), solution.before)


def _anchor(solution: Solution, at: At, first: int) -> MirrorImage | None:
    """An anchor mirrored in the plane that its tool points are nearest to; None of few, or of one that was touched."""
    problem, points = solution.problem, [np.zeros((0, 3))]
    for s in problem.data.series:
        if isinstance(s.kind, AnchorDistance | AnchorContact):
            rows = s.train[s.nuisances[s.train, 0] == first]
            if isinstance(s.kind, AnchorContact) and len(rows):
                return None
            trig = problem.data.trigs(problem.robot)[s.table]
            points.append(forward(at.chains[s.table].without_columns(), trig, s.ends[rows, 0]).position)
    there = np.concatenate(points)
    if len(there) < LEAST_POINTS:
        return None
    middle = there.mean(axis=0)
    across = np.linalg.svd(there - middle)[2][2]
    place = problem.variables.coordinates[first : first + 3]
    start, before = solution.parameters.copy(), solution.before.copy()
    for values in (start, before):
        values[place] -= 2.0 * across * (across @ (values[place] - middle))
    return MirrorImage(assembled(problem, start), before)


def _with_constants(problem: Problem, unknowns: Landmarks, start: Floats) -> Problem:
    """A problem whose unknowns are started elsewhere, those too that are not estimated."""
    data = replace(problem.data, unknowns=unknowns)
    others = np.nan_to_num(np.concatenate(unknowns.starts))

    def anew(p: Problem) -> Problem:
        return replace(p, data=data, variables=replace(p.variables, others=others))

    whole = None if problem.whole is None else anew(problem.whole)
    return assembled(replace(anew(problem), whole=whole), start)
