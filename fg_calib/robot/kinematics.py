"""Forward kinematics of many configurations, with the derivative of the pose in everything that can move.

A `Chain` is a robot prepared for the compiled walk: arrays that say, element by element, which axis to
translate along or rotate about, by how much, and which column of a Jacobian belongs to it. The walk keeps the
three columns of the rotation matrix and the tool point: a rotation combines two columns, a translation adds a
multiple of one. The derivative of the pose in an element is the element's twist (w, v) in the base frame:

    translation along the axis c:        w = 0,  v = c
    rotation about c through point o:    w = c,  v = o x c

so that a unit change turns the tool by w and moves the tool point p by w x p + v (Lynch & Park 2017, ch. 5).

The walk itself is compiled, see `kernels`.

References:
    Lynch & Park (2017), Modern Robotics, Cambridge University Press.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fg_calib.inputs import Brief, Floats, Integers, as_figures, check_sizes, checked
from fg_calib.parallel import processors
from fg_calib.robot.kernels import ChainArrays, walk_all
from fg_calib.robot.model import FRAME_KINDS, PARAMETER_KINDS, Axis, Element, Robot

T = TypeVar("T")


class Curve(NamedTuple):
    """A joint's error curve: what it turns beyond its reading, a periodic cubic B-spline of it.

    Attributes:
        joint: Index of the joint.
        source: Indices of its coefficients in the parameter vector, shape (n_knots,).
        values: The coefficients, shape (n_knots,), [rad].
    """

    joint: int
    source: Integers
    values: Floats


Splines = Mapping[int, tuple[Integers, Floats]]
"""Of each joint that has an error curve what `spline` gives at some readings."""


def spline(angle: Floats, n_knots: int) -> tuple[Integers, Floats]:
    """Numbers of the four periodic cubic B-splines that are not zero at angles, and their values, shape (n, 4) each.

    Args:
        angle: Shape (n,), [rad].
        n_knots: Knots a turn, evenly spaced from 0.
    """
    u = angle * (n_knots / (2.0 * np.pi))
    k = np.floor(u)
    t = u - k
    s, square = 1.0 - t, t * t
    pieces = [s * s * s, (3.0 * t - 6.0) * square + 4.0, ((3.0 - 3.0 * t) * t + 3.0) * t + 1.0, t * square]
    return (k.astype(np.int64)[:, None] + np.arange(-1, 3)) % n_knots, np.stack(pieces, axis=1) / 6.0


class Chain(Brief):
    """A robot prepared for the compiled walk; `at` gives it other parameter values.

    Attributes:
        axis: `Axis` of each element, shape (n_elements,).
        constant: Constant part of each element's value, [m] or [rad].
        sign: +1 or -1, factor of parameter and reading.
        source: Index into the parameter vector of `at`, -1 where the value is constant.
        value: Value of each element without its reading, [m] or [rad].
        joint: Index of the joint whose reading is added, or is what the basis is a function of; -1 for none.
        basis: Column of the `trig` of `Robot.trig` by which the value is multiplied, -1 for none.
        column: Jacobian column of each element's parameter, -1 for none.
        n_columns: Number of parameter columns.
        n_joints: Number of moving joints.
        joint_columns: Whether derivatives in the joints are wanted too; they follow the parameters' columns.
        curves: Error curves of joints.
    """

    axis: NDArray[np.int8]
    constant: Floats
    sign: Floats
    source: Integers
    value: Floats
    joint: Integers
    basis: Integers
    column: Integers
    n_columns: int
    n_joints: int
    joint_columns: bool = False
    curves: tuple[Curve, ...] = ()

    def at(self, parameters: Floats) -> "Chain":
        """Copy with parameter values, shape (n_parameters,) or (n_parameters + 6,), [m] or [rad].

        The six further values are those of the measurement frame, in the order of `FRAME_KINDS`.
        """
        curves = tuple(c._replace(values=parameters[c.source]) for c in self.curves)
        there = replace(self, value=self.values(parameters), curves=curves)
        there.__dict__["_turns"] = self._turns  # which values do not change
        return there

    def values(self, parameters: Floats) -> Floats:
        """Value of each element without its reading at parameter values as `at` takes them, shape (n_elements,)."""
        return self.constant + self.sign * np.where(self.source >= 0, parameters[self.source], 0.0)

    def without_columns(self) -> "Chain":
        """Copy without derivatives."""
        return replace(self, column=np.full_like(self.column, -1), n_columns=0, joint_columns=False)

    def with_joint_columns(self) -> "Chain":
        """Copy with the derivatives in the joints too."""
        return replace(self, joint_columns=True)

    def with_turn_columns(self) -> "Chain":
        """Copy with derivatives in what each joint turns alone: joint columns without slopes of effects."""
        return replace(self, joint_columns=True, joint=np.where(self.basis >= 0, -1, self.joint))

    def with_curves_in(self, trig: Floats, splines: "Splines | None" = None) -> "tuple[Chain, Floats]":
        """The chain without error curves, and readings with them: q + curve(q); `splines` of these if there already."""
        if not any(curve.values.any() for curve in self.curves):
            return replace(self, curves=()) if self.curves else self, trig
        trig, found = trig.copy(), splines or self.splines(trig)
        for curve in self.curves:
            c, s = trig[:, curve.joint].T
            knots, weights = found[curve.joint]
            turn = np.einsum("nk,nk->n", weights, curve.values[knots])
            cos, sin = np.cos(turn), np.sin(turn)
            trig[:, curve.joint] = np.stack([cos * c - sin * s, sin * c + cos * s], axis=1)
        return replace(self, curves=()), trig

    def splines(self, trig: Floats) -> "Splines":
        """Coefficients of each error curve that readings depend on, by joint, and derivatives in them: see `spline`."""
        return {c.joint: spline(np.arctan2(*trig[:, c.joint].T[::-1]), len(c.values)) for c in self.curves}

    @cached_property
    def arrays(self) -> ChainArrays:
        """Arguments of the kernels."""
        cos, sin, n_own = np.cos(self.value), np.sin(self.value), self.n_joints if self.joint_columns else 0
        walk = (self.sign, self.joint, self.column, self.n_columns, n_own, self._turns, self.basis)
        return ChainArrays(self.axis, self.value, cos, sin, *walk)

    @cached_property
    def _turns(self) -> NDArray[np.bool_]:
        """Whether each column, joints included, belongs to a rotation, shape (n_columns + n_joints,)."""
        turns = np.zeros(self.n_columns + self.n_joints, dtype=np.bool_)
        rotation = self.axis >= Axis.RX
        turns[self.column[rotation & (self.column >= 0)]] = True
        turns[self.n_columns + self.joint[rotation & (self.joint >= 0)]] = True
        return turns


def build_chain(
    robot: Robot,
    columns: Mapping[int, int] | None = None,
    *,
    tool_tangent: int | None = None,
    base_tangent: int | None = None,
    frame_tangent: int | None = None,
    frame: bool = False,
) -> Chain:
    """Prepare a robot for the walk, at its nominal values.

    Only what has a column, base and tool if they have a tangent, and the measurement frame may change through
    `Chain.at`; the rest is constant, and what does nothing is left out.

    Args:
        robot: The robot.
        columns: Jacobian column of each parameter that has one, by the parameter's index; of the frame's six values
            by further ones.
        tool_tangent: First of six columns for a small motion of the tool frame in itself, rotation first
            (GTSAM's tangent of a Pose3); None if there are none.
        base_tangent: Such columns for the base frame.
        frame_tangent: Such columns for the measurement frame world_T_base.
        frame: Whether the chain starts in a measurement frame; `Chain.at` then takes six more values, and the
            frame is the identity until it got them.
    """
    columns = dict(columns or {})
    n_parameters = len(robot.parameters)
    base, tool = robot.owned_by(0), robot.owned_by(robot.n_joints + 1)
    end_of_base = max((i for i, e in enumerate(robot.elements) if e.parameter in base and e.basis is None), default=-1)
    elements: list[tuple[Element, int, int]] = []  # element, source, column
    if frame:
        values = enumerate(FRAME_KINDS, start=n_parameters)
        elements += [(Element(PARAMETER_KINDS[kind].axis), i, columns.get(i, -1)) for i, kind in values]
        elements += _tangent(frame_tangent)
    for i, element in enumerate(robot.elements):
        source = -1 if element.parameter is None else element.parameter
        elements.append((element, source, columns.get(source, -1)))
        if i == end_of_base:
            elements += _tangent(base_tangent)
    elements += _tangent(tool_tangent)
    n_columns = len(columns) + 6 * sum(t is not None for t in (tool_tangent, base_tangent, frame_tangent))
    terms = [-1 if e.basis is None else robot.n_joints + e.basis.term for e, _, _ in elements]
    numbers = zip(*((k, _joint_of(e), term, c) for (e, k, c), term in zip(elements, terms, strict=True)), strict=True)
    sources, joint, basis, column = (np.array(each, dtype=np.int64) for each in numbers)
    constant, sign = np.array([(e.constant, float(e.sign)) for e, _, _ in elements]).T.copy()
    axis, value = np.array([e.axis for e, _, _ in elements], dtype=np.int8), np.zeros(len(elements))
    sizes, curves = (n_columns, robot.n_joints), _curves(robot)
    chain = Chain(axis, constant, sign, sources, value, joint, basis, column, *sizes, curves=curves)
    changing = set(columns) | set(range(n_parameters, n_parameters + 6))
    changing |= set(() if tool_tangent is None else tool) | set(() if base_tangent is None else base)
    chain = replace(chain, value=chain.values(np.concatenate([robot.nominal, np.zeros(6)])))
    return _without_idle(chain, changing)


def _curves(robot: Robot) -> tuple[Curve, ...]:
    """The error curves of a robot at its nominal values."""
    sources = dict[int, list[int]]()
    for i, p in enumerate(robot.parameters):
        if p.kind == "curve":
            sources.setdefault(p.owner - 1, []).append(i)
    return tuple(Curve(joint, np.array(each), robot.nominal[each]) for joint, each in sources.items())


def _joint_of(element: Element) -> int:
    """The joint whose reading an element's value depends on, -1 for none."""
    if element.basis is not None:
        return element.basis.joint
    return -1 if element.joint is None else element.joint


def _tangent(first: int | None) -> list[tuple[Element, int, int]]:
    """Six elements of value zero: the derivative in them is that in a frame's tangent, rotation first."""
    if first is None:
        return []
    # Rotations about and translations along the axes of one frame commute to first order.
    return [(Element(axis), -1, first + (axis + 3) % 6) for axis in Axis]


def _without_idle(chain: Chain, changing: set[int]) -> Chain:
    """The chain without elements that do nothing: zero, and nothing will ever change them.

    Args:
        chain: The chain at its nominal values.
        changing: Indices of the parameters, and of the measurement frame's six, that `Chain.at` may change.
    """
    fixed = np.array([source not in changing for source in chain.source])
    keep = ~(fixed & (chain.value == 0.0) & ~((chain.joint >= 0) & (chain.basis < 0)) & (chain.column < 0))
    names = ("axis", "constant", "sign", "source", "value", "joint", "basis", "column")
    return replace(chain, **{name: getattr(chain, name)[keep] for name in names})


class Poses(Brief):
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
        trig: From `Robot.trig`, shape (n, n_joints, 2).
        rows: Rows of `trig`, shape (m,); all if None.

    Note:
        The derivatives of n configurations take n * 6 * n_columns numbers; for large data use the residuals of
        `residuals`, which reduce them as they come.
    """
    chain, trig = chain.with_curves_in(trig)
    rows = np.arange(len(trig)) if rows is None else np.asarray(rows, dtype=np.int64)
    n, n_twists = len(rows), chain.n_columns + (chain.n_joints if chain.joint_columns else 0)
    rotation, position, jacobian = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 6, n_twists))
    arrays = chain.arrays

    def run(start: int, stop: int) -> None:
        walk_all(arrays, trig, rows, start, stop, rotation, position, jacobian)

    over_spans(run, n)
    return Poses(rotation, position, jacobian)


_RIGID_RCOND = 1e-10
"""Singular values of rigid motions below this share of the largest move no point."""


def without_rigid_motion(points: Floats, derivative: Floats) -> tuple[Floats, Floats]:
    """Derivatives of points minus the nearest rigid motion of all of them, and its rotation.

    Args:
        points: Shape (n, 3), [m].
        derivative: Of the points in anything, shape (n, 3, m).

    Returns:
        Shapes (n, 3, m) and (3, m), the latter in [rad] over the unit of what it is differentiated by.
    """
    p = points - points.mean(axis=0)
    translations = np.tile(np.eye(3), (len(p), 1))  # (3 n, 3)
    rotations = np.cross(np.eye(3)[None], p[:, None]).transpose(0, 2, 1).reshape(-1, 3)  # axis x p, a column an axis
    motions = np.hstack([translations, rotations])
    flat, nearest = derivative.reshape(len(motions), -1), np.linalg.pinv(motions, rcond=_RIGID_RCOND)
    found: Floats = nearest @ flat
    left: Floats = flat - motions @ found
    left = left - motions @ (nearest @ left)  # once more: rounding of the first time
    left[:, np.linalg.norm(left, axis=0) <= _RIGID_RCOND * np.linalg.norm(flat, axis=0)] = 0.0
    return left.reshape(derivative.shape), found[3:]


LEAST_TURNING = 1e-4
"""Mean square of sin(half the angle) of rotations, times two, above which they tell base from tool."""


def turning_of_base(w: Floats, rotation: Floats) -> Floats:
    """Rotation of the base in that of the tool: the best a in `w_k = a + R_k b`, shape (3, n_columns), [rad/...].

    Points that should coincide are off by some vectors. If the base turns, all of them turn with it, and their lengths
    stay; if the tool turns about its own point they stay as they are. Which turn of all vectors together belongs to a
    column is free, as it changes no length. This choice is linear in the columns, so that whatever they do together, if
    it is a motion of the base and a turn of the tool about its point, has no effect on vectors turned back by it.

    Args:
        w: Turning of the tool in each column at some configurations, about the base's axes, shape (n, 3, n_columns).
        rotation: base_R_tool there, shape (n, 3, 3).
    """
    w_mean, R_mean = w.mean(axis=0), rotation.mean(axis=0)
    # Normal equations of b about the means; where the rotations hardly tell it is zero, and the turn the base's.
    values, V = np.linalg.eigh(np.eye(3) - R_mean.T @ R_mean)
    right = rotation.reshape(-1, 3).T @ w.reshape(3 * len(w), w.shape[2]) / len(w) - R_mean.T @ w_mean
    inverse = np.divide(1.0, values, out=np.zeros(3), where=values > LEAST_TURNING)
    return np.asarray(w_mean - R_mean @ ((V * inverse) @ (V.T @ right)))


@checked
def pose(robot: Robot, readings: Floats | Sequence[Sequence[float]]) -> Poses:
    """Tool poses of a robot in its base frame, and their derivatives in every parameter, then every joint.

    Args:
        robot: The robot, at its nominal values.
        readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).

    Raises:
        InputError: The readings are of more or fewer joints.
    """
    figures = as_figures("readings", readings, f"numbers of shape (n, {robot.n_joints})")
    check_sizes("readings", figures)
    chain = build_chain(robot, {i: i for i in range(len(robot.parameters))}).with_joint_columns()
    return forward(chain, robot.trig(np.atleast_2d(figures)))


SPAN = 8192
"""Rows of one task of the thread pool; a multiple of `LANES`."""


def over_spans(run: Callable[[int, int], T], n: int) -> list[T]:
    """Results of `run(start, stop)` over fixed spans of `n` rows, in order, on all processors.

    The spans do not depend on the number of processors, so neither do sums over them.
    """
    return list(over_processors(lambda k: run(k * SPAN, min((k + 1) * SPAN, n)), -(-n // SPAN)))


def over_processors(run: Callable[[int], T], n: int) -> Iterator[T]:
    """Results of `run(k)` for k below n, in order, on all processors."""
    if n <= 1 or processors() == 1:
        return (run(k) for k in range(n))
    return _pool().map(run, range(n))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(processors(), thread_name_prefix="fg-calib")


if hasattr(os, "register_at_fork"):  # whose child has none of the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
