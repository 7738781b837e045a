"""`report.html`: the page of a calibration, one file that needs no other, from the template `page.html`."""

import re
import shlex
from collections.abc import Iterator
from functools import cache, partial
from typing import Any

from fg_calib import inputs, io
from fg_calib.report import tables, text
from fg_calib.report.charts import RAMP, resource, standalone
from fg_calib.report.figures import arm_scene, figures_of
from fg_calib.report.predict import FRAMES, percentages, size_table
from fg_calib.report.tables import Section, in_words, section

WORKSPACE = "Expected error over the workspace"

MAX_ROWS = 12
"""Suspicious rows that the page lists; the table of residuals has all."""

CODE = re.compile(r" \([^()]*`[^()]*\)")
"""Keys and commands in a statement, which the first page leaves out."""

EXPLANATIONS = {
    text.PARAMETERS: "Dots are corrections, estimate minus nominal, with 1 sigma to both sides; the pale band is the"
    " prior sigma, cut at 1.5 times the largest of these. Orange: the uncertainty is unknown.",
    text.CURVES: "What joints turn beyond their readings, with a band of 2 sigma to both sides. Dots on the axis are"
    " readings of fitted rows: where there are none, the band is as wide as the prior.",
    "Compliance of joints": "What a joint would have to turn for the tool to be where it was measured, over the torque"
    " of gravity: blue as calibrated, orange without the joint's compliance (the line).",
    "Studentised residuals": "Residuals in their own standard deviations: noise as specified follows the curve, and 1"
    " in 370 is beyond 3.",
    "Error over joint space": "Predicted minus measured; of positions the component along the joint's own motion: a"
    " sine is an error of that joint once a turn. A trend shows an unmodelled effect of it.",
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
    environment.filters |= {"digits": tables.figure, "in_words": in_words, "shown_in": tables.shown_in}
    environment.filters["without_code"] = partial(CODE.sub, "")
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
        lost=list(_not_determined(result)),
        frames=FRAMES,
        command=_command(result),
        options=vars(result.options),
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


def _not_determined(result: io.Result) -> Iterator[str]:
    """A line a reason why combinations of parameters are not determined, with three of these."""
    found: dict[str, list[str]] = {}
    for one in result.observability.lost:
        members = [name for name, factor in one.relation.items() if abs(factor) >= 0.01]  # the largest is 1
        found.setdefault(one.reason, []).append(" with ".join(members[:3]) + " ..." * (len(members) > 3))
    yield from (f"{inputs.shorten(combinations, 3)}: {reason}" for reason, combinations in found.items())


def _command(result: io.Result) -> str:
    """The command that repeats the calibration in the folder of its job; empty without a job."""
    job, folds = [*result.inputs][:1], [] if result.folds is None else ["--folds", f"{result.folds.n}"]
    return shlex.join(["fg-calib", "calibrate", *job, "--out", "result", *folds]) if job else ""
