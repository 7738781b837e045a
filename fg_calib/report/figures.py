"""Figures of identifiability: the spectrum, what moves together, and what is correlated.

Each function returns a matplotlib `Figure` of its own with a canvas that needs no display; pyplot and its global state
take no part. matplotlib is imported where it is used, so that who draws nothing does not wait for it.

References:
    Okabe & Ito (2008), Color Universal Design: the two colours, which differ in lightness too.
"""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.libraries import without_settings
from fg_calib.observability.identifiability import Identifiability
from fg_calib.observability.indices import CORRELATED, WEAK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

FIGURES = ("spectrum.png", "groups.png", "correlations.png")
"""What `write_figures` may write."""

KEPT, LOST = "#0072B2", "#D55E00"
GREY, PALE = "0.45", "0.93"

NEAR_ZERO = 1e-18
"""Singular values below this part of the largest, most of them exactly zero, are drawn there: a log axis has no 0."""

_DPI = 160
_FAINTER = 1.5  # ends of the colours of `draw_groups`, whose +1 and -1 would be nearly black
_SMALL, _TEXT, _TITLE = 7.0, 8.0, 9.0


def write_figures(folder: Path, found: Identifiability) -> None:
    """Write `spectrum.png`, `groups.png` if anything is lost, and `correlations.png` if practical, into a folder."""
    draw_spectrum(found).savefig(folder / FIGURES[0], dpi=_DPI)
    if found.lost:
        draw_groups(found).savefig(folder / FIGURES[1], dpi=_DPI)
    if found.kind == "practical" and found.observability.kept:
        draw_correlations(found).savefig(folder / FIGURES[2], dpi=_DPI)


def draw_spectrum(found: Identifiability) -> Figure:
    """Singular values on a log axis, kept and lost, with the gap between them.

    Those of a structural analysis are relative to the largest, for its noise is arbitrary; those of a practical one are
    signal-to-noise ratios, and a line shows where they become weak. Values below `NEAR_ZERO` stand on the lowest tick.
    """
    o, practical = found.observability, found.kind == "practical"
    largest = float(o.singular_values[0]) or 1.0
    unit = 1.0 if practical else largest
    floor = NEAR_ZERO * largest / unit
    values = o.singular_values / unit
    n, rank = len(values), o.rank
    number = np.arange(1, n + 1)
    kept, zero = number <= rank, values < floor
    weak = kept & practical & (values < WEAK)
    figure, axes = _figure(5.6, 3.6)
    axes.set_yscale("log")
    for chosen, marker, colour, face, label in (
        (kept & ~weak, "o", KEPT, KEPT, f"determined: {rank - int(weak.sum())}"),
        (weak, "o", KEPT, "white", f"determined, but weak: {int(weak.sum())}"),
        (~kept & ~zero, "s", LOST, LOST, f"lost: {int(np.sum(~kept & ~zero))}"),
        (~kept & zero, "v", LOST, LOST, f"lost, zero: {int(np.sum(~kept & zero))}"),
    ):
        if chosen.any():
            shown = np.maximum(values[chosen], floor)
            line = axes.plot(number[chosen], shown, marker, color=colour, markersize=4.5, label=label)[0]
            line.set_markerfacecolor(face)
    if 0 < rank < n:
        _show_gap(axes, (float(values[rank - 1]), max(float(values[rank]), floor)), rank, n, o.gap)
    if practical:
        axes.axhline(WEAK, color=GREY, linewidth=0.9, linestyle="--")
        axes.annotate(
            f"weak below {WEAK:g}",
            (0.0, WEAK),
            (3, -3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            va="top",
            color=GREY,
            fontsize=_SMALL,
        )
    axes.set_xlim(0.0, n + 1.0)
    if not rank:
        axes.set_ylim(floor / 10.0, 1.0)
    axes.set_xlabel("number of the singular value", fontsize=_TEXT)
    axes.set_ylabel("signal-to-noise ratio" if practical else "singular value / largest", fontsize=_TEXT)
    axes.legend(frameon=False, fontsize=_SMALL, loc="lower left" if 0 < rank < n else "upper right")
    _title(axes, f"What is determined: rank {rank} of {n}", found)
    return figure


def draw_groups(found: Identifiability) -> Figure:
    """Which parameters move together unseen: a row for each lost direction, a column for each parameter in one.

    Rows with the same reason stand together; a reason is cut to its first words. Cells hold the change of each
    parameter, [m] and [rad], the largest of a row being 1 in size. Names in grey are fixed in the robot's file.
    """
    o = found.observability
    rows = [(_short(lost.reason), lost.relation) for lost in found.lost]
    reasons = list(dict.fromkeys(reason for reason, _ in rows))
    rows.sort(key=lambda row: reasons.index(row[0]))
    involved = {name for _, relation in rows for name in relation}
    names = [name for name in o.names if name in involved]
    changes = np.full((len(rows), len(names)), np.nan)
    for i, (_, relation) in enumerate(rows):
        for name, change in relation.items():
            changes[i, names.index(name)] = change
    figure, axes = _figure(2.7 + 0.30 * max(len(names), 6), 1.35 + 0.30 * max(len(rows), 2))
    _draw_cells(axes, changes, "PuOr", _FAINTER)
    for (i, j), change in np.ndenumerate(changes):
        if np.isfinite(change):
            ink = "white" if abs(change) > 0.85 else "black"
            axes.text(j, i, _cell(change), ha="center", va="center", fontsize=6, color=ink)
    _name_columns(axes, names, found.fixed)
    first = [next(i for i, row in enumerate(rows) if row[0] == reason) for reason in reasons]
    for start, end, reason in zip(first, [*first[1:], len(rows)], reasons, strict=True):
        axes.text(
            -0.015,
            (start + end - 1) / 2,
            _balanced(reason),
            transform=axes.get_yaxis_transform(),
            ha="right",
            va="center",
            fontsize=_SMALL,
        )
        if start:
            axes.axhline(start - 0.5, color=GREY, linewidth=0.8)
    axes.set_yticks([])
    grey = "; grey: fixed in the robot's file" if involved & set(found.fixed) else ""
    axes.set_xlabel(f"change of each parameter [m], [rad], the largest of a row being 1{grey}", fontsize=_TEXT)
    _title(axes, f"What moves unseen: {len(rows)} of {len(o.names)} directions lost", found)
    return figure


def draw_correlations(found: Identifiability) -> Figure:
    """Correlations of the kept parameters, the others held at nominal; a dot where they are above `CORRELATED`.

    Raises:
        ValueError: The analysis is structural: its noise is arbitrary, and so would the correlations be.
    """
    if found.kind != "practical":
        raise ValueError("a structural analysis has no correlations: its noise is arbitrary")
    o = found.observability
    n = len(o.kept)
    below = np.where(np.tri(n, k=-1, dtype=np.bool_), o.correlation, np.nan)
    side = 1.9 + 0.2 * max(n, 10)
    figure, axes = _figure(side + 0.7, side)
    image = _draw_cells(axes, below, "RdBu")
    with np.errstate(invalid="ignore"):
        strong = np.argwhere(np.abs(below) > CORRELATED)
    axes.plot(strong[:, 1], strong[:, 0], "o", color="white", markersize=2.5)
    _name_columns(axes, o.kept, ())
    axes.set_yticks(range(n), o.kept, fontsize=_SMALL)
    bar = figure.colorbar(image, ax=axes, shrink=0.6, aspect=24, pad=0.02)
    bar.set_label("correlation", fontsize=_TEXT)
    bar.ax.tick_params(labelsize=_SMALL)
    dots = f"{len(strong)} above {CORRELATED:g} in size (dots)" if len(strong) else f"none above {CORRELATED:g} in size"
    _title(axes, f"Correlations of {n} kept parameters: {dots}", found)
    return figure


def _show_gap(axes: Axes, ends: tuple[float, float], rank: int, n: int, ratio: float) -> None:
    """The range without singular values, and how wide it is."""
    above, below = ends
    axes.axhspan(below, above, color=PALE, linewidth=0.0, zorder=0)
    right = rank > n / 2
    x = rank + 0.5
    axes.annotate("", (x, below), (x, above), arrowprops={"arrowstyle": "<->", "color": GREY, "linewidth": 0.9})
    text = f"gap {_power(ratio)}" if np.isfinite(ratio) else "gap: what is lost is 0"
    axes.annotate(
        text,
        (x, float(np.sqrt(above * below))),
        (-5 if right else 5, 0),
        textcoords="offset points",
        ha="right" if right else "left",
        va="center",
        fontsize=_TEXT,
    )


def _power(ratio: float) -> str:
    """A ratio in two digits: `2.5`, `9.3 x 10^13` with a proper sign and exponent."""
    if ratio < 1e3:
        return f"{ratio:.2g}"
    digits, exponent = f"{ratio:.1e}".split("e")
    return rf"${digits} \times 10^{{{int(exponent)}}}$"


def _short(reason: str) -> str:
    """The first words of a reason, which tell it from the others; its explanation is in the report."""
    return re.split(r": |, (?=unseen|which)", reason)[0]


def _balanced(text: str) -> str:
    """Text in lines of at most 30 characters that are about equally long."""
    lines = len(wrap(text, 30))
    return "\n".join(next(w for k in range(30) if len(w := wrap(text, max(1, len(text) // lines) + k)) <= lines))


def _cell(change: float) -> str:
    """A change in few characters, with a minus as long as its plus: `+1`, `\N{MINUS SIGN}0.5`."""
    digits = f"{abs(change):.2g}" if abs(change) >= 0.01 else f"{abs(change):.0e}".replace("e-0", "e-")
    return ("+" if change > 0 else "\N{MINUS SIGN}") + digits.replace("0.", ".")


def empty_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches, with a canvas that needs no display."""
    with without_settings("matplotlibrc", "MPLBACKEND or MPLCONFIGDIR"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    """The same with axes."""
    figure = empty_figure(width, height)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=_SMALL)
    return figure, axes


def _draw_cells(axes: Axes, values: Floats, colours: str, end: float = 1.0) -> Any:
    """A diverging heat map from -`end` to `end` with fine lines between the cells; what is nan stays white."""
    image = axes.imshow(values, cmap=colours, vmin=-end, vmax=end, aspect="equal", interpolation="nearest")
    axes.spines[:].set_visible(False)
    axes.set_xticks(np.arange(-0.5, values.shape[1]), minor=True)
    axes.set_yticks(np.arange(-0.5, values.shape[0]), minor=True)
    axes.grid(which="minor", color=PALE, linewidth=0.5)
    axes.tick_params(which="both", length=0)
    return image


def _name_columns(axes: Axes, names: list[str], fixed: tuple[str, ...]) -> None:
    """Names under the columns, upright; those of fixed parameters in grey."""
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=_SMALL)
    for label in axes.get_xticklabels():
        if label.get_text() in fixed:
            label.set_color("0.55")


def _title(axes: Axes, statement: str, found: Identifiability) -> None:
    """What the figure shows, and of which robot, model and kind of analysis."""
    random = "random " if found.kind == "structural" else ""
    about = f"{found.robot}, {found.model}, {found.kind}, {found.n_configurations} {random}configurations"
    axes.figure.suptitle(f"{statement}\n{about}", fontsize=_TITLE)
