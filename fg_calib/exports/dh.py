"""An arm in the tables of Denavit and Hartenberg, Craig, and Hayati, exactly where these can hold it.

A table has four figures a joint where a rigid transform has six. What makes up for it is that frames may be moved along
and turned about the z axis of their joint (`links`): between joints i and i + 1, with M what is left of the link after
the frame of joint i was moved,

    M = [Rz(theta) Tz(d)] [Tx(a) Rx(alpha)] [Tz(d') Rz(theta')]

the first bracket joins what is about joint i, and the last is carried on to joint i + 1. That is one product with six
figures, and `common_normal` solves it: x goes along the common normal of both axes, a and alpha are their distance and
angle, d and d' are where the normal meets them. DH and Craig's table differ only in the row that a and alpha stand in:
that of the joint before them, or behind them.

    z' = R e_z = Rz(theta) (0, -sin alpha, cos alpha)        theta = atan2(z'_x, -z'_y),  alpha = atan2(|z'_xy|, z'_z)
    p = d e_z + a x + d' z',   x = (cos theta, sin theta, 0), y = e_z x x:
    a = p.x,   d' = -p.y / sin alpha,   d = p.z - d' cos alpha

Exactly parallel axes have a common normal anywhere: d stays what the joint before left. But d' and d grow without bound
as axes become nearly parallel: by p.y over the angle, and a small tilt would move them by kilometres. Beyond `FARTHEST`
a table that holds the arm is none that anybody can use, and this module says so (`Nearly`) and takes the axes to be
parallel; `fits` then finds the best table of such. Hayati's row is for these: where the plane through the frame, square
to z, meets the next axis,

    M = [Rz(theta)] [Tx(a) Rx(alpha) Ry(beta)] [Tz(d') Rz(theta')]
    P = p - z' p_z / z'_z = a x,   Rz(-theta) z' = (sin beta, -sin alpha cos beta, cos alpha cos beta)

which stays well determined, and fails only for axes at right angles. Craig's row has beta before a and alpha: there x =
Rz(theta) Ry(beta) e_x goes from the frame to the nearest point of the next axis, P = p - z' (z'.p) = a x. With rows of
DH for those and Hayati's for these, every arm has a table; rows of DH have no beta, rows of Hayati no d of their own.
Both (theta, a, alpha) and (theta + pi, -a, -alpha) say the same; theta within a quarter turn is taken, as drawings have
it.

Base and tool take what is left. Before the first joint it is the base frame, unless frame 0 and the joint are such that
the first row holds it; behind the last one it is the tool, but for the d and theta of the last row.

References:
    Denavit & Hartenberg (1955), A kinematic notation for lower-pair mechanisms, J. Applied Mechanics 22.
    Craig (2005), Introduction to Robotics, 3rd ed., section 3.4.
    Hayati (1983), Robot arm geometric link parameter estimation, 22nd IEEE Conf. on Decision and Control.

Links are the rigid transforms between joints:

    base_T_tool(q) = base . L0 . J1(q1) . L1 . J2(q2) ... Jn(qn) . Ln . tool

with J(q) = Rz(q) of a revolute joint and Tz(q) of a prismatic one: each moves about, or along, the z axis of its own
frame, in the sense in which its reading grows. What commutes with J may stand before it or after it: Rz and Tz of a
revolute joint, and any translation of a prismatic one. This freedom is all there is between two descriptions of an arm.

The nearest arm of fewer values minimises the sum over configurations of `|p - p'|^2 + L^2 |log(R R'^T)|^2`, with p and
R of the arm that is fitted, p' and R' of the calibrated one, and L the arm's length.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.inputs import Floats, Record, expect, optimize
from fg_calib.robot import Axis, Element, Poses, Robot, RobotBuilder, build_chain, forward, model, pose, random_readings

TableConvention = Literal["dh", "mdh", "mdh-hayati", "dh-hayati"]

PARALLEL = 1e-11
"""Sine of the angle of axes that count as parallel: at an arm's length it moves the tool by as much, [m]."""

NEARLY_PARALLEL = 0.2
"""Sine of the angle of axes below which Hayati's row is taken where there is one."""

FARTHEST = 10.0
"""How far along an axis the next frame of a table may be, in the arm's length."""

SAME = 1e-12
"""Entries of a transform up to this count as 0, [m] and [rad]: rounding of a product is some 1e-16."""


class Nearly(Record):
    """Neighbouring axes that are too nearly parallel for a row of four figures.

    Attributes:
        axes: 1-based numbers of both joints.
        angle: Between them, [rad].
        away: How far along an axis their common normal is, [m].
    """

    axes: tuple[int, int]
    angle: float
    away: float

    def __str__(self) -> str:
        first, second = self.axes
        parallel = f"axes {first} and {second} are parallel within {np.rad2deg(self.angle):.2g} deg, not exactly"
        return f"{parallel}: their common normal is {self.away:.3g} m away"


class TableRobot(Record):
    """An arm in a table.

    Attributes:
        robot: The arm, its names and limits as they were.
        nearly: The axes that it takes to be parallel and that are not; none where it is the same arm.
    """

    robot: Robot
    nearly: tuple[Nearly, ...]


def in_table(robot: Robot, convention: TableConvention, farthest: float = FARTHEST) -> TableRobot:
    """An arm in one of the conventions with a table; as it is if it is in that one already.

    Args:
        robot: The arm, at its nominal values.
        convention: `dh`, `mdh` (Craig), `dh-hayati`, each row of which has d or beta, or `mdh-hayati`.
        farthest: How far along an axis the next frame may be, in the arm's length; infinite: as far as it must.

    Raises:
        InputError: A joint's value is more than its reading plus a constant.
    """
    links = links_of(robot)
    if robot.convention == convention != "dh-hayati":
        return TableRobot(robot, ())
    rows, base, tool, nearly = _rows(links, convention, farthest * robot.reach)
    builder = RobotBuilder(robot.name, convention)
    builder.add_frame("base", model.frame_values("base", tidy(base)), 0, False)
    for joint, row in zip(robot.joints, rows, strict=True):
        builder.add_convention_joint(joint, {"beta": 0.0} | {kind: _turn(kind, row[kind]) for kind in row})
    builder.add_frame("tool", model.frame_values("tool", tidy(tool)), robot.n_joints + 1, False)
    return TableRobot(builder.build(), nearly)


def _rows(
    links: "Links", convention: TableConvention, farthest: float
) -> tuple[list[dict[str, float]], Floats, Floats, tuple[Nearly, ...]]:
    """Rows by kind, base, tool, and the axes that are taken to be parallel."""
    n = len(links.between) - 1
    craig, hayati = convention.startswith("mdh"), convention.endswith("hayati")
    rows = [dict.fromkeys(("a", "alpha", "d", "theta"), 0.0) for _ in range(n)]
    first, carried, base = _start(links, craig)
    rows[0] |= first
    nearly: list[Nearly] = []
    for i in range(1, n):
        M = carried @ links.between[i]
        sine = float(np.hypot(M[0, 2], M[1, 2]))
        if hayati and sine < NEARLY_PARALLEL:
            row = nearest_point(M, carried[2, 3]) if craig else plane_crossing(M)
        else:
            row = common_normal(M, height=carried[2, 3])
            away = max(abs(row["d"]), abs(left_over(M, row)[2, 3]))
            if away > farthest:
                nearly.append(Nearly((i, i + 1), float(np.arcsin(sine)), away))
                row = common_normal(M, height=carried[2, 3], parallel=True)
        carried = _along_z(left_over(M, row))
        link = {kind: row.pop(kind) for kind in ("a", "alpha")}
        rows[i - 1] |= row
        rows[i if craig else i - 1] |= link
    M = carried @ links.between[n]
    row = _end(M, craig)
    rows[n - 1] |= row
    return rows, base, left_over(M, row) @ links.tool, tuple(nearly)


def common_normal(M: Floats, *, height: float = 0.0, parallel: bool = False) -> dict[str, float]:
    """theta, d, a and alpha from the z axis of a frame to that of another.

    Args:
        M: From the one frame to the other, shape (4, 4).
        height: d of parallel axes, which have common normals anywhere, [m].
        parallel: Whether to take both axes to be parallel.
    """
    (x, y, z), p = M[:3, 2], M[:3, 3]
    sine = np.hypot(x, y)
    if parallel or sine < PARALLEL:
        row = {"theta": _direction(p), "d": height, "a": np.hypot(p[0], p[1]), "alpha": 0.0 if z > 0 else np.pi}
        return _upright(row)
    theta = np.arctan2(x, -y)
    c, s = np.cos(theta), np.sin(theta)
    back = -(c * p[1] - s * p[0]) / sine  # d'
    return _upright({"theta": theta, "d": p[2] - z * back, "a": c * p[0] + s * p[1], "alpha": np.arctan2(sine, z)})


def plane_crossing(M: Floats) -> dict[str, float]:
    """theta, a, alpha and beta from the z axis of a frame to another one that is not square to it (Hayati).

    Args:
        M: From the one frame to the other, shape (4, 4).
    """
    z, p = M[:3, 2], M[:3, 3]
    P = p - z * (p[2] / z[2])
    row = _upright({"theta": _direction(P), "d": 0.0, "a": np.hypot(P[0], P[1]), "alpha": 0.0})
    x, y, z_ = transform(theta=-row["theta"])[:3, :3] @ z
    return row | {"alpha": float(np.arctan2(-y, z_)), "beta": float(np.arctan2(x, np.hypot(y, z_)))}


def nearest_point(M: Floats, height: float) -> dict[str, float]:
    """theta, d, beta, a and alpha from a point of the z axis of a frame to that of another one (Hayati, after Craig).

    Args:
        M: From the one frame to the other, shape (4, 4).
        height: d, where the point is, [m]: x goes from there to the nearest point of the other axis.
    """
    z, p = M[:3, 2], M[:3, 3] - [0.0, 0.0, height]
    P = p - z * (z @ p)
    theta = _upright({"theta": _direction(P), "a": 0.0, "alpha": 0.0})["theta"]
    turn = transform(theta=-theta)[:3, :3]
    (x, y, z_), P = turn @ z, turn @ P
    beta = float(np.arctan(x / z_))  # x square to z', also where the axes meet
    c, s = np.cos(beta), np.sin(beta)
    a, alpha = c * P[0] - s * P[2], np.arctan2(-y, s * x + c * z_)
    return {"theta": theta, "d": height, "beta": beta, "a": a, "alpha": alpha}


def left_over(M: Floats, row: Mapping[str, float]) -> Floats:
    """Remainder of a transform after a row of values, in their order, shape (4, 4)."""
    return inverse(transform(**row)) @ M


def _direction(p: Floats) -> float:
    """The angle of a point about z; 0 for one on it."""
    return float(np.arctan2(p[1], p[0])) if np.hypot(p[0], p[1]) > SAME else 0.0


def _upright(row: dict[str, float]) -> dict[str, float]:
    """An equivalent row with theta within a quarter turn of 0."""
    if np.cos(row["theta"]) < -SAME:
        row = row | {"theta": row["theta"] + np.pi, "a": -row["a"], "alpha": -row["alpha"]}
    return {kind: _turn(kind, value) for kind, value in row.items()}


def _turn(kind: str, value: float) -> float:
    """An angle within half a turn, (-pi, pi]; lengths as they are."""
    if kind not in ("theta", "alpha", "beta"):
        return float(value) + 0.0
    turned = value - 2.0 * np.pi * np.round(value / (2.0 * np.pi))
    return float(turned + 2.0 * np.pi if turned <= -np.pi + SAME else turned) + 0.0  # of two zeros the plain one


def _along_z(M: Floats) -> Floats:
    """The turn about z and the shift along z that are nearest to a transform, shape (4, 4)."""
    return transform(theta=_about_z(M), d=float(M[2, 3]))


def _about_z(M: Floats) -> float:
    """How far a transform turns about z, the rest being a turn about an axis square to it; 0 where that is any."""
    cosine, sine = M[0, 0] + M[1, 1], M[1, 0] - M[0, 1]
    return float(np.arctan2(sine, cosine)) if np.hypot(cosine, sine) > SAME else 0.0


def _start(links: "Links", craig: bool) -> tuple[dict[str, float], Floats, Floats]:
    """The a and alpha of the first row, what is carried on to its theta and d, and the base.

    Frame 0 stays where it is if the first joint is along its z axis or, in Craig's table, from there by a and alpha.
    """
    M = links.between[0]
    row = {"a": float(M[0, 3]), "alpha": float(np.arctan2(-M[1, 2], M[2, 2]))} if craig else {"a": 0.0, "alpha": 0.0}
    rest = inverse(transform(**row)) @ M
    if _is_same(rest, _along_z(rest)):
        return {kind: value if abs(value) > SAME else 0.0 for kind, value in row.items()}, _along_z(rest), links.base
    return {}, np.eye(4), links.base @ M


def _end(M: Floats, craig: bool) -> dict[str, float]:
    """The theta and d of the last row and, where nothing else is left and the row is not Craig's, a and alpha."""
    row = {"theta": _about_z(M), "d": float(M[2, 3])}
    rest = left_over(M, row)
    link = {"a": float(rest[0, 3]), "alpha": float(np.arctan2(rest[2, 1], rest[1, 1]))}
    return row | link if not craig and _is_same(rest, transform(**link)) else row


def _is_same(first: Floats, second: Floats) -> bool:
    return bool(np.abs(first - second).max() <= SAME)


def tidy(T: Floats) -> Floats:
    """A transform without what is rounding."""
    return np.eye(4) if _is_same(T, np.eye(4)) else rigid(T[:3, :3], np.where(np.abs(T[:3, 3]) > SAME, T[:3, 3], 0.0))


# --- rigid transforms between joints ----------------------------------------------------------------------------------


class Links(Record):
    """The rigid transforms of an arm, matrices of shape (4, 4), lengths in [m].

    Attributes:
        base: Base frame to frame 0.
        between: L0 to Ln: to the frame of the first joint, from each joint to the next, and on to the last frame.
        tool: Last frame to tool frame.
    """

    base: Floats
    between: tuple[Floats, ...]
    tool: Floats


def links_of(robot: Robot) -> Links:
    """The rigid transforms of a robot at its nominal values.

    Raises:
        InputError: A joint's value is more than its reading plus a constant: no other format has that.
    """
    expect(not robot.effects, robot.name, "joints with effects", "plain readings")
    base, tool = set(robot.owned_by(0)), set(robot.owned_by(robot.n_joints + 1))
    parts: list[list[Element]] = [[], [], []]  # base, what is between joints, tool; more are put before the tool
    for element in robot.elements:
        if element.parameter in base:
            parts[0].append(element)
        elif element.parameter in tool:
            parts[-1].append(element)
        elif element.joint is None:
            parts[-2].append(element)
        else:
            turned = [Element(Axis.RX, np.pi)] if element.sign < 0 else []
            parts[-2] += [replace(element, joint=None), *turned]
            parts.insert(-1, [replace(e, constant=-e.constant) for e in turned])
    matrices = [_product(robot, part) for part in parts]
    return Links(matrices[0], tuple(matrices[1:-1]), matrices[-1])


def _product(robot: Robot, elements: Sequence[Element]) -> Floats:
    """Product of elements of a robot without readings, shape (4, 4)."""
    part = replace(robot, elements=(Element(Axis.TX), *elements))  # a chain has at least one
    at = forward(build_chain(part), part.trig(np.zeros((1, robot.n_joints))))
    return rigid(at.rotation[0], at.position[0])


def rigid(rotation: Floats, position: Floats) -> Floats:
    """A rotation and a shift as one matrix, shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def inverse(T: Floats) -> Floats:
    """The inverse of a rigid transform, shape (4, 4)."""
    return rigid(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


def transform(**values: float) -> Floats:
    """Elementary transforms by kind (theta, d, a, alpha, beta), multiplied from left to right, shape (4, 4)."""
    T = np.eye(4)
    for kind, value in values.items():
        axis = model.PARAMETER_KINDS[kind].axis
        if axis < Axis.RX:
            T[:3, 3] += value * T[:3, axis]
        else:
            T[:3, :3] = T[:3, :3] @ Rotation.from_euler("xyz"[axis - Axis.RX], value).as_matrix()
    return T


# --- the nearest arm of fewer values ----------------------------------------------------------------------------------


N_FITTED, N_JUDGED = 300, 1000
"""Configurations drawn within the joint limits to fit, and others to judge by."""

HOLD = 1e-2
"""Weight of a value's change by 1 m or 1 rad against a miss of the tool by 1 m: a fit that gains hundredths of a
millimetre by values of metres is none. Of a UR10 off by 0.5 mm and 0.5 mrad, 1e-3 to 1e-1 give the same fit, 0.168 mm
RMS; 1e-4 gives 0.163 mm with d of 16 m."""


class PoseErrors(Record):
    """How far the tool of one arm is from that of another over some configurations.

    Attributes:
        position_rms: Of the tool point, [m].
        position_max: The largest, [m].
        rotation_rms: Of the angle that the tool is turned, [rad].
        rotation_max: The largest, [rad].
        n: Number of configurations.
    """

    position_rms: float
    position_max: float
    rotation_rms: float
    rotation_max: float
    n: int

    def __str__(self) -> str:
        position = f"{1e3 * self.position_rms:.4g} mm RMS, {1e3 * self.position_max:.4g} at most"
        rotation = f"{np.rad2deg(self.rotation_rms):.4g} deg RMS, {np.rad2deg(self.rotation_max):.4g} at most"
        return f"position {position}; orientation {rotation}"


def drawn(robot: Robot, n: int, seed: int) -> Floats:
    """Configurations within the joint limits, shape (n, n_joints), [rad] (prismatic: [m])."""
    return random_readings(robot, n, np.random.default_rng(seed))


def errors(found: Robot, wanted: Robot, readings: Floats, zeros: Floats | None = None) -> PoseErrors:
    """How far an arm is from another at joint readings.

    Args:
        found: The one.
        wanted: The other.
        readings: Shape (n, n_joints), [rad] (prismatic: [m]).
        zeros: Offsets of the readings of the first, shape (n_joints,).
    """
    miss = _miss(poses(found, readings if zeros is None else readings + zeros), poses(wanted, readings))
    turn, shift = (np.linalg.norm(part, axis=1) for part in (miss[:, :3], miss[:, 3:]))
    rms = [float(np.sqrt(np.mean(part**2))) for part in (shift, turn)]
    return PoseErrors(rms[0], float(shift.max()), rms[1], float(turn.max()), len(readings))


def poses(robot: Robot, readings: Floats) -> Poses:
    """Tool poses without derivatives."""
    return forward(build_chain(robot), robot.trig(readings))


def fit_zeros(nominal: Robot, calibrated: Robot, readings: Floats) -> Floats:
    """Fit offsets of the joint readings that bring the nominal arm nearest to the calibrated one.

    Where zeros act alike, such as those of two slides along one line, the least of them are taken.

    Args:
        nominal: The arm whose zeros are fitted.
        calibrated: Where the tool truly is.
        readings: To fit at, shape (n, n_joints), [rad] (prismatic: [m]).

    Returns:
        Shape (n_joints,), [rad] (prismatic: [m]).
    """
    return _fit(lambda zeros: poses(nominal, readings + zeros), np.zeros(nominal.n_joints), calibrated, readings, 0.0)


def step_zeros(nominal: Robot, calibrated: Robot, readings: Floats, zeros: Floats) -> Floats:
    """Offsets of `fit_zeros` after a step of Gauss-Newton from others: what they are of an arm a little different."""
    at, weight = pose(nominal, readings + zeros), np.repeat([calibrated.reach, 1.0], 3)
    J = weight[:, None] * at.jacobian[:, :, -nominal.n_joints :]
    miss = (weight * _miss(at, poses(calibrated, readings))).ravel()
    return zeros - np.linalg.lstsq(J.reshape(-1, nominal.n_joints), miss, rcond=None)[0]


def fit_parameters(start: Robot, calibrated: Robot, readings: Floats) -> Robot:
    """The robot of one convention that comes nearest to a calibrated one, base and tool included.

    Args:
        start: A robot of the convention, near it.
        calibrated: Where the tool truly is.
        readings: To fit at, shape (n, n_joints), [rad] (prismatic: [m]).
    """
    values = _fit(lambda x: poses(start.with_values(x), readings), start.nominal, calibrated, readings, HOLD)
    return start.with_values(values)


def _fit(predict: Callable[[Floats], Poses], start: Floats, wanted: Robot, readings: Floats, hold: float) -> Floats:
    """The values that bring predicted poses nearest to those of an arm."""
    weight, at = np.repeat([wanted.reach, 1.0], 3), poses(wanted, readings)

    def residual(x: Floats) -> Floats:
        return np.concatenate([(weight * _miss(predict(x), at)).ravel(), hold * (x - start)])

    return optimize.least_squares(residual, start, "3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200).x


def _miss(found: Poses, wanted: Poses) -> Floats:
    """Rotation vectors of R R'^T, then p - p', shape (n, 6), [rad] and [m]."""
    turn = Rotation.from_matrix(found.rotation @ np.swapaxes(wanted.rotation, 1, 2)).as_rotvec()
    return np.concatenate([turn, found.position - wanted.position], axis=1)


def with_frames_of(robot: Robot, other: Robot, owners: tuple[int, ...]) -> Robot:
    """A robot with the parameters of another that belong to some owners (0: base, n + 1: tool)."""
    values = {p.name: p.nominal for p in other.parameters if p.owner in owners}
    return replace(robot, parameters=tuple(replace(p, nominal=values.get(p.name, p.nominal)) for p in robot.parameters))
