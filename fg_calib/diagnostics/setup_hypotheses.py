"""Hypotheses of mistakes in the set-up of a job, each undone: units, columns, joints, frame and tool."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import partial
from itertools import chain, combinations, permutations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.diagnostics.nominal_residuals import Setup, nominal_residuals
from fg_calib.inputs import Booleans, Floats
from fg_calib.robot import CONVENTIONS

MAX_REACH, MIN_REACH = 50.0, 0.02
"""Reach of an arm beyond which its own lengths are taken for the mistake, [m]."""

MOTION_RAD, MOTION_M = 0.1, 0.01
"""Range of a joint's readings, below which another unit is no explanation but a joint that does not move."""

N_STILL = 10
"""Positions at which each joint may stand still that are tried first."""

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
        values: The values whose unit is wrong, which cannot be in another unit as well; empty of other mistakes.
    """

    about: About
    words: str
    without: Setup
    values: str = ""


_Found = Iterator[tuple[str, Setup]]
"""Words of a `Mistake`, and the set-up with it undone."""


def setup_hypotheses(setup: Setup) -> Iterator[Mistake]:
    """Every mistake that is known, undone in a set-up."""
    for what, units, convert in _quantities(setup):
        about = About.JOINT if what.startswith("readings of joint ") else About.UNIT
        for factor, unit in units.items():
            if (without := convert(factor)) is not None:
                yield Mistake(about, f"{what} are in {unit}", without, what)
    for about, hypotheses in HYPOTHESES.items():
        for words, without in chain.from_iterable(found(setup) for found in hypotheses):
            yield Mistake(about, words, without)


_Quantities = Iterator[tuple[str, dict[float, str], Callable[[float], Setup | None]]]
"""What may be in another unit, the units, and the set-up with it multiplied by a factor; None where that is no use."""


def _quantities(setup: Setup) -> _Quantities:
    """Lengths and angles of the robot, of the measurements and of all joints of a kind."""
    m, robot, (rotations, lengths) = setup.table.measurements, setup.robot, _sees(setup)
    image, pairs, groups, angles = m.image, m.pairs, m.groups, m.roll_pitch_yaw
    prismatic = np.array([joint.prismatic for joint in robot.joints])
    in_m = np.array([parameter.unit == "m" for parameter in robot.parameters])
    reach = float(np.sum(np.abs(robot.nominal[in_m])))
    if reach > MAX_REACH or 0.0 < reach < MIN_REACH:  # no arm has such a size
        factors = {f: unit for f, unit in LENGTHS.items() if (f < 1.0) == (reach > MAX_REACH)}
        yield "the robot's lengths", factors, lambda f: _robot(setup, np.where(in_m, robot.nominal * f, robot.nominal))
    if robot.convention in CONVENTIONS and robot.nominal[~in_m].any():
        yield "the robot's angles", ANGLES, lambda f: _robot(setup, np.where(in_m, robot.nominal, robot.nominal * f))
    if lengths:

        def scaled(f: float) -> Setup:
            of_groups = groups and replace(groups, pairs=replace(groups.pairs, distance=groups.pairs.distance * f))
            of_pairs = pairs and replace(pairs, distance=pairs.distance * f)
            position, length = (None if v is None else v * f for v in (m.position, m.length))
            return _measured(setup, position=position, length=length, pairs=of_pairs, groups=of_groups)

        yield ("distances" if pairs is not None or m.position is None else "x, y, z"), LENGTHS, scaled
    if image is not None:
        yield "corner_x, corner_y", LENGTHS, lambda f: _measured(setup, image=image * [1.0, 1.0, f, f])
    groups_of_joints = {"readings of prismatic joints": prismatic, "joint readings": ~prismatic}
    several = [i for i, kind in enumerate(prismatic) if np.sum(prismatic == kind) > 1]
    groups_of_joints |= {f"readings of joint {i + 1}": np.arange(len(prismatic)) == i for i in several}
    for what, joints in groups_of_joints.items():
        yield what, LENGTHS if prismatic[joints].any() else ANGLES, partial(_joints, setup, joints)
    if pairs is not None and np.isfinite(pairs.angle).any():
        yield "angles of pairs", ANGLES, lambda f: _measured(setup, pairs=replace(pairs, angle=pairs.angle * f))
    if angles is not None:
        yield "roll, pitch, yaw", ANGLES, lambda f: _rotated(setup, Rotation.from_euler("xyz", angles * f), angles * f)
    elif m.rotation is not None and rotations:
        vector, rad = Rotation.from_matrix(m.rotation.copy()).as_rotvec(), {180.0 / np.pi: "rad, not deg"}
        yield "rx, ry, rz", rad, lambda f: _rotated(setup, Rotation.from_rotvec(vector * f))


def _joints(setup: Setup, joints: Booleans, factor: float) -> Setup | None:
    """Some joints' readings multiplied by a factor; None where they hardly move then, or are none."""
    readings = setup.table.measurements.readings
    least = np.where([joint.prismatic for joint in setup.robot.joints], MOTION_M, MOTION_RAD)
    moves = joints.any() and (factor >= 1.0 or np.any((np.ptp(readings, axis=0) * factor > least)[joints]))
    return _measured(setup, readings=np.where(joints, readings * factor, readings)) if moves else None


def _inverted(setup: Setup) -> _Found:
    """Poses of the world in the tool frame instead of the tool in the world; orientations alone."""
    m, (rotations, lengths) = setup.table.measurements, _sees(setup)
    if m.rotation is None or m.pairs is not None:
        return
    inverse = Rotation.from_matrix(m.rotation.copy()).inv()
    if m.position is not None and lengths:
        measured, fixed = ("board", "camera") if setup.instrument.sees_landmarks else ("tool", "world")
        words = f"the poses are inverted ({measured}_T_{fixed} instead of {fixed}_T_{measured})"
        yield words, _measured(_rotated(setup, inverse), position=-inverse.apply(m.position.copy()))
    if rotations:
        yield "the orientations are inverted", _rotated(setup, inverse)


def _columns(setup: Setup) -> _Found:
    """Columns in another order, or with the other sign."""
    m, image = setup.table.measurements, setup.table.measurements.image
    if m.position is not None and m.pairs is None and _sees(setup)[1]:
        for order in list(permutations(range(3)))[1:]:  # column k holds coordinate order[k]
            words = f"columns x, y, z hold {', '.join('xyz'[i] for i in order)}"
            yield words, _measured(setup, position=m.position[:, np.argsort(order)])
        for k in range(3):
            yield f"{'xyz'[k]} has the wrong sign", _measured(setup, position=m.position * (1.0 - 2.0 * np.eye(3)[k]))
    if image is not None:
        yield "columns u, v hold v, u", _measured(setup, image=image[:, [1, 0, 2, 3]])
        yield "columns corner_x, corner_y hold y, x", _measured(setup, image=image[:, [0, 1, 3, 2]])


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
    """A joint that moves the other way, or whose zero is a quarter or half a turn away; columns of joints exchanged."""
    q, joints = setup.table.measurements.readings, setup.robot.joints
    n, others = len(joints), dict[str, Floats]()
    for i, only in enumerate(np.eye(n)):
        others[f"joint {i + 1} moves the other way (the sign of its readings)"] = q * (1.0 - 2.0 * only)
        for degrees in () if joints[i].prismatic else (90, -90, 180):
            others[f"the zero of joint {i + 1} is off by {degrees} deg"] = q + np.deg2rad(degrees) * only
    for i, j in combinations(range(n), 2):
        order = [j if k == i else i if k == j else k for k in range(n)]
        others[f"the readings of joints {i + 1} and {j + 1} are exchanged"] = q[:, order]
    if n > 3:
        others["the joints are in the opposite order"] = q[:, ::-1]
    for words, readings in others.items():
        yield words, _measured(setup, readings=readings)


def _frame(setup: Setup) -> _Found:
    """A measurement frame that is not the base."""
    if setup.instrument.is_pose and setup.table.frame == "known":
        words = "the measurement frame is not the base (frame: unknown)"
        yield words, replace(setup, table=replace(setup.table, frame="unknown"))


def _tool(setup: Setup) -> _Found:
    """A tool that is not where the robot's file says."""
    rotations, lengths = _sees(setup)
    point, fitted = frozenset(setup.tool[:3]), setup.fitted_tool
    if setup.tool and lengths and not point <= fitted:
        yield "the tool point is another one (estimate: [tool.x, tool.y, tool.z])", setup.with_tool(fitted | point)
    if setup.tool and rotations and setup.instrument.is_pose and not fitted & frozenset(setup.tool[3:]):
        words = "the tool frame is another one (estimate: all of tool.x ... tool.yaw)"
        yield words, setup.with_tool(frozenset(setup.tool if lengths else (*setup.tool[3:], *fitted)))


HYPOTHESES: dict[About, tuple[Callable[[Setup], _Found], ...]] = {
    About.COLUMNS: (_inverted, _columns, _orientations, _conventions),
    About.JOINT: (_joint_columns,),
    About.FRAME: (_frame,),
    About.TOOL: (_tool,),
}
"""Hypotheses that are no unit, by what they are about."""


def still_joints(setup: Setup) -> Iterator[Mistake]:
    """Joints whose readings change, each standing still where that explains most."""
    from scipy.optimize import minimize_scalar  # here, for it takes as long to import as a small calibration

    q, joints = setup.table.measurements.readings, setup.robot.joints
    least = [MOTION_M if joint.prismatic else MOTION_RAD for joint in joints]

    def at(i: int, position: float) -> Setup:
        return _measured(setup, readings=np.where(np.arange(len(joints)) == i, position, q))

    def excess(position: float, i: int) -> float:
        return max((residual.excess for residual in nominal_residuals(at(i, position))), default=np.inf)

    for i in np.flatnonzero(np.ptp(q, axis=0) > least).tolist():
        low, high = (float(q[:, i].min()), float(q[:, i].max())) if joints[i].prismatic else (-np.pi, np.pi)
        step = (high - low) / N_STILL
        best, position = min((excess(place, i), place) for place in np.arange(low, high, step).tolist())
        bounds = position - step, position + step
        refined = minimize_scalar(excess, bounds=bounds, args=(i,), method="bounded", options={"xatol": 0.03 * step})
        there = at(i, float(refined.x) if refined.fun < best else position)
        words = f"joint {i + 1} does not move: its readings change, but the arm does not follow"
        yield Mistake(About.JOINT, f"{words} (joint or encoder stuck)", there)


def _measured(setup: Setup, **changes: Any) -> Setup:
    """The set-up with other measurements."""
    return replace(setup, table=replace(setup.table, measurements=replace(setup.table.measurements, **changes)))


def _rotated(setup: Setup, rotation: Rotation, roll_pitch_yaw: Floats | None = None) -> Setup:
    """The set-up with other orientations."""
    return _measured(setup, rotation=rotation.as_matrix(), roll_pitch_yaw=roll_pitch_yaw)


def _robot(setup: Setup, values: Floats) -> Setup:
    """The set-up with other nominal values of the robot."""
    return replace(setup, robot=setup.robot.with_values(values))


def _sees(setup: Setup) -> tuple[bool, bool]:
    """Whether orientations and lengths are measured."""
    return setup.instrument.sees_orientation, setup.instrument.sees_position and setup.table.measurements.image is None
