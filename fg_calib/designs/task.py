"""What a calibration is for: the tool at the configurations of a task, and how far off it would be.

The mean square error over the task is `tr(W C)`, `W = mean v^T v`, with v the derivatives of the tool point (after the
rotation and shift that fit all points best, where it is *fitted*) and C the covariance of the arm's parameters. Of
orientations w counts with a length: how far off a point at that distance from the tool is by a turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import Brief, FrozenArrays
from fg_calib.graph.normal_system import eliminate
from fg_calib.graph.problem import Problem
from fg_calib.observability.indices import Observability, observability_of_rows
from fg_calib.observability.observed_quantities import Seen
from fg_calib.prediction.expected_error import PoseRms, errors_at, without_rigid_motion
from fg_calib.robot.kinematics import forward
from fg_calib.statistics.covariance import TangentCovariance, covariance_of_rows

Floats = NDArray[np.float64]

N_TASK = 500
"""Configurations of a task that nobody stated, drawn within the joint limits."""


@dataclass(frozen=True)
class Task(FrozenArrays):
    """What a calibration is for.

    Attributes:
        readings: Configurations at which the tool is to be right, shape (n, n_joints), [rad] (prismatic: [m]).
        fitted: Whether after the best rigid fit, instead of in the base frame.
        lever: Length with which orientations count, [m]; 0 where positions alone do.
    """

    readings: Floats
    fitted: bool
    lever: float = 0.0

    def form(self, problem: Problem) -> Floats:
        """W, in the columns of a problem's core, shape (n_columns, n_columns), [m^2]."""
        v = problem.variables
        at = forward(v.chains[0].at(problem.start), problem.robot.trig(self.readings))
        turn, shift = at.jacobian[:, :3].copy(), at.jacobian[:, 3:].copy()
        for derivative in (turn, shift):
            derivative[:, :, v.n_robot_columns :] = 0.0
        if self.fitted:
            shift, rotation = without_rigid_motion(at.position, shift)
            turn = turn - rotation
        flat = np.vstack([shift.reshape(-1, shift.shape[2]), self.lever * turn.reshape(-1, turn.shape[2])])
        out: Floats = flat.T @ flat / len(self.readings)
        return out


@dataclass(frozen=True)
class Posterior(Brief):
    """What would be known after some rows were measured.

    Attributes:
        problem: Their problem, at its start.
        rows: Whitened derivatives in all its columns, those of what is known beside them too, shape (m, n).
        n_before: How many measurements what is known beside them is of.
    """

    problem: Problem
    rows: Floats
    n_before: int = 0

    @cached_property
    def covariance(self) -> TangentCovariance:
        """Of the core."""
        v = self.problem.variables
        left = eliminate(self.rows, np.zeros(len(self.rows)), v.n_columns)
        return covariance_of_rows(v, self.problem.start, left.A)

    def error(self, task: Task) -> PoseRms:
        """Expected errors of the tool over a task."""
        base, fitted = errors_at(self.covariance, task.readings)
        return fitted if task.fitted else base

    @cached_property
    def observability(self) -> Observability:
        """What the rows, without tolerances, determine of the arm."""
        p, v = self.problem, self.problem.variables
        left = eliminate(self.rows, np.zeros(len(self.rows)), v.n_robot_columns)
        return observability_of_rows(
            left.A @ v.tangent_derivative(p.start)[: v.n_robot_columns, : v.n_robot_columns],
            p.estimated,
            scales=np.array([p.robot.scale_of(one.unit) for one in p.estimated]),
            n_measurements=self.n_before + n_measured(p),
        )


def n_measured(problem: Problem) -> int:
    """How many measurements a problem's rows are of."""
    return sum(len(s.train) for s in problem.data.series)


def is_fitted(problem: Problem) -> bool:
    """Whether nothing that is measured says where the base is, so that errors count after the best rigid fit alone."""
    return Seen.by(problem.data.tables).blind_to_base
