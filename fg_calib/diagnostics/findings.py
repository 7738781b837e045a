"""What a solution as a whole gives reason to say: from solver, noise, set-up and model to the verdict's statements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.diagnostics.changes import Change, find_change
from fg_calib.diagnostics.linearity import beyond_linear
from fg_calib.diagnostics.offsets import forgotten_offsets
from fg_calib.diagnostics.other_sides import wide_root
from fg_calib.diagnostics.setup_check import SetupCheck
from fg_calib.diagnostics.table_setups import check_problem
from fg_calib.diagnostics.unmodelled_effects import excess_left, probability_of_noise
from fg_calib.diagnostics.verdict import (
    LIKE_NOISE,
    Statement,
    of_bent,
    of_change,
    of_chi2,
    of_curvature,
    of_estimated_noise,
    of_evaluation,
    of_folds,
    of_kept_noise,
    of_lost,
    of_offset,
    of_priors,
    of_structure,
    of_test,
    of_tolerances,
)
from fg_calib.graph.noise import JOINT_NOISE, PairNoise
from fg_calib.graph.problem import at_parameters, reweighted_at
from fg_calib.graph.solver import Solution
from fg_calib.measurements.kinds.pair import missing_values
from fg_calib.observability.parallel_axes import MissingMotion
from fg_calib.robot.kinematics import forward
from fg_calib.statistics.covariance import Spread
from fg_calib.statistics.goodness_of_fit import OUTLIER_WEIGHT, Fit, Goodness
from fg_calib.statistics.noise_components import has_joint_noise
from fg_calib.statistics.residual_table import ResidualTable

Floats = NDArray[np.float64]

MOST_OUTLIERS = 0.5
"""Share of measurements beyond which they are not outliers but the majority."""

BENT = 1.0
"""Sigma by which what the parameters may still be off bends a row that is not linear enough."""

LOST = 3.0
"""Sigma of a parameter over what it is with all outliers, from which these are nearly all that sees it."""

EXPLAINED = 0.8
"""Part of the excess of chi-square left with what a convention has no parameter for, up to which that is the cause.

Where the fit went far astray what is linear of it is but a part: up to 0.7 were left of textbook tables."""

MOST_ESTIMATED = 2.0
"""Noise seen over noise stated above which it is more likely that something is not modelled."""

_WITH_MOTION = ("distance", "angle", "orientation", "position")
"""Kinds of noise whose motions are told from what the arm predicts."""


@dataclass(frozen=True)
class Verdict:
    """Whether a result is to be trusted, and what its reader should know.

    Attributes:
        findings: Why it is not to be trusted; empty if it is.
        cautions: What its reader should know although nothing speaks against it.
        setup: What residuals before the calibration say of its set-up.
        noise_like: Probability that noise alone follows the arm as much as the residuals do; None where that was not
            asked, because they are as small as stated, or cannot be told.
        reservations: Those of the cautions that say that sigmas are too small.
        change: What moved while a table was measured; None if nothing did.
    """

    findings: tuple[str, ...]
    cautions: tuple[str, ...]
    setup: SetupCheck = field(default_factory=SetupCheck)
    noise_like: float | None = None
    reservations: tuple[str, ...] = ()
    change: Change | None = None


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
    updated = problem.knowledge is not None
    of_priors_alone = fit.priors is not None and fit.chi_square.too_large and not _too_large(fit)
    too_large = {kind.verdict for kind in kinds} & {"too small", "both", "many"}
    asked = not problem.evaluated and (too_large or estimated_noise)
    may_change = asked or (any(kind.verdict == "outliers" for kind in kinds) and not problem.evaluated)
    change = find_change(solution) if may_change else None
    gross = fit.goodness.gross if fit.goodness.spoilt and change is None else None
    noise_like = probability_of_noise(solution) if asked and change is None else None
    follow = noise_like is not None and noise_like < LIKE_NOISE
    statements = [
        *_of_solver(solution),
        *of_change(change, problem.end_names),
        *(
            ()
            if of_priors_alone
            else of_chi2(fit.chi_square, problem.evaluated, follow=follow, gross=gross, updated=updated)
        ),
        *of_evaluation(problem.evaluated, estimated_noise),
        *_of_kept_noise(solution, fit.goodness),
        *of_test(fit.goodness.test, fit.chi_square.ratio, problem.end_names),
        *of_priors(fit.priors),
        *_of_tolerances(solution, fit),
        *_of_bent_rows(solution, spread, fit.residuals, fit.goodness, too_large=fit.chi_square.too_large),
        *of_curvature(beyond_linear(solution, spread)),
        *_of_noise(solution, fit.residuals, fit.goodness),
        *(Statement(text, finding=False) for table in problem.data.tables for text in missing_values(table)),
    ]
    setup, structure = SetupCheck(), of_structure(noise_like)
    doubts = any(s.finding for s in (*statements, *structure))
    statements[:0] = [Statement(text, finding=True) for text in _other_optima(solution)]  # which fit as well
    if not problem.evaluated:
        doubtful = doubts or max((kind.factor for kind in kinds), default=1.0) > MOST_ESTIMATED
        setup = check_problem(problem, solution.before, doubtful=doubtful)
    if not (setup.explanations or gross is not None):
        labels = problem.data.labels
        statements += [
            s for found in forgotten_offsets(solution) for s in of_offset(found, labels, fit.chi_square.too_large)
        ]
    fits = not (doubts or estimated_noise)
    high = gross is None and (fit.chi_square.too_large or follow)
    asked = high and bool(missing) and not setup.explanations and not updated  # the convention did before
    certain = asked and excess_left(solution, missing) <= EXPLAINED
    findings, cautions = _of_model(setup, missing, fits=fits, high=high, certain=certain)
    statements += [] if setup.explanations else structure  # of a wrong set-up they are the consequence
    findings += [s.text for s in statements if s.finding]
    cautions += [s.text for s in statements if not s.finding]
    reservations = tuple(s.text for s in statements if s.reservation)
    return Verdict(tuple(findings), tuple(cautions), setup, noise_like, reservations, change)


def _too_large(fit: Fit) -> bool:
    """Whether chi-square is too large without the corrections, which are judged by themselves."""
    if fit.priors is None:
        return fit.chi_square.too_large
    rest, dof = fit.chi_square.value - fit.priors.chi2, fit.chi_square.dof - len(fit.priors.names)
    return rest > max(fit.chi_square.bounds[1] * dof, 0.0) or any(
        kind.verdict in ("too small", "both", "many") for kind in fit.goodness.kinds
    )


def _of_tolerances(solution: Solution, fit: Fit) -> list[Statement]:
    """What tolerances that were estimated say."""
    found = solution.estimated_tolerances
    return [] if found is None else of_tolerances(found.scales, _too_large(fit))


def _of_bent_rows(
    solution: Solution, spread: Spread, table: ResidualTable, goodness: Goodness, *, too_large: bool
) -> list[Statement]:
    """Whether the result rests on lengths and angles that are far from linear in what is still unknown.

    About half a turn a vector has one other side only: where there are more rows than they determine, wrong sides show
    in chi-square. In simulations there, of tolerances of 7 to 30 sigma, that of each wrong one was 12 to 80 times too
    large, and without a wrong one the sigmas were honest (experiment 08). Vectors about 0 point anywhere, which fits.
    """
    scales = np.diag(solution.problem.variables.prior_scales)
    leverage = np.nan_to_num(goodness.leverage)
    bent, folded, turned, lengths = (np.zeros(table.n, dtype=np.bool_) for _ in range(4))
    for number, noise in enumerate(solution.noises):
        if isinstance(noise, PairNoise):
            rows, measured = table.rows_of(number), noise.series.measured
            used = lengths[rows] = table.used[rows]
            bent[rows] = noise.bent_by(spread.root, BENT)[measured] & used
            folded[rows] = noise.may_fold(scales)[measured] & used
            turned[rows] = noise.about_half_a_turn()[measured] & used
    if not lengths.any():
        return []
    turned &= folded
    if not too_large and leverage[turned].sum() < 0.5 * turned.sum():
        folded &= ~turned
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
        if (fit.table, fit.kind) in (solution.estimated_noise or ()) and fit.kind in _WITH_MOTION:
            motion = 1.0 if fit.kind == "orientation" else _motion(solution, table, fit.table, fit.kind)
            found += of_estimated_noise(fit.kind, fit.factor * fit.stated_sigma_rms, max(motion, 1e-300))
    return found


def _motion(solution: Solution, table: ResidualTable, number: int, kind: str) -> float:
    """How far the arm says that what was measured of a kind moved, by the series that moved most.

    Lengths and angles between two ends move by as much as they are. What has one end moves as the tool point does along
    an axis, also where figures do not: on a face, about an anchor, before a board; in contact as the anchors are apart.
    At a single one the tool point stays, and the arm moves by its reach.
    """
    problem, motions = solution.problem, [0.0]
    at = at_parameters(problem, solution.parameters)
    for k, s in enumerate(problem.data.series):
        if s.table != number or all(name.partition(".")[0] != kind for name in s.kind.names):
            continue
        if s.kind.ends == 1:
            trig = problem.data.trigs(problem.robot)[number]
            there = forward(at.chains[number].without_columns(), trig, s.ends[s.train, 0]).position
            if s.kind.is_contact and s.kind.n_nuisances and not s.kind.turned_back:
                there = at.coordinates[s.nuisances[s.train]]
            stays = not np.ptp(there, axis=0).any()
            motions.append(problem.robot.reach if stays else float(np.sqrt(np.mean(np.var(there, axis=0)))))
        else:
            group = table.groups.index((number, kind))
            predicted = (table.measured + table.after)[table.used & (table.series == k) & (table.group == group)]
            motions.append(float(np.sqrt(np.mean(predicted**2))) if len(predicted) else 0.0)
    return max(motions)


def _of_kept_noise(solution: Solution, goodness: Goodness) -> list[Statement]:
    """Noise that was to be estimated and stayed as stated."""
    estimated = solution.estimated_noise
    if estimated is None:
        return []
    kept = [kind.kind for kind in goodness.kinds if (kind.table, kind.kind) not in estimated]
    factors = solution.problem.state.factors
    off = max((factors.get(name, 1.0) for name in estimated), default=1.0) if kept else 1.0
    if has_joint_noise(solution.problem) and JOINT_NOISE not in estimated:
        kept.append("the joint readings")
    return of_kept_noise(list(dict.fromkeys(kept)), not estimated, off)


def _of_solver(solution: Solution) -> list[Statement]:
    """Whether it arrived, and whether a robust loss left enough."""
    statements = []
    if not solution.converged:
        statements.append(Statement(solution.message, finding=True))
    weights, series = solution.problem.state.weights, solution.problem.data.series
    labels = solution.problem.data.labels
    for s, w in zip(series, weights or (), strict=False):
        n, lost = len(s.train), int(np.sum(w[s.train] < OUTLIER_WEIGHT))
        if lost > MOST_OUTLIERS * n:
            of = f" of {labels[s.table]}" if len(labels) > 1 else ""
            what = f"loss {solution.problem.options.loss} takes {lost} of {n} measurements"
            text = f"{what} of {s.kind.names[0].partition('.')[0]}{of} for outliers"
            statements.append(Statement(f"{text}: more than it can tell from noise", finding=True))
    return statements + of_lost(_lost(solution), solution.problem.options.loss)


def _lost(solution: Solution) -> list[str]:
    """Parameters that nearly only outliers see: with these their sigma would be so much smaller."""
    problem, at = solution.problem, solution.parameters
    weights, series = problem.state.weights, problem.data.series
    if not any(np.any(w[s.train] < OUTLIER_WEIGHT) for s, w in zip(series, weights or (), strict=False)):
        return []
    whole = reweighted_at(problem, at, replace(problem.state, weights=None))
    weighted, all_of_them = (np.linalg.norm(wide_root(one, at), axis=1) for one in (problem, whole))
    lost = weighted[: problem.variables.n_robot_columns] > LOST * all_of_them[: problem.variables.n_robot_columns]
    return [problem.variables.names[i] for i in np.flatnonzero(lost)]


def _of_model(
    setup: SetupCheck, missing: Sequence[MissingMotion], *, fits: bool, high: bool, certain: bool
) -> tuple[list[str], list[str]]:
    """Findings and cautions that come before all others: the set-up or the model is wrong, so no figure can be right.

    Args:
        setup: What residuals before the calibration say of the set-up.
        missing: What the robot's convention has no parameter for.
        fits: Whether nothing speaks against the calibration although the noise was as stated.
        high: Whether the residuals are larger than the noise, or follow the arm.
        certain: Whether they are because of what the convention has no parameter for.
    """
    findings: list[str] = []
    cautions: list[str] = []
    for check in (setup, *setup.others):
        if check.explanations:
            (cautions if fits else findings).append(str(check))
        elif check.far and high:
            findings.append(str(check))
    if high and setup.unchecked:
        what = (
            f"the set-up of {', '.join(setup.unchecked)} was not checked for the usual mistakes (units, signs, columns)"
        )
        cautions.append(f"{what}: too few rows to place what is unknown, or kinds of measurement of your own")
    for motion in missing:
        (findings if certain else cautions).append(str(motion))
    return findings, cautions


def _other_optima(solution: Solution, most: int = 4) -> list[str]:
    """A line for each other optimum: the parameters that differ most, in their tolerances, with both corrections."""
    robot, found = solution.problem.robot, []
    advice = "; positions, or pairs between which more joints move, may tell" if solution.problem.pair_series else ""
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
        found.append(
            f"a second optimum that the data cannot tell from this one: {', '.join(words)} from nominal{advice}"
        )
    return found
