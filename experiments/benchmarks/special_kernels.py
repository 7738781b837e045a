"""The kernels of one kind of measurement each, as they were before one kernel served all: for comparison alone.

They differ from `fg_calib.robot.kernels` in that each knows which entries of its wrench rows are zero.
"""

import numpy as np

from fg_calib.robot.kernels import LANES, compiled, inlined


@compiled
def walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, rows, start, rotation, point, twist):
    """Walk `LANES` configurations down the chain.

    Args:
        axis, value, cosine, sine, sign, joint, column, n_columns, n_own: those of `ChainArrays`.
        trig: From `precompute_trig`, shape (n, n_joints, 2).
        rows: Rows of `trig`, shape (m,); positions beyond its end repeat the last.
        start: Position in `rows` of the first lane.
        rotation: Filled: rotation matrix, [column, component, lane], shape (3, 3, LANES).
        point: Filled: tool point, shape (3, LANES), [m].
        twist: Filled: (w, v) of each column, then of each joint, shape (n_columns + n_own, 6, LANES): the sum over the
            elements that it belongs to. Must come with w = 0 for columns of translations alone.
    """
    last = rows.shape[0] - 1
    row = np.empty(LANES, np.int64)
    reading = np.empty(2 * LANES)
    written = np.zeros(twist.shape[0], np.bool_)
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
            if written[target]:
                _add_twist(sign[e], R, k, p, twist[target])
                continue
            written[target] = True
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
def _write_rotation_twist(sign, R, k, p, twist):
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
def _write_translation_twist(sign, R, k, twist):
    for c in range(3):
        for i in range(LANES):
            twist[3 + c, i] = sign * R[(3 * k + c) * LANES + i]


@compiled
def _add_twist(sign, R, k, p, twist):
    """The twist of a further element of a column: it moves with all of them."""
    more = np.zeros((6, LANES))
    if k >= 3:
        _write_rotation_twist(sign, R, k - 3, p, more)
    else:
        _write_translation_twist(sign, R, k, more)
    twist += more


@inlined
def _shift(value, R, k, p):
    for c in range(3):
        for i in range(LANES):
            p[c * LANES + i] += value * R[(3 * k + c) * LANES + i]


@inlined
def _shift_by_reading(value, sign, reading, R, k, p):
    for c in range(3):
        for i in range(LANES):
            p[c * LANES + i] += (value + sign * reading[i]) * R[(3 * k + c) * LANES + i]


@inlined
def _turn(cosine, sine, R, a, b):
    for c in range(3):
        for i in range(LANES):
            x, y = R[(3 * a + c) * LANES + i], R[(3 * b + c) * LANES + i]
            R[(3 * a + c) * LANES + i] = cosine * x + sine * y
            R[(3 * b + c) * LANES + i] = cosine * y - sine * x


@inlined
def _add_angles(cosine, sine, reading):
    """Cosine and sine of the reading become those of its sum with a value."""
    for i in range(LANES):
        c, s = reading[i], reading[LANES + i]
        reading[i] = cosine * c - sine * s
        reading[LANES + i] = sine * c + cosine * s


@inlined
def _turn_by_reading(reading, R, a, b):
    for c in range(3):
        for i in range(LANES):
            x, y = R[(3 * a + c) * LANES + i], R[(3 * b + c) * LANES + i]
            R[(3 * a + c) * LANES + i] = reading[i] * x + reading[LANES + i] * y
            R[(3 * b + c) * LANES + i] = reading[i] * y - reading[LANES + i] * x


@compiled
def fill_pairs(
    axis, value, cosine, sine, sign, joint, column, n_columns, n_own, turns,
    trig, a, b, measured, whitening, with_distance, with_angle, start, stop, panel,
):  # fmt: skip
    """Distances and rotation angles of pairs start to stop."""
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
def fill_same_points(
    axis, value, cosine, sine, sign, joint, column, n_columns, n_own, turns,
    trig, a, b, whitening, turning, start, stop, panel,
):  # fmt: skip
    """Vectors between the points of pairs start to stop."""
    n_twists = n_columns + n_own
    R, p_A, p_B = np.empty((3, 3, LANES)), np.empty((3, LANES)), np.empty((3, LANES))
    t_A, t_B = np.zeros((n_twists, 6, LANES)), np.zeros((n_twists, 6, LANES))
    weight, vector, raw = np.empty((3, 3, LANES)), np.empty((3, LANES)), np.empty((3, LANES))
    last_row = panel.shape[0] - 1
    for first in range(start, stop, LANES):
        walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, a, first, R, p_A, t_A)
        walk(axis, value, cosine, sine, sign, joint, column, n_columns, n_own, trig, b, first, R, p_B, t_B)
        _gather_whitening(whitening, first, stop, weight)
        for c in range(3):
            for i in range(LANES):
                vector[c, i] = p_B[c, i] - p_A[c, i]
        _write_whitened(weight, vector, 3, 1.0, panel[last_row], first - start)
        for t in range(n_twists):
            if t < n_columns:
                _point_derivative(t_A[t], p_A, raw)
                for c in range(3):
                    for i in range(LANES):
                        raw[c, i] = -raw[c, i]
                _add_point_derivative(t_B[t], p_B, raw)
                for c in range(3):
                    d, e = (c + 1) % 3, (c + 2) % 3
                    for i in range(LANES):
                        raw[c, i] -= turning[d, t] * vector[e, i] - turning[e, t] * vector[d, i]
                _write_whitened(weight, raw, 3, 1.0, panel[t], first - start)
            else:
                _point_derivative(t_A[t], p_A, raw)
                _write_whitened(weight, raw, 3, -1.0, panel[t], first - start)
                _point_derivative(t_B[t], p_B, raw)
                _write_whitened(weight, raw, 3, 1.0, panel[t + n_own], first - start)


@compiled
def fill_poses(
    axis, value, cosine, sine, sign, joint, column, n_columns, n_own, turns,
    trig, rows, rotation, position, whitening, with_orientation, with_position, start, stop, panel,
):  # fmt: skip
    """Orientations and positions of measurements start to stop."""
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
def _gather_whitening(whitening, first, stop, weight):
    for i in range(LANES):
        n = first + i
        for r in range(weight.shape[0]):
            for c in range(weight.shape[0]):
                weight[r, c, i] = whitening[n, r, c] if n < stop else 0.0


@compiled
def _point_derivative(twist, p, out):
    out[:3] = 0.0
    _add_point_derivative(twist, p, out)


@compiled
def _add_point_derivative(twist, p, out):
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        for i in range(LANES):
            out[c, i] += twist[a, i] * p[b, i] - twist[b, i] * p[a, i] + twist[3 + c, i]


@compiled
def _write_whitened(weight, raw, height, factor, out, at):
    """Lower triangular weight times raw, into out[row, at + lane]."""
    for r in range(height):
        for i in range(LANES):
            out[r, at + i] = factor * weight[r, 0, i] * raw[0, i]
        for c in range(1, r + 1):
            for i in range(LANES):
                out[r, at + i] += factor * weight[r, c, i] * raw[c, i]


@compiled
def _orientation_residual(measured, R, i, raw, back):
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
