"""A board from one image: exact, either way it may be tilted, with corners that are far off."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fg_calib.initialization import Camera
from fg_calib.initialization.boards import _two_poses, boards_from_image, undistorted

CAMERA = Camera(fx=900, fy=880, cx=640, cy=480)
CORNERS = np.array([[0.08 * i, 0.08 * j] for i in range(4) for j in range(3)])


def board_from_image(*arguments):
    found = boards_from_image(*arguments)
    return found[0][1] if found else None


def image_of(rotation, place, noise=0.0, camera=CAMERA, corners=CORNERS):
    """u, v and the corners, of a board that is somewhere ahead of the camera."""
    seen = camera.image(corners @ rotation[:, :2].T + place)[0]
    return np.hstack([seen + noise, corners])


def angle_between(a, b):
    return Rotation.from_matrix(a.T @ b).magnitude()


def tilted(cosine, rng):
    """A board about 2 m ahead whose normal is at an angle of that cosine to the line of sight."""
    place = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(1.5, 2.5)])
    sight = place / np.linalg.norm(place)
    across = np.linalg.svd(sight[None])[2][1:].T @ [np.cos(turn := rng.uniform(0, 6)), np.sin(turn)]
    normal = cosine * sight + np.sqrt(1.0 - cosine**2) * across
    x = np.linalg.svd(normal[None])[2][1]
    R = np.column_stack([x, np.cross(normal, x), normal]) @ Rotation.from_rotvec([0, 0, rng.uniform(0, 6)]).as_matrix()
    return R, place


@pytest.mark.parametrize("distortion", [{}, {"k1": -0.25, "k2": 0.08, "p1": 1e-3, "p2": -5e-4}])
def test_without_noise_a_board_is_where_it_is(distortion):
    camera, (R, place) = replace(CAMERA, **distortion), tilted(0.7, np.random.default_rng(2))
    found = board_from_image(camera, image_of(R, place, camera=camera))
    assert found.translation == pytest.approx(place, abs=1e-9)
    assert found.rotation == pytest.approx(R, abs=1e-9)


@pytest.mark.parametrize("cosine", [-0.9, 0.05, 0.12, 0.3, 0.9])
def test_an_image_leaves_two_poses_and_the_true_one_is_among_them(cosine):
    """At 0.3 pixel, of a board seen nearly from its edge too."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        R, place = tilted(cosine, rng)
        found = boards_from_image(CAMERA, image_of(R, place, 0.3 * rng.normal(size=(12, 2))), np.full((12, 2), 0.3))
        assert len(found) <= 2
        assert [cost for cost, _ in found] == sorted(cost for cost, _ in found)
        assert all(np.linalg.norm(frame.translation - place) < 0.3 for _, frame in found)  # none diverged
        assert min(angle_between(R, frame.rotation) for _, frame in found) < 0.15


@pytest.mark.parametrize("cosine", [-0.9, 0.3, 0.9])
def test_one_of_the_two_poses_that_a_homography_leaves_is_the_true_one(cosine):
    """Its derivative at the board's middle is that of two turned boards."""
    R, place = tilted(cosine, np.random.default_rng(1))
    H = np.column_stack([R[:, :2], place])
    seen = np.column_stack([CORNERS, np.ones(12)]) @ H.T
    found = _two_poses(H, CORNERS, seen[:, :2] / seen[:, 2:])
    off = [angle_between(R, frame.rotation) for frame in found]
    assert min(off) < 1e-7 < max(off)
    assert found[np.argmin(off)].translation == pytest.approx(place, abs=1e-9)


def test_most_clean_images_keep_all_corners():
    """The cost of a pose is then the sum of squares of all, less than at the true pose.

    Of 20 images in 3 a corner is beyond 3.5 sigma of what most are off by.
    """
    costs, squares, at_truth = np.zeros((3, 20))
    for seed in range(20):
        rng = np.random.default_rng(seed)
        (R, place), noise = tilted(0.8, rng), rng.normal(size=(12, 2))
        image = image_of(R, place, 0.3 * noise)
        costs[seed], found = boards_from_image(CAMERA, image, np.full((12, 2), 0.3))[0]
        squares[seed] = np.sum(((image_of(found.rotation, found.translation) - image) / 0.3) ** 2)
        at_truth[seed] = np.sum(noise**2)
    assert np.sum(costs < squares * (1.0 - 1e-9)) < 5
    assert np.sum(squares) < 0.9 * np.sum(at_truth)


def test_of_five_corners_none_is_left_out():
    """Four have a pose of their own each: nothing tells which is off."""
    corners, sigma = np.vstack([CORNERS[[0, 2, 9, 11]], CORNERS[4]]), np.full((5, 2), 0.3)
    image = image_of(*tilted(0.8, np.random.default_rng(0)), corners=corners)
    image[4, :2] += 10.0
    cost, found = boards_from_image(CAMERA, image, sigma)[0]
    off = (image_of(found.rotation, found.translation, corners=corners) - image) / 0.3
    assert cost == pytest.approx(np.sum(off**2))
    assert cost > 100.0


@pytest.mark.parametrize("n_off", [1, 2])
def test_corners_that_are_far_off_do_not_move_a_board(n_off):
    """30 pixels, of 12 corners at 0.1 pixel: where the others alone have it."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        R, place = tilted(0.8, rng)
        image = image_of(R, place, 0.1 * rng.normal(size=(12, 2)))
        off = rng.permutation(12)[:n_off]
        image[off, :2] += 30.0 * Rotation.random(n_off, random_state=seed).as_matrix()[:, 0, :2]
        clean = board_from_image(CAMERA, np.delete(image, off, axis=0), np.full((12 - n_off, 2), 0.1))
        found = board_from_image(CAMERA, image, np.full((12, 2), 0.1))
        assert found.translation == pytest.approx(clean.translation, abs=0.02)
        assert angle_between(found.rotation, clean.rotation) < 0.05


def test_noise_that_differs_from_corner_to_corner_is_weighed():
    """Half of the corners at 0.01 pixel, half at 3: the former say where the board is."""
    rng = np.random.default_rng(0)
    R, place = tilted(0.7, rng)
    sigma = np.where(np.arange(12)[:, None] % 2, 3.0, 0.01) * np.ones((12, 2))
    found = board_from_image(CAMERA, image_of(R, place, sigma * rng.normal(size=(12, 2))), sigma)
    assert found.translation == pytest.approx(place, abs=2e-3)


def test_what_a_distortion_shows_of_no_point_is_left_out():
    """Beyond where the image of this lens turns back, at 1.15 focal lengths from the axis."""
    camera = Camera(fx=900, fy=880, cx=640, cy=480, k1=-0.25)
    x = np.array([[0.0, 0.0], [0.3, -0.2], [-0.9, 0.5], [0.1, 1.0]])
    pixels = np.vstack([camera.image(np.column_stack([x, np.ones(4)]))[0], [[640 + 900 * 0.8, 480]]])
    found, there = undistorted(camera, pixels)
    assert there.tolist() == [True] * 4 + [False]
    assert found[:4] == pytest.approx(x, abs=1e-9)
    rng = np.random.default_rng(1)
    R, place = tilted(0.8, rng)
    image = np.vstack([image_of(R, place, camera=camera), [640 + 900 * 0.8, 480, 0.3, 0.3]])
    assert board_from_image(camera, image).translation == pytest.approx(place, abs=1e-6)


def test_points_on_one_line_say_nothing_of_a_board():
    x = np.arange(5.0)
    image = np.column_stack([100 * x, 50 * x, x, 2 * x])
    assert board_from_image(Camera(900, 900, 640, 480), image) is None
    assert board_from_image(Camera(900, 900, 640, 480), image[:3]) is None


def test_images_of_no_board_have_no_pose_that_breaks_anything():
    """All corners at one pixel, on one line, at random, doubled: no error, and every pose is ahead of the camera."""
    rng = np.random.default_rng(0)
    line = np.outer(np.linspace(0.0, 1.0, 12), [400.0, 300.0]) + 100.0
    for seen in (np.full((12, 2), 300.0), line, rng.uniform(0, 900, (12, 2)), np.tile(line[::6], (6, 1)), 1e9 * line):
        for camera in (CAMERA, Camera(fx=900, fy=880, cx=640, cy=480, k1=-0.25, k2=0.1)):
            for _, frame in boards_from_image(camera, np.hstack([seen, CORNERS])):
                assert np.isfinite(frame.translation).all()
                assert frame.rotation @ frame.rotation.T == pytest.approx(np.eye(3), abs=1e-9)
    assert boards_from_image(CAMERA, np.hstack([np.full((12, 2), 300.0), CORNERS])) == []
