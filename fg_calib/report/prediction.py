"""What to expect of a calibrated arm, for the terminal, for programs, and as a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType

from fg_calib import __version__
from fg_calib.io import prediction as document
from fg_calib.io.csv_writer import write_csv
from fg_calib.io.result import Result
from fg_calib.io.tables import joint_columns
from fg_calib.io.units import Units
from fg_calib.options import LengthUnit
from fg_calib.prediction.prediction import PredictedErrors, Responsible, WorstConfiguration, summed_up
from fg_calib.prediction.tool_pose import ToolErrors
from fg_calib.report.shown import SHOWN
from fg_calib.report.summary import verdict_word
from fg_calib.report.tables import indented, line, plain_table, rounded, section
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]

_MOST = 20
"""Configurations that a report lists; the table has them all."""

_WORDS = {"base": "in the base frame", "fitted": "after the best rigid fit"}
_KINDS = (("position", "m"), ("orientation", "rad"))
_SIZES = {"rms": "RMS", "median": "median", "p95": "95 % below", "largest": "largest"}


def prediction_document(found: PredictedErrors, result: Result, ids: Sequence[str] = ()) -> dict[str, Any]:
    """What `--json` prints and `predict.json` holds: see `files.prediction.Prediction`.

    Args:
        found: The prediction.
        result: What it is of.
        ids: Names of the configurations, where they were given.
    """
    names, errors = _names(found, ids), found.errors
    classes = {p.name: p.identifiability for p in result.parameters}
    noise, total = errors.joint_noise, found.with_joint_noise
    expected = document.Expected(
        base=_kinds(errors.base),
        fitted=_kinds(errors.fitted),
        joint_noise=None if noise is None else _kinds(noise),
        total=None if total is None else _kinds(total),
    )
    worst = None if found.worst is None else _worst_document(found.worst, names, classes)
    each = [_configuration(errors, k, names[k], bool(~found.far[k])) for k in range(len(names))] if found.given else []
    return document.Prediction.make(
        schema_=document.SCHEMA,
        version=__version__,
        robot=result.robot,
        trustworthy=not (result.findings or result.in_parts),
        findings=result.findings,
        reservations=result.reservations,
        at="configurations" if found.given else "workspace",
        n=len(errors.readings),
        counts="fitted" if found.fitted else "base",
        expected=expected,
        unknown=found.unknown,
        undetermined=found.undetermined,
        far=float(np.mean(found.far)),
        limit=found.limit,
        within=found.within,
        worst=worst,
        responsible=_shares(found.responsible, classes),
        configurations=tuple(document.Configuration(**one) for one in each),
    ).document()


def _names(found: PredictedErrors, ids: Sequence[str]) -> tuple[str, ...]:
    """Names of the configurations: those that were drawn have numbers."""
    return tuple(ids) or tuple(map(str, range(len(found.errors.readings))))


def _kinds(errors: Floats) -> document.Kinds:
    return document.Kinds(
        position=document.Sizes(**summed_up(errors[:, 0])), orientation=document.Sizes(**summed_up(errors[:, 1]))
    )


def _errors(both: Floats) -> document.Errors:
    return document.Errors(position=float(both[0]), orientation=float(both[1]))


def _configuration(errors: ToolErrors, k: int, name: str, near: bool) -> dict[str, Any]:
    return {
        "id": name,
        "readings": errors.readings[k],
        "position": errors.position[k],
        "base": _errors(errors.base[k]),
        "fitted": _errors(errors.fitted[k]),
        "joint_noise": None if errors.joint_noise is None else _errors(errors.joint_noise[k]),
        "near": near,
    }


def _worst_document(worst: WorstConfiguration, names: Sequence[str], classes: Mapping[str, str]) -> document.Worst:
    name = "" if worst.row is None else names[worst.row]
    return document.Worst.make(
        **_configuration(worst.errors, 0, name, not worst.far),
        axes=worst.axes.tolist(),
        sigma=worst.sigma,
        responsible=_shares(worst.responsible, classes),
    )


def _shares(found: Sequence[Responsible], classes: Mapping[str, str]) -> tuple[document.Share, ...]:
    return tuple(
        document.Share(name=p.name, unit=p.unit, share=p.share, change=p.change, identifiability=classes[p.name])
        for p in found
    )


def write_prediction_table(
    path: Path, found: PredictedErrors, robot: Robot, units: Units, ids: Sequence[str] = ()
) -> None:
    """Write `predict.csv`, a row a configuration; NaN is what is not known.

    Args:
        path: The CSV.
        found: The prediction.
        robot: Whose joints they are of.
        units: Of joint values and positions; errors are in mm and deg, as their columns say.
        ids: Names of the configurations, where they were given.

    Raises:
        InputError: It cannot be written.
    """
    errors = found.errors
    readings = errors.readings / [units.factor(joint.unit) for joint in robot.joints]
    columns: dict[str, Any] = {
        "id": np.array(_names(found, ids), dtype=np.str_),
        **dict(zip(joint_columns(robot), readings.T, strict=True)),
        **dict(zip("xyz", errors.position.T / units.factor("m"), strict=True)),
    }
    for name in ("base", "fitted", "joint_noise"):
        of_both = getattr(errors, name)
        if of_both is not None:
            for column, (kind, unit) in zip(of_both.T, _KINDS, strict=True):
                factor, shown, _ = SHOWN[unit]
                columns[f"{name}_{kind}_{shown}"] = column * factor
    columns["measured_near"] = np.where(found.far, "no", "yes")
    write_csv(path, columns)


def build_prediction_report(
    found: PredictedErrors, result: Result, robot: Robot, ids: Sequence[str] = (), length: LengthUnit = "m"
) -> RenderableType:
    """A prediction for the terminal.

    Args:
        found: The prediction.
        result: What it is of.
        robot: The calibrated robot.
        ids: Names of the configurations, where they were given.
        length: Unit of positions; errors are in mm.
    """
    n = len(found.errors.readings)
    where = f"at {n} configurations" if found.given else "over the workspace"
    verdict = verdict_word(result) if not result.findings else "DOUBTFUL"
    parts: list[RenderableType] = [line(f"{result.robot}: expected error of the tool {where}", "bold")]
    parts += [line(f"the calibration was {verdict}", "bold green" if not result.findings else "bold red")]
    parts += indented([*result.findings, *result.reservations])
    title = "Expected error, by the calibration's covariance" + ", if model and noise were as stated" * bool(
        result.findings or result.reservations
    )
    parts += section(title, _sizes(found), *indented(_shares_in_words(found)))
    if found.worst is not None:
        title = "Where it is largest" + ", as far as it is known" * bool(found.unknown)
        parts += section(title, *indented(_worst_in_words(found.worst, robot, _names(found, ids), length)))
    if found.responsible:
        parts += section("What it comes from", _parameters(found, result))
        parts += indented(["the mean square falls by that share where the parameter alone is known exactly"])
    if found.given:
        parts += section("Configurations", _configurations(found, robot, _names(found, ids)))
        parts += indented([f"and {n - _MOST} more: --out writes them all"] if n > _MOST else [])
    return Group(*parts, *section("Notes", *indented(_notes(found))))


def _sizes(found: PredictedErrors) -> RenderableType:
    """RMS and quantiles, in both frames, with joint noise and without."""
    words = {**_SIZES} if found.given else {**_SIZES, "largest": "largest drawn"}
    table = plain_table(("", "left"), ("", "left"), *((heading, "right") for heading in words.values()), wrap=True)
    order = ("fitted", "base") if found.fitted else ("base", "fitted")
    rows = {_WORDS[name]: found.errors.of(name == "fitted") for name in order}
    total = found.with_joint_noise
    if total is not None:
        rows[f"{_WORDS[order[0]]}, with joint noise"] = total
    for frame, errors in rows.items():
        for column, (_, unit) in zip(errors.T, _KINDS, strict=True):
            factor, shown, decimals = SHOWN[unit]
            sizes = summed_up(column)
            figures = ["unknown" if (v := sizes[k]) is None else rounded(v * factor, decimals) for k in _SIZES]
            table.add_row("" if unit == "rad" else frame, shown, *figures)
    return table


def _shares_in_words(found: PredictedErrors) -> list[str]:
    lines = []
    if found.within is not None and found.limit is not None:
        lines.append(f"within {found.limit * 1e3:.6g} mm at {_percent(found.within)} of them")
    if found.unknown > 0.0:
        of = f": it depends on {', '.join(found.undetermined)}, which nothing determines" if found.undetermined else ""
        lines.append(f"not known at {_percent(found.unknown)} of them{of}")
    lines.append(
        f"nothing was measured near {_percent(float(np.mean(found.far)))} of them"
        if found.far.any()
        else "something was measured near each of them"
    )
    return lines


def _percent(share: float) -> str:
    """A share in words; only what is all, or nothing, rounds to it."""
    shown = f"{100.0 * share:.0f}"
    return (
        {"0": "less than 1 %", "100": "more than 99 %"}.get(shown, f"{shown} %") if 0.0 < share < 1.0 else f"{shown} %"
    )


def _worst_in_words(worst: WorstConfiguration, robot: Robot, names: Sequence[str], length: LengthUnit) -> list[str]:
    errors, factor = worst.errors, Units(length).factor("m")
    decimals = max(0, 4 + round(math.log10(factor)))
    x, y, z = (f"{v / factor:.{decimals}f}" for v in errors.position[0].tolist())
    size = np.sqrt(np.sum(worst.sigma**2)) * 1e3
    at = "" if worst.row is None else f"{names[worst.row]}: "
    words = []
    for joint, value in zip(robot.joints, errors.readings[0].tolist(), strict=True):
        factor, unit, _ = SHOWN[joint.unit]
        words.append(f"{joint.name} {value * factor:.2f} {unit}")
    lines = [
        f"{at}{size:.4f} mm with the tool at x {x}, y {y}, z {z} {length} from the base",
        f"joints: {', '.join(words)}",
    ]
    axis = ", ".join(f"{v:+.2f}" for v in worst.axes[0].tolist())
    sigma = [f"{v * 1e3:.4f}" for v in worst.sigma.tolist()]
    lines.append(f"1 sigma is {sigma[0]} mm along ({axis}), {sigma[1]} and {sigma[2]} mm across")
    if worst.responsible:
        changes = []
        for p in worst.responsible:
            factor, unit, _ = SHOWN[p.unit]
            changes.append(f"{p.name} {(p.change or 0.0) * factor:+.3g} {unit}")
        lines.append(f"with 1 sigma along it go {', '.join(changes)}")
    lines += ["nothing was measured near it"] if worst.far else []
    return lines


def _parameters(found: PredictedErrors, result: Result) -> RenderableType:
    """Parameters that errors follow, over all configurations and at the worst."""
    classes = {p.name: p.identifiability for p in result.parameters}
    worst = {} if found.worst is None else {p.name: p.share for p in found.worst.responsible}
    everywhere = {p.name: p.share for p in found.responsible}
    table = plain_table(("", "left"), ("of all", "right"), ("where largest", "right"), ("the data alone say", "left"))
    for name in dict.fromkeys([*everywhere, *worst]):
        shares = ["-" if name not in of else f"{100.0 * of[name]:.0f} %" for of in (everywhere, worst)]
        table.add_row(name, *shares, classes[name])
    return table


def _configurations(found: PredictedErrors, robot: Robot, names: Sequence[str]) -> RenderableType:
    """The worst of the configurations that were given, in their order."""
    error = np.where(np.isnan(found.expected[:, 0]), np.inf, found.expected[:, 0])
    shown = np.sort(np.argsort(-error, kind="stable")[:_MOST])
    units = [SHOWN[joint.unit] for joint in robot.joints]
    headings = [f"{joint.name} {unit}" for joint, (_, unit, _) in zip(robot.joints, units, strict=True)]
    kinds = [SHOWN[unit] for _, unit in _KINDS]
    columns = (*headings, *(unit for _, unit, _ in kinds), "near")
    table = plain_table(("", "left"), *((heading, "right") for heading in columns), wrap=True)
    for k in shown.tolist():
        q = [f"{v * factor:.2f}" for v, (factor, _, _) in zip(found.errors.readings[k].tolist(), units, strict=True)]
        both = zip(found.expected[k].tolist(), kinds, strict=True)
        figures = [rounded(v * factor, decimals) if np.isfinite(v) else "unknown" for v, (factor, _, decimals) in both]
        table.add_row(names[k], *q, *figures, "no" if found.far[k] else "yes")
    return table


def _notes(found: PredictedErrors) -> list[str]:
    """What one should know before one relies on it."""
    notes = ["Errors are RMS: what noise and tolerances as they were stated leave. What the model lacks is no part."]
    if not found.given:
        unlimited = [j.name for j in found.joints if not np.isfinite(j.limits).all()]
        stands = f" ({', '.join(unlimited)} without any: +-180 deg, or what was read)" if unlimited else ""
        sought = "; the largest error was then looked for" if found.worst is not None else ""
        n = len(found.errors.readings)
        notes.append(f"{n} configurations were drawn within the joint limits{stands}{sought}.")
    if found.fitted:
        notes.append(
            "Nothing was measured in the base frame: errors count after the one rigid motion that fits all that was "
            "measured best, and then holds everywhere."
        )
    if found.errors.joint_noise is None:
        notes.append(
            "The job states no noise of the joints' readings: how well the arm repeats is not in these errors."
        )
    return notes
