"""Residuals of the nominal arm, compared with what noise and prior sigmas let them be.

The nominal arm, its unknown frames, tool and landmarks fitted to the rows, misses what was measured by

    r = J e + n,    its length on average by the root of tr(J T^2 J^T + N)

with J the derivatives in the arm's estimated parameters, T their prior sigmas (`USUAL` where there are none) and N the
covariance of the noise. The *excess* is the median length over the median expected: medians are not moved by a few
gross errors. What is fitted takes up a part of the arm's errors, so healthy tables have an excess of a fifth to one.
"""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.graph import Problem, build_variables, noises_at, problem_of_tables, tables_of, take_steps
from fg_calib.inputs import Floats, InputError, Options, Pairing, ProblemError, Record, SolverError
from fg_calib.measurements import INSTRUMENTS, Instrument, Table, residuals
from fg_calib.robot import EFFECT_KINDS, Robot

USUAL = {"m": 2e-3, "rad": 5e-3}
"""1 sigma of true minus nominal where a parameter has no prior: 2 mm and 5 mrad (0.3 degrees)."""

MAX_ROWS, MAX_IMAGES, MAX_CORNERS = 100, 20, 8
"""Train configurations that are looked at, drawn from the table; images, and corners of each."""

MAX_STEPS = 6
"""Steps from the start in closed form that suffice where the set-up is right."""


class TypicalResidual(Record):
    """Residuals of one kind of measurement before a calibration.

    Attributes:
        kind: `position`, `orientation`, `distance`, `angle`, `point` or `pixel`.
        unit: `m`, `rad` or `px`.
        size: Median of their lengths, [m], [rad] or [px].
        expected: Median expected from noise and prior sigmas.
        n: Number of measurements.
    """

    kind: str
    unit: Literal["m", "rad", "px"]
    size: float
    expected: float
    n: int

    @property
    def excess(self) -> float:
        """Size over expected size."""
        return self.size / self.expected


class Setup(Record):
    """Some rows of a table, and what the job says of them.

    Attributes:
        robot: The nominal robot; the parameters of its tool that are estimated are fitted.
        table: The rows; pairs among them.
    """

    robot: Robot
    table: Table

    @property
    def instrument(self) -> Instrument:
        """The instrument of the table."""
        return INSTRUMENTS[str(self.table.model)]

    @property
    def tool(self) -> tuple[str, ...]:
        """Names of the tool's parameters, in the order x, y, z, yaw, pitch, roll."""
        return tuple(self.robot.parameters[i].name for i in self.robot.owned_by(self.robot.n_joints + 1))

    @property
    def has_landmarks(self) -> bool:
        """Whether landmarks have to be located before anything can be said of the table."""
        return not (self.instrument.is_pose or self.instrument.uses_pairs) or "target" in self.table.measurements.labels

    @property
    def sees_lengths(self) -> bool:
        """Whether lengths are measured."""
        return self.instrument.sees_position and self.table.measurements.image is None

    def with_tool(self, fitted: frozenset[str]) -> "Setup":
        """The set-up with these of the tool's parameters fitted."""
        names = [p.name for p in self.robot.parameters if p.estimated and p.name not in self.tool]
        return replace(self, robot=self.robot.with_estimated([*names, *sorted(fitted)]))

    def measuring(self, **changes: Any) -> "Setup":
        """The set-up with other measurements."""
        return replace(self, table=replace(self.table, measurements=replace(self.table.measurements, **changes)))


def setup_of(robot: Robot, table: Table) -> Setup | None:
    """Some train rows of a table as the job says they are; None if the table has no train rows.

    Pairs are formed anew from some of the rows, whatever the job's pairing. Rows are drawn at random, for rows in turn
    may be of one target or anchor.
    """
    m, rng = table.measurements, np.random.default_rng(0)
    rows, pairs = np.flatnonzero(~m.test), m.pairs if table.uses_pairs else None
    if table.model is None or not len(rows):
        return None
    if pairs is not None:
        train = np.flatnonzero(~pairs.test)
        pairs = pairs.select(train[evenly(len(train), 3 * MAX_ROWS)])
        rows = np.unique(np.concatenate([rows[:MAX_ROWS] if m.groups is not None else rows[:0], pairs.a, pairs.b]))
        pairs = replace(pairs, a=np.searchsorted(rows, pairs.a), b=np.searchsorted(rows, pairs.b))
    elif m.image is not None:
        images = rng.permutation(np.unique(m.ids[rows]))[:MAX_IMAGES]
        rows = np.concatenate([rows[m.ids[rows] == image][:MAX_CORNERS] for image in images])
    else:
        rows = np.sort(rng.permutation(rows)[:MAX_ROWS])
    some = replace(m.select(rows), pairs=pairs, groups=m.groups and replace(m.groups, index=m.groups.index[rows]))
    some_rows = replace(table, measurements=some, pairing=Pairing("chain"), own=())
    base = {robot.parameters[i].name for i in robot.owned_by(0) if robot.parameters[i].estimated}
    if base and INSTRUMENTS[table.model].is_pose and table.frame == "known":  # the base is fitted as a frame
        robot = robot.with_estimated([p.name for p in robot.parameters if p.estimated and p.name not in base])
        some_rows = replace(some_rows, frame="unknown")
    idle = not any(p.nominal for p in robot.parameters if p.kind in EFFECT_KINDS)
    return Setup(robot.geometry if idle else robot.with_curves_held(robot.nominal), some_rows)


def evenly(n: int, most: int) -> NDArray[np.int64]:
    """Indices of at most so many of n numbers, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(most, n)).astype(np.int64))


def nominal_residuals(setup: Setup) -> tuple[TypicalResidual, ...]:
    """Residuals of a set-up by kind, frame, tool and landmarks fitted; empty if there are too few rows, or no fit."""
    options = Options(gauge="none")
    try:
        tables = [t.tested_on(np.ones_like(t.measurements.test)).by_itself() for t in tables_of(setup.table, options)]
        problem = problem_of_tables(setup.robot, tables, options)  # of test rows alone: the arm stays at nominal
        located = setup.instrument.is_pose and not setup.has_landmarks  # in closed form
        parameters = problem.start if located else take_steps(problem, MAX_STEPS)
    except (InputError, ProblemError, SolverError, RuntimeError, np.linalg.LinAlgError):
        return ()
    n_free = problem.variables.n_columns + problem.variables.n_nuisance
    enough = problem.n_residuals >= 2 * n_free + 6 + setup.has_landmarks * n_free
    return residuals_at(problem, parameters, setup.robot) if enough else ()


def residuals_at(
    problem: Problem, parameters: Floats, robot: Robot, table: int | None = None
) -> tuple[TypicalResidual, ...]:
    """Residuals by kind at a parameter vector; rows of landmarks alone, which have none of the arm's errors, left out.

    Args:
        problem: The problem; at most `3 * MAX_ROWS` rows of a block are looked at.
        parameters: The parameter vector.
        robot: The robot with what is estimated of the arm, whose prior sigmas are usual ones where it has none.
        table: Number of the table that is asked for; all if None.
    """
    blocks = [s for s in problem.data.blocks if table in (None, s.table) and len(s.train) and s.kind.ends]
    some = tuple(s.select(s.train[evenly(len(s.train), 3 * MAX_ROWS)]) for s in blocks)
    variables = build_variables(robot, [t.unknown_frame for t in problem.data.tables])
    arm = {p.name: p for p in robot.parameters if 1 <= p.owner <= robot.n_joints}
    usual = {p.name: p.tolerance or USUAL.get(p.unit, p.scale) for p in arm.values()}
    scale = np.array([usual.get(name, 0.0) for name in variables.names])
    values = np.concatenate([parameters[problem.variables.robot_span], parameters[problem.variables.frame_span]])
    found: list[TypicalResidual] = []
    for noise in noises_at(replace(problem, data=replace(problem.data, blocks=some)), parameters):
        chain = variables.chains[noise.block.table].at(values)
        J = residuals.linearise(noise.rows_at(slice(None)), chain)[1][:, :, : len(scale)] * scale
        squares, variance = noise.residual() ** 2, np.sum(J**2, axis=2) + noise.sigma**2
        kinds, used = np.array([name.partition(".")[0] for name in noise.block.kind.names]), noise.block.used
        for kind in dict.fromkeys(kinds.tolist()):
            of, unit = used & (kinds == kind), noise.block.kind.units[kinds.tolist().index(kind)]
            rows = of.any(axis=1)
            if rows.any():
                lengths = [np.sqrt(np.sum(v, axis=1, where=of)[rows]) for v in (squares, variance)]
                size, expected = (float(np.median(each)) for each in lengths)
                found.append(TypicalResidual(kind, unit, size, max(expected, 1e-9), int(rows.sum())))
    return tuple(found) if all(np.isfinite([r.size, r.expected]).all() for r in found) else ()
