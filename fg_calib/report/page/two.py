"""Two calibrations of one robot beside each other: what changed, and whether more than their uncertainties."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType

from fg_calib.errors import InputError
from fg_calib.io.atomic import fill_folder, write_text
from fg_calib.io.result import Parameter
from fg_calib.report.page import sections
from fg_calib.report.page.charts import bars, whiskers
from fg_calib.report.page.figures import Figure
from fg_calib.report.page.markup import tag
from fg_calib.report.page.page import document, standalone
from fg_calib.report.page.run import Run
from fg_calib.report.shown import SHOWN
from fg_calib.report.summary import summary
from fg_calib.report.tables import indented, line, plain_table, section

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

FILES = {"comparison.html": b"<!DOCTYPE html>", "comparison.svg": b"<svg"}
"""What a comparison of two runs writes, and how it begins."""

INDEPENDENT = (
    "The change in sigma takes the two for independent; where they share tolerances or measurements it is too small."
)


@dataclass(frozen=True)
class Change:
    """What became of one parameter.

    Attributes:
        name: Its name.
        unit: `m` or `rad`.
        old: Its estimate before.
        new: Its estimate now.
        change: New less old, angles within half a turn.
        sigma: 1 sigma of the change, were the two independent; None where one is not known.
    """

    name: str
    unit: str
    old: float
    new: float
    change: float
    sigma: float | None

    @property
    def in_sigma(self) -> float | None:
        """The change in its sigma."""
        return None if not self.sigma else self.change / self.sigma


def changes(old: Run, new: Run) -> tuple[Change, ...]:
    """Parameter by parameter, those that one of the two estimated.

    Raises:
        InputError: They are of different robots.
    """
    names = [[p.name for p in run.result.parameters] for run in (old, new)]
    if names[0] != names[1]:
        raise InputError(str(new.folder), "another robot", f"the parameters of {old.folder}")
    pairs = zip(old.result.parameters, new.result.parameters, strict=True)
    estimated = (both for both in pairs if any(p.identifiability != "fixed" for p in both))
    return tuple(_change(*both) for both in estimated)


def _change(old: Parameter, new: Parameter) -> Change:
    change = new.estimate - old.estimate
    if new.unit == "rad":
        change -= 2.0 * np.pi * round(change / (2.0 * np.pi))
    known = old.sigma is not None and new.sigma is not None
    sigma = float(np.hypot(old.sigma or 0.0, new.sigma or 0.0)) if known else None
    return Change(new.name, new.unit, old.estimate, new.estimate, change, sigma)


def _accuracy(old: Run, new: Run) -> Iterator[tuple[str, str, list[str]]]:
    """Split and kind, and the RMS of nominal, old and new."""
    for split in ("test", "train"):
        both = [run.result.residual_rms.get(split, {}) for run in (old, new)]
        for family in dict.fromkeys((*both[0], *both[1])):
            rms = [kinds.get(family) for kinds in both]
            if any(one is not None for one in rms):
                yield split, family, [sections.shown_rms(one, family, "after") for one in rms]


def build_text(old: Run, new: Run) -> RenderableType:
    """The two for the terminal."""
    found = changes(old, new)
    parts: list[RenderableType] = []
    for name, run in (("OLD", old), ("NEW", new)):
        parts += [line(f"{name}  {run.folder}", "bold"), *indented(summary(run.result)), line("")]
    table = plain_table(("", "left"), ("rows", "left"), ("old", "right"), ("new", "right"))
    for split, family, figures in _accuracy(old, new):
        table.add_row(family, split, *figures)
    parts += section("Residuals after calibration (RMS)", table)
    headings = ("old", "new", "change", "sigma of it", "in sigma")
    table = plain_table(("", "left"), ("", "left"), *((heading, "right") for heading in headings))
    for row in _rows(found):
        table.add_row(*row)
    return Group(*parts, *section("Parameters", table), *indented([INDEPENDENT]))


def _rows(found: tuple[Change, ...]) -> Iterator[list[str]]:
    for one in found:
        factor, unit, decimals = SHOWN[one.unit]
        sigma = "unknown" if one.sigma is None else f"{one.sigma * factor:.{decimals}f}"
        z = "" if one.in_sigma is None else f"{one.in_sigma:+z.1f}"
        figures = (f"{value * factor:z.{decimals}f}" for value in (one.old, one.new))
        yield [one.name, unit, *figures, f"{one.change * factor:+z.{decimals}f}", sigma, z]


def two_document(old: Run, new: Run) -> dict[str, Any]:
    """The two for programs, in [m] and [rad].

    { "schema": "fg-calib/changes/1", "old": folder, "new": folder,
      "parameters": [{"name", "unit", "old", "new", "change", "sigma", "in_sigma"}] }
    """
    found = changes(old, new)
    parameters = [asdict(one) | {"in_sigma": one.in_sigma} for one in found]
    folders = {"old": str(old.folder), "new": str(new.folder)}
    return {"schema": "fg-calib/changes/1", **folders, "parameters": parameters}


def build_two(old: Run, new: Run) -> str:
    """The two as a page of HTML."""
    found = changes(old, new)
    sides = [
        tag("div", tag("h2", f"{name}: {run.folder.name}"), _about(run), sections.verdict(run), sections.tiles(run))
        for name, run in (("Old", old), ("New", new))
    ]
    accuracy = [[family, split, *figures] for split, family, figures in _accuracy(old, new)]
    main = tag(
        "main",
        tag("p", "Two calibrations side by side", class_="soft"),
        tag("h1", new.result.robot),
        tag("div", sides, class_="figures"),
        tag("h2", "Residuals after calibration (RMS)"),
        sections.figures([_bars(old, new)]),
        sections.table(["", "rows", "old", "new"], accuracy),
        tag("h2", "What changed"),
        sections.figures(_whiskers(found)),
        sections.table(["", "", "old", "new", "change", "sigma of it", "in sigma"], list(_rows(found))),
        tag("p", INDEPENDENT, class_="soft"),
        *[
            tag("section", tag("h2", f"{name}: inputs, options and versions"), sections.inputs(run))
            for name, run in (("Old", old), ("New", new))
        ],
    )
    return document(f"Two calibrations of {new.result.robot}", main, script=False)


def write_two(folder: Path, old: Run, new: Run, *, figures: bool = False) -> None:
    """Write `comparison.html`, and `comparison.svg` if figures are wanted, into a folder, all of them or none.

    Raises:
        InputError: They are of different robots, or the folder cannot be written.
    """
    texts = {"comparison.html": build_two(old, new)}
    if figures:
        texts["comparison.svg"] = standalone([_bars(old, new), *_whiskers(changes(old, new))])

    def write(into: Path) -> None:
        for name, text in texts.items():
            write_text(into / name, text)

    fill_folder(folder, write, FILES)


def _about(run: Run) -> Element:
    return tag("p", f"calibrated {run.written:%Y-%m-%d %H:%M} UTC", class_="soft")


def _bars(old: Run, new: Run) -> Figure:
    split = "test" if old.held_out and new.held_out else "train"
    both = [run.result.residual_rms.get(split, {}) for run in (old, new)]
    rows = []
    for family in dict.fromkeys((*both[0], *both[1])):
        chart = []
        for name, rms in zip(("old", "new"), (kinds.get(family) for kinds in both), strict=True):
            value = np.nan if rms is None or rms.after is None else rms.after
            chart.append((name, value, sections.shown_rms(rms, family, "after")))
        if np.isfinite([value for _, value, _ in chart]).any():
            rows.append((family, chart))
    about = f"RMS residuals of {split} rows after the old and after the new calibration"
    return about, bars(rows, about)


def _whiskers(found: tuple[Change, ...]) -> list[Figure]:
    charts = []
    for unit, what in (("m", "Lengths"), ("rad", "Angles")):
        factor, name, _ = SHOWN[unit]
        rows = [
            (one.name, one.change * factor, np.nan if one.sigma is None else one.sigma * factor, np.nan)
            for one in found
            if one.unit == unit
        ]
        if rows:
            about = f"{what}: new less old [{name}], with 1 sigma of the change to both sides"
            charts.append((about, whiskers(rows, about, f"[{name}]")))
    return charts
