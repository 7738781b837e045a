"""The pages of the documentation: `docs/` of the repository, which the installed package has as `fg_calib/docs`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.console import RenderableType
from rich.markdown import Markdown

TOPICS: Mapping[str, str] = {
    "tutorial": "from a tracker file to a corrected UR10, step by step",
    "files": "your robot, tables and job: conventions, columns, noise, exit codes",
    "job": "every key of a calibration job",
    "robot": "every key of a robot file",
    "tables": "every column that means something",
    "instruments": "which model for which instrument, touched points, several tables",
    "from-bags-and-images": "tables from ROS bags and from images of a board",
    "reading-a-report": "what the numbers mean",
    "believe-it": "inspect, limits, folds, the page to show, two results side by side",
    "correct": "what to command so that the calibrated arm reaches its targets",
    "predict": "how far off the calibrated tool is expected to be, where and why",
    "export": "into the robot: URDF, ROS, Tesseract, tables, joint zeros",
    "next-month": "is a calibration still good, what has moved, and what was learned since",
    "observability": "which parameters measurements can determine at all",
    "design": "where to measure: how many stops, which ones, what accuracy, which instrument",
    "many-jobs": "on one process, on several, on a cluster; one huge table",
    "simulate": "a robot and measurements to try things on",
    "compare": "beside plain least squares, and against the truth",
    "python": "from arrays, the single steps, measurements and factors of your own",
    "layout": "which folder of the package holds what",
    "security": "what is trusted, and what no input can do",
}
"""What each page is of, in the order in which people need them."""

_PACKAGE = Path(__file__).parents[1]


def read_page(topic: str) -> str:
    """A page as Markdown: of the installed package, or of the checkout that it runs from.

    Raises:
        OSError: It is not there, or cannot be read.
    """
    installed = _PACKAGE / "docs"
    folder = installed if installed.is_dir() else _PACKAGE.parent / "docs"
    return (folder / f"{topic}.md").read_text(encoding="utf-8")


def build_page(topic: str) -> RenderableType:
    """A page for a terminal: links show where they lead, and code has no background of its own."""
    return Markdown(read_page(topic), hyperlinks=False, code_theme="ansi_dark")
