"""The sections of the page of one calibration, in the order in which they are read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.io.result import Parameter, Rms
from fg_calib.prediction.workspace import Workspace
from fg_calib.report.identifiability import format_relation
from fg_calib.report.page.figures import (
    accuracy_bars,
    arm_ranges,
    correlation_matrix,
    error_over_joints,
    parameter_whiskers,
    residual_charts,
    workspace_slices,
)
from fg_calib.report.page.markup import tag
from fg_calib.report.page.run import Run
from fg_calib.report.shown import FAMILY_UNIT, SHOWN
from fg_calib.report.summary import judged, parameter_rows, verdict_word
from fg_calib.report.tolerances import HEADINGS, TITLE, tolerance_rows
from fg_calib.statistics.cross_validation import wide

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

Floats = NDArray[np.float64]

_FEW = 3
"""Residuals a parameter, below which strong correlations may come from that alone."""

_WHOLE = "Not of a calibration in parts: fg-calib calibrate without --parts, of some of the rows, has it."
"""In place of what takes single rows."""

_LIMITS = {"position": "0.5 mm", "distance": "0.5 mm", "orientation": "0.1 deg", "angle": "0.1 deg"}
"""Limits that a job may state, as its file writes them: one of a kind that was measured is shown."""

_MOST_ROWS = 40
"""Suspicious rows that the page lists; the table of residuals has all."""


def verdict(run: Run) -> list[Element]:
    """Whether the arm is good enough, and whether the figures are to be trusted."""
    result = run.result
    parts = []
    if result.evaluated_only:
        parts.append(tag("p", "Evaluated only: all rows are test rows, nothing of the arm was calibrated."))
    if result.acceptance is not None:
        word = {"pass": "PASS", "fail": "FAIL"}.get(result.acceptance.verdict, "NOT EVALUATED")
        kind = {"pass": "pass", "fail": "fail"}.get(result.acceptance.verdict, "open")
        lines = [tag("div", text) for text in judged(result.acceptance.judgements)]
        parts.append(tag("div", tag("strong", f"{word}: the limits that were set"), lines, class_=f"verdict {kind}"))
    if result.findings:
        lines = [tag("div", text) for text in result.findings]
        parts.append(tag("div", tag("strong", "DOUBTFUL: not to be trusted"), lines, class_="verdict fail"))
    else:
        word = verdict_word(result) + (": figures may be trusted" if not result.in_parts else "")
        lines = [tag("div", text) for text in (*result.reservations, result.solver.message)]
        kind = "open" if result.reservations else "pass"
        parts.append(tag("div", tag("strong", word), lines, class_=f"verdict {kind}"))
    if result.acceptance is None:
        parts.append(tag("p", f"No limits were set{_how_to_set_limits(run)}.", class_="soft"))
    cautions = [text for text in result.cautions if text not in result.reservations]
    if cautions:
        parts += [tag("h3", "Worth knowing"), tag("ul", [tag("li", text) for text in cautions])]
    return parts


def _how_to_set_limits(run: Run) -> str:
    """How the job would state a limit of something that its rows say; nothing where none can be judged."""
    if run.result.in_parts:
        return ": a calibration in parts judges none"
    measured = run.result.residual_rms.get(run.judged_on, {})
    kind = next((name for name in _LIMITS if measured.get(name) is not None), None)
    return "" if kind is None else f": with accept: {{{kind}: {_LIMITS[kind]}}} in the job this page says pass or fail"


def tiles(run: Run) -> Element:
    """The few figures that count."""
    result, split = run.result, run.judged_on
    none = "test rows are left out" if result.in_parts else "none were held out"
    rows = "held out" if run.held_out else f"fitted ({none})"
    rows = "of an evaluation" if result.evaluated_only else rows
    found = []
    for family, held in (result.folds.kinds if result.folds is not None and not run.held_out else {}).items():
        unit = run.unit(family)
        words = f"{family}, held out by cross-validation; before: {_shown(held.before, unit)}"
        found.append((_shown(held.after, unit), words))
    for family, rms in result.residual_rms.get(split, {}).items():
        if rms is not None and ", table" not in family:
            words = f"{family}, rows {rows}; before: {_shown(rms.before, run.unit(family))}"
            found.append((_shown(rms.after, run.unit(family)), words))
    expected = result.expected_error
    if expected is not None:
        where = "after the best rigid fit" if run.free_of_frame else "in the base frame"
        for kind, unit in (("position", "m"), ("orientation", "rad")):
            both = getattr(expected, kind)
            value = both.fitted if run.free_of_frame else both.base
            found.append((_shown(value, unit), f"tool {kind} error expected from the covariance, {where} (RMS)"))
    known = sum(p.sigma is not None for p in result.parameters if p.identifiability != "fixed")
    estimated = sum(p.identifiability != "fixed" for p in result.parameters)
    found.append(
        (f"{result.n_configurations}", "configurations fitted" if not result.evaluated_only else "configurations")
    )
    found.append((f"{known} of {estimated}", "parameters estimated with a known uncertainty"))
    return tag("div", [tag("div", tag("b", value), words, class_="tile") for value, words in found], class_="tiles")


def accuracy(run: Run) -> list[Element]:
    """Before and after, on rows that were held out where there are any."""
    rows = (
        "test rows, to which frame, base and tool alone were fitted"
        if run.result.evaluated_only
        else "rows that were held out: the estimate never saw them"
        if run.held_out
        else "rows that were fitted; test rows are left out of a calibration in parts: elsewhere the arm will do worse"
        if run.result.in_parts
        else "rows that were fitted, for none were held out (split: test): elsewhere the arm will do worse"
    )
    words = f"RMS residuals before and after the calibration, of {rows}."
    parts = [tag("p", f"{words} They contain the measurements' noise.")]
    return [*parts, figures([accuracy_bars(run)])]


def cross_validation(run: Run) -> list[Element]:
    """How well configurations are predicted without which it was calibrated."""
    found = run.result.folds
    if found is None:
        words = "Not done: fg-calib calibrate --folds 5 holds every configuration out once."
        return [tag("p", _WHOLE if run.result.in_parts else words, class_="soft")]
    words = (
        f"{found.n_held_out} configurations in {found.n} folds, each predicted by a calibration without it. RMS; the"
        " noise stated is there to compare."
    )
    rows = []
    for kind, held in found.kinds.items():
        unit = run.unit(kind)
        rows.append([kind, f"{held.n}", *(_shown(v, unit) for v in (held.before, held.after, held.noise))])
    parts = [tag("p", words), table(["", "held out", "before", "after", "noise stated"], rows)]
    sigma = {p.name: p.sigma for p in run.result.parameters if p.sigma}
    ratio = {name: v / sigma[name] for name, v in found.spread.items() if v is not None and name in sigma}
    if ratio:
        by = 100.0 / np.sqrt(2.0 * (found.n - 1))
        words = (
            f"Between folds a parameter spreads by {np.median(list(ratio.values())):.2f} of its sigma (median; each is"
            f" known to {by:.0f} %). Below 1 is where tolerances determine it, far above 1 what the model lacks."
        )
        parts.append(tag("p", words))
        if found.of_pairs:
            parts.append(tag("p", "Of pairs it is 1.4 to 1.7 times as large: they leave with either end."))
        elif beyond := wide(ratio, found.n):
            named = ", ".join(f"{name} {ratio[name]:.1f}" for name in beyond[:8])
            parts.append(tag("p", f"More than their sigmas say, not by chance: {named}."))
    return parts


def joints(run: Run) -> list[Element]:
    """Residuals against each joint's reading, and where each joint was read."""
    charts = error_over_joints(run)
    if not charts:
        return [_missing(run, "configurations.csv")]
    words = "Each dot is a configuration. A bow or a slope means an effect that the model lacks at that joint."
    parts = [tag("p", words), figures(charts)]
    workspace = run.workspace
    if workspace is not None:
        parts += [tag("h3", "Where the joints were measured"), figures([arm_ranges(workspace)])]
        share = 100.0 * float(np.mean(workspace.far))
        text = f"{share:.0f} % of the workspace {_drawn_within(workspace)} has no measured position near it."
        parts.append(tag("p", text))
        parts.append(tag("ul", [tag("li", line) for line in _gaps(run)]))
    return parts


def _drawn_within(workspace: Workspace) -> str:
    """Between what the workspace lies, in words: joint limits, or what stands for those not stated."""
    missing = [joint for joint in workspace.joints if not np.isfinite(joint.limits).all()]
    if not missing:
        return "within the joint limits"
    named = {"rad": "turns by \u00b1180 deg", "m": "slides as far as they were read"}
    stands = " and ".join(words for unit, words in named.items() if any(joint.unit == unit for joint in missing))
    return f"within {'the' if len(missing) < len(workspace.joints) else 'no'} joint limits ({stands} without any)"


def _gaps(run: Run) -> Iterator[str]:
    """The widest part of each joint's range that was not measured, where it is wide."""
    assert run.workspace is not None
    for joint in run.workspace.joints:
        factor, unit, _ = SHOWN[joint.unit]
        low, high = (v * factor for v in joint.gap)
        limits = [v for v in joint.limits if np.isfinite(v)]
        width = (max((*joint.range, *limits)) - min((*joint.range, *limits))) * factor
        if width > 0.0 and high - low > 0.25 * width:
            yield f"{joint.name}: nothing between {low:.4g} and {high:.4g} {unit}; measure there"


def parameters(run: Run) -> list[Element]:
    """Every parameter, by class."""
    found = [p for p in run.result.parameters if p.identifiability != "fixed"]
    if not found:
        return [tag("p", "No parameter was estimated.")]
    words = (
        "Dots are corrections, estimate less nominal, with 1 sigma to both sides; the pale band is the tolerance that"
        " was assumed. Orange: its uncertainty is not known."
    )
    parts = [tag("p", words), figures(parameter_whiskers(run))]
    titles = {
        "independent": "Independent: the measurements alone determine each of these",
        "relative": "Relative: determined only together with others",
        "ineffective": "Ineffective: no measurement depends on these",
    }
    for kind, title in titles.items():
        chosen = [p for p in found if p.identifiability == kind]
        if chosen:
            parts += [tag("h3", title), _table_of_parameters(chosen)]
    if run.result.tolerance_scales:
        rows = tolerance_rows(run.result.tolerance_scales, found)
        parts += [tag("h3", TITLE), table(HEADINGS, rows)]
    return parts


def _table_of_parameters(found: Sequence[Parameter]) -> Element:
    head, *rows = parameter_rows(found)
    cells = [[*row, _share(p)] for row, p in zip(rows, found, strict=True)]
    return table([*head, "sigma / tolerance"], cells, drop=7)


def _share(p: Parameter) -> str:
    return "" if p.sigma is None or not p.prior_sigma else f"{p.sigma / p.prior_sigma:.2f}"


def undetermined(run: Run) -> list[Element]:
    """What nothing determines, and what is determined badly, in words."""
    o = run.result.observability
    parts = []
    if o.lost:
        by_reason: dict[str, list[str]] = {}
        for lost in o.lost:
            by_reason.setdefault(lost.reason, []).append(format_relation(lost.relation))
        rows = [[", ".join(relations), reason] for reason, relations in by_reason.items()]
        parts += [tag("p", "The measurements cannot tell these apart:"), table(["what", "because"], rows, words=True)]
    if o.weak:
        weak = [
            [f"{1.0 / w.signal_to_noise:.3g}" if w.signal_to_noise else "unknown", _relation(w.members)]
            for w in o.weak[:8]
        ]
        parts += [
            tag("p", "Determined badly: the uncertainty is above a tenth of the tolerance, or of 1 mrad at the reach."),
            table(["sigma / tolerance", "largest members"], weak, words=True),
        ]
    parts += [tag("p", f"Not modelled: {missing.message}") for missing in o.missing]
    return parts or [tag("p", "The measurements determine every parameter that was estimated.")]


def _relation(members: dict[str, float]) -> str:
    listed = sorted(members.items(), key=lambda item: -abs(item[1]))
    words = ", ".join(f"{name} {share:+.2f}" for name, share in listed[:6])
    return words if len(listed) <= 6 else f"{words} and {len(listed) - 6} more"


def correlations(run: Run) -> list[Element]:
    """What is correlated."""
    found = correlation_matrix(run)
    if found is None:
        return [tag("p", "Fewer than two parameters have a known uncertainty.")]
    words = "Strong colours: errors of the two go together, so neither is known alone as well as both together."
    parts = [tag("p", words)]
    n, of = run.result.n_residuals, sum(p.identifiability != "fixed" for p in run.result.parameters)
    if n < _FEW * of:
        few = f"Only {n} residuals for {of} parameters: correlations as strong as here may come from that alone;"
        parts.append(tag("p", f"{few} more configurations, farther apart, tell parameters apart."))
    return [*parts, tag("div", figures([found]), class_="scene")]


def residuals(run: Run) -> list[Element]:
    """What is left, and what is suspicious."""
    charts = residual_charts(run)
    if not charts:
        return [_missing(run, "residuals.csv and no residuals.parquet", "without --residuals none")]
    words = "Residuals in their own standard deviations: noise as stated follows the curve, and 1 in 370 is beyond 3."
    parts = [tag("p", words), figures(charts)]
    found = run.residuals
    assert found is not None
    suspects = np.flatnonzero(found.suspect)
    suspects = suspects[np.argsort(-np.abs(np.nan_to_num(found.studentised[suspects])))]
    if not len(suspects):
        return [*parts, tag("p", "No row is suspicious.")]
    rows = []
    for k in suspects[:_MOST_ROWS].tolist():
        factor, unit, decimals = SHOWN.get(found.units[found.kind[k]], (1.0, "", 6))
        of = f"{found.a[k]} {found.b[k]}".strip()
        split = "test" if found.test[k] else "train"
        shown = f"{found.residual[k] * factor:+.{decimals}f} {unit}", f"{found.studentised[k]:+.1f}"
        rows.append([found.kinds[found.kind[k]], of, found.of[k], split, *shown, found.place(k)])
    heading = ["what", "configuration", "of", "split", "residual", "in its sigma", "where"]
    parts += [tag("h3", f"Suspicious rows ({len(suspects)})"), table(heading, rows)]
    if len(suspects) > _MOST_ROWS:
        parts.append(tag("p", f"and {len(suspects) - _MOST_ROWS} more: suspect in {found.file}", class_="soft"))
    return parts


def workspace(run: Run) -> list[Element]:
    """Expected error all over the workspace."""
    found = run.workspace
    if run.result.evaluated_only:
        return [tag("p", "Nothing of the arm was estimated: no covariance says how large its errors are.")]
    if found is None:
        return [_missing(run, "configurations.csv")]
    if not np.isfinite(found.error).any():
        return [tag("p", "The error of the tool depends on what the measurements do not determine: it is not known.")]
    where = "after the best rigid fit to the measured positions" if found.fitted else "in the base frame"
    low, middle, high = (_shown(float(v), "m") for v in np.nanquantile(found.error, [0.05, 0.5, 0.95]))
    unknown = float(np.mean(~np.isfinite(found.error)))
    words = (
        f"RMS error of the tool's position expected from the covariance, {where}, at {len(found.error)} configurations"
        f" drawn {_drawn_within(found)}: 5 % are below {low}, half below {middle}, 95 % below {high}. It says what is"
        " left of the measurements' noise, not what the model lacks."
    )
    parts = [tag("p", words)]
    if unknown > 0.0:
        parts.append(tag("p", f"At {100.0 * unknown:.0f} % of them it is not known."))
    return [*parts, figures(workspace_slices(found))]


def inputs(run: Run) -> list[Element]:
    """What it was made from, and how to make it again."""
    result = run.result
    parts = []
    if run.command is not None:
        parts.append(tag("p", "In the folder of the job: ", tag("code", run.command)))
    if result.inputs:
        files = [[name, digest] for name, digest in result.inputs.items()]
        parts.append(table(["file", "SHA-256"], files, words=True))
    said = {key: value for key, value in result.options.items() if value not in (None, [], (), "") and key != "accept"}
    options = [[key, _plain(value)] for key, value in said.items()]
    if options:
        parts += [tag("h3", "Options"), table(["", ""], options, words=True)]
    versions = [[name, version] for name, version in result.versions.items()] or [["fg-calib", result.version]]
    parts += [tag("h3", "Versions"), table(["", ""], versions, words=True)]
    return parts


def _plain(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _shown(value: float | None, unit: str) -> str:
    """A figure with its unit, in three digits."""
    factor, name, _ = SHOWN.get(unit, (1.0, unit, 3))
    return "unknown" if value is None or not np.isfinite(value) else f"{value * factor:.3g} {name}"


def shown_rms(rms: Rms | None, family: str, when: str) -> str:
    """An RMS before or after with its unit; a dash where there is none."""
    if rms is None:
        return "-"
    return _shown(getattr(rms, when), rms.unit or FAMILY_UNIT.get(family.partition(",")[0], "m"))


def figures(charts: Sequence[tuple[str, Element]]) -> Element:
    """Charts with what they show below each."""
    return tag("div", [tag("figure", svg, tag("figcaption", words)) for words, svg in charts], class_="figures")


def table(heading: Sequence[str], rows: Sequence[Sequence[str]], *, words: bool = False, drop: int = -1) -> Element:
    """A table that scrolls by itself where the page is narrow.

    Args:
        heading: Of each column.
        rows: Cells.
        words: Whether cells hold words, which wrap.
        drop: A column to leave out.
    """

    def cells(name: str, row: Sequence[str]) -> list[Element]:
        kinds = ["words" if words else None for _ in row]
        chosen = [(cell, kind) for i, (cell, kind) in enumerate(zip(row, kinds, strict=True)) if i != drop]
        return [tag(name, cell, class_=kind) for cell, kind in chosen]

    head = tag("thead", tag("tr", cells("th", heading))) if any(heading) else None
    body = tag("tbody", [tag("tr", cells("td", row)) for row in rows])
    return tag("div", tag("table", head, body), class_="wide")


def _missing(run: Run, files: str, how: str = "with --out") -> Element:
    words = f"The folder holds no {files}: calibrate again {how} to have this part."
    return tag("p", _WHOLE if run.result.in_parts else words, class_="soft")
