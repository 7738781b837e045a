"""A history of runs: a table for the terminal, and a picture of parameters with their sigmas over time."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType

from fg_calib.diagnostics.verdict import probability
from fg_calib.io.atomic import fill_folder
from fg_calib.io.history import SCHEMA, History, Run
from fg_calib.report.figures import empty_figure
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import line, plain_table, section

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_DRAWN = 12
"""Parameters in the picture: those that changed most, in sigma."""

FILES = {"history.svg": b"<?xml", "history.png": b"\x89PNG"}
"""What `write_history` writes, and how it begins."""


def history_document(history: History) -> dict[str, Any]:
    """A history for programs, in [m] and [rad]: what `history.json` holds."""
    return {"schema": SCHEMA, **history.model_dump(mode="json", exclude={"schema_"})}


def build_history(history: History) -> RenderableType:
    """A history for the terminal."""
    table = plain_table(
        *(("date", "left"), ("residuals", "right"), ("chi-square", "right"), ("of", "right"), ("p-value", "right")),
        *(("", "left"), ("changed most", "left"), ("by", "right"), ("in sigma", "right")),
    )
    for run in history.runs:
        p = "" if run.p_value is None else probability(run.p_value)
        chi2 = "" if run.chi2 is None else f"{run.chi2:.6g}"
        table.add_row(run.date[:10], str(run.n_residuals), chi2, str(run.dof), p, run.verdict, *_moved(run))
    n = len(history.runs)
    return Group(line(f"{history.robot}: {n} run{'s' * (n > 1)}", "bold"), *section("Runs", table))


def _moved(run: Run) -> tuple[str, str, str]:
    if run.moved is None:
        return "", "", ""
    factor, unit, decimals = SHOWN[run.parameters[run.moved.name].unit]
    in_sigma = "unknown" if run.moved.in_sigma is None else f"{run.moved.in_sigma:.1f}"
    return run.moved.name, f"{run.moved.change * factor:+.{decimals}f} {unit}", in_sigma


def draw_history(history: History) -> Figure:
    """Parameters with 1 sigma over time, those first that changed most since the first run, in its sigma."""
    runs, names = history.runs, _most_changed(history)
    columns = min(4, max(1, len(names)))
    rows = -(-len(names) // columns)
    figure = empty_figure(2.4 * columns, 0.4 + 1.9 * rows)
    dates = [_when(run.date) for run in runs]
    days = np.array([(d - dates[0]).total_seconds() / 86400.0 for d in dates])
    at, label = (
        (days, "days") if days[-1] > 0.0 and np.all(np.diff(days) > 0.0) else (np.arange(1, len(runs) + 1), "run")
    )
    for i, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, i + 1)
        known = [run.parameters.get(name) for run in runs]
        there = [k for k, one in enumerate(known) if one is not None]
        factor, unit, _ = SHOWN[next(one.unit for one in known if one is not None)]
        first = known[there[0]]
        assert first is not None
        off = [(one.estimate - first.estimate) * factor for one in known if one is not None]
        sigma = [(one.sigma or 0.0) * factor for one in known if one is not None]
        axes.axhline(0.0, color="0.8", linewidth=0.8)
        axes.errorbar(at[there], off, yerr=sigma, fmt="o-", color="#0072B2", markersize=3.5, capsize=2, linewidth=1.0)
        axes.set_title(f"{name} [{unit}]", fontsize=8)
        axes.set_xlabel(label, fontsize=7)
        if label == "run":
            axes.set_xticks(at)
        axes.tick_params(labelsize=6.5)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{history.robot}: change since {runs[0].date[:10]}, with 1 sigma", fontsize=9)
    return figure


def _when(date: str) -> datetime:
    found = datetime.fromisoformat(date or "1970-01-01")  # of results of version 1 no date is known
    return found if found.tzinfo else found.replace(tzinfo=UTC)


def _most_changed(history: History) -> list[str]:
    first, *later = history.runs
    size = {}
    for name, one in first.parameters.items():
        moves = [abs(run.parameters[name].estimate - one.estimate) for run in later if name in run.parameters]
        size[name] = max(moves, default=0.0) / one.sigma if one.sigma else 0.0
    return sorted(size, key=lambda name: -size[name])[:MOST_DRAWN]


def write_history(folder: Path, history: History) -> None:
    """Write `history.svg` and `history.png` into a folder.

    Raises:
        InputError: The folder cannot be written.
    """
    figure = draw_history(history)

    def write(into: Path) -> None:
        figure.savefig(into / "history.svg", metadata={"Date": None})
        figure.savefig(into / "history.png", dpi=160)

    fill_folder(folder, write, FILES)
