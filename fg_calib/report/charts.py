"""Charts as SVG: axes, dots, bars, whiskers and matrices, in colours that the page's style sheet sets.

A chart is a caption and its SVG. It stands in the page as it is, or in a file of its own (`write_charts`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fg_calib.inputs import Floats, escaped
from fg_calib.io import write_text

WIDTH, HEIGHT = 360.0, 230.0
"""Size of an ordinary chart, in its own units; the page stretches it."""

LEFT, RIGHT, TOP, BOTTOM = 52.0, 10.0, 12.0, 40.0
"""Margins of the plot within it."""

NAMES = 92.0
"""Width of the names to the left of rows."""

MAX_DOTS = 1500
"""Dots that a chart shows; of more, as many that are evenly spaced."""

RAMP = ("#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725")
"""Colours from low to high that differ in lightness too: samples of viridis (van der Walt & Smith, 2015)."""


class Chart(NamedTuple):
    """A caption and an SVG element with its size."""

    caption: str
    svg: str
    width: float
    height: float


def tag(name: str, content: str = "", **attributes: str | float) -> str:
    """An element of SVG.

    Args:
        name: Of the element.
        content: Elements, or text that has been escaped.
        attributes: By name, a trailing _ removed.
    """
    plain = [
        f' {key.rstrip("_")}="{escape(escaped(value)) if isinstance(value, str) else coordinate(value)}"'
        for key, value in attributes.items()
    ]
    return f"<{name}{''.join(plain)}>{content}</{name}>"


def coordinate(value: float) -> str:
    """A coordinate in few characters."""
    return f"{round(value, 1):g}"


def words(x: float, y: float, text: str, kind: str, **attributes: str) -> str:
    """Text at coordinates."""
    return tag("text", escape(escaped(text)), x=x, y=y, class_=kind, **attributes)


def title(text: str) -> str:
    """Text that shows when its element is pointed at, and for who cannot see it."""
    return tag("title", escape(escaped(text)))


def framed(caption: str, width: float, height: float, *elements: str) -> Chart:
    """A chart of elements."""
    box = f"0 0 {coordinate(width)} {coordinate(height)}"
    return Chart(caption, tag("svg", title(caption) + "".join(elements), viewBox=box, role="img"), width, height)


@dataclass(frozen=True)
class Scale:
    """An axis of a chart.

    Attributes:
        low: The value at `start`.
        high: The value at `end`.
        start: Its coordinate.
        end: The other's coordinate.
    """

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: Any) -> Any:
        """The coordinate of a value, or of an array of them."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self, most: int = 5) -> list[float]:
        """Round values along the axis."""
        width = (self.high - self.low) / most
        power = 10.0 ** np.floor(np.log10(width))
        step = next(float(power * k) for k in (1.0, 2.0, 5.0, 10.0) if power * k >= width * (1.0 - 1e-9))
        first, last = np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9)
        return [float(k * step) for k in np.arange(first, last + 1.0)]


def limits_of(*values: Any, around: float = 0.05, with_zero: bool = False) -> tuple[float, float]:
    """The lowest and highest finite value, with room around them."""
    every = np.concatenate([np.ravel(np.asarray(v, dtype=np.float64)) for v in values] or [np.zeros(0)])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    if with_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    room = around * (high - low) or around * abs(high) or 1.0
    return (low if with_zero and low == 0.0 else low - room), high + room


class Plot:
    """A plot with axes; marks are added to it.

    Args:
        x: Lowest and highest value from left to right.
        y: Those from bottom to top.
        names: What the axes show, with units.
        size: Width and height.
        powers: Whether the values from bottom to top are powers of ten.
    """

    def __init__(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        names: tuple[str, str],
        size: tuple[float, float] = (WIDTH, HEIGHT),
        *,
        powers: bool = False,
    ) -> None:
        self.size, (width, height) = size, size
        self.x, self.y = Scale(*x, LEFT, width - RIGHT), Scale(*y, height - BOTTOM, TOP)
        self._elements: list[str] = []
        for value in self.y.ticks():
            at = self.y(value)
            self.line(self.x.start, at, self.x.end, at, "grid")
            self.add(words(self.x.start - 5.0, at + 3.5, f"1e{value:.3g}" if powers else _label(value), "tick end"))
        for value in self.x.ticks():
            at = self.x(value)
            self.line(at, self.y.start, at, self.y.start + 4.0, "axis")
            self.add(words(at, self.y.start + 15.0, _label(value), "tick middle"))
        self.line(self.x.start, self.y.start, self.x.end, self.y.start, "axis")
        middle = 0.5 * (self.y.start + self.y.end)
        self.add(words(0.5 * (self.x.start + self.x.end), height - 8.0, names[0], "name middle"))
        self.add(words(11.0, middle, names[1], "name middle", transform=f"rotate(-90 11 {coordinate(middle)})"))

    def chart(self, caption: str) -> Chart:
        """The plot with a caption."""
        return framed(caption, *self.size, *self._elements)

    def add(self, element: str) -> None:
        """Add an element in coordinates."""
        self._elements.append(element)

    def line(self, x1: float, y1: float, x2: float, y2: float, kind: str) -> None:
        """A line between coordinates."""
        self.add(tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=kind))

    def level(self, y: float) -> None:
        """A dashed line from left to right at a value."""
        self.line(self.x.start, self.y(y), self.x.end, self.y(y), "level")

    def dots(self, x: Floats, y: Floats, kind: str) -> None:
        """A dot at each pair of finite values."""
        good = np.isfinite(x) & np.isfinite(y)
        at = np.column_stack([self.x(x[good]), self.y(y[good])])
        if len(at):
            at = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), MAX_DOTS)).astype(np.int64))]
            path = "".join([f"M{a:g} {b:g}h0" for a, b in np.round(at, 1).tolist()])
            self.add(tag("path", d=path, class_=f"dots {kind}"))

    def ring(self, x: float, y: float, text: str) -> None:
        """A ring about a dot; its text shows when it is pointed at."""
        self.add(tag("circle", title(text), cx=self.x(x), cy=self.y(y), r=5.0, class_="ring"))

    def curve(self, x: Floats, y: Floats, kind: str) -> None:
        """A curve through values."""
        points = zip(self.x(x).tolist(), self.y(y).tolist(), strict=True)
        path = "M" + "L".join(f"{coordinate(a)} {coordinate(b)}" for a, b in points)
        self.add(tag("path", d=path, class_=kind))

    def box(self, x1: float, y1: float, x2: float, y2: float, **attributes: str) -> None:
        """A rectangle between values."""
        (left, right), (top, bottom) = sorted((self.x(x1), self.x(x2))), sorted((self.y(y1), self.y(y2)))
        self.add(tag("rect", x=left, y=top, width=right - left, height=bottom - top, **attributes))


def bars(rows: Sequence[tuple[str, Sequence[tuple[str, float, str]]]], caption: str) -> Chart:
    """Groups of horizontal bars, each with its own scale, the last of a group in colour.

    Args:
        rows: Name of a group, and its bars: name, length, and value in words.
        caption: Of the chart.
    """
    bar, gap, first = 17.0, 13.0, 18.0
    elements, y = [], 0.0
    for name, group in rows:
        elements.append(words(0.0, y + 12.0, name, "name"))
        most = max((length for _, length, _ in group if np.isfinite(length)), default=0.0) or 1.0
        y += first
        for i, (what, length, value) in enumerate(group, start=1):
            wide = 165.0 * length / most if np.isfinite(length) else 0.0
            kind = "bar after" if i == len(group) else "bar before"
            elements.append(words(72.0, y + 12.0, what, "tick end"))
            elements.append(tag("rect", x=78.0, y=y + 2.0, width=max(wide, 1.0), height=bar - 5.0, class_=kind))
            elements.append(words(84.0 + wide, y + 12.0, value, "tick"))
            y += bar
        y += gap
    return framed(caption, WIDTH, y, *elements)


class Whisker(NamedTuple):
    """A name, a value, its sigma (nan: unknown), and its prior sigma (nan: none)."""

    name: str
    value: float
    sigma: float
    prior: float


def whiskers(rows: Sequence[Whisker], caption: str, name: str) -> Chart:
    """A row each with a dot, a line of one sigma to both sides, and a pale band of the prior sigma.

    Args:
        rows: What is shown.
        caption: Of the chart.
        name: Of the axis.
    """
    row = 15.0
    height = TOP + BOTTOM + row * len(rows)
    value, sigma, prior = (np.array([one[i] for one in rows]) for i in (1, 2, 3))
    spread = np.nan_to_num(sigma)
    x = Scale(*limits_of(value - spread, value + spread, [0.0], prior, -prior), NAMES, WIDTH - RIGHT)
    elements = []
    for tick in x.ticks():
        at, bottom = x(tick), height - BOTTOM
        elements.append(tag("line", x1=at, y1=TOP, x2=at, y2=bottom, class_="axis" if tick == 0.0 else "grid"))
        elements.append(words(at, bottom + 15.0, _label(tick), "tick middle"))
    elements.append(words(0.5 * (NAMES + WIDTH), height - 8.0, name, "name middle"))
    for i, (what, at, one_sigma, band) in enumerate(rows):
        y = TOP + row * (i + 0.5)
        elements.append(words(NAMES - 6.0, y + 3.5, short(what), "tick end"))
        if np.isfinite(band):
            left, right = x(-band), x(band)
            elements.append(tag("rect", x=left, y=y - 6.0, width=right - left, height=12.0, class_="band"))
        known = bool(np.isfinite(one_sigma))
        if known:
            elements.append(tag("line", x1=x(at - one_sigma), y1=y, x2=x(at + one_sigma), y2=y, class_="whisker"))
        dot = f"M{coordinate(x(at))} {coordinate(y)}h0"
        elements.append(tag("path", d=dot, class_=f"dots large {'a' if known else 'b'}"))
    return framed(caption, WIDTH, height, *elements)


def matrix(rows: Sequence[str], columns: Sequence[str], values: Floats, caption: str) -> Chart:
    """A matrix of values from -1 to 1: blue where negative, orange where positive, strong where large.

    Args:
        rows: Names of the rows.
        columns: Names of the columns.
        values: Shape (rows, columns); nan for empty cells.
        caption: Of the chart.
    """
    cell, side = 14.0, 78.0 if max(map(len, rows), default=0) <= 14 else 150.0
    elements = [words(side - 4.0, cell * (i + 1) - 1.5, short(name, 28), "tick end") for i, name in enumerate(rows)]
    foot = 6.0 + cell * len(rows)
    for j, name in enumerate(columns):
        x = side + cell * (j + 0.5) + 3.0
        turned = f"rotate(-90 {coordinate(x)} {coordinate(foot)})"
        elements.append(words(x, foot, short(name), "tick end", transform=turned))
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value) and abs(value) > 0.02:
            about = title(f"{rows[i]}, {columns[j]}: {value:+.2f}") if abs(value) > 0.5 else ""
            box = {"x": side + cell * j, "y": 2.0 + cell * i, "width": cell - 1.0, "height": cell - 1.0}
            kind = "plus" if value > 0.0 else "minus"
            elements.append(tag("rect", about, **box, class_=kind, opacity=f"{min(1.0, abs(value)):.2f}"))
    return framed(caption, side + cell * len(columns) + 6.0, foot + 80.0, *elements)


def legend(low: float, high: float, unit: str, caption: str) -> Chart:
    """The colours of the ramp from a low to a high value."""
    wide, length = (WIDTH - 20.0) / len(RAMP), WIDTH - 20.0
    boxes = [tag("rect", x=10.0 + wide * k, y=4.0, width=wide + 0.5, height=16.0, fill=c) for k, c in enumerate(RAMP)]
    places = ("tick", *["tick middle"] * 3, "tick end")
    ticks = [
        words(10.0 + length * k / 4.0, 36.0, f"{low + (high - low) * k / 4.0:.3g}{f' {unit}' * (k == 4)}", place)
        for k, place in enumerate(places)
    ]
    return framed(caption, WIDTH, 50.0, *boxes, *ticks)


def colour(share: float) -> str:
    """The colour of a share of the ramp, 0 to 1."""
    return RAMP[int(np.clip(share * len(RAMP), 0, len(RAMP) - 1))]


def short(name: str, most: int = 14) -> str:
    """A name in few characters: its end distinguishes it from others, such as `.x`."""
    return name if len(name) <= most else f"{name[: most - 8]}…{name[-7:]}"


def _label(value: float) -> str:
    return (f"{value:.6g}" if value else "0").replace("-", "\N{MINUS SIGN}")


def standalone(charts: Sequence[Chart]) -> str:
    """Charts below each other as one SVG file."""
    width, gap, y = max(chart.width for chart in charts), 34.0, 0.0
    elements = [tag("style", resource("style.css")), tag("rect", width="100%", height="100%", class_="paper")]
    for chart in charts:
        place = f'<svg x="0" y="{coordinate(y + 20.0)}" width="{coordinate(chart.width)}" '
        elements.append(words(0.0, y + 14.0, chart.caption, "tick"))
        elements.append(chart.svg.replace("<svg ", f'{place}height="{coordinate(chart.height)}" ', 1))
        y += chart.height + gap
    box = f"0 0 {coordinate(width)} {coordinate(y)}"
    return tag("svg", "".join(elements), xmlns="http://www.w3.org/2000/svg", viewBox=box, width=2.0 * width) + "\n"


def resource(name: str) -> str:
    """The text of a file of this folder."""
    return files("fg_calib.report").joinpath(name).read_text(encoding="utf-8")


def write_charts(folder: Path, figures: Mapping[str, Sequence[Chart]]) -> None:
    """Write each figure as an SVG file of its name.

    Raises:
        InputError: The folder cannot be written.
    """
    for name, charts in figures.items():
        write_text(folder / f"{name}.svg", standalone(charts))
