"""The compiled loops: the walk down a chain, and the rows of a Jacobian for any kind of measurement.

All of this is compiled by numba and runs on blocks of `LANES` configurations at once: arrays are shaped
(..., LANES) and the innermost loop runs over configurations, which the compiler turns into vector instructions.
(Inside the walk rotation and point are flat, so that it sees at which constant distance columns lie and that they do
not overlap.) Sine and cosine of the readings are taken once a data set (`Robot.trig`) and combined with those of
the parameters by the addition theorem, so no trigonometry happens inside.

A kind of measurement gives its residual and its wrench rows D: derivatives in a turn w about the base's axes through
the tool point and in a shift dp of that point (see `measurements.kinds`). A column's twist (w, v) moves the point by
`w x p + v`, so in its coordinates the rows are `(D_w + p x D_p, D_p)`: six products a row, column and end, three where
a column only translates. What a kind computes in numpy a *twin* may compute here, `LANES` measurements at once.

All kernels stand in this one file because numba's cache looks at the file of the outermost kernel alone: a change in
any of them then has all of them compiled anew.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fg_calib.robot._numba import compiled, inlined, part

LANES = 32
"""Configurations walked at once: the width of the innermost loops. Shorter loops would be unrolled, not vectorised."""


class ChainArrays(NamedTuple):
    """Arrays of a `kinematics.Chain` for the kernels, with an entry an element, then the counts.

    Attributes:
        axis: `model.Axis`.
        value: Value without the reading, [m] or [rad].
        cosine: Of the value.
        sine: Of the value.
        sign: Factor of parameter and reading.
        joint: Index of the joint whose reading is added, -1 for none.
        column: Jacobian column of the parameter, -1 for none.
        n_columns: Number of parameter columns.
        n_own: Number of joint columns: that of the joints, or 0.
        turns: For each column, then each joint, whether it belongs to a rotation.
        basis: Column of `trig` by which the element's value is multiplied, after those of the joints; -1 for none.
    """

    axis: NDArray[np.int8]
    value: NDArray[np.float64]
    cosine: NDArray[np.float64]
    sine: NDArray[np.float64]
    sign: NDArray[np.float64]
    joint: NDArray[np.int64]
    column: NDArray[np.int64]
    n_columns: int
    n_own: int
    turns: NDArray[np.bool_]
    basis: NDArray[np.int64]


@inlined
def walk(chain, trig, row, rotation, point, twist):  # type: ignore[no-untyped-def]
    """Walk `LANES` configurations down the chain.

    Args:
        chain: `ChainArrays`.
        trig: From `Robot.trig`, shape (n, n_joints, 2).
        row: Row of `trig` of each lane, shape (LANES,).
        rotation: Filled: rotation matrix, [column, component, lane], shape (3, 3, LANES).
        point: Filled: tool point, shape (3, LANES), [m].
        twist: Filled: (w, v) of each column, then of each joint, shape (n_columns + n_own, 6, LANES): the sum over the
            elements that it belongs to.
    """
    axis, value, cosine, sine, sign, joint, column, n_columns, n_own, _, basis = chain
    reading = np.empty(2 * LANES)
    twist[:] = 0.0
    R, p = rotation.reshape(9 * LANES), point.reshape(3 * LANES)
    R[:] = 0.0
    p[:] = 0.0
    for i in range(LANES):
        R[i] = 1.0
        R[4 * LANES + i] = 1.0
        R[8 * LANES + i] = 1.0
    for e in range(axis.shape[0]):
        k, j = axis[e], joint[e]
        if basis[e] >= 0:
            own = n_columns + j if n_own > 0 and j >= 0 else -1
            _walk_basis(k, value[e], sign[e], trig, row, basis[e], column[e], own, reading, R, p, twist)
            continue
        for target in (column[e], n_columns + j if n_own > 0 and j >= 0 else -1):
            if target >= 0:
                _add_twist(sign[e], R, k, p, twist[target])
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
            _turn_about_by_reading(k, reading, R)
        else:
            _turn_about(k, cosine[e], sine[e], R)


@inlined
def _add_twist(sign, R, k, p, twist):  # type: ignore[no-untyped-def]
    """Add the twist of an element along or about its axis."""
    if k < 3:
        for c in range(3):
            for i in range(LANES):
                twist[3 + c, i] += sign * R[(3 * k + c) * LANES + i]
        return
    w = 3 * (k - 3) * LANES
    for i in range(LANES):
        w0 = sign * R[w + i]
        w1 = sign * R[w + LANES + i]
        w2 = sign * R[w + 2 * LANES + i]
        twist[0, i] += w0
        twist[1, i] += w1
        twist[2, i] += w2
        twist[3, i] += p[LANES + i] * w2 - p[2 * LANES + i] * w1
        twist[4, i] += p[2 * LANES + i] * w0 - p[i] * w2
        twist[5, i] += p[i] * w1 - p[LANES + i] * w0


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
def _turn_about(k, cosine, sine, R):  # type: ignore[no-untyped-def]
    if k == 3:
        _turn(cosine, sine, R, 1, 2)
    elif k == 4:
        _turn(cosine, sine, R, 2, 0)
    else:
        _turn(cosine, sine, R, 0, 1)


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


@inlined
def _turn_about_by_reading(k, reading, R):  # type: ignore[no-untyped-def]
    if k == 3:
        _turn_by_reading(reading, R, 1, 2)
    elif k == 4:
        _turn_by_reading(reading, R, 2, 0)
    else:
        _turn_by_reading(reading, R, 0, 1)


@part
def _walk_basis(k, coefficient, sign, trig, row, basis, column, own, reading, R, p, twist):  # type: ignore[no-untyped-def]
    """An element whose value is a coefficient times a basis function, which `trig` has with its slope in a reading."""
    for target, which in ((column, 0), (own, 1)):
        if target >= 0:
            unit = np.zeros((6, LANES))
            _add_twist(sign if which == 0 else coefficient, R, k, p, unit)
            for c in range(6):
                for i in range(LANES):
                    twist[target, c, i] += trig[row[i], basis, which] * unit[c, i]
    for i in range(LANES):
        angle = coefficient * trig[row[i], basis, 0]
        reading[i] = angle if k < 3 else np.cos(angle)
        reading[LANES + i] = np.sin(angle)
    if k < 3:
        _shift_by_reading(0.0, 1.0, reading, R, k, p)
    else:
        _turn_about_by_reading(k, reading, R)


@compiled
def walk_all(chain, trig, rows, start, stop, out_R, out_p, out_J):  # type: ignore[no-untyped-def]
    """Rotation (n, 3, 3), point (n, 3) and derivatives (n, 6, n_columns + n_own) of rows start to stop."""
    n_twists = chain.n_columns + chain.n_own
    rotation, point, row = np.empty((3, 3, LANES)), np.empty((3, LANES)), np.empty(LANES, np.int64)
    twist = np.zeros((n_twists, 6, LANES))
    for first in range(start, stop, LANES):
        for i in range(LANES):
            row[i] = rows[min(first + i, stop - 1)]
        walk(chain, trig, row, rotation, point, twist)
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


@compiled
def fill(chain, trig, ends, data, whitening, twins, given, turning, panel):  # type: ignore[no-untyped-def]
    """Whitened derivatives and residuals of some measurements of any kind.

    Args:
        chain: `ChainArrays`.
        trig: From `Robot.trig`, shape (n_configurations, n_joints, 2).
        ends: Row of `trig` of each end, shape (n, n_ends).
        data: Measured values, shape (n, width).
        whitening: Lower triangles, row by row, shape (n, d * (d + 1) / 2), d the `residual_dim`.
        twins: Of a kind that is computed here, part by part: code, first row, first column of `data`, shape (n_parts,
            3).
        given: Of another kind: residuals (n, d) and wrench rows (n, n_ends, d, 6). Of any: derivatives in nuisances,
            shape (n, d, n_nuisances).
        turning: Turn of the base in each column that the residual is turned back by, shape (3, n_columns); (3, 0) if
            it is not.
        panel: Filled: [column, row, measurement], shape (n_columns + n_ends * n_own + n_nuisances + 1, d, m), m the
            next multiple of `LANES`; the last column is the residual, lanes without a measurement are zero.
    """
    n, n_ends = ends.shape
    residual_dim, n_twists, n_nuisances = panel.shape[1], chain.n_columns + chain.n_own, given[2].shape[2]
    turned = turning.shape[1] > 0
    n_wrenches = n_ends + 1 if turned else n_ends  # the base is one more end
    R, p = np.empty((n_ends, 3, 3, LANES)), np.empty((n_ends, 3, LANES))
    T, D = np.zeros((n_wrenches, n_twists, 6, LANES)), np.zeros((n_wrenches, residual_dim, 6, LANES))
    width = 6 * LANES if n_twists > 0 else LANES
    r, weight, row = np.empty((residual_dim, LANES)), np.empty((whitening.shape[1], width)), np.empty(LANES, np.int64)
    if turned:
        for t in range(chain.n_columns):
            for c in range(3):
                for i in range(LANES):
                    T[n_ends, t, c, i] = turning[c, t]
    for first in range(0, n, LANES):
        for e in range(n_ends):
            for i in range(LANES):
                row[i] = ends[min(first + i, n - 1), e]
            walk(chain, trig, row, R[e], p[e], T[e])
        _gather_whitening(whitening, first, weight)
        if twins.shape[0] == 0:
            _gather(given, first, r, D)
        for k in range(twins.shape[0]):
            _run_twin(twins[k], R, p, data, first, n_twists > 0, r, D)
        if turned:
            _turn_back(r, D[n_ends])
        _whiten(weight, r)
        for h in range(residual_dim):
            for i in range(LANES):
                panel[panel.shape[0] - 1, h, first + i] = r[h, i]
        if n_twists > 0:
            for e in range(n_wrenches):
                if e < n_ends:
                    _about_origin(p[e], D[e])
                _whiten(weight, D[e].reshape(residual_dim, 6 * LANES))
            _contract(chain, n_ends, T, D, panel, first)
        if n_nuisances > 0:
            _fill_nuisances(given[2], weight, first, panel)


@compiled
def whiten_small(covariances, used, start, stop, out):  # type: ignore[no-untyped-def]
    """Inverse Cholesky factors of many small covariances, by the rows in use; whether all of them have one.

    Args:
        covariances: Shape (n, d, d).
        used: Shape (n, d).
        start: First of those that are wanted.
        stop: The one after the last.
        out: Filled: lower triangles, zero in what is not in use, shape (n, d, d).
    """
    d = used.shape[1]
    L = np.zeros((d, d))
    for n in range(start, stop):
        C, W, mine = covariances[n], out[n], used[n]
        W[:] = 0.0
        for i in range(d):
            for j in range(i + 1):
                left = C[i, j] if mine[i] and mine[j] else 0.0
                for k in range(j):
                    left -= L[i, k] * L[j, k]
                if i > j:
                    L[i, j] = left / L[j, j]
                elif not mine[i]:
                    L[i, i] = 1.0
                elif left > 0.0:
                    L[i, i] = np.sqrt(left)
                else:
                    return False
            if mine[i]:
                for j in range(i):
                    total = 0.0
                    for k in range(j, i):
                        total -= L[i, k] * W[k, j]
                    W[i, j] = total / L[i, i]
                W[i, i] = 1.0 / L[i, i]
    return True


@compiled
def add_gram(products, knots, weights, total):  # type: ignore[no-untyped-def]
    """Add the Gram matrix of turns times splines, its upper triangle alone.

    Args:
        products: Gram matrix of each measurement's derivatives in its turns, shape (n, k, k).
        knots: Numbers of the splines that its turns depend on, four each, shape (n, 4 k).
        weights: Values of these, shape (n, 4 k).
        total: What it is added to, shape (n_splines, n_splines).
    """
    for i in range(knots.shape[0]):
        for a in range(knots.shape[1]):
            for b in range(knots.shape[1]):
                if knots[i, a] <= knots[i, b]:
                    product = products[i, a // 4, b // 4] * weights[i, a] * weights[i, b]
                    total[knots[i, a], knots[i, b]] += product


@inlined
def _gather_whitening(whitening, first, weight):  # type: ignore[no-untyped-def]
    """Whitening of each lane, zero where there is no measurement, once for each component of a wrench."""
    n = whitening.shape[0]
    for k in range(weight.shape[0]):
        for i in range(LANES):
            weight[k, i] = whitening[first + i, k] if first + i < n else 0.0
        for i in range(LANES, weight.shape[1]):
            weight[k, i] = weight[k, i - LANES]


@part
def _gather(given, first, r, D):  # type: ignore[no-untyped-def]
    """Residuals and wrench rows that numpy computed, lane by lane."""
    residual, wrenches, _ = given
    n, n_ends, residual_dim, _ = wrenches.shape
    for h in range(residual_dim):
        for i in range(LANES):
            r[h, i] = residual[min(first + i, n - 1), h]
        for e in range(n_ends):
            for c in range(6):
                for i in range(LANES):
                    D[e, h, c, i] = wrenches[min(first + i, n - 1), e, h, c]


@part
def _turn_back(r, D):  # type: ignore[no-untyped-def]
    """Wrench rows of a turn a of the base by which a residual of three coordinates is turned back: -a x r."""
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        for i in range(LANES):
            D[c, c, i] = 0.0
            D[c, a, i] = -r[b, i]
            D[c, b, i] = r[a, i]


@inlined
def _about_origin(p, D):  # type: ignore[no-untyped-def]
    """Wrench rows about the tool point become those about the base's origin: D_w + p x D_p."""
    for h in range(D.shape[0]):
        for c in range(3):
            a, b = (c + 1) % 3, (c + 2) % 3
            for i in range(LANES):
                D[h, c, i] += p[a, i] * D[h, 3 + b, i] - p[b, i] * D[h, 3 + a, i]


@inlined
def _whiten(weight, rows):  # type: ignore[no-untyped-def]
    """Rows, [row, as many figures as lanes or six times these], become a lower triangle times them."""
    residual_dim, size = rows.shape
    for h in range(residual_dim - 1, -1, -1):
        k = h * (h + 1) // 2
        _scale(weight[k + h, :size], rows[h])
        for g in range(h):
            _add_scaled(weight[k + g, :size], rows[g], rows[h])


@inlined
def _scale(factor, row):  # type: ignore[no-untyped-def]
    for i in range(row.shape[0]):
        row[i] *= factor[i]


@inlined
def _add_scaled(factor, other, row):  # type: ignore[no-untyped-def]
    for i in range(row.shape[0]):
        row[i] += factor[i] * other[i]


@inlined
def _contract(chain, n_ends, T, D, panel, at):  # type: ignore[no-untyped-def]
    """Wrench rows times twists: in each column the sum over the ends, in the joints each end by itself."""
    n_wrenches, n_twists, residual_dim, size = T.shape[0], T.shape[1], D.shape[1], 6 * LANES
    T, D = T.reshape(-1), D.reshape(-1)
    for t in range(n_twists):
        own = t >= chain.n_columns
        for e in range(n_ends if own else n_wrenches):
            column = t + e * chain.n_own if own else t
            twist = T[(e * n_twists + t) * size : (e * n_twists + t + 1) * size]
            for h in range(residual_dim):
                wrench = D[(e * residual_dim + h) * size : (e * residual_dim + h + 1) * size]
                if own or e == 0:
                    panel[column, h, at : at + LANES] = 0.0
                _add_product(chain.turns[t], wrench, twist, panel[column, h, at : at + LANES])


@inlined
def _add_product(turns, D, T, out):  # type: ignore[no-untyped-def]
    if turns:
        for i in range(LANES):
            out[i] += (
                D[i] * T[i] + D[LANES + i] * T[LANES + i] + D[2 * LANES + i] * T[2 * LANES + i]
                + D[3 * LANES + i] * T[3 * LANES + i] + D[4 * LANES + i] * T[4 * LANES + i]
                + D[5 * LANES + i] * T[5 * LANES + i]
            )  # fmt: skip
    else:
        for i in range(LANES):
            out[i] += (
                D[3 * LANES + i] * T[3 * LANES + i] + D[4 * LANES + i] * T[4 * LANES + i]
                + D[5 * LANES + i] * T[5 * LANES + i]
            )  # fmt: skip


@part
def _fill_nuisances(derivatives, weight, first, panel):  # type: ignore[no-untyped-def]
    """Whitened derivatives in the nuisances, which stand before the residual."""
    n, residual_dim, n_nuisances = derivatives.shape
    rows = np.empty((residual_dim, LANES))
    for k in range(n_nuisances):
        for h in range(residual_dim):
            for i in range(LANES):
                rows[h, i] = derivatives[min(first + i, n - 1), h, k]
        _whiten(weight, rows)
        for h in range(residual_dim):
            for i in range(LANES):
                panel[panel.shape[0] - 1 - n_nuisances + k, h, first + i] = rows[h, i]


DISTANCE, ROTATION_ANGLE, POSITION, ORIENTATION = range(4)
"""Codes of the twins."""


@inlined
def _run_twin(twin, R, p, data, first, derived, r, D):  # type: ignore[no-untyped-def]
    """Residuals of `LANES` measurements of a kind, from its first row and column of data on, and wrench rows."""
    code, h, column = twin[0], twin[1], twin[2]
    if code == DISTANCE:
        _distance(p, data, first, column, derived, r[h], D[0, h], D[1, h])
    elif code == ROTATION_ANGLE:
        _rotation_angle(R, data, first, column, derived, r[h], D[0, h], D[1, h])
    elif code == POSITION:
        _position(p[0], data, first, column, r[h:], D[0, h:])
    elif code == ORIENTATION:
        D[0, h : h + 3] = 0.0
        for i in range(LANES):
            _orientation(R[0], data[min(first + i, data.shape[0] - 1), column:], i, derived, r[h:], D[0, h:])


@inlined
def _distance(p, data, first, column, derived, r, D_A, D_B):  # type: ignore[no-untyped-def]
    p, u = p.reshape(-1), D_B.reshape(-1)[3 * LANES :]
    for i in range(LANES):
        x, y, z = p[3 * LANES + i] - p[i], p[4 * LANES + i] - p[LANES + i], p[5 * LANES + i] - p[2 * LANES + i]
        u[i], u[LANES + i], u[2 * LANES + i] = x, y, z
    _normalise(u, r)
    if derived:
        D_B[:3] = 0.0
        _negate(D_B, D_A)
    for i in range(LANES):
        r[i] -= data[min(first + i, data.shape[0] - 1), column]


@inlined
def _rotation_angle(R, data, first, column, derived, r, D_A, D_B):  # type: ignore[no-untyped-def]
    R, k, cosine = R.reshape(-1), D_B.reshape(-1), np.empty(LANES)
    B = 9 * LANES
    for i in range(LANES):
        x, y, z, trace = 0.0, 0.0, 0.0, 0.0
        for c in range(3):
            n = 3 * c * LANES + i
            x += R[n + LANES] * R[B + n + 2 * LANES] - R[n + 2 * LANES] * R[B + n + LANES]
            y += R[n + 2 * LANES] * R[B + n] - R[n] * R[B + n + 2 * LANES]
            z += R[n] * R[B + n + LANES] - R[n + LANES] * R[B + n]
            trace += R[n] * R[B + n] + R[n + LANES] * R[B + n + LANES] + R[n + 2 * LANES] * R[B + n + 2 * LANES]
        k[i], k[LANES + i], k[2 * LANES + i] = x, y, z
        cosine[i] = trace - 1.0
    _normalise(k, r)
    if derived:
        D_B[3:] = 0.0
        _negate(D_B, D_A)
    for i in range(LANES):
        r[i] = np.arctan2(r[i], cosine[i]) - data[min(first + i, data.shape[0] - 1), column]


@inlined
def _normalise(vector, length):  # type: ignore[no-untyped-def]
    """The vectors, [component, lane] in one row, become directions; zero has none."""
    for i in range(LANES):
        x, y, z = vector[i], vector[LANES + i], vector[2 * LANES + i]
        length[i] = np.sqrt(x * x + y * y + z * z)
    for i in range(LANES):
        inverse = 1.0 / max(length[i], 1e-300)
        vector[i] *= inverse
        vector[LANES + i] *= inverse
        vector[2 * LANES + i] *= inverse


@inlined
def _position(p, data, first, column, r, D):  # type: ignore[no-untyped-def]
    D[:3] = 0.0
    for c in range(3):
        for i in range(LANES):
            r[c, i] = p[c, i] - data[min(first + i, data.shape[0] - 1), column + c]
            D[c, 3 + c, i] = 1.0


@inlined
def _negate(D_B, D_A):  # type: ignore[no-untyped-def]
    for c in range(6):
        for i in range(LANES):
            D_A[c, i] = -D_B[c, i]


@part
def _orientation(R, data, i, derived, r, D):  # type: ignore[no-untyped-def]
    """Log(measured^T R) of lane i, and Jr^-1 R^T, which maps w to its derivative; data are measured, row by row."""
    E = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            E[a, b] = data[a] * R[b, 0, i] + data[3 + a] * R[b, 1, i] + data[6 + a] * R[b, 2, i]
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
    r[0, i], r[1, i], r[2, i] = x, y, z
    if not derived:
        return
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
            D[a, m, i] = (
                diagonal
                + (g * log[a] * log[b] - 0.5 * log[c]) * R[b, m, i]
                + (g * log[a] * log[c] + 0.5 * log[b]) * R[c, m, i]
            )
