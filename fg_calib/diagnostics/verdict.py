"""The verdict on a calibration: errors, warnings and notes, by one table of checks.

An *error* says why a result is not to be trusted (DOUBTFUL): chi-square far above its mean, say, for noise or prior
sigmas specified too small, unmodelled effects and gross errors make sigmas too small and the estimate wrong. A
*warning* says that sigmas may be too small although the result may be trusted; a *note* what else its reader should
know. Within `FACTOR` of its mean chi-square is no error, whatever its distribution: noise is never known better.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import field, replace
from typing import Literal

import numpy as np

from fg_calib import statistics
from fg_calib.diagnostics import unmodelled_effects as effects
from fg_calib.diagnostics.linearity import NONLINEAR, AmbiguousRows, Nonlinearity, check_linearity, find_ambiguous_rows
from fg_calib.diagnostics.setup_check import SetupCheck, check_problem
from fg_calib.graph import JOINT_NOISE, Problem, Solution, mahalanobis_distances, solve, with_factors
from fg_calib.inputs import CalibrationError, Floats, Record, shorten
from fg_calib.measurements import missing_values
from fg_calib.observability import NOT_EXCITED, Identifiability
from fg_calib.robot import SCALES, pose
from fg_calib.statistics import CONFIDENCE, FACTOR, FINE, LEAST_REDUNDANCY, OUTLIER_WEIGHT, Fit, GrossErrors, Spread
from fg_calib.statistics.priors import Beyond

Severity = Literal["error", "warning", "note"]

SIGNIFICANT = (1.0 - CONFIDENCE) / 2.0
"""P-value below which chi-square, and the outliers of test rows, are significant."""

NOTABLE_RATIO = 1.1
"""Estimated over specified noise, or the inverse, below which a significant difference is not reported."""

PRIOR_P_VALUE = 1e-4
"""P-value below which corrections are too large together: prior sigmas are guesses, more than noise is."""

AMBIGUOUS_SHARE, MAX_AMBIGUOUS_SHARE = 0.05, 0.3
"""Part of the information that may rest on lengths and angles of ambiguous sign: with a warning, and no more at all."""

LARGE_NOISE, MOST_READINGS = 0.2, 1000
"""Estimated noise over the tool's motion, beyond which it is no noise; and configurations of which that is taken."""

GAIN_SCORE = 3.0
"""Sigma by which squares of test rows must be larger than by the nominal arm: a right arm gains nothing."""

LEAST_GAIN = 1.05
"""Error of test rows with a robust loss, over that of least squares, above which the loss does harm."""

MAX_OUTLIER_SHARE = 0.5
"""Share of measurements beyond which they are not outliers but the majority."""

MOST_ESTIMATED = 2.0
"""Estimated over specified noise above which an unmodelled effect is more likely."""

MAX_NOISE_FACTOR = 1.2
"""Estimated over specified noise above which, if significant, one asks why."""

LEAST_COMPLIANCE = -4.0
"""Compliance in its sigma below which it is negative: gravity never lifts a joint."""


class Statement(Record):
    """A statement about a result: one line, how severe it is, and whether it applies.

    Keys and commands stand in backticks within parentheses: the first page of a report leaves them out.
    """

    severity: Severity
    text: str
    applies: object = True


class Verdict(Record):
    """Whether a result is to be trusted, and what its reader should know.

    Attributes:
        errors: Why it is not to be trusted; empty if it is.
        warnings: Why sigmas may be too small although it is.
        notes: Other notes for its reader.
        setup: The set-up, by residuals before the calibration.
        systematic: How systematic residuals are; None where that cannot be told.
        change: Change while a table was measured; None if nothing did.
        variance: Variance that the noise is taken to have for the covariance, in that specified.
    """

    errors: tuple[str, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    setup: SetupCheck = field(default_factory=SetupCheck)
    systematic: effects.Systematic | None = None
    change: effects.Change | None = None
    variance: float = 1.0

    @property
    def noise_like(self) -> float | None:
        """P-value of residuals as systematic as these by noise alone; None where `systematic` is."""
        return None if self.systematic is None else self.systematic.p_value

    @property
    def cautions(self) -> tuple[str, ...]:
        """Warnings and notes."""
        return (*self.warnings, *self.notes)


class Case(Record):
    """A solution to be judged, and what its tests found.

    Attributes:
        solution: The solution.
        spread: The covariance of what was estimated.
        fit: How well it fits.
        identifiability: Identifiability by the rows, with motions that the robot's convention has no parameter for.
        regression: Its rows, linearised, with what the model does not have; None where the arm was evaluated
            or the solver did not converge.
        change: Change while a table was measured.
        systematic: See `Verdict`.
        setup: The set-up, which is checked after all else.
    """

    solution: Solution
    spread: Spread
    fit: Fit
    identifiability: Identifiability
    regression: effects.Regression | None = None
    change: effects.Change | None = None
    systematic: effects.Systematic | None = None
    setup: SetupCheck = field(default_factory=SetupCheck)

    @property
    def problem(self) -> Problem:
        """The problem solved."""
        return self.solution.problem

    @property
    def gross(self) -> GrossErrors | None:
        """The gross errors that are all that is wrong; None if there are none, or more than these is."""
        alone = self.fit.goodness.gross_alone and self.change is None and not self.effect
        return self.fit.goodness.gross if alone else None

    @property
    def effect(self) -> str:
        """What systematic residuals follow, with the p-value; empty where residuals are not systematic."""
        found = self.systematic
        if found is None or found.p_value >= effects.LIKE_NOISE or self.setup.explanations:
            return ""
        cause = found.cause or "no effect alone explains them (`effects: select`)"
        return f"{cause} (p = {max(found.p_value, 1e-300):.1g})"

    @property
    def too_large(self) -> bool:
        """Whether chi-square is too large without the corrections, which are judged by themselves."""
        chi2, priors = self.fit.chi_square, self.fit.priors
        if priors is None:
            return chi2.too_large
        rest, dof = chi2.value - priors.chi2, chi2.dof - len(priors.names)
        return rest > max(chi2.bounds[1] * dof, 0.0) or any(k.verdict == "too small" for k in self.fit.goodness.kinds)

    @property
    def variance(self) -> float:
        """Variance that the noise is taken to have for the covariance, in that specified; at least 1."""
        chi2, found = self.fit.chi_square, self.systematic
        significant = chi2.p_value is not None and chi2.p_value < SIGNIFICANT and not chi2.too_large
        of_regions = found.variance if found is not None and self.effect else 1.0
        return max(1.0, of_regions, chi2.ratio if significant and self.gross is None else 1.0)

    @property
    def high(self) -> bool:
        """Whether residuals are larger than the noise, or systematic, and not by gross errors alone."""
        return self.gross is None and (self.fit.chi_square.too_large or bool(self.effect))


def judge(solution: Solution, spread: Spread, fit: Fit, identifiability: Identifiability) -> Verdict:
    """The verdict on a solution.

    Args:
        solution: The solution.
        spread: The covariance of what was estimated.
        fit: How well it fits.
        identifiability: Identifiability by the rows.
    """
    problem = solution.problem
    regression = None if problem.evaluated or not solution.converged else effects.regress(solution)
    suspicious = solution.estimated_noise is not None or any(kind.verdict not in FINE for kind in fit.goodness.kinds)
    change = effects.find_change(regression) if suspicious and regression is not None else None
    systematic = None
    if regression is not None and change is None:
        even = effects.with_even_noise(solution, regression)
        other = None if even is solution else effects.regress(even)
        systematic = effects.find_systematic(regression, other, thorough=suspicious)
    case = Case(solution, spread, fit, identifiability, regression, change, systematic)
    found = {check: [statement for statement in check(case) if statement.applies] for check in CHECKS}
    doubts = any(s.severity == "error" for each in found.values() for s in each)
    much = any(kind.factor > MOST_ESTIMATED for kind in fit.goodness.kinds)
    if not problem.evaluated:
        case = replace(case, setup=check_problem(problem, solution.before, doubtful=doubts or much))
    fits = not (doubts or solution.estimated_noise is not None)
    found[check_fit] = list(check_fit(case))  # which names an effect only if the set-up is right
    lacking, offsets = list(check_missing(case)), list(check_offsets(case))
    explained = bool(offsets) or any(s.severity == "error" for s in lacking)  # why residuals are systematic
    statements = [*check_setup(case, fits=fits), *check_optima(case)]
    statements += () if explained else check_systematic(case, doubts=doubts or much)
    statements += [*(s for each in found.values() for s in each), *check_test_outliers(case)]
    statements += [Statement("note", text) for table in problem.data.tables for text in missing_values(table)]
    statements += [*check_excitation(identifiability), *offsets, *lacking]
    errors, warnings, notes = (texts(statements, severity) for severity in ("error", "warning", "note"))
    return Verdict(errors, warnings, notes, case.setup, systematic, change, case.variance)


def texts(statements: Sequence[Statement], severity: str) -> tuple[str, ...]:
    """The statements of a severity that apply."""
    return tuple(s.text for s in statements if s.severity == severity and s.applies)


def check_solver(case: Case) -> Iterator[Statement]:
    """Check whether the solver converged, and whether a robust loss left enough."""
    yield Statement("error", case.solution.message, not case.solution.converged)
    weights, data, loss = case.problem.state.weights, case.problem.data, case.problem.options.loss
    for s, w in zip(data.blocks, weights or (), strict=False):
        n, lost = len(s.train), int(np.sum(w[s.train] < OUTLIER_WEIGHT))
        of = f" of {data.labels[s.table]}" if len(data.labels) > 1 else ""
        text = f"loss {loss} takes {lost} of {n} measurements of {s.kind.names[0].partition('.')[0]}{of} for outliers"
        yield Statement("error", f"{text}: more than it can tell from noise", lost > MAX_OUTLIER_SHARE * n)


def check_change(case: Case) -> Iterator[Statement]:
    """Check whether something moved while a table was measured."""
    if case.change is not None:
        what, left = case.change.what, 100.0 * case.change.left
        where = f"from configuration {case.problem.end_names[case.change.configuration + 1]} on the {what} has moved"
        gain = f"chi-square falls to {left:.2g} % with a {what} of its own from there"
        yield Statement("error", f"{where} ({gain}): look for a target, a base or an instrument that moved")


def check_fit(case: Case) -> Iterator[Statement]:
    """Check chi-square, but where only the corrections make it too large."""
    chi2, problem = case.fit.chi_square, case.problem
    if case.fit.priors is None or case.too_large or not chi2.too_large:
        noise = any(kind.verdict == "too large" for kind in case.fit.goodness.kinds)
        updated, evaluated, effect = problem.knowledge is not None, problem.evaluated, case.effect
        yield from check_chi_square(chi2, case.gross, noise, evaluated=evaluated, updated=updated, effect=effect)
        text = "outliers were not searched for: there are too many rows; let a robust loss do so (`loss: gnc`)"
        yield Statement("warning", text, chi2.too_large and not case.effect and not case.fit.goodness.searched)


def check_chi_square(
    chi2: statistics.ChiSquare,
    gross: GrossErrors | None = None,
    noise: bool = True,
    *,
    evaluated: bool = False,
    updated: bool = False,
    effect: str = "",
) -> Iterator[Statement]:
    """Check chi-square of the fitted rows and priors.

    Args:
        chi2: Chi-square.
        gross: The gross errors that are all that is wrong; None if there are none, or more than these is.
        noise: Whether residuals of some kind are smaller than specified; else priors are, or what was known before.
        evaluated: Whether the arm was evaluated as it is.
        updated: Whether the rows were added to an earlier calibration.
        effect: What systematic residuals follow.
    """
    if chi2.dof <= 0:
        text = "no degree of freedom is left: nothing says whether the fit is right, or the noise; measure more"
        yield Statement("error", text)
        return
    reduced, ratio, (low, high) = chi2.value / chi2.dof, float(np.sqrt(chi2.ratio)), chi2.bounds
    outside, cause = f"reduced chi-square {reduced:.3g} is outside [{low:.2f}, {high:.2f}]", ""
    if evaluated:
        cause = "the arm does not predict these test rows, noise specified too small, or outliers"
    elif gross is not None:
        cause = (
            f"outliers: {gross.n} ({shorten(gross.names)}), {gross.ratio:.3g} without: look at them, or let a robust"
        )
        cause += " loss do so (`loss: gnc`)"
    elif updated:
        cause = "new rows contradict the earlier calibration: has the arm changed (see `fg-calib check`)?"
    elif effect:
        cause = "residuals are systematic"
    cause = cause or "noise specified too small, unmodelled effects, or outliers"
    yield Statement("error", f"{outside}: {cause}", reduced > high)
    text = f"{outside}: noise specified too large; sigmas are larger than they need be"
    yield Statement("note", text, reduced < low and noise)
    significant = low <= reduced <= high and chi2.p_value is not None and chi2.p_value < SIGNIFICANT
    text = f"reduced chi-square {reduced:.3g}: residuals are significantly larger than the specified noise"
    text += f" ({ratio:.2f} times), and sigmas are shown larger by as much"
    text += ": is the instrument as bad? Else the model lacks an effect"
    yield Statement("warning", text, significant and ratio > NOTABLE_RATIO)


def check_kept_noise(case: Case) -> Iterator[Statement]:
    """Check noise that was to be estimated, and had too few degrees of freedom for that."""
    estimated = case.solution.estimated_noise
    if estimated is None:
        return
    kept = [kind.kind for kind in case.fit.goodness.kinds if (kind.table, kind.kind) not in estimated]
    kept += ["the joint readings"] * (statistics.has_joint_noise(case.problem) and JOINT_NOISE not in estimated)
    text = f"the noise of {', '.join(dict.fromkeys(kept))} could not be estimated: fewer than {LEAST_REDUNDANCY:g}"
    text += " degrees of freedom are left to it; it is as specified, or 1 mm and 1 mrad where nothing was"
    text += "; nothing says whether it is right: measure more" * (not estimated)
    yield Statement("note" if estimated else "error", text, kept)


def check_test_rows(case: Case) -> Iterator[Statement]:
    """Check test rows: predicted worse than they should be, and worse than others were fitted."""
    fit, of_fitted = case.fit.goodness.test, case.fit.chi_square.ratio
    if fit is None:
        return
    ratio, many = fit.chi2 / fit.expected if fit.n else 0.0, fit.n_outliers > MAX_OUTLIER_SHARE * fit.n_measurements
    text = f"test rows: {fit.n_outliers} of {fit.n_measurements} measurements are outliers"
    yield Statement("error", f"{text}: more than a robust loss can tell from noise", many)
    large = ratio >= NOTABLE_RATIO**2 and fit.p_value < SIGNIFICANT
    if large and not many and not FACTOR < of_fitted > ratio / FACTOR:  # noise specified too small is reported once
        text = f"{predicted_in_words(fit)}: the arm does not predict them as well as it claims{_suspicious(fit)}"
        yield Statement("error" if ratio > FACTOR else "warning", text, not fit.has_outliers)


def check_test_outliers(case: Case) -> Iterator[Statement]:
    """Check whether a few test rows alone are predicted worse than they should be: they say nothing of the arm."""
    fit = case.fit.goodness.test
    if fit is not None and fit.has_outliers:
        text = f"outliers in {predicted_in_words(fit)}{_suspicious(fit)}; {fit.others:.2g} times its mean without"
        yield Statement("error", text)


def _suspicious(fit: statistics.PredictedFit) -> str:
    names = [configuration.id for configuration in fit.configurations]
    return f"; suspicious: {shorten(names)}" if names else ""


def check_gain(case: Case) -> Iterator[Statement]:
    """Check that test rows, outliers among them, are predicted better than by the nominal arm, and by least squares."""
    solution, problem = case.solution, case.problem
    if problem.evaluated or case.fit.goodness.test is None or not case.fit.goodness.test.n:
        return
    (before, old), (after, new) = (_test_misfit(problem, x) for x in (solution.before, solution.parameters))
    worse = new - old
    certain = worse.mean() > GAIN_SCORE * worse.std() / np.sqrt(len(worse))
    text = f"test rows are predicted no better than by the nominal arm ({after:.3g} sigma RMS, {before:.3g} before)"
    text += ": the calibration is no gain; keep the nominal arm" if certain else ", as far as chance tells"
    yield Statement("error" if certain else "warning", text, after > before)
    if problem.options.loss != "none":
        plain = replace(problem, options=replace(problem.options, loss="none"))
        plain = with_factors(plain, problem.start, replace(problem.state, weights=None))
        try:
            least, _ = _test_misfit(problem, solve(plain).parameters)
        except CalibrationError:  # says nothing of the loss
            return
        text = f"least squares predicts the test rows better ({least:.3g} sigma RMS, {after:.3g} with loss"
        text += f" {problem.options.loss}): it takes effects for outliers (use `loss: none`)"
        yield Statement("error", text, after > LEAST_GAIN * least)


def _test_misfit(problem: Problem, parameters: Floats) -> tuple[float, Floats]:
    """RMS of all test rows at a parameter vector, over their noise, and the sum of squares of each measurement's."""
    each = zip(problem.data.blocks, mahalanobis_distances(problem, parameters), strict=True)
    e, n = (np.concatenate(found) for found in zip(*((e[s.test], n[s.test]) for s, (e, n) in each), strict=True))
    return float(np.sqrt(np.sum(e**2) / max(np.sum(n), 1))), e**2


def check_priors(case: Case) -> Iterator[Statement]:
    """Check corrections against their prior sigmas; nothing without priors."""
    fit = case.fit.priors
    if fit is None:
        return
    causes = "prior sigmas (key `tolerance`) specified too small, or the measurements are not what the job says"
    for one in fit.beyond:
        text = f"{one.name} lies {one.z:.1f} prior sigmas from where it was specified: {causes}"
        yield Statement("error", text, one.is_place)
    worst = [f"{one.name} {one.z:+.1f}" for one in fit.beyond if not one.is_place and not is_negative_compliance(one)]
    text = f"corrections beyond their prior sigmas (in sigma of these: {shorten(worst)}): {causes}"
    yield Statement("error", text, worst)
    largest = [f"{fit.names[i]} {fit.z[i]:+.1f}" for i in np.argsort(-np.abs(fit.z))]
    text = f"corrections are too large for their prior sigmas (in sigma of these: {shorten(largest)}; sum of squares"
    text += f" {fit.chi2:.3g} where {fit.expected:.3g} is expected): {causes}"
    p_value = 1.0 if fit.beyond or fit.p_value is None else fit.p_value
    certain = fit.chi2 > FACTOR * fit.expected and p_value < PRIOR_P_VALUE
    yield Statement("error" if certain else "note", text, p_value < SIGNIFICANT)


def check_compliances(case: Case) -> Iterator[Statement]:
    """Check for joints that rise under load."""
    robot, sigma = case.problem.robot, np.sqrt(np.diagonal(case.spread.tangent))
    z = {name: case.solution.parameters[robot.index(name)] / sigma[k] if sigma[k] else 0.0
         for k, name in enumerate(case.problem.variables.names) if name.endswith(".compliance")}  # fmt: skip
    far = [] if case.fit.priors is None else [one.name for one in case.fit.priors.beyond if is_negative_compliance(one)]
    worst = [f"{name} {z[name]:.0f}" for name in z if z[name] < LEAST_COMPLIANCE or name in far]
    text = f"joints rise under load (compliance in sigma: {shorten(worst)}): the masses or gravity are wrong, or a"
    text += " spring balances the arm; estimate the loads instead (`masses: free`)"
    yield Statement("error" if far else "warning", text, worst)


def is_negative_compliance(one: Beyond) -> bool:
    """Whether a correction beyond its prior sigma is a negative compliance."""
    return one.name.endswith(".compliance") and one.z < 0.0


def check_signs(case: Case) -> Iterator[Statement]:
    """Check lengths and angles near 0 and 180 degrees, and what is not linear within the posterior.

    Near 180 degrees a vector has one other sign only: where there are more rows than they determine, a wrong sign shows
    in chi-square. Vectors near 0 point anywhere, which fits.
    """
    rows = find_ambiguous_rows(case.solution, case.spread)
    return check_linear(rows, check_linearity(case.solution, case.spread), case.fit.chi_square.too_large)


def check_linear(rows: AmbiguousRows, nonlinear: Nonlinearity, high: bool = False) -> Iterator[Statement]:
    """Check ambiguous signs, else nonlinearity, by which the covariance is optimistic: one statement with the remedy.

    Args:
        rows: Lengths and angles of ambiguous sign or direction.
        nonlinear: Nonlinearity within the posterior.
        high: Whether residuals are too large for the noise, which a single wrong sign may be the cause of.
    """
    curved = nonlinear.directions >= NONLINEAR
    sign = bool(rows.names) and (high or curved or rows.share >= AMBIGUOUS_SHARE)
    names, what = (rows.names, "sign") if sign else (rows.turned, "direction")
    share = f"; {100.0 * rows.share:.0f} % of the information rests on them" * sign
    text = f"the {what} of {len(names)} of {rows.n_rows} lengths and angles is ambiguous within the prior sigmas"
    text += f" ({shorten(names)} near 0 or 180 deg{share}): there may be a better optimum far away, and sigmas"
    text += " may be too small; leave these out, or measure longer and wider motions, in which more joints move"
    ambiguous = sign or (bool(rows.turned) and not curved)
    yield Statement("error" if rows.share > MAX_AMBIGUOUS_SHARE else "warning", text, ambiguous)
    beyond = f"some {np.sqrt(1.0 + nonlinear.directions):.2g}" if np.isfinite(nonlinear.directions) else "many"
    text = "the measurements are nonlinear within the posterior sigmas, so the covariance is optimistic in weak"
    text += f" directions: errors there are {beyond} times what it says"
    advice = "measure at more configurations, or specify smaller prior sigmas"
    yield Statement("warning", f"{text}; {advice}", nonlinear.matters and curved and not ambiguous)
    yield Statement("note", f"{text}; not those of the tool", curved and not nonlinear.matters and not ambiguous)


def check_estimated_noise(case: Case) -> Iterator[Statement]:
    """Check whether few rows make estimated noise large, and whether it is small compared with motions of joints."""
    estimated, gross = case.solution.estimated_noise, case.fit.goodness.gross
    if not estimated:
        return
    if gross is not None:
        text = f"outliers: {gross.n} ({shorten(gross.names)}) make the estimated noise {gross.ratio**-0.5:.3g} times as"
        text += " large: look at them, or let a robust loss do so (`loss: gnc`)"
        yield Statement("error" if case.effect else "warning", text)
    readings = case.problem.data.readings[:MOST_READINGS]
    at = pose(case.problem.robot, readings).jacobian[:, :, -readings.shape[1] :] * readings.std(axis=0)
    turn, shift = (float(np.sqrt(np.mean(np.sum(part**2, axis=2)))) for part in (at[:, :3], at[:, 3:]))
    for fit in case.fit.goodness.kinds:
        ratio = fit.factor * fit.specified_sigma_rms / {"m": shift, "rad": turn}.get(fit.unit, np.inf)
        text = f"the noise estimated of {fit.kind} is {ratio:.2g} times as large as what the joints move"
        text += ": the arm explains next to nothing; check the table and the job"
        yield Statement("error", text, (fit.table, fit.kind) in estimated and ratio >= LARGE_NOISE)
        text = f"the noise estimated of {fit.kind} is {fit.factor:.3g} times that specified (1 mm, 1 mrad where nothing"
        text += " was): is the instrument as bad? Else the model lacks an effect, and no sigma holds what it costs"
        significant = (
            fit.factor > MAX_NOISE_FACTOR and statistics.upper_probability(fit.factor**2, fit.degrees) < SIGNIFICANT
        )
        yield Statement("warning", text, gross is None and significant)


CHECKS: tuple[Callable[[Case], Iterator[Statement]], ...] = (
    *(check_solver, check_change, check_fit, check_kept_noise, check_test_rows, check_gain, check_priors),
    *(check_compliances, check_signs, check_estimated_noise),
)
"""The checks of every solution, in the order of their statements; for what comes before and after them see `judge`."""


def check_systematic(case: Case, *, doubts: bool) -> Iterator[Statement]:
    """Check whether residuals are systematic, which is the cause of other doubts, if it is not a wrong set-up."""
    text, grown = f"systematic residuals: {case.effect}; ", float(np.sqrt(case.variance))
    grows = f"sigmas are {grown:.2g} times what noise alone makes them, as regions of joint space disagree; "
    text += f"{grows * (grown >= NOTABLE_RATIO)}where no row is, errors may be larger: rely on the test rows"
    yield Statement("error" if doubts else "warning", text, case.effect)


def check_offsets(case: Case) -> Iterator[Statement]:
    """Check lengths to anchors that are all off by the same.

    Where residuals are too large for the noise the linearised fit knows less of the offset than its sigma says.
    """
    labels, high = case.problem.data.labels, case.fit.chi_square.too_large
    rows = None if case.gross is not None or case.setup.explanations else case.regression
    for found in () if rows is None else effects.forgotten_offsets(rows):
        of = f" of {labels[found.table]}" if len(labels) > 1 else ""
        adds = f"{1e3 * found.size:+.3g} mm"
        adds = f"some {adds} to each" if high else f"{adds} to each (sigma {1e3 * found.sigma:.2g} mm)"
        text = f"the lengths{of} fit better if the instrument adds {adds}, which was not estimated:"
        text += " estimate it (`offset: estimate`), or calibrate the instrument"
        yield Statement("error" if high else "warning", text)


def check_missing(case: Case) -> Iterator[Statement]:
    """Check whether what the convention has no parameter for explains the misfit; an update's convention did before."""
    asked = case.high and not case.setup.explanations and case.problem.knowledge is None
    for motion in case.identifiability.missing:
        certain = asked and case.regression is not None and effects.explains_misfit(case.regression, motion)
        of_axes = [p for p in case.problem.robot.parameters if p.estimated and p.owner in motion.axes]
        few = all(p.kind == "theta" for p in of_axes)
        text = f"{motion}; estimate more than zeros first" if few else str(motion)
        yield Statement("error" if certain and not few else "note", text)


def check_excitation(found: Identifiability) -> Iterator[Statement]:
    """Check whether other configurations would determine more; of more than these do their result is mostly priors."""
    n, rank = sum(direction.reason == NOT_EXCITED for direction in found.lost), found.observability.rank
    text = f"these rows determine {rank} of {len(found.observability.names)} parameters; directions not excited by"
    text += f" these configurations although the model sees more: {n}; move every joint more"
    yield Statement("warning" if n > rank else "note", text, n)


def check_setup(case: Case, *, fits: bool) -> Iterator[Statement]:
    """Check the set-up, before all else: where it is wrong no value can be right.

    Args:
        case: The solution.
        fits: Whether nothing speaks against the calibration although the noise was as specified.
    """
    for check in (case.setup, *case.setup.others):
        if check.explanations:
            yield Statement("note" if fits else "error", str(check))
        elif check.far and case.high:
            yield Statement("error", str(check))


def check_optima(case: Case) -> Iterator[Statement]:
    """Check for other optima: the four parameters that differ most, in their prior sigmas, with both corrections."""
    robot = case.problem.robot
    advice = "; measure positions, or pairs between which more joints move" if case.problem.pair_blocks else ""
    for other in case.solution.others:
        both, span = (case.solution.parameters, other), case.problem.variables.robot_span
        here, there = (at[span] - robot.nominal for at in both)
        apart = np.abs(there - here) / [p.scale for p in robot.parameters]
        words = []
        for i in [i for i in np.argsort(-apart, kind="stable")[:4].tolist() if apart[i] > 0.3 * apart.max()]:
            unit, factor, *_ = SCALES[robot.parameters[i].unit]
            words.append(f"{robot.parameters[i].name} {factor * here[i]:+.3g} or {factor * there[i]:+.3g} {unit}")
        text = f"a second optimum that the data cannot distinguish from this one: {', '.join(words)} from nominal"
        yield Statement("error", text + advice)


def chi2_in_words(chi2: float, expected: float, p_value: float) -> str:
    """`chi-square 169 where 30 is expected (p-value < 0.001)`."""
    return f"chi-square {chi2:.4g} where {expected:.4g} is expected (p-value {probability(p_value)})"


def predicted_in_words(fit: statistics.PredictedFit) -> str:
    """`test rows: chi-square 1012 where 1000 is expected (p-value 0.4), of 1000 of the 9990 rows, evenly spaced`."""
    some = f", of {fit.n} of the {fit.n_rows} rows, evenly spaced" if fit.n < fit.n_rows else ""
    return f"test rows: {chi2_in_words(fit.chi2, fit.expected, fit.p_value)}{some}"


def probability(p: float) -> str:
    """A probability with two digits, none beyond a thousandth from 0 and 1."""
    return "< 0.001" if p < 1e-3 else "> 0.999" if p > 0.999 else f"{p:.2g}" if p < 0.1 else f"{p:.2f}"
