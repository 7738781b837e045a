"""The calibration report for people: verdict, statistics, residuals, parameters; lengths in mm, angles in degrees.

It is made of a typed result and its tables, so that a loaded calibration prints like a new one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table

from fg_calib.assessment import Assessment
from fg_calib.diagnostics import chi2_in_words, predicted_in_words, probability
from fg_calib.graph import Solution
from fg_calib.inputs import Floats
from fg_calib.io import Result, key_of
from fg_calib.measurements import LANDMARKS
from fg_calib.options import LIMITED
from fg_calib.prediction import ExpectedError
from fg_calib.report.tables import (
    SHOWN,
    WEAK,
    WIDTH,
    Section,
    figure,
    in_order,
    in_words,
    indented,
    line,
    lost_directions,
    plain_text,
    section,
    shortened,
    table_of,
    weak_directions,
)
from fg_calib.robot import Robot
from fg_calib.statistics import (
    OUTLIER_WEIGHT,
    PREDICTION_VERDICTS,
    VERDICTS,
    Judgement,
    KindFit,
    LandmarkEstimate,
    ParameterEstimate,
)

if TYPE_CHECKING:
    import polars as pl


UNMOVED = 1e-9
"""How far an estimate that no step meant to move may be from its start, [m] and [rad]."""


class Calibrated(Protocol):
    """What a report is made of: see `calibration.Calibration`."""

    @property
    def result(self) -> Result:
        """The typed result."""

    @property
    def robot(self) -> Robot:
        """The calibrated robot."""

    @property
    def residuals(self) -> pl.DataFrame | None:
        """Every scalar residual."""

    @property
    def configurations(self) -> pl.DataFrame | None:
        """Every measured configuration."""


def format_result(found: Calibrated, width: int = WIDTH) -> str:
    """The report as plain text."""
    return plain_text(build_report(found), width)


def build_report(found: Calibrated) -> RenderableType:
    """The report, to be printed by rich."""
    return Group(*_verdict(found.result), *build_sections(found))


def build_sections(found: Calibrated, most: int = 5) -> list[Section]:
    """The sections of the report, for the terminal and the page.

    Args:
        found: The calibration.
        most: Suspicious rows that are listed, and weak directions.
    """
    result = found.result
    joint_noise = ", with joint noise" if np.any(result.sigma_joint > 0.0) else ""
    scales = "Prior sigmas estimated (ratio to the specified ones, with its 95 % interval)"
    notes = [*(text for text in result.cautions if result.findings or text not in result.reservations), *result.notes]
    return [
        *section("Fit statistics", _statistics(result)),
        *section(f"Goodness of fit (1 sigma of a row{joint_noise})", *_goodness(result, found.robot)),
        *_prediction(result),
        *_cross_validation(result),
        *expected_tool_error(result.expected_error),
        *section(RESIDUALS, _residuals(result)),
        *(section(PARAMETERS, parameter_table(result)) if result.estimated or not result.evaluated_only else []),
        *section(scales, _tolerances(result)),
        *section("Combinations that the kept parameters stand for", _combinations(result)),
        *_suspicious_rows(found.residuals, result, most),
        *_suspicious_configurations(result),
        *_joint_values(found),
        *_frames(result),
        *_landmarks(result.groups),
        *section("Not identifiable from these data", lost_directions(result.observability.lost)),
        *section(f"Weakly determined ({WEAK})", weak_directions(result.observability.observability, most)),
        *section(NOTES, *indented(notes)),
    ]


RESIDUALS, PARAMETERS, NOTES = "Residuals (RMS)", "Parameters", "Notes"
"""Titles of sections to which the page adds charts, or which it shows first."""


def verdict_word(result: Result) -> str:
    """`GOOD`, with its warnings if there are any, or `DOUBTFUL`."""
    return "DOUBTFUL" if result.findings else "GOOD, with warnings" if result.reservations else "GOOD"


def judged(judgements: Iterable[Judgement]) -> list[str]:
    """A line a limit: `PASS: position 0.31 mm (RMS of 30 held-out measurements), limit 0.5 mm`."""
    lines = []
    for one in judgements:
        unit = LIMITED[one.kind]
        error = "" if one.error is None else f" {in_words(one.error, unit)} (RMS of {one.n} held-out measurements)"
        reason = f": {one.reason}" if one.reason else ""
        of = f" of {one.table}" if one.table else ""
        lines.append(f"{one.verdict.upper()}: {one.kind}{of}{error}, limit {in_words(one.limit, unit)}{reason}")
    return lines


def _verdict(result: Result) -> Iterator[RenderableType]:
    several = len(result.tables) > 1
    tables = "; ".join(f"{label} ({words})" if several else words for label, words in result.tables)
    joints = ", joint positions estimated" if result.joint_values is not None else ""
    loss = "" if result.loss == "none" else f", loss {result.loss}"
    yield line(f"{result.robot}: {tables}{joints}{loss}")
    if result.evaluated_only:
        yield line("EVALUATED ONLY: all rows are test rows, nothing of the arm was calibrated")
    yield from (line(f"DOUBTFUL: {finding}", "bold red") for finding in result.findings)
    if not result.findings:
        yield line(f"{verdict_word(result)}: {result.solver.message}", "bold green")
        yield from indented(result.reservations)
    if result.acceptance is not None:
        colour = {"pass": "bold green", "fail": "bold red"}.get(result.acceptance.verdict, "bold yellow")
        yield from (line(text, colour) for text in judged(result.acceptance.judgements))
    if result.evaluated_only and result.chi2_p_value is not None:
        yield line(f"test rows: {chi2_in_words(result.chi2, result.chi2_expected, result.chi2_p_value)}")
    elif result.test is not None and result.test.n:
        yield line(predicted_in_words(result.test))


def _statistics(result: Result) -> Table:
    low, high = result.chi2_bounds
    p = "" if result.chi2_p_value is None else f", p-value {probability(result.chi2_p_value)}"
    reduced = "unknown" if result.reduced_chi2 is None else f"{result.reduced_chi2:.4g}"
    good = f" (good from {low:.3g} to {high:.3g})" if result.reduced_chi2 is not None else ""
    solver = result.solver
    rows = [
        ("configurations", f"{result.n_configurations}"),
        *([("pairs", f"{result.n_pairs}")] if result.n_pairs else []),
        ("residuals", f"{result.n_residuals}, and {result.n_priors} priors"),
        ("estimated", f"{result.n_unknowns} unknowns, {result.n_determined} directions determined"),
        ("chi-square", f"{result.chi2:.6g} with {result.dof} degrees of freedom"),
        ("reduced chi-square", f"{reduced}{good}{p}"),
        (
            "solver",
            f"{solver.iterations} iterations, {solver.seconds:.2f} s, cost {solver.initial_cost:.6g} ->"
            f" {solver.cost:.6g}",
        ),
    ]
    return table_of(("", ""), rows, left="ll")


def _named(result: Result, fit: KindFit) -> str:
    return fit.kind if len(result.tables) == 1 else f"{fit.kind} of {result.tables[fit.table][0]}"


def _goodness(result: Result, robot: Robot) -> list[RenderableType]:
    """Specified and estimated noise by kind, and what their ratio means."""
    factors, fits, rows = result.noise_factors, tuple(result.goodness.values()), list[tuple[str, ...]]()
    for fit in fits:
        specified, ratio, words = fit.stated_sigma_rms, fit.seen_over_stated, VERDICTS[fit.verdict]
        if factors is not None:
            specified, ratio, words = fit.own_sigma_rms, fit.own_factor, _estimated_noise(result, key_of(fit, fits))
        known = np.isfinite(ratio)
        rows.append(
            (
                _named(result, fit),
                SHOWN[fit.unit][1],
                figure(specified, fit.unit),
                figure(ratio * specified, fit.unit, none="-"),
                f"{ratio:.3f}" if known else "-",
                "-" if fit.p_value is None else probability(fit.p_value),
                words,
            )
        )
    rows += _joint_noise(result, robot)
    estimated = "observed" if factors is None else "estimated"
    headings = ("", "", "specified", estimated, "ratio", "p-value", "")
    table = table_of(headings, rows, left="llrrrrl", wrap=True)
    suspicious = bool(result.suspect_configurations) or any(fit.n_beyond for fit in fits)
    level = f"no row (|studentised residual| above {result.suspect_level:.2f}) and no configuration is suspicious"
    return [table, *indented([] if suspicious or not np.isfinite(result.suspect_level) else [level])]


def _joint_noise(result: Result, robot: Robot) -> Iterator[tuple[str, ...]]:
    """A row for the noise of joint readings where noise was estimated; revolute and prismatic joints apart."""
    ratio = (result.noise_factors or {}).get("joint")
    for unit in dict.fromkeys(joint.unit for joint in robot.joints) if ratio is not None else ():
        sigma = np.array([s for s, joint in zip(result.sigma_joint, robot.joints, strict=True) if joint.unit == unit])
        if ratio is not None and np.any(sigma > 0.0):
            rms = float(np.sqrt(np.mean(sigma[sigma > 0.0] ** 2)))
            values = figure(rms / ratio, unit), figure(rms, unit), f"{ratio:.3f}"
            yield ("joint readings", SHOWN[unit][1], *values, "-", _estimated_noise(result, "joint"))


def _estimated_noise(result: Result, key: str) -> str:
    if key in result.noise_kept:
        return "cannot be estimated from these rows: as specified"
    return "estimated" if result.solver.converged else "not settled: the estimate has not converged"


def _prediction(result: Result) -> list[Section]:
    """How well the test rows are predicted, by kind."""
    fit = result.test
    if fit is None:
        return []
    rows = []
    for kind in fit.kinds:
        ratio = kind.seen_over_stated / kind.factor
        cells = f"{kind.n}", f"{kind.chi2:.4g}", f"{kind.expected:.4g}", "-" if np.isnan(ratio) else f"{ratio:.3f}"
        p = "-" if kind.p_value is None else probability(kind.p_value)
        rows.append((_named(result, kind), *cells, p, PREDICTION_VERDICTS[kind.verdict]))
    headings = ("", "rows", "chi-square", "expected", "ratio", "p-value", "")
    notes = []
    if fit.outliers.test:
        notes.append(f"{fit.outliers.test} of {fit.outliers.n_test} measurements do not count: outliers by the loss")
    if fit.n_unknown:
        notes.append(f"{fit.n_unknown} rows are not judged: they depend on what is not determined")
    table = table_of(headings, rows, left="lrrrrrl", wrap=True)
    return section("Prediction of the test rows", table, *indented(notes))


def _cross_validation(result: Result) -> list[Section]:
    """How well configurations are predicted by calibrations without them, and how parameters spread."""
    found = result.folds
    if found is None:
        return []
    rows = []
    for kind in in_order(found.kinds):
        held, unit = found.kinds[kind], result.unit_of(kind)
        values = (f"{v * SHOWN[unit][0]:.4f}" for v in (held.before, held.after, held.noise))
        rows.append((kind, SHOWN[unit][1], f"{held.n}", *values))
    table = table_of(("", "", "held out", "before", "after", "specified noise"), rows, left="ll")
    title = f"Cross-validation ({found.n} folds of configurations, each predicted without it; RMS)"
    lines, (ratio, wide) = [], found.beyond({p.name: p.sigma for p in result.estimated})
    if ratio:
        median = f"{np.median(list(ratio.values())):.2f}" + " (pairs: expect 1.4 to 1.7)" * found.of_pairs
        lines.append(f"spread of a parameter between folds over its sigma: median {median}, below 1 where priors act")
    if wide:
        named = shortened([f"{name} {ratio[name]:.1f}" for name in wide], 5)
        lines.append(f"spread significantly larger than sigma: {named}; the model lacks an effect, or rows are wrong")
    if found.not_converged:
        lines.append(f"{found.not_converged} of {found.n} calibrations did not converge")
    return section(title, table, *indented(lines))


def expected_tool_error(expected: ExpectedError | None) -> list[Section]:
    """The section on the expected error of the tool, by the covariance; none for an evaluation."""
    if expected is None:
        return []
    both = (expected.base, expected.fitted)
    rows = [
        (kind, SHOWN[unit][1], *(figure(getattr(rms, kind), unit) for rms in both))
        for kind, unit in (("position", "m"), ("orientation", "rad"))
    ]
    table = table_of(("", "", "in the base frame", "after the best rigid fit"), rows, left="ll")
    which = "" if expected.n == expected.of else f" of {expected.of}"
    return section(f"Expected tool error (RMS at {expected.n}{which} {expected.at} configurations)", table)


def _residuals(result: Result) -> Table:
    """By kind; by table where several tables have it."""
    names, rows = list(result.residual_rms["train"]), []
    for kind in in_order(name for name in names if ", table" not in name):
        for name in [name for name in names if name.startswith(f"{kind}, table ")] or [kind]:
            both = [result.residual_rms[split].get(name) for split in ("train", "test")]
            if any(both):
                factor, unit, _ = SHOWN[result.unit_of(kind)]
                values = (getattr(rms, when, None) for rms in both for when in ("before", "after"))
                rows.append((name, unit, *("-" if v is None else f"{v * factor:.4f}" for v in values)))
    return table_of(("", "", "train before", "after", "test before", "after"), rows, left="ll")


def parameter_table(result: Result) -> Table:
    """Every parameter; base and tool fixed at zero are left out, and all fixed ones of an evaluation."""
    rows: list[tuple[str, ...]] = []
    for p in result.parameters:
        unit = SHOWN[p.unit][1]
        if p.identifiability != "fixed":
            cells = figure(p.estimate, p.unit), figure(p.sigma, p.unit), unit, figure(p.correction, p.unit, "+")
            prior = figure(p.prior_sigma, p.unit, none="")
            rows.append((p.name, *cells, figure(p.nominal, p.unit), prior, p.identifiability))
        elif not result.evaluated_only and (p.nominal != 0.0 or not p.name.startswith(("base.", "tool."))):
            rows.append((p.name, figure(p.estimate, p.unit), "", unit, "", "", "", "fixed"))
    headings = ("", "estimate", "± sigma", "", "correction", "nominal", "prior", "class")
    return table_of(headings, rows, left="lrrlrrrl")


def _tolerances(result: Result) -> Table:
    """Each scale of prior sigmas; these themselves only where those of a scale are all the same."""
    by_name = {p.name: p for p in result.parameters}
    rows: list[tuple[str, ...]] = []
    for one in result.tolerance_scales or ():
        members = [by_name[name] for name in one.parameters]
        first = members[0].prior_sigma
        same = len({(p.unit, f"{p.prior_sigma or 0.0:.6g}") for p in members}) == 1
        factor, unit, _ = SHOWN[members[0].unit]
        sigmas = (f"{first / one.scale * factor:.3g}", f"{first * factor:.3g}", unit) if same and first else ("",) * 3
        ratios = f"{one.scale:.3g}", f"{one.low:.2g}", f"{one.high:.2g}", f"{one.seen:.1f} of {len(one.parameters)}"
        rows.append((one.group, *sigmas, *ratios))
    headings = ("", "specified", "estimated", "", "ratio", "from", "to", "corrections that count")
    return table_of(headings, rows, left="rrrl")


def _combinations(result: Result) -> Table:
    rows = [
        (p.name, figure(p.sigma_of_combination, p.unit), SHOWN[p.unit][1], format_combination(p.stands_for))
        for p in result.parameters
        if p.stands_for
    ]
    return table_of(("", "sigma", "", "of the sum"), rows, left="lrll", wrap=True)


def format_combination(factors: Mapping[str, float]) -> str:
    """`d5 + d3 + d4`, `a7 + 0.5 beta5`: errors of the parameters, each with its factor."""
    sizes = {name: "" if abs(f) == 1.0 else f"{abs(f):.4g} " for name, f in factors.items()}
    terms = (f"{'-' if f < 0.0 else '+'} {sizes[name]}{name}" for name, f in factors.items())
    return " ".join(terms).removeprefix("+ ")


def _suspicious_rows(residuals: pl.DataFrame | None, result: Result, most: int) -> list[Section]:
    """The fitted rows that are larger than noise, then the test rows, the worst first; none if they were not saved."""
    sections: list[Section] = []
    if residuals is None:
        return sections
    for split, word in (("train", ""), ("test", "test ")):
        judged = residuals.filter((residuals["split"] == split) & residuals["excluded"].is_null())
        suspects = judged.filter(judged["suspect"])
        suspects = suspects[suspects["studentised"].abs().fill_nan(0.0).arg_sort(descending=True)]
        lines = [*_poses_in_common(judged, suspects, result), *_labels_in_common(judged, suspects)]
        sections += section(f"Suspicious {word}rows", *indented(lines), _suspects(suspects, most))
    return sections


def _suspects(suspects: pl.DataFrame, most: int) -> Table:
    more = [name for name in ("table", "of") if name in suspects.columns]
    rows: list[tuple[Any, ...]] = []
    for row in suspects.head(most).fill_null("").iter_rows(named=True):
        residual = figure(row["residual"], row["unit"], "+"), SHOWN[row["unit"]][1]
        names = row["a"], row["b"], row["kind"], *(row[name] for name in more)
        rows.append((*names, *residual, f"{row['studentised']:+.1f}", row["flag"]))
    if len(suspects) > most:
        rows.append(("", "", f"and {len(suspects) - most} more", *[""] * (4 + len(more))))
    headings = ("a", "b", "", *more, "residual", "", "in its sigma", "")
    return table_of(headings, rows, left=f"lll{'l' * len(more)}rlrl")


def _poses_in_common(judged: pl.DataFrame, suspects: pl.DataFrame, result: Result, limit: int = 5) -> Iterator[str]:
    """The poses that most of their formed pairs are suspicious of: one wrong pose makes all its pairs suspicious.

    The pose in most suspicious pairs comes first; each next one counts the pairs that those before do not explain. A
    single suspicious pair does not say which of its two poses is wrong.
    """
    if result.pairing in (None, "measured"):
        return
    pairs = [set(frame.select("a", "b").unique().drop_nulls().iter_rows()) for frame in (judged, suspects)]
    in_all, left, lines = Counter(name for pair in pairs[0] for name in pair), pairs[1], []
    n_suspicious = len(left)
    while left:
        of_pose = Counter(name for pair in left for name in pair)
        wrong = [name for name, n in of_pose.items() if n > 1 and 2 * n > in_all[name]]
        if not wrong:
            break
        worst = min(wrong, key=lambda name: (-of_pose[name], name))
        words = f"{of_pose[worst]} of {n_suspicious} suspicious pairs, and in {in_all[worst]} pairs in all"
        lines.append(f"pose {worst} is in {words}")
        left = {pair for pair in left if worst not in pair}
    yield from lines[:limit]
    if len(lines) > limit:
        yield f"and {len(lines) - limit} more such poses"


def _labels_in_common(judged: pl.DataFrame, suspects: pl.DataFrame) -> Iterator[str]:
    """The target, anchor, corner or table that most suspicious rows are of, but less than half as many others."""
    for column in ("of", "table"):
        if column not in suspects.columns or len(suspects.select("a", "b", column).unique()) < 2:
            continue
        counts = suspects[column].drop_nulls().value_counts(sort=True)
        if not len(counts):
            continue
        name, found = counts.row(0)
        n, of_all = len(suspects), int((judged[column] == name).sum())
        if 2 * found > n and 2.0 * of_all / len(judged) * n <= found:
            count = f"{found} of {n}" if found < n else "both" if n == 2 else f"all {n}"
            yield f"{count} suspicious rows are of {name}, as are {of_all} of all {len(judged)} rows"


def _suspicious_configurations(result: Result, most: int = 8) -> list[Section]:
    """The configurations whose residuals together are larger than noise."""
    found = result.suspect_configurations
    rows = [(c.id, f"{c.n}", f"{c.chi2:.4g}", f"{c.expected:.4g}") for c in found[:most]]
    table = table_of(("", "rows", "chi-square", "expected"), rows)
    more = [f"and {shortened([c.id for c in found[most:]], 8)}"] if len(found) > most else []
    return section("Suspicious configurations", table, *indented(more))


def _joint_values(found: Calibrated, most: int = 5) -> list[Section]:
    """Estimated joint positions compared with the readings, joint by joint, and the suspicious readings."""
    values, configurations = found.result.joint_values, found.configurations
    if values is None:
        return []
    units = [found.robot.joints[j].unit for j in values.joints]
    sigma = "specified" if (found.result.noise_factors or {}).get("joint", 1.0) == 1.0 else "estimated"
    rows, wrong = [], []
    for k, (name, unit) in enumerate(zip(values.names, units, strict=True)):
        scatter = "-" if np.isnan(values.scatter[k]) else f"{values.scatter[k]:.3f}"
        rows.append((name, figure(values.sigma[k], unit), SHOWN[unit][1], f"{values.mean[k]:+z.3f}", scatter))
    for i, k in values.suspects[:most]:
        at, unit = int(values.configurations[i]), units[k]
        name = str(at) if configurations is None else configurations["id"][at]
        error = figure(values.error[i, k], unit, "+"), SHOWN[unit][1]
        wrong.append((name, values.names[k], *error, f"{values.studentised[i, k]:+.1f}"))
    if len(values.suspects) > most:
        wrong.append(("", f"and {len(values.suspects) - most} more", "", "", ""))
    title = f"Joint readings (estimate minus reading; scatter is 1 where all is as {sigma})"
    return [
        *section(title, table_of(("", sigma, "", f"mean error / {sigma}", "scatter"), rows, left="lrl")),
        *section("Suspicious joint readings", table_of(("", "", "error", "", "in its sigma"), wrong, left="llrl")),
    ]


def _landmarks(landmarks: Sequence[LandmarkEstimate], most: int = 8) -> list[Section]:
    """Estimated contact points, targets, anchors, planes and boards; `result.json` has all of many."""
    sections: list[Section] = []
    for kind, title in ((kind.name, kind.heading) for kind in LANDMARKS.values() if kind.heading):
        chosen, rows = [p for p in landmarks if p.kind == kind], []
        for p in chosen[:most]:
            units = ["" if kind == "unknown" else unit for unit in p.units]
            xyz, sigma = _vector(p.xyz, *units), _vector(p.sigma, *units)
            rows.append((p.name, f"{p.n}", xyz, "±", sigma if p.sigma.any() else "known"))
        if len(chosen) > most:
            rows.append((f"and {len(chosen) - most} more", "", "", "", ""))
        sections += section(title, table_of(("", "rows", "estimate", "", "sigma"), rows, left="lrrlr"))
    return sections


def _frames(result: Result) -> list[Section]:
    """The estimated measurement frames."""
    sections: list[Section] = []
    for symbol, frame in result.frames.items():
        which = "" if len(result.tables) == 1 else f" of {result.tables[int(symbol[2:-1])][0]}"
        rows = [
            ("xyz", _vector(frame.xyz, *"mmm"), "mm"),
            ("± along its axes", _vector(frame.sigma[3:], *"mmm"), "mm"),
            ("quaternion xyzw", "  ".join(f"{v:z.8f}" for v in frame.quaternion_xyzw.tolist()), ""),
            ("± about its axes", _vector(frame.sigma[:3], *["rad"] * 3), "deg"),
        ]
        sections += section(f"Measurement frame (world_T_base{which})", table_of(("", "", ""), rows, left="lrl"))
    return sections


def _vector(values: Floats, *units: str) -> str:
    return "  ".join(figure(v, unit) for v, unit in zip(values.tolist(), units, strict=True))


def summary(result: Result, most: int = 3) -> list[str]:
    """Robot, verdict, counts and residuals in at most ten lines.

    Args:
        result: The result.
        most: How many errors or warnings are shown.
    """
    texts = [f"DOUBTFUL: {finding}" for finding in result.findings]
    texts = texts or [f"{verdict_word(result)}: {result.solver.message}", *result.reservations]
    more = [f"... and {len(texts) - most} more findings"] if len(texts) > most else []
    chi2 = "" if result.reduced_chi2 is None else f", reduced chi-square {result.reduced_chi2:.3g}"
    known = sum(p.sigma is not None for p in result.estimated)
    lines = [
        f"{result.robot}: {'; '.join(words for _, words in result.tables)}",
        *([] if result.acceptance is None else judged(result.acceptance.judgements)),
        *texts[:most],
        *more,
        f"{result.n_configurations} configurations, {result.n_residuals} residuals{chi2}",
        f"{len(result.estimated)} of {len(result.parameters)} parameters estimated, {known} of them with a known sigma",
        *_rms_lines(result),
    ]
    return [str(line(text if len(text) <= WIDTH else f"{text[: WIDTH - 4]} ...")) for text in lines]


def _rms_lines(result: Result) -> Iterator[str]:
    for split, kinds in result.residual_rms.items():
        found = [
            f"{kind} {in_words(rms.before, result.unit_of(kind))} -> {in_words(rms.after, result.unit_of(kind))}"
            for kind, rms in kinds.items()
            if rms is not None
        ]
        if found:
            yield f"{split} residuals, RMS: {', '.join(found)}"


def notes_of(solution: Solution, assessed: Assessment) -> Iterator[str]:
    """What a reader of the report should know besides, a sentence each."""
    problem, goodness = solution.problem, assessed.fit.goodness
    for reason, count in problem.n_excluded.items():
        if count:
            yield f"{count} train rows are excluded: {reason.replace('_', ' ')}"
    if same := problem.data.n_train(lambda kind: kind.is_contact and kind.ends == 2):
        yield f"{same} train pairs touch one point twice: three coordinates each instead of a distance"
    for table in problem.data.tables:
        if not table.uses_pairs and table.measurements.pairs is not None:
            yield f"{table.measurements.pairs.source} is not used: model {table.model} is of poses, not of pairs"
    if problem.added:
        values = problem.variables.values(solution.parameters)
        chi2 = 2.0 * sum(factor.error(values) for factor in problem.added)
        yield f"{len(problem.added)} added factors with {problem.n_added} rows: chi-square {chi2:.6g}"
    if problem.formed and problem.missing_correlation and problem.n_pairs >= problem.n_configurations:
        yield (
            f"{problem.n_pairs} pairs are formed from {problem.n_configurations} poses and counted as independent: the"
            " sigmas are too small where there are many more pairs than poses"
        )
    yield from _noise_notes(solution, assessed)
    weights, series = problem.state.weights, problem.data.series
    if weights is not None:
        n = sum(int(np.sum(w[s.train] < OUTLIER_WEIGHT)) for s, w in zip(series, weights, strict=True))
        yield (
            f"loss {problem.options.loss}: {n} of {sum(len(s.train) for s in series)} measurements lost more than half"
            " their weight and do not count in chi-square"
        )
    yield from _undetermined(solution, assessed)
    for frame in sorted({p.name.split(".")[0] for p in assessed.estimates.parameters if _is_rotation(p)}):
        yield f"{frame} is pitched near 90 degrees: corrections of its angles are rotations about its own axes"
    if not assessed.fit.residuals.split.any():
        yield "no test rows: the prediction of new configurations was not checked"
    if goodness.suspects.size and weights is None:
        yield "suspicious rows may be weighted down by a robust loss: loss in the job"


def _noise_notes(solution: Solution, assessed: Assessment) -> Iterator[str]:
    """What the ratio of observed to specified noise means, and how to estimate the noise."""
    estimated, joint_noise = solution.estimated_noise, bool(np.any(solution.problem.data.sigma_joint > 0.0))
    verdicts = {fit.verdict for fit in assessed.fit.goodness.kinds}
    if estimated and solution.converged:
        kinds = " and ".join(dict.fromkeys(kind for _, kind in estimated))
        yield (
            f"{kinds} noise was estimated from these residuals: chi-square does not test it, and {len(estimated)}"
            " degrees of freedom are used for it"
        )
    elif estimated is None and verdicts & {"too large", "too small", "both"} and assessed.noise_may_be_estimated:
        if joint_noise and "too large" in verdicts:
            yield (
                "the specified joint noise may be too large (one value a joint: noise: {joint: [...]}); estimate: true"
                " separates it from that of the measurements where possible"
            )
        else:
            yield "to use the observed noise instead of the specified one: estimate: true in noise of the job"


def _is_rotation(p: ParameterEstimate) -> bool:
    """Whether a correction is about a frame's own axis, not the difference of an angle (see `corrections_of`)."""
    off = p.estimate - p.nominal - p.correction
    return p.unit == "rad" and abs(np.remainder(off + np.pi, 2.0 * np.pi) - np.pi) > UNMOVED


def _undetermined(solution: Solution, assessed: Assessment) -> Iterator[str]:
    """What fixes the parameters that the data alone do not determine."""
    estimated, keep = set(assessed.names), solution.problem.options.gauge == "keep"
    fixed: dict[str, list[ParameterEstimate]] = {}
    for p in assessed.estimates.parameters:
        if p.identifiability in ("relative", "ineffective"):
            if p.name in estimated and p.prior_sigma is not None:
                what = "not identifiable from these data, fixed by their priors: {}"
            elif abs(p.correction) <= UNMOVED:
                what = "not identifiable from these data, kept at nominal: {}"
            elif keep:
                what = "standing for combinations with parameters that stay at nominal: {}"
            elif p.sigma is not None:
                what = "not identifiable from these data, fixed by priors of parameters in combination with them: {}"
            else:
                what = "fixed by nothing, moved from nominal by steps of minimum norm: {}"
            fixed.setdefault(what, []).append(p)
    for what, parameters in fixed.items():
        yield what.format(shortened([p.name for p in parameters], 12))
