"""Tolerances that were estimated, as rows of a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from fg_calib.graph.tolerances import ToleranceScale
from fg_calib.io.result import Parameter
from fg_calib.io.result import ToleranceScale as ScaleDocument
from fg_calib.report.shown import SHOWN
from fg_calib.statistics.estimates import ParameterEstimate

HEADINGS = ("", "stated", "estimated", "", "ratio", "from", "to", "corrections seen")
"""What the cells of a row are; the interval is one of 95 %."""

TITLE = "Tolerances estimated (ratio to those stated, with its 95 % interval)"


def tolerance_rows(
    scales: Iterable[ToleranceScale | ScaleDocument], parameters: Iterable[ParameterEstimate | Parameter]
) -> list[tuple[str, ...]]:
    """A row of cells for each scale; tolerances themselves only where those of a scale are all the same.

    Args:
        scales: The scales.
        parameters: All parameters, with the tolerances that were estimated.
    """
    by_name = {p.name: p for p in parameters}
    rows: list[tuple[str, ...]] = []
    for one in scales:
        figures = (f"{one.scale:.3g}", f"{one.low:.2g}", f"{one.high:.2g}", f"{one.seen:.1f} of {len(one.parameters)}")
        rows.append((one.group, *_tolerance([by_name[name] for name in one.parameters], one.scale), *figures))
    return rows


def _tolerance(members: Sequence[ParameterEstimate | Parameter], scale: float) -> tuple[str, str, str]:
    """Stated, estimated and unit where the members have one tolerance."""
    there = {(p.unit, f"{p.prior_sigma or 0.0:.6g}") for p in members}
    first = members[0].prior_sigma
    if len(there) > 1 or first is None:
        return "", "", ""
    factor, unit, _ = SHOWN[members[0].unit]
    return f"{first / scale * factor:.3g}", f"{first * factor:.3g}", unit
