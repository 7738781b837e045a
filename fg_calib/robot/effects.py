r"""What an arm does beyond its geometry, one class an effect: gears, encoders, gravity, temperature.

Joint i turns by q_i plus the sum of its effects; each is a coefficient, a parameter like any other, times a term:

| effect | parameters | term |
|---|---|---|
| `Gain` | theta2.gain | q_i |
| `Harmonics` | theta2.sin1, theta2.cos1 | sin(m q_i), cos(m q_i); an order m may be a gear ratio |
| `ErrorCurve` | theta2.curve[17] | periodic cubic B-splines of q_i, whose Gaussian prior is part of the model |
| `Compliance` | theta2.compliance | tau_i = sum of m g . dx/dq_i, the torque of gravity about the joint |
| | theta2.compliance_x, _y | rotations about x and y just before the joint, by the moments about these axes |
| | base.tilt_x, base.tilt_y | small angles of gravity about the base's axes |
| | theta2.load3x, load3y | free masses: tau_i of a unit first moment of link 3 along x or y, as its joint turns it |
| `Bending` | base.bending | rotation of the base by the moment of all masses about its origin |
| `Backlash` | theta2.backlash | side of approach: -1, 0 or 1 |
| `Coupling` | theta5.coupling4 | the reading of another joint |
| `Thermal` | a2.expansion, theta2.drift | length or 1, times temperature minus reference |

A joint of a URDF has its own name in place of `theta2`. Where joints give way, tau is that of the joints as they have
turned: q + k tau(q), one step of the fixed point, which leaves errors of the third order in k. Derivatives of poses
take tau as constant: in k, lengths and readings they lack k dtau, some thousandth of them.

References:
    Jia et al. (2019), section 2, for the geometry. Judd, Knasinski (1990), A technique to calibrate industrial robots
    with experimental verification. IEEE Trans. Robotics and Automation 6(1): gears. Khalil, Besnard (2002), Geometric
    calibration of robots with flexible joints and links. J. Intelligent and Robotic Systems 34.
"""

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from fg_calib.inputs import MOST_SIZE, Floats, InputError, Record, as_floats, check_names, check_number, expect, shown
from fg_calib.robot.model import CONVENTIONS, Axis, Context, Effect, Element, Joint, Parameter, Robot, Term, names_of

_log = logging.getLogger(__name__)

Joints = Literal["all"] | Sequence[int]
"""Numbers of joints from 1; all that turn, for gains all."""

LEAST_MOVE = 1e-4
"""Smallest move that takes a gear to its opposite flank, [rad]."""

LEAST_LENGTH = 0.02
"""Length that grows with temperature, [m]: shorter ones do by a micrometre, and zeros do not stay zero."""

GRAVITY = (0.0, 0.0, -9.81)
"""Of a base that stands upright, [m/s^2]."""

MOST_GRAVITY = 100.0
"""Size of no gravity that an arm works under, [m/s^2]: it is in mm/s^2."""

GUESS = "a guess, such as 5 kg each, is better than none"
"""What to do where masses are needed and not known: compliances make up for most of the error."""

MOST_TERMS = 1000
"""Highest order of a harmonic, and most knots a turn."""

MOST_KELVIN = 40.0
"""Distance of all temperatures from their reference beyond which it is asked for their unit."""


def _joints(robot: Robot, joints: Joints, what: str, *, sliding: bool = False) -> list[int]:
    """Indices of the joints: those that turn, or all of them.

    Raises:
        InputError: One is none of these.
    """
    able = [i for i, joint in enumerate(robot.joints) if sliding or not joint.prismatic]
    if joints == "all":
        return able
    numbers = [i + 1 for i in able]
    expected = f"joints{' that turn' * (not sliding)}, of {', '.join(map(str, numbers))}"
    for number in joints:
        expect(number in numbers and number is not True, f"{what}: joints", f"found {shown(number)}", expected)
    expect(0 < len({*joints}) == len(joints), f"{what}: joints", f"found {shown(joints)}", "different joints")
    return [int(number) - 1 for number in joints]


def _prefix(robot: Robot, joint: int) -> str:
    """How the names of a joint's effects begin."""
    own = "d" if robot.joints[joint].prismatic else "theta"
    return f"{own}{joint + 1}" if robot.convention in CONVENTIONS else robot.joints[joint].name


def _own(robot: Robot, joint: int, kind: str, sigma: float, slope: int | None = None) -> Term:
    """A term that turns a joint about its own axis."""
    place, e = robot.moving[joint]
    of = joint if slope is None else slope
    return Term(f"{_prefix(robot, joint)}.{kind}", sigma, joint + 1, place, e.axis, e.sign, of)


def _with_slopes(values: Floats, slopes: Floats | float = 0.0) -> Floats:
    return np.stack([values, np.broadcast_to(slopes, values.shape)], axis=2)


def _known(context: Context, name: str, default: float) -> Floats:
    """What was measured by some name, or a default for rows of which it is not known, shape (n,) or (1,)."""
    return np.where(np.isnan(given := context.get(name, np.full(1, np.nan))), default, given)


class Gain(Effect, Record):
    """An encoder or gear ratio that is slightly off: in proportion to the reading."""

    joints: Joints = "all"

    def terms(self, robot: Robot) -> list[Term]:
        return [_own(robot, i, "gain", 1e-2) for i in _joints(robot, self.joints, "gain", sliding=True)]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        return _with_slopes(readings[:, _joints(robot, self.joints, "gain", sliding=True)], 1.0)


class Harmonics(Effect, Record):
    """Eccentric encoders and gears: sine and cosine of multiples of the reading.

    Attributes:
        orders: Periods a turn; any number above 0, such as a gear ratio.
        joints: The joints.
    """

    orders: Sequence[float] = (1, 2)
    joints: Joints = "all"

    def __post_init__(self) -> None:
        super().__post_init__()
        for order in self.orders:
            check_number("orders", order, above=True, most=MOST_TERMS)
        different = 0 < len({f"{order:.9g}" for order in self.orders}) == len(self.orders)
        expect(different, "orders", f"found {shown(self.orders)}", "different numbers, such as [1, 2]")

    def terms(self, robot: Robot) -> list[Term]:
        names = [(f"{m:.9g}".replace(".", "_"), f) for m in self.orders for f in ("sin", "cos")]
        return [_own(robot, i, f"{f}{m}", 3e-3) for i in _joints(robot, self.joints, "harmonics") for m, f in names]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        orders = np.array(self.orders, dtype=np.float64)
        angle = readings[:, _joints(robot, self.joints, "harmonics"), None] * orders
        sin, cos = np.sin(angle), np.cos(angle)
        both = np.stack([sin, cos, orders * cos, -orders * sin], axis=3)  # (n, joints, orders, 4)
        return both.reshape(len(readings), -1, 2, 2).transpose(0, 1, 3, 2).reshape(len(readings), -1, 2)


class ErrorCurve(Effect, Record):
    """Whatever repeats each turn of a joint: a periodic cubic B-spline of the reading.

    Attributes:
        joints: The joints.
        knots: Coefficients a turn.
        sigma: 1 sigma of a coefficient, [rad]; estimated, one for all joints, if None.
    """

    joints: Joints = "all"
    knots: int = 144
    sigma: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("knots", self.knots, least=4.0, whole=True, most=MOST_TERMS)
        check_number("sigma", 1.0 if self.sigma is None else self.sigma, above=True)

    def terms(self, robot: Robot) -> list[Term]:
        joints, sigma = _joints(robot, self.joints, "error_curve"), self.sigma or 5e-4
        names = [(i, f"{_prefix(robot, i)}.curve[{k}]") for i in joints for k in range(self.knots)]
        return [Term(name, sigma, i + 1, None) for i, name in names]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        return np.zeros((len(readings), 0, 2))


class Hinge(NamedTuple):
    """A joint outside the chain, whose readings are the column of its name.

    Attributes:
        joint: The joint.
        link: The link that it moves.
        origin: Where it is in the frame of the link, or of the hinge, that it hangs on, shape (4, 4), [m].
        axis: Unit vector in its own frame, shape (3,).
    """

    joint: Joint
    link: str
    origin: Sequence[Sequence[float]]
    axis: Sequence[float]

    def place(self, points: Floats, context: Context) -> Floats:
        """Points that it moves, from its own frame to that of what it hangs on, shape (n, 3) or (1, 3), [m]."""
        q, T, u = _known(context, self.joint.name, 0.0)[:, None], np.array(self.origin), np.array(self.axis)
        if self.joint.prismatic:
            moved = points + q * u
        else:
            moved = np.cos(q) * points + np.sin(q) * np.cross(u, points) + (1.0 - np.cos(q)) * (points @ u)[:, None] * u
        return moved @ T[:3, :3].T + T[:3, 3]


class Mass(NamedTuple):
    """A point mass on the arm.

    Attributes:
        link: Number of the joint that moves it; 0 for the base.
        mass: [kg].
        com: Where it is in the frame behind that joint's figures (a DH frame, a URDF's link) or, with hinges, of the
            last hinge's link, [m].
        column: Column of the table that has the mass of each row instead, [kg], such as a payload that is put on.
        hinges: Joints outside the chain between the link and the mass.
    """

    link: int
    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    column: str = ""
    hinges: Sequence[Hinge] = ()

    def at(self, context: Context) -> Floats:
        """Where it is in the frame of its link, shape (n, 3) or (1, 3), [m]."""
        points = np.array([self.com])
        for hinge in self.hinges[::-1]:
            points = hinge.place(points, context)
        return points


def outside_joints(robot: Robot, least: float = 0.0) -> dict[str, Joint]:
    """The joints outside the chain that masses of at least some [kg] hang on, by their names."""
    masses = [m for effect in robot.effects for m in getattr(effect, "masses", None) or () if m.mass >= least]
    return {hinge.joint.name: hinge.joint for m in masses for hinge in m.hinges}


class _Moments:
    """Moments of gravity about the origins of some joints' frames, in these frames just before they turn."""

    def __init__(
        self, robot: Robot, readings: Floats, context: Context, gravity: Floats, masses: Sequence[Mass]
    ) -> None:
        self.robot, self.readings, self._cross = robot, readings, np.cross(np.eye(3), -gravity)
        ends = [robot.end_of(m.link) for m in masses]
        of_joints = (robot.moving[j][0] + k for j in range(robot.n_joints) for k in (0, 1))
        self._frames = _frames(robot, readings, {robot.end_of(0), *ends, *of_joints})
        frames = zip(masses, map(self._frames.__getitem__, ends), strict=True)
        at = [p + sum(x * axis for x, axis in zip(m.at(context).T, axes, strict=True)) for m, (axes, p) in frames]
        each = [_known(context, m.column, m.mass) for m in masses]
        self._masses = [(end, mass, mass * x) for end, mass, x in zip(ends, each, at, strict=True)]

    def of_masses(self, place: int, which: slice) -> Floats:
        """Of the masses beyond an element, about some axes of the frame before it, shape (n, n_axes), [N m]."""
        axes, p = self._frames[place]
        beyond = [(mass, first) for end, mass, first in self._masses if end > place]
        return self._along(axes[which], sum(first for _, first in beyond) - sum(mass for mass, _ in beyond) * p)

    def of_unit(self, place: int, joint: int, axis: int) -> Floats:
        """Of a unit first moment along an axis of the frame that a joint turns, about z, shape (n, 1), [m/s^2].

        Along the axis of a slide it is that of a unit mass, in proportion to the reading.
        """
        i, e = self.robot.moving[joint]
        u = self._frames[i + 1][0][axis] * (self.readings[:, joint] if axis == e.axis else 1.0)
        return self._along(self._frames[place][0][2:], u)

    def _along(self, axes: Sequence[Floats], first: Floats) -> Floats:
        """Moments of gravity along axes, shape (n, n_axes), of first moments, shape (3, n)."""
        moment = self._cross @ first  # first cross gravity
        return np.stack([np.sum(axis * moment, axis=0) for axis in axes], axis=1)


def _frames(robot: Robot, readings: Floats, wanted: Collection[int]) -> dict[int, tuple[list[Floats], Floats]]:
    """Axes and origin, shape (3, n) each, of the frames before some elements of a chain without effects."""
    n, nominal, found = len(readings), robot.nominal, {}
    axes, p = [np.repeat(axis[:, None], n, axis=1) for axis in np.eye(3)], np.zeros((3, n))
    for i, e in enumerate((*robot.elements, Element(Axis.TX))[: max(wanted) + 1]):
        if i in wanted:
            found[i] = axes.copy(), p
        reading = 0.0 if e.joint is None else readings[:, e.joint]
        value = e.constant + e.sign * (reading + (0.0 if e.parameter is None else nominal[e.parameter]))
        if e.joint is None and not value:
            continue
        if e.axis < Axis.RX:
            p = p + value * axes[e.axis]
        else:
            x, y = ((e.axis + k) % 3 for k in (1, 2))
            c, s = np.cos(value), np.sin(value)
            axes[x], axes[y] = c * axes[x] + s * axes[y], c * axes[y] - s * axes[x]
    return found


class _Loaded(Effect):
    """An effect of gravity on masses."""

    masses: Sequence[Mass] | None
    gravity: Sequence[float] | Literal["estimate"]

    def bound(self, robot: Robot) -> Effect:
        last, n = max((m.link for m in self.masses or ()), default=0), robot.n_joints
        expect(last <= n + 1, "masses", f"found link {last}", f"0 (the base) to {n + 1} (the tool)")
        return self

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.by_loads and self.masses is not None:
            figures = [(m.link, m.mass, *m.com) for m in self.masses]
            if not figures or np.any(as_floats("masses", figures, "(n, 5)")[:, :2] < 0.0):
                raise InputError("masses", f"found {shown(self.masses)}", "a Mass for each link, 0 kg or more")
        size = np.linalg.norm(as_floats("gravity", GRAVITY if self.gravity == "estimate" else self.gravity, "(3)"))
        expect(0.0 < size < MOST_GRAVITY, "gravity", f"found {shown(self.gravity)}", "m/s^2, such as [0, 0, -9.81]")

    def assumed(self, known: Collection[str] = ()) -> list[str]:
        words = [f"{m.column} {m.mass:g} kg" for m in self.masses or () if m.column and m.column not in known]
        outside = {hinge.joint.name for m in self.masses or () for hinge in m.hinges}
        return words + ["joints outside the chain at 0"] * (not outside <= set(known))

    def context(self, robot: Robot, readings: Floats | None, read: Callable[[Sequence[str]], Floats]) -> Context:
        masses = self.masses or ()
        found = {m.column: read([m.column])[:, 0] for m in masses if m.column}
        for name, each in found.items():
            if np.any(each < 0.0):
                raise InputError(name, f"found {np.nanmin(each):g}", "masses, 0 or above")
        return found | {h.joint.name: read([h.joint.name])[:, 0] for m in masses for h in m.hinges}


class Compliance(_Loaded, Record):
    """Joints that give way to gravity: q + k tau, k in [rad/(N m)], positive; tau where they have turned.

    Attributes:
        masses: The masses on the arm, a payload among them; None if only products of compliance and first moments of
            the links' masses can be told: one parameter each.
        joints: The joints.
        lateral: Whether joints tilt too, about the two axes across their own.
        gravity: In the base frame, shape (3,), [m/s^2]; or `estimate`: that of a base that stands upright but for two
            small angles, base.tilt_x and base.tilt_y.
    """

    masses: Sequence[Mass] | None
    joints: Joints = "all"
    lateral: bool = False
    gravity: Sequence[float] | Literal["estimate"] = GRAVITY

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.masses is None and (self.gravity == "estimate" or self.lateral):
            what = "lateral" if self.lateral else "gravity: estimate"
            raise InputError("masses", f"found free masses with {what}", f"urdf, or masses by link ({GUESS})")

    @property
    def by_loads(self) -> bool:
        return True

    def _loads(self, robot: Robot, joint: int) -> list[tuple[int, int]]:
        """Free first moments that turn a joint: number of the link from 1, and axis; none of known masses."""
        links = [] if self.masses is not None else range(joint, robot.n_joints)
        slides = [(i + 1, int(robot.moving[i][1].axis)) for i in links if i > joint and robot.joints[i].prismatic]
        return [(i + 1, axis) for i in links for axis in (0, 1)] + [one for one in slides if one[1] == Axis.TZ]

    def terms(self, robot: Robot) -> list[Term]:
        joints = _joints(robot, self.joints, "compliance")
        if self.masses is None:
            loads = [(i, link, axis) for i in joints for link, axis in self._loads(robot, i)]
            return [_own(robot, i, f"load{link}{'xyz'[axis]}", 1e-3, -1) for i, link, axis in loads]
        terms = [_own(robot, i, "compliance", 1e-4, -1) for i in joints]
        for i, axis in [(i, axis) for i in joints for axis in (Axis.RX, Axis.RY) if self.lateral]:
            name = f"{_prefix(robot, i)}.compliance_{'xy'[axis - Axis.RX]}"
            terms.append(Term(name, 1e-4, i + 1, robot.moving[i][0] - 1, axis))
        if self.gravity == "estimate":
            names = ("base.tilt_x", "base.tilt_y", "")
            terms += [t._replace(name=name, sigma=2e-2, owner=0) for t in terms for name in names]
        return terms

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        joints = _joints(robot, self.joints, "compliance")
        gravity, tilts = np.array(GRAVITY if self.gravity == "estimate" else self.gravity), np.zeros(2)
        if self.gravity == "estimate":
            tilts = at[-3:-1]
        along = gravity + np.cross([*tilts, 0.0], gravity)
        counts = [len(self._loads(robot, i)) or 1 for i in joints]
        if np.any(own := at[: sum(counts)]):  # as the joints have turned
            turns = own * self._torques(robot, readings, context, joints, along)
            readings = readings.copy()
            readings[:, joints] += np.add.reduceat(turns, np.cumsum([0, *counts[:-1]]), axis=1)
        parts = [self._moments(robot, readings, context, joints, along)]
        if self.gravity == "estimate":  # k M has the tilts' share already: tilts have its derivatives, less that share
            turned = (np.cross(e, gravity) for e in np.eye(3)[:2])
            each = [self._moments(robot, readings, context, joints, g) for g in turned]
            x, y = (at[: m.shape[1]] * m for m in each)
            parts.append(np.stack([x, y, -tilts[0] * x - tilts[1] * y], axis=2).reshape(len(x), -1))
        return _with_slopes(np.hstack(parts))

    def _moments(
        self, robot: Robot, readings: Floats, context: Context, joints: Sequence[int], gravity: Floats
    ) -> Floats:
        """Torques, and where joints tilt too the moments across their axes, shape (n, n_own + n_lateral)."""
        parts = [self._torques(robot, readings, context, joints, gravity)]
        if self.lateral and self.masses is not None:
            moments = _Moments(robot, readings, context, gravity, self.masses)
            parts += [moments.of_masses(robot.moving[i][0], slice(2)) for i in joints]
        return np.hstack(parts)

    def _torques(
        self, robot: Robot, readings: Floats, context: Context, joints: Sequence[int], gravity: Floats
    ) -> Floats:
        """Torque in each joint's own sense, of each load, shape (n, n_own), [N m] or [m/s^2]."""
        moments, columns = _Moments(robot, readings, context, gravity, self.masses or ()), list[Floats]()
        for i in joints:
            place, e = robot.moving[i]
            each = [moments.of_unit(place, link - 1, axis) for link, axis in self._loads(robot, i)]
            each = each or [moments.of_masses(place, slice(2, 3))]
            columns += [e.sign * m for m in each]
        return np.hstack(columns)


class Bending(_Loaded, Record):
    """Bending of a base or column: it turns by the moment of all masses about its origin.

    Attributes:
        masses: The masses on the arm.
        gravity: In the base frame, shape (3,), [m/s^2].
    """

    masses: Sequence[Mass]
    gravity: Sequence[float] = GRAVITY

    by_loads = Compliance.by_loads

    def terms(self, robot: Robot) -> list[Term]:
        return [Term("base.bending", 1e-4, 0, robot.end_of(0) - 1, axis) for axis in (Axis.RX, Axis.RY)]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        moments = _Moments(robot, readings, context, np.array(self.gravity), self.masses)
        return _with_slopes(moments.of_masses(robot.end_of(0), slice(2)))


def last_moves(readings: Floats) -> Floats:
    """Sign of each joint's last move before each row, 0 before the first, shape (n, n_joints)."""
    sides = np.zeros(readings.shape)
    for k, move in enumerate(np.diff(readings, axis=0)):
        sides[k + 1] = np.where(np.abs(move) < LEAST_MOVE, sides[k], np.sign(move))
    return sides


class Backlash(_Loaded, Record):
    """Half the dead zone of a gear, times the side that it lies on.

    Attributes:
        joints: The joints.
        side: `moves`: sign of the last move, by the order of rows, 0 before the first; `load`: sign of the torque of
            gravity by `masses`; else how the columns of the table begin: side for side1, side2, ...
        masses: The masses on the arm, for `load`.
        gravity: In the base frame, shape (3,), [m/s^2].
    """

    joints: Joints = "all"
    side: str = "moves"
    masses: Sequence[Mass] = ()
    gravity: Sequence[float] = GRAVITY

    @property
    def by_loads(self) -> bool:
        return self.side == "load"

    def assumed(self, known: Collection[str] = ()) -> list[str]:
        return super().assumed(known) if self.by_loads else ["no side of approach"] * (self.side not in known)

    def terms(self, robot: Robot) -> list[Term]:
        return [_own(robot, i, "backlash", 1e-3, -1) for i in _joints(robot, self.joints, "backlash")]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        joints = _joints(robot, self.joints, "backlash")
        if self.side == "load":
            of, gravity = Compliance(self.masses), np.array(self.gravity)
            return _with_slopes(np.sign(of._torques(robot, readings, context, joints, gravity)))
        return _with_slopes(np.nan_to_num(context.get(self.side, np.zeros(readings.shape))[:, joints]))

    def context(self, robot: Robot, readings: Floats | None, read: Callable[[Sequence[str]], Floats]) -> Context:
        if self.side == "load":
            return super().context(robot, readings, read)
        if self.side != "moves":
            joints = _joints(robot, self.joints, "backlash")
            given = read([f"{self.side}{i + 1}" for i in joints])
            for j, side in np.argwhere(~np.isin(given, (-1.0, 0.0, 1.0)) & np.isfinite(given))[:, ::-1][:1]:
                found = f"found {given[side, j]:g}"
                raise InputError(f"{self.side}{joints[j] + 1}", found, "sides of approach, -1, 0 or 1")
            sides = np.full((len(given), robot.n_joints), np.nan)
            sides[:, joints] = given
            return {self.side: sides}
        return {} if readings is None else {self.side: last_moves(readings)}


class Coupling(Effect, Record):
    """A joint that turns with another one, as in wrists whose gears pass through each other.

    Attributes:
        pairs: Driving joint and joint that turns with it, numbers from 1: [(4, 5)] for theta5.coupling4.
    """

    pairs: Sequence[tuple[int, int]] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = [len(pair) if isinstance(pair, tuple) else 1 for pair in {*self.pairs}]
        of_two = sizes == [2] * (len(self.pairs) or 1)
        expect(of_two, "pairs", f"found {shown(self.pairs)}", "different pairs of joints, such as [[4, 5]]")

    def _places(self, robot: Robot) -> list[list[int]]:
        return [_joints(robot, pair, "coupling", sliding=True) for pair in self.pairs]

    def terms(self, robot: Robot) -> list[Term]:
        return [_own(robot, j, f"coupling{i + 1}", 1e-2, i) for i, j in self._places(robot)]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        return _with_slopes(readings[:, [i for i, _ in self._places(robot)]], 1.0)


class Thermal(Effect, Record):
    """Links that grow and zeros that drift with a temperature.

    Attributes:
        reference: Temperature at which nominal values hold, in the unit of the column.
        lengths: Whether lengths of 2 cm or more grow: value (1 + expansion (T - reference)); or the names of those.
        zeros: Whether joint zeros drift.
        column: The column of the temperature.
    """

    reference: float = 20.0
    lengths: bool | Sequence[str] = True
    zeros: bool = False
    column: str = "temperature"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("reference", self.reference, least=-MOST_SIZE)
        if not self.lengths and not self.zeros:
            raise InputError("lengths", "neither lengths nor zeros", "one of them")

    def bound(self, robot: Robot) -> "Thermal":
        """Of the nominal arm: a calibration finds no further lengths, and loses none."""
        of_links = [p for p in robot.parameters if p.unit == "m" and 1 <= p.owner <= robot.n_joints]
        if self.lengths is not True:
            check_names("thermal: lengths", self.lengths or (), names_of(of_links), "length")
            return self
        return replace(self, lengths=tuple(p.name for p in of_links if abs(p.nominal) >= LEAST_LENGTH))

    def _lengths(self, robot: Robot) -> list[tuple[int, Element, Parameter]]:
        """Place, element and parameter of each length that grows."""
        names = self.bound(robot).lengths or ()
        of = ((i, e, robot.parameters[e.parameter]) for i, e in enumerate(robot.elements) if e.parameter is not None)
        return [(i, e, p) for i, e, p in of if p.name in names]  # type: ignore[operator]

    def assumed(self, known: Collection[str] = ()) -> list[str]:
        return [f"{self.column} {self.reference:g}"] * (self.column not in known)

    def _drifting(self, robot: Robot) -> list[int]:
        return _joints(robot, "all", "thermal") if self.zeros else []

    def terms(self, robot: Robot) -> list[Term]:
        terms = []
        for i, e, p in self._lengths(robot):
            frame, _, kind = p.name.rpartition(".")
            name = f"{frame}.expansion_{kind}" if frame else f"{kind}.expansion"
            terms.append(Term(name, 1e-4, p.owner, i, e.axis, e.sign))
        return terms + [_own(robot, i, "drift", 1e-4, -1) for i in self._drifting(robot)]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        warmer = np.nan_to_num(context.get(self.column, np.full(len(readings), self.reference)) - self.reference)
        lengths = [p.nominal for *_, p in self._lengths(robot)]
        return _with_slopes(warmer[:, None] * np.array(lengths + [1.0] * len(self._drifting(robot))))

    def context(self, robot: Robot, readings: Floats | None, read: Callable[[Sequence[str]], Floats]) -> Context:
        found = read([self.column])[:, 0]
        if np.all(np.abs(found - self.reference) > MOST_KELVIN):
            of = self.column, found[0], self.reference
            _log.warning("column %s, %g in the first row, is far from its reference, %g; are they in one unit?", *of)
        return {self.column: found}


EFFECTS: Mapping[str, type[Effect]] = {
    "error_curve": ErrorCurve,
    "compliance": Compliance,
    "base_bending": Bending,
    "harmonics": Harmonics,
    "gain": Gain,
    "backlash": Backlash,
    "coupling": Coupling,
    "thermal": Thermal,
}
"""The effects by their keys in a robot file, in the order in which `select` tries them."""
