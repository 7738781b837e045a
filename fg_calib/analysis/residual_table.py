"""Every scalar residual, train and test, before and after."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.problem import Problem, all_rows, pair_rows
from fg_calib.graph.solver import Solution
from fg_calib.measurements import residuals
from fg_calib.options import PAIR_MODELS, POSE_MODELS
from fg_calib.robot.kinematics import forward

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Codes = NDArray[np.int8]
Indices = NDArray[np.int32]


ROW_KINDS = (
    *("distance", "angle"),
    *("orientation.x", "orientation.y", "orientation.z"),
    *("position.x", "position.y", "position.z"),
    *("point.x", "point.y", "point.z"),
)
"""Kinds of scalar rows, in the order of their codes."""

FAMILIES = ("distance", "angle", "orientation", "position", "point")
"""Kinds of noise, in the order of their codes."""

FAMILY_OF_KIND = np.array([0, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4], dtype=np.int8)
"""Code in `FAMILIES` of each code in `ROW_KINDS`."""


@dataclass(frozen=True)
class ResidualTable:
    """Every scalar residual, train and test, before and after; [m] and [rad]. Words are codes: a table is long.

    A touched point's residual is that of its predicted tool point from the mean of its group's (see
    `PointGroups.rows_of`); that of a distance between groups is of these means.

    Attributes:
        kind_code: Of each row, in `ROW_KINDS`, shape (n,).
        measurement: Number of each row's pair or configuration, ascending; beyond these touches and distances
            between touched points count on, shape (n,).
        a: Row of the (first) configuration, shape (n,); a group counts on from the number of configurations.
        b: Row of the second configuration or group, -1 for poses and points, shape (n,).
        test: Predicted only, shape (n,).
        reason_code: Why a row takes no part, in `reasons`; 0 where it does, shape (n,).
        reasons: Reasons by code; the first is empty.
        measured: Measured value; nan for orientations, shape (n,).
        before: Residual with the arm at nominal, shape (n,).
        after: Residual at the estimate, shape (n,).
        excess: What noise adds to the measured value on average (see `moments`), at the estimate, shape (n,); the arm's
            own prediction is measured + after - excess.
        sigma: 1 sigma of the residual, shape (n,).
        evaluated: Whether these are test rows, all of them, by which the arm was evaluated as it is.
    """

    kind_code: Codes
    measurement: Indices
    a: Indices
    b: Indices
    test: Booleans
    reason_code: Codes
    reasons: tuple[str, ...]
    measured: Floats
    before: Floats
    after: Floats
    excess: Floats
    sigma: Floats
    evaluated: bool = False

    @property
    def split(self) -> Codes:
        """0 for train, 1 for test, shape (n,)."""
        return (self.test | self.evaluated).astype(np.int8)

    @property
    def n(self) -> int:
        """Number of rows."""
        return len(self.kind_code)

    @property
    def kind(self) -> NDArray[np.str_]:
        """`distance`, `angle`, `position.x`, ..., `orientation.z`, `point.x`, ... of each row, shape (n,)."""
        return np.array(ROW_KINDS)[self.kind_code]

    @property
    def reason(self) -> NDArray[np.str_]:
        """Why a row takes no part, empty where it does, shape (n,)."""
        return np.array(self.reasons)[self.reason_code]

    @property
    def family(self) -> Codes:
        """Kind of noise of each row, in `FAMILIES`, shape (n,)."""
        return FAMILY_OF_KIND[self.kind_code]

    @property
    def used(self) -> Booleans:
        """Whether each row was fitted, shape (n,)."""
        used: Booleans = (self.reason_code == 0) & ~self.test
        return used

    def rms(self) -> dict[str, dict[str, dict[str, float]]]:
        """RMS by split, kind (the norm of three components but for distances and angles), before and after."""
        table: dict[str, dict[str, dict[str, float]]] = {"train": {}, "test": {}}
        family, counted = self.family, self.reason_code == 0
        for code, split in enumerate(("train", "test")):
            of_split = counted & (self.split == code)
            for name in ("position", "orientation", "distance", "angle", "point"):
                rows = of_split & (family == FAMILIES.index(name))
                if rows.any():
                    per_row = 1.0 if name in ("distance", "angle") else 3.0
                    table[split][name] = {
                        when: float(np.sqrt(per_row * np.mean(values[rows] ** 2)))
                        for when, values in (("before", self.before), ("after", self.after))
                    }
        return table


def residual_table(solution: Solution) -> ResidualTable:
    """Every scalar residual, train and test, with the arm at nominal and at the estimate."""
    problem = solution.problem
    chain = problem.variables.chain
    before, after = (
        residuals.residual(all_rows(problem, p), chain.at(p)) for p in (solution.before, solution.parameters)
    )
    evaluated = problem.evaluated
    if problem.pairs is None:
        return replace(_pose_table(problem, before, after), evaluated=evaluated)
    tables = [_pair_table(problem, before, after, pair_rows(problem, solution.parameters).moments.excess)]
    if problem.points is not None:
        tables += _point_tables(problem, solution.before, solution.parameters)
    arrays = [f.name for f in fields(ResidualTable) if f.name not in ("reasons", "evaluated")]
    together = {name: np.concatenate([getattr(t, name) for t in tables]) for name in arrays}
    return ResidualTable(reasons=tables[0].reasons, evaluated=evaluated, **together)


def _pair_table(problem: Problem, before: Floats, after: Floats, excess: Floats) -> ResidualTable:
    pairs, judgement = problem.pairs, problem.judgement
    assert pairs is not None
    assert judgement is not None
    kinds = np.flatnonzero(PAIR_MODELS[problem.options.model])
    reasons = ("", *judgement.reasons)
    codes = np.zeros((pairs.n_pairs, 2), dtype=np.int8)
    for code, (reason, mask) in enumerate(judgement.reasons.items(), start=1):
        named = [column for column, kind in enumerate(("distance", "angle")) if kind in reason]
        for column in named or (0, 1):
            codes[mask, column] = code
    measured = np.stack([pairs.distance, pairs.angle], axis=1)[:, kinds]
    there = np.isfinite(measured)
    rows, columns = np.nonzero(there)
    return ResidualTable(
        kind_code=kinds.astype(np.int8)[columns],
        measurement=rows.astype(np.int32),
        a=pairs.a.astype(np.int32)[rows],
        b=pairs.b.astype(np.int32)[rows],
        test=pairs.test[rows],
        reason_code=codes[:, kinds][there],
        reasons=reasons,
        measured=measured[there],
        before=before[there],
        after=after[there],
        excess=excess[:, kinds][there],
        sigma=problem.sigma[:, kinds][there],
    )


def _point_tables(problem: Problem, before: Floats, after: Floats) -> list[ResidualTable]:
    """Touches, then distances between touched points, at two parameter vectors."""
    points, m, pairs = problem.points, problem.measurements, problem.pairs
    assert points is not None
    assert pairs is not None
    chains = [problem.variables.chain.at(p) for p in (before, after)]
    means = [points.means(chain, problem.trig) for chain in chains]
    rows = np.flatnonzero(points.touched)
    off = [
        (forward(chain.without_columns(), problem.trig, rows).position - mean[points.groups.index[rows]]).ravel()
        for chain, mean in zip(chains, means, strict=True)
    ]
    n_rows, between = 3 * len(rows), points.groups.pairs
    touches = ResidualTable(
        kind_code=np.tile(np.arange(3, dtype=np.int8) + np.int8(ROW_KINDS.index("point.x")), len(rows)),
        measurement=(pairs.n_pairs + np.repeat(np.arange(len(rows)), 3)).astype(np.int32),
        a=np.repeat(rows, 3).astype(np.int32),
        b=np.full(n_rows, -1, dtype=np.int32),
        test=np.repeat(m.test[rows], 3),
        reason_code=np.zeros(n_rows, dtype=np.int8),
        reasons=("",),
        measured=np.full(n_rows, np.nan),
        before=off[0],
        after=off[1],
        excess=np.zeros(n_rows),
        sigma=problem.sigma_point[rows].ravel(),
    )
    miss = [np.linalg.norm(mean[between.b] - mean[between.a], axis=1) - between.distance for mean in means]
    n = m.n_configurations
    distances = ResidualTable(
        kind_code=np.full(between.n_pairs, ROW_KINDS.index("distance"), dtype=np.int8),
        measurement=(pairs.n_pairs + len(rows) + np.arange(between.n_pairs)).astype(np.int32),
        a=(n + between.a).astype(np.int32),
        b=(n + between.b).astype(np.int32),
        test=between.test,
        reason_code=np.zeros(between.n_pairs, dtype=np.int8),
        reasons=("",),
        measured=between.distance,
        before=miss[0],
        after=miss[1],
        excess=np.zeros(between.n_pairs),
        sigma=between.sigma_distance,
    )
    return [touches, distances]


def _pose_table(problem: Problem, before: Floats, after: Floats) -> ResidualTable:
    m, n = problem.measurements, problem.measurements.n_configurations
    wanted = np.flatnonzero(np.repeat(POSE_MODELS[problem.options.model], 3))
    measured = np.full((n, 6), np.nan)
    if m.position is not None:
        measured[:, 3:] = m.position
    each, rows = len(wanted), np.arange(n, dtype=np.int32)
    return ResidualTable(
        kind_code=np.tile(wanted.astype(np.int8) + np.int8(ROW_KINDS.index("orientation.x")), n),
        measurement=np.repeat(rows, each),
        a=np.repeat(rows, each),
        b=np.full(n * each, -1, dtype=np.int32),
        test=np.repeat(m.test, each),
        reason_code=np.zeros(n * each, dtype=np.int8),
        reasons=("",),
        measured=measured[:, wanted].ravel(),
        before=before.ravel(),
        after=after.ravel(),
        excess=np.zeros(n * each),
        sigma=problem.sigma[:, wanted].ravel(),
    )
