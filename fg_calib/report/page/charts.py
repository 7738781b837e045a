"""Charts as SVG that takes its colours from the page: few kinds, each small enough for a phone.

matplotlib draws the figures of `observe`; here charts change with the page's theme, have text that can be selected, and
take a tenth of the room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.report.page.markup import add, figure, tag

if TYPE_CHECKING:
    from lxml.etree import _Element as Element

Floats = NDArray[np.float64]

WIDTH, HEIGHT = 360.0, 230.0
"""Of an ordinary chart, in its own units; the page stretches it."""

LEFT, RIGHT, TOP, BOTTOM = 52.0, 10.0, 12.0, 40.0
"""Margins of the plot within it."""

MOST_DOTS = 1500
"""Dots that a chart shows; of more, so many that are evenly spaced."""

RAMP = ("#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725")
"""Colours from low to high that differ in lightness too: samples of viridis (van der Walt & Smith, 2015)."""


@dataclass(frozen=True)
class Scale:
    """Figures along one axis of a chart.

    Attributes:
        low: The figure at `start`.
        high: The figure at `end`.
        start: Its coordinate.
        end: The other's coordinate.
    """

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: Any) -> Any:
        """The coordinate of a figure, or of an array of them."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self, most: int = 5) -> list[float]:
        """Round figures along the axis."""
        width = (self.high - self.low) / most
        power = 10.0 ** np.floor(np.log10(width))
        step = next(float(power * k) for k in (1.0, 2.0, 5.0, 10.0) if power * k >= width * (1.0 - 1e-9))
        first, last = np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9)
        return [float(k * step) for k in np.arange(first, last + 1.0)]


def limits_of(*values: Any, around: float = 0.05, with_zero: bool = False) -> tuple[float, float]:
    """The lowest and highest finite figure, with room around them."""
    every = np.concatenate([np.ravel(np.asarray(v, dtype=np.float64)) for v in values] or [np.zeros(0)])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    if with_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    room = around * (high - low) or around * abs(high) or 1.0
    return (low if with_zero and low == 0.0 else low - room), high + room


class Chart:
    """A plot with axes; marks are added to it.

    Args:
        x: Lowest and highest figure from left to right.
        y: Those from bottom to top.
        names: What the axes show, with units.
        about: What the chart shows, for who cannot see it.
        size: Width and height.
    """

    def __init__(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        names: tuple[str, str],
        about: str,
        size: tuple[float, float] = (WIDTH, HEIGHT),
    ) -> None:
        width, height = size
        self.x = Scale(*x, LEFT, width - RIGHT)
        self.y = Scale(*y, height - BOTTOM, TOP)
        self.svg = tag("svg", tag("title", about), viewBox=f"0 0 {figure(width)} {figure(height)}", role="img")
        middle = 0.5 * (self.y.start + self.y.end)
        for value in self.y.ticks():
            at = self.y(value)
            self.line(self.x.start, at, self.x.end, at, "grid")
            self.text(self.x.start - 5.0, at + 3.5, _label(value), "tick end")
        for value in self.x.ticks():
            at = self.x(value)
            self.line(at, self.y.start, at, self.y.start + 4.0, "axis")
            self.text(at, self.y.start + 15.0, _label(value), "tick middle")
        self.line(self.x.start, self.y.start, self.x.end, self.y.start, "axis")
        self.text(0.5 * (self.x.start + self.x.end), height - 8.0, names[0], "name middle")
        turned = f"rotate(-90 11 {figure(middle)})"
        add(self.svg, tag("text", names[1], x=11.0, y=middle, class_="name middle", transform=turned))

    def line(self, x1: float, y1: float, x2: float, y2: float, kind: str) -> None:
        """A line between coordinates."""
        add(self.svg, tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=kind))

    def text(self, x: float, y: float, text: str, kind: str) -> None:
        """Text at coordinates."""
        add(self.svg, tag("text", text, x=x, y=y, class_=kind))

    def level(self, y: float, kind: str = "level") -> None:
        """A line from left to right at a figure."""
        self.line(self.x.start, self.y(y), self.x.end, self.y(y), kind)

    def dots(self, x: Floats, y: Floats, kind: str) -> None:
        """A dot at each pair of finite figures."""
        good = np.isfinite(x) & np.isfinite(y)
        at = np.column_stack([self.x(x[good]), self.y(y[good])])
        at = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), MOST_DOTS)).astype(np.int64))] if len(at) else at
        if len(at):
            path = "".join(f"M{figure(a)} {figure(b)}h0" for a, b in at.tolist())
            add(self.svg, tag("path", d=path, class_=f"dots {kind}"))

    def marked(self, x: float, y: float, words: str) -> None:
        """A ring about a dot; words that show when it is pointed at."""
        add(self.svg, tag("circle", tag("title", words), cx=self.x(x), cy=self.y(y), r=5.0, class_="ring"))

    def curve(self, x: Floats, y: Floats, kind: str) -> None:
        """A curve through figures."""
        path = "M" + "L".join(f"{figure(a)} {figure(b)}" for a, b in zip(self.x(x), self.y(y), strict=True))
        add(self.svg, tag("path", d=path, class_=kind))

    def box(self, x1: float, y1: float, x2: float, y2: float, **attributes: str) -> None:
        """A rectangle between figures."""
        (left, right), (top, bottom) = sorted((self.x(x1), self.x(x2))), sorted((self.y(y1), self.y(y2)))
        add(self.svg, tag("rect", x=left, y=top, width=right - left, height=bottom - top, **attributes))


def bars(rows: Sequence[tuple[str, Sequence[tuple[str, float, str]]]], about: str) -> Element:
    """Groups of horizontal bars, each with its own scale, the last of a group in colour.

    Args:
        rows: Name of a group, and its bars: what each is, its length, and its figure in words.
        about: What the chart shows.
    """
    bar, gap, first = 17.0, 13.0, 18.0
    height = sum(first + len(group) * bar + gap for _, group in rows)
    svg = tag("svg", tag("title", about), viewBox=f"0 0 {figure(WIDTH)} {figure(height)}", role="img")
    y = 0.0
    for name, group in rows:
        add(svg, tag("text", name, x=0.0, y=y + 12.0, class_="name"))
        most = max((length for _, length, _ in group if np.isfinite(length)), default=0.0) or 1.0
        y += first
        for i, (what, length, words) in enumerate(group, start=1):
            wide = 165.0 * length / most if np.isfinite(length) else 0.0
            kind = "after" if i == len(group) else "before"
            add(svg, tag("text", what, x=72.0, y=y + 12.0, class_="tick end"))
            add(svg, tag("rect", x=78.0, y=y + 2.0, width=max(wide, 1.0), height=bar - 5.0, class_=f"bar {kind}"))
            add(svg, tag("text", words, x=84.0 + wide, y=y + 12.0, class_="tick"))
            y += bar
        y += gap
    return svg


ROW = 15.0
"""Height of a row of `whiskers`."""

_NAMES = 92.0
"""Where rows begin, to the right of their names."""

Whisker = tuple[str, float, float, float]
"""Name, figure, its sigma (nan: not known), and its tolerance (nan: none)."""


def whiskers(rows: Sequence[Whisker], about: str, name: str) -> Element:
    """A row each with a dot, a line of one sigma to both sides, and a pale band of the tolerance.

    Args:
        rows: What is shown.
        about: What the chart shows.
        name: What the figures are.
    """
    height = TOP + BOTTOM + ROW * len(rows)
    value, sigma, tolerance = (np.array([row[i] for row in rows]) for i in (1, 2, 3))
    spread = np.nan_to_num(sigma)
    x = Scale(*limits_of(value - spread, value + spread, [0.0], tolerance, -tolerance), _NAMES, WIDTH - RIGHT)
    svg = tag("svg", tag("title", about), viewBox=f"0 0 {figure(WIDTH)} {figure(height)}", role="img")
    for tick in x.ticks():
        at, bottom = x(tick), height - BOTTOM
        add(svg, tag("line", x1=at, y1=TOP, x2=at, y2=bottom, class_="axis" if tick == 0.0 else "grid"))
        add(svg, tag("text", _label(tick), x=at, y=bottom + 15.0, class_="tick middle"))
    add(svg, tag("text", name, x=0.5 * (_NAMES + WIDTH), y=height - 8.0, class_="name middle"))
    for i, row in enumerate(rows):
        _draw_whisker(svg, x, TOP + ROW * (i + 0.5), row)
    return svg


def _draw_whisker(svg: Element, x: Scale, y: float, row: Whisker) -> None:
    name, value, sigma, tolerance = row
    add(svg, tag("text", short(name), x=_NAMES - 6.0, y=y + 3.5, class_="tick end"))
    if np.isfinite(tolerance):
        left, right = x(-tolerance), x(tolerance)
        add(svg, tag("rect", x=left, y=y - 6.0, width=right - left, height=12.0, class_="band"))
    known = np.isfinite(sigma)
    if known:
        add(svg, tag("line", x1=x(value - sigma), y1=y, x2=x(value + sigma), y2=y, class_="whisker"))
    add(svg, tag("path", d=f"M{figure(x(value))} {figure(y)}h0", class_=f"dots large {'a' if known else 'b'}"))


def matrix(names: Sequence[str], values: Floats, about: str) -> Element:
    """A correlation matrix below its diagonal: blue where negative, orange where positive, strong where large."""
    n, cell, side = len(names), 14.0, 78.0
    width = side + cell * n + 6.0
    svg = tag("svg", tag("title", about), viewBox=f"0 0 {figure(width)} {figure(width)}", role="img")
    for i, name in enumerate(names):
        y = 2.0 + cell * (i + 1)
        add(svg, tag("text", short(name), x=side - 4.0, y=y - 3.5, class_="tick end"))
        x, foot = side + cell * (i + 0.5) + 3.0, 6.0 + cell * n
        turned = f"rotate(-90 {figure(x)} {figure(foot)})"
        add(svg, tag("text", short(name), x=x, y=foot, class_="tick end", transform=turned))
        for j in range(i):
            rho = values[i, j]
            if np.isfinite(rho) and abs(rho) > 0.02:
                add(
                    svg,
                    tag(
                        "rect",
                        tag("title", f"{name}, {names[j]}: {rho:+.2f}") if abs(rho) > 0.5 else None,
                        x=side + cell * j,
                        y=y - cell,
                        width=cell - 1.0,
                        height=cell - 1.0,
                        class_="plus" if rho > 0.0 else "minus",
                        opacity=f"{min(1.0, abs(rho)):.2f}",
                    ),
                )
    return svg


def colour(share: float) -> str:
    """The colour of a share of the ramp, 0 to 1."""
    return RAMP[int(np.clip(share * len(RAMP), 0, len(RAMP) - 1))]


def _label(value: float) -> str:
    text = f"{value:.6g}" if value else "0"
    return text.replace("-", "\N{MINUS SIGN}")


def short(name: str, most: int = 14) -> str:
    """A name in few characters: its end tells it from others, such as `.x`."""
    return name if len(name) <= most else f"{name[: most - 8]}…{name[-7:]}"
