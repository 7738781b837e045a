"""The verdict: what speaks against a result, and what its reader should know although it may be trusted.

Statements are *findings*, which make a result not to be trusted, or *cautions*. Sums of squares far above their mean
are a finding: noise or tolerances stated too small, effects not modelled, or gross errors make sigmas too small and the
estimate wrong. Within `FACTOR` of their mean they are at most a caution, whatever their distribution: noise is
never known better. Sums far below it only mean that sigmas are larger than they need be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from fg_calib.analysis.chi_square import CONFIDENCE, FACTOR, ChiSquare
from fg_calib.analysis.corrections import PriorFit
from fg_calib.analysis.goodness import PredictedFit

WORTH_SAYING = 1.1
"""Noise seen over noise stated, or the inverse, below which a difference that is not by chance is not worth a word."""

CERTAIN = 1e-4
"""Probability below which corrections are too large together: tolerances are guesses, more than noise is."""

LEAST_REST, LEAST_SHARE = 0.3, 0.01
"""Directions that rest on rows far from linear, and share of such rows, below which sigmas are honest."""

LEAST_FOLDED, MOST_FOLDED = 0.05, 0.3
"""Part of what the rows say that may rest on vectors of unknown sign: with a caution, and no more at all."""

LARGE_NOISE = 0.2
"""Estimated noise over the motions measured, beyond which it is no noise."""

_NAMED = 3
"""Configurations or parameters that a statement names."""


@dataclass(frozen=True)
class Statement:
    """Something about a result, in words.

    Attributes:
        text: One line.
        finding: Whether the result is not to be trusted because of it; else it is a caution.
    """

    text: str
    finding: bool


def of_chi2(found: ChiSquare, evaluated: bool = False) -> list[Statement]:
    """What chi-square of the fitted rows and priors says.

    Args:
        found: It.
        evaluated: Whether the arm was taken as it is.
    """
    if found.dof <= 0:
        text = "no degree of freedom is left: nothing says whether the fit is right, or the noise; measure more"
        return [Statement(text, finding=True)]
    reduced, (low, high) = found.value / found.dof, found.bounds
    outside = f"reduced chi-square {reduced:.3g} is outside [{low:.2f}, {high:.2f}]"
    if reduced > high:
        cause = "noise stated too small, effects not modelled, or outliers"
        if evaluated:
            cause = "the arm does not predict these test rows, noise stated too small, or outliers"
        return [Statement(f"{outside}: {cause}", finding=True)]
    if reduced < low:
        return [Statement(f"{outside}: noise stated too large; sigmas are larger than they need be", finding=False)]
    seen = float(np.sqrt(found.ratio))
    if found.p_value is not None and found.p_value < (1.0 - CONFIDENCE) / 2.0 and seen > WORTH_SAYING:
        text = f"reduced chi-square {reduced:.3g}: residuals are {seen:.2f} times the noise stated, not by chance"
        return [Statement(f"{text}; sigmas may be too small by as much", finding=False)]
    return []


def of_evaluation(evaluated: bool, noise_estimated: bool) -> list[Statement]:
    """What an evaluation lacks whose noise was estimated from the very rows that it is judged by."""
    if not (evaluated and noise_estimated):
        return []
    text = (
        "the noise was estimated from these test rows: nothing says whether the arm predicts them as well as it should"
    )
    return [Statement(text, finding=False)]


def of_estimated_noise(kind: str, sigma: float, motion: float) -> list[Statement]:
    """What it means that estimated noise is as large as the motions that were measured.

    Args:
        kind: Kind of noise.
        sigma: What was estimated, [m] or [rad].
        motion: Typical size of what the arm predicts, [m] or [rad].
    """
    if sigma < LARGE_NOISE * motion:
        return []
    text = (
        f"the noise estimated of {kind} is {sigma / motion:.2g} times as large as what was measured moved:"
        " the arm explains next to nothing of it, so the table or the job is wrong"
    )
    return [Statement(text, finding=True)]


def of_test(fit: PredictedFit | None, of_fitted: float, names: Sequence[str]) -> list[Statement]:
    """What the predicted rows say, if they were predicted worse than they should be, and worse than others were fitted.

    Args:
        fit: Their fit; None without any.
        of_fitted: Chi-square of the fitted rows over its mean: noise stated too small is not said twice.
        names: Of configurations and groups (see `Measurements.end_names`).
    """
    if fit is None:
        return []
    count = fit.outliers
    most = min(1.0, (count.fitted + 1.0 + 3.0 * np.sqrt(count.fitted + 1.0)) / max(count.of_fitted, 1))
    if count.test and special.bdtrc(count.test - 1, count.of_test, most) < (1.0 - CONFIDENCE) / 2.0:
        text = f"test rows: the loss takes {count.test} of {count.of_test} measurements for outliers"
        return [Statement(f"{text}, of those fitted {count.fitted} of {count.of_fitted}", finding=True)]
    if not fit.n or fit.p_value >= (1.0 - CONFIDENCE) / 2.0:
        return []
    ratio = fit.chi2 / fit.expected
    if ratio < WORTH_SAYING**2 or FACTOR < of_fitted > ratio / FACTOR:
        return []
    worst = [names[c.configuration + 1] for c in fit.configurations]
    suspicious = f"; suspicious: {_listed(worst)}" if worst else ""
    claim = "the arm does not predict them as well as it claims"
    return [
        Statement(
            f"test rows: {chi2_in_words(fit.chi2, fit.expected, fit.p_value)}: {claim}{suspicious}", ratio > FACTOR
        )
    ]


def of_priors(fit: PriorFit | None) -> list[Statement]:
    """What corrections say of tolerances, if they are too large for these.

    Args:
        fit: Corrections against tolerances; None without priors.
    """
    if fit is None:
        return []
    statements = []
    causes = "tolerances stated too small, or the measurements are not what the job says"
    if fit.beyond:
        worst = [f"{fit.names[i]} {fit.z[i]:+.1f}" for i in fit.beyond]
        statements.append(
            Statement(f"corrections beyond their tolerances (in sigma of these: {_listed(worst)}): {causes}", True)
        )
    elif fit.p_value is not None and fit.p_value < (1.0 - CONFIDENCE) / 2.0:
        largest = [f"{fit.names[i]} {fit.z[i]:+.1f}" for i in np.argsort(-np.abs(fit.z))]
        what = f"corrections are too large for their tolerances (in sigma of these: {_listed(largest)}; sum of squares"
        text = f"{what} {fit.chi2:.3g} where {fit.expected:.3g} is expected): {causes}"
        statements.append(Statement(text, fit.chi2 > FACTOR * fit.expected and fit.p_value < CERTAIN))
    return statements


def of_bent(n: int, n_rows: int, directions: float) -> list[Statement]:
    """What it means that rows are not linear in what the parameters may still be off.

    Args:
        n: How many there are.
        n_rows: Of so many rows.
        directions: Sum of their leverage: how many directions of the parameters rest on them.
    """
    if directions < LEAST_REST and n < LEAST_SHARE * max(n_rows, 1):
        return []
    text = (
        f"{n} of {n_rows} lengths and angles are small and bent by what the parameters may still be off:"
        " sigmas of these may be 10 % too small, or there is a second optimum"
    )
    return [Statement(text, finding=False)]


def of_folds(n: int, n_rows: int, share: float) -> list[Statement]:
    """What it means that vectors may as well point the other way within what the tolerances allow.

    Args:
        n: How many lengths and angles there are of that kind.
        n_rows: Of so many.
        share: Part of all that the rows say that these say (by leverage).
    """
    if share < LEAST_FOLDED:
        return []
    text = (
        f"{n} of {n_rows} lengths and angles are so near 0 or half a turn that tolerances let their vectors point"
        f" either way, and {100.0 * share:.0f} % of what the rows say rests on them: there may be a better optimum far"
        " away; start from a better nominal arm, or measure longer and wider motions"
    )
    return [Statement(text, share > MOST_FOLDED)]


def chi2_in_words(chi2: float, expected: float, p_value: float) -> str:
    """`chi-square 169 where 30 is expected (p-value < 0.001)`."""
    return f"chi-square {chi2:.4g} where {expected:.4g} is expected (p-value {probability(p_value)})"


def probability(p: float) -> str:
    """A probability with two figures, none beyond a thousandth from 0 and 1."""
    return "< 0.001" if p < 1e-3 else "> 0.999" if p > 0.999 else f"{p:.2g}" if p < 0.1 else f"{p:.2f}"


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
