"""The expected error over the workspace as a picture: horizontal slices, and height over the distance from the axis.

matplotlib is imported where it is used, so that who draws nothing does not wait for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.prediction.prediction import PredictedErrors
from fg_calib.prediction.workspace import LEAST_WIDTH
from fg_calib.report.figures import LOST, empty_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

CELLS = 22
"""Cells along each side of a slice."""

SLAB = 0.12
"""Thickness of a horizontal slice, in the width of the workspace."""

HEIGHTS = (0.2, 0.5, 0.8)
"""At which quantiles of the heights that the tool reaches slices are."""

_ENDS = (0.02, 0.98)
"""Quantiles of the cells' errors at the ends of the colours."""

_DPI = 160
_SMALL, _TEXT, _TITLE = 7.0, 8.0, 9.0
_UNKNOWN = "0.82"


@dataclass(frozen=True)
class Slice:
    """RMS of the expected errors of the configurations in each cell of a slice.

    Attributes:
        title: What it is.
        names: Of its axes.
        x: Edges of the cells from left to right, shape (n + 1,), [m].
        y: Edges from bottom to top, shape (m + 1,), [m].
        error: RMS of the errors, shape (n, m), [m]; nan in cells that no configuration comes to.
        unknown: Whether nothing is known in a cell that configurations come to, shape (n, m).
        measured: What was measured in it, shape (k, 2), [m].
        worst: Where the error is largest, shape (2,), [m]; None where that is not in it.
    """

    title: str
    names: tuple[str, str]
    x: Floats
    y: Floats
    error: Floats
    unknown: NDArray[np.bool_]
    measured: Floats
    worst: Floats | None


def slices_of(found: PredictedErrors) -> tuple[Slice, ...]:
    """Three horizontal slices from below to above, and height over distance from the base's z axis.

    Args:
        found: A prediction over the workspace.
    """
    p, error = found.errors.position, found.expected[:, 0]
    low, high = p.min(axis=0), p.max(axis=0)
    width = max(float((high - low).max()), LEAST_WIDTH)
    thick, middle = SLAB * width, 0.5 * (low + high)
    edges = [np.linspace(m - 0.5 * width, m + 0.5 * width, CELLS + 1) for m in middle]
    worst = None if found.worst is None else found.worst.errors.position[0]
    slices = []
    for height in np.quantile(p[:, 2], HEIGHTS).tolist():
        inside, near = (np.abs(at[:, 2] - height) <= 0.5 * thick for at in (p, found.measured))
        cells, unknown = _cells(p[inside, :2], error[inside], edges[0], edges[1])
        at = worst[:2] if worst is not None and abs(worst[2] - height) <= 0.5 * thick else None
        title = f"z = {height:.2f} m ± {0.5 * thick:.2g} m".replace("-", "\N{MINUS SIGN}")
        names = ("x [m]", "y [m]")
        slices.append(Slice(title, names, edges[0], edges[1], cells, unknown, found.measured[near, :2], at))
    radial, z = _radial(p), edges[2]
    r = np.arange(CELLS + 1) * (z[1] - z[0])
    r = r[: max(int(np.searchsorted(r, radial[:, 0].max())), 1) + 1]
    cells, unknown = _cells(radial, error, r, z)
    at = None if worst is None else _radial(worst[None])[0]
    names = ("distance from the z axis [m]", "z [m]")
    return (*slices, Slice("all around the z axis", names, r, z, cells, unknown, _radial(found.measured), at))


def _radial(points: Floats) -> Floats:
    """Distance from the z axis and height of points, shape (n, 2)."""
    return np.column_stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]])


def _cells(at: Floats, error: Floats, x: Floats, y: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """RMS of errors in cells, and which cells hold none that is known."""
    known = np.isfinite(error)
    n, _, _ = np.histogram2d(at[:, 0], at[:, 1], (x, y))
    of_known, _, _ = np.histogram2d(at[known, 0], at[known, 1], (x, y))
    squares, _, _ = np.histogram2d(at[known, 0], at[known, 1], (x, y), weights=error[known] ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(squares / of_known), (n > 0) & (of_known == 0)


def draw_slices(found: PredictedErrors, robot: str) -> Figure:
    """Slices of the expected position error, on one scale in mm.

    Args:
        found: A prediction over the workspace.
        robot: Its name.
    """
    slices = slices_of(found)
    known = np.concatenate([one.error[np.isfinite(one.error)] for one in slices]) * 1e3
    low, high = np.quantile(known, _ENDS).tolist() if len(known) else (0.0, 1.0)
    figure = empty_figure(8.6, 7.6)
    image = None
    for axes, one in zip(figure.subplots(2, 2).ravel(), slices, strict=True):
        image = _draw(axes, one, (low, high if high > low else low + 1e-9))
    if len(known) and image is not None:
        bar = figure.colorbar(image, ax=figure.axes, shrink=0.75, aspect=32, extend="both")
        bar.set_label("expected error of the tool's position (RMS) [mm]", fontsize=_TEXT)
        bar.ax.tick_params(labelsize=_SMALL)
    where = "after the best rigid fit" if found.fitted else "in the base frame"
    n = len(found.errors.readings)
    figure.suptitle(f"{robot}: expected error, {where}, at {n} configurations within the joint limits", fontsize=_TITLE)
    _explain(figure, found)
    return figure


def _draw(axes: Axes, one: Slice, ends: tuple[float, float]) -> Any:
    """One slice; its coloured cells are returned."""
    from matplotlib.colors import ListedColormap

    grey = np.where(one.unknown, 1.0, np.nan)
    axes.pcolormesh(one.x, one.y, grey.T, cmap=ListedColormap([_UNKNOWN]), linewidth=0.0, rasterized=True)
    image = axes.pcolormesh(
        one.x, one.y, one.error.T * 1e3, cmap="viridis", vmin=ends[0], vmax=ends[1], linewidth=0.0, rasterized=True
    )
    axes.plot(*one.measured.T, "o", color="white", markeredgecolor="black", markeredgewidth=0.5, markersize=2.6)
    if one.worst is not None:
        for colour, wide in (("white", 3.6), (LOST, 2.0)):
            axes.plot(*one.worst, "x", color=colour, markersize=9.0, markeredgewidth=wide, clip_on=False, zorder=5)
    axes.set_aspect("equal", anchor="W")
    axes.set_title(one.title, fontsize=_TEXT)
    axes.set_xlabel(one.names[0], fontsize=_TEXT)
    axes.set_ylabel(one.names[1], fontsize=_TEXT)
    axes.tick_params(labelsize=_SMALL)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(one.x[0], one.x[-1])
    axes.set_ylim(one.y[0], one.y[-1])
    return image


def _explain(figure: Figure, found: PredictedErrors) -> None:
    """What the marks mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    marks: list[Any] = [
        Line2D([], [], marker="o", linestyle="", color="white", markeredgecolor="black", markersize=4.0)
    ]
    marks[0].set_label("measured")
    if found.worst is not None:
        size = found.worst.errors.of(found.fitted)[0, 0] * 1e3
        marks.append(Line2D([], [], marker="x", linestyle="", color=LOST, markersize=7.0, markeredgewidth=2.0))
        marks[-1].set_label(f"largest: {size:.3g} mm")
    if found.unknown > 0.0:
        marks.append(Patch(color=_UNKNOWN, label="not known: nothing determines it"))
    figure.legend(handles=marks, loc="outside lower center", ncols=len(marks), frameon=False, fontsize=_TEXT)


def write_slices(folder: Path, found: PredictedErrors, robot: str) -> None:
    """Write `predict.png` and `predict.svg` into a folder."""
    from matplotlib import rc_context

    figure = draw_slices(found, robot)
    figure.savefig(folder / "predict.png", dpi=_DPI)
    with rc_context({"svg.hashsalt": "fg-calib"}):  # the same file of the same result
        figure.savefig(folder / "predict.svg", metadata={"Date": None}, dpi=_DPI)
