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

SECTIONS = {
    **{"parameters": text.PARAMETERS, "curves": text.CURVES, "compliances": "Compliance of joints"},
    **{"residuals": "Studentised residuals", "joints": "Error over joint space", "correlations": "Correlations"},
    "workspace": WORKSPACE,
}
"""The section that each figure is in: one of the report, or of the page alone after them."""


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
    figures = {SECTIONS[name]: (name, of) for name, of in charts.items() if of}
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
