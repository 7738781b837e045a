"""`report.html`: the page of a calibration, one file that needs no other, from the template `page.html`."""

import shlex
from collections.abc import Iterator
from functools import cache
from typing import Any

from fg_calib import inputs, io
from fg_calib.report import text
from fg_calib.report.charts import RAMP, resource, standalone
from fg_calib.report.figures import arm_scene, figures_of
from fg_calib.report.predict import FRAMES, percentages, size_table
from fg_calib.report.tables import POSE_KINDS, Section, in_words, section, shortened

WORKSPACE = "Expected error over the workspace"

MAX_ROWS = 40
"""Suspicious rows that the page lists; the table of residuals has all."""

EXPLANATIONS = {
    text.PARAMETERS: "Dots are corrections, estimate minus nominal, with 1 sigma to both sides; the pale band is the"
    " prior sigma, cut at 1.5 times the largest of these. Orange: the uncertainty is unknown.",
    text.CURVES: "What joints turn beyond their readings, with a band of 2 sigma to both sides. Dots on the axis are"
    " readings of fitted rows: where there are none, the band is as wide as the prior.",
    "Compliance of joints": "What a joint would have to turn for the tool to be where it was measured, over the torque"
    " of gravity: blue as calibrated, orange without the joint's compliance (the line).",
    "Studentised residuals": "Residuals in their own standard deviations: noise as specified follows the curve, and 1"
    " in 370 is beyond 3.",
    "Error over joint space": "Each dot is a configuration. A trend shows an unmodelled effect of that joint.",
    "Correlations": "Strong colours: errors of the two parameters go together.",
    WORKSPACE: "RMS error of the tool's position expected from the covariance. Unmodelled effects are not included.",
}
"""How to read the figures of each section: of the report, or of the page alone after them."""


@cache
def _environment() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("fg_calib.report", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: inputs.escaped(value) if type(value) is str else value,
    )
    environment.filters |= {"figure": lambda chart: Markup(chart.svg), "resource": lambda name: Markup(resource(name))}
    return environment


def build_page(data: text.ReportData) -> str:
    """The page of a calibration, as HTML."""
    result, charts, space = data.result, figures_of(data), data.workspace
    sections = sorted(text.build_sections(data, MAX_ROWS), key=lambda one: one.title != text.NOTES)
    drawn = zip(EXPLANATIONS.items(), charts.values(), strict=True)
    figures = {title: (about, of) for (title, about), of in drawn if of}
    sections += [Section(title) for title in figures if title not in {one.title for one in sections}]
    if charts["workspace"] and space is not None:
        sections[-1:] = section(WORKSPACE, size_table(space), *percentages(space))
    template = _environment().get_template("page.html")
    return template.render(
        data=data,
        result=result,
        sections=sections,
        figures=figures,
        arm=arm_scene(data),
        ramp=RAMP,
        verdict=text.verdict_word(result),
        limits=[] if result.acceptance is None else list(text.judged(result.acceptance.judgements)),
        tiles=list(_tiles(data)),
        command=_command(result),
        options=list(_options(result)),
    )


def notebook_html(result: io.Result) -> str:
    """The summary and the parameters as HTML, for a notebook."""
    (table,) = section(text.PARAMETERS, text.parameter_table(result))
    return _environment().get_template("notebook.html").render(lines=text.summary(result), section=table)


def pages_of(data: text.ReportData, *, report: bool, figures: bool) -> dict[str, str]:
    """The page as `report.html`, and its figures as SVG files: text by name."""
    drawn = figures_of(data) if figures else {}
    files = {f"{name}.svg": standalone(charts) for name, charts in drawn.items() if charts}
    return {"report.html": build_page(data)} | files if report else files


def _tiles(data: text.ReportData) -> Iterator[tuple[str, str]]:
    """The most important values, and their meaning."""
    result = data.result
    rows = "of an evaluation" if result.evaluated_only else "held out" if data.split == "test" else "fitted"
    for kind, rms in result.residual_rms[data.split].items():
        if rms is not None and ", table" not in kind:
            unit, found = result.unit_of(kind), data.quantiles(kind)
            after, before = in_words(rms.after, unit), in_words(rms.before, unit)
            if found is None:
                yield after, f"{kind}, rows {rows} (RMS); before: {before}"
            else:
                most = f"95 % below {in_words(found[1], unit)}, RMS {after}"
                yield in_words(found[0], unit), f"{kind}, median of rows {rows}; {most}; before: RMS {before}"
    if result.expected_error is not None:
        frame = "fitted" if result.free_of_frame else "base"
        for kind, unit in POSE_KINDS.items():
            size = in_words(getattr(getattr(result.expected_error, frame), kind), unit)
            yield size, f"tool {kind} error expected from the covariance, {FRAMES[frame]} (RMS)"
    known = sum(p.sigma is not None for p in result.estimated)
    yield f"{result.n_configurations}", "configurations" if result.evaluated_only else "configurations fitted"
    yield f"{known} of {len(result.estimated)}", "parameters estimated with a known uncertainty"


def _command(result: io.Result) -> str:
    """The command that repeats the calibration in the folder of its job; empty without a job."""
    job, folds = [*result.inputs][:1], [] if result.folds is None else ["--folds", f"{result.folds.n}"]
    return shlex.join(["fg-calib", "calibrate", *job, "--out", "result", *folds]) if job else ""


def _options(result: io.Result) -> Iterator[tuple[str, str]]:
    for key, value in vars(result.options).items():
        if value not in (None, (), "") and key != "accept":
            yield key, shortened(list(value), 20) if isinstance(value, tuple) else str(value)
