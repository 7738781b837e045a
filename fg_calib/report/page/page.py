"""`report.html`: one file without anything from elsewhere, in which no name of a file can become a script.

Text stands in elements as text; data for the page's own script stand in a block that holds no `<`; and the page's
content security policy lets run only the script with the hash that it names, and load nothing at all.
"""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fg_calib.io.atomic import fill_folder, write_text
from fg_calib.report.page import sections
from fg_calib.report.page.arm import scene
from fg_calib.report.page.charts import RAMP
from fg_calib.report.page.figures import Figure
from fg_calib.report.page.files import FIGURE_FILES, PAGE
from fg_calib.report.page.markup import add, as_html, data, figure, tag
from fg_calib.report.page.run import Run

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

_SECTIONS: tuple[tuple[str, Callable[[Run], list[Element]]], ...] = (
    ("Accuracy before and after", sections.accuracy),
    ("Cross-validation", sections.cross_validation),
    ("Error over joint space", sections.joints),
    ("Parameters", sections.parameters),
    ("What is not determined", sections.undetermined),
    ("Correlations", sections.correlations),
    ("Residuals", sections.residuals),
    ("Expected error over the workspace", sections.workspace),
    ("Inputs, options and versions", sections.inputs),
)


def build_page(run: Run) -> str:
    """The page of a calibration, as HTML."""
    result = run.result
    about = f"{result.model}{'' if result.pairing is None else f', pairs: {result.pairing}'}"
    main = tag(
        "main",
        tag("p", "Robot calibration report", class_="soft"),
        tag("h1", result.robot),
        tag("p", f"{about}; calibrated {run.written:%Y-%m-%d %H:%M} UTC with fg-calib {result.version}", class_="soft"),
        sections.verdict(run),
        sections.tiles(run),
    )
    for title, section in _SECTIONS:
        add(main, tag("section", tag("h2", title), section(run)))
        if section is sections.accuracy:
            add(main, _arm(run))
    return document(f"Calibration of {result.robot}", main)


def document(title: str, main: Element, script: bool = True) -> str:
    """A page around its content.

    Args:
        title: Of the page.
        main: Its content.
        script: Whether it has the arm to be turned.
    """
    style, code = _resource("style.css"), _resource("arm.js") if script else ""
    allowed = f"default-src 'none'; style-src '{_digest(style)}'; script-src '{_digest(code)}'; base-uri 'none'"
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=f"{allowed}; form-action 'none'"),
        tag("meta", name_="viewport", content="width=device-width, initial-scale=1"),
        tag("title", title),
    )
    head.append(_verbatim("style", style))
    body = tag("body", main)
    if script:
        body.append(_verbatim("script", code))
    return as_html(tag("html", head, body, lang="en"))


def write_page(folder: Path, run: Run) -> None:
    """Write `report.html` into a folder, whole or not at all.

    Raises:
        InputError: The folder cannot be written, or holds another file of that name.
    """
    text = build_page(run)
    fill_folder(folder, lambda into: write_text(into / "report.html", text), PAGE)


def write_figures(folder: Path, figures: Mapping[str, Sequence[Figure]]) -> None:
    """Write each figure into a file of its own, `accuracy.svg`, `joints.svg`, ..., all of them or none.

    Raises:
        InputError: The folder cannot be written, or holds other files of these names.
    """
    texts = {f"{name}.svg": standalone(charts) for name, charts in figures.items()}

    def write(into: Path) -> None:
        for name, text in texts.items():
            write_text(into / name, text)

    fill_folder(folder, write, FIGURE_FILES)


def standalone(charts: Sequence[Figure]) -> str:
    """Charts below each other as one SVG that needs no page."""
    from lxml import etree

    boxes = [tuple(map(float, svg.get("viewBox", "0 0 0 0").split())) for _, svg in charts]
    width, gap = max(box[2] for box in boxes), 34.0
    height = sum(box[3] + gap for box in boxes)
    root = tag(
        "svg", xmlns="http://www.w3.org/2000/svg", viewBox=f"0 0 {figure(width)} {figure(height)}", width=2 * width
    )
    root.append(_verbatim("style", _resource("style.css")))
    add(root, tag("rect", width="100%", height="100%", class_="paper"))
    y = 0.0
    for (words, svg), box in zip(charts, boxes, strict=True):
        add(root, tag("text", words, x=0.0, y=y + 14.0, class_="tick"))
        svg.attrib.update({"x": "0", "y": figure(y + 20.0), "width": figure(box[2]), "height": figure(box[3])})
        add(root, svg)
        y += box[3] + gap
    text: str = etree.tostring(root, encoding="unicode")
    return text + "\n"


def _arm(run: Run) -> Element | None:
    """The arm, to be turned."""
    found = scene(run)
    if found is None:
        return None
    unit, family = found["unit"], found["family"]
    words = (
        "Drag to turn it; click a dot or move the slider for another configuration. Dots are where the tool was"
        f" measured (squares: held out); their {family} residual goes from dark ({found['low']:.3g} {unit}) to bright"
        f" ({found['high']:.3g} {unit} and more)."
    )
    of = 0 if run.configurations is None else len(run.configurations.ids)
    if len(found["items"]) < of:
        words += f" {len(found['items'])} of {of} configurations are shown, the worst among them."
    canvas = tag("canvas", id="arm", tabindex="0", role="img", aria_label="The arm in three dimensions")
    canvas.set("data-ramp", json.dumps(RAMP))
    slider = tag("input", id="arm-slider", type="range", min="0", value="0", aria_label="Configuration")
    said = tag("p", "The arm is drawn by a script of this page.", id="arm-words", class_="soft")
    content: list[Any] = [tag("h2", "The arm and what was measured"), tag("p", words)]
    return tag("section", *content, tag("div", canvas, slider, said, class_="scene"), data("arm-data", found))


def _resource(name: str) -> str:
    return files("fg_calib.report.page").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return f"sha256-{b64encode(sha256(text.encode()).digest()).decode()}"


def _verbatim(name: str, text: str) -> Element:
    """A style or script of ours, as it stands."""
    from lxml import etree

    element = etree.Element(name)
    element.text = text
    return element
