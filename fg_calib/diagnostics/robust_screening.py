"""Measurements that disagree with the nominal arm far more than the others do: gross errors, found early.

The arm stays nominal. Measurement frames, base, tool and landmarks are fitted to all rows, train and test, with
Cauchy's weights. The distance of a measurement is

    d^2 = r^T (J T^2 J^T + N)^-1 r over the number of its rows

with r its residual, J the derivatives in the arm's estimated parameters, T their prior sigmas (usual errors where there
are none, see `nominal_residuals`) and N the covariance of its noise. All rows have the arm's errors in common, which
may be larger or smaller than the prior sigmas, so distances are compared with their median. Pairs formed from poses are
screened as these poses in an unknown frame, for one wrong pose spoils many pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.diagnostics.nominal_residuals import evenly, fit_landmarks, nominal_problem, with_arm_errors
from fg_calib.graph import Problem, RowNoise, relinearized_at, whitening_of
from fg_calib.inputs import Floats, InputError, Options, ProblemError, SolverError
from fg_calib.measurements import INSTRUMENTS, Table
from fg_calib.parallel import one_blas_thread
from fg_calib.robot import Robot
from fg_calib.statistics import MAX_OUTLIER_SHARE

MAX_ROWS = 5000
"""Rows of a table up to which all are screened; of more, so many that are evenly spaced."""

FAR = 5.0
"""Distance over the typical one from which a measurement disagrees; half of it where there is less than expected."""

MIN_TYPICAL, MIN_MEASUREMENTS = 1e-2, 20
"""Least typical distance, for below it residuals are rounding, and measurements from which a median is typical."""

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
        for i in np.flatnonzero(d > FAR).tolist():
            found.append(_disagreement(problem, noise, i, covariance[i], (labels[k], float(d[i]), test)))
    found = sorted(found, key=lambda one: -one.ratio) if len(found) <= MAX_OUTLIER_SHARE * n else []
    return Disagreements(tuple(found), n, round(of))


def _sampled(table: Table) -> Table:
    """At most `MAX_ROWS` rows of a table; pairs that would be formed from poses as these poses."""
    m, n = table.measurements, table.measurements.n_configurations
    m = m if m.part is not None else replace(m, part=np.arange(n))
    if table.uses_pairs and m.pairs is not None:
        m = replace(m, pairs=m.pairs.select(evenly(m.pairs.n_pairs, MAX_ROWS)))
    elif m.groups is None and not table.own:
        m = m.select(evenly(n, MAX_ROWS))
    if not table.uses_pairs or m.pairs is not None or m.groups is not None:
        return replace(table, measurements=m)
    sees = INSTRUMENTS[str(table.model)]
    position = sees.sees_position and m.position is not None
    both = position and sees.sees_orientation and m.rotation is not None
    model = "pose" if both else "position" if position else "orientation"
    return replace(table, measurements=replace(m, labels={}), model=model, frame="unknown")


_Rows = list[tuple[RowNoise, Floats, Floats, Floats]]


def _distances(problem: Problem, parameters: Floats, robot: Robot) -> _Rows:
    """The rows of each series, with covariance, distance over the typical one, and part of the noise in it."""
    found: _Rows = []
    for noise, of_arm in with_arm_errors(problem, parameters, robot):
        total, used = noise.total + of_arm, noise.series.used
        n_rows = used.sum(axis=1)
        r = np.where(used, noise.residual(), 0.0)
        z = np.linalg.norm(whitening_of(total, used) @ r[:, :, None], axis=(1, 2))
        size = np.median(z[n_rows > 0] / np.sqrt(special.chdtri(n_rows[n_rows > 0], 0.5))) if n_rows.any() else 1.0
        size = max(size, MIN_TYPICAL if np.sum(n_rows > 0) >= MIN_MEASUREMENTS else 1.0)
        typical = np.clip(1.0, size, 2.0 * size)  # farther, where prior sigmas allow more than there is
        share = np.einsum("nii->n", noise.total) / np.einsum("nii->n", total)
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
    landmarks = data.n_configurations + np.unique(data.unknowns.owners[s.nuisances[k]])
    ends = tuple(data.names[i] for i in (data.places[s.table][s.ends[k]] if s.kind.ends else landmarks).tolist())
    of = s.of.names[s.of.index[k]] if s.of is not None and s.of.index[k] >= 0 else ""
    values = sizes[kind], expected[kind], d, bool(test[s.ends[k]].any())
    return Disagreement(label, ends, of, row, kind, units[kind], *values)
