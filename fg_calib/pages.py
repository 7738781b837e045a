"""Saved calibrations as pages: read from their folders, written as one file of HTML each."""

from __future__ import annotations

from pathlib import Path

from fg_calib.arguments import checked
from fg_calib.calibration import Calibration
from fg_calib.io.atomic import is_folder
from fg_calib.io.saved import read_configurations, read_residuals, require_unchanged
from fg_calib.report.page.figures import figures_of
from fg_calib.report.page.page import write_figures, write_page
from fg_calib.report.page.run import Run, written_at


def load_run(path: Path | str) -> Run:
    """All that the folder of a calibration holds, for a page.

    Raises:
        InputError: There is none, or it is damaged.
    """
    found = Calibration.load(path)
    folder = Path(path) if is_folder(Path(path)) else Path(path).parent
    require_unchanged(folder, found.result.files)
    return Run(
        folder=folder.absolute(),
        result=found.result,
        robot=found.robot,
        posterior=found.posterior,
        configurations=read_configurations(folder, found.robot.n_joints),
        residuals=read_residuals(folder),
        written=written_at(folder / "result.json"),
    )


@checked
def write_report(
    path: Path | str, folder: Path | str | None = None, *, page: bool = True, figures: bool = False
) -> None:
    """Write `report.html` of a saved calibration: one page that needs nothing else.

    Args:
        path: The folder that `save` or `calibrate --out` wrote, or its `result.json`.
        folder: Where to; beside the result if None.
        page: Whether to write the page.
        figures: Whether to write its figures, each as an SVG of its own.

    Raises:
        InputError: There is no such calibration, it is damaged, or the folder cannot be written.
    """
    run = load_run(path)
    into = run.folder if folder is None else Path(folder)
    if page:
        write_page(into, run)
    if figures:
        write_figures(into, figures_of(run))
