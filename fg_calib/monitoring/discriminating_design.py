"""Which configurations to measure beside those there are, so that explanations that these leave open are distinguished.

Of random configurations that could be measured like the rows there are (see `candidates`) those are taken, one after
the other, that make the least difference of two explanations largest: with a_i d_i what explanation i makes of all
rows, old and new, and what is known and free fitted, `D_ij` is what is left of it when j has been fitted. If i is true,
chi-square with j is above that with i by about `D_ij + 1 +- 2 sqrt(D_ij)`; so D must reach
`(sqrt(threshold) + MARGIN)^2`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.monitoring.candidates import candidates
from fg_calib.monitoring.hypotheses import HypothesisTest, columns_of, motion, quantile
from fg_calib.monitoring.new_data import Calibrated, Linear

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_ADVISED = 12
"""Configurations that are advised at most."""

LEAST = 0.1
"""Sigma that the first configuration must tell explanations apart by; else more of them do not either."""

MARGIN = 2.5
"""Sigma by which the difference is to exceed what tells apart: so a difference is missed less often than 1 in 100."""


@dataclass(frozen=True)
class Advice(FrozenArrays):
    """Configurations that would tell explanations apart.

    Attributes:
        readings: They, one after the other, shape (n, n_joints), [rad] (prismatic: [m]).
        between: The two explanations that differ least with all of them.
        apart: How far the tool is apart there by these two, shape (n,), [m].
        sigma: The root of the least difference after each, in sigma, shape (n,).
        needed: What it must reach.
        enough: Whether it does.
    """

    readings: Floats
    between: tuple[tuple[str, ...], tuple[str, ...]]
    apart: Floats
    sigma: Floats
    needed: float
    enough: bool


def separating(
    calibrated: Calibrated, rows: Linear, likely: Sequence[HypothesisTest], probability: float
) -> Advice | None:
    """What to measure to tell the likely explanations apart; None where nothing measured like them helps.

    Args:
        calibrated: The arm.
        rows: The rows there are.
        likely: Explanations that they leave open.
        probability: Of calling the true one distinguished, one of them.
    """
    known = [f for f in likely if f.hypothesis.kind != "row"]
    new = candidates(rows) if len(known) > 1 else None
    if new is None:
        return None
    fitted = new.columns @ rows.directions
    needed = float(np.sqrt(quantile(probability, max(f.k for f in known)))) + MARGIN
    X = rows.system
    N = X.T @ X
    own = [columns_of(f.hypothesis, calibrated)(rows) for f in known]
    G = [rows.stacked(c) for c in own]
    cross = [X.T @ g for g in G]
    square = [[a.T @ b for b in G] for a in G]
    of_new = [_columns(calibrated, rows, f, new.columns, new.joints) for f in known]
    chosen: list[int] = []
    sigma, between = [], (known[0].hypothesis.names, known[1].hypothesis.names)
    while len(chosen) < MOST_ADVISED:
        best, best_k, pair = -1.0, -1, (0, 1)
        for k in range(len(fitted)):
            at = [*chosen, k]
            D, worst = _least(N, cross, square, fitted[at], [c[at] for c in of_new], known)
            if best < D:
                best, best_k, pair = D, k, worst
        chosen.append(best_k)
        sigma.append(float(np.sqrt(max(best, 0.0))))
        between = known[pair[0]].hypothesis.names, known[pair[1]].hypothesis.names
        if sigma[0] < LEAST:
            return None
        if sigma[-1] >= needed:
            break
    q = new.readings[chosen]
    apart = _apart(calibrated, known, between, q)
    return Advice(q, between, apart, np.array(sigma), needed, sigma[-1] >= needed)


def _apart(
    calibrated: Calibrated, known: Sequence[HypothesisTest], between: Sequence[tuple[str, ...]], readings: Floats
) -> Floats:
    """How far the tool is apart by two explanations, shape (n,), [m]."""
    one, other = (
        motion(calibrated, next(f for f in known if f.hypothesis.names == names), readings) for names in between
    )
    out: Floats = np.linalg.norm((one - other)[:, 1], axis=1)
    return out


def _least(
    N: Floats,
    cross: list[Floats],
    square: list[list[Floats]],
    fitted: Floats,
    of_new: list[Floats],
    known: Sequence[HypothesisTest],
) -> tuple[float, tuple[int, int]]:
    """The least of what is left of one explanation with another fitted, and of which two."""
    X = fitted.reshape(-1, fitted.shape[2])
    Y = [c.reshape(-1, c.shape[2]) for c in of_new]
    M = N + X.T @ X
    scale = 1.0 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    inverse = np.linalg.pinv(M * np.outer(scale, scale), rcond=1e-13, hermitian=True) * np.outer(scale, scale)
    C = [c + X.T @ y for c, y in zip(cross, Y, strict=True)]
    n = len(known)
    S = [[square[i][j] + Y[i].T @ Y[j] - C[i].T @ inverse @ C[j] for j in range(n)] for i in range(n)]
    best, pair = np.inf, (0, 1)
    for i in range(n):
        d = known[i].change
        for j in range(n):
            if i != j:
                t = S[j][i] @ d
                D = float(d @ S[i][i] @ d - t @ np.linalg.pinv(S[j][j], rcond=1e-12) @ t)
                if best > D:
                    best, pair = D, (i, j)
    return best, pair


def _columns(calibrated: Calibrated, rows: Linear, found: HypothesisTest, columns: Floats, joints: Floats) -> Floats:
    """Derivatives of candidates in a hypothesis, shape (n, h, k).

    Args:
        calibrated: The arm.
        rows: The rows there are.
        found: The hypothesis.
        columns: Derivatives in their columns, shape (n, h, n_columns + n_nuisance).
        joints: Derivatives in the joints' zeros, shape (n, h, n_joints).
    """
    n, h, wide = columns.shape
    flat = replace(rows, columns=columns.reshape(-1, wide), joints=joints.reshape(n * h, -1))
    out: Floats = columns_of(found.hypothesis, calibrated)(flat).reshape(n, h, -1)
    return out
