"""How plain least squares gets to a minimum: Gauss-Newton as printed in the paper, and scipy; what it claims there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RCOND = 1e-10
"""Singular values of J below this part of the largest count as zero in J^+."""

SHARE = 1e-6
"""A parameter with more than this share in a direction that J leaves open has no sigma."""

ROUNDING = 1e-8
"""A step below this that no longer shrinks is rounding: weak directions magnify it, [m] and [rad]."""


@dataclass(frozen=True)
class Fit:
    """Unknowns where a method stopped, and why."""

    x: Floats
    converged: bool
    message: str
    iterations: int
    steps: tuple[float, ...]


Evaluate = Callable[[Floats], tuple[Floats, Floats]]
"""From the unknowns to residuals, shape (m,), and their derivatives, shape (m, n)."""

Solver = Callable[[Evaluate, Floats], Fit]


def gauss_newton(evaluate: Evaluate, x: Floats, *, limit: int, tolerance: float) -> Fit:
    """Eq. (54) and (55) of `least_squares`."""
    steps: list[float] = []

    def end(converged: bool, message: str) -> Fit:
        return Fit(x, converged, message, len(steps), tuple(steps))

    for _ in range(limit):
        with np.errstate(all="ignore"):
            r, J = evaluate(x)
            if not (np.isfinite(r).all() and np.isfinite(J).all()):
                return end(False, f"diverged: residuals are not finite after {len(steps)} steps")
            try:
                step = np.linalg.pinv(J, rcond=RCOND) @ -r
            except np.linalg.LinAlgError as error:
                return end(False, f"no step possible: {error}")
        if not np.isfinite(step).all():
            return end(False, f"diverged: step {len(steps) + 1} is not finite")
        x = x + step
        steps.append(float(np.linalg.norm(step)))
        if steps[-1] <= tolerance:
            return end(True, f"converged: the last step was {steps[-1]:.1e}")
        if steps[-1] <= ROUNDING and len(steps) > 1 and steps[-1] >= steps[-2]:
            return end(True, f"converged to rounding: steps of {steps[-1]:.1e} no longer shrink")
    return end(False, f"not converged: {limit} iterations, the last step was {steps[-1]:.1e}")


def scipy_fit(evaluate: Evaluate, x: Floats, *, limit: int, tolerance: float) -> Fit:
    """MINPACK's Levenberg-Marquardt, or scipy's trust region where there are fewer rows than unknowns."""

    def residual(x: Floats) -> Floats:
        return evaluate(x)[0]

    def derivative(x: Floats) -> Floats:
        return evaluate(x)[1]

    from scipy import optimize  # here, for it takes as long to import as a small calibration

    exact = 1e-15  # near the least that MINPACK takes
    try:
        found = optimize.least_squares(
            residual,
            x,
            jac=derivative,
            method="lm" if len(residual(x)) >= len(x) else "trf",
            x_scale="jac",
            ftol=exact,
            xtol=max(exact, tolerance),
            gtol=exact,
            max_nfev=limit,
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        return Fit(x, False, f"no step possible: {error}", 0, ())
    converged = bool(found.status > 0)
    message = " ".join(str(found.message).split()).rstrip(".")
    message = f"{'converged' if converged else 'not converged'}: {message}"
    return Fit(np.asarray(found.x, dtype=np.float64), converged, message, int(found.njev or found.nfev), ())


def claimed_covariance(r: Floats, J: Floats, weighted: bool) -> tuple[Floats, int]:
    """(J^T J)^-1, times s^2 where the rows are not weighted, nan where J leaves a parameter open; and the rank of J."""
    n = J.shape[1]
    if not np.isfinite(J).all():
        return np.full((n, n), np.nan), 0
    _, s, Vt = np.linalg.svd(np.vstack([J, np.zeros((n, n))]), full_matrices=False)
    rank = int(np.sum(s > RCOND * s.max(initial=0.0)))
    half = Vt[:rank].T / s[:rank]
    covariance: Floats = half @ half.T
    if not weighted:
        covariance = covariance * (float(r @ r) / (len(r) - rank) if len(r) > rank else np.nan)
    loose = np.linalg.norm(Vt[rank:], axis=0) > SHARE
    covariance[loose, :] = np.nan
    covariance[:, loose] = np.nan
    return covariance, rank
