"""Which configurations to measure beside those there are, so that explanations that these leave open are told apart.

Of random configurations within the joint limits those are taken, one after the other, that make the least difference of
two explanations largest: with a_i d_i what explanation i makes of all rows, old and new, and what is known and free
fitted, `D_ij` is what is left of it when j has been fitted. If i is true, chi-square with j is above that with i by
about `D_ij + 1 +- 2 sqrt(D_ij)`; so D must reach `(sqrt(threshold) + MARGIN)^2`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.analysis.new_rows import Calibrated, Linear
from fg_calib.analysis.suspects import Found, columns_of, quantile
from fg_calib.arrays import FrozenArrays
from fg_calib.graph.factors import build_variables
from fg_calib.options import POSE_MODELS
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import forward, precompute_trig

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

N_CANDIDATES = 200
"""Random configurations to choose from."""

MOST_ADVISED = 12
"""Configurations that are advised at most."""

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


def separating(calibrated: Calibrated, rows: Linear, likely: Sequence[Found], probability: float) -> Advice | None:
    """What to measure to tell the likely explanations apart; None where no configuration of the arm helps.

    Args:
        calibrated: The arm.
        rows: The rows there are.
        likely: Explanations that they leave open.
        probability: Of calling the true one told apart, one of them.
    """
    known = [f for f in likely if f.suspect.kind != "row"]
    table = _table_to_add_to(rows)
    if len(known) < 2 or table is None:
        return None
    q = random_readings(calibrated.robot, N_CANDIDATES, np.random.default_rng(0))
    new = _Rows(calibrated, rows, q, table)
    needed = float(np.sqrt(quantile(probability, max(f.k for f in known)))) + MARGIN
    X = rows.system
    N = X.T @ X
    own = [columns_of(f.suspect, calibrated)(rows) for f in known]
    G = [rows.stacked(c) for c in own]
    cross = [X.T @ g for g in G]
    square = [[a.T @ b for b in G] for a in G]
    of_new = [new.columns(f) for f in known]
    chosen: list[int] = []
    sigma, between = [], (known[0].suspect.names, known[1].suspect.names)
    while len(chosen) < MOST_ADVISED:
        best, best_k, pair = -1.0, -1, (0, 1)
        for k in range(N_CANDIDATES):
            at = [*chosen, k]
            D, worst = _least(N, cross, square, new.fitted[at], [c[at] for c in of_new], known)
            if best < D:
                best, best_k, pair = D, k, worst
        chosen.append(best_k)
        sigma.append(float(np.sqrt(max(best, 0.0))))
        between = known[pair[0]].suspect.names, known[pair[1]].suspect.names
        if sigma[-1] >= needed:
            break
    return Advice(q[chosen], between, new.apart(known, between)[chosen], np.array(sigma), needed, sigma[-1] >= needed)


def _least(
    N: Floats,
    cross: list[Floats],
    square: list[list[Floats]],
    fitted: Floats,
    of_new: list[Floats],
    known: Sequence[Found],
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


def _table_to_add_to(rows: Linear) -> int | None:
    """The first table of poses; None without any."""
    for number, table in enumerate(rows.placed.problem.data.tables):
        if table.model in POSE_MODELS:
            return number
    return None


class _Rows:
    """Candidate configurations as rows that would be added to a table.

    Args:
        calibrated: The arm.
        rows: The rows there are.
        q: The candidates, shape (n, n_joints).
        table: Number of the table.

    Attributes:
        fitted: Their derivatives in what is fitted, shape (n, 6, n_fitted).
    """

    def __init__(self, calibrated: Calibrated, rows: Linear, q: Floats, table: int) -> None:
        self._calibrated, self._rows = calibrated, rows
        problem = rows.placed.problem
        v, t = problem.variables, problem.data.tables[table]
        m = t.measurements
        turned, placed = POSE_MODELS[t.model]  # type: ignore[index]
        sigma = (m.sigma_orientation if turned else None, m.sigma_position if placed else None)
        weight = [0.0 if s is None else 1.0 / float(np.sqrt(np.nanmean(np.asarray(s) ** 2))) for s in sigma]
        self._robot, self._trig = v.robot, precompute_trig(v.robot, q)
        at = forward(v.chains[table].at(problem.start).with_joint_columns(), self._trig)
        weighted = at.jacobian * np.repeat(weight, 3)[:, None]
        self._columns = np.zeros((len(q), 6, v.n_columns + v.n_nuisance))
        self._columns[:, :, : v.n_columns] = weighted[:, :, : v.n_columns]
        self._joints = weighted[:, :, v.n_columns :]
        self.fitted = self._columns @ rows.directions

    def columns(self, found: Found) -> Floats:
        """Derivatives of the candidates in a suspect, shape (n, 6, k)."""
        n, _, wide = self._columns.shape
        flat = replace(self._rows, columns=self._columns.reshape(-1, wide), joints=self._joints.reshape(6 * n, -1))
        out: Floats = columns_of(found.suspect, self._calibrated)(flat).reshape(n, 6, -1)
        return out

    def apart(self, known: Sequence[Found], between: Sequence[tuple[str, ...]]) -> Floats:
        """How far the tool is apart by two explanations, shape (n,), [m]."""
        v = build_variables(self._robot, [False], False)
        x = np.append(self._robot.nominal, np.zeros(6))
        J = forward(v.chains[0].at(x).with_joint_columns(), self._trig).jacobian
        n = v.n_columns
        flat = replace(self._rows, columns=J[:, :, :n].reshape(-1, n), joints=J[:, :, n:].reshape(6 * len(J), -1))
        total = np.zeros((len(J), 6))
        for sign, names in zip((1.0, -1.0), between, strict=True):
            found = next(f for f in known if f.suspect.names == names)
            columns = columns_of(found.suspect, self._calibrated)(flat).reshape(len(J), 6, -1)
            total += sign * columns @ found.change
        out: Floats = np.linalg.norm(total[:, 3:], axis=1)
        return out
