"""Whether a calibration is still good: new rows against the calibrated arm, and what changed if it is not.

The rows say no more than noise and the calibration's own uncertainty make of them, or they do not: by chi-square, and
by what single changes explain of it (see `hypotheses`), which sees an offset change of one joint long before
chi-square of many rows does. Where limits are set they decide: an arm within them is good although its rows show a
change, as long as that change stays within them everywhere.

Rows of one configuration that are gross errors are named and left out of the judgement; noise that is specified too
small is no change of the arm.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy import special

from fg_calib.diagnostics import check_tables, reporting
from fg_calib.inputs import LIMITED, Limits, Record
from fg_calib.monitoring import hypotheses
from fg_calib.monitoring.hypotheses import HypothesisTest
from fg_calib.monitoring.new_data import Linear, Rows, linearise_new_data, place_new_data
from fg_calib.monitoring.prior_information import Calibrated
from fg_calib.statistics import FACTOR, LEAST, HeldOut, upper_probability
from fg_calib.statistics.residual_table import pooled

Verdict = Literal["pass", "fail", "not_evaluated"]

LEAST_DOF = 3
"""Degrees of freedom from which rows are judged."""

MOST_GROSS = 0.1
"""Part of the configurations that gross errors may be in: more are none."""

POWER = 0.9
"""Probability with which a detectable joint offset change is found."""

ALSO_SHOWN = 3
"""Changes that the rows exclude and that are shown with the likely ones."""


class Explanation(Record):
    """A change that explains new rows.

    Attributes:
        parameters: Changed parameters.
        kind: `zero`, `parameter`, `tool`, `frame`, `zeros`, or `row` of gross errors.
        change: Size, [m] and [rad]; empty of gross errors.
        sigma: 1 sigma of that; None where it is not determined.
        units: `m` or `rad` of each.
        chi2_drop: Drop of chi-square with it.
        p_value: Probability that chance explains as much, all hypotheses counted.
        likely: Whether it explains most, or the rows do not distinguish it from the change that does.
        told_apart_from: Changes that the rows would exclude, were it this one.
        not_told_apart_from: Other changes that explain the rows as well.
        same: Parameters whose change makes the same of the arm everywhere, but for less than the noise of one row: they
            need not be distinguished.
    """

    parameters: tuple[str, ...]
    kind: str
    change: tuple[float, ...]
    sigma: tuple[float | None, ...]
    units: tuple[str, ...]
    chi2_drop: float
    p_value: float
    likely: bool
    told_apart_from: tuple[tuple[str, ...], ...] = ()
    not_told_apart_from: tuple[tuple[str, ...], ...] = ()
    same: tuple[str, ...] = ()


class Check(Record):
    """Check of a calibration by new rows.

    Attributes:
        verdict: Whether it is still good.
        reasons: Why not, or why that cannot be said.
        cautions: Notes for the reader.
        n: Number of measurements.
        chi2: Of the rows, by their noise and the calibration's uncertainty, after what is free was fitted.
        dof: Its degrees of freedom.
        p_value: Probability of one as large, were arm and noise as specified.
        rms: RMS of residuals by kind, frame fitted, the arm as calibrated, [m] and [rad].
        noise: RMS of the noise specified for them.
        limits: Limits of errors by kind, as far as set.
        explanations: Possible changes, the best first; none where nothing is certain.
        gross_rows: Configurations whose rows are gross errors, left out of all that is said here.
        deploy: Whether to go on: with the calibration as it is, or with the change that explains the rows.
        detectable: Joint offset changes that these rows would show in 9 of 10 cases, [rad] (prismatic: [m]);
            None where they show none at all.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    cautions: tuple[str, ...]
    n: int
    chi2: float
    dof: int
    p_value: float | None
    rms: dict[str, float]
    noise: dict[str, float]
    limits: dict[str, float]
    explanations: tuple[Explanation, ...]
    gross_rows: tuple[str, ...]
    deploy: bool
    detectable: dict[str, float | None]


def check_rows(calibrated: Calibrated, rows: Rows, limits: Limits) -> Check:
    """Compare new rows with a calibrated arm.

    Args:
        calibrated: The arm.
        rows: The rows; test rows count as the others do.
        limits: How large errors may be.

    Raises:
        ProblemError: The rows lack what their model needs.
    """
    rows = rows.all_train()
    kept, gross = rows, list[str]()
    while True:
        at = linearise_new_data(place_new_data(calibrated, kept, calibrated.values))
        data, few = at.placed.problem.data, _too_few(at)
        found = [] if few else hypotheses.fit_changes(at)
        likely = hypotheses.likely_changes(found)
        most_gross = max(1, int(MOST_GROSS * (at.placed.problem.n_configurations + len(gross))))
        if len(likely) != 1 or likely[0].hypothesis.kind != "row" or len(gross) >= most_gross:
            break
        gross += likely[0].hypothesis.names
        kept = rows.without([np.isin(np.array(data.names)[places], gross) for places in data.places])
    if any(f.hypothesis.kind != "row" for f in likely) and not gross:
        found = hypotheses.refine_best(calibrated, rows, found)
        likely = hypotheses.likely_changes(found) or likely
    return _judge(at, limits, found, likely, gross, few)


def _too_few(rows: Linear) -> str:
    """Why the rows cannot be judged; empty if they can."""
    if rows.dof >= LEAST_DOF:
        return ""
    fitted = f"{rows.n_free} go to frame, station and whatever else does not stay with the arm"
    used = f"{rows.placed.problem.n_independent} figures, of which {fitted}"
    return f"{used}: {rows.dof} left to judge by, at least {LEAST_DOF} needed"


def _judge(
    at: Linear, limits: Limits, found: list[HypothesisTest], likely: list[HypothesisTest], gross: list[str], few: str
) -> Check:
    calibrated = at.placed.calibrated
    held = at.placed.errors()
    rms = {kind: pooled([one for one in held if one.kind == kind]) for kind in dict.fromkeys(one.kind for one in held)}
    noise = {kind: one.noise for kind, one in rms.items()}
    merged = hypotheses.merge_alike(at, likely, noise)
    alike = {f.hypothesis.names for f in likely} - {f.hypothesis.names for f in merged}
    likely, found = merged, [f for f in found if f.hypothesis.names not in alike]
    limit = {kind: value for kind in LIMITED if (value := getattr(limits, kind)) is not None}
    of_noise = calibrated.noise_degrees or np.inf  # noise that was estimated may itself be off
    p_value = upper_probability(at.chi2 / at.dof, at.dof, of_noise) if at.dof > 0 else None
    reasons, cautions = ([few], []) if few else _reasons(at, p_value, likely, rms, limit)
    if gross:
        left_out = "left out here; delete them before update, measure again"
        cautions.insert(0, f"gross errors at {', '.join(gross)}: {left_out}")
    unjudged = [kind for kind in limit if kind not in rms or rms[kind].n < LEAST]
    verdict: Verdict = "not_evaluated" if few else "fail" if reasons else "pass"
    if verdict == "pass" and unjudged:
        verdict, reasons = "not_evaluated", [f"a limit of {unjudged[0]}, and fewer than {LEAST} rows to judge it by"]
    explained = bool(likely) and likely[0].explains
    alone = len(likely) == 1 and likely[0].hypothesis.kind != "row"
    n = sum(len(s.train) for s in at.placed.problem.data.blocks)
    tested = (verdict, tuple(reasons), tuple(cautions), n, at.chi2, at.dof, p_value)
    sizes = ({kind: one.after for kind, one in rms.items()}, noise, limit)
    deploy = verdict == "pass" or (verdict == "fail" and alone and explained)
    explanations, detectable = _explanations(found, likely), _detectable(calibrated, found)
    made = Check(*tested, *sizes, explanations, tuple(gross), deploy, detectable)
    return made if explained or verdict != "fail" else _unless_misread(made, at)


def _unless_misread(found: Check, at: Linear) -> Check:
    """A check that failed, but by a usual mistake in how the table is read, such as its units: then it says nothing."""
    solution = at.placed.solution
    problem = replace(solution.problem, robot=at.placed.calibrated.arm)  # with what a set-up check may fit
    checks = check_tables(problem, solution.parameters, doubtful=True, with_landmarks=True)
    named = tuple(str(one) for one in reporting(checks) if one.explanations)
    if not named:
        return found
    nothing = replace(found, cautions=(), explanations=(), gross_rows=())
    return replace(nothing, verdict="not_evaluated", reasons=named, deploy=False)


def _detectable(calibrated: Calibrated, found: Sequence[HypothesisTest]) -> dict[str, float | None]:
    """The offset change of each joint that is found with a probability of `POWER`."""
    least = np.sqrt(hypotheses.quantile(hypotheses.CERTAIN / max(len(found), 1), 1)) + special.ndtri(POWER)
    sizes = {f.hypothesis.names[0]: float(least * f.sigma[0]) for f in found if f.hypothesis.kind == "zero"}
    return {n: sizes[n] if np.isfinite(sizes.get(n, np.nan)) else None for n in calibrated.robot.zero_names}


def _reasons(
    at: Linear,
    p_value: float | None,
    likely: Sequence[HypothesisTest],
    rms: dict[str, HeldOut],
    limits: dict[str, float],
) -> tuple[list[str], list[str]]:
    """Why the calibration is not good any more, and cautions."""
    reasons, cautions = [], []
    for kind, one in rms.items():
        limit = limits.get(kind, np.inf)
        if one.n < LEAST or one.after <= limit:
            continue
        if one.after**2 - one.noise**2 <= limit**2:
            cautions.append(f"{kind}: the specified noise hides whether the arm is within the limit")
        reasons.append(f"{kind}: RMS error {_shown(one.after, kind)}, limit {_shown(limit, kind)}")
    change = next((f for f in likely if f.hypothesis.kind != "row"), None)
    excess = float(np.sqrt(at.chi2 / at.dof))
    if change is not None:
        turn, shift = hypotheses.rms_motion(hypotheses.motion(at, change)).tolist()
        sizes = {"orientation": turn, "position": shift}
        far = [kind for kind, size in sizes.items() if size > limits.get(kind, np.inf)]
        where = f"; over the whole workspace {_shown(sizes[far[0]], far[0])} RMS" if far else ""
        if far or not limits or change.hypothesis.kind == "frame":
            reasons.append(f"the rows show a change: chi-square falls by {change.drop:.4g} with it{where}")
        else:
            cautions.append("the rows show a change, within the limits everywhere")
    elif p_value is not None and p_value < hypotheses.CERTAIN:
        what = f"residuals are {excess:.3g} times as large as noise and calibration allow"
        if excess**2 > FACTOR and not limits:
            reasons.append(f"{what}: their noise is specified too small, or a change that they are too few to name")
        else:
            cautions.append(f"{what}, like noise")
    return reasons, cautions


def _shown(value: float, kind: str) -> str:
    return f"{value * 1e3:.4g} mm" if LIMITED[kind] == "m" else f"{np.rad2deg(value):.4g} deg"


def _explanations(found: Sequence[HypothesisTest], likely: Sequence[HypothesisTest]) -> tuple[Explanation, ...]:
    """The likely changes, and the best of those that they exclude."""
    if not likely:
        return ()
    names, scale = {f.hypothesis.names for f in likely}, likely[0].scale
    others = [f for f in sorted(found, key=lambda f: f.left) if f.hypothesis.names not in names]
    shown = [*likely, *[f for f in others if not any(hypotheses.is_part_of(g, f) for g in likely)][:ALSO_SHOWN]]

    def explanation(f: HypothesisTest) -> Explanation:
        excluded = {g.hypothesis.names: hypotheses.excludes(f, g, scale) for g in shown if g is not f}
        h, sized = f.hypothesis, f.hypothesis.kind != "row"
        change = tuple(map(float, f.change)) if sized else ()
        sigma = tuple(float(s) if np.isfinite(s) else None for s in f.sigma) if sized else ()
        tests = (f.drop, f.p_value, h.names in names)
        told = tuple(other for other, out in excluded.items() if out)
        not_told = tuple(other for other, out in excluded.items() if not out and other in names)
        return Explanation(h.names, h.kind, change, sigma, h.units if sized else (), *tests, told, not_told, h.same)

    return tuple(map(explanation, shown))
