"""What a covariance of parameters does to vectors between poses, by the kernel and by differences of moved poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fg_calib.robot.kernels import vector_variances


def moved_vectors(poses, ends, base, carried, step):
    """Distance vectors in the base, and rotation vectors in the first tool, after a small step along each column."""
    rotation, position, moved = poses
    a, b = ends
    found = []
    for j in range(moved.shape[2]):
        at = {}
        for k in (a, b):
            turn = Rotation.from_rotvec(step * (moved[k, :3, j] - base[:, j])).as_matrix()
            # A turn of the base that is taken out carries the point with it, the other way.
            shift = moved[k, 3:, j] - np.cross(carried[:, j], position[k])
            at[k] = turn @ rotation[k], position[k] + step * shift
        found.append(at[b][1] - at[a][1])
        found.append(Rotation.from_matrix(at[a][0].T @ at[b][0]).as_rotvec())
    return np.array(found).reshape(-1, 2, 3)


def test_variances_are_those_of_moved_vectors():
    """Along and across, by central differences; the angle's part across is that of the rotation error, in the tool."""
    rng = np.random.default_rng(0)
    n, k = 6, 5
    poses = (
        Rotation.from_rotvec(rng.normal(size=(n, 3))).as_matrix(),
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 6, k)),
    )
    base, carried = rng.normal(size=(2, 3, k))
    ends = np.array([[0, 1], [2, 5], [4, 3]])
    across, along = np.empty((3, 2)), np.empty((3, 2))
    vector_variances(poses, ends, base, carried, across, along)
    step = 1e-5
    for i, pair in enumerate(ends.tolist()):
        plus, minus = (moved_vectors(poses, pair, base, carried, s) for s in (step, -step))
        change = (plus - minus) / (2.0 * step)  # (k, 2, 3)
        here = moved_vectors(poses, pair, base, carried, 0.0)[0]
        for which in (0, 1):
            u = here[which] / np.linalg.norm(here[which])
            inner = change[:, which] @ u
            assert along[i, which] == pytest.approx(np.sum(inner**2), rel=1e-6)
        # Of a distance what is across is that of the vector itself.
        left = np.sum(change[:, 0] ** 2) - along[i, 0]
        assert across[i, 0] == pytest.approx(0.5 * left, rel=1e-6)
        # Of a rotation Q it is that of the rotation error, of which Q^T dQ is the matrix.
        R, _, moved = poses
        a, b = pair
        error = R[b].T @ (moved[b, :3] - base) - R[a].T @ (moved[a, :3] - base)
        assert across[i, 1] == pytest.approx(0.5 * (np.sum(error**2) - along[i, 1]), rel=1e-9)


def test_vectors_of_no_length_have_no_direction():
    """All of their variance is across."""
    turn = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()  # whose products round
    R, p = turn[None].repeat(2, axis=0), np.ones((2, 3))
    moved = np.zeros((2, 6, 1))
    moved[1] = np.array([[0.1], [0.2], [0.2], [1.0], [2.0], [2.0]])
    across, along = np.empty((1, 2)), np.empty((1, 2))
    none = np.zeros((3, 1))
    vector_variances((R, p, moved), np.array([[0, 1]]), none, none, across, along)
    assert along == pytest.approx(0.0)
    assert across[0] == pytest.approx([4.5, 0.045])
