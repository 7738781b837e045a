"""The calibration report for people: verdict, statistics, residuals, parameters; lengths in mm, angles in degrees.

It is made of a typed result and its tables, so that a loaded calibration prints like a new one.
"""

from collections.abc import Iterable, Iterator
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table

from fg_calib import assessment, graph, inputs, measurements, prediction, statistics
from fg_calib.diagnostics import chi2_in_words, predicted_in_words, probability
from fg_calib.inputs import pl
from fg_calib.io import Result, key_of
from fg_calib.report import tables
from fg_calib.report.tables import Content, Section, figure, in_order, in_words, line, section, table_of
from fg_calib.robot import Robot, kind_of

UNMOVED = 1e-9
"""How far an estimate that no step meant to move may be from its start, [m] and [rad]."""


class ReportData(inputs.Record):
    """Data of the report, the page and the figures of a calibration.

    Attributes:
        result: The result.
        robot: The calibrated robot.
        posterior: The covariance of its parameters.
        configurations: Every measured configuration; None if they were not saved.
        residuals: Every scalar residual; None if they were not saved.
    """

    result: Result
    robot: Robot
    posterior: statistics.TangentCovariance
    configurations: "pl.DataFrame | None"
    residuals: "pl.DataFrame | None"

    @property
    def split(self) -> str:
        """The rows that accuracy is shown of: `test` if there are any, else `train`."""
        return "test" if self.result.rms_after("test") else "train"

    @cached_property
    def readings(self) -> inputs.Floats:
        """Readings of the measured configurations, shape (n, n_joints), [rad] (prismatic: [m])."""
        assert self.configurations is not None
        return self.configurations.select(f"q{i + 1}" for i in range(self.robot.n_joints)).to_numpy()

    @cached_property
    def held_out(self) -> inputs.Booleans:
        """Which configurations were held out, shape (n,)."""
        assert self.configurations is not None
        return (self.configurations["split"] == "test").to_numpy()

    @cached_property
    def workspace(self) -> prediction.PredictedErrors | None:
        """Expected errors over the workspace; None where nothing says what was measured."""
        if self.configurations is None or not len(self.configurations):
            return None
        return prediction.predict_errors(self.robot, self.posterior, self.readings, fitted=self.result.free_of_frame)

    @cached_property
    def rms(self) -> tuple[str, inputs.Floats] | None:
        """The kind of residual that is nearest to the tool's position, and its RMS by configuration in the unit shown.

        Shape (n,), nan where a configuration has none; None where there is no such kind.
        """
        if self.configurations is None:
            return None
        kinds = [name.removeprefix("rms_") for name in self.configurations.columns if name.startswith("rms_")]
        for kind in sorted(kinds, key=lambda k: ["position", "distance", "point", "pixel", k].index(k)):
            values = self.configurations[f"rms_{kind}"].cast(float).fill_null(np.nan).to_numpy()
            if np.isfinite(values).any():
                return kind, values * tables.shown_in(self.result.unit_of(kind)).factor
        return None


def format_result(found: ReportData, width: int = tables.WIDTH) -> str:
    """The report as plain text."""
    return tables.plain_text(build_report(found), width)


def build_report(found: ReportData) -> Group:
    """The report, to be printed by rich."""
    return tables.report(*_verdict(found.result), *build_sections(found))


def build_sections(found: ReportData, most: int = 5) -> list[Section]:
    """The sections of the report, for the terminal and the page.

    Args:
        found: The calibration.
        most: Suspicious rows that are listed, and weak directions.
    """
    result = found.result
    joint_noise = ", with joint noise" if np.any(result.sigma_joint > 0.0) else ""
    notes = [*(text for text in result.cautions if result.findings or text not in result.reservations), *result.notes]
    return [
        *section(RESIDUALS, _residuals(result), _lengths(result)),
        *section("Fit statistics", _statistics(result)),
        *section(f"Goodness of fit (1 sigma of a row{joint_noise})", *_goodness(result, found.robot)),
        *section("Prediction of the test rows", *_prediction(result)),
        *_cross_validation(result),
        *expected_tool_error(result.expected_error),
        *section("Effects beyond the geometry (folds: RMS of held-out blocks of joint positions)", *_effects(result)),
        *section(PARAMETERS, parameter_table(result)),
        *section(CURVES, _error_curves(result)),
        *section("Combinations that the kept parameters stand for", _combinations(result)),
        *section("Suspicious rows", *_suspicious_rows(found.residuals, "train", most)),
        *section("Suspicious test rows", *_suspicious_rows(found.residuals, "test", most)),
        *section("Suspicious configurations", _suspicious_configurations(result)),
        *_joint_values(found),
        *_frames(result),
        *_landmarks(result),
        *section("Not identifiable from these data", tables.lost_directions(result.observability.lost)),
        *section(tables.WEAKLY, tables.weak_directions(result.observability.observability, most)),
        *section(NOTES, *notes),
    ]


RESIDUALS, PARAMETERS, NOTES, CURVES = "Residuals (RMS)", "Parameters", "Notes", "Error curves of joints"
"""Titles of sections to which the page adds charts, or which it shows first."""


def verdict_word(result: Result) -> str:
    """`GOOD`, with its warnings if there are any, or `DOUBTFUL`."""
    return "DOUBTFUL" if result.findings else "GOOD, with warnings" if result.reservations else "GOOD"


def judged(judgements: Iterable[statistics.Judgement]) -> Iterator[str]:
    """A line a limit: `PASS: position 0.31 mm (RMS of 30 held-out measurements), limit 0.5 mm`."""
    for one in judgements:
        unit = inputs.LIMITED[one.kind]
        error = "" if one.error is None else f" {in_words(one.error, unit)} (RMS of {one.n} held-out measurements)"
        reason = f": {one.reason}" if one.reason else ""
        of = f" of {one.table}" if one.table else ""
        yield f"{one.verdict.upper()}: {one.kind}{of}{error}, limit {in_words(one.limit, unit)}{reason}"


def _verdict(result: Result) -> Iterator[Content]:
    measured = "; ".join(f"{label} ({words})" if len(result.tables) > 1 else words for label, words in result.tables)
    joints = ", joint positions estimated" if result.joint_values is not None else ""
    loss = "" if result.loss == "none" else f", loss {result.loss}"
    yield line(f"{result.robot}: {measured}{joints}{loss}")
    if result.evaluated_only:
        yield line("EVALUATED ONLY: all rows are test rows, nothing of the arm was calibrated")
    yield from (line(f"DOUBTFUL: {finding}", "bold red") for finding in result.findings)
    if not result.findings:
        yield line(f"{verdict_word(result)}: {result.solver.message}", "bold green")
        yield from result.reservations
    if result.acceptance is not None:
        colour = {"pass": "bold green", "fail": "bold red"}.get(result.acceptance.verdict, "bold yellow")
        yield from (line(text, colour) for text in judged(result.acceptance.judgements))
    if result.evaluated_only and result.chi2_p_value is not None:
        yield line(f"test rows: {chi2_in_words(result.chi2, result.chi2_expected, result.chi2_p_value)}")
    elif result.test is not None and result.test.n:
        yield line(predicted_in_words(result.test))


def _statistics(result: Result) -> Table:
    (low, high), reduced, solver = result.chi2_bounds, "unknown", result.solver
    if result.reduced_chi2 is not None:
        p = "" if result.chi2_p_value is None else f", p-value {probability(result.chi2_p_value)}"
        reduced = f"{result.reduced_chi2:.4g} (good from {low:.3g} to {high:.3g}){p}"
    cost = f"cost {solver.initial_cost:.6g} -> {solver.cost:.6g}"
    rows = {
        "configurations": f"{result.n_configurations}",
        "pairs": f"{result.n_pairs or ''}",
        "residuals": f"{result.n_residuals}, and {result.n_priors} priors",
        "estimated": f"{result.n_unknowns} unknowns, {result.n_determined} directions determined",
        "chi-square": f"{result.chi2:.6g} with {result.dof} degrees of freedom",
        "reduced chi-square": reduced,
        "solver": f"{solver.iterations} iterations, {solver.seconds:.2f} s, {cost}",
    }
    return table_of(("", ""), [row for row in rows.items() if row[1]])


def _named(result: Result, fit: statistics.KindFit) -> str:
    return fit.kind if len(result.tables) == 1 else f"{fit.kind} of {result.tables[fit.table][0]}"


def _goodness(result: Result, robot: Robot) -> list[Content]:
    """Specified and estimated noise by kind, and what their ratio means."""
    factors, fits, rows = result.noise_factors, tuple(result.goodness.values()), list[tuple[Any, ...]]()
    for fit in fits:
        specified, ratio, words = fit.specified_sigma_rms, fit.observed_over_specified, statistics.VERDICTS[fit.verdict]
        if factors is not None:
            ratio, words = fit.factor, _estimated_noise(result, key_of(fit, fits))
        rows.append((_named(result, fit), fit.unit, specified, ratio * specified, ratio, fit.p_value, words))
    joint = (factors or {}).get("joint")
    for unit in dict.fromkeys(one.unit for one in robot.joints) if joint is not None else ():
        sigma = result.sigma_joint[[one.unit == unit for one in robot.joints]]
        rms = np.sqrt(np.mean(sigma[sigma > 0.0] ** 2)) if np.any(sigma > 0.0) else np.nan
        rows.append(("joint readings", unit, rms / (joint or 1.0), rms, joint, None, _estimated_noise(result, "joint")))
    estimated = "observed" if factors is None else "estimated"
    columns = ("", "|unit", "specified|q|-", f"{estimated}|q|-", "ratio|.3f", "p-value|p", "")
    level = f"no row (|studentised residual| above {result.suspect_level:.2f}) and no configuration is suspicious"
    none = not result.suspect_configurations and not any(fit.n_beyond for fit in fits)
    return [table_of(columns, rows), *([level] if none and np.isfinite(result.suspect_level) else [])]


def _estimated_noise(result: Result, key: str) -> str:
    if key in result.noise_kept:
        return "cannot be estimated from these rows: as specified"
    return "estimated" if result.solver.converged else "not settled: the estimate has not converged"


def _prediction(result: Result) -> Iterator[Content]:
    """How well the test rows are predicted, by kind."""
    if (fit := result.test) is None:
        return
    ratios = [(k.n, k.observed_over_specified / k.factor, k.p_value) for k in fit.kinds]
    words = [statistics.PREDICTION_VERDICTS[k.verdict] for k in fit.kinds]
    rows = [(_named(result, k), *of, word) for k, of, word in zip(fit.kinds, ratios, words, strict=True)]
    yield table_of(("", "rows|d", "ratio|.3f", "p-value|p", ""), rows)
    if fit.n_outliers:
        yield f"{fit.n_outliers} of {fit.n_measurements} measurements do not count: outliers by the loss"
    if fit.n_unknown:
        yield f"{fit.n_unknown} rows are not judged: they depend on what is not determined"


def _cross_validation(result: Result) -> list[Section]:
    """How well configurations are predicted by calibrations without them, and how parameters spread."""
    if (found := result.folds) is None:
        return []
    kinds = {kind: found.kinds[kind] for kind in in_order(found.kinds)}
    rows = [(kind, result.unit_of(kind), held.n, held.before, held.after, held.noise) for kind, held in kinds.items()]
    lines, (ratio, wide) = [], found.beyond({p.name: p.sigma for p in result.estimated})
    if ratio:
        median = f"{np.median(list(ratio.values())):.2f}" + " (pairs: expect 1.4 to 1.7)" * found.of_pairs
        lines.append(f"spread of a parameter between folds over its sigma: median {median}, below 1 where priors act")
    if wide:
        named = inputs.shorten([f"{name} {ratio[name]:.1f}" for name in wide], 5)
        lines.append(f"spread significantly larger than sigma: {named}; the model lacks an effect, or rows are wrong")
    if found.not_converged:
        lines.append(f"{found.not_converged} of {found.n} calibrations did not converge")
    title = f"Cross-validation ({found.n} folds of configurations, each predicted without it; RMS)"
    columns = ("", "|unit", "held out|d", "before|q:.4f", "after|q:.4f", "specified noise|q:.4f")
    return section(title, table_of(columns, rows), *lines)


def _effects(result: Result) -> Iterator[str]:
    """What was found of each effect that was tried."""
    for one in result.effects:
        joints, n = ", ".join(map(str, one.joints)), len(one.joints)
        if n > 2 and one.joints[-1] - one.joints[0] == n - 1:
            joints = f"{one.joints[0]} to {one.joints[-1]}"
        where = f" of joint{'s' * (n > 1)} {joints}" * bool(joints)
        rms = f"{figure(one.folds_before, one.unit, '.3g')} -> {in_words(one.folds_after, one.unit)}"
        p = f"p {one.p_value:.0e}" if one.p_value > 1e-300 else "p < 1e-300"
        outcome = "kept" if one.kept else f"left, {one.reason}"
        yield f"{one.effect.replace('_', ' ')}{where}: {p}, folds {rms}: {outcome}"


def expected_tool_error(expected: prediction.ExpectedError | None) -> list[Section]:
    """The section on the expected error of the tool, by the covariance; none for an evaluation."""
    if expected is None:
        return []
    kinds, both = tables.POSE_KINDS, (expected.base, expected.fitted)
    rows = [(kind, unit, *(getattr(rms, kind) for rms in both)) for kind, unit in kinds.items()]
    which = "" if expected.n == expected.of else f" of {expected.of}"
    title = f"Expected tool error (RMS at {expected.n}{which} {expected.at} configurations)"
    return section(title, table_of(("", "|unit", "in the base frame|q", "after the best rigid fit|q"), rows))


def _residuals(result: Result) -> Table:
    """Rows by kind; by table where several tables have it."""
    names, rows = list(result.residual_rms["train"]), []
    for kind in in_order(name for name in names if ", table" not in name):
        for name in [name for name in names if name.startswith(f"{kind}, table ")] or [kind]:
            both = [result.residual_rms[split].get(name) for split in ("train", "test")]
            values = (getattr(rms, when, None) for rms in both for when in ("before", "after"))
            if any(both):
                rows.append((name, result.unit_of(kind), *values))
    headings = ("train before", "after", "test before", "after")
    return table_of(("", "|unit", *(f"{heading}|q:.4f|-" for heading in headings)), rows)


def _lengths(result: Result) -> Table:
    """Statistics of the lengths of test residuals, else of train ones, in the words of ISO 9283."""
    split = "test" if result.rms_after("test") else "train"
    rows = [
        (f"{kind} {when}", result.unit_of(kind), one.mean, one.std, one.p95, one.max)
        for kind, both in result.residual_statistics.get(split, {}).items()
        for when, one in (both or {}).items()
    ]
    headings = (f"{split} rows: mean", "std", "95 %", "max")
    table = table_of(("", "|unit", *(f"{heading}|q:.4f|-" for heading in headings)), rows)
    table.caption, table.caption_justify = line("mean: the accuracy of ISO 9283, averaged over these rows"), "left"
    return table


def parameter_table(result: Result) -> Table:
    """Every parameter but those of curves; base and tool fixed at zero are left out, all fixed ones of evaluations."""
    rows: list[tuple[Any, ...]] = []
    for p in (p for p in result.parameters if kind_of(p.name) != "curve"):
        if p.identifiability != "fixed":
            more = p.correction, p.nominal, "" if p.prior_sigma is None else p.prior_sigma
            rows.append((p.name, p.estimate, p.sigma, p.unit, *more, p.identifiability))
        elif not result.evaluated_only and (p.nominal != 0.0 or not p.name.startswith(("base.", "tool."))):
            rows.append((p.name, p.estimate, "", p.unit, "", "", "", "fixed"))
    return table_of(("", "estimate|q", "± sigma|q", "|unit", "correction|q:+", "nominal|q", "prior|q", "class"), rows)


def _error_curves(result: Result) -> Table:
    """Of each estimated error curve how many coefficients were measured, and their RMS and sigma."""
    rows, of_curves = [], (p for p in result.estimated if kind_of(p.name) == "curve")
    for name, each in groupby(of_curves, lambda p: p.name.partition("[")[0]):
        curve = list(each)
        measured = np.array([(p.estimate, p.sigma) for p in curve if p.identifiability == "relative"]).reshape(-1, 2)
        rms = np.linalg.norm(measured, axis=0) / np.sqrt(max(len(measured), 1))
        rows.append((name, len(curve), len(measured), *rms, "rad", curve[0].prior_sigma))
    return table_of(("", "coefficients|d", "measured|d", "RMS|q", "± sigma|q", "|unit", "prior|q"), rows)


def _combinations(result: Result) -> Table:
    sums = [(p, tables.format_sum(p.stands_for)) for p in result.parameters if p.stands_for]
    rows = [(p.name, p.sigma_of_combination, p.unit, words) for p, words in sums]
    return table_of(("", "sigma|q", "|unit", "of the sum"), rows)


def _suspicious_rows(residuals: "pl.DataFrame | None", split: str, most: int) -> list[Table]:
    """The rows of a split that are larger than noise, the worst first; none if they were not saved."""
    if residuals is None:
        return []
    suspects = residuals.filter(residuals["suspect"] & (residuals["split"] == split))
    suspects = suspects[suspects["studentised"].abs().fill_nan(0.0).arg_sort(descending=True)]
    more = [name for name in ("table", "of") if name in suspects.columns]
    columns = ["a", "b", "kind", *more, "residual", "unit", "studentised", "flag"]
    rows = [["" if value is None else value for value in row] for row in suspects.select(columns).rows()]
    return [table_of(("a", "b", "", *more, "residual|q:+", "|unit", "in its sigma|+.1f", ""), rows, most=most)]


def _suspicious_configurations(result: Result) -> Table:
    """The configurations whose residuals together are larger than noise."""
    rows = [(c.id, c.n, c.chi2, c.expected) for c in result.suspect_configurations]
    return table_of(("", "rows|d", "chi-square|.4g", "expected|.4g"), rows, most=8)


def _joint_values(found: ReportData) -> list[Section]:
    """Estimated joint positions compared with the readings, joint by joint, and the suspicious readings."""
    values, configurations = found.result.joint_values, found.configurations
    if values is None:
        return []
    units = [found.robot.joints[j].unit for j in values.joints]
    sigma = "specified" if (found.result.noise_factors or {}).get("joint", 1.0) == 1.0 else "estimated"
    rows = list(zip(values.names, values.sigma, units, values.mean, values.scatter, strict=True))
    wrong = []
    for i, k in values.suspects:
        at = int(values.configurations[i])
        name = str(at if configurations is None else configurations["id"][at])
        wrong.append((name, values.names[k], values.error[i, k], units[k], values.studentised[i, k]))
    title = f"Joint readings (estimate minus reading; scatter is 1 where all is as {sigma})"
    columns = ("", f"{sigma}|q", "|unit", f"mean error / {sigma}|+z.3f", "scatter|.3f")
    suspicious = table_of(("", "", "error|q:+", "|unit", "in its sigma|+.1f"), wrong, most=5)
    return [*section(title, table_of(columns, rows)), *section("Suspicious joint readings", suspicious)]


def _landmarks(result: Result) -> Iterator[Section]:
    """Estimated contact points, targets, anchors, planes and boards; `result.json` has all of many."""
    for kind, title in ((kind.name, kind.heading) for kind in measurements.LANDMARKS.values() if kind.heading):
        rows = []
        for p in (p for p in result.groups if p.kind == kind):
            units = ["" if kind == "unknown" else unit for unit in p.units]
            sigma = _vector(p.sigma, *units) if p.sigma.any() else "known"
            rows.append((p.name, p.n, _vector(p.xyz, *units), "±", sigma))
        yield from section(title, table_of(("", "rows|d", "estimate|>", "", "sigma|>"), rows, most=8))


def _frames(result: Result) -> Iterator[Section]:
    """The estimated measurement frames."""
    for symbol, frame in result.frames.items():
        which = "" if len(result.tables) == 1 else f" of {result.tables[int(symbol[2:-1])][0]}"
        along, about = ("± along its axes", *frame.sigma[3:], "m"), ("± about its axes", *frame.sigma[:3], "rad")
        quaternion = "  ".join(f"{v:z.8f}" for v in frame.quaternion_xyzw.tolist())
        table = table_of(("", "|q", "|q", "|q", "|unit"), [("xyz", *frame.xyz, "m"), along, about])
        yield from section(f"Measurement frame (world_T_base{which})", table, f"quaternion xyzw: {quaternion}")


def _vector(values: inputs.Floats, *units: str) -> str:
    return "  ".join(map(figure, values.tolist(), units))


def summary(result: Result) -> list[str]:
    """Robot, the verdict's first four lines, counts and residuals: ten lines at most."""
    title, *verdict = map(str, _verdict(result))
    chi2 = "" if result.reduced_chi2 is None else f", reduced chi-square {result.reduced_chi2:.3g}"
    known = sum(p.sigma is not None for p in result.estimated)
    lines = [
        *(title, *verdict[:4]),
        f"{result.n_configurations} configurations, {result.n_residuals} residuals{chi2}",
        f"{len(result.estimated)} of {len(result.parameters)} parameters estimated, {known} of them with a known sigma",
    ]
    for split, kinds in result.residual_rms.items():
        known_rms = {kind: (rms, result.unit_of(kind)) for kind, rms in kinds.items() if rms is not None}
        both = (f"{k} {in_words(r.before, unit)} -> {in_words(r.after, unit)}" for k, (r, unit) in known_rms.items())
        lines += [f"{split} residuals, RMS: {', '.join(both)}"] if known_rms else []
    return [str(line(text if len(text) <= tables.WIDTH else f"{text[: tables.WIDTH - 4]} ...")) for text in lines]


def notes_of(solution: graph.Solution, assessed: assessment.Assessment) -> Iterator[str]:
    """Notes for a reader of the report, a sentence each."""
    problem, weights, blocks = solution.problem, solution.problem.state.weights, solution.problem.data.blocks
    for reason, count in problem.n_excluded.items():
        if count:
            yield f"{count} train rows are excluded: {reason.replace('_', ' ')}"
    for table in problem.data.tables:
        if not table.uses_pairs and table.measurements.pairs is not None:
            yield f"{table.measurements.pairs.source} is not used: model {table.model} is of poses, not of pairs"
    if problem.added:
        values = problem.variables.values(solution.parameters)
        chi2 = 2.0 * sum(factor.error(values) for factor in problem.added)
        yield f"{len(problem.added)} added factors with {problem.n_added} rows: chi-square {chi2:.6g}"
    if problem.formed and problem.rows.counted_as_private and problem.n_pairs >= problem.n_configurations:
        formed = f"{problem.n_pairs} pairs are formed from {problem.n_configurations} poses"
        yield f"{formed} and counted as independent: with many more pairs than poses the sigmas are too small"
    yield from _noise_notes(solution, assessed)
    if weights is not None:
        n = sum(int(np.sum(w[s.train] < statistics.OUTLIER_WEIGHT)) for s, w in zip(blocks, weights, strict=True))
        lost = f"{n} of {sum(len(s.train) for s in blocks)} measurements lost more than half their weight"
        yield f"loss {problem.options.loss}: {lost} and do not count in chi-square"
    yield from _undetermined(solution, assessed)
    if not assessed.fit.residuals.split.any() and not problem.options.folds:
        yield "no test rows: the prediction of new configurations was not checked"
    few = assessed.fit.goodness.gross is not None or not assessed.fit.chi_square.too_large
    if few and np.any(assessed.fit.goodness.suspect & assessed.fit.residuals.used) and weights is None:
        yield "suspicious rows may be weighted down by a robust loss: loss in the job"


def _noise_notes(solution: graph.Solution, assessed: assessment.Assessment) -> Iterator[str]:
    """Explain the ratio of observed to specified noise, and how to estimate the noise."""
    estimated, verdicts = solution.estimated_noise, {fit.verdict for fit in assessed.fit.goodness.kinds}
    if estimated and solution.converged:
        kinds = " and ".join(dict.fromkeys(kind for _, kind in estimated))
        used = f"{len(estimated)} degrees of freedom are used for it"
        yield f"{kinds} noise was estimated from these residuals: chi-square does not test it, and {used}"
    elif estimated is None and verdicts & {"too large", "too small"} and assessed.noise_may_be_estimated:
        yield "to use the observed noise instead of the specified one: estimate: true in noise of the job"


def _undetermined(solution: graph.Solution, assessed: assessment.Assessment) -> Iterator[str]:
    """Explain what fixes the parameters that the data do not determine."""
    estimated, fixed = set(assessed.names), dict[str, list[str]]()
    for p in assessed.estimates.parameters:
        if p.identifiability in ("relative", "ineffective") and kind_of(p.name) != "curve":
            if p.name in estimated and p.prior_sigma is not None:
                what = "not identifiable from these data, fixed by their priors"
            elif abs(p.correction) <= UNMOVED:
                what = "not identifiable from these data, kept at nominal"
            elif solution.problem.options.gauge == "keep":
                what = "standing for combinations with parameters that stay at nominal"
            elif p.sigma is not None:
                what = "not identifiable from these data, fixed by priors of parameters in combination with them"
            else:
                what = "fixed by nothing, moved from nominal by steps of minimum norm"
            fixed.setdefault(what, []).append(p.name)
    for what, names in fixed.items():
        yield f"{what}: {inputs.shorten(names, 12)}"
