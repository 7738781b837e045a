"""The report of `fg-calib correct`: what to command, target by target, and what to expect of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from scipy.spatial.transform import Rotation

from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import indented, line, plain_table, rounded, section
from fg_calib.robot.model import Robot
from fg_calib.robot.reaching import Correction

Floats = NDArray[np.float64]

_MOST = 20
"""Targets that a report lists; the table of commands has them all."""

_EXPLAINED = {
    "uncorrected": "with the joint values of the nominal arm",
    "missed": "what is left with the commands, by the calibrated arm",
    "expected": "expected of the true arm, by the calibration's uncertainty (RMS)",
}


def correction_document(name: str, ids: Sequence[str], correction: Correction) -> dict[str, Any]:
    """What to command, as JSON: [m], [rad]; null where it is not known.

    Args:
        name: The robot's name.
        ids: The targets' names.
        correction: What to command.
    """
    quaternion = Rotation.from_matrix(correction.rotation.copy()).as_quat(canonical=True)

    def errors(of: str, i: int) -> dict[str, float | None]:
        both = correction.turns or of == "expected"
        return _known(("position", "orientation") if both else ("position",), getattr(correction, of)[i])

    return {
        "schema": "fg-calib/correct/1",
        "robot": name,
        "n_targets": len(ids),
        "n_reached": int(correction.reached.sum()),
        "expected_fitted": correction.expected_fitted if np.isfinite(correction.expected_fitted) else None,
        "targets": [
            {
                "id": target,
                "reached": bool(correction.reached[i]),
                "readings": correction.readings[i].tolist(),
                "nominal_readings": correction.nominal_readings[i].tolist(),
                "position": correction.position[i].tolist(),
                "quaternion_xyzw": quaternion[i].tolist(),
                **{of: errors(of, i) for of in _EXPLAINED},
            }
            for i, target in enumerate(ids)
        ],
    }


def _known(names: Sequence[str], figures: Floats) -> dict[str, float | None]:
    """Figures by name, None where unknown."""
    return {name: v if np.isfinite(v) else None for name, v in zip(names, figures.tolist(), strict=False)}


def build_correction_report(ids: Sequence[str], correction: Correction, robot: Robot) -> RenderableType:
    """What to command, for people.

    Args:
        ids: The targets' names.
        correction: What to command.
        robot: The calibrated robot.
    """
    n, reached = len(ids), int(correction.reached.sum())
    parts: list[RenderableType] = [line(f"{robot.name}: {reached} of {n} targets can be reached", "bold"), line("")]
    parts += [_summary(correction)]
    shown = np.concatenate([np.flatnonzero(~correction.reached), np.flatnonzero(correction.reached)])[:_MOST]
    more = [f"and {n - len(shown)} more: --out writes them all"] if n > len(shown) else []
    parts += section("Joint values to command", _commands(ids, correction, robot, np.sort(shown)), *indented(more))
    return Group(*parts, *section("Notes", *indented(_notes(ids, correction))))


def _summary(correction: Correction) -> RenderableType:
    """Errors over all targets."""
    table = plain_table(
        ("error at the targets", "left"), ("RMS", "right"), ("largest", "right"), ("", "left"), wrap=True
    )
    for of, words in _EXPLAINED.items():
        for k, unit in enumerate(("m", "rad") if correction.turns or of == "expected" else ("m",)):
            factor, name, decimals = SHOWN[unit]
            known = getattr(correction, of)[:, k] * factor
            known = known[np.isfinite(known)]
            sizes = (float(np.sqrt(np.mean(known**2))), float(known.max())) if len(known) else (np.nan, np.nan)
            table.add_row("" if k else words, *(_figure(size, decimals) for size in sizes), name)
    factor, name, decimals = SHOWN["m"]
    fitted = _figure(correction.expected_fitted * factor, decimals)
    table.add_row("the same after the best rigid fit of all targets", fitted, "", name)
    return table


def _figure(value: float, decimals: int) -> str:
    return rounded(value, decimals) if np.isfinite(value) else "-"


def _commands(ids: Sequence[str], correction: Correction, robot: Robot, rows: Any) -> RenderableType:
    """Joint values and errors of some targets."""
    units = [SHOWN[joint.unit] for joint in robot.joints]
    names = [f"{joint.name} {unit}" for joint, (_, unit, _) in zip(robot.joints, units, strict=True)]
    factor, name, decimals = SHOWN["m"]
    headings = (*names, f"before {name}", f"after {name}")
    table = plain_table(("target", "left"), *((heading, "right") for heading in headings), wrap=True)
    after = np.hypot(correction.missed[:, 0], correction.expected[:, 0])
    for i in rows:
        figures = [rounded(q * f, d) for q, (f, _, d) in zip(correction.readings[i].tolist(), units, strict=True)]
        errors = [float(e) * factor for e in (correction.uncorrected[i, 0], after[i])]
        figures += [_figure(e, decimals) for e in errors]
        table.add_row(line(ids[i]), *figures)
    return table


def _notes(ids: Sequence[str], correction: Correction) -> list[str]:
    """What one should know before one commands it."""
    notes = [
        "Give the controller the joint values; or, where it only takes poses, the poses that --out writes, "
        "with its nominal model, base and tool unchanged.",
    ]

    def named(rows: Any) -> str:
        some = [ids[i] for i in np.flatnonzero(rows).tolist()]
        return ", ".join(some[:5]) + (f" and {len(some) - 5} more" if len(some) > 5 else "")

    turned = ~correction.reached & (correction.missed[:, 0] < 1e-9)
    if turned.any():
        notes.append(f"Reached with the point alone, the tool turned as near as the arm can: {named(turned)}.")
    away = ~correction.reached & ~turned
    if away.any():
        notes.append(f"Out of reach within the joint limits: {named(away)}.")
    if correction.far.any():
        notes.append(
            "A joint changes by more than a calibration alone explains, near a singularity or on another branch: "
            f"{named(correction.far)}. Look at these before you run them."
        )
    if np.isnan(correction.expected).any():
        notes.append("What to expect is not known where it depends on what the calibration left undetermined.")
    return notes
