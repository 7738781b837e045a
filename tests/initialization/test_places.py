"""Closed-form starts of targets, frames, anchors, offsets and planes: metres away and half a turn away."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fg_calib.initialization import Frame, anchors_from_lengths
from fg_calib.initialization.landmarks import offset_from_lengths, plane_from_distances, targets_from_positions

SIGMA = 1e-3
ORIGIN = Frame(np.eye(3), np.zeros(3))


def arm(n, rng):
    return Rotation.random(n, random_state=rng.integers(1000)).as_matrix(), rng.normal(size=(n, 3))


@pytest.mark.parametrize("away", [0.1, 3.0])
@pytest.mark.parametrize("n_targets", [1, 2, 3])
@pytest.mark.parametrize("n_known", [0, 1])
@pytest.mark.parametrize("unknown_frame", [False, True])
def test_targets_and_frame_from_positions(away, n_targets, n_known, unknown_frame):
    """Nearer than 30 mm and 30 mrad with 1 mm of noise: a start, from which a descent goes on."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        (R, p), targets = arm(20, rng), away * rng.normal(size=(n_targets, 3))
        X = Frame(Rotation.random(random_state=seed).as_matrix(), 5.0 * rng.normal(size=3)) if unknown_frame else ORIGIN
        which = np.arange(20) % n_targets
        points = p + np.einsum("nij,nj->ni", R, targets[which])
        measured = points @ X.rotation.T + X.translation + SIGMA * rng.normal(size=(20, 3))
        known = np.full((n_targets, 3), np.nan)
        known[:n_known] = targets[:n_known]
        found, places = targets_from_positions((R, p), measured, which, known, unknown_frame)
        assert places == pytest.approx(targets, abs=0.03)
        assert found.rotation == pytest.approx(X.rotation, abs=0.03)
        assert found.translation == pytest.approx(X.translation, abs=0.1)  # 30 mrad at some metres


@pytest.mark.parametrize("offset", [0.0, 0.3])
@pytest.mark.parametrize("flat", [1.0, 0.2])
def test_anchors_and_what_an_instrument_adds_from_lengths(offset, flat):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points, anchors = rng.normal(size=(45, 3)) * [1.0, 1.0, flat], 2.0 * rng.normal(size=(3, 3))
        which = np.arange(45) % 3
        length = np.linalg.norm(points - anchors[which], axis=1) + offset + SIGMA * rng.normal(size=45)
        unknown, anchor = np.full(9, np.nan), 3 * which[:, None] + np.arange(3)
        added = offset_from_lengths(points, length, anchor, unknown) if offset > 0.0 else 0.0
        found = anchors_from_lengths(points, length - added, anchor, unknown)
        assert [place for _, place in found] == pytest.approx(anchors, abs=0.1)
        assert added == pytest.approx(offset, abs=0.1)


@pytest.mark.parametrize(("height", "even"), [(0.3, False), (2.0, False), (0.0, True), (0.02, True)])
def test_a_plane_from_distances(height, even):
    """Away from the base, as the true one here, where no distance tells the side; else it is said by them.

    None does where a tip touched, or a ball of one radius everywhere: the points lie on either side alike.
    """
    for seed in range(10):
        rng = np.random.default_rng(seed)
        n = rng.normal(size=3)
        n /= np.linalg.norm(n)
        points, distance = rng.normal(size=(15, 3)), height * (np.ones(15) if even else rng.random(15))
        points += (0.7 + distance * (not even) - points @ n + SIGMA * rng.normal(size=15))[:, None] * n
        c, f = plane_from_distances(points, distance)
        found = (f - c) / np.linalg.norm(f - c)
        assert found == pytest.approx(n, abs=0.01)
        assert found @ f == pytest.approx(0.7 - height * even, abs=0.01)
