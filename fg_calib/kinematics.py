"""Forward kinematics of many configurations, with the derivative of the pose in everything that can move.

A `Chain` is a robot prepared for the compiled walk: arrays that say, element by element, which axis to
translate along or rotate about, by how much, and which column of a Jacobian belongs to it. The walk keeps the
three columns of the rotation matrix and the tool point: a rotation combines two columns, a translation adds a
multiple of one. The derivative of the pose in an element is the element's twist (w, v) in the base frame:

    translation along the axis c:        w = 0,  v = c
    rotation about c through point o:    w = c,  v = o x c

so that a unit change turns the tool by w and moves the tool point p by w x p + v (Lynch & Park 2017, ch. 5).

All of it is compiled by numba and runs on blocks of `LANES` configurations at once: arrays are shaped
(..., LANES) and the innermost loop runs over configurations, which the compiler turns into vector instructions.
(Inside the walk rotation and point are flat, so that it sees at which constant distance columns lie and that they do
not overlap.) Sine and cosine of the readings are taken once a data set (`precompute_trig`) and combined with those of
the parameters by the addition theorem, so no trigonometry happens inside.

Note:
    Numba's cache looks at the file of the outermost kernel alone: after a change here, kernels elsewhere that call
    `walk` are compiled anew only once their cache (`fg_calib/__pycache__/*.nb*`) is deleted.

References:
    Lynch & Park (2017), Modern Robotics, Cambridge University Press.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core import event
from numpy.typing import NDArray

from fg_calib.robot import AXIS_OF_KIND, FRAME_KINDS, Axis, Element, Robot

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

logger = logging.getLogger(__name__)

LANES = 32
"""Configurations walked at once: the width of the innermost loops. Shorter loops would be unrolled, not vectorised."""

T = TypeVar("T")


class _CompileNotice(event.Listener):  # type: ignore[misc]
    """Says once, when numba starts to compile, why the program is silent for some seconds."""

    said = False

    def on_start(self, event: object) -> None:
        """Numba begins to compile (a kernel found in its cache does not come here)."""
        if not _CompileNotice.said:
            _CompileNotice.said = True
            logger.warning("compiling the kernels: some seconds, once an installation")

    def on_end(self, event: object) -> None:
        """Numba is done with one function."""


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile a kernel with numba: without the GIL, with fused multiply-adds, cached where a folder can be written."""
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}} | options
    try:
        kernel: Callable[..., Any] = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        kernel = numba.njit(**options)(function)
    return kernel


inlined = partial(compiled, forceinline=True)
"""As `compiled`, for a part of a kernel that must see its caller's constants."""


@dataclass(frozen=True)
class Chain:
    """A robot prepared for the compiled walk; `at` gives it other parameter values.

    Attributes:
        axis: `Axis` of each element, shape (n_elements,).
        constant: Constant part of each element's value, [m] or [rad].
        sign: +1 or -1, factor of parameter and reading.
        source: Index into the parameter vector of `at`, -1 where the value is constant.
        value: Value of each element without its reading, [m] or [rad].
        joint: Index of the joint whose reading is added, -1 for none.
        column: Jacobian column of each element's parameter, -1 for none.
        n_columns: Number of parameter columns.
        n_joints: Number of moving joints.
        joint_columns: Whether derivatives in the joints are wanted too; they follow the parameters' columns.
    """

    axis: NDArray[np.int8]
    constant: Floats
    sign: Floats
    source: Integers
    value: Floats
    joint: Integers
    column: Integers
    n_columns: int
    n_joints: int
    joint_columns: bool = False

    def at(self, parameters: Floats) -> Chain:
        """The same chain with parameter values, shape (n_parameters,) or (n_parameters + 6,), [m] or [rad].

        The six further values are those of the measurement frame, in the order of `FRAME_KINDS`.
        """
        value = self.constant + self.sign * np.where(self.source >= 0, parameters[self.source], 0.0)
        return replace(self, value=value)

    def without_columns(self) -> Chain:
        """The same chain with no derivatives."""
        return replace(self, column=np.full_like(self.column, -1), n_columns=0, joint_columns=False)

    def with_joint_columns(self) -> Chain:
        """The same chain with the derivatives in the joints as well."""
        return replace(self, joint_columns=True)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """What the kernels take: the arrays, sines and cosines of the values among them."""
        return (
            self.axis,
            self.value,
            np.cos(self.value),
            np.sin(self.value),
            self.sign,
            self.joint,
            self.column,
            self.n_columns,
            self.n_joints if self.joint_columns else 0,
        )

    @property
    def turns(self) -> NDArray[np.bool_]:
        """For each column, joints included, whether it belongs to a rotation, shape (n_columns + n_joints,)."""
        turns = np.zeros(self.n_columns + self.n_joints, dtype=np.bool_)
        rotation = self.axis >= Axis.RX
        turns[self.column[self.column >= 0]] = rotation[self.column >= 0]
        turns[self.n_columns + self.joint[self.joint >= 0]] = rotation[self.joint >= 0]
        return turns


def build_chain(
    robot: Robot,
    columns: Mapping[int, int] | None = None,
    *,
    tool_tangent: int | None = None,
    frame_tangent: int | None = None,
    frame: bool = False,
) -> Chain:
    """Prepare a robot for the walk, at its nominal values.

    Of the joints' parameters only those that have a column may change through `Chain.at`; the others are
    constants, and what does nothing is left out.

    Args:
        robot: The robot.
        columns: Jacobian column of each parameter that has one, by the parameter's index.
        tool_tangent: First of six columns for a small motion of the tool frame in itself, rotation first
            (GTSAM's tangent of a Pose3); None if there are none.
        frame_tangent: The same for the measurement frame world_T_base.
        frame: Whether the chain starts in a measurement frame; `Chain.at` then takes six more values, and the
            frame is the identity until it got them.
    """
    columns = dict(columns or {})
    n_parameters = len(robot.parameters)
    elements: list[tuple[Element, int, int]] = []  # element, source, column
    if frame:
        elements += [(Element(AXIS_OF_KIND[k]), n_parameters + i, -1) for i, k in enumerate(FRAME_KINDS)]
        elements += _tangent(frame_tangent)
    for element in robot.elements:
        source = -1 if element.parameter is None else element.parameter
        elements.append((element, source, columns.get(source, -1)))
    elements += _tangent(tool_tangent)
    n_columns = len(columns) + 6 * (tool_tangent is not None) + 6 * (frame_tangent is not None)
    chain = Chain(
        axis=np.array([e.axis for e, _, _ in elements], dtype=np.int8),
        constant=np.array([e.constant for e, _, _ in elements]),
        sign=np.array([float(e.sign) for e, _, _ in elements]),
        source=np.array([source for _, source, _ in elements], dtype=np.int64),
        value=np.zeros(len(elements)),
        joint=np.array([-1 if e.joint is None else e.joint for e, _, _ in elements], dtype=np.int64),
        column=np.array([column for _, _, column in elements], dtype=np.int64),
        n_columns=n_columns,
        n_joints=robot.n_joints,
    )
    return _simplified(chain.at(np.concatenate([robot.nominal, np.zeros(6)])), set(columns), robot)


def _tangent(first: int | None) -> list[tuple[Element, int, int]]:
    """Six elements of value zero: the derivative in them is that in a frame's tangent, rotation first."""
    if first is None:
        return []
    # Rotations about and translations along the axes of one frame commute to first order.
    return [(Element(axis), -1, first + (axis + 3) % 6) for axis in Axis]


def _simplified(chain: Chain, estimated: set[int], robot: Robot) -> Chain:
    """The chain without elements that do nothing.

    A parameter outside `estimated` may still change through `Chain.at` if it is the base's or the tool's (a
    Pose3 stands for them there); a joint's is constant, and if it is zero it need not be walked.
    """
    constant = np.array(
        [
            0 <= s < len(robot.parameters) and s not in estimated and 1 <= robot.parameters[s].owner <= robot.n_joints
            for s in chain.source
        ]
    ) | (chain.source < 0)
    idle = constant & (chain.value == 0.0) & (chain.joint < 0) & (chain.column < 0)
    keep = ~idle
    arrays = {
        name: getattr(chain, name)[keep] for name in ("axis", "constant", "sign", "source", "value", "joint", "column")
    }
    return replace(chain, **arrays)


def precompute_trig(robot: Robot, readings: Floats) -> Floats:
    """Cosine and sine of revolute readings (value and 0 for prismatic), shape (n, n_joints, 2).

    Args:
        robot: The robot.
        readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
    """
    prismatic = np.array([j.prismatic for j in robot.joints])
    return np.stack(
        [np.where(prismatic, readings, np.cos(readings)), np.where(prismatic, 0.0, np.sin(readings))], axis=2
    )


@compiled
def walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, rows, start, rotation, point, twist):  # type: ignore[no-untyped-def]
    """Walk `LANES` configurations down the chain.

    Args:
        axis, value, cosine, sine, sign, joint, column, n_columns, n_own: `Chain.arguments`.
        trig: From `precompute_trig`, shape (n, n_joints, 2).
        rows: Rows of `trig`, shape (m,); positions beyond its end repeat the last.
        start: Position in `rows` of the first lane.
        rotation: Filled: rotation matrix, [column, component, lane], shape (3, 3, LANES).
        point: Filled: tool point, shape (3, LANES), [m].
        twist: Filled: (w, v) of each column, then of each joint, shape (n_columns + n_own, 6, LANES); must come with
            w = 0 for translations.
    """
    last = rows.shape[0] - 1
    row = np.empty(LANES, np.int64)
    reading = np.empty(2 * LANES)
    for i in range(LANES):
        row[i] = rows[min(start + i, last)]
    R, p = rotation.reshape(9 * LANES), point.reshape(3 * LANES)
    R[:] = 0.0
    p[:] = 0.0
    for i in range(LANES):
        R[i] = 1.0
        R[4 * LANES + i] = 1.0
        R[8 * LANES + i] = 1.0
    for e in range(axis.shape[0]):
        k, j = axis[e], joint[e]
        for target in (column[e], n_columns + j if n_own > 0 and j >= 0 else -1):
            if target < 0:
                continue
            if k >= 3:
                _write_rotation_twist(sign[e], R, k - 3, p, twist[target])
            else:
                _write_translation_twist(sign[e], R, k, twist[target])
        if j >= 0:
            for i in range(LANES):
                reading[i] = trig[row[i], j, 0]
                reading[LANES + i] = sign[e] * trig[row[i], j, 1]
        if k < 3:
            if j >= 0:
                _shift_by_reading(value[e], sign[e], reading, R, k, p)
            else:
                _shift(value[e], R, k, p)
        elif j >= 0:
            _add_angles(cosine[e], sine[e], reading)
            if k == 3:
                _turn_by_reading(reading, R, 1, 2)
            elif k == 4:
                _turn_by_reading(reading, R, 2, 0)
            else:
                _turn_by_reading(reading, R, 0, 1)
        elif k == 3:
            _turn(cosine[e], sine[e], R, 1, 2)
        elif k == 4:
            _turn(cosine[e], sine[e], R, 2, 0)
        else:
            _turn(cosine[e], sine[e], R, 0, 1)


@inlined
def _write_rotation_twist(sign, R, k, p, twist):  # type: ignore[no-untyped-def]
    w = 3 * k * LANES
    for i in range(LANES):
        w0 = sign * R[w + i]
        w1 = sign * R[w + LANES + i]
        w2 = sign * R[w + 2 * LANES + i]
        twist[0, i] = w0
        twist[1, i] = w1
        twist[2, i] = w2
        twist[3, i] = p[LANES + i] * w2 - p[2 * LANES + i] * w1
        twist[4, i] = p[2 * LANES + i] * w0 - p[i] * w2
        twist[5, i] = p[i] * w1 - p[LANES + i] * w0


@inlined
def _write_translation_twist(sign, R, k, twist):  # type: ignore[no-untyped-def]
    for c in range(3):
        for i in range(LANES):
            twist[3 + c, i] = sign * R[(3 * k + c) * LANES + i]


@inlined
def _shift(value, R, k, p):  # type: ignore[no-untyped-def]
    for c in range(3):
        for i in range(LANES):
            p[c * LANES + i] += value * R[(3 * k + c) * LANES + i]


@inlined
def _shift_by_reading(value, sign, reading, R, k, p):  # type: ignore[no-untyped-def]
    for c in range(3):
        for i in range(LANES):
            p[c * LANES + i] += (value + sign * reading[i]) * R[(3 * k + c) * LANES + i]


@inlined
def _turn(cosine, sine, R, a, b):  # type: ignore[no-untyped-def]
    for c in range(3):
        for i in range(LANES):
            x, y = R[(3 * a + c) * LANES + i], R[(3 * b + c) * LANES + i]
            R[(3 * a + c) * LANES + i] = cosine * x + sine * y
            R[(3 * b + c) * LANES + i] = cosine * y - sine * x


@inlined
def _add_angles(cosine, sine, reading):  # type: ignore[no-untyped-def]
    """Cosine and sine of the reading become those of its sum with a value."""
    for i in range(LANES):
        c, s = reading[i], reading[LANES + i]
        reading[i] = cosine * c - sine * s
        reading[LANES + i] = sine * c + cosine * s


@inlined
def _turn_by_reading(reading, R, a, b):  # type: ignore[no-untyped-def]
    for c in range(3):
        for i in range(LANES):
            x, y = R[(3 * a + c) * LANES + i], R[(3 * b + c) * LANES + i]
            R[(3 * a + c) * LANES + i] = reading[i] * x + reading[LANES + i] * y
            R[(3 * b + c) * LANES + i] = reading[i] * y - reading[LANES + i] * x


@compiled
def _walk_all(  # type: ignore[no-untyped-def]
    axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, rows, start, stop, out_R, out_p, out_J
):
    """Rotation (n, 3, 3), point (n, 3) and derivatives (n, 6, n_columns + n_own) of rows start to stop."""
    n_twists = n_columns + n_own
    rotation, point = np.empty((3, 3, LANES)), np.empty((3, LANES))
    twist = np.zeros((n_twists, 6, LANES))
    for first in range(start, stop, LANES):
        walk(
            axis, value, cosine, sine, sign, joint, column, n_columns, n_own,
            trig, rows, first, rotation, point, twist,
        )  # fmt: skip
        for i in range(min(LANES, stop - first)):
            n = first + i
            for r in range(3):
                out_p[n, r] = point[r, i]
                for c in range(3):
                    out_R[n, r, c] = rotation[c, r, i]
            for t in range(n_twists):
                for r in range(3):
                    a, b = (r + 1) % 3, (r + 2) % 3
                    out_J[n, r, t] = twist[t, r, i]
                    out_J[n, 3 + r, t] = (
                        twist[t, a, i] * point[b, i] - twist[t, b, i] * point[a, i] + twist[t, 3 + r, i]
                    )


@dataclass(frozen=True)
class Poses:
    """Tool poses with their derivatives.

    Attributes:
        rotation: base_R_tool, shape (n, 3, 3).
        position: base_p_tool, shape (n, 3), [m].
        jacobian: Of the pose, rotation first (about the base axes, through the tool point), then position, in
            the chain's columns and, if the chain has them, in the joints: shape (n, 6, n_columns + n_joints),
            [rad or m over rad or m].
    """

    rotation: Floats
    position: Floats
    jacobian: Floats


def forward(chain: Chain, trig: Floats, rows: Integers | None = None) -> Poses:
    """Tool poses, and their derivatives in the chain's columns.

    Args:
        chain: The chain; `without_columns` spares the derivatives.
        trig: From `precompute_trig`, shape (n, n_joints, 2).
        rows: Rows of `trig`, shape (m,); all if None.

    Note:
        The derivatives of n configurations take n * 6 * n_columns numbers; for large data use the residuals of
        `residuals`, which reduce them as they come.
    """
    rows = np.arange(len(trig)) if rows is None else np.asarray(rows, dtype=np.int64)
    n, n_twists = len(rows), chain.n_columns + (chain.n_joints if chain.joint_columns else 0)
    rotation, position, jacobian = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 6, n_twists))
    arguments = chain.arguments

    def run(start: int, stop: int) -> None:
        _walk_all(*arguments, trig, rows, start, stop, rotation, position, jacobian)

    for _ in over_spans(run, n):
        pass
    return Poses(rotation, position, jacobian)


def pose(robot: Robot, readings: Floats | Sequence[Sequence[float]]) -> Poses:
    """Tool poses of a robot in its base frame, and their derivatives in every parameter, then every joint.

    Args:
        robot: The robot, at its nominal values.
        readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
    """
    q = np.asarray(readings, dtype=np.float64).reshape(-1, robot.n_joints)
    chain = build_chain(robot, {i: i for i in range(len(robot.parameters))}).with_joint_columns()
    return forward(chain, precompute_trig(robot, q))


SPAN = 8192
"""Rows of one task of the thread pool; a multiple of `LANES`."""


def over_spans(run: Callable[[int, int], T], n: int) -> Iterator[T]:
    """Results of `run(start, stop)` over fixed spans of `n` rows, in order, on all processors.

    The spans do not depend on the number of processors, so neither do sums over them.
    """
    spans = [(start, min(start + SPAN, n)) for start in range(0, n, SPAN)]
    if len(spans) == 1 or processors() == 1:
        return (run(*span) for span in spans)
    return _pool().map(lambda span: run(*span), spans)


@cache
def processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(processors(), thread_name_prefix="fg-calib")


event.register("numba:compile", _CompileNotice())
