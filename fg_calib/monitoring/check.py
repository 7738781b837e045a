"""Whether a calibration is still good: new rows against the calibrated arm, and what changed if it is not.

The rows say no more than noise and the calibration's own uncertainty make of them, or they do not: by chi-square, and
by what single changes explain of it (see `hypotheses`), which sees a slip of one joint long before chi-square of many
rows does. Where limits are set they decide: an arm within them is good although its rows show a change, as long as that
change stays within them everywhere.

Rows of one configuration that are gross errors are named and left out of the judgement; noise that is stated too small
is no change of the arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import special

from fg_calib.diagnostics.setup_check import check_tables
from fg_calib.monitoring.discriminating_design import Advice, separating
from fg_calib.monitoring.hypotheses import (
    CERTAIN,
    WRONG,
    HypothesisTest,
    best_refined,
    check_hypotheses,
    effect_elsewhere,
    excludes,
    explains,
    likely_changes,
    merged,
    quantile,
    within,
    zero_names,
)
from fg_calib.monitoring.new_data import Calibrated, Linear, Rows, linear, placed
from fg_calib.options import LIMITED, Limits
from fg_calib.statistics.acceptance import LEAST
from fg_calib.statistics.goodness_of_fit import FACTOR
from fg_calib.statistics.residual_table import residual_table

Verdict = Literal["pass", "fail", "not_evaluated"]

LEAST_DOF = 3
"""Degrees of freedom from which rows are judged."""

MOST_GROSS = 0.1
"""Part of the configurations that gross errors may be in: more are none."""

POWER = 0.9
"""Probability with which a slip is to be found that is called detectable."""

ALSO_SHOWN = 3
"""Suspects that are distinguished from the best, and shown beside it."""


@dataclass(frozen=True)
class Explanation:
    """A change that explains new rows.

    Attributes:
        parameters: What changed.
        kind: `zero`, `parameter`, `tool`, `frame`, `zeros`, or `row` of gross errors.
        change: By how much, [m] and [rad]; empty of gross errors.
        sigma: 1 sigma of that; None where it is not determined.
        units: `m` or `rad` of each.
        chi2_drop: By how much chi-square falls with it.
        p_value: Probability that chance explains as much, all that was tried counted.
        likely: Whether the rows do not tell it from the change that explains most, or it is that itself.
        told_apart_from: What the rows say it is rather not, were it this.
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


@dataclass(frozen=True)
class Check:
    """What new rows say of a calibration.

    Attributes:
        verdict: Whether it is still good.
        reasons: Why not, or why that cannot be said.
        cautions: What its reader should know all the same.
        n: Number of measurements.
        chi2: Of the rows, by their noise and the calibration's uncertainty, after what is free was fitted.
        dof: Its degrees of freedom.
        p_value: Probability of one as large, were arm and noise as stated.
        rms: RMS of residuals by kind, frame fitted, the arm as calibrated, [m] and [rad].
        noise: RMS noise stated of the same.
        limits: What they may be, as far as a limit was set.
        explanations: What changed, the best first; none where nothing is certain.
        gross_rows: Configurations whose rows are gross errors, left out of all that is said here.
        deploy: Whether to go on: with the calibration as it is, or with the change that explains the rows.
        detectable: Of each joint's zero the slip that these rows would show in 9 of 10 cases, [rad] (prismatic: [m]);
            None where they show none at all.
        advice: What to measure to distinguish what these rows do not; None where there is nothing to.
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
    advice: Advice | None = None

    @property
    def passed(self) -> bool:
        """Whether the calibration is still good."""
        return self.verdict == "pass"


def check_rows(calibrated: Calibrated, rows: Rows, limits: Limits) -> Check:
    """Compare new rows with a calibrated arm.

    Args:
        calibrated: The arm.
        rows: The rows; test rows count as the others do.
        limits: How large errors may be.

    Raises:
        ProblemError: The rows lack what their model needs.
    """
    rows = replace(rows, tables=tuple(table.all_train() for table in rows.tables))
    whole = linear(calibrated, placed(calibrated, rows, calibrated.values))
    few = _too_few(whole)
    gross: list[str] = []
    found: list[HypothesisTest] = []
    at = whole
    if not few:
        found = check_hypotheses(calibrated, at)
        best = likely_changes(found, at)
        while len(best) == 1 and best[0].hypothesis.kind == "row" and len(gross) < _most_gross(whole):
            gross += best[0].hypothesis.names
            at = at.without(best[0].hypothesis.columns)
            found = [f for f in check_hypotheses(calibrated, at) if f.hypothesis.names[0] not in gross]
            best = likely_changes(found, at)
    return _judged(calibrated, rows, limits, at, found, gross, few)


def _most_gross(rows: Linear) -> int:
    return max(1, int(MOST_GROSS * rows.placed.problem.n_configurations))


def _too_few(rows: Linear) -> str:
    """Why the rows cannot be judged; empty if they can."""
    n = rows.placed.problem.n_independent
    fitted = "frame, station and whatever else does not stay with the arm"
    if rows.dof < LEAST_DOF:
        used = f"{n} figures, of which {rows.n_free} go to {fitted}"
        return f"{used}: {rows.dof} left to judge by, at least {LEAST_DOF} needed"
    return ""


def _judged(
    calibrated: Calibrated,
    rows: Rows,
    limits: Limits,
    at: Linear,
    found: list[HypothesisTest],
    gross: list[str],
    few: str,
) -> Check:
    p_value = _p_value(calibrated, at) if at.dof > 0 else None
    likely = likely_changes(found, at)
    if any(f.hypothesis.kind != "row" for f in likely):
        found = best_refined(calibrated, rows, at, found, likely) if not gross else found
        likely = likely_changes(found, at) or likely
    rms, noise, counts = _rms(calibrated, rows, at, gross)
    alike = {f.hypothesis.names for f in likely}
    likely = merged(calibrated, likely, noise)
    alike -= {f.hypothesis.names for f in likely}
    stated = {kind: limit for kind in LIMITED if (limit := getattr(limits, kind)) is not None}
    elsewhere = effect_elsewhere(calibrated, likely[0]) if likely else None
    reasons, cautions = _reasons(at, p_value, found, likely, rms, noise, counts, stated, elsewhere, few)
    if gross:
        names = ", ".join(gross)
        cautions.insert(0, f"gross errors at {names}: left out here; measure again")
    missing = [kind for kind in stated if kind not in rms]
    verdict: Verdict = "not_evaluated" if few else "fail" if reasons else "pass"
    if verdict == "pass" and (missing or any(counts[kind] < LEAST for kind in stated if kind in counts)):
        what = missing or [kind for kind in stated if counts[kind] < LEAST]
        verdict, reasons = "not_evaluated", [f"a limit of {what[0]}, and fewer than {LEAST} rows to judge it by"]
    alone = len(likely) == 1 and likely[0].hypothesis.kind != "row"
    explained = bool(likely) and explains(likely[0], at)
    advice = separating(calibrated, at, likely, WRONG / max(len(found), 1)) if len(likely) > 1 else None
    made = Check(
        verdict=verdict,
        reasons=(few,) if few else tuple(reasons),
        cautions=tuple(cautions),
        n=sum(len(s.train) for s in at.placed.problem.data.series),
        chi2=at.chi2,
        dof=at.dof,
        p_value=p_value,
        rms=rms,
        noise=noise,
        limits=stated,
        explanations=_explanations([f for f in found if f.hypothesis.names not in alike], likely, at),
        gross_rows=tuple(gross),
        deploy=verdict == "pass" or (verdict == "fail" and alone and explained),
        detectable=_detectable(calibrated, at, found),
        advice=advice,
    )
    return made if explained or verdict != "fail" else _unless_misread(made, at)


def _p_value(calibrated: Calibrated, at: Linear) -> float:
    """Probability of chi-square as large; of noise that was estimated by F, as that may itself be off."""
    if calibrated.noise_degrees is None:
        return float(special.chdtrc(at.dof, at.chi2))
    return float(special.fdtrc(at.dof, calibrated.noise_degrees, at.chi2 / at.dof))


def _unless_misread(found: Check, at: Linear) -> Check:
    """A check that failed, but by a usual mistake in how the table is read, such as its units: then it says nothing."""
    solution = at.placed.solution
    _, far = check_tables(solution.problem, solution.parameters, doubtful=True, with_landmarks=True)
    named = tuple(str(one) for one in far if one.explanations)
    if not named:
        return found
    nothing = replace(found, cautions=(), explanations=(), gross_rows=(), advice=None)
    return replace(nothing, verdict="not_evaluated", reasons=named, deploy=False)


def _detectable(calibrated: Calibrated, at: Linear, found: Sequence[HypothesisTest]) -> dict[str, float | None]:
    """The slip of each joint's zero that is found with a probability of `POWER`."""
    sigma = {name: float(f.sigma[0]) for f in found if f.k == 1 for name in (*f.hypothesis.names, *f.hypothesis.same)}
    least = np.sqrt(quantile(CERTAIN / max(len(found), 1), 1)) + special.ndtri(POWER)
    sizes = {name: least * sigma.get(name, np.nan) for name in zero_names(calibrated.robot)}
    return {name: float(size) if np.isfinite(size) else None for name, size in sizes.items()}


def _rms(
    calibrated: Calibrated, rows: Rows, at: Linear, gross: Sequence[str]
) -> tuple[dict[str, float], dict[str, float], dict[str, int]]:
    """RMS of residuals and of noise by kind, and the number of measurements, by what is no gross error.

    Frames are fitted without gross errors, too, and the arm is as calibrated.
    """
    solution, data = at.placed.solution, at.placed.problem.data
    if gross:
        wrong = [data.names.index(name) for name in gross]
        tables = (t.tested_on(np.isin(k, wrong)) for t, k in zip(rows.tables, data.places, strict=True))
        solution = placed(calibrated, replace(rows, tables=tuple(tables)), calibrated.values).solution
    table = residual_table(solution)
    counted, first = table.used & ~table.test, table.is_first_of_family()
    rms, noise, counts = {}, {}, {}
    for k, family in enumerate(table.families):
        mine = counted & (table.family == k)
        n = int(np.sum(mine & first))
        if n:
            rms[family], noise[family] = (float(np.sqrt(np.sum(v[mine] ** 2) / n)) for v in (table.after, table.sigma))
            counts[family] = n
    return rms, noise, counts


def _reasons(
    at: Linear,
    p_value: float | None,
    found: Sequence[HypothesisTest],
    likely: Sequence[HypothesisTest],
    rms: dict[str, float],
    noise: dict[str, float],
    counts: dict[str, int],
    limits: dict[str, float],
    elsewhere: dict[str, float] | None,
    few: str,
) -> tuple[list[str], list[str]]:
    """Why the calibration is not good any more, and cautions."""
    reasons, cautions = [], []
    if few or p_value is None:
        return [], []
    for kind, limit in limits.items():
        if kind not in rms or counts[kind] < LEAST or rms[kind] <= limit:
            continue
        if rms[kind] ** 2 - noise[kind] ** 2 <= limit**2:
            cautions.append(f"{kind}: the noise stated hides whether the arm is within the limit")
        reasons.append(f"{kind}: RMS error {_shown(rms[kind], LIMITED[kind])}, limit {_shown(limit, LIMITED[kind])}")
    changed = [f for f in likely if f.hypothesis.kind != "row"]
    far = [kind for kind, size in (elsewhere or {}).items() if kind in limits and size > limits[kind]]
    reduced = at.chi2 / at.dof
    if changed and (not limits or far or elsewhere is None):
        what = (
            f"; at other configurations up to {_shown((elsewhere or {})[far[0]], LIMITED[far[0]])} RMS" if far else ""
        )
        reasons.append(f"the rows show a change: chi-square falls by {changed[0].drop:.4g} with it{what}")
    elif changed:
        cautions.append("the rows show a change, within the limits everywhere")
    elif p_value < CERTAIN and reduced > FACTOR and not limits:
        what = f"residuals are {np.sqrt(reduced):.2g} times as large as noise and calibration allow"
        reasons.append(f"{what}{_without_change(found, at)}")
    elif p_value < CERTAIN:
        cautions.append(
            f"residuals are {np.sqrt(reduced):.3g} times as large as noise and calibration allow, like noise"
        )
    return reasons, cautions


def _without_change(found: Sequence[HypothesisTest], at: Linear) -> str:
    """What residuals mean that are too large where no change is certain whatever the noise."""
    of_arm = [f for f in found if f.hypothesis.kind != "row"]
    best = min(of_arm, key=lambda f: (not explains(f, at), f.k, f.left), default=None)
    if best is None or best.p_value >= CERTAIN or not explains(best, at):
        return ", and no change of the arm explains that: is the noise of these rows stated too small?"
    change = " and ".join(best.hypothesis.names)
    return f": their noise is stated too small, or a change such as of {change}; they are too few to say which"


def _shown(value: float, unit: str) -> str:
    return f"{value * 1e3:.4g} mm" if unit == "m" else f"{np.rad2deg(value):.4g} deg"


def _explanations(
    found: Sequence[HypothesisTest], likely: Sequence[HypothesisTest], at: Linear
) -> tuple[Explanation, ...]:
    if not likely:
        return ()
    names = {f.hypothesis.names for f in likely}
    others = sorted((f for f in found if f.hypothesis.names not in names), key=lambda f: f.left)
    others = [f for f in others if not any(within(g, f) for g in likely)][:ALSO_SHOWN]
    scale = max(1.0, likely[0].left / max(at.dof - likely[0].k, 1))
    shown = [*likely, *others]

    def explanation(f: HypothesisTest) -> Explanation:
        apart = tuple(g.hypothesis.names for g in shown if g is not f and excludes(f, g, scale, len(found)))
        rivals = tuple(g.hypothesis.names for g in likely if g is not f and not excludes(f, g, scale, len(found)))
        sized = f.hypothesis.kind != "row"
        return Explanation(
            parameters=f.hypothesis.names,
            kind=f.hypothesis.kind,
            change=tuple(map(float, f.change)) if sized else (),
            sigma=tuple(float(s) if np.isfinite(s) else None for s in f.sigma) if sized else (),
            units=f.hypothesis.units if sized else (),
            chi2_drop=f.drop,
            p_value=f.p_value,
            likely=f.hypothesis.names in names,
            told_apart_from=apart,
            not_told_apart_from=rivals,
            same=f.hypothesis.same,
        )

    return tuple(map(explanation, shown))
