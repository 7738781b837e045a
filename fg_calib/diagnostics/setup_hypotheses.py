"""Hypotheses of mistakes in the set-up of a job, each undone: units, columns, joints, frame and tool."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import combinations, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.diagnostics.nominal_residuals import Setup, nominal_residuals
from fg_calib.options import PAIR_MODELS, POSE_MODELS
from fg_calib.robot.model import CONVENTIONS

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

MAX_REACH, MIN_REACH = 50.0, 0.02
"""Reach of an arm beyond which its own lengths are taken for the mistake, [m]."""

MOTION_RAD, MOTION_M = 0.1, 0.01
"""Range of a joint's readings, below which another unit is no explanation but a joint that does not move."""

N_STILL, STILL_EXCESS_RATIO = 10, 3.0
"""Positions at which each joint may stand still that are tried first, and excess left there over the least of all
joints, up to which a joint is looked at more closely."""

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
    for what, factors, convert in (*_quantities(setup), *_quantities_of_joints(setup)):
        for factor, unit in factors.items():
            without = convert(factor)
            if without is not None:
                about = About.JOINT if what.startswith("readings of joint ") else About.UNIT
                yield Mistake(about, f"{what} are in {unit}", without, what)
    for about, hypotheses in HYPOTHESES:
        for words, without in hypotheses(setup):
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
    if setup.table.model == "pixels" and image is not None:
        yield "corner_x, corner_y", LENGTHS, lambda f: _measured(setup, image=image * [1.0, 1.0, f, f])
    yield "readings of prismatic joints", LENGTHS, lambda f: _joints(setup, prismatic, f)
    yield "joint readings", ANGLES, lambda f: _joints(setup, ~prismatic, f)
    if pairs is not None and np.isfinite(pairs.angle).any():
        yield "angles of pairs", ANGLES, lambda f: _measured(setup, pairs=replace(pairs, angle=pairs.angle * f))
    if angles is not None:
        yield "roll, pitch, yaw", ANGLES, lambda f: _rotated(setup, Rotation.from_euler("xyz", angles * f), angles * f)
    elif m.rotation is not None and rotations:
        vector, rad = Rotation.from_matrix(m.rotation.copy()).as_rotvec(), {180.0 / np.pi: "rad, not deg"}
        yield "rx, ry, rz", rad, lambda f: _rotated(setup, Rotation.from_rotvec(vector * f))


def _quantities_of_joints(setup: Setup) -> _Quantities:
    """The readings of one joint; where it is the only one of its kind, they are those of all."""
    prismatic = [joint.prismatic for joint in setup.robot.joints]
    for i, slides in enumerate(prismatic):
        if prismatic.count(slides) > 1:
            only, units = np.arange(len(prismatic)) == i, LENGTHS if slides else ANGLES
            yield f"readings of joint {i + 1}", units, lambda f, only=only: _joints(setup, only, f)  # type: ignore[misc]


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
        of_board = setup.table.model == "board"
        which = "board_T_camera instead of camera_T_board" if of_board else "tool_T_world instead of world_T_tool"
        inverted = _measured(_rotated(setup, inverse), position=-inverse.apply(m.position.copy()))
        yield f"the poses are inverted ({which})", inverted
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
    if setup.table.model == "pixels" and image is not None:
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


def _signs_and_zeros(setup: Setup) -> _Found:
    """A joint that moves the other way, or whose zero is a quarter or half a turn away."""
    q, joints = setup.table.measurements.readings, setup.robot.joints
    for i, joint in enumerate(joints):
        only = np.arange(len(joints)) == i
        words = f"joint {i + 1} moves the other way (the sign of its readings)"
        yield words, _measured(setup, readings=np.where(only, -q, q))
        for degrees in () if joint.prismatic else (90, -90, 180):
            words = f"the zero of joint {i + 1} is off by {degrees} deg"
            yield words, _measured(setup, readings=q + np.deg2rad(degrees) * only)


def _swaps(setup: Setup) -> _Found:
    """The readings of two joints exchanged, or of all in the opposite order."""
    q, n = setup.table.measurements.readings, setup.robot.n_joints
    for i, j in combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        yield f"the readings of joints {i + 1} and {j + 1} are exchanged", _measured(setup, readings=q[:, order])
    if n > 3:
        yield "the joints are in the opposite order", _measured(setup, readings=q[:, ::-1])


def _frame(setup: Setup) -> _Found:
    """A measurement frame that is not the base."""
    if setup.table.model in POSE_MODELS and setup.table.frame == "known":
        words = "the measurement frame is not the base (frame: unknown)"
        yield words, replace(setup, table=replace(setup.table, frame="unknown"))


def _tool(setup: Setup) -> _Found:
    """A tool that is not where the robot's file says; targets whose coordinates are in the frame of the flange."""
    rotations, lengths = _sees(setup)
    rotations = rotations and setup.table.model in POSE_MODELS
    point, fitted = frozenset(setup.tool[:3]), setup.fitted_tool
    if setup.tool and lengths and not point <= fitted:
        yield "the tool point is another one (estimate: [tool.x, tool.y, tool.z])", setup.with_tool(fitted | point)
    if setup.tool and rotations and not fitted & frozenset(setup.tool[3:]):
        words = "the tool frame is another one (estimate: all of tool.x ... tool.yaw)"
        yield words, setup.with_tool(frozenset(setup.tool if lengths else (*setup.tool[3:], *fitted)))
    known = setup.table.known
    if not known or not setup.tool or fitted & frozenset(setup.tool[3:]) or setup.table.model not in POSE_MODELS:
        return
    x, y, z, yaw, pitch, roll = setup.robot.nominal[setup.robot.owned_by(setup.robot.n_joints + 1)]
    R, t = Rotation.from_euler("xyz", [roll, pitch, yaw]), np.array([x, y, z])
    if np.any(t) or R.magnitude() > 0.0:
        moved = {name: replace(point, xyz=R.inv().apply(point.xyz - t)) for name, point in known.items()}
        words = "the targets' coordinates are in the frame of the flange, not of the tool"
        yield words, replace(setup, table=replace(setup.table, known=moved))


HYPOTHESES: tuple[tuple[About, Callable[[Setup], _Found]], ...] = (
    (About.COLUMNS, _inverted),
    (About.COLUMNS, _columns),
    (About.COLUMNS, _orientations),
    (About.COLUMNS, _conventions),
    (About.JOINT, _signs_and_zeros),
    (About.JOINT, _swaps),
    (About.FRAME, _frame),
    (About.TOOL, _tool),
)
"""Hypotheses that are no unit, by what they are about."""


def still_joints(setup: Setup) -> Iterator[Mistake]:
    """Joints whose readings change, each standing still where that explains most; those that explain least left out."""
    from scipy.optimize import minimize_scalar  # here, for it takes as long to import as a small calibration

    q, joints = setup.table.measurements.readings, setup.robot.joints
    least = [MOTION_M if joint.prismatic else MOTION_RAD for joint in joints]
    moving = np.flatnonzero(np.ptp(q, axis=0) > least).tolist()

    def at(i: int, position: float) -> Setup:
        return _measured(setup, readings=np.where(np.arange(len(joints)) == i, position, q))

    def excess(position: float, i: int) -> float:
        return max((residual.excess for residual in nominal_residuals(at(i, position))), default=np.inf)

    turn = np.linspace(-np.pi, np.pi, N_STILL, endpoint=False)
    places = {i: np.linspace(q[:, i].min(), q[:, i].max(), N_STILL) if joints[i].prismatic else turn for i in moving}
    tried = {i: [(excess(position, i), position) for position in places[i]] for i in moving}
    smallest = min((min(found)[0] for found in tried.values()), default=np.inf)
    for i, found in tried.items():
        best, position = min(found)
        if best <= STILL_EXCESS_RATIO * smallest:
            step = float(places[i][1] - places[i][0])
            refined = minimize_scalar(
                lambda position, i=i: excess(position, i),
                bounds=(position - step, position + step),
                method="bounded",
                options={"xatol": 0.03 * step},
            )
            words = f"joint {i + 1} does not move: its readings change, but the arm does not follow"
            there = at(i, float(refined.x) if refined.fun < best else position)
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
    """Whether the model uses orientations and lengths."""
    model = setup.table.model
    if model in POSE_MODELS:
        return POSE_MODELS[model]
    if model in PAIR_MODELS:
        with_distance, with_angle = PAIR_MODELS[model]
        return with_angle, with_distance
    return model == "board", model != "pixels"
