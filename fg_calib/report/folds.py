"""The section of the calibration report on cross-validation."""

from __future__ import annotations

import numpy as np
from rich.console import RenderableType

from fg_calib.assessment import Assessment as Uncertainty
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import in_order, indented, plain_table, section


def folds(uncertainty: Uncertainty) -> list[RenderableType]:
    """How well configurations are predicted without which it was calibrated, and how parameters spread."""
    found = uncertainty.folds
    if found is None:
        return []
    headings = ("held out", "before", "after", "noise stated")
    table = plain_table(("", "left"), ("", "left"), *((heading, "right") for heading in headings))
    for kind in in_order(found.kinds):
        held, (factor, unit, _) = found.kinds[kind], SHOWN[uncertainty.residuals.unit(kind)]
        table.add_row(kind, unit, f"{held.n}", *(f"{v * factor:.4f}" for v in (held.before, held.after, held.noise)))
    ratio, wide = found.beyond({p.name: p.sigma for p in uncertainty.parameters})
    lines = []
    if ratio:
        by = 100.0 / np.sqrt(2.0 * (found.n - 1))
        median = np.median(list(ratio.values()))
        lines.append(
            f"spread of a parameter between folds over its sigma: median {median:.2f} (each is known to {by:.0f} %;"
            " below 1 where tolerances determine it)"
        )
    if found.of_pairs:
        lines.append("of pairs it is 1.4 to 1.7 times as large: they leave with either end, or are formed anew")
    if wide:
        more = f" and {len(wide) - 5} more" * (len(wide) > 5)
        named = ", ".join(f"{name} {ratio[name]:.1f}" for name in wide[:5])
        lines.append(f"they spread more than their sigmas say, not by chance: {named}{more}")
    if found.not_converged:
        lines.append(f"{found.not_converged} of {found.n} calibrations did not converge")
    title = f"Cross-validation ({found.n} folds of configurations, each predicted without it; RMS)"
    return section(title, table, *indented(lines))
