"""`report.html`: the page of a calibration, one file that needs no other, from the template `page.html`."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Any

import numpy as np

from fg_calib.errors import escaped
from fg_calib.prediction.workspace import PredictedErrors
from fg_calib.report.charts import RAMP, resource, standalone
from fg_calib.report.figures import Drawn, arm_scene, figures_of
from fg_calib.report.tables import SHOWN, in_words, relations_by_reason, shortened, weak_rows
from fg_calib.report.text import (
    PARAMETER_HEADINGS,
    TOLERANCE_HEADINGS,
    judged,
    parameter_rows,
    spread_in_words,
    tolerance_rows,
    verdict_word,
)

MAX_ROWS = 40
"""Suspicious rows that the page lists; the table of residuals has all."""

RESIDUALS_PER_PARAMETER = 3
"""Below this ratio, strong correlations may come from the number of residuals alone."""

LIMITS = {"position": "0.5 mm", "distance": "0.5 mm", "orientation": "0.1 deg", "angle": "0.1 deg"}
"""Examples of limits in a job, by the kind of residual."""

FIGURES = ("accuracy", "joints", "ranges", "parameters", "correlations", "residuals", "workspace")
"""Names of the figures."""

CLASSES = {
    "independent": "Independent: identifiable alone",
    "relative": "Relative: identifiable only in combination with others",
    "ineffective": "Ineffective: not identifiable, no measurement depends on these",
}
"""Heading of each class of parameters."""


def build_page(drawn: Drawn) -> str:
    """The page of a calibration, as HTML."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    template = Environment(
        loader=PackageLoader("fg_calib.report", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: escaped(value) if type(value) is str else value,
    )
    template.filters |= {"words": in_words, "figure": lambda chart: Markup(chart.svg)}
    charts = dict.fromkeys(FIGURES, ()) | figures_of(drawn)
    return template.get_template("page.html").render(
        result=drawn.result,
        drawn=drawn,
        charts=charts,
        style=Markup(resource("style.css")),
        script=Markup(resource("arm.js")),
        arm=arm_scene(drawn),
        ramp=RAMP,
        verdict=verdict_word(drawn.result),
        limits=[] if drawn.result.acceptance is None else judged(drawn.result.acceptance.judgements),
        example=next((f"{kind}: {LIMITS[kind]}" for kind in drawn.result.rms_after(drawn.split) if kind in LIMITS), ""),
        tiles=list(_tiles(drawn)),
        spread=[] if drawn.result.folds is None else spread_in_words(drawn.result),
        gaps=[] if drawn.workspace is None else list(_gaps(drawn.workspace)),
        limits_words="" if drawn.workspace is None else _limits_in_words(drawn.workspace),
        headings=[*PARAMETER_HEADINGS[:7], "sigma / prior"],
        classes=[(title, _parameter_rows(drawn, kind)) for kind, title in CLASSES.items()],
        tolerances=(TOLERANCE_HEADINGS, tolerance_rows(drawn.result)),
        lost=relations_by_reason(drawn.result.observability.lost),
        weak=weak_rows(drawn.result.observability.observability, 8),
        few=drawn.result.n_residuals < RESIDUALS_PER_PARAMETER * len(drawn.result.estimated),
        suspects=_suspects(drawn),
        workspace=_workspace(drawn),
        command=_command(drawn),
        options=list(_options(drawn)),
    )


def draw_figures(drawn: Drawn) -> dict[str, str]:
    """The figures of the page as SVG files: text by name."""
    return {f"{name}.svg": standalone(charts) for name, charts in figures_of(drawn).items()}


def _tiles(drawn: Drawn) -> Iterator[tuple[str, str]]:
    """The most important values, and their meaning."""
    result = drawn.result
    rows = "of an evaluation" if result.evaluated_only else "held out" if drawn.split == "test" else "fitted"
    if result.folds is not None and drawn.split == "train":
        for kind, held in result.folds.kinds.items():
            unit = result.unit_of(kind)
            before = in_words(held.before, unit)
            yield in_words(held.after, unit), f"{kind}, held out by cross-validation; before: {before}"
    for kind, rms in result.residual_rms[drawn.split].items():
        if rms is not None and ", table" not in kind:
            unit = result.unit_of(kind)
            yield in_words(rms.after, unit), f"{kind}, rows {rows}; before: {in_words(rms.before, unit)}"
    expected = result.expected_error
    if expected is not None:
        where = "after the best rigid fit" if result.free_of_frame else "in the base frame"
        both = expected.fitted if result.free_of_frame else expected.base
        for kind, unit in (("position", "m"), ("orientation", "rad")):
            yield in_words(getattr(both, kind), unit), f"tool {kind} error expected from the covariance, {where} (RMS)"
    known = sum(p.sigma is not None for p in result.estimated)
    yield f"{result.n_configurations}", "configurations" if result.evaluated_only else "configurations fitted"
    yield f"{known} of {len(result.estimated)}", "parameters estimated with a known uncertainty"


def _limits_in_words(space: PredictedErrors) -> str:
    """The range over which the workspace is drawn."""
    missing = [joint for joint in space.joints if not np.isfinite(joint.limits).all()]
    if not missing:
        return "within the joint limits"
    ranges = {"rad": "rotations by \u00b1180 deg", "m": "translations as far as they were read"}
    instead = " and ".join(words for unit, words in ranges.items() if any(joint.unit == unit for joint in missing))
    return f"within {'the' if len(missing) < len(space.joints) else 'no'} joint limits ({instead} without any)"


def _gaps(space: PredictedErrors) -> Iterator[str]:
    """The widest part of each joint's range without a reading, where it is wide."""
    for joint in space.joints:
        factor, unit, _ = SHOWN[joint.unit]
        low, high = (v * factor for v in joint.gap)
        ends = [v * factor for v in (*joint.range, *joint.limits) if np.isfinite(v)]
        if max(ends) > min(ends) and high - low > 0.25 * (max(ends) - min(ends)):
            yield f"{joint.name}: nothing between {low:.4g} and {high:.4g} {unit}; measure there"


def _parameter_rows(drawn: Drawn, kind: str) -> list[list[str]]:
    chosen = [p for p in drawn.result.parameters if p.identifiability == kind]
    ratios = ["" if p.sigma is None or not p.prior_sigma else f"{p.sigma / p.prior_sigma:.2f}" for p in chosen]
    return [[*row[:7], ratio] for row, ratio in zip(parameter_rows(chosen), ratios, strict=True)]


def _suspects(drawn: Drawn) -> tuple[int, list[list[str]]]:
    """The number of suspicious rows, and cells of the worst ones."""
    table = drawn.residuals
    if table is None:
        return 0, []
    found = table.with_row_index("row_of_file").filter(table["suspect"] & table["excluded"].is_null())
    found = found[found["studentised"].abs().fill_nan(0.0).arg_sort(descending=True)]
    rows = []
    for row in found.head(MAX_ROWS).fill_null("").iter_rows(named=True):
        factor, unit, decimals = SHOWN.get(row["unit"], (1.0, "", 6))
        where = f"residuals: row {row['row_of_file'] + 1}"
        cells = [row["kind"], f"{row['a']} {row['b']}".strip(), row.get("of", ""), row["split"]]
        rows.append([*cells, f"{row['residual'] * factor:+.{decimals}f} {unit}", f"{row['studentised']:+.1f}", where])
    return len(found), rows


def _workspace(drawn: Drawn) -> dict[str, Any] | None:
    """Quantiles of the expected error over the workspace, and the share where it is unknown."""
    space = drawn.workspace
    if space is None or space.unknown == 1.0:
        return None
    quantiles = [in_words(float(v), "m") for v in np.nanquantile(space.expected[:, 0], [0.05, 0.5, 0.95])]
    far = 100.0 * float(np.mean(space.far))
    return {"n": len(space.far), "quantiles": quantiles, "unknown": 100.0 * space.unknown, "far": far}


def _command(drawn: Drawn) -> str:
    """The command that repeats the calibration in the folder of its job; empty without a job."""
    job = next(iter(drawn.result.inputs), None)
    folds = [] if drawn.result.folds is None else ["--folds", f"{drawn.result.folds.n}"]
    return "" if job is None else shlex.join(["fg-calib", "calibrate", job, "--out", "result", *folds])


def _options(drawn: Drawn) -> Iterator[tuple[str, str]]:
    for key, value in vars(drawn.result.options).items():
        if value not in (None, (), "") and key != "accept":
            shown = {True: "yes", False: "no"}[value] if isinstance(value, bool) else value
            yield key, shortened(list(value), 20) if isinstance(value, tuple) else str(shown)
