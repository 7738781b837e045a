"""Measurements that disagree with the nominal arm far more than the others do: gross errors, told early.

The arm stays nominal. Measurement frame, base, tool and what else is unknown are fitted to all rows, train and test,
from their start in closed form, each measurement with a weight (Cauchy's) that falls with its distance

    d^2 = r^T (J T^2 J^T + N)^-1 r

with r its residual, J the derivatives in the arm's estimated parameters, T their tolerances (or usual errors, see
`typical_residuals`) and N the covariance of its noise. All rows have the arm's errors in common, which may be larger
than the tolerances say, or far smaller: so it is the distances over their median that count. Far is what is so beside
noise and tolerances too, or what is farther than any arm's errors spread distances that are all small. Pairs formed
from poses are looked at as these poses in an unknown frame, for one wrong pose spoils many pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.diagnostics.nominal_residuals import fit_landmarks, prior_sigmas_of
from fg_calib.errors import InputError, ProblemError, SolverError
from fg_calib.graph.build import problem_of_tables
from fg_calib.graph.noise_models import RowNoise, whitening_of
from fg_calib.graph.problem import Problem, noises_at, relinearized_at
from fg_calib.graph.variables import build_variables
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Booleans, Measurements
from fg_calib.measurements.kinds import INSTRUMENTS
from fg_calib.measurements.table import Table
from fg_calib.options import Model, Options
from fg_calib.robot.kinematics import Chain
from fg_calib.robot.model import Robot
from fg_calib.statistics.residual_table import CHANCE, MAX_OUTLIER_SHARE
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_ROWS = 5000
"""Rows of a table up to which all are looked at; of more, so many that are evenly spaced."""

FAR = 5.0
"""Distance over the typical one from which a measurement is far; chance does not reach it."""

OUT_OF_LINE = 10.0
"""The same where the typical one is smaller than tolerances allow: an arm's errors are not alike in all rows."""

LEAST_SIZE = 1e-2
"""Typical distance that is taken for this at least: rounding alone says nothing."""

LEAST_MANY = 20
"""Measurements from which their median says what is typical of them although tolerances allow more."""

_ROUNDS = 5
"""Times that what is unknown is fitted with weights from the fit before."""

_CAUCHY = 2.4
"""Distance, over the typical one, at which a measurement keeps half its weight."""


@dataclass(frozen=True)
class Disagreement:
    """A measurement that disagrees with the nominal arm.

    Attributes:
        table: Name of its table; empty of one alone.
        ends: Names of the configurations, or of what else it is between.
        of: Its target, anchor or corner; empty where nothing says.
        row: Row of the table, counted from 0; -1 where it is of a pair.
        kind: `position`, `orientation`, `distance`, ...: what of it is farthest off.
        unit: `m`, `rad` or `px`.
        size: Length of the residual of that kind.
        expected: What noise and tolerances make of it.
        ratio: Its distance over the typical one; `FAR` and more.
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
        found: They; empty where there are none, or not few.
        n: Number of measurements looked at.
        of: Number that there are.
    """

    found: tuple[Disagreement, ...]
    n: int
    of: int


@dataclass(frozen=True)
class RoughFit:
    """The nominal arm, with measurement frames, base, tool and other unknowns fitted to what most rows say.

    Attributes:
        robot: The nominal robot.
        problem: The problem that was fitted: some rows of each table, all of them as test rows.
        parameters: Its parameter vector.
        noises: The rows there.
        distances: Of each measurement of each series, per row and over the typical one, shape (n,) each; 0 where it
            takes no part.
        n_rows: Rows that each table has.
        tests: Which of the rows looked at are test rows, shape (n,) each.
    """

    robot: Robot
    problem: Problem
    parameters: Floats
    noises: tuple[RowNoise, ...]
    distances: tuple[Floats, ...]
    n_rows: tuple[int, ...]
    tests: tuple[Booleans, ...]

    def start(self, problem: Problem) -> Floats:
        """The start of a problem of the same tables with base, tool and measurement frames where they were fitted."""
        start, fitted = problem.start.copy(), self.problem.variables
        start[problem.variables.robot_span] = self.parameters[fitted.robot_span]
        frames = {v.symbol: self.parameters[v.places] for v in fitted.frames}
        for v in problem.variables.frames:
            start[v.places] = frames[v.symbol]
        return start


def fit_roughly(robot: Robot, tables: Sequence[Table]) -> RoughFit | None:
    """The nominal arm at the frames that most rows of some tables determine; None if they do not.

    Args:
        robot: The nominal robot.
        tables: What was measured.
    """
    chosen, n_rows, tests = zip(*map(_looked_at, tables), strict=True)
    with one_blas_thread:
        try:
            problem = problem_of_tables(robot, [table.by_itself() for table in chosen], Options(gauge="none"))
            fitted = _fitted(problem, robot)
        except (InputError, ProblemError, SolverError, RuntimeError, np.linalg.LinAlgError):
            return None
    return RoughFit(robot, problem, *fitted, n_rows=n_rows, tests=tests)


def find_disagreements(fit: RoughFit, labels: Sequence[str]) -> Disagreements:
    """The measurements that disagree with the nominal arm.

    Args:
        fit: What most rows say.
        labels: Names of the tables.
    """
    flagged: list[Disagreement] = []
    n = total = 0
    with one_blas_thread:
        chains = _arm(fit.problem, fit.robot, fit.parameters)
        for noise, d in zip(fit.noises, fit.distances, strict=True):
            s = noise.series
            share = fit.n_rows[s.table] / max(len(fit.tests[s.table]), 1)
            n, total = n + int(np.sum(d > 0.0)), total + round(share * float(np.sum(d > 0.0)))
            bad = np.flatnonzero(_are_far(d, s.used.sum(axis=1)))
            covariance = _covariance(noise, chains[s.table], fit.robot)
            flagged += _described(fit, noise, covariance, (d, bad), labels[s.table])
    if len(flagged) > MAX_OUTLIER_SHARE * max(n, 1):
        flagged = []
    return Disagreements(tuple(sorted(flagged, key=lambda one: -one.ratio)), n, total)


def _looked_at(table: Table) -> tuple[Table, int, Booleans]:
    """Some rows of a table, all as test rows, by which the arm is evaluated as it is; how many it has; which are."""
    m, n = table.measurements, table.measurements.n_configurations
    model, frame, pairs = table.model, table.frame, m.pairs
    if table.uses_pairs and pairs is None and m.groups is None:
        model, frame = _of_poses(m, table), "unknown"
        m = replace(m, labels={})
    own = tuple(replace(o, test=None if o.test is None else np.ones(len(o.data), np.bool_)) for o in table.own)
    if table.uses_pairs and pairs is not None and pairs.n_pairs > MOST_ROWS:
        m = replace(m, pairs=pairs.select(_evenly(pairs.n_pairs)))
    elif n > MOST_ROWS and not own and m.groups is None and not (table.uses_pairs and pairs is not None):
        rows = _evenly(n)
        m = replace(m if m.part is not None else replace(m, part=np.arange(n))).select(rows)
    test, m = m.test, replace(m, test=np.ones(m.n_configurations, np.bool_))
    if m.pairs is not None:
        m = replace(m, pairs=replace(m.pairs, test=np.ones(m.pairs.n_pairs, np.bool_)))
    if m.groups is not None:
        between = m.groups.pairs
        m = replace(m, groups=replace(m.groups, pairs=replace(between, test=np.ones(between.n_pairs, np.bool_))))
    return replace(table, measurements=m, model=model, frame=frame, own=own), n, test


def _of_poses(m: Measurements, table: Table) -> Model | None:
    """The model of poses that holds what pairs formed from them do."""
    assert table.model is not None
    instrument = INSTRUMENTS[table.model]
    placed_ = instrument.sees_position and m.position is not None
    turned = instrument.sees_orientation and m.rotation is not None
    return "pose" if placed_ and turned else "position" if placed_ else "orientation"


def _evenly(n: int) -> Integers:
    return np.unique(np.linspace(0, n - 1, MOST_ROWS).round().astype(np.int64))


def _arm(problem: Problem, robot: Robot, parameters: Floats) -> list[Chain]:
    """The chain of each table with columns for all that is estimated of the arm, at the parameters."""
    v = problem.variables
    values = np.concatenate([parameters[v.robot_span], parameters[v.frame_span]])
    every = build_variables(robot, [table.unknown_frame for table in problem.data.tables])
    return [chain.at(values) for chain in every.chains]


def _fitted(problem: Problem, robot: Robot) -> tuple[Floats, tuple[RowNoise, ...], tuple[Floats, ...]]:
    """What is unknown fitted with weights: parameters, noises and distances of a `RoughFit`."""
    parameters = problem.start
    for last in range(_ROUNDS):
        noises = noises_at(problem, parameters)
        chains = _arm(problem, robot, parameters)
        distances, weights = [], []
        for noise in noises:
            total, own = _covariance(noise, chains[noise.series.table], robot), noise.total
            used = noise.series.used
            r = np.where(used, noise.residual(), 0.0)
            z = np.linalg.norm(whitening_of(total, used) @ r[:, :, None], axis=(1, 2))
            d = z / np.sqrt(np.maximum(used.sum(axis=1), 1)) / _typical(z, used)
            share = np.einsum("nii->n", own) / np.einsum("nii->n", total)
            distances.append(d)
            weights.append(share / (1.0 + (d / _CAUCHY) ** 2))
        if last == _ROUNDS - 1 or not problem.variables.keys:
            break
        problem = relinearized_at(problem, parameters, replace(problem.state, weights=tuple(weights)))
        parameters = fit_landmarks(problem)
    return parameters, noises, tuple(distances)


def _typical(z: Floats, used: Booleans) -> float:
    """The typical distance over what noise and tolerances make of it, so that what is `FAR` times it is far.

    Args:
        z: Lengths of whitened residuals, shape (n,).
        used: Rows that take part, shape (n, residual_dim).
    """
    n_rows = used.sum(axis=1)
    there = n_rows > 0
    if not there.any():
        return 1.0
    size = float(np.median(z[there] / np.sqrt(special.chdtri(n_rows[there], 0.5))))
    in_line = OUT_OF_LINE / FAR * max(size, LEAST_SIZE) if np.sum(there) >= LEAST_MANY else 1.0
    return max(size, min(1.0, in_line))


def _covariance(noise: RowNoise, chain: Chain, robot: Robot) -> Floats:
    """Covariance of each measurement's rows by noise and tolerances, shape (n, residual_dim, residual_dim)."""
    names = build_variables(robot, []).names
    J = residuals.linearise(noise.rows, chain)[1][:, :, : len(names)] * prior_sigmas_of(robot, names)
    out: Floats = noise.total + J @ np.swapaxes(J, 1, 2)
    return out


def _are_far(d: Floats, n_rows: Integers) -> Booleans:
    """Which distances, per row, are too far for chance, shape (n,)."""
    n = max(int(np.sum(n_rows > 0)), 1)
    limit = special.chdtri(np.maximum(n_rows, 1), CHANCE / n) / np.maximum(n_rows, 1)
    far: Booleans = d**2 > np.maximum(limit, FAR**2)
    return far


def _described(
    fit: RoughFit, noise: RowNoise, covariance: Floats, found: tuple[Floats, Integers], label: str
) -> list[Disagreement]:
    """What is to be said of some measurements of a series.

    Args:
        fit: What most rows say.
        noise: The series' rows.
        covariance: Of each measurement's rows by noise and tolerances.
        found: Distances of all, and which are far.
        label: Name of their table.
    """
    s, (d, bad), data = noise.series, found, fit.problem.data
    kinds = np.array([name.partition(".")[0] for name in s.kind.names])
    units = dict(zip(kinds.tolist(), s.kind.units, strict=True))
    r = np.where(s.used, noise.residual(), 0.0)
    variance = np.einsum("nii->ni", covariance)
    part, out = data.tables[s.table].measurements.part, []
    for k in bad.tolist():
        sizes = {kind: float(np.linalg.norm(r[k, kinds == kind])) for kind in units}
        expected = {kind: float(np.sqrt(np.sum(variance[k, kinds == kind]))) for kind in units}
        kind = max(units, key=lambda kind: sizes[kind] / expected[kind])
        here = int(s.ends[k, 0]) if s.kind.ends == 1 else -1
        row = int(part[here]) if part is not None and here >= 0 else here
        unknowns = data.n_configurations + np.unique(data.unknowns.owners[s.nuisances[k]])
        ends = data.places[s.table][s.ends[k]] if s.kind.ends else unknowns
        of = s.of.names[s.of.index[k]] if s.of is not None and s.of.index[k] >= 0 else ""
        test = bool(fit.tests[s.table][s.ends[k]].any())
        figures = (sizes[kind], expected[kind], float(d[k]), test)
        out.append(
            Disagreement(label, tuple(data.names[i] for i in ends.tolist()), of, row, kind, units[kind], *figures)
        )
    return out
