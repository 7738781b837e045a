"""Each kind of measurement: derivatives by central differences, compiled twins against numpy, a custom kind."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import central_differences, random_robot, tool_pose
from scipy.spatial.transform import Rotation
from sparing import diagonal
from tolerances import rounding

from fg_calib.initialization import Camera
from fg_calib.measurements import Block, Frames, LandmarkKind, check_rows, pack, residuals, unit_whitening, unpack
from fg_calib.measurements.kind import Stacked
from fg_calib.measurements.kinds.anchor import AnchorContact, AnchorDistance
from fg_calib.measurements.kinds.board import BoardPose
from fg_calib.measurements.kinds.pair import Distance, PointDistance, RotationAngle, SamePoint, TouchedPoint
from fg_calib.measurements.kinds.pixel import Pixel, RoomPixel
from fg_calib.measurements.kinds.plane import PlaneDistance
from fg_calib.measurements.kinds.pose import Orientation, Position, TargetPosition
from fg_calib.robot import LANES, build_chain

CONVENTIONS = ["dh", "mdh", "mdh-hayati", "dh-hayati", "urdf"]
COMPILED = [
    *(Distance(), RotationAngle(), Position(), Orientation()),
    *(Stacked(Distance(), RotationAngle()), Stacked(Orientation(), Position()), Stacked(Position(), Orientation())),
]
INSTRUMENTS = [TargetPosition(), AnchorDistance(), AnchorContact(), PlaneDistance(), BoardPose()]
INSTRUMENTS += [Stacked(Orientation(), TargetPosition())]
KINDS = [*COMPILED, SamePoint(), TouchedPoint(), PointDistance(), *INSTRUMENTS]


def name_of(kind):
    return "+".join(map(name_of, kind.parts)) if isinstance(kind, Stacked) else type(kind).__name__


EVERY_KIND = pytest.mark.parametrize("kind", KINDS, ids=name_of)


def in_numpy(kind):
    """The kind without its twin."""
    kind = Stacked(*kind.parts) if isinstance(kind, Stacked) else type(kind)()
    kind.twins = lambda: np.zeros((0, 3), dtype=np.int64)
    return kind


def data_of(kind, n, rng):
    """Measured values that are far from what is predicted."""
    if isinstance(kind, Stacked):
        return np.concatenate([data_of(part, n, rng) for part in kind.parts], axis=1)
    if isinstance(kind, Orientation):
        return Rotation.random(n, random_state=rng.integers(1000)).as_matrix().reshape(n, 9)
    if isinstance(kind, BoardPose):
        return np.hstack([data_of(Orientation(), n, rng), rng.normal(size=(n, 3))])
    return rng.uniform(0.0, 1.0, (n, kind.width))


def random_block(kind, robot, n, rng):
    h = kind.residual_dim
    trig = robot.trig(rng.uniform(-3, 3, (2 * n + 1, robot.n_joints)))
    ends = rng.permutation(2 * n + 1)[: n * kind.ends].reshape(n, kind.ends)
    whitening = pack(np.tril(rng.normal(size=(n, h, h))) + 3 * np.eye(h))
    return Block(kind, trig, ends, data_of(kind, n, rng), whitening, rng.normal(size=(n, kind.n_nuisances)))


def chain_of(robot):
    return build_chain(robot, {i: i for i in range(len(robot.parameters))}).with_joint_columns()


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("kind", "convention"), diagonal(KINDS, CONVENTIONS, every=3))
def test_derivatives_are_those_of_central_differences(kind, convention):
    """In every parameter, in the joints of each end and in the nuisances, sliding joints among them."""
    rng = np.random.default_rng(CONVENTIONS.index(convention))
    robot = random_robot(convention, 5, rng)
    q, data = rng.uniform(-3, 3, (kind.ends, 5)), data_of(kind, 1, rng)
    nuisances = rng.normal(size=(1, kind.n_nuisances))
    W = np.tril(rng.normal(size=(kind.residual_dim, kind.residual_dim)))
    n_parameters = len(robot.parameters)

    def formula(x):
        T = np.array([tool_pose(robot, q, x[:n_parameters]) for q in joints_of(x)]).reshape(1, -1, 4, 4)
        at = Frames(T[:, :, :3, :3], T[:, :, :3, 3])
        return W @ kind.rows(at, data, x[None, n_parameters + q.size :]).residual[0]

    def joints_of(x):
        return x[n_parameters : n_parameters + q.size].reshape(kind.ends, 5)

    x = np.concatenate([robot.nominal, q.ravel(), nuisances.ravel()])
    trig, ends = robot.trig(q.reshape(-1, 5)), np.arange(kind.ends)[None]
    block = Block(kind, trig, ends, data, pack(W[None]), nuisances)
    r, J = residuals.linearise(block, chain_of(robot))
    size = np.abs(J).max()
    assert r[0] == pytest.approx(formula(x), abs=rounding(10.0))
    found, expected = J[0], central_differences(formula, x)
    if kind.turned_back:  # a turn of the residual by each parameter is free: it changes no length
        off = np.linalg.solve(W, formula(x))
        turned = np.linalg.solve(W, found - expected)
        assert off @ turned == pytest.approx(0.0, abs=1e-6)
        found, expected = found[:, n_parameters:], expected[:, n_parameters:]
    # Steps of 1e-6 leave third derivatives times 1e-12 and rounding over 1e-6, here of rows of size 1 to 10.
    assert found == pytest.approx(expected, abs=1e-7 * max(1.0, size))


def frames_of(n, ends, rng):
    turned = Rotation.random(max(n * ends, 1), random_state=rng.integers(1000)).as_matrix()[: n * ends]
    return Frames(turned.reshape(n, ends, 3, 3), rng.normal(size=(n, ends, 3)))


@EVERY_KIND
def test_predicted_data_leave_no_residuals(kind):
    rng = np.random.default_rng(8)
    at, nuisances = frames_of(6, kind.ends, rng), rng.normal(size=(6, kind.n_nuisances))
    data = kind.predict(at, nuisances)
    assert data.shape == (6, kind.width)
    if kind.width:  # of a contact nothing is measured: the arm is where the point is
        assert kind.rows(at, data, nuisances).residual == pytest.approx(0.0, abs=rounding(10.0))


def test_the_mirror_image_of_an_anchor_is_as_far_from_points_in_a_plane():
    rng = np.random.default_rng(10)
    points, anchor = np.column_stack([rng.normal(size=(9, 2)), np.full(9, 0.3)]), np.array([0.2, 0.1, 1.3, 0.05])
    image = AnchorDistance().mirrored(points, np.zeros((9, 1)), anchor)
    assert image == pytest.approx([0.2, 0.1, -0.7, 0.05], abs=rounding(1.0))
    assert AnchorDistance().mirrored(points[:3], np.zeros((3, 1)), anchor) is None


def test_the_mirror_image_of_a_plane_has_the_same_readings_in_the_mean():
    c, f = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
    points = np.array([[0.0, 0.0, 1.1], [1.0, 0.0, 1.3]])
    image = PlaneDistance().mirrored(points, np.array([[0.1], [0.3]]), np.concatenate([c, f]))
    there = Frames(np.tile(np.eye(3), (2, 1, 1, 1)), points[:, None])
    readings = PlaneDistance().rows(there, np.zeros((2, 1)), np.tile(image, (2, 1))).residual[:, 0]
    assert readings == pytest.approx([0.3, 0.1], abs=rounding(1.0))  # reversed, in the mean the same
    assert PlaneDistance().mirrored(points, np.zeros((2, 1)), np.concatenate([c, f])) is None


@pytest.mark.parametrize("kind", COMPILED, ids=name_of)
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_compiled_twins_compute_what_numpy_does(kind, convention):
    rng = np.random.default_rng(10 + CONVENTIONS.index(convention))
    robot = random_robot(convention, 6, rng)
    block = random_block(kind, robot, 2 * LANES + 5, rng)
    assert len(kind.twins())
    r, J = residuals.linearise(block, chain_of(robot))
    expected_r, expected_J = residuals.linearise(replace(block, kind=in_numpy(kind)), chain_of(robot))
    for found, expected in ((r, expected_r), (J, expected_J)):
        assert np.abs(found - expected).max() <= 1e-13 * np.abs(expected).max()


CAMERA = Camera(fx=900, fy=910, cx=640, cy=480, k1=-0.2, k2=0.1, p1=0.001, p2=-0.002, k3=0.01)


def seen_by_camera(n, rng):
    """Frames of a camera, points of boards, and the boards, all before the camera."""
    R = Rotation.random(n, random_state=rng.integers(1000)).as_matrix()
    p, ahead = rng.normal(size=(n, 3)), np.column_stack([0.3 * rng.normal(size=(n, 2)), rng.uniform(3, 4, n)])
    data = np.hstack([rng.uniform(0, 1000, (n, 2)), rng.uniform(-0.2, 0.2, (n, 2))])
    board = np.hstack([rng.normal(size=(n, 3)), p + (R @ ahead[:, :, None])[..., 0]])
    return Frames(R[:, None], p[:, None]), data, board


def test_pixels_have_the_derivatives_of_central_differences():
    at, data, board = seen_by_camera(40, np.random.default_rng(23))
    check_rows(Pixel(CAMERA), at, data, board, "")
    in_room = Frames(at.rotation, 0.3 * at.position + [0.0, 0.0, 4.0])
    check_rows(RoomPixel(CAMERA), in_room, data, np.zeros((40, 0)), "")


def test_a_camera_in_the_room_and_one_on_the_tool_see_the_same_board():
    at, data, board = seen_by_camera(10, np.random.default_rng(24))
    R, p = at.rotation[:, 0], at.position[:, 0]
    B, b = Rotation.from_rotvec(board[:, :3]).as_matrix(), board[:, 3:]
    camera_T_board = Frames((np.swapaxes(R, 1, 2) @ B)[:, None], np.einsum("nji,nj->ni", R, b - p)[:, None])
    on_tool = Pixel(CAMERA).rows(at, data, board).residual
    assert RoomPixel(CAMERA).rows(camera_T_board, data, np.zeros((10, 0))).residual == pytest.approx(on_tool, abs=1e-9)


def test_an_image_is_that_of_the_textbook():
    """OpenCV's model written out for one point, 3-D reconstruction section of its manual: x' = 0.1, y' = -0.2."""
    k1, k2, p1, p2, k3, r2 = -0.2, 0.1, 0.001, -0.002, 0.01, 0.05
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x = 0.1 * radial + 2 * p1 * 0.1 * -0.2 + p2 * (r2 + 2 * 0.01)
    y = -0.2 * radial + p1 * (r2 + 2 * 0.04) + 2 * p2 * 0.1 * -0.2
    assert CAMERA.image(np.array([[0.2, -0.4, 2.0]]))[0][0] == pytest.approx([900 * x + 640, 910 * y + 480])


def test_what_is_behind_a_camera_has_no_image_that_leads_anywhere():
    assert not CAMERA.image(np.array([[0.1, 0.2, -1.0]]))[1].any()


@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi - 1e-9, np.pi])
def test_orientations_in_numpy_are_right_at_no_turn_and_half_a_turn(angle):
    rng = np.random.default_rng(21)
    robot = random_robot("urdf", 4, rng)
    block = random_block(Orientation(), robot, 1, rng)
    k = rng.normal(size=3)
    at = tool_pose(robot, q := rng.uniform(-1, 1, 4))[:3, :3]
    measured = at @ Rotation.from_rotvec(angle * k / np.linalg.norm(k)).as_matrix()
    block = replace(block, trig=robot.trig(q[None]), ends=np.array([[0]]), data=measured.reshape(1, 9))
    J = residuals.linearise(block, chain_of(robot))[1]
    in_plain_numpy = residuals.linearise(replace(block, kind=in_numpy(block.kind)), chain_of(robot))[1]
    # At half a turn the axis has either sign, and its own derivative with it; rounding of the angle is over its sine.
    assert np.isfinite(J).all()
    if angle != np.pi:
        assert J == pytest.approx(in_plain_numpy, abs=rounding(J) if angle < 1.0 else 1e-6)


def test_kinds_are_equal_by_what_they_are():
    """Rows whitened anew are compared with those before: a problem is at its optimum where both are the same."""
    assert Distance() == Distance() != RotationAngle()
    assert Stacked(Distance(), RotationAngle()) == Stacked(Distance(), RotationAngle()) != Stacked(Distance())
    assert len({Distance(), Distance(), SamePoint()}) == 2


def test_pack_keeps_lower_triangles():
    W = np.tril(np.random.default_rng(22).normal(size=(4, 3, 3)))
    assert np.array_equal(unpack(pack(W), 3), W)
    assert np.array_equal(unpack(unit_whitening(2, 3), 3), np.tile(np.eye(3), (2, 1, 1)))


def test_where_nothing_is_measured_landmarks_stand_about_the_arm_as_far_away_as_they_say():
    """Frames of landmarks are a rotation vector before the place; of two coordinates there are two."""
    flat = LandmarkKind("Z", "spot", "", "", units=("m", "m"), away=1.0)
    assert flat.default_places(4, np.zeros(3), 1.0).shape == (4, 2)
    for size, away in ((3, -2.0), (6, 1.5)):
        kind = LandmarkKind("Z", "z", "", "", units=("m",) * size, away=away)
        places = kind.default_places(5, np.array([3.0, 2.0, 1.0]), 0.8)
        assert places.shape == (5, size)
        off = places[:, -3:] - [3.0, 2.0, 1.0]
        assert np.linalg.norm(off, axis=1) == pytest.approx([abs(away) * 0.8] * 5)
        assert len(np.unique(off.round(6), axis=0)) == 5
