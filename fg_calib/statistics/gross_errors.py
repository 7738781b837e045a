"""Gross errors: the few measurements that spoil a fit, found in the linearised problem.

One wrong row of a table with many unknowns makes most residuals too large, for the fit gives way to it: how many are
too large says nothing. So measurements are left out, the worst first, until what is left fits. With e the residuals, C
the covariance of their noise and A theirs (see `goodness`), the fit without the rows S follows from this one:

    u = C^-1 e,  Q = C^-1 A C^-1;   chi-square falls by T = u_S^T Q_SS^-1 u_S,  u becomes u - Q_:S Q_SS^-1 u_S,
                                                                                Q becomes Q - Q_:S Q_SS^-1 Q_S:.

What is left out at once is a measurement, or all those of one configuration, whose reading may be wrong. The worst is
the one whose drop is least likely by chance, whatever the size of the noise: with Gaussian noise what is left of
chi-square, over what it was, has a beta distribution. After k of N, the k are taken for gross errors if a drop as large
by any k of N (Bonferroni) is no chance, for the k for which that is least likely.

References:
    Cook, Weisberg (1982), Residuals and Influence in Regression, section 2.2.
    Hadi, Simonoff (1993), Procedures for the identification of multiple outliers in linear models. JASA 88(424).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy import special
from scipy.sparse import csgraph

from fg_calib.graph.noise import PRIVATE_SHARE
from fg_calib.statistics.residual_covariance import Errors

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]
Loadings = scipy.sparse.csr_array

MOST_FEW = 0.2
"""Share of rows above which they are not few, so no outliers."""

CHANCE = 1e-4
"""Probability below which what leaving measurements out gains is no chance."""

MAX_TOGETHER = 2000
"""Rows that share errors with each other, and errors that they share, up to which gross errors are looked for."""

_AT_ONCE = 0.1
"""Part of those left out so far that is left out in one step: one by one at first."""

_LEAST = 1e-6
"""Part of a row's information below which the others say nothing of it: it is met whatever was measured."""


def find_gross_errors(
    z: Floats,
    errors: Errors,
    tangent: Floats,
    units: Sequence[Integers],
    dof: float,
    priors: tuple[Floats, Floats] | None = None,
) -> Booleans | None:
    """The few measurements that spoil a fit, shape (n,); None if there are none, or not few, or it cannot be told.

    Args:
        z: Residuals over the sigma of their noise, at the optimum or where the problem is linear, shape (n,).
        errors: What they follow from, over the same sigma.
        tangent: Covariance of the core, which goes with rows weighted by C^-1.
        units: Rows that may be left out together: of a measurement, of a configuration.
        dof: Degrees of freedom of rows and priors.
        priors: Whitened residuals of the core's priors there, and their derivatives.
    """
    noise = _Noise.of(errors)
    if noise is None or dof < 1.0:
        return None
    r_prior, J_prior = priors if priors is not None else (np.zeros(0), np.zeros((0, len(tangent))))
    B, along = noise.solve(errors.of_estimate(tangent)), tangent @ (J_prior.T @ r_prior)
    # At the optimum of the linearised problem, where priors and rows lead to:
    e = z - errors.J @ along - errors.of_estimate(tangent) @ (B.T @ z)
    u = noise.solve(e[:, None])[:, 0]
    step = -along - tangent @ (errors.J.T @ noise.solve(z[:, None])[:, 0])
    chi2 = float(e @ u) + float(np.sum((r_prior + J_prior @ step) ** 2))
    search = _Search(noise, u, B, units, chi2, dof)
    while np.any(search.leave_out()):
        pass
    return search.best()


class _Noise:
    """The inverse of C = D + L L^T, the covariance of rows by their noise.

    Args:
        d: Diagonal of D, shape (n,).
        L: Sparse, shape (n, n_errors).
        together: Errors that rows have in common, by the number of them, shape (m, number) each.
    """

    def __init__(self, d: Floats, L: Loadings, S: Loadings, together: Sequence[Integers]) -> None:
        rows, columns, values = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
        for those in together:
            grid = np.broadcast_arrays(those[:, :, None], those[:, None, :])
            rows.append(grid[0].ravel())
            columns.append(grid[1].ravel())
            blocks = np.asarray(S[rows[-1], columns[-1]]).reshape(grid[0].shape)
            values.append(np.linalg.inv(blocks).ravel())
        at = (np.concatenate(rows), np.concatenate(columns))
        K = Loadings((np.concatenate(values), at), shape=S.shape)
        scaled = Loadings(scipy.sparse.diags_array(1.0 / d) @ L)
        self._W = Loadings(scipy.sparse.diags_array(1.0 / d) - scaled @ K @ scaled.T)

    @classmethod
    def of(cls, errors: Errors) -> _Noise | None:
        """The noise of rows; None if too many share errors."""
        d, L = np.maximum(errors.private, PRIVATE_SHARE * errors.of_noise), errors.L
        S = Loadings(L.T @ scipy.sparse.diags_array(1.0 / d) @ L + scipy.sparse.eye_array(L.shape[1]))
        _, label = csgraph.connected_components(S, directed=False)
        count, first = np.bincount(label), L.indices[L.indptr[:-1][np.diff(L.indptr) > 0]]
        if max(count.max(initial=0), np.bincount(label[first]).max(initial=0)) > MAX_TOGETHER:
            return None
        order = np.argsort(label, kind="stable")
        of_size = count[label[order]]
        sizes = np.unique(count[count > 0])
        return cls(d, L, S, [order[of_size == size].reshape(-1, size) for size in sizes.tolist()])

    def solve(self, X: Floats) -> Floats:
        """C^-1 X."""
        out: Floats = self._W @ X
        return out

    def columns(self, rows: Integers) -> Floats:
        """Columns of C^-1, shape (n, n_rows)."""
        out: Floats = self._W[:, rows].toarray()
        return out

    def blocks(self, rows: Integers) -> Floats:
        """Blocks of C^-1 at several rows each, shape (m, d) and (m, d, d)."""
        grid = np.broadcast_arrays(rows[:, :, None], rows[:, None, :])
        out: Floats = np.asarray(self._W[grid[0].ravel(), grid[1].ravel()]).reshape(grid[0].shape)
        return out


class _Search:
    """Units left out of a fit, step by step.

    Args:
        noise: Of the rows.
        u: See the module's head, shape (n,).
        B: With Q = C^-1 - B B^T, shape (n, m).
        units: Rows that may be left out together.
        chi2: Chi-square with all of them.
        dof: Its degrees of freedom.
    """

    def __init__(self, noise: _Noise, u: Floats, B: Floats, units: Sequence[Integers], chi2: float, dof: float) -> None:
        self._noise, self._n_units, self._many = noise, len(units), False
        self._steps = [(np.zeros(len(u), dtype=np.bool_), u, B, chi2, dof, 0)]
        sizes = sorted({len(unit) for unit in units})
        self._units = [np.array([unit for unit in units if len(unit) == size]) for size in sizes]
        of_noise = [noise.blocks(rows) for rows in self._units]
        self._least = [_LEAST * np.einsum("mii->m", block) / block.shape[1] for block in of_noise]
        self._Q = [
            block - B[rows] @ np.swapaxes(B[rows], 1, 2) for block, rows in zip(of_noise, self._units, strict=True)
        ]

    def leave_out(self) -> Booleans:
        """Leave out the worst; the rows that were, none if there is nothing that may be."""
        out, u, B, chi2, dof, count = self._steps[-1]
        found = []
        for rows, Q, least in zip(self._units, self._Q, self._least, strict=True):
            T, rank = _drops(Q, u[rows], least)
            found += [
                (log_chance(1.0 - t / chi2, dof - m, m), *unit)
                for t, m, unit in zip(T.tolist(), rank.tolist(), rows.tolist(), strict=True)
                if 0 < m < dof and t < chi2
            ]
        new = np.zeros_like(out)
        for chance, *unit in sorted(found)[: max(1, int(_AT_ONCE * count))]:
            if chance < 0.0 and not new[unit].any() and not out[unit].all():
                new[unit], count = True, count + 1
        self._many = bool(np.sum(out | new) > MOST_FEW * len(out))
        if not new.any() or self._many:
            return np.zeros_like(out)
        rows = np.flatnonzero(new & ~out)
        columns = self._noise.columns(rows) - B @ B[rows].T
        values, V = np.linalg.eigh(columns[rows])
        kept = values > _LEAST * float(np.trace(columns[rows])) / len(rows)
        F = columns @ (V[:, kept] / np.sqrt(values[kept]))
        step = (V[:, kept].T @ u[rows]) / np.sqrt(values[kept])
        self._Q = [Q - F[of] @ np.swapaxes(F[of], 1, 2) for of, Q in zip(self._units, self._Q, strict=True)]
        left = max(chi2 - float(step @ step), 1e-12 * chi2)
        self._steps.append((out | new, u - F @ step, np.hstack([B, F]), left, dof - float(kept.sum()), count))
        return new

    def best(self) -> Booleans | None:
        """What was left out when what was gained was least likely by chance; None if it may be, or more should be."""
        chi2, dof = self._steps[0][3:5]
        chances = [
            log_chance(left / chi2, now, dof - now) + _log_choices(self._n_units, count)
            for *_, left, now, count in self._steps[1:]
        ]
        best = int(np.argmin(chances)) if chances else 0
        if not chances or chances[best] > np.log(CHANCE) or (self._many and best == len(chances) - 1):
            return None
        return self._steps[best + 1][0]


def _log_choices(n: int, k: int) -> float:
    """Logarithm of the number of ways to choose k of n."""
    return -float(special.betaln(k + 1, n - k + 1) + np.log(n + 1.0))


def log_chance(left: float, dof: float, m: float) -> float:
    """Logarithm of the probability that m unknowns more leave no more than a part of chi-square; at most a bound of it.

    The part has the beta distribution of (dof / 2, m / 2), whose density integrates to less than
    left^(dof / 2) / (dof / 2) / B(dof / 2, m / 2), for m = 1 times (1 - left)^(-1/2).

    Args:
        left: The part.
        dof: Degrees of freedom that are left.
        m: Unknowns more.
    """
    if m <= 0.0 or dof <= 0.0 or left >= 1.0:
        return 0.0
    a, b = 0.5 * dof, 0.5 * m
    bound = a * np.log(max(left, 1e-300)) - np.log(a) - special.betaln(a, b) + min(b - 1.0, 0.0) * np.log1p(-left)
    return min(float(bound), 0.0)


def _drops(Q: Floats, u: Floats, least: Floats) -> tuple[Floats, Integers]:
    """By how much chi-square falls without each unit, shape (m,), and how many rows of it say something.

    Args:
        Q: Shape (m, d, d).
        u: Shape (m, d).
        least: What says something has at least that much information, shape (m,).
    """
    values, V = np.linalg.eigh(Q)
    says = values > least[:, None]
    along = np.einsum("mij,mi->mj", V, u)
    drops = np.where(says, along**2 / np.where(says, values, 1.0), 0.0)
    return np.sum(drops, axis=1), np.sum(says, axis=1)
