"""The figure of `fg-calib compare JOB`."""

from __future__ import annotations

from fg_calib.baseline.comparison import Comparison
from fg_calib.report.page.charts import bars
from fg_calib.report.page.page import standalone
from fg_calib.report.shown import FAMILY_UNIT, SHOWN


def draw_estimators(comparison: Comparison) -> str:
    """RMS residuals that each estimator leaves, by kind, as SVG."""
    before, rows = comparison.estimates[0].residual_rms or {}, []
    for family, of_family in before.get(comparison.judged_on, {}).items():
        factor, unit, _ = SHOWN.get(FAMILY_UNIT.get(family, "m"), (1.0, "", 3))
        found = [("nominal", of_family["before"])]
        for e in comparison.estimates:
            if e.residual_rms is not None:
                found.append((e.name, e.residual_rms[comparison.judged_on][family]["after"]))
        rows.append((family, [(name, value * factor, f"{value * factor:.3g} {unit}") for name, value in found]))
    about = f"RMS residuals of {comparison.judged_on} rows that each estimator leaves"
    return standalone([(about, bars(rows, about))])
