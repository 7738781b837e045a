"""Groups of configurations whose tool points touched the same physical point: its position is estimated with the arm.

| rows | residual | of |
|---|---|---|
| touch | `p_k - l_g` in the base frame | a configuration k of group g, 3 rows |
| distance | `|l_h - l_g| - measured` | two groups, 1 row |

with p_k the predicted tool point and l_g the point, both in the base frame. Derivatives: `dp_k - dl_g`, and
`u . (dl_h - dl_g)` with u the unit vector from g to h. A touch has noise `sigma_point` on each axis, and that of the
joint readings to first order.

What moves all tool points of a group as one body moves the point with them, and turns the residuals without changing
their lengths. Each column's derivative is taken of residuals turned back by its share in such motions, `dp_k - dl_g -
a x (p_k - l_g)` (see `kinematics.turning_of_base`): else directions that no touch determines would seem determined.

Note:
    Noise of a reading that also takes part in a pair counts as independent of that in the pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import ProblemError
from fg_calib.graph.factors import Term, Variables
from fg_calib.measurements.dataset import Groups, Measurements, Pairs
from fg_calib.robot.kinematics import Chain, forward, turning_of_base

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

POINT_MODELS = ("distance", "distance-rotation")
"""Models that use touched points."""


@dataclass(frozen=True)
class Touches:
    """The train rows of one group.

    Attributes:
        trig: Readings, shape (n_configurations, n_joints, 2).
        rows: The group's rows of `trig`, shape (n,).
        point: Index of the point among the nuisance variables.
        whitening: Whitens each 3-vector, shape (n, 3, 3), [1/m].
    """

    trig: Floats
    rows: Integers
    point: int
    whitening: Floats

    on_core = True

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return 3 * len(self.rows)

    @property
    def nuisance(self) -> tuple[int, ...]:
        """The point alone."""
        return (self.point,)

    def residual(self, variables: Variables, parameters: Floats) -> Floats:
        """Whitened residuals, shape (n_rows,)."""
        p = forward(variables.chain.at(parameters).without_columns(), self.trig, self.rows).position
        off = p - parameters[list(variables.nuisance[self.point].parameters)]
        return (self.whitening @ off[:, :, None]).ravel()

    def linearise(self, variables: Variables, parameters: Floats) -> tuple[Floats, Floats]:
        """The same with derivatives in the core's columns, then in the point, shape (n_rows, n_columns + 3)."""
        point = parameters[list(variables.nuisance[self.point].parameters)]
        at = forward(variables.chain.at(parameters), self.trig, self.rows)
        w, dp, off = at.jacobian[:, :3], at.jacobian[:, 3:], (at.position - point)[:, :, None]
        dp = dp - np.cross(turning_of_base(w, at.rotation)[None], off, axis=1)
        J = np.concatenate([dp, np.broadcast_to(-np.eye(3), (len(dp), 3, 3))], axis=2)
        return (self.whitening @ off).ravel(), (self.whitening @ J).reshape(self.n_rows, -1)


@dataclass(frozen=True)
class PointDistance:
    """A distance measured between the points of two groups.

    Attributes:
        a: Index of the first point among the nuisance variables.
        b: Index of the second.
        distance: Measured, [m].
        sigma: 1 sigma, [m].
    """

    a: int
    b: int
    distance: float
    sigma: float

    on_core = False
    n_rows = 1

    @property
    def nuisance(self) -> tuple[int, ...]:
        """The two points."""
        return self.a, self.b

    def residual(self, variables: Variables, parameters: Floats) -> Floats:
        """Whitened residual, shape (1,)."""
        return self.linearise(variables, parameters)[0]

    def linearise(self, variables: Variables, parameters: Floats) -> tuple[Floats, Floats]:
        """The same with derivatives in the two points, shape (1, 6)."""
        l_a, l_b = (parameters[list(variables.nuisance[i].parameters)] for i in self.nuisance)
        length = float(np.linalg.norm(l_b - l_a))
        u = (l_b - l_a) / max(length, 1e-300)
        J = np.concatenate([-u, u])[None] / self.sigma
        return np.array([(length - self.distance) / self.sigma]), J


class PointGroups:
    """The groups of a problem at its measurements: which have a point to estimate, and their rows.

    Args:
        measurements: What was measured, groups among it.
        model: Which measurements take part.

    Attributes:
        groups: The groups.
        touched: Rows that touch a point, shape (n_configurations,).
        train: Those of the fit.
        estimated: Groups with a train row: those with a point, in the order of the nuisance variables.
        used: Distances between groups that take part: train, between two points that are estimated.

    Raises:
        ProblemError: The model does not use touched points, or a sigma is missing.
    """

    def __init__(self, measurements: Measurements, model: str) -> None:
        assert measurements.groups is not None
        m, groups = measurements, measurements.groups
        if model not in POINT_MODELS:
            raise ProblemError(m.source, f"a column group with model {model}", f"model {' or '.join(POINT_MODELS)}")
        self.groups: Groups = groups
        self._measurements = m
        self.touched = groups.index >= 0
        if m.sigma_point is None or not np.isfinite(m.sigma_point[self.touched]).all():
            raise ProblemError(m.source, "no sigma for touched points", "noise.point or a column sigma_point")
        if not np.isfinite(groups.pairs.sigma_distance).all():
            expected = "noise.distance or a column sigma_distance"
            raise ProblemError(groups.pairs.source, "no sigma for distance", expected)
        self._sigma: Floats = m.sigma_point
        self.train = self.touched & ~m.test
        self.estimated: Integers = np.unique(groups.index[self.train])
        self.used: Booleans = (
            ~groups.pairs.test & np.isin(groups.pairs.a, self.estimated) & np.isin(groups.pairs.b, self.estimated)
        )

    @property
    def n_residuals(self) -> int:
        """Scalar residuals of the fit."""
        return 3 * int(self.train.sum()) + int(self.used.sum())

    def add_points(self, variables: Variables) -> Variables:
        """The variables with a point a group that has train rows."""
        return variables.with_nuisance("point", "L", range(len(self.estimated)), 3 * (variables.robot.scale_of("m"),))

    def rows_of(self, group: int) -> Integers:
        """Rows that say where a group's point is: the train rows; of a group without any, all."""
        rows = np.flatnonzero(self.groups.index == group)
        train = rows[~self._measurements.test[rows]]
        return train if len(train) else rows

    def means(self, chain: Chain, trig: Floats) -> Floats:
        """Mean of the predicted tool points of each group (see `rows_of`), shape (n_groups, 3), [m]."""
        p = forward(chain.without_columns(), trig).position
        return np.array([p[self.rows_of(g)].mean(axis=0) for g in range(self.groups.n_groups)])

    def start(self, chain: Chain, trig: Floats) -> Floats:
        """Initial nuisance values: the means of the estimated groups, flat, [m]."""
        return self.means(chain, trig)[self.estimated].ravel()

    def tool_point(self, flange: tuple[Floats, Floats], nominal: Floats, free: Booleans) -> Floats:
        """The tool point that brings the points of each group nearest together, from the nominal one, shape (3,), [m].

        Args:
            flange: base_T_flange: rotations (n, 3, 3), translations (n, 3), [m].
            nominal: The nominal tool point, [m].
            free: Which of its coordinates are unknown, shape (3,).
        """
        A, b = [np.zeros((0, 3))], [np.zeros(0)]
        for g in self.estimated:
            R, p = (v[self.rows_of(int(g))] for v in flange)
            at = p + R @ nominal
            A.append((R - R.mean(axis=0)).reshape(-1, 3))
            b.append(-(at - at.mean(axis=0)).ravel())
        found = nominal.copy()
        found[free] += np.linalg.lstsq(np.vstack(A)[:, free], np.concatenate(b), rcond=1e-10)[0]
        return found

    def covariance(self, chain: Chain, trig: Floats) -> Floats:
        """Of each touch, joint noise to first order: shape (n_configurations, 3, 3), [m^2]; of no meaning elsewhere."""
        m = self._measurements
        S = self._sigma[:, None, None] ** 2 * np.eye(3)
        if np.any(m.sigma_joint > 0.0):
            J = forward(chain.without_columns().with_joint_columns(), trig).jacobian[:, 3:] * m.sigma_joint
            S = S + J @ np.swapaxes(J, 1, 2)
        return S

    def terms(self, trig: Floats, covariance: Floats) -> tuple[Term, ...]:
        """The train rows: a term a group, and one a distance between two of them."""
        place = {int(g): i for i, g in enumerate(self.estimated)}
        terms: list[Term] = []
        for g, i in place.items():
            rows = self.rows_of(g)
            W: Floats = np.tril(np.linalg.inv(np.linalg.cholesky(covariance[rows])))
            terms.append(Touches(trig, rows, i, W))
        pairs: Pairs = self.groups.pairs.select(self.used)
        for a, b, d, s in zip(pairs.a, pairs.b, pairs.distance, pairs.sigma_distance, strict=True):
            terms.append(PointDistance(place[int(a)], place[int(b)], float(d), float(s)))
        return tuple(terms)
