"""The robot: joints as sequences of elementary transforms, with named parameters.

Every convention (DH, Craig's modified DH, the two with Hayati's extra angle, POE, URDF) becomes the same
thing here: a list of translations along and rotations about the x, y and z axes of the moving frame.
A convention is therefore data, `CONVENTIONS`, and nothing behind this module knows one from another.
"""

import logging
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import field, replace
from enum import IntEnum
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fg_calib import inputs
from fg_calib.inputs import Floats, InputError, as_floats, check_names, checked, escaped, listed, shape_of, shown
from fg_calib.robot.rotations import rotation_of, yaw_pitch_roll

MOST_JOINTS = 200
"""The largest number of moving joints: the work grows with its third power."""

_log = logging.getLogger(__name__)


class Axis(IntEnum):
    """Elementary transform: translation along (T) or rotation about (R) one axis."""

    TX = 0
    TY = 1
    TZ = 2
    RX = 3
    RY = 4
    RZ = 5


class Scale(NamedTuple):
    """How values in an SI unit are shown: the unit, its factor and decimals; and an ordinary change, in the SI unit."""

    unit: str
    factor: float
    decimals: int
    ordinary: float = 1e-3


SCALES: Mapping[str, Scale] = {
    "m": Scale("mm", 1e3, 4),
    "rad": Scale("deg", 180.0 / np.pi, 5),
    "1": Scale("ppm", 1e6, 1),
    "px": Scale("px", 1.0, 3),
    "rad/(N m)": Scale("urad/(N m)", 1e6, 4, 1e-5),
    "rad s^2/m": Scale("urad s^2/m", 1e6, 3, 1e-4),
    "1/K": Scale("ppm/K", 1e6, 3, 1e-4),
    "rad/K": Scale("urad/K", 1e6, 3, 1e-4),
}
"""Each SI unit of a parameter or a residual, and how reports show it."""


class ParameterKind(NamedTuple):
    """Kind of parameter: its SI unit, a key of `SCALES`, and the elementary transform that it is a value of.

    An effect (see `effects`) says for itself along which axis it acts.
    """

    unit: str
    axis: Axis = Axis.RZ


_AXES = {
    **{"theta": Axis.RZ, "d": Axis.TZ, "a": Axis.TX, "alpha": Axis.RX, "beta": Axis.RY},
    **{"x": Axis.TX, "y": Axis.TY, "z": Axis.TZ, "yaw": Axis.RZ, "pitch": Axis.RY, "roll": Axis.RX},
}
"""Elementary transforms of the kinds of geometry."""

PARAMETER_KINDS: Mapping[str, ParameterKind] = {
    **{kind: ParameterKind("m" if axis < Axis.RX else "rad", axis) for kind, axis in _AXES.items()},
    **dict.fromkeys(("compliance", "bending"), ParameterKind("rad/(N m)")),
    "tilt": ParameterKind("rad"),
    "load": ParameterKind("rad s^2/m"),
    "gain": ParameterKind("1"),
    **dict.fromkeys(("sin", "cos", "backlash"), ParameterKind("rad")),
    "coupling": ParameterKind("1"),
    "expansion": ParameterKind("1/K"),
    "drift": ParameterKind("rad/K"),
    "curve": ParameterKind("rad"),
}
"""The kinds of parameters. Of those that only act together the earlier kind is kept, as in the paper."""

EFFECT_KINDS = tuple(PARAMETER_KINDS)[tuple(PARAMETER_KINDS).index("compliance") :]
"""Kinds of the parameters of what an arm does beyond its geometry."""

CONVENTIONS: Mapping[str, tuple[str, ...]] = {
    "dh": ("theta", "d", "a", "alpha"),
    "mdh": ("a", "alpha", "d", "theta"),
    "mdh-hayati": ("a", "alpha", "d", "theta", "beta"),
    "dh-hayati": ("theta", "d", "a", "alpha", "beta"),
}
"""Order of one joint's elementary transforms, left to right (`mdh-hayati`: Jia et al. 2019, Eq. 29)."""

POE = "poe"
"""The convention of screw axes, a product of exponentials: see `RobotBuilder.add_screw_joint`."""

DH_COLUMNS = ("a", "alpha", "d", "theta", "beta")
"""Order of the figures in a row of `Robot.from_dh`, whatever the convention."""

Context = Mapping[str, Floats]
"""What else was measured at configurations: the side of approach, a temperature."""

JointType = Literal["revolute", "prismatic"]

FRAME_KINDS = ("x", "y", "z", "yaw", "pitch", "roll")
"""A frame's elementary transforms, left to right: Txyz Rz(yaw) Ry(pitch) Rx(roll), as in URDF."""

SCREW_KINDS = ("x", "y", "pitch", "roll")
"""Elementary transforms of the axis of a joint of `POE`, left to right; those of a slide are the last two."""

STRAIGHT = 1e-12
"""Part of an axis along x, y or z below which it is rounding: a yaw by it would be any."""


ZEROS = "zeros"
"""Stands in `estimate` for the zero of each joint: of the arm these alone are estimated."""

MOST_ANGLE = 4.0 * np.pi
"""How large an angle of a robot in rad may be: most of those in deg are larger."""

MOST_LIMIT = 16.0 * np.pi
"""How far a joint of limited range turns at most, [rad]: limits beyond that are warned of as probably in deg."""

IN_RAD = "angles in rad, two turns at most"
"""Expected size of angles instead."""


class Parameter(inputs.Record):
    """One kinematic parameter.

    Attributes:
        name: `a3`, `theta7`, `elbow.x`, `tool.z`: its kind and a number, or a name, a dot and its kind.
        kind: `a`, `alpha`, `x`, `roll`, ...: a key of `PARAMETER_KINDS`.
        owner: 0 for the base, 1 to n for the joints, n + 1 for the tool.
        nominal: Nominal value, [m], [rad] or in the kind's unit.
        tolerance: 1-sigma prior on true minus nominal, in the same unit; None if there is none.
        estimated: Whether a calibration may change it.
    """

    name: str
    kind: str
    owner: int
    nominal: float
    tolerance: float | None = None
    estimated: bool = True

    def __post_init__(self) -> None:
        """Refuse a kind that is not known, or that the name contradicts."""
        if self.kind not in PARAMETER_KINDS or unit_of(self.name) != self.unit:
            expected = f"a name that ends in its kind, one of {', '.join(PARAMETER_KINDS)}"
            raise InputError(f"parameter {shown(self.name)}", f"kind {shown(self.kind)}", expected)

    @property
    def unit(self) -> str:
        """SI unit: `m`, `rad`, or another of `SCALES`."""
        return PARAMETER_KINDS[self.kind].unit

    def preference(self, prefer: Sequence[str]) -> int:
        """Rank in the order of keeping, 0 first: the user's choice, then base and tool, then `PARAMETER_KINDS`.

        Base and tool are estimated only where the user asks for it, and may be far from nominal.
        """
        if self.name in prefer:
            return list(prefer).index(self.name)
        of_frame = self.name.startswith(("base.", "tool."))
        return len(prefer) + (0 if of_frame else 1 + list(PARAMETER_KINDS).index(self.kind))

    @property
    def scale(self) -> float:
        """How far it may be off: the tolerance, else 1 mm, 1 mrad, or as `SCALES` says. Not for ranks: `scale_of`."""
        return self.tolerance if self.tolerance is not None else SCALES[self.unit].ordinary


class Basis(NamedTuple):
    """What an element's coefficient is multiplied by: a term of the robot's effects, by its number.

    Attributes:
        term: Number of the term, in the order of `Robot.terms`.
        joint: Index of the joint in whose reading the term has a slope; -1 for none.
    """

    term: int
    joint: int


class Term(NamedTuple):
    """One term of an effect: a coefficient times what `Effect.values` gives.

    Attributes:
        name: Name of the coefficient, `theta2.sin1`; terms of one name share it; without one it is 1.
        sigma: 1 sigma of the coefficient where no tolerance is given, in its unit.
        owner: Number of the joint that it acts at, 0 for the base.
        after: Index of the element that it follows, -1 for the start; None for what is no element (an error curve).
        axis: Axis of the elementary transform.
        sign: +1 or -1.
        joint: See `Basis`.
    """

    name: str
    sigma: float
    owner: int
    after: int | None
    axis: Axis = Axis.RZ
    sign: int = 1
    joint: int = -1


def context_at(context: Context | None, rows: inputs.Integers | slice) -> Context:
    """What else was measured at some of the configurations."""
    return {name: values[rows] for name, values in (context or {}).items()}


class Effect(ABC):
    """What an arm does beyond its geometry: a sum of terms, each a coefficient times a function of the readings."""

    def __post_init__(self) -> None:
        """Take lists for tuples: robots are keys of caches."""
        for name, value in list(vars(self).items()):
            object.__setattr__(self, name, _as_tuple(value))
        inputs.check_fields(self)

    @property
    def by_loads(self) -> bool:
        """Whether its values are loads, which depend on the robot's parameters."""
        return False

    def bound(self, robot: "Robot") -> "Effect":
        """The effect as it is on a nominal robot without effects."""
        return self

    @abstractmethod
    def terms(self, robot: "Robot") -> list[Term]:
        """The terms for a robot without effects.

        Raises:
            InputError: The robot has no such joint.
        """

    def assumed(self, known: Collection[str] = ()) -> list[str]:
        """What is taken of what it depends on besides readings, in words, but for what is known by name."""
        return []

    @abstractmethod
    def values(self, robot: "Robot", readings: Floats, context: Context, at: Floats) -> Floats:
        """Value of each term that is an element, and its slope in the reading of its joint, shape (n, n_terms, 2).

        Args:
            robot: The robot without effects.
            readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
            context: What else was measured, by name, shape (n,) or (n, n_joints) each; nan where it is unknown.
            at: Values of the terms' coefficients, shape (n_terms,).
        """

    def context(self, robot: "Robot", readings: Floats | None, read: Callable[[Sequence[str]], Floats]) -> Context:
        """What else the values depend on, for the rows of a table.

        Args:
            robot: The robot.
            readings: Joint readings in the rows' order, shape (n, n_joints), [rad] (prismatic: [m]); None if the table
                has none.
            read: Columns of the table, shape (n, k), by their names.

        Raises:
            InputError: A row has what cannot be.
        """
        return {}


class Element(inputs.Record):
    """One elementary transform of the chain.

    Its value is `constant + sign * (parameter + reading)`: the parameter at index `parameter` and the reading of
    the joint at index `joint`, where there are any. A chain that is walked against a joint's own direction has
    the sign -1 there.

    With a `basis` it is `sign * parameter * basis`, without constant and reading. Values of elements that follow each
    other on one axis add up, so a value that is a sum of coefficients times bases is such a sequence.
    """

    axis: Axis
    constant: float = 0.0
    parameter: int | None = None
    joint: int | None = None
    sign: int = 1
    basis: Basis | None = None


class Joint(inputs.Record):
    """One moving joint: its name, whether it slides, and its limits, [rad] or [m]."""

    name: str
    prismatic: bool = False
    lower: float = -np.inf
    upper: float = np.inf

    @property
    def unit(self) -> str:
        """`m` for a prismatic joint, `rad` for a revolute one."""
        return "m" if self.prismatic else "rad"


class UrdfSource(inputs.Record):
    """The URDF a robot came from, kept whole so that the calibrated one can be written into it."""

    text: str
    base_link: str
    tip_link: str


class Robot(inputs.Record):
    """A serial arm: base frame to tool frame as one sequence of elementary transforms.

    Attributes:
        name: The robot's name.
        convention: A key of `CONVENTIONS`, `poe` or `urdf`.
        joints: The moving joints in chain order.
        parameters: All named parameters: base, joints in chain order, tool.
        elements: The chain, base to tool.
        urdf: The file it was read from, for a URDF robot.
        units: Of length and angle in its robot file, in which its calibration is written.
        effects: What it does beyond its geometry; their terms are among parameters and elements.
        select_effects: Whether a calibration keeps only those for which there is evidence.
    """

    name: str
    convention: str
    joints: tuple[Joint, ...]
    parameters: tuple[Parameter, ...]
    elements: tuple[Element, ...]
    urdf: UrdfSource | None = field(default=None, repr=False)
    units: tuple[inputs.LengthUnit, inputs.AngleUnit] = field(default=("m", "rad"), repr=False, compare=False)
    effects: tuple[Effect, ...] = ()
    select_effects: bool = field(default=False, repr=False)

    from_urdf = inputs.Reader("read_urdf")

    @classmethod
    @checked
    def from_dh(
        cls,
        rows: ArrayLike,
        convention: str = "dh",
        *,
        name: str = "robot",
        types: JointType | Sequence[JointType] = "revolute",
        limits: Sequence[Sequence[float] | None] | Floats | None = None,
        names: Sequence[str] | None = None,
        base: Mapping[str, float] | ArrayLike | None = None,
        tool: Mapping[str, float] | ArrayLike | None = None,
        fixed: Sequence[str] = (),
        estimate: Sequence[str] = (),
        tolerance: Mapping[str, float] | None = None,
    ) -> "Robot":
        """A robot from a table of Denavit-Hartenberg figures, in [m] and [rad].

        Args:
            rows: a, alpha, d, theta of each joint, shape (n, 4), in this order whatever the convention; of the
                conventions with Hayati's angle also (n, 5), beta last.
            convention: A key of `CONVENTIONS`.
            name: The robot's name.
            types: `revolute` or `prismatic`, for all joints or for each.
            limits: Lower and upper of each joint, None for one without, [rad] (prismatic: [m]).
            names: Of the joints; q1, q2, ... if None.
            base: Base frame to frame 0: x y z, or x y z roll pitch yaw (as in URDF), or a matrix of shape (4, 4), or
                values by kind.
            tool: Last frame to tool frame, in the same ways: where the tool is as seen from the last frame. What a
                hand-eye calibration calls the camera in the gripper's frame, and not its inverse.
            fixed: See `RobotBuilder.build`.
            estimate: See `RobotBuilder.build`.
            tolerance: See `RobotBuilder.build`.

        Raises:
            InputError: A figure, name or shape that cannot be used; the message names the joint.
        """
        inputs.check("convention", convention, tuple(CONVENTIONS))
        five = shape_of("rows", rows, "numbers of shape (n, 4)")[1:] == (5,)
        figures = as_floats("rows", rows, "(n, 5)" if five else "(n, 4)")
        kinds = CONVENTIONS[convention]
        if figures.shape[1] > 4 and "beta" not in kinds:
            raise InputError("rows", f"shape {figures.shape}", f"(n, 4): the convention {convention} has no beta")
        angles = figures[:, [unit_of(kind) == "rad" for kind in DH_COLUMNS[: figures.shape[1]]]]
        inputs.require(np.abs(angles) <= MOST_ANGLE, "rows", angles, IN_RAD, "are they in deg?")
        builder = RobotBuilder(name, convention)
        builder.add_frame("base", frame_values("base", base), 0, False)
        for joint, row in zip(_joints(len(figures), types, limits, names), figures, strict=True):
            builder.add_convention_joint(joint, {"beta": 0.0} | dict(zip(DH_COLUMNS, row, strict=False)))
        builder.add_frame("tool", frame_values("tool", tool), len(figures) + 1, False)
        return builder.build(fixed=fixed, estimate=estimate, tolerance=tolerance)

    def __repr__(self) -> str:
        joints = ", ".join(joint.name for joint in self.joints)
        estimated = names_of(p for p in self.parameters if p.estimated)
        lines = [
            f"Robot {self.name!r}, {self.convention}, {self.n_joints} joints: {joints}",
            f"  estimated {len(estimated)} of {len(self.parameters)} parameters: {', '.join(estimated) or 'none'}",
        ]
        return "\n".join(escaped(line if len(line) <= 100 else f"{line[:96]} ...") for line in lines)

    @property
    def n_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joints)

    @cached_property
    def geometry(self) -> "Robot":
        """The robot without effects and their parameters; the others keep their places."""
        elements = tuple(e for e in self.elements if e.basis is None)
        parameters = tuple(p for p in self.parameters if p.kind not in EFFECT_KINDS)
        return replace(self, elements=elements, parameters=parameters, effects=())

    @cached_property
    def moving(self) -> list[tuple[int, Element]]:
        """Index of the element that each joint's reading moves, and the element."""
        places = {e.joint: i for i, e in enumerate(self.elements) if e.joint is not None and e.basis is None}
        return [(places[j], self.elements[places[j]]) for j in range(self.n_joints)]

    @cached_property
    def terms(self) -> tuple[tuple[Term, ...], ...]:
        """The terms that are elements, effect by effect."""
        return tuple(tuple(t for t in e.terms(self.geometry) if t.after is not None) for e in self.effects)

    @cached_property
    def loads(self) -> list[int]:
        """Indices of the parameters that loads depend on: those of the arm, and how joints give way; none without."""
        each = enumerate(self.parameters) if any(effect.by_loads for effect in self.effects) else ()
        return [i for i, p in each if p.owner <= self.n_joints and p.kind != "curve"]

    def trig(self, readings: Floats, context: Context | None = None, values: Floats | None = None) -> Floats:
        """Joint readings as the kernels take them, shape (n, n_joints + n_terms, 2).

        Cosine and sine of each revolute reading (value and 0 of a prismatic one), then value and slope of each of the
        terms of the robot's effects. Nothing else computes what an element's value takes from a configuration.

        Args:
            readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
            context: What else was measured there, by name: see `effects`.
            values: Values of the parameters, by which loads are found; nominal if None.

        Raises:
            InputError: The readings are of more or fewer joints.
        """
        expected = f"(n, {self.n_joints}) for the robot's joints"
        shape = shape_of("readings", readings, expected)
        inputs.expect(len(shape) == 2 and shape[1] == self.n_joints, "readings", f"shape {shape}", expected)
        for name, given in (context or {}).items():
            inputs.expect(len(given) == shape[0], f"context {name}", f"{len(given)} rows", f"{shape[0]}, one a row")
        prismatic = np.array([j.prismatic for j in self.joints])
        trig = np.empty((*shape, 2))
        np.cos(readings, out=trig[:, :, 0])
        np.sin(readings, out=trig[:, :, 1])
        if prismatic.any():
            trig[:, prismatic, 0], trig[:, prismatic, 1] = np.asarray(readings)[:, prismatic], 0.0
        values, parts, readings = self._nominal if values is None else values, [trig], np.asarray(readings)
        arm, names = self.geometry, names_of(self.parameters)
        loaded = arm.with_values(values[: len(arm.parameters)]) if self.loads else arm
        for effect, terms in zip(self.effects, self.terms, strict=True):
            if terms:
                at = np.array([values[names.index(t.name)] if t.name else 1.0 for t in terms])
                parts.append(effect.values(loaded if effect.by_loads else arm, readings, context or {}, at))
        return np.concatenate(parts, axis=1) if len(parts) > 1 else trig

    def with_effects(self, *effects: Effect, select: bool = False) -> "Robot":
        """Copy that does more than its geometry; each effect brings its parameters, of nominal value zero.

        Args:
            effects: The effects.
            select: Whether a calibration keeps only those for which there is evidence.

        Raises:
            InputError: A joint that there is not, or two effects with the same parameters.
        """
        inputs.expect(not self.effects, self.name, "it has effects already", "all of them together")
        for e in effects:
            inputs.expect(isinstance(e, Effect), "effects", f"found {shown(e)}", "effects, such as Harmonics([1, 2])")
        effects = tuple(effect.bound(self) for effect in effects)
        parameters, more = list(self.parameters), dict[int, list[Element]]()
        places = {p.name: i for i, p in enumerate(parameters)}
        number = 0
        for effect in effects:
            mine = set[str]()
            for t in effect.terms(self):
                if t.name in places and t.name not in mine:
                    raise InputError(self.name, f"two effects with the parameter {t.name}", "one")
                if t.name and t.name not in mine:
                    mine.add(t.name)
                    places[t.name] = len(parameters)
                    parameters.append(Parameter(t.name, kind_of(t.name), t.owner, 0.0, t.sigma))
                if t.after is not None:
                    constant = 0.0 if t.name else float(t.sign)
                    element = Element(t.axis, constant, places.get(t.name), None, t.sign, Basis(number, t.joint))
                    more.setdefault(t.after, []).append(element)
                    number += 1
        follow = (one for i, element in enumerate(self.elements) for one in (element, *more.get(i, [])))
        found = tuple(parameters), (*more.get(-1, []), *follow)
        return replace(self, parameters=found[0], elements=found[1], effects=effects, select_effects=select)

    @property
    def nominal(self) -> Floats:
        """Nominal values, shape (n_parameters,), [m] or [rad]; a new array each time."""
        return self._nominal.copy()

    @cached_property
    def _nominal(self) -> Floats:
        return np.array([p.nominal for p in self.parameters])

    @cached_property
    def zero_names(self) -> tuple[str, ...]:
        """Name of each joint's zero: theta3 or d3 where the convention has it, else `<joint>.zero`."""
        moving = {e.joint: self.parameters[e.parameter].name for e in self.elements
                  if e.joint is not None and e.parameter is not None}  # fmt: skip
        return tuple(moving.get(j, f"{joint.name}.zero") for j, joint in enumerate(self.joints))

    def own_names(self, names: Iterable[str]) -> tuple[str, ...]:
        """Names of parameters, `<joint>.zero` as the robot's own parameter is called."""
        own = {f"{joint.name}.zero": name for joint, name in zip(self.joints, self.zero_names, strict=True)}
        return tuple(own.get(name, name) if isinstance(name, str) else name for name in names)

    @property
    def estimates_zeros_freely(self) -> bool:
        """Whether of the joints zeros alone are estimated, and nothing that is estimated has a prior."""
        of_joints = {p.name for p in self.parameters if p.estimated and 1 <= p.owner <= self.n_joints}
        with_prior = any(p.tolerance is not None for p in self.parameters if p.estimated)
        return bool(of_joints) and of_joints.issubset(self.zero_names) and not with_prior

    @property
    def limits(self) -> Floats:
        """Joint limits, lower and upper, shape (n_joints, 2), [rad] or [m]."""
        return np.array([(j.lower, j.upper) for j in self.joints]).reshape(-1, 2)

    @cached_property
    def reach(self) -> float:
        """Length of the arm stretched out, base to tool, sliding joints at their limits, [m]; 1 if it has none."""
        nominal, all_limits, base, reach = self.nominal, self.limits, self.owned_by(0), 0.0
        along = np.zeros((3, 3))  # x, y, z since the last rotation: with joints at 0, at their lower and upper limits
        for element in (*self.elements, Element(Axis.RX)):
            if element.axis >= Axis.RX:
                reach += float(np.abs(along).max(axis=1).sum())
                along[:] = 0.0
            elif element.parameter not in base and element.basis is None:
                length = 0.0 if element.parameter is None else nominal[element.parameter]
                limits = np.zeros(2) if element.joint is None else all_limits[element.joint]
                ends = np.append(0.0, np.where(np.isfinite(limits), limits, 0.0))
                along[element.axis] += element.constant + element.sign * (length + ends)
        return reach or 1.0

    def scale_of(self, unit: str) -> float:
        """A change that moves the tool by about as much in either unit: 1 mrad, or what that moves at the arm's reach.

        By it lengths and angles are compared where only geometry counts, such as in a rank.
        """
        return SCALES.get(unit, SCALES["1"]).ordinary * (self.reach if unit == "m" else 1.0)

    def index(self, name: str) -> int:
        """Index of the parameter called `name`.

        Raises:
            InputError: There is no such parameter.
        """
        names = names_of(self.parameters)
        check_names(self.name, [name], names)
        return names.index(name)

    def end_of(self, owner: int) -> int:
        """How many elements come before the end of the link that joint `owner` moves (0: the base)."""

        def of_link(e: Element) -> bool:
            return e.joint == owner - 1 or (e.parameter is not None and self.parameters[e.parameter].owner == owner)

        end = max((i for i, e in enumerate(self.elements) if of_link(e)), default=-1) + 1
        if self.convention == POE and 1 <= owner <= self.n_joints:
            end += len(Axis) - 1  # back from the joint's axis to the base frame
        elif self.convention not in CONVENTIONS and owner and self.elements[end - 1].joint == owner - 1:
            end += 2  # turns back from the joint's axis
        return end

    def owned_by(self, owner: int) -> list[int]:
        """Indices of the geometric parameters of joint `owner` (0 is the base, n + 1 the tool)."""
        return [i for i, p in enumerate(self.parameters) if p.owner == owner and p.kind not in EFFECT_KINDS]

    def with_curves_held(self, values: Floats) -> "Robot":
        """Copy whose error curves are what they are in values of all parameters, and are not estimated."""
        pairs = zip(self.parameters, values.tolist(), strict=True)
        held = [replace(p, nominal=v, estimated=False) if p.kind == "curve" else p for p, v in pairs]
        return replace(self, parameters=tuple(held))

    @checked
    def with_estimated(self, names: Iterable[str]) -> "Robot":
        """Copy with just the parameters called `names` estimated.

        Raises:
            InputError: There is no such parameter.
        """
        names = (names,) if isinstance(names, str) else listed(self.name, names)
        check_names(self.name, names, names_of(self.parameters))
        wanted = set(names)
        return replace(self, parameters=tuple(replace(p, estimated=p.name in wanted) for p in self.parameters))

    @checked
    def with_values(self, values: Floats | Sequence[float]) -> "Robot":
        """Copy with other nominal values, shape (n_parameters,), [m] or [rad].

        Raises:
            InputError: There are more or fewer values than parameters.
        """
        figures, n = inputs.as_figures(self.name, values, "values of the parameters"), len(self.parameters)
        if figures.shape != (n,):
            found = f"{len(figures)} values" if figures.ndim == 1 else f"shape {figures.shape}"
            raise InputError(self.name, found, f"{n}, one a parameter")
        inputs.check_sizes(self.name, figures)
        pairs = zip(self.parameters, figures.tolist(), strict=True)
        return replace(self, parameters=tuple(p if p.nominal == v else replace(p, nominal=v) for p, v in pairs))


def _as_tuple(value: Any) -> Any:
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        return value
    return type(value)(*map(_as_tuple, value)) if hasattr(value, "_fields") else tuple(map(_as_tuple, value))


class RobotBuilder:
    """Collects elements and parameters, base to tool, while a reader walks its file."""

    @checked
    def __init__(self, name: str, convention: str) -> None:
        self._name = name
        self._convention = convention
        self._joints: list[Joint] = []
        self._parameters: list[Parameter] = []
        self._elements: list[Element] = []

    @property
    def n_joints(self) -> int:
        """Number of moving joints so far."""
        return len(self._joints)

    @checked
    def add_frame(self, prefix: str, values: Mapping[str, float], owner: int, estimated: bool) -> None:
        """Append a frame: six parameters `prefix.x` ... `prefix.yaw`; missing values are 0, [m] or [rad]."""
        for kind in FRAME_KINDS:
            self._add_parameter(f"{prefix}.{kind}", owner, values.get(kind, 0.0), estimated)

    def add_constant_frame(self, values: Mapping[str, float], *, backwards: bool = False) -> None:
        """Append a frame that has no parameters, such as a fixed joint of a URDF, or its inverse (`backwards`)."""
        elements = [Element(PARAMETER_KINDS[kind].axis, values.get(kind, 0.0)) for kind in FRAME_KINDS]
        self._elements += _inverse(elements) if backwards else elements

    @checked
    def add_convention_joint(self, joint: Joint, values: Mapping[str, float]) -> None:
        """Append a joint of one of the `CONVENTIONS`; `values` are keyed by kind, [m] or [rad].

        Before the first one goes the frame `base` if nothing else did, and `build` adds a `tool` that was left out:
        the parameters of such a robot are those that its file has.
        """
        if not self._parameters:
            self.add_frame("base", {}, 0, False)
        index = len(self._joints)
        self._joints.append(joint)
        moving = "d" if joint.prismatic else "theta"
        for kind in CONVENTIONS[self._convention]:
            self._add_parameter(f"{kind}{index + 1}", index + 1, values[kind], True, index if kind == moving else None)

    @checked
    def add_urdf_joint(
        self, joint: Joint, origin: Mapping[str, float], axis: Floats, *, backwards: bool = False, zero: bool = False
    ) -> None:
        """Append a URDF joint: its origin as six parameters, then the motion about or along `axis`.

        Args:
            joint: The moving joint.
            origin: x, y, z, roll, pitch, yaw of the joint's origin, [m] and [rad].
            axis: Unit vector in the joint's frame, shape (3,).
            backwards: Append the inverse: the chain runs from the joint's child to its parent.
            zero: Whether the zero of a joint that turns is a parameter of its own, `<joint>.zero`.
        """
        index, start = len(self._joints), len(self._elements)
        self._joints.append(joint)
        self.add_frame(joint.name, origin, index + 1, True)
        onto = _onto(axis)
        self._elements += onto
        if zero:
            self._add_parameter(f"{joint.name}.zero", index + 1, 0.0, True, index)
        else:
            self._elements.append(Element(Axis.TZ if joint.prismatic else Axis.RZ, joint=index))
        self._elements += _inverse(onto)
        if backwards:
            self._elements[start:] = _inverse(self._elements[start:])

    @checked
    def add_screw_joint(
        self, joint: Joint, axis: ArrayLike, point: ArrayLike, values: Mapping[str, float] | None = None
    ) -> None:
        """Append a joint by its axis at zero readings: C E J(q) E^-1 C^-1, which is 1 at a reading of zero.

        C brings z onto the axis, as constants. E moves the axis from there: Tx(x) Ty(y) Ry(pitch) Rx(roll) of a joint
        that turns, the rotations alone of one that slides: what there is to an axis, and no parameter for its zero.
        The arm is a product of exponentials, and its tool frame that at zero readings (Brockett 1984; Park 1994).

        Args:
            joint: The moving joint.
            axis: Direction in the frame behind `base`, shape (3,), of any length but 0.
            point: Any point on the axis, shape (3,), [m]: x and y move the axis, roll and pitch turn it there.
            values: x, y, roll and pitch, those missing 0, [m] and [rad].

        Raises:
            InputError: The axis has no length.
        """
        direction, index = as_floats("axis", axis, "(3)"), len(self._joints)
        if not (length := np.linalg.norm(direction)) > inputs.LEAST_SIZE:
            raise InputError("axis", f"found {shown(axis)}", "a direction of three numbers")
        direction = np.where(np.abs(direction) > STRAIGHT * length, direction, 0.0) / length
        if not self._parameters:
            self.add_frame("base", {}, 0, False)
        self._joints.append(joint)
        there = [*map(Element, Axis, as_floats("point", point, "(3)").tolist()), *_onto(direction)]
        kinds = SCREW_KINDS[2:] if joint.prismatic else SCREW_KINDS
        self._elements += there
        for kind in kinds:
            self._add_parameter(f"{joint.name}.{kind}", index + 1, (values or {}).get(kind, 0.0), True)
        there += self._elements[-len(kinds) :]
        self._elements += [Element(Axis.TZ if joint.prismatic else Axis.RZ, joint=index), *_inverse(there)]

    @checked
    def build(
        self,
        *,
        fixed: Sequence[str] = (),
        estimate: Sequence[str] = (),
        tolerance: Mapping[str, float] | None = None,
        urdf: UrdfSource | None = None,
        effects: Sequence[Effect] = (),
        place: str = "robot",
    ) -> Robot:
        """The finished robot.

        Args:
            fixed: Names of parameters that are known exactly.
            estimate: Names of base and tool parameters to estimate (they are fixed otherwise); with `ZEROS` zeros and
                what else is named are all that is estimated of the joints.
            tolerance: 1-sigma priors by parameter name or by kind, [m] or [rad]; the kinds `base` and `tool`
                mean the lengths of those frames.
            urdf: The source, for a URDF robot.
            effects: What the arm does beyond its geometry.
            place: File name for error messages.

        Raises:
            InputError: A name that is neither a parameter nor, for tolerances, a kind.
        """
        self._check_joints(place)
        behind = len(self._joints) + 1
        if self._convention in (*CONVENTIONS, POE) and all(p.owner != behind for p in self._parameters):
            self.add_frame("tool", {}, behind, False)
        parts = tuple(self._joints), tuple(self._parameters), tuple(self._elements)
        robot = Robot(self._name, self._convention, *parts, urdf)
        with inputs.within(f"{place}: effects"):
            robot = robot.with_effects(*effects) if effects else robot
        fixed, estimate = (robot.own_names(listed(*one)) for one in (("fixed", fixed), ("estimate", estimate)))
        if ZEROS in estimate:
            if not {*robot.zero_names} <= {*names_of(robot.parameters)}:
                raise InputError(f"{place}: estimate", "zeros", "parameters", f"{self._convention} has no joint zeros")
            estimate = tuple(name for name in estimate if name != ZEROS)
            free = {*robot.zero_names, *estimate}
            of_joints = names_of(robot.parameters[i] for owner in range(1, behind) for i in robot.owned_by(owner))
            fixed += tuple(name for name in of_joints if name not in free)
        names = {p.name for p in robot.parameters}
        if len(names) < len(robot.parameters):
            twice = next(name for name, n in Counter(names_of(robot.parameters)).items() if n > 1).rpartition(".")[0]
            hint = "base and tool are the frames before and behind the joints"
            raise InputError(place, f"two frames called {twice!r}", "different names", hint)
        for key, chosen in (("fixed", fixed), ("estimate", estimate)):
            check_names(f"{place}: {key}", chosen, names_of(robot.parameters))
        both = sorted(set(fixed) & set(estimate))
        if both:
            raise InputError(f"{place}: estimate", f"{both[0]!r} is under fixed too", "it under one of the two")
        tolerance, parameters = _checked_tolerance(tolerance or {}, robot.parameters, place), list[Parameter]()
        for p in robot.parameters:
            estimated = (p.estimated or p.name in estimate) and p.name not in fixed
            sigma = tolerance.get(p.name, tolerance.get(tolerance_kind(p) or "", p.tolerance))
            parameters.append(replace(p, estimated=estimated, tolerance=sigma))
        return replace(robot, parameters=tuple(parameters))

    def _check_joints(self, place: str) -> None:
        inputs.expect(len(self._joints) <= MOST_JOINTS, place, f"{len(self._joints)} joints", f"at most {MOST_JOINTS}")
        for joint in self._joints:
            if not joint.prismatic and np.isfinite([joint.lower, joint.upper]).all() and joint.upper > MOST_LIMIT:
                limits = f"{joint.lower:g} to {joint.upper:g} rad"
                _log.warning("%s: joint %s has limits of %s; are they in deg?", place, escaped(joint.name), limits)

    def _add_parameter(self, name: str, owner: int, nominal: float, estimated: bool, joint: int | None = None) -> None:
        kind = kind_of(name)
        parameter = Parameter(name, kind, owner, float(nominal), estimated=estimated)
        self._elements.append(Element(PARAMETER_KINDS[kind].axis, parameter=len(self._parameters), joint=joint))
        self._parameters.append(parameter)


def _checked_tolerance(tolerance: Mapping[str, float], parameters: Sequence[Parameter], place: str) -> dict[str, float]:
    """1-sigma priors by name or kind, of parameters that there are."""
    for key, figure in dict(tolerance).items():
        inputs.check_number(f"tolerance: {key}", figure, above=True)
    kinds = sorted({kind for p in parameters if (kind := tolerance_kind(p))})
    check_names(f"{place}: tolerance", tolerance, [*kinds, *names_of(parameters)], "parameter or kind")
    return dict(tolerance)


def frame_values(name: str, given: Mapping[str, float] | ArrayLike | None) -> dict[str, float]:
    """The values by kind of a frame given by kind, as x y z, as x y z roll pitch yaw, or as a matrix; zeros if None.

    Args:
        name: Its name, for messages.
        given: A mapping, or of shape (3,), (6,) or (4, 4), [m] and [rad].

    Raises:
        InputError: The frame is given as something else.
    """
    if given is None:
        return {}
    if isinstance(given, Mapping):
        check_names(name, given, FRAME_KINDS, "value")
        return _frame_in_rad(name, {k: float(as_floats(f"{name}: {k}", figure, "()")) for k, figure in given.items()})
    found = shape_of(name, given, "numbers of shape (3), (6) or (4, 4)")
    if found != (4, 4):
        shape = f"({found[0]})" if found in ((3,), (6,)) else "(3), (6) or (4, 4)"
        kinds = ("x", "y", "z", "roll", "pitch", "yaw")
        return _frame_in_rad(name, dict(zip(kinds, as_floats(name, given, shape).tolist(), strict=False)))
    matrix = as_floats(name, given, "(4, 4)")
    R = matrix[:3, :3]
    if not np.allclose(matrix[3], [0, 0, 0, 1]) or np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        raise InputError(name, "a matrix that is no pose", "a rotation, a shift, and 0 0 0 1 as the last row")
    return frame_of_matrix(matrix)


def frame_of_matrix(matrix: Floats) -> dict[str, float]:
    """x, y, z, roll, pitch, yaw of a pose, shape (4, 4), by kind, [m] and [rad]."""
    values = np.concatenate([matrix[:3, 3], yaw_pitch_roll(matrix[:3, :3])[::-1]])
    return dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), values.tolist(), strict=True))


def matrix_of_frame(values: Mapping[str, float]) -> Floats:
    """The pose, shape (4, 4), of x, y, z, roll, pitch, yaw by kind, [m] and [rad]; missing ones are 0."""
    T = np.eye(4)
    T[:3, :3] = rotation_of(*(values.get(kind, 0.0) for kind in ("yaw", "pitch", "roll")))
    T[:3, 3] = [values.get(kind, 0.0) for kind in "xyz"]
    return T


def _frame_in_rad(name: str, values: dict[str, float]) -> dict[str, float]:
    for kind in ("roll", "pitch", "yaw"):
        if abs(values.get(kind, 0.0)) > MOST_ANGLE:
            raise InputError(f"{name}: {kind}", f"found {values[kind]:g}", IN_RAD, "is it in deg?")
    return values


def _joints(
    n: int,
    types: JointType | Sequence[JointType],
    limits: Sequence[Sequence[float] | None] | Floats | None,
    names: Sequence[str] | None,
) -> list[Joint]:
    """The joints of a table of n rows, by what was given for all of them or for each."""
    inputs.expect(n, "rows", "no joints", "at least one")
    kinds = [types] * n if isinstance(types, str) else listed("types", types, "a type, or one a joint")
    ranges = [None] * n if limits is None else listed("limits", limits, "lower and upper of each joint")
    called = [f"q{i + 1}" for i in range(n)] if names is None else listed("names", names)
    for key, count in (("types", len(kinds)), ("limits", len(ranges)), ("names", len(called))):
        inputs.expect(count == n, key, f"{count} for {n} joints", "one a joint")
    joints: list[Joint] = []
    for i, (kind, given, name) in enumerate(zip(kinds, ranges, called, strict=True), start=1):
        inputs.check(f"types: joint {i}", kind, JointType)
        if not isinstance(name, str) or not name:
            raise InputError(f"names: joint {i}", f"found {shown(name)}", "a word")
        inputs.expect(name not in called[: i - 1], f"names: joint {i}", f"found {name!r}, as before", "different names")
        pair = (-np.inf, np.inf) if given is None else inputs.as_figures(f"limits: joint {i}", given, "lower and upper")
        lower, upper = pair if np.shape(pair) == (2,) else (np.nan, np.nan)
        inputs.expect(lower < upper, f"limits: joint {i}", f"found {shown(given)}", "lower below upper, or None")
        joints.append(Joint(str(name), kind == "prismatic", float(lower), float(upper)))
    return joints


def _onto(axis: Floats) -> list[Element]:
    """Rotations that turn z onto a unit vector, shape (3,): constants, so that any axis is elementary."""
    yaw, pitch = np.arctan2(axis[1], axis[0]), np.arctan2(np.hypot(axis[0], axis[1]), axis[2])
    return [Element(Axis.RZ, 0.0 if pitch == 0.0 else float(yaw)), Element(Axis.RY, float(pitch))]


def _inverse(elements: Sequence[Element]) -> list[Element]:
    """The inverse of a sequence of elementary transforms."""
    return [replace(e, constant=-e.constant, sign=-e.sign) for e in reversed(elements)]


def names_of(parameters: Iterable[Parameter]) -> list[str]:
    """The parameters' names, in order."""
    return [p.name for p in parameters]


@lru_cache(4096)
def kind_of(name: str) -> str:
    """The kind in the name of a parameter: `alpha3`, `elbow.yaw`, `theta2.sin1`, `theta2.curve[17]`, `q2.zero`."""
    kind = re.match("[a-z]+", name.rpartition(".")[2])
    found = kind.group() if kind else ""
    return {"zero": "theta"}.get(found, found)


def unit_of(name: str) -> str:
    """The SI unit of a parameter or kind by its name; `m` of `base`, `tool`, what is no kind."""
    kind = kind_of(name)
    return PARAMETER_KINDS[kind].unit if kind in PARAMETER_KINDS else "m"


def tolerance_kind(parameter: Parameter) -> str | None:
    """The key under which a tolerance by kind reaches `parameter`: `a`, `x`, `tool`; None if there is none."""
    frame = re.match(r"(base|tool)\.", parameter.name)
    if frame is None or parameter.kind not in FRAME_KINDS:
        return parameter.kind
    return frame.group(1) if parameter.unit == "m" else None
