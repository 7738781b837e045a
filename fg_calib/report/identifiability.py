"""The report on identifiability: what can be determined, what only together, and why not the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Group, RenderableType

from fg_calib.arguments import checked
from fg_calib.observability.identifiability import Identifiability
from fg_calib.observability.indices import CORRELATED, Observability
from fg_calib.observability.reasons import LostDirection
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import WIDTH, line, plain_table, plain_text, section
from fg_calib.robot.model import AXIS_OF_KIND, Axis

WEAK = "sigma above a tenth of the tolerance, or of 1 mrad at the reach"
"""What makes a direction weak, for headings."""


@checked
def format_identifiability(found: Identifiability, width: int = WIDTH) -> str:
    """`build_identifiability_report` as plain text."""
    return plain_text(build_identifiability_report(found), width)


def build_identifiability_report(found: Identifiability) -> RenderableType:
    """What can be identified, as in the paper's Tables 3 and 4, and why the rest cannot."""
    where = "random configurations" if found.kind == "structural" else "configurations"
    model = f"{found.model}, as poses of the board" if found.model == "pixels" else found.model
    title = f"{found.robot}: {model}, {found.kind}, {found.n_configurations} {where}"
    parts: list[RenderableType] = [line(title, "bold")]
    parts += (line(f"NOT MODELLED: {m}", "bold red") for m in found.missing)
    parts += _classes(found)
    known = found.with_fixed_known
    if known is not None:
        parts += [
            *section(f"With {', '.join(found.fixed)} known, as the robot's file says"),
            *_classes(known),
        ]
    return Group(*parts)


def _classes(found: Identifiability) -> list[RenderableType]:
    o = found.observability
    table = plain_table(("Identifiability", "left"), ("Kinematic parameters", "left"), wrap=True)
    table.add_row("Independent", ", ".join(o.named("independent")) or "None")
    relations = (f"[{' '.join(relation)}]" for group in o.relative for relation in group.relations)
    table.add_row("Relative", ", ".join(relations) or "None")
    table.add_row("Ineffective", ", ".join(o.named("ineffective")) or "None")
    table.add_row("Kept", ", ".join(o.kept) or "None")
    parts: list[RenderableType] = [line(f"rank {o.rank} of {len(o.names)}"), line(""), table]
    if found.lost:
        parts += section("Lost directions", lost_directions(found.lost))
    practical = found.kind == "practical"
    parts += section("Singular values" + (" (signal-to-noise ratios)" if practical else ""), _singular_values(o))
    if practical:
        indices = "  ".join(f"{name} {value:.4g}" for name, value in o.indices.items())
        parts += section("Observability indices", line(f"{indices}  condition number {o.condition_number:.4g}"))
        weak = weak_directions(o)
        if weak is not None:
            parts += section(f"Weak directions ({WEAK})", weak)
        parts += section("Sigma of what is kept, the rest at nominal", _sigmas(o))
        if o.correlations:
            correlated = (line(f"{a}, {b}: {rho:+.3f}") for a, b, rho in o.correlations)
            parts += section(f"Correlations above {CORRELATED:g}", *correlated)
    return parts


def lost_directions(lost: Sequence[LostDirection]) -> RenderableType:
    """One line a reason, with the directions that have it."""
    by_reason: dict[str, list[str]] = {}
    for direction in lost:
        by_reason.setdefault(direction.reason, []).append(format_relation(direction.relation))
    table = plain_table(("", "left"), ("because", "left"), wrap=True)
    for reason, relations in by_reason.items():
        table.add_row(", ".join(relations), reason)
    return table


def format_relation(relation: Mapping[str, float]) -> str:
    """`d3 - d4` where sizes are equal, else `d6 by +0.5 m with alpha7 by +1 rad`."""
    names, values = list(relation), list(relation.values())
    if all(abs(v) == 1.0 for v in values):
        return names[0] + "".join(f" {'+' if v > 0 else '-'} {n}" for n, v in zip(names[1:], values[1:], strict=True))
    large = {n: v for n, v in relation.items() if abs(v) >= 0.01}  # the largest is 1
    text = " with ".join(f"{n} by {v:+.4g} {unit_of(n)}" for n, v in large.items())
    n_small = len(relation) - len(large)
    return text + (f" and a little of {n_small} other parameter{'s' * (n_small > 1)}" if n_small else "")


def unit_of(name: str) -> str:
    """`m` or `rad`, by a parameter's name."""
    kind = name.rsplit(".", 1)[-1].rstrip("0123456789") if "." not in name else name.rsplit(".", 1)[-1]
    return "m" if AXIS_OF_KIND[kind] < Axis.RX else "rad"


def weak_directions(observability: Observability) -> RenderableType | None:
    """Weak directions by their largest members; None where no direction is weak."""
    if not observability.weak:
        return None
    table = plain_table(("sigma / tolerance", "right"), ("largest members", "left"), wrap=True)
    for weak in observability.weak[:5]:
        members = ", ".join(f"{name} {share:+.2f}" for name, share in list(weak.members.items())[:6])
        table.add_row(f"{1.0 / weak.signal_to_noise:.3g}" if weak.signal_to_noise > 0.0 else "unknown", members)
    if len(observability.weak) > 5:
        table.add_row("", f"and {len(observability.weak) - 5} more")
    return table


def _singular_values(observability: Observability) -> RenderableType:
    o = observability
    kept, dropped = o.singular_values[: o.rank], o.singular_values[o.rank :]
    lines = [" ".join(f"{v:.3g}" for v in kept) or "none"]
    if len(dropped):
        lines.append(f"gap of {o.gap:.1e}, then {len(dropped)} of at most {dropped[0]:.1e}")
    return Group(*map(line, lines))


def _sigmas(observability: Observability) -> RenderableType:
    table = plain_table(("", "left"), ("sigma", "right"), ("", "left"), ("stands for", "left"))
    for name, sigma in observability.sigma.items():
        factor, unit, decimals = SHOWN[unit_of(name)]
        others = [g for g in observability.relative if name in g.keep]
        stands = " ".join(others[0].parameters) if others else ""
        table.add_row(name, f"{sigma * factor:.{decimals}f}", unit, stands)
    return table
