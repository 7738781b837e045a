"""Charts as SVG: dots, lines, boxes and words on two axes, in colours that the page's style sheet sets.

A chart is a caption and its SVG. It stands in the page as it is, or in a file of its own (`standalone`).
"""

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from fg_calib.inputs import Floats, Record, escaped

WIDTH, HEIGHT = 360.0, 230.0
"""Size of an ordinary chart, in its own units; the page stretches it."""

LEFT, RIGHT, TOP, BOTTOM = 52.0, 10.0, 12.0, 40.0
"""Margins of the plot within the chart."""

CELL, LETTER = 14.0, 5.8
"""Size of a row or column that has a name, and width of a letter of the name."""

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
        attributes: By name, a trailing _ removed; numbers are coordinates, in few characters.
    """
    plain = (escape(escaped(v)) if isinstance(v, str) else f"{round(v, 1):g}" for v in attributes.values())
    shown = [f' {key.rstrip("_")}="{value}"' for key, value in zip(attributes, plain, strict=True)]
    return f"<{name}{''.join(shown)}>{content}</{name}>"


def title(text: str) -> str:
    """Text that shows when its element is pointed at, and for who cannot see it."""
    return tag("title", escape(escaped(text)))


class Scale(Record):
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

    def ticks(self) -> list[float]:
        """Round values along the axis."""
        width = (self.high - self.low) / 5
        power = 10.0 ** np.floor(np.log10(width))
        step = next(float(power * k) for k in (1.0, 2.0, 5.0, 10.0) if power * k >= width * (1.0 - 1e-9))
        first, last = np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9)
        return [float(k * step) for k in np.arange(first, last + 1.0)]


def limits_of(*values: Any, with_zero: bool = False) -> tuple[float, float]:
    """The lowest and highest finite value, with room around them."""
    every = np.concatenate([np.ravel(np.asarray(v, dtype=np.float64)) for v in values] or [np.zeros(0)])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    if with_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    room = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return (low if with_zero and low == 0.0 else low - room), high + room


def without_outliers(values: Floats) -> Floats:
    """Values, those further than 3 interquartile ranges from the quartiles moved there (Tukey's outer fences)."""
    if not np.isfinite(values).any():
        return values
    low, high = np.nanquantile(values, [0.25, 0.75])
    room = 3.0 * (high - low) or np.inf
    return np.clip(values, low - room, high + room)


def cut(n: int) -> str:
    """The end of a caption, if values lie beyond the axis."""
    return f"; {n} beyond the axis, at its edge" if n else ""


Axis = tuple[float, float] | Sequence[str]
"""Range of an axis: values from a lowest to a highest, or names, whose values are 0, 1, 2 ..."""


class Plot:
    """A plot with axes; marks are added to it, at values.

    Args:
        x: From left to right.
        y: Values from bottom to top, or names from top to bottom.
        names: Titles of the axes, with units.
        height: Of the chart with values from bottom to top.
    """

    def __init__(self, x: Axis, y: Axis, names: tuple[str, str], *, height: float = HEIGHT) -> None:
        columns, rows = ([short(name, 28) for name in axis if isinstance(name, str)] for axis in (x, y))
        left = 10.0 + LETTER * max(map(len, rows)) if rows else LEFT
        bottom = 8.0 + LETTER * max(map(len, columns)) if columns else BOTTOM
        right, foot = WIDTH - RIGHT, TOP + CELL * len(rows) if rows else height - bottom
        right = left + CELL * len(columns) if columns else right
        self._size = right + RIGHT, foot + bottom
        self.x, self.y = _scale(x, left, right), _scale(y, TOP, foot) if rows else _scale(y, foot, TOP)
        self._elements: list[str] = []
        for value, word in enumerate(rows) if rows else _labels(self.y):
            if not rows:
                self.line((self.x.low, self.x.high), value, "grid")
            self._words(left - 5.0, self.y(value) + 3.5, word, "tick end")
        for value, word in enumerate(columns) if columns else _labels(self.x):
            at = self.x(value)
            if columns:
                at, end = at + 3.5, foot + 6.0
                self._words(at, end, word, "tick end", transform=f"rotate(-90 {at:.1f} {end:.1f})")
            else:
                top, kind = (TOP, "grid" if value else "axis") if rows else (foot + 4.0, "axis")
                self._add("line", x1=at, y1=top, x2=at, y2=foot, class_=kind)
                self._words(at, foot + 15.0, word, "tick middle")
        if not rows:
            self._add("line", x1=left, y1=foot, x2=right, y2=foot, class_="axis")
        across, up = 0.5 * (left + right), 0.5 * (TOP + foot)
        self._words(across, foot + bottom - 8.0, names[0], "name middle")
        self._words(11.0, up, names[1], "name middle", transform=f"rotate(-90 11 {up:.1f})")

    def chart(self, caption: str) -> Chart:
        """The plot with a caption."""
        width, height = self._size
        svg = tag("svg", title(caption) + "".join(self._elements), viewBox=f"0 0 {width:g} {height:g}", role="img")
        return Chart(caption, svg, width, height)

    def _add(self, name: str, content: str = "", **attributes: str | float) -> None:
        self._elements.append(tag(name, content, **attributes))

    def _words(self, x: float, y: float, text: str, kind: str, **attributes: str) -> None:
        self._add("text", escape(escaped(text)), x=x, y=y, class_=kind, **attributes)

    def line(self, x: tuple[float, float], y: float, kind: str) -> None:
        """A line from left to right at a height."""
        self._add("line", x1=self.x(x[0]), y1=self.y(y), x2=self.x(x[1]), y2=self.y(y), class_=kind)

    def dots(self, x: Floats, y: Floats, kind: str) -> None:
        """A dot at each pair of finite values."""
        good = np.isfinite(x) & np.isfinite(y)
        at = np.column_stack([self.x(x[good]), self.y(y[good])])
        if len(at):
            at = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), MAX_DOTS)).astype(np.int64))]
            path = "".join([f"M{a:g} {b:g}h0" for a, b in np.round(at, 1).tolist()])
            self._add("path", d=path, class_=f"dots {kind}")

    def ring(self, x: float, y: float, text: str) -> None:
        """A ring about a dot; its text shows when it is pointed at."""
        self._add("circle", title(text), cx=self.x(x), cy=self.y(y), r=5.0, class_="ring")

    def curve(self, x: Floats, y: Floats, kind: str = "curve") -> None:
        """A curve through values, or the area within it."""
        points = zip(self.x(x).tolist(), self.y(y).tolist(), strict=True)
        self._add("path", d="M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in points), class_=kind)

    def box(self, x: tuple[float, float], y: tuple[float, float], about: str = "", **attributes: str) -> None:
        """A rectangle between values; what it is about shows when it is pointed at."""
        (left, right), (top, bottom) = sorted(map(self.x, x)), sorted(map(self.y, y))
        size = {"x": left, "y": top, "width": right - left, "height": bottom - top}
        self._add("rect", title(about) if about else "", **size, **attributes)


def _scale(axis: Axis, start: float, end: float) -> Scale:
    low, high = (-0.5, len(axis) - 0.5) if isinstance(axis[0], str) else axis
    return Scale(float(low), float(high), start, end)


def _labels(scale: Scale) -> list[tuple[float, str]]:
    """Round values along an axis, and what stands at them."""
    return [(value, f"{value:.6g}".replace("-", "\N{MINUS SIGN}") if value else "0") for value in scale.ticks()]


def short(name: str, most: int) -> str:
    """A name in few characters: its end distinguishes it from others, such as `.x`."""
    return name if len(name) <= most else f"{name[: most - 8]}…{name[-7:]}"


def standalone(charts: Sequence[Chart]) -> str:
    """Charts below each other as one SVG file."""
    y, elements = 0.0, [tag("style", resource("style.css")), tag("rect", width="100%", height="100%", class_="paper")]
    for chart in charts:
        place = f'<svg x="0" y="{y + 20.0:g}" width="{chart.width:g}" height="{chart.height:g}" '
        elements.append(tag("text", escape(escaped(chart.caption)), x=0.0, y=y + 14.0, class_="tick"))
        elements.append(chart.svg.replace("<svg ", place, 1))
        y += chart.height + 34.0
    width = max(chart.width for chart in charts)
    box, space = f"0 0 {width:g} {y:g}", "http://www.w3.org/2000/svg"
    return tag("svg", "".join(elements), xmlns=space, viewBox=box, width=2.0 * width) + "\n"


def resource(name: str) -> str:
    """The text of a file of this folder."""
    return files("fg_calib.report").joinpath(name).read_text(encoding="utf-8")
