"""The files that a page and its figures are written to."""

PAGE = {"report.html": b"<!DOCTYPE html>"}
"""The page of a calibration, and how it begins."""

FIGURES = ("accuracy", "joints", "ranges", "parameters", "correlations", "residuals", "workspace")
"""Its figures that may be files of their own."""

FIGURE_FILES = {f"{name}.svg": b"<svg" for name in FIGURES}
"""These files, and how they begin."""
