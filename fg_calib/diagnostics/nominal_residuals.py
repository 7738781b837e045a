"""Residuals of the nominal arm, compared with what noise and prior sigmas let them be.

The nominal arm, its unknown frames, tool and landmarks fitted to the rows, misses what was measured by

    r = J e + n,    its length on average by the root of tr(J T^2 J^T + N)

with J the derivatives in the arm's estimated parameters, T their prior sigmas (`USUAL_LENGTH` and `USUAL_ANGLE` where
there are none) and N the covariance of the noise. The *excess* is the median length over the median expected: medians
are not moved by a few gross errors. What is fitted takes up a part of the arm's errors, so healthy tables have an
excess of a fifth to one.

Measurements *disagree* with the nominal arm where their distance is far above the median of all,

    d^2 = r^T (J T^2 J^T + N)^-1 r over the number of rows

for all rows have the arm's errors in common, which may be larger or smaller than the prior sigmas. Frames, base, tool
and landmarks are fitted to all rows, train and test, with Cauchy's weights. Pairs formed from poses are screened as
these poses in an unknown frame, for one wrong pose spoils many pairs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.graph import (
    Problem,
    RowNoise,
    build_variables,
    noises_at,
    problem_of_tables,
    relinearized_at,
    tables_of,
    take_steps,
    whitening_of,
)
from fg_calib.inputs import Floats, InputError, Options, Pairing, ProblemError, SolverError
from fg_calib.measurements import INSTRUMENTS, Instrument, Table, residuals
from fg_calib.parallel import one_blas_thread
from fg_calib.robot import Robot
from fg_calib.statistics import MAX_OUTLIER_SHARE

USUAL_LENGTH, USUAL_ANGLE = 2e-3, 5e-3
"""1 sigma of true minus nominal where a parameter has no prior: 2 mm and 5 mrad (0.3 degrees)."""

MAX_ROWS, MAX_IMAGES, MAX_CORNERS = 60, 20, 8
"""Train configurations that are looked at, drawn from the table; images, and corners of each."""

MAX_STEPS = 6
"""Steps from the start in closed form that suffice where the set-up is right."""

_UNITS: dict[str, Literal["m", "rad", "px"]] = {"orientation": "rad", "angle": "rad", "pixel": "px"}


@dataclass(frozen=True)
class TypicalResidual:
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


@dataclass(frozen=True)
class Setup:
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
    def fitted_tool(self) -> frozenset[str]:
        """Names of those of the tool's parameters that are fitted."""
        return frozenset(p.name for p in self.robot.parameters if p.estimated) & frozenset(self.tool)

    @property
    def has_landmarks(self) -> bool:
        """Whether landmarks have to be located before anything can be said of the table."""
        without = self.instrument.is_pose or self.instrument.uses_pairs
        return not without or "target" in self.table.measurements.labels

    @property
    def sees_lengths(self) -> bool:
        """Whether lengths are measured."""
        return self.instrument.sees_position and self.table.measurements.image is None

    def with_tool(self, fitted: frozenset[str]) -> Setup:
        """The set-up with these of the tool's parameters fitted."""
        names = [p.name for p in self.robot.parameters if p.estimated and p.name not in self.tool]
        return replace(self, robot=self.robot.with_estimated([*names, *sorted(fitted)]))

    def with_values(self, values: Floats) -> Setup:
        """The set-up with other nominal values of the robot."""
        return replace(self, robot=self.robot.with_values(values))

    def measuring(self, **changes: Any) -> Setup:
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
        touched = rows[:MAX_ROWS] if m.groups is not None else rows[:0]
        rows = np.unique(np.concatenate([touched, pairs.a, pairs.b]))
        pairs = replace(pairs, a=np.searchsorted(rows, pairs.a), b=np.searchsorted(rows, pairs.b))
    elif m.image is not None:
        images = rng.permutation(np.unique(m.ids[rows]))[:MAX_IMAGES]
        rows = np.concatenate([rows[m.ids[rows] == image][:MAX_CORNERS] for image in images])
    else:
        rows = np.sort(rng.permutation(rows)[:MAX_ROWS])
    groups = m.groups and replace(m.groups, index=m.groups.index[rows])
    some = replace(m.select(rows), pairs=pairs, groups=groups)
    some_rows = replace(table, measurements=some, pairing=Pairing("chain"), own=())
    base = {robot.parameters[i].name for i in robot.owned_by(0) if robot.parameters[i].estimated}
    if base and INSTRUMENTS[table.model].is_pose and table.frame == "known":  # the base is fitted as a frame
        robot = robot.with_estimated([p.name for p in robot.parameters if p.estimated and p.name not in base])
        some_rows = replace(some_rows, frame="unknown")
    return Setup(robot, some_rows)


def evenly(n: int, most: int) -> NDArray[np.int64]:
    """At most so many of n numbers, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(most, n)).astype(np.int64))


def nominal_residuals(setup: Setup) -> tuple[TypicalResidual, ...]:
    """Residuals of a set-up by kind, frame, tool and landmarks fitted; empty if there are too few rows, or no fit."""
    options = Options(gauge="none")
    try:
        problem = nominal_problem(setup.robot, tables_of(setup.table, options), options)
        located = setup.instrument.is_pose and not setup.has_landmarks  # in closed form
        parameters = problem.start if located else fit_landmarks(problem)
    except (InputError, ProblemError, SolverError, RuntimeError, np.linalg.LinAlgError):
        return ()
    n_free = problem.variables.n_columns + problem.variables.n_nuisance
    enough = problem.n_residuals >= 2 * n_free + 6 + setup.has_landmarks * n_free
    return residuals_at(problem, parameters, setup.robot) if enough else ()


def nominal_problem(robot: Robot, tables: Sequence[Table], options: Options) -> Problem:
    """The problem of frames, base, tool and landmarks with the arm at nominal: every row is a test row."""
    tests = [t.tested_on(np.ones(t.measurements.n_configurations, dtype=np.bool_)).by_itself() for t in tables]
    return problem_of_tables(robot, tests, options)


def fit_landmarks(problem: Problem) -> Floats:
    """The parameter vector with frames, tool and landmarks fitted to the rows, whitened as at the start.

    Args:
        problem: A problem of the arm as it is (see `Problem.evaluated`).
    """
    return take_steps(problem, MAX_STEPS)


def residuals_at(
    problem: Problem, parameters: Floats, robot: Robot, table: int | None = None
) -> tuple[TypicalResidual, ...]:
    """Residuals by kind at a parameter vector; rows of landmarks alone, which have none of the arm's errors, left out.

    Args:
        problem: The problem; at most `3 * MAX_ROWS` rows of a series are looked at.
        parameters: The parameter vector.
        robot: The robot with what is estimated of the arm.
        table: Number of the table that is asked for; all if None.
    """
    series = [s for s in problem.data.blocks if table in (None, s.table) and len(s.train) and s.kind.ends]
    some = tuple(s.select(s.train[evenly(len(s.train), 3 * MAX_ROWS)]) for s in series)
    sampled = replace(problem, data=replace(problem.data, blocks=some))
    found: list[TypicalResidual] = []
    for noise, of_arm in with_arm_errors(sampled, parameters, robot):
        variance = np.einsum("nii->ni", of_arm) + noise.sigma**2
        found += _by_kind(noise, noise.residual() ** 2, variance)
    return tuple(found) if all(np.isfinite([r.size, r.expected]).all() for r in found) else ()


def with_arm_errors(problem: Problem, parameters: Floats, robot: Robot) -> Iterator[tuple[RowNoise, Floats]]:
    """The rows of each series, and their covariance by the arm's errors, shape (n, residual_dim, residual_dim).

    Args:
        problem: The problem.
        parameters: The parameter vector.
        robot: The robot with what is estimated of the arm, whose prior sigmas are usual ones where it has none.
    """
    variables, scale = build_variables(robot, [t.unknown_frame for t in problem.data.tables]), list[float]()
    by_name = {p.name: p for p in robot.parameters if 1 <= p.owner <= robot.n_joints}
    for name in variables.names:
        p = by_name.get(name)
        usual = 0.0 if p is None else USUAL_LENGTH if p.unit == "m" else USUAL_ANGLE
        scale.append(usual if p is None or p.tolerance is None else p.tolerance)
    values = np.concatenate([parameters[problem.variables.robot_span], parameters[problem.variables.frame_span]])
    for noise in noises_at(problem, parameters):
        chain = variables.chains[noise.series.table].at(values)
        J = residuals.linearise(noise.rows_at(slice(None)), chain)[1][:, :, : len(scale)] * scale
        yield noise, J @ np.swapaxes(J, 1, 2)


def _by_kind(noise: RowNoise, squares: Floats, variance: Floats) -> Iterator[TypicalResidual]:
    """Residuals of one series, by kind of noise.

    Args:
        noise: Its rows and their noise.
        squares: Squared residual of each row, shape (n, residual_dim).
        variance: Variance of each row by noise and the arm's errors, shape (n, residual_dim).
    """
    kinds, used = np.array([name.partition(".")[0] for name in noise.series.kind.names]), noise.series.used
    for kind in dict.fromkeys(kinds.tolist()):
        of = used & (kinds == kind)
        rows = of.any(axis=1)
        if rows.any():
            size, expected = (float(np.median(np.sqrt(np.sum(v, axis=1, where=of)[rows]))) for v in (squares, variance))
            yield TypicalResidual(kind, _UNITS.get(kind, "m"), size, max(expected, 1e-9), int(rows.sum()))


# --- measurements that disagree ---------------------------------------------------------------------------------------

MAX_SCREENED = 5000
"""Rows of a table up to which all are screened; of more, so many that are evenly spaced."""

DISAGREES = 5.0
"""Distance from which a measurement disagrees, over the median one or the expected one, whichever is larger."""

ROUNDS, HALF_WEIGHT = 4, 2.4
"""Fits with weights by the distances before, and the distance over the typical one of a weight of one half."""


@dataclass(frozen=True)
class Disagreement:
    """A measurement that disagrees with the nominal arm.

    Attributes:
        table: Name of its table; empty of one alone.
        ends: Names of the configurations, or of what else it is between.
        of: Its target, anchor or corner; empty where the table names none.
        row: Row of the table, counted from 0; -1 of a pair.
        kind: Kind of noise that is farthest off: `position`, `orientation`, `distance`, ...
        unit: `m`, `rad` or `px`.
        size: Length of the residual of that kind.
        expected: 1 sigma of it by noise and prior sigmas.
        ratio: Its distance over the typical one; `DISAGREES` and more.
        test: Whether it is a test row.
    """

    table: str
    ends: tuple[str, ...]
    of: str
    row: int
    kind: str
    unit: str
    size: float
    expected: float
    ratio: float
    test: bool


@dataclass(frozen=True)
class Disagreements:
    """Measurements that disagree with the nominal arm, the farthest first.

    Attributes:
        found: The measurements; empty where there are none, or more than a few.
        n: Number of measurements screened.
        of: Number of measurements.
    """

    found: tuple[Disagreement, ...] = ()
    n: int = 0
    of: int = 0


def find_disagreements(robot: Robot, tables: Sequence[Table], labels: Sequence[str]) -> Disagreements:
    """The measurements that disagree with the nominal arm.

    Args:
        robot: The nominal robot.
        tables: What was measured.
        labels: Names of the tables.
    """
    chosen, found, n, of = [_sampled(table) for table in tables], list[Disagreement](), 0, 0.0
    with one_blas_thread:
        try:
            problem = nominal_problem(robot, chosen, Options(gauge="none"))
            rows = _distances(problem, problem.start, robot)
            for _ in range(ROUNDS if problem.variables.keys else 0):
                weights = tuple(share / (1.0 + (d / HALF_WEIGHT) ** 2) for *_, d, share in rows)
                problem = relinearized_at(problem, problem.start, replace(problem.state, weights=weights))
                problem = relinearized_at(problem, fit_landmarks(problem))
                rows = _distances(problem, problem.start, robot)
        except (InputError, ProblemError, SolverError, RuntimeError, np.linalg.LinAlgError):
            return Disagreements()
    for noise, covariance, d, _ in rows:
        k = noise.series.table
        whole, test = tables[k].measurements.n_configurations, chosen[k].measurements.test
        n, of = n + int(np.sum(d > 0.0)), of + whole / len(test) * float(np.sum(d > 0.0))
        for i in np.flatnonzero(d > DISAGREES).tolist():
            found.append(_disagreement(problem, noise, i, covariance[i], (labels[k], float(d[i]), test)))
    found = sorted(found, key=lambda one: -one.ratio) if len(found) <= MAX_OUTLIER_SHARE * n else []
    return Disagreements(tuple(found), n, round(of))


def _sampled(table: Table) -> Table:
    """At most `MAX_SCREENED` rows of a table; pairs that would be formed from poses as these poses."""
    m = table.measurements
    m = m if m.part is not None else replace(m, part=np.arange(m.n_configurations))
    if table.uses_pairs and m.pairs is not None:
        return replace(table, measurements=replace(m, pairs=m.pairs.select(evenly(m.pairs.n_pairs, MAX_SCREENED))))
    if m.groups is not None or table.own:
        return replace(table, measurements=m)
    m = m.select(evenly(m.n_configurations, MAX_SCREENED))
    if not table.uses_pairs:
        return replace(table, measurements=m)
    model = ("orientation", "position", "pose")[2 * (m.position is not None) + (m.rotation is not None) - 1]
    return replace(table, measurements=replace(m, labels={}), model=model, frame="unknown")


_Rows = list[tuple[RowNoise, Floats, Floats, Floats]]


def _distances(problem: Problem, parameters: Floats, robot: Robot) -> _Rows:
    """The rows of each series, with covariance, distance over the typical one, and part of the noise in it."""
    found: _Rows = []
    for noise, of_arm in with_arm_errors(problem, parameters, robot):
        of_noise, used = noise.total_at(slice(None)), noise.series.used
        total = of_noise + of_arm
        n_rows = used.sum(axis=1)
        r = np.where(used, noise.residual(), 0.0)
        z = np.linalg.norm(whitening_of(total, used) @ r[:, :, None], axis=(1, 2))
        expected = np.sqrt(special.chdtri(np.maximum(n_rows, 1), 0.5))
        typical = max(1.0, float(np.median((z / expected)[n_rows > 0]))) if n_rows.any() else 1.0
        share = np.einsum("nii->n", of_noise) / np.einsum("nii->n", total)
        found.append((noise, total, z / np.sqrt(np.maximum(n_rows, 1)) / typical, share))
    return found


def _disagreement(
    problem: Problem, noise: RowNoise, k: int, covariance: Floats, found: tuple[str, float, NDArray[np.bool_]]
) -> Disagreement:
    """A measurement of a series that disagrees.

    Args:
        problem: The problem of all rows.
        noise: The series' rows.
        k: Number of the measurement.
        covariance: Of its rows by noise and prior sigmas.
        found: Name of its table, its distance, and which configurations are test rows.
    """
    s, data, (label, d, test) = noise.series, problem.data, found
    kinds = np.array([name.partition(".")[0] for name in s.kind.names])
    units = dict(zip(kinds.tolist(), s.kind.units, strict=True))
    r = np.where(s.used[k], noise.residual()[k], 0.0)
    sizes = {kind: float(np.linalg.norm(r[kinds == kind])) for kind in units}
    expected = {kind: float(np.sqrt(np.diag(covariance)[kinds == kind].sum())) for kind in units}
    kind = max(units, key=lambda kind: sizes[kind] / expected[kind])
    part = data.tables[s.table].measurements.part
    row = int(part[s.ends[k, 0]]) if part is not None and s.kind.ends == 1 else -1
    landmarks = data.n_configurations + np.unique(data.landmarks.owners[s.nuisances[k]])
    ends = tuple(data.names[i] for i in (data.places[s.table][s.ends[k]] if s.kind.ends else landmarks).tolist())
    of = s.of.names[s.of.index[k]] if s.of is not None and s.of.index[k] >= 0 else ""
    values = sizes[kind], expected[kind], d, bool(test[s.ends[k]].any())
    return Disagreement(label, ends, of, row, kind, units[kind], *values)
