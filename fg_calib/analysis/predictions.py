"""Touched points of test rows: how far they may miss, by their noise and by what the estimate is off.

A touch k of group g is compared with the mean of the predicted tool points of the rows that say where the point is (see
`PointGroups.rows_of`). With e the noise of touches, dx the error of the estimate and dl_g that of a point estimated
with it,

    r_k = e_k + J_k dx - dl_g - s_g,   s_g = mean over the train rows j of (e_j + J_j dx) - dl_g,

where s_g is a mean of fitted residuals, which is independent of the errors of the estimate. Of a group without
train rows the mean is that of its own touches: r_k = e_k - mean e + (J_k - mean J) dx. A distance between two groups
misses by its noise and by what both means are off along the line between them.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.analysis.residual_table import FAMILIES, ROW_KINDS, ResidualTable
from fg_calib.graph.problem import Problem, eliminated_terms
from fg_calib.robot.kinematics import forward

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Sparse = scipy.sparse.csr_array


def predicted_points(
    problem: Problem, parameters: Floats, half: Floats, table: ResidualTable, rows: Integers
) -> tuple[Floats, Sparse, Floats]:
    """Covariance `D + L L^T + P P^T` of test rows of touched points, over their sigmas.

    Args:
        problem: The problem, with groups.
        parameters: The estimate.
        half: H with H H^T the covariance of the core's columns.
        table: All residuals.
        rows: Test rows of touches and of distances between points.

    Returns:
        P, shape (n, at least n_columns), the first columns those of `half`; L; the diagonal of D, shape (n,).
    """
    points = problem.points
    assert points is not None
    chain = problem.variables.chain.at(parameters)
    noise = np.linalg.cholesky(points.covariance(chain, problem.trig)).astype(np.float64)  # (n_configurations, 3, 3)
    J = forward(chain, problem.trig).jacobian[:, 3:]  # (n_configurations, 3, n_core)
    of_touch, of_mean = _coefficients(problem, parameters, table, rows)
    error, where, averaged = _means(problem, parameters, half, J, noise)
    sigma = table.sigma[rows]
    of_core = of_touch @ J.reshape(-1, J.shape[2])
    P = (np.pad(of_core, ((0, 0), (0, len(error) - J.shape[2]))) + of_mean @ where) @ error
    L = (of_touch + of_mean @ averaged) @ scipy.sparse.block_diag(list(map(scipy.sparse.csr_array, noise)), "csr")
    own = (table.family[rows] == FAMILIES.index("distance")).astype(np.float64)
    return P / sigma[:, None], scipy.sparse.csr_array(scipy.sparse.diags_array(1.0 / sigma) @ L), own


def _coefficients(problem: Problem, parameters: Floats, table: ResidualTable, rows: Integers) -> tuple[Sparse, Sparse]:
    """How rows follow from coordinates of touches, shape (n, 3 n_configurations), and of groups' means."""
    points, n = problem.points, problem.measurements.n_configurations
    assert points is not None
    means = points.means(problem.variables.chain.at(parameters), problem.trig)  # (n_groups, 3)
    touches = np.flatnonzero(table.family[rows] == FAMILIES.index("point"))
    k, axis = table.a[rows[touches]], table.kind_code[rows[touches]] - ROW_KINDS.index("point.x")
    ones = np.ones(len(touches))
    of_touch = scipy.sparse.csr_array((ones, (touches, 3 * k + axis)), shape=(len(rows), 3 * n))
    distances = np.flatnonzero(table.family[rows] == FAMILIES.index("distance"))
    a, b = table.a[rows[distances]] - n, table.b[rows[distances]] - n
    u = means[b] - means[a]
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
    figures = np.concatenate([-ones, -u.ravel(), u.ravel()])
    of_rows = np.concatenate([touches, np.repeat(distances, 3), np.repeat(distances, 3)])
    columns = [3 * points.groups.index[k] + axis, *((3 * g[:, None] + np.arange(3)).ravel() for g in (a, b))]
    shape = (len(rows), 3 * points.groups.n_groups)
    return of_touch, scipy.sparse.csr_array((figures, (of_rows, np.concatenate(columns))), shape=shape)


def _means(
    problem: Problem, parameters: Floats, half: Floats, J: Floats, noise: Floats
) -> tuple[Floats, Floats, Sparse]:
    """What groups' means are off.

    Returns:
        E with E E^T the covariance of (dx, dl, s); how the means follow from these, shape (3 n_groups, len(E)); how
        those without train rows follow from the noise of touches, sparse, shape (3 n_groups, 3 n_configurations).
    """
    points = problem.points
    assert points is not None
    left, n_core, n_points = eliminated_terms(problem, parameters), len(half), 3 * len(points.estimated)
    joint = np.block([[half, np.zeros((n_core, n_points))], [left.follow @ half, left.inverse]])
    where = np.zeros((3 * points.groups.n_groups, n_core + 2 * n_points))
    averaged = scipy.sparse.lil_array((len(where), 3 * len(noise)))
    of_fitted, by_noise = np.zeros((n_points, len(joint))), np.zeros((n_points, n_points))
    place = {int(g): 3 * i for i, g in enumerate(points.estimated)}
    for g in range(points.groups.n_groups):
        said, here, eye = points.rows_of(g), slice(3 * g, 3 * g + 3), np.eye(3)
        if g not in place:
            where[here, :n_core] = J[said].mean(axis=0)
            for k in said:
                averaged[here, 3 * k : 3 * k + 3] = eye / len(said)
            continue
        point = slice(place[g], place[g] + 3)
        where[here, n_core + point.start : n_core + point.stop] = eye
        where[here, n_core + n_points + point.start : n_core + n_points + point.stop] = eye
        of_fitted[point, :n_core] = J[said].mean(axis=0)
        of_fitted[point, n_core + point.start : n_core + point.stop] = -eye
        by_noise[point, point] = np.sum(noise[said] @ np.swapaxes(noise[said], 1, 2), axis=0) / len(said) ** 2
    explained = of_fitted @ joint
    values, vectors = np.linalg.eigh(by_noise - explained @ explained.T)
    of_s = vectors * np.sqrt(np.maximum(values, 0.0))
    error = np.block([[joint, np.zeros((len(joint), n_points))], [np.zeros((n_points, len(joint))), of_s]])
    return error, where, scipy.sparse.csr_array(averaged)
