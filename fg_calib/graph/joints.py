"""Encoder noise as variables: the true joint values Q(k) of each configuration, with its reading as their prior.

Rows depend on the true joint values in place of the readings, and have no joint noise; each reading is one more row,
`(Q(k) - reading) / sigma`. Only joints that have noise are in a Q(k).

This is the estimate of `encoder: estimated` written out; it costs a dense system of all joint values. Beyond
`MAX_JOINT_VARIABLES` configurations the same optimum is found with the joint values eliminated: rows are linearised
about the true joint values that they imply themselves, in rounds, until these stay (see `solver`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.factors import Term, Variables
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.residuals import AnyBlock, Block, CorrelatedBlock, PoseBlock
from fg_calib.robot.kinematics import precompute_trig
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MAX_JOINT_VARIABLES = 100
"""Configurations beyond which joint values are eliminated instead of being variables of the graph."""


@dataclass(frozen=True)
class MovedRows:
    """Rows of measurements at true joint values.

    Attributes:
        block: The rows, whitened without joint noise; its `trig` is replaced.
        robot: The robot.
        readings: Readings behind the rows of `trig`, shape (n, n_joints).
        joints: Joints that have noise, shape (n_noisy,).
        configurations: Rows of `readings` that have true joint values, shape (m,).
        nuisance: Their variables' indices among the nuisance variables, in the same order.
    """

    block: AnyBlock
    robot: Robot
    readings: Floats
    joints: Integers
    configurations: Integers
    nuisance: tuple[int, ...]

    on_core = True

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.block.n * self.block.height

    def residual(self, variables: Variables, parameters: Floats) -> Floats:
        """Whitened residuals, shape (n_rows,)."""
        chain = variables.chain.at(parameters).without_columns()
        return residuals.residual(self._moved(variables, parameters), chain).ravel()

    def linearise(self, variables: Variables, parameters: Floats) -> tuple[Floats, Floats]:
        """The same with derivatives in the core's columns, then in the true joint values."""
        block, chain = self._moved(variables, parameters), variables.chain.at(parameters)
        parts = block.parts if isinstance(block, CorrelatedBlock) else (block,)
        rows = np.vstack([self._rows(part, chain.n_columns, residuals.linearise(part, chain.with_joint_columns()))
                          for part in parts])  # fmt: skip
        if isinstance(block, CorrelatedBlock):
            rows = block.whiten(rows)
        return rows[:, -1], rows[:, :-1]

    def _moved(self, variables: Variables, parameters: Floats) -> AnyBlock:
        """The block at the true joint values."""
        q = self.readings.copy()
        values = [parameters[list(variables.nuisance[i].parameters)] for i in self.nuisance]
        q[np.ix_(self.configurations, self.joints)] = values
        trig = precompute_trig(self.robot, q)
        if isinstance(self.block, CorrelatedBlock):
            return replace(self.block, parts=tuple(replace(part, trig=trig) for part in self.block.parts))  # type: ignore[type-var]
        return replace(self.block, trig=trig)  # type: ignore[type-var]

    def _rows(self, part: Block, n_columns: int, linearised: tuple[Floats, Floats]) -> Floats:
        """[J r] of a part with each end's joint columns at its configuration's place, shape (n_rows, ...)."""
        r, J = linearised  # (n, height), (n, height, n_columns + ends * n_joints)
        n_joints, n_noisy = self.readings.shape[1], len(self.joints)
        out = np.zeros((*r.shape, n_columns + len(self.configurations) * n_noisy + 1))
        out[:, :, :n_columns], out[:, :, -1] = J[:, :, :n_columns], r
        ends = (part.rows,) if isinstance(part, PoseBlock) else (part.a, part.b)  # type: ignore[attr-defined]
        for i, end in enumerate(ends):
            place = np.searchsorted(self.configurations, end)
            columns = n_columns + place[:, None] * n_noisy + np.arange(n_noisy)  # (n, n_noisy)
            of_end = J[:, :, n_columns + i * n_joints + self.joints]
            np.put_along_axis(out, np.broadcast_to(columns[:, None], of_end.shape), of_end, axis=2)
        return out.reshape(r.size, -1)


@dataclass(frozen=True)
class ReadingPrior:
    """A configuration's reading as the prior of its true joint values.

    Attributes:
        variable: Index of Q(k) among the nuisance variables.
        reading: Shape (n_noisy,), [rad] (prismatic: [m]).
        sigma: Shape (n_noisy,), [rad] (prismatic: [m]).
    """

    variable: int
    reading: Floats
    sigma: Floats

    on_core = False

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.reading)

    @property
    def nuisance(self) -> tuple[int, ...]:
        """The true joint values."""
        return (self.variable,)

    def residual(self, variables: Variables, parameters: Floats) -> Floats:
        """Whitened residuals, shape (n_rows,)."""
        return (parameters[list(variables.nuisance[self.variable].parameters)] - self.reading) / self.sigma

    def linearise(self, variables: Variables, parameters: Floats) -> tuple[Floats, Floats]:
        """The same with derivatives in the true joint values, shape (n_rows, n_rows)."""
        return self.residual(variables, parameters), np.diag(1.0 / self.sigma)


class TrueJoints:
    """The true joint values of the configurations that train rows come from, as variables.

    Args:
        robot: The robot.
        measurements: What was measured.
        configurations: Rows of the configurations, in order, shape (m,).
    """

    def __init__(self, robot: Robot, measurements: Measurements, configurations: Integers) -> None:
        self._robot = robot
        self._measurements = measurements
        self.configurations = configurations
        self.joints = np.flatnonzero(measurements.sigma_joint > 0.0)

    def add_joints(self, variables: Variables) -> Variables:
        """The variables with a Q(k) for each configuration k."""
        scales = tuple(self._measurements.sigma_joint[self.joints].tolist())
        return variables.with_nuisance("joints", "Q", self.configurations.tolist(), scales)

    def start(self) -> Floats:
        """Initial nuisance values: the readings, flat."""
        return self._measurements.readings[np.ix_(self.configurations, self.joints)].ravel()

    def values(self, variables: Variables, parameters: Floats) -> Floats:
        """Joint values at a parameter vector, readings where none are estimated: (n_configurations, n_joints)."""
        q = self._measurements.readings.copy()
        found = [parameters[list(v.parameters)] for v in variables.nuisance if v.kind == "joints"]
        q[np.ix_(self.configurations, self.joints)] = found
        return q

    def terms(self, blocks: list[AnyBlock], variables: Variables) -> tuple[Term, ...]:
        """The readings, a term each, and the rows: a term a pose, or one for all pairs.

        Args:
            blocks: The train rows, whitened without joint noise.
            variables: The variables, with `add_joints`.
        """
        m = self._measurements
        index = [i for i, v in enumerate(variables.nuisance) if v.kind == "joints"]
        sigma = m.sigma_joint[self.joints]
        terms: list[Term] = [
            ReadingPrior(i, m.readings[k, self.joints], sigma) for i, k in zip(index, self.configurations, strict=True)
        ]
        for block in blocks:
            if isinstance(block, PoseBlock):
                terms += [self._pose(block, i, n, k) for n, (i, k) in enumerate(zip(index, block.rows, strict=True))]
            else:
                terms.append(MovedRows(block, self._robot, m.readings, self.joints, self.configurations, tuple(index)))
        return tuple(terms)

    def _pose(self, block: PoseBlock, variable: int, n: int, k: int) -> MovedRows:
        """The n-th pose of a block, at configuration k."""
        readings = self._measurements.readings[k : k + 1]
        first = np.zeros(1, dtype=np.int64)
        one = replace(residuals.rows_of(block, slice(n, n + 1)), trig=block.trig[k : k + 1], rows=first)  # type: ignore[type-var]
        return MovedRows(one, self._robot, readings, self.joints, first, (variable,))
