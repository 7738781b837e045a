r"""Residuals, predicted minus measured, with analytic derivatives: the mathematics of the measurements.

| kind | residual | rows |
|---|---|---|
| distance | `\|p_B - p_A\| - measured` | 1 |
| rotation angle | `angle(R_A^T R_B) - measured`, in [0, pi] | 1 |
| same point | `p_B - p_A` in the base frame, up to a rotation | 3 |
| position | `world_p_tool - measured` in the world frame | 3 |
| orientation | `Log(R_measured^T R_predicted)`: rotation vector in the tool frame | 3 |
| pose | orientation, then position | 6 |

Derivatives, with (w, v) the twist of a parameter at a configuration (see `kinematics`) and p the tool point:

    distance:        dl = u . (dp_B - dp_A)            Jia et al. (2019), Eq. (5); dp = w x p + v
    rotation angle:  dphi = k . (w_B - w_A)            the same, Eq. (21); k the unit axis of R_B R_A^T
    same point:      dp_B - dp_A, but 0 for what moves both points as one body: the residual may be turned by
                     any rotation without changing its norm, so by one that undoes such a motion
    orientation:     dr = Jr^-1(r) R_predicted^T w     Jr the right Jacobian of SO(3), Sola et al. (2018), Eq. (144)

In the pair kernel `u . (w x p) = w . (p x u)`, so that p x u is computed once a pair, and the axis in the base
frame is half the sum over columns of `R_A[:, c] x R_B[:, c]`, which is `k sin(phi)`.

A *block* is a set of measurements of one kind. Its kernel fills a panel, shape (n_columns + 1, rows): the transposed
whitened Jacobian and, in its last row, the whitened residual. Panels are handed on chunk by chunk and never
stored for a whole block: `gram` and `triangle` reduce them as they come, `linearise` keeps them for those who want
to look at every row.

References:
    Jia, Wang, Chen, Sun (2019), Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on
    Orbit. International Journal of Aerospace Engineering.
    Sola, Deray, Atchuthan (2018), A micro Lie theory for state estimation in robotics. arXiv:1812.01537.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from fg_calib.kinematics import LANES, Chain, compiled, over_spans, walk

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

CHUNK = 512
"""Measurements in one panel; a multiple of `LANES`."""


class Block(Protocol):
    """Measurements of one kind with one kernel."""

    @property
    def n(self) -> int:
        """Number of measurements."""

    @property
    def height(self) -> int:
        """Rows of residual of one measurement."""

    @property
    def n_configurations(self) -> int:
        """Configurations of one measurement: 1 for poses, 2 for pairs; each has joint columns of its own."""

    def fill(self, arguments: tuple[Any, ...], turns: NDArray[np.bool_], start: int, stop: int, panel: Floats) -> None:
        """Fill the panel, [column, row of a measurement, measurement], with measurements start to stop."""


@dataclass(frozen=True)
class PairBlock:
    """Distances and rotation angles of pairs.

    Attributes:
        trig: Readings, from `kinematics.precompute_trig`, shape (n_configurations, n_joints, 2).
        a: Row of each pair's first configuration in `trig`, shape (n,).
        b: Row of its second, shape (n,).
        measured: Distance and angle, shape (n, 2), [m], [rad]; any number where not measured.
        whitening: Lower triangle (w_dd, w_ad, w_aa) of a 2x2 matrix that whitens (distance, angle), shape (n, 3);
            zero for a row that is not measured.
        kinds: Whether distance and angle are wanted at all.
    """

    trig: Floats
    a: Integers
    b: Integers
    measured: Floats
    whitening: Floats
    kinds: tuple[bool, bool] = (True, True)

    n_configurations = 2

    @property
    def n(self) -> int:
        """Number of pairs."""
        return len(self.a)

    @property
    def height(self) -> int:
        """Rows of one pair: distance, angle or both."""
        return sum(self.kinds)

    def fill(self, arguments: tuple[Any, ...], turns: NDArray[np.bool_], start: int, stop: int, panel: Floats) -> None:
        """Fill the panel with pairs start to stop."""
        _fill_pairs(
            *arguments, turns, self.trig, self.a, self.b, self.measured, self.whitening, *self.kinds, start, stop, panel
        )


@dataclass(frozen=True)
class SamePointBlock:
    """Pairs whose tool points coincide: a distance of zero, which has no direction but three coordinates.

    Attributes:
        trig: Readings, shape (n_configurations, n_joints, 2).
        a: Row of each pair's first configuration, shape (n,).
        b: Row of its second, shape (n,).
        whitening: Whitens the 3-vector, lower triangular, shape (n, 3, 3), [1/m].
    """

    trig: Floats
    a: Integers
    b: Integers
    whitening: Floats

    n_configurations = 2
    height = 3

    @property
    def n(self) -> int:
        """Number of pairs."""
        return len(self.a)

    def fill(self, arguments: tuple[Any, ...], turns: NDArray[np.bool_], start: int, stop: int, panel: Floats) -> None:
        """Fill the panel with pairs start to stop."""
        _fill_same_points(*arguments, turns, self.trig, self.a, self.b, self.whitening, start, stop, panel)


@dataclass(frozen=True)
class PoseBlock:
    """Measured positions, orientations or poses, in the frame that the chain starts in.

    Attributes:
        trig: Readings, shape (n_configurations, n_joints, 2).
        rows: Row of each measurement in `trig`, shape (n,).
        rotation: Measured world_R_tool, shape (n, 3, 3); any if orientation is not wanted.
        position: Measured world_p_tool, shape (n, 3), [m]; any if position is not wanted.
        whitening: Whitens (orientation, position), lower triangular, shape (n, height, height).
        kinds: Whether orientation and position are wanted.
    """

    trig: Floats
    rows: Integers
    rotation: Floats
    position: Floats
    whitening: Floats
    kinds: tuple[bool, bool] = (True, True)

    n_configurations = 1

    @property
    def n(self) -> int:
        """Number of measurements."""
        return len(self.rows)

    @property
    def height(self) -> int:
        """Rows of one measurement: 3 or 6."""
        return 3 * sum(self.kinds)

    def fill(self, arguments: tuple[Any, ...], turns: NDArray[np.bool_], start: int, stop: int, panel: Floats) -> None:
        """Fill the panel with measurements start to stop."""
        _fill_poses(
            *arguments,
            turns,
            self.trig,
            self.rows,
            self.rotation,
            self.position,
            self.whitening,
            *self.kinds,
            start,
            stop,
            panel,
        )


def rows_of(block: Block, rows: slice) -> Block:
    """The measurements at `rows` of a block."""
    parts = {f.name: getattr(block, f.name)[rows] for f in fields(block) if f.name not in ("trig", "kinds")}  # type: ignore[arg-type]
    part: Block = replace(block, **parts)  # type: ignore[type-var]
    return part


def residual(block: Block, chain: Chain) -> Floats:
    """Whitened residuals, shape (n, height)."""
    return linearise(block, chain.without_columns())[0]


def linearise(block: Block, chain: Chain) -> tuple[Floats, Floats]:
    """Whitened residuals and their derivatives, row by row.

    Returns:
        The residuals, shape (n, height), and the derivatives, shape (n, height, n_columns + n_own): first in the
        chain's columns, then, if the chain has joint columns, in the joints of the measurement's first configuration,
        then of its second.
    """
    n_all = _n_columns(block, chain) + 1
    out = np.empty((block.n, block.height, n_all))

    def run(start: int, stop: int) -> None:
        for first, last, panel in _panels(block, chain, start, stop):
            out[first:last] = panel[:, :, : last - first].transpose(2, 1, 0)

    for _ in over_spans(run, block.n):
        pass
    return out[:, :, -1], out[:, :, :-1]


def squared_norm(block: Block, chain: Chain) -> float:
    """Sum of squared whitened residuals."""
    free = chain.without_columns()

    def run(start: int, stop: int) -> float:
        return sum(float(np.vdot(panel, panel)) for _, _, panel in _panels(block, free, start, stop))

    return sum(over_spans(run, block.n))


def gram(block: Block, chain: Chain) -> Floats:
    """[J r]^T [J r] of the block, shape (n_columns + 1, n_columns + 1)."""
    n_all = _n_columns(block, chain) + 1

    def run(start: int, stop: int) -> Floats:
        total = np.zeros((n_all, n_all))
        for _, _, panel in _panels(block, chain, start, stop):
            rows = panel.reshape(n_all, -1)
            total += rows @ rows.T
        return total

    with single_threaded_blas():
        return sum(over_spans(run, block.n), np.zeros((n_all, n_all)))


def triangle(block: Block, chain: Chain) -> Floats:
    """R of a thin QR of [J r], shape (n_columns + 1, n_columns + 1): `gram` without squaring the condition number."""
    n_all = _n_columns(block, chain) + 1

    def run(start: int, stop: int) -> Floats:
        running = np.zeros((0, n_all))
        for _, _, panel in _panels(block, chain, start, stop):
            running = _upper(np.vstack([running, panel.reshape(n_all, -1).T]))
        return running

    with single_threaded_blas():
        return _upper(np.vstack([*over_spans(run, block.n), np.zeros((n_all, n_all))]))


def _upper(A: Floats) -> Floats:
    """R of a thin QR."""
    R: Floats = np.linalg.qr(A, mode="r")  # type: ignore[assignment]
    return R


def single_threaded_blas() -> Any:
    """A context in which BLAS keeps to one thread: the chunks already use every processor."""
    return _threadpools().limit(limits=1, user_api="blas")


@cache
def _threadpools() -> ThreadpoolController:
    return ThreadpoolController()


def _n_columns(block: Block, chain: Chain) -> int:
    return chain.n_columns + (block.n_configurations * chain.n_joints if chain.joint_columns else 0)


def _panels(block: Block, chain: Chain, start: int, stop: int) -> Iterator[tuple[int, int, Floats]]:
    """First and last measurement and the panel of each chunk; lanes without a measurement are zero."""
    arguments, turns = chain.arguments, chain.turns
    size = min(CHUNK, -(-(stop - start) // LANES) * LANES)
    whole = np.empty((_n_columns(block, chain) + 1, block.height, size))
    for first in range(start, stop, size):
        last = min(first + size, stop)
        width = -(-(last - first) // LANES) * LANES
        panel = whole if width == size else np.empty((*whole.shape[:2], width))
        block.fill(arguments, turns, first, last, panel)
        yield first, last, panel


@compiled
def _fill_pairs(  # type: ignore[no-untyped-def]
    axis, value, cosine, sine, sign, joint, column, n_columns, n_own, turns,
    trig, a, b, measured, whitening, with_distance, with_angle, start, stop, panel,
):  # fmt: skip
    n_twists = n_columns + n_own
    R_A, R_B = np.empty((3, 3, LANES)), np.empty((3, 3, LANES))
    p_A, p_B = np.empty((3, LANES)), np.empty((3, LANES))
    t_A, t_B = np.zeros((n_twists, 6, LANES)), np.zeros((n_twists, 6, LANES))
    u, k, m_A, m_B = np.empty((3, LANES)), np.empty((3, LANES)), np.empty((3, LANES)), np.empty((3, LANES))
    w_dd, w_ad, w_aa = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    distance, angle = np.empty(LANES), np.empty(LANES)
    d_A, d_B, a_A, a_B = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    angle_row = 1 if with_distance else 0
    last_row = panel.shape[0] - 1
    for first in range(start, stop, LANES):
        at = first - start
        walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, a, first, R_A, p_A, t_A)
        walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, b, first, R_B, p_B, t_B)
        for i in range(LANES):
            n = first + i
            w_dd[i], w_ad[i], w_aa[i], distance[i], angle[i] = 0.0, 0.0, 0.0, 0.0, 0.0
            if n < stop:
                w_dd[i], w_ad[i], w_aa[i] = whitening[n, 0], whitening[n, 1], whitening[n, 2]
                distance[i], angle[i] = measured[n, 0], measured[n, 1]
        for i in range(LANES):
            x, y, z = p_B[0, i] - p_A[0, i], p_B[1, i] - p_A[1, i], p_B[2, i] - p_A[2, i]
            length = np.sqrt(x * x + y * y + z * z)
            inverse = 1.0 / max(length, 1e-300)
            u[0, i], u[1, i], u[2, i] = x * inverse, y * inverse, z * inverse
            distance[i] = length - distance[i]
        for c in range(3):
            for i in range(LANES):
                m_A[c, i] = p_A[(c + 1) % 3, i] * u[(c + 2) % 3, i] - p_A[(c + 2) % 3, i] * u[(c + 1) % 3, i]
                m_B[c, i] = p_B[(c + 1) % 3, i] * u[(c + 2) % 3, i] - p_B[(c + 2) % 3, i] * u[(c + 1) % 3, i]
        if with_angle:
            for i in range(LANES):
                x, y, z, trace = 0.0, 0.0, 0.0, 0.0
                for c in range(3):
                    x += R_A[c, 1, i] * R_B[c, 2, i] - R_A[c, 2, i] * R_B[c, 1, i]
                    y += R_A[c, 2, i] * R_B[c, 0, i] - R_A[c, 0, i] * R_B[c, 2, i]
                    z += R_A[c, 0, i] * R_B[c, 1, i] - R_A[c, 1, i] * R_B[c, 0, i]
                    trace += R_A[c, 0, i] * R_B[c, 0, i] + R_A[c, 1, i] * R_B[c, 1, i] + R_A[c, 2, i] * R_B[c, 2, i]
                twice_sine = np.sqrt(x * x + y * y + z * z)
                inverse = 1.0 / max(twice_sine, 1e-300)
                k[0, i], k[1, i], k[2, i] = x * inverse, y * inverse, z * inverse
                angle[i] = np.arctan2(twice_sine, trace - 1.0) - angle[i]
        if with_distance:
            for i in range(LANES):
                panel[last_row, 0, at + i] = w_dd[i] * distance[i]
        if with_angle:
            for i in range(LANES):
                panel[last_row, angle_row, at + i] = w_ad[i] * distance[i] + w_aa[i] * angle[i]
        for t in range(n_twists):
            for i in range(LANES):
                d_A[i] = u[0, i] * t_A[t, 3, i] + u[1, i] * t_A[t, 4, i] + u[2, i] * t_A[t, 5, i]
                d_B[i] = u[0, i] * t_B[t, 3, i] + u[1, i] * t_B[t, 4, i] + u[2, i] * t_B[t, 5, i]
            if turns[t]:
                for i in range(LANES):
                    d_A[i] += t_A[t, 0, i] * m_A[0, i] + t_A[t, 1, i] * m_A[1, i] + t_A[t, 2, i] * m_A[2, i]
                    d_B[i] += t_B[t, 0, i] * m_B[0, i] + t_B[t, 1, i] * m_B[1, i] + t_B[t, 2, i] * m_B[2, i]
                if with_angle:
                    for i in range(LANES):
                        a_A[i] = k[0, i] * t_A[t, 0, i] + k[1, i] * t_A[t, 1, i] + k[2, i] * t_A[t, 2, i]
                        a_B[i] = k[0, i] * t_B[t, 0, i] + k[1, i] * t_B[t, 1, i] + k[2, i] * t_B[t, 2, i]
            else:
                a_A[:] = 0.0
                a_B[:] = 0.0
            if t < n_columns:
                if with_distance:
                    for i in range(LANES):
                        panel[t, 0, at + i] = w_dd[i] * (d_B[i] - d_A[i])
                if with_angle:
                    for i in range(LANES):
                        panel[t, angle_row, at + i] = w_ad[i] * (d_B[i] - d_A[i]) + w_aa[i] * (a_B[i] - a_A[i])
            else:
                if with_distance:
                    for i in range(LANES):
                        panel[t, 0, at + i] = -w_dd[i] * d_A[i]
                        panel[t + n_own, 0, at + i] = w_dd[i] * d_B[i]
                if with_angle:
                    for i in range(LANES):
                        panel[t, angle_row, at + i] = -w_ad[i] * d_A[i] - w_aa[i] * a_A[i]
                        panel[t + n_own, angle_row, at + i] = w_ad[i] * d_B[i] + w_aa[i] * a_B[i]


@compiled
def _fill_same_points(  # type: ignore[no-untyped-def]
    axis, value, cosine, sine, sign, joint, column, n_columns, n_own, turns,
    trig, a, b, whitening, start, stop, panel,
):  # fmt: skip
    n_twists = n_columns + n_own
    R, p_A, p_B = np.empty((3, 3, LANES)), np.empty((3, LANES)), np.empty((3, LANES))
    t_A, t_B = np.zeros((n_twists, 6, LANES)), np.zeros((n_twists, 6, LANES))
    weight, raw = np.empty((3, 3, LANES)), np.empty((3, LANES))
    last_row = panel.shape[0] - 1
    for first in range(start, stop, LANES):
        walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, a, first, R, p_A, t_A)
        walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, b, first, R, p_B, t_B)
        _gather_whitening(whitening, first, stop, weight)
        for c in range(3):
            for i in range(LANES):
                raw[c, i] = p_B[c, i] - p_A[c, i]
        _write_whitened(weight, raw, 3, 1.0, panel[last_row], first - start)
        for t in range(n_twists):
            if t < n_columns:
                _point_derivative(t_A[t], p_A, raw)
                for c in range(3):
                    for i in range(LANES):
                        raw[c, i] = -raw[c, i]
                _add_point_derivative(t_B[t], p_B, raw)
                _forget_rigid_motion(t_A[t], t_B[t], raw)
                _write_whitened(weight, raw, 3, 1.0, panel[t], first - start)
            else:
                _point_derivative(t_A[t], p_A, raw)
                _write_whitened(weight, raw, 3, -1.0, panel[t], first - start)
                _point_derivative(t_B[t], p_B, raw)
                _write_whitened(weight, raw, 3, 1.0, panel[t + n_own], first - start)


@compiled
def _fill_poses(  # type: ignore[no-untyped-def]
    axis, value, cosine, sine, sign, joint, column, n_columns, n_own, turns,
    trig, rows, rotation, position, whitening, with_orientation, with_position, start, stop, panel,
):  # fmt: skip
    n_twists = n_columns + n_own
    height = 3 * (with_orientation + with_position)
    p0 = 3 if with_orientation else 0
    R, p, twist = np.empty((3, 3, LANES)), np.empty((3, LANES)), np.zeros((n_twists, 6, LANES))
    weight, raw, back = np.empty((height, height, LANES)), np.empty((height, LANES)), np.empty((3, 3, LANES))
    last_row = panel.shape[0] - 1
    for first in range(start, stop, LANES):
        walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, rows, first, R, p, twist)
        _gather_whitening(whitening, first, stop, weight)
        if with_orientation:
            for i in range(LANES):
                _orientation_residual(rotation[min(first + i, stop - 1)], R, i, raw, back)
        if with_position:
            for i in range(LANES):
                n = min(first + i, stop - 1)
                for c in range(3):
                    raw[p0 + c, i] = p[c, i] - position[n, c]
        _write_whitened(weight, raw, height, 1.0, panel[last_row], first - start)
        for t in range(n_twists):
            if with_orientation:
                for c in range(3):
                    for i in range(LANES):
                        raw[c, i] = (
                            back[c, 0, i] * twist[t, 0, i]
                            + back[c, 1, i] * twist[t, 1, i]
                            + back[c, 2, i] * twist[t, 2, i]
                        )
            if with_position:
                _point_derivative(twist[t], p, raw[p0:])
            _write_whitened(weight, raw, height, 1.0, panel[t], first - start)


@compiled
def _gather_whitening(whitening, first, stop, weight):  # type: ignore[no-untyped-def]
    for i in range(LANES):
        n = first + i
        for r in range(weight.shape[0]):
            for c in range(weight.shape[0]):
                weight[r, c, i] = whitening[n, r, c] if n < stop else 0.0


@compiled
def _point_derivative(twist, p, out):  # type: ignore[no-untyped-def]
    out[:3] = 0.0
    _add_point_derivative(twist, p, out)


@compiled
def _add_point_derivative(twist, p, out):  # type: ignore[no-untyped-def]
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        for i in range(LANES):
            out[c, i] += twist[a, i] * p[b, i] - twist[b, i] * p[a, i] + twist[3 + c, i]


@compiled
def _forget_rigid_motion(twist_A, twist_B, raw):  # type: ignore[no-untyped-def]
    """Zero the derivative in what moves both points as one body, such as the base.

    It only turns the vector between them, which no measurement sees. Such elements come before the first reading,
    so their twists are equal to the last bit.
    """
    for i in range(LANES):
        same = True
        for c in range(6):
            same = same and twist_A[c, i] == twist_B[c, i]
        if same:
            for c in range(3):
                raw[c, i] = 0.0


@compiled
def _write_whitened(weight, raw, height, factor, out, at):  # type: ignore[no-untyped-def]
    """Lower triangular weight times raw, into out[row, at + lane]."""
    for r in range(height):
        for i in range(LANES):
            out[r, at + i] = factor * weight[r, 0, i] * raw[0, i]
        for c in range(1, r + 1):
            for i in range(LANES):
                out[r, at + i] += factor * weight[r, c, i] * raw[c, i]


@compiled
def _orientation_residual(measured, R, i, raw, back):  # type: ignore[no-untyped-def]
    """Log(measured^T R) of lane i into raw[:3], and Jr^-1 R^T, which maps w to its derivative, into back."""
    E = np.empty((3, 3))
    for r in range(3):
        for c in range(3):
            E[r, c] = measured[0, r] * R[c, 0, i] + measured[1, r] * R[c, 1, i] + measured[2, r] * R[c, 2, i]
    x, y, z = 0.5 * (E[2, 1] - E[1, 2]), 0.5 * (E[0, 2] - E[2, 0]), 0.5 * (E[1, 0] - E[0, 1])
    sine = np.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (E[0, 0] + E[1, 1] + E[2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    if cosine > -0.99:
        factor = angle / sine if sine > 1e-9 else 1.0
        x, y, z = factor * x, factor * y, factor * z
    else:  # near half a turn the sine vanishes: the axis comes from the symmetric part, its sign from the other
        k = 0
        for c in range(1, 3):
            if E[c, c] > E[k, k]:
                k = c
        axis = np.empty(3)
        for c in range(3):
            axis[c] = 0.5 * (E[k, c] + E[c, k]) - (cosine if c == k else 0.0)
        norm = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
        if axis[0] * x + axis[1] * y + axis[2] * z < 0.0:
            norm = -norm
        x, y, z = angle * axis[0] / norm, angle * axis[1] / norm, angle * axis[2] / norm
    raw[0, i], raw[1, i], raw[2, i] = x, y, z
    # Jr^-1 = I + [r]x / 2 + g [r]x^2,  [r]x^2 = r r^T - angle^2 I
    if angle < 1e-4:
        g = 1.0 / 12.0 + angle * angle / 720.0
    else:
        half = 0.5 * angle
        g = (1.0 - half * np.cos(half) / np.sin(half)) / (angle * angle)
    log = (x, y, z)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for m in range(3):
            # row a of Jr^-1 times column m of R^T (component m of each column of R)
            diagonal = (1.0 + g * (log[a] * log[a] - angle * angle)) * R[a, m, i]
            back[a, m, i] = (
                diagonal
                + (g * log[a] * log[b] - 0.5 * log[c]) * R[b, m, i]
                + (g * log[a] * log[c] + 0.5 * log[b]) * R[c, m, i]
            )
