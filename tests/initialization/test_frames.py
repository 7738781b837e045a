"""Closed-form starts: exact without noise, from anywhere."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tolerances import rounding

from fg_calib.initialization import Frame, hand_eye
from fg_calib.initialization.hand_eye import Unknown, start_from_distances, start_from_most_poses, start_from_poses

ALL = np.ones(3, dtype=bool)
IDENTITY = Frame(np.eye(3), np.zeros(3))
FAR = [
    Frame(Rotation.from_rotvec([0, 0, np.pi]).as_matrix(), np.array([20.0, -3.0, 7.0])),
    Frame(Rotation.from_rotvec(np.pi * np.array([0.6, 0.0, 0.8])).as_matrix(), np.array([-5.0, 40.0, 1.0])),
    Frame(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.1, 0.0, 0.2])),
]


def flange_poses(n=12, seed=0, axis=None):
    rng = np.random.default_rng(seed)
    turns = Rotation.random(n, random_state=seed)
    if axis is not None:
        turns = Rotation.from_rotvec(rng.uniform(-3, 3, (n, 1)) * axis)
    return turns.as_matrix(), rng.uniform(-1, 1, (n, 3))


def measured(flange, X, T):
    R, p = flange
    return X.rotation @ R @ T.rotation, (p + R @ T.translation) @ X.rotation.T + X.translation


@pytest.mark.parametrize("X", FAR)
@pytest.mark.parametrize("T", FAR)
def test_frame_and_tool_are_found_from_poses(X, T):
    flange = flange_poses()
    found = start_from_poses(flange, measured(flange, X, T), (FAR[1], FAR[2]), Unknown(True, True, ALL))
    for f, expected in zip(found, (X, T), strict=True):
        assert f.rotation == pytest.approx(expected.rotation, abs=rounding(1, 10))
        assert f.translation == pytest.approx(expected.translation, abs=rounding(1, 1e3))


@pytest.mark.parametrize("X", FAR)
def test_frame_and_tool_point_are_found_from_positions(X):
    flange, T = flange_poses(), Frame(np.eye(3), np.array([0.3, -0.2, 0.9]))
    position = measured(flange, X, T)[1]
    found = start_from_poses(flange, (None, position), (IDENTITY, IDENTITY), Unknown(True, False, ALL))
    assert found[0].rotation == pytest.approx(X.rotation, abs=rounding(1, 100))
    assert found[0].translation == pytest.approx(X.translation, abs=1e-8)
    assert found[1].translation == pytest.approx(T.translation, abs=rounding(1, 100))


def test_without_noise_every_candidate_is_the_frames_rotation():
    """The linear one is that of an unknown tool point; about the means the point is taken to be known."""
    flange, T = flange_poses(), Frame(np.eye(3), np.array([0.3, -0.2, 0.9]))
    position, unknown = measured(flange, FAR[2], T)[1], Unknown(True, False, ALL)
    found = hand_eye._frame_rotations(*flange, position, T.translation, unknown)
    assert [rotation == pytest.approx(FAR[2].rotation, abs=rounding(1, 100)) for rotation in found] == [True] * 3


@pytest.mark.parametrize("T", FAR)
def test_tool_alone_is_found(T):
    flange = flange_poses()
    _, found = start_from_poses(flange, measured(flange, IDENTITY, T), (IDENTITY, IDENTITY), Unknown(False, True, ALL))
    assert found.rotation == pytest.approx(T.rotation, abs=rounding(1, 100))
    assert found.translation == pytest.approx(T.translation, abs=rounding(1, 100))


@pytest.mark.parametrize("X", FAR)
@pytest.mark.parametrize("T", FAR)
def test_rotations_about_one_axis_only_still_give_a_start_that_explains_the_poses(X, T):
    flange = flange_poses(axis=np.array([0.0, 0.0, 1.0]))
    R, p = measured(flange, X, T)
    found = start_from_poses(flange, (R, p), (IDENTITY, IDENTITY), Unknown(True, True, ALL))
    R_again, p_again = measured(flange, *found)
    assert R_again == pytest.approx(R, abs=1e-4)  # alternating Procrustes, 20 steps
    # the turn about the common axis is sought in steps of 5 degrees; points lie 1 m from it, the tool 20 m and more
    assert np.sqrt(np.mean((p_again - p) ** 2)) < np.deg2rad(2.5)


def test_coordinates_of_the_tool_that_are_known_stay():
    flange, X = flange_poses(), FAR[0]
    T = Frame(np.eye(3), np.array([0.3, 0.1, 0.5]))
    free = np.array([False, True, False])
    nominal = Frame(np.eye(3), np.array([0.3, 0.0, 0.5]))
    _, found = start_from_poses(flange, measured(flange, X, T), (IDENTITY, nominal), Unknown(True, False, free))
    assert found.translation == pytest.approx([0.3, 0.1, 0.5], abs=rounding(1, 10))


def test_what_the_poses_leave_open_stays_at_nominal():
    R, p = flange_poses()
    flange = (np.tile(R[:1], (12, 1, 1)), p)  # never turns: frame and tool translations act together
    T = Frame(np.eye(3), np.array([0.0, 0.0, 0.4]))
    X, tool = start_from_poses(flange, measured(flange, FAR[2], T), (FAR[2], T), Unknown(True, False, ALL))
    assert tool.translation == pytest.approx(T.translation, abs=rounding(1, 10))
    assert X.translation == pytest.approx(FAR[2].translation, abs=rounding(1, 10))


@pytest.mark.parametrize("t", [[0.3, -0.2, 0.9], [-2.0, 1.0, 3.0], [0.0, 0.0, 0.01]])
def test_tool_point_is_found_from_distances(t):
    R, p = flange_poses(30)
    tip = p + R @ np.array(t)
    a, b = np.triu_indices(30, 1)
    distance = np.linalg.norm(tip[b] - tip[a], axis=1)
    found = start_from_distances((R, p), np.stack([a, b], axis=1), distance, IDENTITY, ALL)
    assert found.translation == pytest.approx(t, abs=rounding(1, 10))


@pytest.mark.parametrize("n_wrong", [1, 4])
def test_poses_that_are_wrong_or_the_other_of_two_do_not_move_frame_and_tool(n_wrong):
    """Of 30 with 1 mm and 1 mrad of noise some are away, kilometres or 0.3 m, and a third is tilted the other way."""
    for seed in range(5):
        rng, X, T = np.random.default_rng(seed), FAR[0], FAR[2]
        flange = flange_poses(30, seed)
        R, p = measured(flange, X, T)
        R = R @ Rotation.from_rotvec(1e-3 * rng.normal(size=(30, 3))).as_matrix()
        p = p + 1e-3 * rng.normal(size=p.shape)
        choices = np.stack([R, R @ Rotation.from_rotvec([0.0, 0.9, 0.0]).as_matrix()], axis=1), np.stack([p, p], axis=1)
        swapped = rng.permutation(30)[:10]
        choices[0][swapped] = choices[0][swapped, ::-1]
        choices[1][rng.permutation(30)[:n_wrong]] += (2e3, 0.3)[seed % 2] * rng.normal(size=(n_wrong, 1, 3))
        found = start_from_most_poses(flange, choices, (IDENTITY, IDENTITY), Unknown(True, True, ALL))
        for f, expected in zip(found, (X, T), strict=True):
            assert f.rotation == pytest.approx(expected.rotation, abs=1e-3)
            assert f.translation == pytest.approx(expected.translation, abs=3e-3)
