"""Sections of the calibration report on the parameters."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import RenderableType

from fg_calib.assessment import Assessment as Uncertainty
from fg_calib.graph.tolerances import ToleranceScales
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import plain_table, rounded
from fg_calib.report.tolerances import HEADINGS, tolerance_rows


def parameters(uncertainty: Uncertainty) -> RenderableType:
    """Estimates with sigma, correction, nominal value, prior and class; frames fixed at zero are not listed."""
    headings = [("", "left"), ("estimate", "right"), ("", "left"), ("sigma", "right"), ("", "left")]
    table = plain_table(*headings, ("correction", "right"), ("nominal", "right"), ("prior", "right"), ("class", "left"))
    for p in uncertainty.parameters:
        if p.identifiability == "fixed" and uncertainty.residuals.evaluated:
            continue
        if p.identifiability == "fixed" and p.name.startswith(("base.", "tool.")) and p.nominal == 0.0:
            continue
        factor, unit, decimals = SHOWN[p.unit]
        nominal = rounded(p.nominal * factor, decimals)
        if p.identifiability == "fixed":
            table.add_row(p.name, nominal, "", "", unit, "", "", "", "fixed", style="dim")
            continue
        table.add_row(
            p.name,
            rounded(p.estimate * factor, decimals),
            "±",
            "unknown" if p.sigma is None else f"{p.sigma * factor:.{decimals}f}",
            unit,
            rounded(p.correction * factor, decimals, "+"),
            nominal,
            "" if p.prior_sigma is None else f"{p.prior_sigma * factor:.{decimals}f}",
            p.identifiability,
        )
    return table


def tolerances(found: ToleranceScales, uncertainty: Uncertainty) -> RenderableType:
    """The scales of tolerances that were estimated."""
    left = {0, 3}
    table = plain_table(*((heading, "left" if i in left else "right") for i, heading in enumerate(HEADINGS)))
    for row in tolerance_rows(found.scales, uncertainty.parameters):
        table.add_row(*row)
    return table


def combinations(uncertainty: Uncertainty) -> RenderableType:
    """The combinations that kept parameters stand for, whose sigmas are those of the estimates."""
    table = plain_table(("", "left"), ("sigma", "right"), ("", "left"), ("of the sum", "left"), wrap=True)
    for p in uncertainty.parameters:
        if p.stands_for:
            factor, unit, decimals = SHOWN[p.unit]
            sigma = p.sigma_of_combination
            shown = "unknown" if sigma is None else f"{sigma * factor:.{decimals}f}"
            table.add_row(p.name, shown, unit, format_combination(p.stands_for))
    return table


def format_combination(factors: Mapping[str, float]) -> str:
    """`d5 + d3 + d4`, `a7 + 0.5 beta5`: errors of the parameters, each by its factor."""
    sizes = {name: "" if abs(f) == 1.0 else f"{abs(f):.4g} " for name, f in factors.items()}
    terms = (f"{'-' if f < 0.0 else '+'} {sizes[name]}{name}" for name, f in factors.items())
    return " ".join(terms).removeprefix("+ ")
