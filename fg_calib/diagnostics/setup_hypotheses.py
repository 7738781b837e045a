"""The usual mistakes in the set-up of a job, each undone: units, columns, joints, frame and tool."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.diagnostics.nominal_residuals import residuals_of
from fg_calib.diagnostics.setup import Setup
from fg_calib.options import PAIR_MODELS, POSE_MODELS
from fg_calib.robot.model import CONVENTIONS

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

_LARGEST, _SMALLEST = 50.0, 0.02
"""Reach of an arm beyond which its own lengths are taken for the mistake, [m]."""

_LENGTHS = {
    1e-3: "mm, not m",
    1e3: "m, not mm",
    1e-2: "cm, not m",
    1e2: "m, not cm",
    1e-1: "mm, not cm",
    1e1: "cm, not mm",
    0.0254: "inches, not m",
    2.54: "inches, not cm",
    25.4: "inches, not mm",
    1.0 / 0.0254: "m, not inches",
    1.0 / 2.54: "cm, not inches",
    1.0 / 25.4: "mm, not inches",
}

STILL_TURN, STILL_SLIDE = 0.1, 0.01
"""Range of a joint's readings, [rad] and [m], below which another unit is no explanation but a joint that stands still:
nobody measures so."""

_PLACES = 10
"""Places at which each joint may stand still that are tried first."""

_WORTH = 3.0
"""Excess that is left there, over the least of all joints, up to which a joint is looked at more closely."""

_ANGLES = {np.pi / 180.0: "deg, not rad", 180.0 / np.pi: "rad, not deg"}


class About(IntEnum):
    """What a mistake is about, the simplest first."""

    UNIT = 0
    COLUMNS = 1
    JOINT = 2
    FRAME = 3
    TOOL = 4


@dataclass(frozen=True)
class Mistake:
    """A usual mistake, undone.

    Attributes:
        about: What it is about.
        words: The end of a sentence "residuals fall if ...".
        without: The set-up with it undone.
        figures: The figures that it is the unit of, which cannot be in another unit as well; empty of other mistakes.
    """

    about: About
    words: str
    without: Setup
    figures: str = ""


def usual_mistakes(setup: Setup) -> Iterator[Mistake]:
    """Every usual mistake, undone in a set-up."""
    for about, mistakes in (
        (About.UNIT, (_robot_units, _lengths, _angles)),
        (About.COLUMNS, (_inverted, _axis_orders, _image_columns, _orientation_columns, _conventions)),
        (About.JOINT, (_joint_units, _signs, _offsets, _swaps)),
        (About.FRAME, (_frame,)),
        (About.TOOL, (_tool, _targets_of_flange)),
    ):
        for mistake in mistakes:
            for words, without in mistake(setup):
                figures = words.partition(" are in ")[0] if mistake in _UNITS else ""
                yield Mistake(about, words, without, figures)


_Found = Iterator[tuple[str, Setup]]
"""Words of a `Mistake`, and the set-up with it undone."""


def _robot_units(setup: Setup) -> _Found:
    """The robot's own lengths, where no arm has such a size, and angles."""
    robot = setup.robot
    lengths = np.array([parameter.unit == "m" for parameter in robot.parameters])
    reach = float(np.sum(np.abs(robot.nominal[lengths])))
    for factor, unit in _LENGTHS.items():
        if (reach > _LARGEST and factor < 1.0) or (0.0 < reach < _SMALLEST and factor > 1.0):
            values = np.where(lengths, robot.nominal * factor, robot.nominal)
            yield f"the robot's lengths are in {unit}", replace(setup, robot=robot.with_values(values))
    for factor, unit in _ANGLES.items():
        values = np.where(lengths, robot.nominal, robot.nominal * factor)
        if robot.convention in CONVENTIONS and np.any(values != robot.nominal):
            yield f"the robot's angles are in {unit}", replace(setup, robot=robot.with_values(values))


def _lengths(setup: Setup) -> _Found:
    """Lengths measured, and readings of slides, in another unit."""
    m = setup.measurements
    slides = np.array([joint.prismatic for joint in setup.robot.joints])
    for factor, unit in _LENGTHS.items():
        if _sees(setup)[1]:
            pairs = None if m.pairs is None else replace(m.pairs, distance=m.pairs.distance * factor)
            groups, length = m.groups, None if m.length is None else m.length * factor
            if groups is not None:
                groups = replace(groups, pairs=replace(groups.pairs, distance=groups.pairs.distance * factor))
            what = "distances" if pairs is not None or m.position is None else "x, y, z"
            position = None if m.position is None else m.position * factor
            changed = _measured(setup, position=position, pairs=pairs, groups=groups, length=length)
            yield f"{what} are in {unit}", changed
        if setup.model == "pixels" and m.image is not None:
            corners = replace(m, image=m.image * [1.0, 1.0, factor, factor])
            yield f"corner_x, corner_y are in {unit}", replace(setup, measurements=corners)
        if slides.any() and _moves(setup, slides, factor):
            readings = np.where(slides, m.readings * factor, m.readings)
            yield f"readings of slides are in {unit}", _measured(setup, readings=readings)


def _angles(setup: Setup) -> _Found:
    """Joint readings, measured angles and orientations in another unit."""
    m = setup.measurements
    slides = np.array([joint.prismatic for joint in setup.robot.joints])
    for factor, unit in _ANGLES.items():
        if not slides.all() and _moves(setup, ~slides, factor):
            readings = np.where(slides, m.readings, m.readings * factor)
            yield f"joint readings are in {unit}", _measured(setup, readings=readings)
        if m.pairs is not None and np.isfinite(m.pairs.angle).any():
            pairs = replace(m.pairs, angle=m.pairs.angle * factor)
            yield f"angles of pairs are in {unit}", _measured(setup, pairs=pairs)
        if m.rotation is not None and m.roll_pitch_yaw is None and factor > 1.0 and _sees(setup)[0]:
            vector = Rotation.from_matrix(m.rotation.copy()).as_rotvec() * factor
            rotation = Rotation.from_rotvec(vector).as_matrix()
            yield f"rx, ry, rz are in {unit}", _measured(setup, rotation=rotation)
        if m.roll_pitch_yaw is not None:
            yield f"roll, pitch, yaw are in {unit}", _turned(setup, m.roll_pitch_yaw * factor)


def _joint_units(setup: Setup) -> _Found:
    """The readings of one joint in another unit than those of the others."""
    m, joints = setup.measurements, setup.robot.joints
    for i, joint in enumerate(joints):
        if sum(other.prismatic == joint.prismatic for other in joints) < 2:
            continue  # those of all its kind
        for factor, unit in (_LENGTHS if joint.prismatic else _ANGLES).items():
            if not _moves(setup, np.arange(len(joints)) == i, factor):
                continue
            readings = m.readings * np.where(np.arange(len(joints)) == i, factor, 1.0)
            yield f"readings of joint {i + 1} are in {unit}", _measured(setup, readings=readings)


def _moves(setup: Setup, joints: Booleans, factor: float) -> bool:
    """Whether some of the joints still move if their readings are multiplied by a factor: else it but nulls them."""
    least = np.where([joint.prismatic for joint in setup.robot.joints], STILL_SLIDE, STILL_TURN)
    return factor >= 1.0 or bool(np.any((np.ptp(setup.measurements.readings, axis=0) * factor > least)[joints]))


def still_joints(setup: Setup) -> Iterator[Mistake]:
    """Joints whose readings change, each standing still where that explains most; those that explain least left out."""
    from scipy.optimize import minimize_scalar  # here, for it takes as long to import as a small calibration

    joints = [i for i, extent in enumerate(np.ptp(setup.measurements.readings, axis=0)) if extent > _still(setup, i)]
    tried = {i: [(_left_still(setup, i, place), place) for place in _places(setup, i)] for i in joints}
    least = min((min(found)[0] for found in tried.values()), default=np.inf)
    for i, found in tried.items():
        best, place = min(found)
        if best > _WORTH * least:
            continue
        (_, first), (_, second), *_ = found
        step = second - first
        refined = minimize_scalar(
            lambda at, i=i: _left_still(setup, i, at),
            bounds=(place - step, place + step),
            method="bounded",
            options={"xatol": 0.03 * step},
        )
        words = (
            f"joint {i + 1} does not move: its readings change, but the arm does not follow (joint or encoder stuck)"
        )
        at = float(refined.x) if refined.fun < best else place
        yield Mistake(About.JOINT, words, _standing(setup, i, at))


def _still(setup: Setup, i: int) -> float:
    """Range of a joint's readings below which it stands still by what they say, [rad] or [m]."""
    return STILL_SLIDE if setup.robot.joints[i].prismatic else STILL_TURN


def _places(setup: Setup, i: int) -> Floats:
    """Places where a joint may stand still, evenly spaced over its readings' range or a turn."""
    q = setup.measurements.readings[:, i]
    if setup.robot.joints[i].prismatic:
        return np.linspace(np.min(q), np.max(q), _PLACES)
    return np.linspace(-np.pi, np.pi, _PLACES, endpoint=False)


def _standing(setup: Setup, i: int, place: float) -> Setup:
    """The set-up with a joint that stands still."""
    readings = setup.measurements.readings.copy()
    readings[:, i] = place
    return _measured(setup, readings=readings)


def _left_still(setup: Setup, i: int, place: float) -> float:
    """The excess that is left if a joint stands still there."""
    residuals = residuals_of(_standing(setup, i, place))
    return max((residual.excess for residual in residuals), default=np.inf)


_UNITS = (_robot_units, _lengths, _angles, _joint_units)


def _inverted(setup: Setup) -> _Found:
    """Poses of the world in the tool frame instead of the tool in the world; orientations alone."""
    m = setup.measurements
    if m.rotation is None or m.pairs is not None:
        return
    inverse = np.swapaxes(m.rotation, 1, 2)
    sees_turns, sees_lengths = _sees(setup)
    if m.position is not None and sees_lengths:
        position = -np.einsum("nij,nj->ni", inverse, m.position)
        of_board = setup.model == "board"
        which = "board_T_camera instead of camera_T_board" if of_board else "tool_T_world instead of world_T_tool"
        words = f"the poses are inverted ({which})"
        yield words, _measured(setup, rotation=inverse, position=position)
    if sees_turns:
        yield "the orientations are inverted", _measured(setup, rotation=inverse)


def _axis_orders(setup: Setup) -> _Found:
    """Columns x, y, z in another order, or one of them with the other sign."""
    m = setup.measurements
    if m.position is None or m.pairs is not None or not _sees(setup)[1]:
        return
    for order in list(permutations(range(3)))[1:]:
        # Column k holds coordinate order[k].
        words = f"columns x, y, z hold {', '.join('xyz'[i] for i in order)}"
        yield words, _measured(setup, position=m.position[:, np.argsort(order)])
    for k in range(3):
        position = m.position * np.where(np.arange(3) == k, -1.0, 1.0)
        yield f"{'xyz'[k]} has the wrong sign", _measured(setup, position=position)


def _image_columns(setup: Setup) -> _Found:
    """Columns of an image, or of its corners, exchanged."""
    image = setup.measurements.image
    if setup.model == "pixels" and image is not None:
        yield "columns u, v hold v, u", _measured(setup, image=image[:, [1, 0, 2, 3]])
        yield "columns corner_x, corner_y hold y, x", _measured(setup, image=image[:, [0, 1, 3, 2]])


def _orientation_columns(setup: Setup) -> _Found:
    """A quaternion with its scalar first; three angles that are not roll, pitch, yaw about fixed axes."""
    m = setup.measurements
    if m.rotation is None or m.pairs is not None:
        return
    if m.roll_pitch_yaw is None:
        wxyz = Rotation.from_matrix(m.rotation.copy()).as_quat()
        rotation = Rotation.from_quat(np.roll(wxyz, -1, axis=1)).as_matrix()
        yield "columns qx, qy, qz, qw hold w, x, y, z", _measured(setup, rotation=rotation)
        return
    angles = m.roll_pitch_yaw.copy()
    for words, turned in (
        ("roll, pitch, yaw turn about the moving axes x, y, z", Rotation.from_euler("XYZ", angles)),
        ("columns roll, pitch, yaw hold yaw, pitch, roll", Rotation.from_euler("ZYX", angles)),
        ("roll, pitch, yaw are angles about the moving axes z, y, z", Rotation.from_euler("ZYZ", angles)),
        ("roll, pitch, yaw are a rotation vector", Rotation.from_rotvec(angles)),
    ):
        yield words, _measured(setup, rotation=turned.as_matrix())


def _conventions(setup: Setup) -> _Found:
    """Parameters of the other Denavit-Hartenberg convention."""
    robot = setup.robot
    if robot.convention not in CONVENTIONS:
        return
    other = robot.convention[1:] if robot.convention.startswith("m") else f"m{robot.convention}"
    order = {kind: place for place, kind in enumerate(CONVENTIONS[other])}
    owned = [robot.parameters[e.parameter] for e in robot.elements if e.parameter is not None]
    places = [(p.owner, order.get(p.kind, i)) for i, p in enumerate(owned)]  # frames stay as they are
    elements = tuple(robot.elements[i] for i in sorted(range(len(places)), key=lambda i: places[i]))
    words = f"the robot's convention is {other}, not {robot.convention}"
    yield words, replace(setup, robot=replace(robot, convention=other, elements=elements))


def _signs(setup: Setup) -> _Found:
    """A joint that turns or slides the other way."""
    m = setup.measurements
    for i, joint in enumerate(setup.robot.joints):
        readings = m.readings * np.where(np.arange(m.readings.shape[1]) == i, -1.0, 1.0)
        moves = "slides" if joint.prismatic else "turns"
        yield f"joint {i + 1} {moves} the other way (the sign of its readings)", _measured(setup, readings=readings)


def _offsets(setup: Setup) -> _Found:
    """A joint whose zero is a quarter or half a turn away."""
    m = setup.measurements
    for i, joint in enumerate(setup.robot.joints):
        for degrees in (90, -90, 180):
            if not joint.prismatic:
                readings = m.readings + np.where(np.arange(m.readings.shape[1]) == i, np.deg2rad(degrees), 0.0)
                yield f"the zero of joint {i + 1} is off by {degrees} deg", _measured(setup, readings=readings)


def _swaps(setup: Setup) -> _Found:
    """The readings of two joints exchanged, or of all in the opposite order."""
    m, joints = setup.measurements, setup.robot.joints
    for i, j in combinations(range(len(joints)), 2):
        order = np.arange(len(joints))
        order[[i, j]] = j, i
        words = f"the readings of joints {i + 1} and {j + 1} are exchanged"
        yield words, _measured(setup, readings=m.readings[:, order])
    if len(joints) > 3:
        yield "the joints are in the opposite order", _measured(setup, readings=m.readings[:, ::-1])


def _frame(setup: Setup) -> _Found:
    """A measurement frame that is not the base."""
    if setup.model in POSE_MODELS and not setup.frame:
        yield "the measurement frame is not the base (frame: unknown)", replace(setup, frame=True)


def _tool(setup: Setup) -> _Found:
    """A tool that is not where the robot's file says."""
    sees_turns, sees_lengths = _sees(setup)
    point = np.ones(3, dtype=np.bool_)
    if sees_lengths and not setup.tool_translation.all():
        words = "the tool point is another one (estimate: [tool.x, tool.y, tool.z])"
        yield words, replace(setup, tool_translation=point)
    if sees_turns and setup.model in POSE_MODELS and not setup.tool_rotation:
        words = "the tool frame is another one (estimate: all of tool.x ... tool.yaw)"
        free = point if sees_lengths else setup.tool_translation
        yield words, replace(setup, tool_rotation=True, tool_translation=free)


def _targets_of_flange(setup: Setup) -> _Found:
    """Known targets whose coordinates are those in the flange's frame, not the tool's; or the other way."""
    table, robot = setup.table, setup.robot
    tool = robot.owned_by(robot.n_joints + 1)
    if table is None or setup.model not in POSE_MODELS or not table.known or not tool or setup.tool_rotation:
        return
    x, y, z, yaw, pitch, roll = robot.nominal[tool]
    R, t = Rotation.from_euler("xyz", [roll, pitch, yaw]), np.array([x, y, z])
    if np.any(t) or R.magnitude() > 0.0:
        known = {name: replace(point, xyz=R.inv().apply(point.xyz - t)) for name, point in table.known.items()}
        words = "the targets' coordinates are in the frame of the flange, not of the tool"
        yield words, replace(setup, table=replace(table, known=known))


def _measured(setup: Setup, **changes: object) -> Setup:
    """The set-up with other measurements."""
    return replace(setup, measurements=replace(setup.measurements, **changes))  # type: ignore[arg-type]


def _sees(setup: Setup) -> tuple[bool, bool]:
    """Whether the model uses turns and lengths."""
    if setup.model in POSE_MODELS:
        return POSE_MODELS[setup.model]
    if setup.model not in PAIR_MODELS:
        return setup.model == "board", setup.model != "pixels"
    with_distance, with_angle = PAIR_MODELS[setup.model]
    return with_angle, with_distance


def _turned(setup: Setup, roll_pitch_yaw: Floats) -> Setup:
    rotation = Rotation.from_euler("xyz", roll_pitch_yaw).as_matrix()
    return _measured(setup, rotation=rotation, roll_pitch_yaw=roll_pitch_yaw)
