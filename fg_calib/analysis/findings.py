"""What a solution as a whole gives reason to say: from solver, noise, set-up and model to the verdict's statements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fg_calib.analysis.chi_square import ChiSquare
from fg_calib.analysis.conventions import MissingMotion
from fg_calib.analysis.corrections import PriorFit
from fg_calib.analysis.covariance import Spread
from fg_calib.analysis.goodness import OUTLIER_WEIGHT, Goodness
from fg_calib.analysis.mistakes import SetupCheck, check_problem
from fg_calib.analysis.residual_table import ResidualTable
from fg_calib.analysis.structure import probability_of_noise
from fg_calib.analysis.verdict import (
    Statement,
    of_bent,
    of_chi2,
    of_estimated_noise,
    of_evaluation,
    of_folds,
    of_priors,
    of_test,
)
from fg_calib.graph.noise import PairNoise
from fg_calib.graph.problem import noises_at
from fg_calib.graph.solver import Solution

Floats = NDArray[np.float64]

MOST_OUTLIERS = 0.5
"""Share of measurements beyond which they are not outliers but the majority."""

BENT = 1.0
"""Sigma by which what the parameters may still be off bends a row that is not linear enough."""

MOST_ESTIMATED = 2.0
"""Noise seen over noise stated above which it is more likely that something is not modelled."""

_WITH_FIGURES = ("distance", "angle", "orientation", "position")
"""Kinds of noise whose motions are seen in what was measured."""

LIKE_NOISE = 1e-3
"""Probability below which residuals follow the arm more than noise does."""


@dataclass(frozen=True)
class Fit:
    """How well a solution fits, figure by figure.

    Attributes:
        chi2: Chi-square of the fitted rows and the priors.
        table: Every residual.
        goodness: Goodness of fit by kind, by row and by configuration.
        priors: Corrections against tolerances; None without priors.
    """

    chi2: ChiSquare
    table: ResidualTable
    goodness: Goodness
    priors: PriorFit | None


@dataclass(frozen=True)
class Verdict:
    """Whether a result is to be trusted, and what its reader should know.

    Attributes:
        findings: Why it is not to be trusted; empty if it is.
        cautions: What its reader should know although nothing speaks against it.
        setup: What residuals before the calibration say of its set-up.
        noise_like: Probability that noise alone follows the arm as much as the residuals do; None where that was not
            asked, because they are as small as stated, or cannot be told.
    """

    findings: tuple[str, ...]
    cautions: tuple[str, ...]
    setup: SetupCheck = field(default_factory=SetupCheck)
    noise_like: float | None = None


def judge(solution: Solution, spread: Spread, fit: Fit, missing: Sequence[MissingMotion]) -> Verdict:
    """The verdict on a solution.

    Args:
        solution: The solution.
        spread: The covariance of what was estimated.
        fit: How well it fits.
        missing: What the robot's convention has no parameter for.
    """
    problem, kinds = solution.problem, fit.goodness.kinds
    estimated_noise = solution.estimated_noise is not None
    of_priors_alone = fit.priors is not None and fit.chi2.too_large and not _too_large(fit)
    statements = [
        *_of_solver(solution),
        *(() if of_priors_alone else of_chi2(fit.chi2, problem.evaluated)),
        *of_evaluation(problem.evaluated, estimated_noise),
        *of_test(fit.goodness.test, fit.chi2.ratio, problem.end_names),
        *of_priors(fit.priors),
        *_of_bent_rows(solution, spread, fit.table, fit.goodness),
        *_of_noise(solution, fit.table, fit.goodness),
    ]
    doubts = tuple(s.text for s in statements if s.finding)
    cautions = tuple(s.text for s in statements if not s.finding)
    too_large = {kind.verdict for kind in kinds} & {"too small", "both"}
    asked = not problem.evaluated and (too_large or (missing and estimated_noise))
    noise_like = probability_of_noise(solution) if asked else None
    follow = noise_like is not None and noise_like < LIKE_NOISE
    setup = SetupCheck()
    if not problem.evaluated:
        doubtful = bool(doubts) or max((kind.factor for kind in kinds), default=1.0) > MOST_ESTIMATED
        setup = check_problem(problem, solution.before, doubtful=doubtful)
    fits = not (doubts or estimated_noise)
    first = _of_model(setup, missing, fits=fits, high=fit.chi2.too_large or follow)
    return Verdict((*first[0], *doubts), (*first[1], *cautions), setup, noise_like)


def _too_large(fit: Fit) -> bool:
    """Whether chi-square is too large without the corrections, which are judged by themselves."""
    if fit.priors is None:
        return fit.chi2.too_large
    rest, dof = fit.chi2.value - fit.priors.chi2, fit.chi2.dof - len(fit.priors.names)
    return rest > max(fit.chi2.bounds[1] * dof, 0.0) or any(
        kind.verdict in ("too small", "both") for kind in fit.goodness.kinds
    )


def _of_bent_rows(solution: Solution, spread: Spread, table: ResidualTable, goodness: Goodness) -> list[Statement]:
    """Whether the result rests on lengths and angles that are far from linear in what is still unknown."""
    values, V = np.linalg.eigh(spread.tangent)
    half, scales = V * np.sqrt(np.maximum(values, 0.0)), np.diag(solution.problem.variables.prior_scales)
    noises = noises_at(solution.problem, solution.parameters, at_readings=True)
    leverage = np.nan_to_num(goodness.leverage)
    bent, folded, lengths = (np.zeros(table.n, dtype=np.bool_) for _ in range(3))
    for number, noise in enumerate(noises):
        if isinstance(noise, PairNoise):
            rows = np.flatnonzero(table.used & (table.series == number))
            place = (table.measurement[rows], table.row[rows])
            lengths[rows] = True
            bent[rows], folded[rows] = noise.bent_by(half, BENT)[place], noise.may_fold(scales)[place]
    if not lengths.any():
        return []
    n_rows = int(lengths.sum())
    share = float(leverage[folded].sum() / max(leverage[table.used].sum(), 1e-300))
    return [
        *of_bent(int(bent.sum()), n_rows, float(leverage[bent].sum())),
        *of_folds(int(folded.sum()), n_rows, share),
    ]


def _of_noise(solution: Solution, table: ResidualTable, goodness: Goodness) -> list[Statement]:
    """Whether noise that was estimated is small beside the motions it was estimated of."""
    found: list[Statement] = []
    for fit in goodness.kinds:
        if (fit.table, fit.kind) in (solution.estimated_noise or ()) and fit.kind in _WITH_FIGURES:
            rows = table.used & (table.group == table.groups.index((fit.table, fit.kind)))
            predicted = (table.measured + table.after)[rows]
            about = 0.0 if fit.kind in ("distance", "angle") else float(np.mean(predicted))
            motion = 1.0 if fit.kind == "orientation" else float(np.sqrt(np.mean((predicted - about) ** 2)))
            found += of_estimated_noise(fit.kind, fit.factor * fit.stated_sigma_rms, max(motion, 1e-300))
    return found


def _of_solver(solution: Solution) -> list[Statement]:
    """Whether it arrived, and whether a robust loss left enough."""
    statements = []
    if not solution.converged:
        statements.append(Statement(solution.message, finding=True))
    statements += [Statement(text, finding=True) for text in _other_optima(solution)]
    weights, series = solution.problem.state.weights, solution.problem.data.series
    labels = solution.problem.data.labels
    for s, w in zip(series, weights or (), strict=False):
        n, lost = len(s.train), int(np.sum(w[s.train] < OUTLIER_WEIGHT))
        if lost > MOST_OUTLIERS * n:
            of = f" of {labels[s.table]}" if len(labels) > 1 else ""
            what = f"loss {solution.problem.options.loss} takes {lost} of {n} measurements"
            text = f"{what} of {s.kind.names[0].partition('.')[0]}{of} for outliers"
            statements.append(Statement(f"{text}: more than it can tell from noise", finding=True))
    return statements


def _of_model(
    setup: SetupCheck, missing: Sequence[MissingMotion], *, fits: bool, high: bool
) -> tuple[list[str], list[str]]:
    """Findings and cautions that come before all others: the set-up or the model is wrong, so no figure can be right.

    Args:
        setup: What residuals before the calibration say of the set-up.
        missing: What the robot's convention has no parameter for.
        fits: Whether nothing speaks against the calibration although the noise was as stated.
        high: Whether the residuals are larger than the noise, or follow the arm.
    """
    findings: list[str] = []
    cautions: list[str] = []
    if setup.explanations:
        (cautions if fits else findings).append(str(setup))
    elif setup.far and high:
        findings.append(str(setup))
    for motion in missing:
        (findings if high and not setup.explanations else cautions).append(str(motion))
    return findings, cautions


def _other_optima(solution: Solution, most: int = 4) -> list[str]:
    """A line for each other optimum: the parameters that differ most, in their tolerances, with both corrections."""
    robot, found = solution.problem.robot, []
    for other in solution.others:
        apart = {p.name: abs(other[i] - solution.parameters[i]) / p.scale for i, p in enumerate(robot.parameters)}
        largest = max(apart.values())
        named = sorted((name for name in apart if apart[name] > 0.3 * largest), key=lambda name: -apart[name])[:most]
        words = []
        for i in map(robot.index, named):
            p = robot.parameters[i]
            factor, unit = (1e3, "mm") if p.unit == "m" else (180.0 / np.pi, "deg")
            here, there = (factor * (at[i] - p.nominal) for at in (solution.parameters, other))
            words.append(f"{p.name} {here:+.3g} or {there:+.3g} {unit}")
        found.append(f"a second optimum that the data cannot tell from this one: {', '.join(words)} from nominal")
    return found
