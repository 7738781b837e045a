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

from fg_calib.diagnostics.changes import Change
from fg_calib.diagnostics.linearity import Curvature
from fg_calib.diagnostics.offsets import Offset
from fg_calib.graph.tolerances import ToleranceScale
from fg_calib.statistics.goodness_of_fit import CONFIDENCE, FACTOR, ChiSquare, GrossErrors, PredictedFit
from fg_calib.statistics.prior_consistency import PriorFit
from fg_calib.statistics.variance_components import LEAST_REDUNDANCY

LIKE_NOISE, NOT_NOISE = 1e-3, 1e-6
"""Probability below which residuals follow the arm more than noise does, and below which true errors are several times
those that sigmas claim; between the two they may be twice as large (`tests/analysis/test_structure.py`)."""

WORTH_SAYING = 1.1
"""Noise seen over noise stated, or the inverse, below which a difference that is not by chance is not worth a word."""

CERTAIN = 1e-4
"""Probability below which corrections are too large together: tolerances are guesses, more than noise is."""

LEAST_REST, LEAST_SHARE = 0.3, 0.01
"""Directions that rest on rows far from linear, and share of such rows, below which sigmas are honest."""

LEAST_FOLDED, MOST_FOLDED = 0.05, 0.3
"""Part of what the rows say that may rest on vectors of unknown sign: with a caution, and no more at all."""

LEAST_CURVED, MOST_CURVED = 0.2, 1.0
"""Mean square of errors beyond what the covariance says, because rows bend: with a caution, and no more at all."""

LARGE_NOISE = 0.2
"""Estimated noise over the motions measured, beyond which it is no noise."""

MOST_KEPT = 3.0
"""Factor on estimated noise beyond which what was stated is no reason to trust the noise that measurements keep."""

_NAMED = 3
"""Configurations or parameters that a statement names."""


FAR_OFF = 10.0
"""Tolerance estimated over tolerance stated above which one asks why."""

UNSEEN = 0.5
"""Corrections of a group that the data tell of, below which they do not tell its scale."""


@dataclass(frozen=True)
class Statement:
    """Something about a result, in words.

    Attributes:
        text: One line.
        finding: Whether the result is not to be trusted because of it; else it is a caution.
        reservation: Whether a caution says that sigmas are too small, so that the verdict has to mention it.
    """

    text: str
    finding: bool
    reservation: bool = False


def of_chi2(
    found: ChiSquare,
    evaluated: bool = False,
    *,
    follow: bool = False,
    gross: GrossErrors | None = None,
    updated: bool = False,
) -> list[Statement]:
    """What chi-square of the fitted rows and priors says.

    Args:
        found: It.
        evaluated: Whether the arm was taken as it is.
        follow: Whether residuals follow the arm: sigmas are then too small by more than residuals are too large.
        gross: The gross errors that are all that is wrong; None if there are none, or more than these is.
        updated: Whether the rows were added to an earlier calibration.
    """
    if found.dof <= 0:
        text = "no degree of freedom is left: nothing says whether the fit is right, or the noise; measure more"
        return [Statement(text, finding=True)]
    reduced, (low, high) = found.value / found.dof, found.bounds
    outside = f"reduced chi-square {reduced:.3g} is outside [{low:.2f}, {high:.2f}]"
    if reduced > high:
        cause = "noise stated too small, effects not modelled, or outliers"
        if gross is not None:
            who = f"{'outlier' if gross.n == 1 else f'{gross.n} outliers'} ({_listed(gross.names)})"
            them = "it" if gross.n == 1 else "them"
            cause = f"{who}, {gross.ratio:.3g} without {them}: look at {them}, or let a robust loss do so (loss: gnc)"
        elif updated:
            cause = "new rows are at odds with the calibration before: has the arm changed? `fg-calib check` says"
        if evaluated:
            cause = "the arm does not predict these test rows, noise stated too small, or outliers"
        return [Statement(f"{outside}: {cause}", finding=True)]
    if reduced < low:
        return [Statement(f"{outside}: noise stated too large; sigmas are larger than they need be", finding=False)]
    seen = float(np.sqrt(found.ratio))
    if found.p_value is not None and found.p_value < (1.0 - CONFIDENCE) / 2.0 and seen > WORTH_SAYING:
        text = f"reduced chi-square {reduced:.3g}: residuals are {seen:.2f} times the noise stated, not by chance"
        return [Statement(text + "; sigmas may be too small by as much" * (not follow), finding=False)]
    return []


def of_structure(noise_like: float | None) -> list[Statement]:
    """What it means that residuals follow the arm.

    Args:
        noise_like: Probability that noise alone follows it as much; None if that is not known.
    """
    if noise_like is None or noise_like >= LIKE_NOISE:
        return []
    certain = noise_like < NOT_NOISE
    text = "the residuals follow the arm, as noise does not: effects that are not modelled"
    several = "true errors may be several times those claimed: believe the test rows"
    errors = several if certain else "true errors may be twice those claimed"
    return [Statement(f"{text}; {errors}", finding=False, reservation=True)]


def of_change(found: Change | None, names: Sequence[str]) -> list[Statement]:
    """What it means that something moved while a table was measured.

    Args:
        found: What moved; None if nothing did.
        names: Of configurations and groups (see `Measurements.end_names`).
    """
    if found is None:
        return []
    where = f"from configuration {names[found.configuration + 1]} on the {found.what} is not where it was before"
    gain = f"chi-square falls to {100.0 * found.left:.2g} % with a {found.what} of its own from there"
    return [Statement(f"{where} ({gain}): a target, a base or an instrument that moved", finding=True)]


def of_offset(found: Offset, labels: Sequence[str], high: bool) -> list[Statement]:
    """What it means that all lengths to anchors are off by the same.

    Args:
        found: By how much.
        labels: Of the tables.
        high: Whether residuals are too large for the noise: else it is a reservation. The rest is then far from where
            it will be, and of the figure the linearised fit knows less than its sigma says.
    """
    of = f" of {labels[found.table]}" if len(labels) > 1 else ""
    adds = f"{1e3 * found.size:+.3g} mm"
    adds = f"some {adds} to each" if high else f"{adds} to each (sigma {1e3 * found.sigma:.2g} mm)"
    text = (
        f"the lengths{of} fit better if the instrument adds {adds}, which was not estimated: offset: estimate, or"
        " calibrate the instrument"
    )
    return [Statement(text, finding=high, reservation=not high)]


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


def of_kept_noise(kept: Sequence[str], every: bool, off: float = 1.0) -> list[Statement]:
    """What it means that noise was to be estimated, but too few degrees of freedom were left for that.

    Args:
        kept: What noise stayed as stated.
        every: Whether these are all there are.
        off: The largest factor by which other noise was stated too small, where measurements kept theirs.
    """
    if not kept:
        return []
    text = (
        f"the noise of {', '.join(kept)} could not be estimated, for fewer than {LEAST_REDUNDANCY:g} degrees of"
        " freedom are left to it: it is as stated, or 1 mm and 1 mrad where nothing was"
    )
    wrong = f"; other noise was stated {off:.3g} times too small, and so may this be: measure more"
    text += "; nothing says whether it is right: measure more" if every else wrong if off > MOST_KEPT else ""
    return [Statement(text, finding=every or off > MOST_KEPT)]


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
            f"{predicted_in_words(fit)}: {claim}{suspicious}",
            finding=ratio > FACTOR,
            reservation=ratio <= FACTOR,
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
    for one in fit.beyond:
        if one.is_place:
            text = f"{one.name} lies {one.z:.1f} of its tolerances from where it was said to be"
            statements.append(Statement(f"{text}: {causes}", True))
    worst = [f"{one.name} {one.z:+.1f}" for one in fit.beyond if not one.is_place]
    if worst:
        text = f"corrections beyond their tolerances (in sigma of these: {_listed(worst)}): {causes}"
        statements.append(Statement(text, True))
    if not statements and fit.p_value is not None and fit.p_value < (1.0 - CONFIDENCE) / 2.0:
        largest = [f"{fit.names[i]} {fit.z[i]:+.1f}" for i in np.argsort(-np.abs(fit.z))]
        what = f"corrections are too large for their tolerances (in sigma of these: {_listed(largest)}; sum of squares"
        text = f"{what} {fit.chi2:.3g} where {fit.expected:.3g} is expected): {causes}"
        statements.append(Statement(text, fit.chi2 > FACTOR * fit.expected and fit.p_value < CERTAIN))
    return statements


def of_tolerances(scales: Sequence[ToleranceScale], too_large: bool) -> list[Statement]:
    """What a reader of tolerances that were estimated should know.

    Args:
        scales: Them.
        too_large: Whether residuals are larger than their noise.
    """
    statements = []
    far = [f"{one.group} {one.scale:.3g}" for one in scales if one.scale > FAR_OFF]
    if far:
        text = f"corrections are far larger than the tolerances stated ({', '.join(far)} times)"
        text += ": residuals are too large as well, so corrections may take up what is not modelled" * too_large
        statements.append(Statement(text, finding=False))
    unseen = [one.group for one in scales if one.seen < UNSEEN]
    if unseen:
        text = f"the data tell next to nothing of the corrections of {', '.join(unseen)}"
        statements.append(Statement(f"{text}: the scale of their tolerances goes with the others", finding=False))
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


def of_lost(names: Sequence[str], loss: str) -> list[Statement]:
    """What it means that nearly all measurements that see some parameters count as outliers.

    Args:
        names: The parameters.
        loss: The robust loss.
    """
    if not names:
        return []
    text = (
        f"nearly all measurements that see {_listed(names)} are taken for outliers by loss {loss}: look at them;"
        " calibrate without a loss to see what they say"
    )
    return [Statement(text, finding=False, reservation=True)]


def of_curvature(found: Curvature) -> list[Statement]:
    """What it means that rows are not linear within what the parameters may still be off, far from any fold.

    Args:
        found: By how much mean squares of errors exceed what the covariance says.
    """
    bend = "the measurements bend within what they leave unknown"
    if found.tool >= LEAST_CURVED:
        text = f"{bend}: the tool's errors are {_times(found.tool)} what sigmas say: measure at more configurations"
        return [Statement(text, found.tool > MOST_CURVED, reservation=True)]
    if found.parameter >= LEAST_CURVED:
        who, honest = found.name or "a frame", "; those of the tool are honest"
        text = f"{bend}: errors of {who} are {_times(found.parameter)} what its sigma says{honest}"
        return [Statement(text, finding=False, reservation=True)]
    if found.sums > MOST_CURVED:
        honest = "those of single parameters and of the tool are honest"
        text = f"{bend}: errors of sums of parameters are {_times(found.sums)} what the covariance says;"
        return [Statement(f"{text} {honest}", finding=False)]
    return []


def _times(beyond: float) -> str:
    """Errors over their sigma, in words, by how much the mean of their ratio's square exceeds 1."""
    return f"some {np.sqrt(1.0 + beyond):.2g} times" if np.isfinite(beyond) else "many times"


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
        " away; measure longer and wider motions, in which more joints move"
    )
    return [Statement(text, share > MOST_FOLDED)]


def chi2_in_words(chi2: float, expected: float, p_value: float) -> str:
    """`chi-square 169 where 30 is expected (p-value < 0.001)`."""
    return f"chi-square {chi2:.4g} where {expected:.4g} is expected (p-value {probability(p_value)})"


def predicted_in_words(fit: PredictedFit) -> str:
    """`test rows: chi-square 1012 where 1000 is expected (p-value 0.4), of 1000 of the 9990 rows, evenly spaced`."""
    some = f", of {fit.n} of the {fit.n_rows} rows, evenly spaced" if fit.n < fit.n_rows else ""
    return f"test rows: {chi2_in_words(fit.chi2, fit.expected, fit.p_value)}{some}"


def probability(p: float) -> str:
    """A probability with two figures, none beyond a thousandth from 0 and 1."""
    return "< 0.001" if p < 1e-3 else "> 0.999" if p > 0.999 else f"{p:.2g}" if p < 0.1 else f"{p:.2f}"


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
