"""Hypotheses of mistakes in the set-up of a job, each undone: units, columns, joints, frame and tool."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import combinations, permutations

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.diagnostics.nominal_residuals import Setup, nominal_residuals
from fg_calib.inputs import Booleans, Floats
from fg_calib.robot import CONVENTIONS

MAX_REACH, MIN_REACH = 50.0, 0.02
"""Reach of an arm beyond which its own lengths are taken for the mistake, [m]."""

MOTION_RAD, MOTION_M = 0.1, 0.01
"""Range of a joint's readings, below which another unit is no explanation but a joint that does not move."""

N_STILL, N_REFINED = 10, 4
"""Positions at which each joint may stand still that are tried, and rounds in which they are refined about the best."""

_UNITS = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "inches": 0.0254}
LENGTHS = {_UNITS[one] / _UNITS[other]: f"{one}, not {other}" for one, other in permutations(_UNITS, 2)}
ANGLES = {np.pi / 180.0: "deg, not rad", 180.0 / np.pi: "rad, not deg"}
"""Units that are meant by values in another, by the factor that converts them."""


class About(IntEnum):
    """The subject of a mistake, the simplest first."""

    UNIT = 0
    COLUMNS = 1
    JOINT = 2
    FRAME = 3
    TOOL = 4


@dataclass(frozen=True)
class Mistake:
    """A mistake in a set-up, undone.

    Attributes:
        about: Its subject.
        words: The end of a sentence "residuals fall if ...".
        without: The set-up with it undone.
    """

    about: About
    words: str
    without: Setup


_Found = Iterator[tuple[str, Setup]]
"""Words of a `Mistake`, and the set-up with it undone."""


def setup_hypotheses(setup: Setup) -> Iterator[Mistake]:
    """Every mistake that is known, undone in a set-up."""
    for about, hypothesis in HYPOTHESES:
        for words, without in hypothesis(setup):
            yield Mistake(about, words, without)


def _robot_in_units(setup: Setup) -> _Found:
    """Lengths of the robot, where no arm has such a size, and angles."""
    robot = setup.robot
    in_m = np.array([parameter.unit == "m" for parameter in robot.parameters])
    reach = float(np.sum(np.abs(robot.nominal[in_m])))
    far, has_angles = reach > MAX_REACH, robot.convention in CONVENTIONS and robot.nominal[~in_m].any()
    for factor, unit in LENGTHS.items() if far or 0.0 < reach < MIN_REACH else ():
        if (factor < 1.0) == far:
            yield f"the robot's lengths are in {unit}", setup.with_values(robot.nominal * np.where(in_m, factor, 1.0))
    for factor, unit in ANGLES.items() if has_angles else ():
        yield f"the robot's angles are in {unit}", setup.with_values(robot.nominal * np.where(in_m, 1.0, factor))


def _measured_in_units(setup: Setup) -> _Found:
    """Lengths and angles of the measurements."""
    m = setup.table.measurements
    pairs, groups, image, angles = m.pairs, m.groups, m.image, m.roll_pitch_yaw
    for f, unit in LENGTHS.items():
        if setup.sees_lengths:
            of_groups = groups and replace(groups, pairs=replace(groups.pairs, distance=groups.pairs.distance * f))
            of_pairs = pairs and replace(pairs, distance=pairs.distance * f)
            position, length = (None if v is None else v * f for v in (m.position, m.length))
            what = "distances" if pairs is not None or m.position is None else "x, y, z"
            without = setup.measuring(position=position, length=length, pairs=of_pairs, groups=of_groups)
            yield f"{what} are in {unit}", without
        if image is not None:
            yield f"corner_x, corner_y are in {unit}", setup.measuring(image=image * [1.0, 1.0, f, f])
    for f, unit in ANGLES.items():
        if pairs is not None and np.isfinite(pairs.angle).any():
            yield f"angles of pairs are in {unit}", setup.measuring(pairs=replace(pairs, angle=pairs.angle * f))
        if angles is not None:
            without = _rotated(setup, Rotation.from_euler("xyz", angles * f), angles * f)
            yield f"roll, pitch, yaw are in {unit}", without
        elif m.rotation is not None and setup.instrument.sees_orientation and f > 1.0:
            vector = Rotation.from_matrix(m.rotation.copy()).as_rotvec()
            yield f"rx, ry, rz are in {unit}", _rotated(setup, Rotation.from_rotvec(vector * f))


def _readings_in_units(setup: Setup) -> _Found:
    """Readings of all joints of a kind."""
    prismatic = np.array([joint.prismatic for joint in setup.robot.joints])
    yield from _in_units(setup, "readings of prismatic joints", prismatic)
    yield from _in_units(setup, "joint readings", ~prismatic)


def _in_units(setup: Setup, what: str, joints: Booleans) -> _Found:
    """Readings of some joints, which would not hardly move then."""
    q, prismatic = setup.table.measurements.readings, [joint.prismatic for joint in setup.robot.joints]
    least = np.where(prismatic, MOTION_M, MOTION_RAD)
    for factor, unit in (LENGTHS if np.any(joints & prismatic) else ANGLES).items() if joints.any() else ():
        if factor >= 1.0 or np.any((np.ptp(q, axis=0) * factor > least)[joints]):
            yield f"{what} are in {unit}", setup.measuring(readings=np.where(joints, q * factor, q))


def _inverted(setup: Setup) -> _Found:
    """Poses of the world in the tool frame instead of the tool in the world; orientations alone."""
    m = setup.table.measurements
    if m.rotation is None or m.pairs is not None:
        return
    inverse = Rotation.from_matrix(m.rotation.copy()).inv()
    if m.position is not None and setup.sees_lengths:
        measured, fixed = ("board", "camera") if setup.instrument.sees_landmarks else ("tool", "world")
        words = f"the poses are inverted ({measured}_T_{fixed} instead of {fixed}_T_{measured})"
        yield words, _rotated(setup, inverse).measuring(position=-inverse.apply(m.position.copy()))
    if setup.instrument.sees_orientation:
        yield "the orientations are inverted", _rotated(setup, inverse)


def _columns(setup: Setup) -> _Found:
    """Columns in another order, or with the other sign."""
    m, image = setup.table.measurements, setup.table.measurements.image
    if m.position is not None and m.pairs is None and setup.sees_lengths:
        for order in list(permutations(range(3)))[1:]:  # column k holds coordinate order[k]
            words = f"columns x, y, z hold {', '.join('xyz'[i] for i in order)}"
            yield words, setup.measuring(position=m.position[:, np.argsort(order)])
        for k in range(3):
            yield f"{'xyz'[k]} has the wrong sign", setup.measuring(position=m.position * (1.0 - 2.0 * np.eye(3)[k]))
    if image is not None:
        yield "columns u, v hold v, u", setup.measuring(image=image[:, [1, 0, 2, 3]])
        yield "columns corner_x, corner_y hold y, x", setup.measuring(image=image[:, [0, 1, 3, 2]])


ORIENTATIONS: dict[str, Callable[[Floats], Rotation]] = {
    "roll, pitch, yaw are rotations about the moving axes x, y, z": lambda a: Rotation.from_euler("XYZ", a),
    "columns roll, pitch, yaw hold yaw, pitch, roll": lambda a: Rotation.from_euler("ZYX", a),
    "roll, pitch, yaw are angles about the moving axes z, y, z": lambda a: Rotation.from_euler("ZYZ", a),
    "roll, pitch, yaw are a rotation vector": Rotation.from_rotvec,
}
"""Meanings of three columns that are not roll, pitch, yaw about fixed axes."""


def _orientations(setup: Setup) -> _Found:
    """A quaternion with its scalar first; three angles of another meaning."""
    m = setup.table.measurements
    if m.rotation is None or m.pairs is not None:
        return
    if m.roll_pitch_yaw is None:
        wxyz = Rotation.from_matrix(m.rotation.copy()).as_quat()
        words = "columns qx, qy, qz, qw hold w, x, y, z"
        yield words, _rotated(setup, Rotation.from_quat(np.roll(wxyz, -1, axis=1)))
        return
    for words, rotation_of in ORIENTATIONS.items():
        yield words, _rotated(setup, rotation_of(m.roll_pitch_yaw.copy()), m.roll_pitch_yaw)


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


def _joint_columns(setup: Setup) -> _Found:
    """A joint in another unit, moving the other way, or a quarter or half a turn away; columns of joints exchanged."""
    q, joints = setup.table.measurements.readings, setup.robot.joints
    n, others = len(joints), dict[str, Floats]()
    for i, only in enumerate(np.eye(n)):
        if sum(joint.prismatic == joints[i].prismatic for joint in joints) > 1:
            yield from _in_units(setup, f"readings of joint {i + 1}", only > 0.0)
        others[f"joint {i + 1} moves the other way (the sign of its readings)"] = q * (1.0 - 2.0 * only)
        for degrees in () if joints[i].prismatic else (90, -90, 180):
            others[f"the zero of joint {i + 1} is off by {degrees} deg"] = q + np.deg2rad(degrees) * only
    for i, j in combinations(range(n), 2):
        order = [j if k == i else i if k == j else k for k in range(n)]
        others[f"the readings of joints {i + 1} and {j + 1} are exchanged"] = q[:, order]
    if n > 3:
        others["the joints are in the opposite order"] = q[:, ::-1]
    for words, readings in others.items():
        yield words, setup.measuring(readings=readings)


def _frame(setup: Setup) -> _Found:
    """A measurement frame that is not the base."""
    if setup.instrument.is_pose and setup.table.frame == "known":
        words = "the measurement frame is not the base (frame: unknown)"
        yield words, replace(setup, table=replace(setup.table, frame="unknown"))


def _tool(setup: Setup) -> _Found:
    """A tool that is not where the robot's file says."""
    rotations, lengths = setup.instrument.sees_orientation, setup.sees_lengths
    point, fitted = frozenset(setup.tool[:3]), setup.fitted_tool
    if setup.tool and lengths and not point <= fitted:
        yield "the tool point is another one (estimate: [tool.x, tool.y, tool.z])", setup.with_tool(fitted | point)
    if setup.tool and rotations and setup.instrument.is_pose and not fitted & frozenset(setup.tool[3:]):
        words = "the tool frame is another one (estimate: all of tool.x ... tool.yaw)"
        yield words, setup.with_tool(frozenset(setup.tool if lengths else (*setup.tool[3:], *fitted)))


HYPOTHESES: tuple[tuple[About, Callable[[Setup], _Found]], ...] = (
    *((About.UNIT, found) for found in (_robot_in_units, _measured_in_units, _readings_in_units)),
    *((About.COLUMNS, found) for found in (_inverted, _columns, _orientations, _conventions)),
    (About.JOINT, _joint_columns),
    (About.FRAME, _frame),
    (About.TOOL, _tool),
)
"""Hypotheses by what they are about."""


def still_joints(setup: Setup) -> Iterator[Mistake]:
    """Joints whose readings change, each standing still where that explains most."""
    q, joints = setup.table.measurements.readings, setup.robot.joints
    least = [MOTION_M if joint.prismatic else MOTION_RAD for joint in joints]

    def at(i: int, position: float) -> Setup:
        return setup.measuring(readings=np.where(np.arange(len(joints)) == i, position, q))

    for i in np.flatnonzero(np.ptp(q, axis=0) > least).tolist():
        low, high = (q[:, i].min(), q[:, i].max()) if joints[i].prismatic else (-np.pi, np.pi)
        tried, step = np.linspace(low, high, N_STILL, endpoint=False), (high - low) / N_STILL
        for _ in range(N_REFINED):
            best = min(tried.tolist(), key=lambda position: _excess(at(i, position)))
            tried, step = best + np.linspace(-step, step, 5), 0.5 * step
        words = f"joint {i + 1} does not move: its readings change, but the arm does not follow"
        yield Mistake(About.JOINT, f"{words} (joint or encoder stuck)", at(i, best))


def _excess(setup: Setup) -> float:
    return max((residual.excess for residual in nominal_residuals(setup)), default=np.inf)


def _rotated(setup: Setup, rotation: Rotation, roll_pitch_yaw: Floats | None = None) -> Setup:
    """The set-up with other orientations."""
    return setup.measuring(rotation=rotation.as_matrix(), roll_pitch_yaw=roll_pitch_yaw)
