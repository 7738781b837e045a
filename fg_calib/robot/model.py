"""The robot: joints as sequences of elementary transforms, with named parameters.

Every convention (DH, Craig's modified DH, the two with Hayati's extra angle, URDF) becomes the same
thing here: a list of translations along and rotations about the x, y and z axes of the moving frame.
A convention is therefore data, `CONVENTIONS`, and nothing behind this module knows one from another.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import InputError
from fg_calib.options import NEAR, check_names, did_you_mean, known_names

Floats = NDArray[np.float64]


class Axis(IntEnum):
    """What an elementary transform does: translate along (T) or rotate about (R) one axis."""

    TX = 0
    TY = 1
    TZ = 2
    RX = 3
    RY = 4
    RZ = 5


AXIS_OF_KIND: Mapping[str, Axis] = {
    **{"a": Axis.TX, "alpha": Axis.RX, "d": Axis.TZ, "theta": Axis.RZ, "beta": Axis.RY},
    **{"x": Axis.TX, "y": Axis.TY, "z": Axis.TZ},
    **{"roll": Axis.RX, "pitch": Axis.RY, "yaw": Axis.RZ},
}
"""The elementary transform that a kind of parameter is the value of."""

CONVENTIONS: Mapping[str, tuple[str, ...]] = {
    "dh": ("theta", "d", "a", "alpha"),
    "mdh": ("a", "alpha", "d", "theta"),
    "mdh-hayati": ("a", "alpha", "d", "theta", "beta"),
    "dh-hayati": ("theta", "d", "a", "alpha", "beta"),
}
"""Order of one joint's elementary transforms, left to right (`mdh-hayati`: Jia et al. 2019, Eq. 29)."""

FRAME_KINDS = ("x", "y", "z", "yaw", "pitch", "roll")
"""A frame's elementary transforms, left to right: Txyz Rz(yaw) Ry(pitch) Rx(roll), as in URDF."""


@dataclass(frozen=True)
class Parameter:
    """One kinematic parameter.

    Attributes:
        name: `a3`, `theta7`, `elbow.x`, `tool.z`.
        kind: `a`, `alpha`, `x`, `roll`, ...: a key of `AXIS_OF_KIND`.
        owner: 0 for the base, 1 to n for the joints, n + 1 for the tool.
        nominal: Nominal value, [m] or [rad].
        tolerance: 1-sigma prior on true minus nominal, [m] or [rad]; None if there is none.
        estimated: Whether a calibration may change it.
    """

    name: str
    kind: str
    owner: int
    nominal: float
    tolerance: float | None = None
    estimated: bool = True

    @property
    def axis(self) -> Axis:
        """The elementary transform that this parameter is the value of."""
        return AXIS_OF_KIND[self.kind]

    @property
    def unit(self) -> str:
        """`m` or `rad`."""
        return "m" if self.axis < Axis.RX else "rad"

    @property
    def scale(self) -> float:
        """How far it may be off: the tolerance, else 1 mm or 1 mrad, [m] or [rad]. Not for ranks: see `scale_of`."""
        return self.tolerance if self.tolerance is not None else 1e-3


@dataclass(frozen=True)
class Element:
    """One elementary transform of the chain.

    Its value is `constant + sign * (parameter + reading)`: the parameter at index `parameter` and the reading of
    the joint at index `joint`, where there are any. A chain that is walked against a joint's own direction has
    the sign -1 there.
    """

    axis: Axis
    constant: float = 0.0
    parameter: int | None = None
    joint: int | None = None
    sign: int = 1


@dataclass(frozen=True)
class Joint:
    """One moving joint: its name, whether it slides, and its limits, [rad] or [m]."""

    name: str
    prismatic: bool = False
    lower: float = -np.inf
    upper: float = np.inf

    @property
    def unit(self) -> str:
        """`m` for a prismatic joint, `rad` for a revolute one."""
        return "m" if self.prismatic else "rad"


@dataclass(frozen=True)
class UrdfSource:
    """The URDF a robot came from, kept whole so that the calibrated one can be written into it."""

    text: str
    base_link: str
    tip_link: str


@dataclass(frozen=True)
class Robot:
    """A serial arm: base frame to tool frame as one sequence of elementary transforms.

    Attributes:
        name: The robot's name.
        convention: A key of `CONVENTIONS`, or `urdf`.
        joints: The moving joints in chain order.
        parameters: All named parameters: base, joints in chain order, tool.
        elements: The chain, base to tool.
        urdf: The file it was read from, for a URDF robot.
    """

    name: str
    convention: str
    joints: tuple[Joint, ...]
    parameters: tuple[Parameter, ...]
    elements: tuple[Element, ...]
    urdf: UrdfSource | None = field(default=None, repr=False)

    @property
    def n_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joints)

    @property
    def nominal(self) -> Floats:
        """Nominal values, shape (n_parameters,), [m] or [rad]."""
        return np.array([p.nominal for p in self.parameters])

    @property
    def limits(self) -> Floats:
        """Joint limits, lower and upper, shape (n_joints, 2), [rad] or [m]."""
        return np.array([(j.lower, j.upper) for j in self.joints]).reshape(-1, 2)

    @property
    def reach(self) -> float:
        """Length of the arm stretched out, base to tool, sliding joints at their limits, [m]; 1 if it has none."""
        nominal, all_limits, base, reach = self.nominal, self.limits, self.owned_by(0), 0.0
        for element in self.elements:
            if element.axis >= Axis.RX or element.parameter in base:
                continue
            length = element.constant + (0.0 if element.parameter is None else nominal[element.parameter])
            limits = np.zeros(0) if element.joint is None else all_limits[element.joint]
            reach += float(np.max(np.abs(length + limits[np.isfinite(limits)]), initial=abs(length)))
        return reach or 1.0

    def scale_of(self, unit: str) -> float:
        """A change that moves the tool by about as much in either unit: 1 mrad, or what that moves at the arm's reach.

        By it lengths and angles are compared where only geometry counts, such as in a rank; [m] and [rad].
        """
        return 1e-3 * (self.reach if unit == "m" else 1.0)

    def index(self, name: str) -> int:
        """Index of the parameter called `name`.

        Raises:
            InputError: There is no such parameter.
        """
        for i, parameter in enumerate(self.parameters):
            if parameter.name == name:
                return i
        names = names_of(self.parameters)
        raise InputError(self.name, f"no parameter {name!r}", known_names(names), did_you_mean(name, names, NEAR))

    def owned_by(self, owner: int) -> list[int]:
        """Indices of the parameters of joint `owner` (0 is the base, n + 1 the tool)."""
        return [i for i, p in enumerate(self.parameters) if p.owner == owner]

    def with_estimated(self, names: Iterable[str]) -> Robot:
        """The same robot with just the parameters called `names` estimated.

        Raises:
            InputError: There is no such parameter.
        """
        wanted = set(names)
        check_names(self.name, sorted(wanted), names_of(self.parameters))
        return replace(self, parameters=tuple(replace(p, estimated=p.name in wanted) for p in self.parameters))

    def with_values(self, values: Floats | Sequence[float]) -> Robot:
        """The same robot with other nominal values, shape (n_parameters,), [m] or [rad].

        Raises:
            InputError: There are more or fewer values than parameters.
        """
        if len(values) != len(self.parameters):
            raise InputError(self.name, f"{len(values)} values", f"{len(self.parameters)}, one a parameter")
        changed = (replace(p, nominal=float(v)) for p, v in zip(self.parameters, values, strict=True))
        return replace(self, parameters=tuple(changed))


class RobotBuilder:
    """Collects elements and parameters, base to tool, while a reader walks its file."""

    def __init__(self, name: str, convention: str) -> None:
        self._name = name
        self._convention = convention
        self._joints: list[Joint] = []
        self._parameters: list[Parameter] = []
        self._elements: list[Element] = []

    def add_frame(self, prefix: str, values: Mapping[str, float], owner: int, estimated: bool) -> None:
        """Append a frame: six parameters `prefix.x` ... `prefix.yaw`; missing values are 0, [m] or [rad]."""
        for kind in FRAME_KINDS:
            self._add_parameter(f"{prefix}.{kind}", kind, owner, values.get(kind, 0.0), estimated)

    def add_constant_frame(self, values: Mapping[str, float], *, backwards: bool = False) -> None:
        """Append a frame that has no parameters, such as a fixed joint of a URDF, or its inverse (`backwards`)."""
        elements = [Element(AXIS_OF_KIND[kind], values.get(kind, 0.0)) for kind in FRAME_KINDS]
        self._elements += _inverse(elements) if backwards else elements

    def add_convention_joint(self, joint: Joint, values: Mapping[str, float]) -> None:
        """Append a joint of one of the `CONVENTIONS`; `values` are keyed by kind, [m] or [rad]."""
        index = len(self._joints)
        self._joints.append(joint)
        moving = "d" if joint.prismatic else "theta"
        for kind in CONVENTIONS[self._convention]:
            self._add_parameter(
                f"{kind}{index + 1}", kind, index + 1, values[kind], True, index if kind == moving else None
            )

    def add_urdf_joint(
        self, joint: Joint, origin: Mapping[str, float], axis: Floats, *, backwards: bool = False
    ) -> None:
        """Append a URDF joint: its origin as six parameters, then the motion about or along `axis`.

        Args:
            joint: The moving joint.
            origin: x, y, z, roll, pitch, yaw of the joint's origin, [m] and [rad].
            axis: Unit vector in the joint's frame, shape (3,).
            backwards: Append the inverse: the chain runs from the joint's child to its parent.
        """
        index, start = len(self._joints), len(self._elements)
        self._joints.append(joint)
        self.add_frame(joint.name, origin, index + 1, True)
        # Turn z onto the axis, move about z, turn back: constants, so that any axis is elementary.
        yaw, pitch = np.arctan2(axis[1], axis[0]), np.arctan2(np.hypot(axis[0], axis[1]), axis[2])
        if pitch == 0.0:
            yaw = 0.0
        self._elements += [
            Element(Axis.RZ, yaw),
            Element(Axis.RY, pitch),
            Element(Axis.TZ if joint.prismatic else Axis.RZ, joint=index),
            Element(Axis.RY, -pitch),
            Element(Axis.RZ, -yaw),
        ]
        if backwards:
            self._elements[start:] = _inverse(self._elements[start:])

    def build(
        self,
        *,
        fixed: Sequence[str] = (),
        estimate: Sequence[str] = (),
        tolerance: Mapping[str, float] | None = None,
        urdf: UrdfSource | None = None,
        place: str = "robot",
    ) -> Robot:
        """The finished robot.

        Args:
            fixed: Names of parameters that are known exactly.
            estimate: Names of base and tool parameters to estimate (they are fixed otherwise).
            tolerance: 1-sigma priors by parameter name or by kind, [m] or [rad]; the kinds `base` and `tool`
                mean the lengths of those frames.
            urdf: The source, for a URDF robot.
            place: File name for error messages.

        Raises:
            InputError: A name that is neither a parameter nor, for tolerances, a kind.
        """
        names = {p.name for p in self._parameters}
        if len(names) < len(self._parameters):
            raise InputError(place, "two joints share a name, or one is called base or tool", "different names")
        for key, listed in (("fixed", fixed), ("estimate", estimate)):
            check_names(f"{place}: {key}", listed, names_of(self._parameters))
        both = sorted(set(fixed) & set(estimate))
        if both:
            raise InputError(f"{place}: estimate", f"{both[0]!r} stands under fixed too", "it under one of the two")
        tolerance = dict(tolerance or {})
        kinds = {tolerance_kind(p) for p in self._parameters} - {None}
        for name in tolerance:
            if name not in names and name not in kinds:
                listed = sorted(str(k) for k in kinds)
                found, hint = f"unknown parameter or kind {name!r}", did_you_mean(name, [*listed, *names], NEAR)
                raise InputError(f"{place}: tolerance", found, known_names(listed), hint)
        parameters = tuple(
            replace(
                p,
                estimated=(p.estimated or p.name in estimate) and p.name not in fixed,
                tolerance=tolerance.get(p.name, tolerance.get(tolerance_kind(p) or "")),
            )
            for p in self._parameters
        )
        return Robot(self._name, self._convention, tuple(self._joints), parameters, tuple(self._elements), urdf)

    def _add_parameter(
        self, name: str, kind: str, owner: int, nominal: float, estimated: bool, joint: int | None = None
    ) -> None:
        parameter = Parameter(name, kind, owner, float(nominal), estimated=estimated)
        self._elements.append(Element(parameter.axis, parameter=len(self._parameters), joint=joint))
        self._parameters.append(parameter)


def _inverse(elements: Sequence[Element]) -> list[Element]:
    """The inverse of a sequence of elementary transforms."""
    return [replace(e, constant=-e.constant, sign=-e.sign) for e in reversed(elements)]


def names_of(parameters: Iterable[Parameter]) -> list[str]:
    """The parameters' names, in order."""
    return [p.name for p in parameters]


def tolerance_kind(parameter: Parameter) -> str | None:
    """The key under which a tolerance by kind reaches `parameter`: `a`, `x`, `tool`; None if there is none."""
    frame = re.match(r"(base|tool)\.", parameter.name)
    if frame is None:
        return parameter.kind
    return frame.group(1) if parameter.unit == "m" else None
