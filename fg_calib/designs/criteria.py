"""Criteria of designs, as each was published, and what candidates would gain by them.

With C the covariance of what can be determined, W the task's quadratic form, `S = (P C P^T)^-1` the information of the
core with the nuisances eliminated, in changes of ordinary size, and s_1 >= ... >= s_L the singular values whose squares
are the eigenvalues of S:

| name | smaller is better | |
|---|---|---|
| `I` | `tr(W C)` | mean square error of the tool over the task (Fedorov 1972) |
| `D`, `O1` | `-log det S` | volume of the ellipsoid; `O1 = (s_1 ... s_L)^(1/L) / sqrt(m)` (Borm and Menq 1991) |
| `A` | `tr S^-1` | mean variance |
| `E`, `O3` | `-s_L` | the worst direction (Nahvi et al. 1994) |
| `O2` | `-s_L / s_1` | inverse condition number (Driels and Pathre 1990) |
| `O4` | `-s_L^2 / s_1` | noise amplification (Nahvi and Hollerbach 1996) |
| `O5` | `sum 1 / s_i` | (Sun and Hollerbach 2008) |

A candidate's rows A change C by `-C A^T (1 + G)^-1 A C` with `G = A C A^T` (Woodbury), its determinant by
`det(1 + G)`: with U = A L, `C = L L^T`, and V = A C X,

    I, A: tr (1 + G)^-1 V V^T,   X X^T = W;   D: log det(1 + G) - log det(1 + G - V V^T),   X X^T = P^T S P.

Candidates are worked out in the order of a bound that is cheap, until none is left that could be better. I, D and A are
convex in the information, so that none gains more than its derivative says, `|A C X|^2`. Of the others S grows by at
most `B^T B` with `B = A C P^T S`, for nuisances held where they are best now; so s_L^2 grows by no more than
`|B v_L|^2`, s_1 does not shrink, and the convex `sum 1 / s_i` falls by no more than its derivative, `|B S^-3/4|^2 / 2`.

References:
    Fedorov (1972), Theory of Optimal Experiments. Academic Press.
    Borm, Menq (1991), Determination of optimal measurement configurations for robot calibration based on observability
    measure. International Journal of Robotics Research 10(1).
    Driels, Pathre (1990), Significance of observation strategy on the design of robot calibration experiments. Journal
    of Robotic Systems 7(2).
    Nahvi, Hollerbach, Hayward (1994), Calibration of a parallel robot using multiple kinematic closed loops. ICRA.
    Nahvi, Hollerbach (1996), The noise amplification index for optimal pose selection in robot calibration. ICRA.
    Sun, Hollerbach (2008), Observability index selection for robot calibration. ICRA.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from fg_calib.designs.information import System
from fg_calib.inputs import Floats, Integers
from fg_calib.robot import over_processors

Criterion = Literal["I", "D", "A", "E", "O1", "O2", "O3", "O4", "O5"]

CHUNK = 512
"""Candidates that are looked at together."""

BATCH, EIGENVALUE_CHUNK = 32, 16
"""Candidates whose singular values are worked out before the next bound is looked at, and by one processor."""

MAX_EXACT = 128
"""Candidates of a step whose singular values are worked out at most: those of the best bounds."""

_TINY = 1e-300


class Measure:
    """A criterion on a system: smaller is better.

    Args:
        criterion: Which.
        system: The system.
    """

    def __init__(self, criterion: Criterion, system: System) -> None:
        self.criterion, self.system = criterion, system
        self._linear = criterion in ("I", "A")
        if criterion == "I":
            self._half = _root(system.task)
        elif criterion == "A":
            self._half = system.core.T

    def value(self, information: Floats) -> float:
        """The criterion with some information, shape (n, n)."""
        if self._linear:
            L = np.linalg.cholesky(information)
            return float(np.sum(scipy.linalg.solve_triangular(L, self._half, lower=True) ** 2))
        return self._now(_covariance(information))

    def best(self, information: Floats, allowed: NDArray[np.bool_], below: float = np.inf) -> tuple[int, float]:
        """The candidate that makes the criterion smallest, and its value with that.

        Args:
            information: What is there, shape (n, n).
            allowed: Candidates that may be taken, shape (n_candidates,); at least one.
            below: Less than which the criterion must become; where no candidate makes it so, -1 and this are returned.
        """
        C = _covariance(information)
        bounds = np.where(allowed, self._bounds(C), np.inf)
        most, at_once = (len(bounds), CHUNK) if self._is_cheap else (MAX_EXACT, BATCH)
        order, best, least = np.argsort(bounds, kind="stable")[: int(np.sum(allowed))], -1, below
        for start in range(0, min(len(order), most), at_once):
            some = order[start : start + at_once]
            some = some[bounds[some] < least]
            if not len(some):
                break
            values = self._with(C, some)
            k = int(np.argmin(values))
            if values[k] < least:
                best, least = int(some[k]), float(values[k])
        return best, least

    def most_helpful(self, information: Floats, n: int) -> Integers:
        """The n candidates that promise to make the criterion smallest."""
        C = _covariance(information)
        promise = self._with(C, np.arange(self.system.n_candidates)) if self._is_cheap else self._bounds(C)
        return np.argsort(promise, kind="stable")[:n]

    @property
    def _is_cheap(self) -> bool:
        """Whether the criterion of a candidate takes no eigenvalues."""
        return self._linear or self.criterion in ("D", "O1")

    def _bounds(self, C: Floats) -> Floats:
        """Less than which each candidate cannot make the criterion."""
        P = self.system.core
        if self._is_cheap:
            return self._now(C) - self._squares(self._slope(C))
        w, V = np.linalg.eigh(P @ C @ P.T)  # ascending: the last is the worst direction
        s = 1.0 / np.sqrt(np.maximum(w, _TINY))
        B = C @ P.T @ V / w  # C P^T S in the basis of eigenvectors
        if self.criterion == "O5":
            return np.asarray(np.sum(1.0 / s) - 0.5 * self._squares(B * s ** (-1.5)))
        last = np.sqrt(s[-1] ** 2 + self._squares(B[:, -1:]))
        return np.asarray(_of_values(self.criterion, np.stack([np.full(len(last), s[0]), last], axis=1)))

    def _squares(self, X: Floats) -> Floats:
        """`|A X|^2` of all candidates, shape (n_candidates,)."""
        rows, (n, _, m) = self.system.rows, self.system.rows.shape

        def span(k: int) -> Floats:
            A = rows[k * CHUNK : (k + 1) * CHUNK]
            product = (A.reshape(-1, m) @ X).reshape(len(A), -1)
            return np.asarray(np.einsum("ij,ij->i", product, product))

        return np.concatenate(list(over_processors(span, -(-n // CHUNK))))

    def _slope(self, C: Floats) -> Floats:
        """X of which `|A X|^2` is the derivative of a cheap criterion, shape (n, r): see the module."""
        P = self.system.core
        half = self._half if self._linear else P.T @ np.linalg.inv(np.linalg.cholesky(P @ C @ P.T)).T
        out: Floats = C @ half
        return out

    def _now(self, C: Floats) -> float:
        """The criterion."""
        if self._linear:
            return float(np.sum(self._half * (C @ self._half)))
        P = self.system.core
        return float(_of_values(self.criterion, _singular_values(P @ C @ P.T)))

    def _gains(self, C: Floats, candidates: Integers) -> Floats:
        """By how much each of some candidates would make a cheap criterion smaller, shape (n,)."""
        L, X, m = np.linalg.cholesky(C), self._slope(C), self.system.rows.shape[2]

        def span(k: int) -> Floats:
            A = self.system.rows[candidates[k * CHUNK : (k + 1) * CHUNK]]
            h = A.shape[1]
            U, V = (np.reshape(A.reshape(-1, m) @ B, (len(A), h, -1)) for B in (L, X))
            F, T = np.eye(h) + U @ np.swapaxes(U, 1, 2), V @ np.swapaxes(V, 1, 2)
            if self._linear:
                return np.asarray(np.trace(np.linalg.solve(F, T), axis1=1, axis2=2))
            return np.asarray(np.linalg.slogdet(F)[1] - np.linalg.slogdet(F - T)[1])

        return np.concatenate(list(over_processors(span, -(-len(candidates) // CHUNK))))

    def _with(self, C: Floats, candidates: Integers) -> Floats:
        """The criterion with each of some candidates, shape (n,)."""
        if self._is_cheap:
            return self._now(C) - self._gains(C, candidates)
        P = self.system.core
        S, K = P @ C @ P.T, C @ P.T

        def span(k: int) -> Floats:
            A = self.system.rows[candidates[k * EIGENVALUE_CHUNK : (k + 1) * EIGENVALUE_CHUNK]]
            G, B = np.eye(A.shape[1]) + A @ C @ np.swapaxes(A, 1, 2), A @ K
            after = S - np.swapaxes(B, 1, 2) @ np.linalg.solve(G, B)
            return np.asarray(_of_values(self.criterion, _singular_values(after)))

        return np.concatenate(list(over_processors(span, -(-len(candidates) // EIGENVALUE_CHUNK))))


def _singular_values(S: Floats) -> Floats:
    """Those of the core's information, descending, of its covariances of shape (..., p, p): shape (..., p)."""
    w = np.linalg.eigvalsh(S)
    out: Floats = 1.0 / np.sqrt(np.maximum(w, _TINY))
    return out


def _of_values(criterion: Criterion, s: Floats) -> Floats:
    """A criterion by singular values, descending along the last axis."""
    first, last = s[..., 0], s[..., -1]
    formula: dict[str, Callable[[], Floats]] = {
        "D": lambda: -2.0 * np.sum(np.log(s), axis=-1),
        "O1": lambda: -2.0 * np.sum(np.log(s), axis=-1),
        "A": lambda: np.sum(s**-2.0, axis=-1),
        "E": lambda: -last,
        "O3": lambda: -last,
        "O2": lambda: -last / first,
        "O4": lambda: -(last**2) / first,
        "O5": lambda: np.sum(1.0 / s, axis=-1),
    }
    return formula[criterion]()


def _covariance(information: Floats) -> Floats:
    half = scipy.linalg.solve_triangular(np.linalg.cholesky(information), np.eye(len(information)), lower=True)
    out: Floats = half.T @ half
    return out


def _root(W: Floats) -> Floats:
    """X with `X X^T = W`, of as many columns as W has directions."""
    w, V = np.linalg.eigh(W)
    kept = w > 1e-15 * w[-1]
    out: Floats = V[:, kept] * np.sqrt(w[kept])
    return out
