"""Expected errors of a calibrated arm, and joint positions that correct them: for the terminal and for programs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from scipy.spatial.transform import Rotation

from fg_calib import __version__
from fg_calib.inputs import Floats
from fg_calib.io import Result, Units, joint_columns, require_own_csv, write_csv
from fg_calib.options import LengthUnit
from fg_calib.prediction import Correction, PredictedErrors, Responsible, ToolErrors, WorstConfiguration, summed_up
from fg_calib.report.tables import SHOWN, figure, indented, line, plain, section, shortened, table_of
from fg_calib.report.text import verdict_word
from fg_calib.robot import Robot

MAX_LISTED = 20
"""Configurations, or targets, that a report lists; the tables have all."""

FRAMES = {"base": "in the base frame", "fitted": "after the best rigid fit"}
KINDS = (("position", "m"), ("orientation", "rad"))
SIZES = {"rms": "RMS", "median": "median", "p95": "95 % below", "largest": "largest"}

ERRORS = {
    "uncorrected": "with the joint positions of the nominal arm",
    "missed": "what is left with the commands, by the calibrated arm",
    "expected": "expected of the true arm, by the calibration's uncertainty (RMS)",
}
"""The errors at a target."""


def prediction_document(found: PredictedErrors, result: Result, ids: Sequence[str] = ()) -> dict[str, Any]:
    """The content of `predict.json`, in [m] and [rad]; null for what is unknown.

    `counts` is `fitted` where nothing was measured in the base frame. Over the `workspace` there are `n` drawn
    configurations, and `configurations` is empty. `unknown`, `far` (nothing measured near) and `within` (the `limit`)
    are shares of them, 0 to 1. `change` of a responsible parameter goes with 1 sigma along the longest axis of the
    worst error; known exactly, it would reduce the expected square by `share`.

    Args:
        found: The prediction.
        result: The result of the calibration.
        ids: Names of the configurations, where they were given.
    """
    names, errors, worst = _names(found, ids), found.errors, found.worst
    sizes = {"base": errors.base, "fitted": errors.fitted, "joint_noise": errors.joint_noise}
    of_worst: dict[str, Any] | None = None
    if worst is not None:
        of_worst = _configuration(worst.errors, 0, "" if worst.row is None else names[worst.row], near=not worst.far)
        of_worst |= {"axes": worst.axes, "sigma": worst.sigma, "responsible": _shares(worst.responsible, result)}
    each = range(len(names)) if found.given else ()
    document: dict[str, Any] = plain(
        {
            "schema": "fg-calib/predict/1",
            "version": __version__,
            "robot": result.robot,
            "trustworthy": not result.findings,
            "findings": result.findings,
            "reservations": result.reservations,
            "at": "configurations" if found.given else "workspace",
            "n": len(errors.readings),
            "counts": "fitted" if found.fitted else "base",
            "expected": {key: _sizes(values) for key, values in (sizes | {"total": found.with_joint_noise}).items()},
            "far": float(np.mean(found.far)),
            **{key: getattr(found, key) for key in ("unknown", "undetermined", "limit", "within")},
            "worst": of_worst,
            "responsible": _shares(found.responsible, result),
            "configurations": [_configuration(errors, k, names[k], near=not found.far[k]) for k in each],
        }
    )
    return document


def _names(found: PredictedErrors, ids: Sequence[str]) -> tuple[str, ...]:
    """Names of the configurations; drawn ones have numbers."""
    return tuple(ids) or tuple(map(str, range(len(found.errors.readings))))


def _sizes(errors: Floats | None) -> dict[str, Any] | None:
    if errors is None:
        return None
    return {kind: summed_up(column) for column, (kind, _) in zip(errors.T, KINDS, strict=True)}


def _configuration(errors: ToolErrors, k: int, name: str, *, near: bool) -> dict[str, Any]:
    def both(values: Floats | None) -> dict[str, float] | None:
        return None if values is None else {"position": values[k, 0], "orientation": values[k, 1]}

    kinds = {key: both(getattr(errors, key)) for key in ("base", "fitted", "joint_noise")}
    return {"id": name, "readings": errors.readings[k], "position": errors.position[k], **kinds, "near": bool(near)}


def _shares(found: Sequence[Responsible], result: Result) -> list[dict[str, Any]]:
    classes = {p.name: p.identifiability for p in result.parameters}
    keys = ("name", "unit", "share", "change")
    return [{key: getattr(p, key) for key in keys} | {"identifiability": classes[p.name]} for p in found]


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
            for column, (kind, unit) in zip(of_both.T, KINDS, strict=True):
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
        result: The result of the calibration.
        robot: The calibrated robot.
        ids: Names of the configurations, where they were given.
        length: Unit of positions; errors are in mm.
    """
    n = len(found.errors.readings)
    where = f"at {n} configurations" if found.given else "over the workspace"
    style = "bold red" if result.findings else "bold green"
    parts: list[RenderableType] = [line(f"{result.robot}: expected error of the tool {where}", "bold")]
    parts += [line(f"the calibration was {verdict_word(result)}", style)]
    parts += indented([*result.findings, *result.reservations])
    title = "Expected error, by the covariance of the calibration"
    parts += section(title, size_table(found), *indented(percentages(found)))
    if found.worst is not None:
        title = "Where it is largest" + ", as far as it is known" * bool(found.unknown)
        parts += section(title, *indented(_worst_in_words(found.worst, robot, _names(found, ids), length)))
    if found.responsible:
        parts += section("Parameters that it comes from", _responsible(found, result))
        parts += indented(["the mean square falls by that share where the parameter alone is known exactly"])
    if found.given:
        parts += section("Configurations", _configurations(found, robot, _names(found, ids)))
        parts += indented([f"and {n - MAX_LISTED} more: --out writes them all"] if n > MAX_LISTED else [])
    return Group(*parts, *section("Notes", *indented(_prediction_notes(found))))


def size_table(found: PredictedErrors) -> RenderableType:
    """RMS and quantiles, in both frames, with joint noise and without."""
    order = ("fitted", "base") if found.fitted else ("base", "fitted")
    errors = {FRAMES[name]: found.errors.of(name == "fitted") for name in order}
    if found.with_joint_noise is not None:
        errors[f"{FRAMES[order[0]]}, with joint noise"] = found.with_joint_noise
    rows = []
    for frame, of_frame in errors.items():
        for column, (kind, unit) in zip(of_frame.T, KINDS, strict=True):
            sizes = summed_up(column)
            name = frame if kind == "position" else ""
            rows.append((name, SHOWN[unit][1], *(figure(sizes[key], unit) for key in SIZES)))
    return table_of(("", "", *SIZES.values()), rows, left="ll", wrap=True)


def percentages(found: PredictedErrors) -> Iterator[str]:
    """The shares of configurations within the limit, where the error is unknown, and where nothing was measured."""
    if found.within is not None and found.limit is not None:
        yield f"within {found.limit * 1e3:.6g} mm at {_percent(found.within)} of them"
    if found.unknown > 0.0:
        of = f": it depends on {', '.join(found.undetermined)}, not identifiable" if found.undetermined else ""
        yield f"unknown at {_percent(found.unknown)} of them{of}"
    far = float(np.mean(found.far))
    yield f"nothing was measured near {_percent(far)} of them" if far else "something was measured near each of them"


def _percent(share: float) -> str:
    """A share in words; only 0 and 1 themselves round to 0 and 100 %."""
    limits = {"0": "less than 1 %", "100": "more than 99 %"} if 0.0 < share < 1.0 else {}
    return limits.get(f"{100.0 * share:.0f}", f"{100.0 * share:.0f} %")


def _worst_in_words(worst: WorstConfiguration, robot: Robot, names: Sequence[str], length: LengthUnit) -> Iterator[str]:
    errors, factor = worst.errors, Units(length).factor("m")
    decimals = max(0, 4 + round(math.log10(factor)))
    x, y, z = (f"{v / factor:.{decimals}f}" for v in errors.position[0].tolist())
    at = "" if worst.row is None else f"{names[worst.row]}: "
    size = figure(float(np.sqrt(np.sum(worst.sigma**2))), "m")
    yield f"{at}{size} mm with the tool at x {x}, y {y}, z {z} {length} from the base"
    readings = zip(robot.joints, errors.readings[0].tolist(), strict=True)
    shown = ((joint.name, value * SHOWN[joint.unit][0], SHOWN[joint.unit][1]) for joint, value in readings)
    yield f"joints: {', '.join(f'{name} {value:.2f} {unit}' for name, value, unit in shown)}"
    axis, sigma = ", ".join(f"{v:+.2f}" for v in worst.axes[0].tolist()), [figure(v, "m") for v in worst.sigma.tolist()]
    yield f"1 sigma is {sigma[0]} mm along ({axis}), {sigma[1]} and {sigma[2]} mm across"
    if worst.responsible:
        changes = ((p.name, (p.change or 0.0) * SHOWN[p.unit][0], SHOWN[p.unit][1]) for p in worst.responsible)
        yield f"with 1 sigma along it go {', '.join(f'{name} {value:+.3g} {unit}' for name, value, unit in changes)}"
    if worst.far:
        yield "nothing was measured near it"


def _responsible(found: PredictedErrors, result: Result) -> RenderableType:
    """The shares of parameters over all configurations and at the worst."""
    classes = {p.name: p.identifiability for p in result.parameters}
    worst = {} if found.worst is None else {p.name: p.share for p in found.worst.responsible}
    everywhere = {p.name: p.share for p in found.responsible}
    rows = []
    for name in dict.fromkeys([*everywhere, *worst]):
        shares = ["-" if name not in of else f"{100.0 * of[name]:.0f} %" for of in (everywhere, worst)]
        rows.append((name, *shares, classes[name]))
    return table_of(("", "of all", "where largest", "class"), rows, left="lrrl")


def _configurations(found: PredictedErrors, robot: Robot, names: Sequence[str]) -> RenderableType:
    """The worst of the given configurations, in their order."""
    error = np.where(np.isnan(found.expected[:, 0]), np.inf, found.expected[:, 0])
    joints = [f"{joint.name} {SHOWN[joint.unit][1]}" for joint in robot.joints]
    rows = []
    for k in np.sort(np.argsort(-error, kind="stable")[:MAX_LISTED]).tolist():
        readings = zip(found.errors.readings[k].tolist(), robot.joints, strict=True)
        q = [f"{v * SHOWN[joint.unit][0]:.2f}" for v, joint in readings]
        errors = [figure(v, unit) for v, (_, unit) in zip(found.expected[k].tolist(), KINDS, strict=True)]
        rows.append((names[k], *q, *errors, "no" if found.far[k] else "yes"))
    return table_of(("", *joints, *(SHOWN[unit][1] for _, unit in KINDS), "near"), rows, wrap=True)


def _prediction_notes(found: PredictedErrors) -> Iterator[str]:
    yield "Errors are RMS, from the specified noise and prior sigmas. Unmodelled effects are not included."
    if not found.given:
        unlimited = [j.name for j in found.joints if not np.isfinite(j.limits).all()]
        instead = f" ({', '.join(unlimited)} without any: +-180 deg, or what was read)" if unlimited else ""
        yield f"{len(found.errors.readings)} configurations were drawn within the joint limits{instead}."
    if found.fitted:
        yield "Nothing was measured in the base frame: errors count after the best rigid fit to all measurements."
    if found.errors.joint_noise is None:
        yield "The job specifies no joint noise: the repeatability of the arm is not in these errors."


def correction_document(name: str, ids: Sequence[str], correction: Correction) -> dict[str, Any]:
    """The content of `correct --json`: [m], [rad]; null where it is unknown.

    Args:
        name: The robot's name.
        ids: The targets' names.
        correction: The commands.
    """
    quaternion = Rotation.from_matrix(correction.rotation.copy()).as_quat(canonical=True)

    def errors(of: str, i: int) -> dict[str, float]:
        kinds = ("position", "orientation") if correction.turns or of == "expected" else ("position",)
        return dict(zip(kinds, getattr(correction, of)[i].tolist(), strict=False))

    targets = [
        {
            "id": target,
            "reached": bool(correction.reached[i]),
            **{key: getattr(correction, key)[i] for key in ("readings", "nominal_readings", "position")},
            "quaternion_xyzw": quaternion[i],
            **{of: errors(of, i) for of in ERRORS},
        }
        for i, target in enumerate(ids)
    ]
    counts = {"n_targets": len(ids), "n_reached": int(correction.reached.sum())}
    head = {"schema": "fg-calib/correct/1", "robot": name, **counts, "expected_fitted": correction.expected_fitted}
    document: dict[str, Any] = plain(head | {"targets": targets})
    return document


def build_correction_report(ids: Sequence[str], correction: Correction, robot: Robot) -> RenderableType:
    """Commands for the terminal.

    Args:
        ids: The targets' names.
        correction: The commands.
        robot: The calibrated robot.
    """
    n, reached = len(ids), int(correction.reached.sum())
    parts: list[RenderableType] = [line(f"{robot.name}: {reached} of {n} targets can be reached", "bold"), line("")]
    parts += [_target_errors(correction)]
    shown = np.concatenate([np.flatnonzero(~correction.reached), np.flatnonzero(correction.reached)])[:MAX_LISTED]
    more = [f"and {n - len(shown)} more: --out writes them all"] if n > len(shown) else []
    table = _commands(ids, correction, robot, np.sort(shown).tolist())
    parts += section("Joint positions to command", table, *indented(more))
    return Group(*parts, *section("Notes", *indented(_correction_notes(ids, correction))))


def _target_errors(correction: Correction) -> RenderableType:
    rows = []
    for of, words in ERRORS.items():
        for k, unit in enumerate(("m", "rad") if correction.turns or of == "expected" else ("m",)):
            values = getattr(correction, of)[:, k]
            known = values[np.isfinite(values)]
            sizes = (float(np.sqrt(np.mean(known**2))), float(known.max())) if len(known) else (np.nan, np.nan)
            rows.append(("" if k else words, *(figure(size, unit, none="-") for size in sizes), SHOWN[unit][1]))
    fitted = figure(correction.expected_fitted, "m", none="-")
    rows.append(("the same after the best rigid fit of all targets", fitted, "", "mm"))
    return table_of(("error at the targets", "RMS", "largest", ""), rows, left="lrrl", wrap=True)


def _commands(ids: Sequence[str], correction: Correction, robot: Robot, chosen: Sequence[int]) -> RenderableType:
    """Joint positions and errors of some targets."""
    after, rows = np.hypot(correction.missed[:, 0], correction.expected[:, 0]), []
    for i in chosen:
        readings = zip(correction.readings[i].tolist(), robot.joints, strict=True)
        errors = (float(correction.uncorrected[i, 0]), float(after[i]))
        commands = (figure(q, joint.unit) for q, joint in readings)
        rows.append((ids[i], *commands, *(figure(e, "m", none="-") for e in errors)))
    joints = [f"{joint.name} {SHOWN[joint.unit][1]}" for joint in robot.joints]
    return table_of(("target", *joints, "before mm", "after mm"), rows, wrap=True)


def _correction_notes(ids: Sequence[str], correction: Correction) -> Iterator[str]:
    yield (
        "Give the controller the joint positions; or, where it only takes poses, the poses that --out writes, with its"
        " nominal model, base and tool unchanged."
    )

    def named(rows: Any) -> str:
        return shortened([ids[i] for i in np.flatnonzero(rows).tolist()], 5)

    rotated = ~correction.reached & (correction.missed[:, 0] < 1e-9)
    if rotated.any():
        yield f"Reached with the point alone, the tool rotated as near as the arm can: {named(rotated)}."
    if (~correction.reached & ~rotated).any():
        yield f"Out of reach within the joint limits: {named(~correction.reached & ~rotated)}."
    if correction.far.any():
        yield (
            "A joint changes by more than a calibration alone explains, near a singularity or on another branch: "
            f"{named(correction.far)}. Look at these before you run them."
        )
    if np.isnan(correction.expected).any():
        yield "The expected error is unknown where it depends on what the calibration did not determine."


_COMMANDS_BEGIN = b"id,reached,"
"""How a table of commands begins."""


def require_commands(path: Path) -> None:
    """Check that a table of commands can be written: a CSV that is not there yet, or was written as one.

    Raises:
        InputError: It cannot.
    """
    require_own_csv(path, _COMMANDS_BEGIN)


def write_commands(path: Path, ids: tuple[str, ...], correction: Correction, robot: Robot, units: Units) -> None:
    """Write a table of commands, whole or not at all.

    Columns: `id`; `reached`: yes, or no; joint values by the joints' names (`q1 ... qn` where these mean something else
    in a table); `x y z qx qy qz qw`, the pose to command from the base; `uncorrected_position` and
    `uncorrected_orientation`, how far the nominal values miss; `missed_position` and `missed_orientation`, what is left
    where a target is out of reach; `expected_position` and `expected_orientation`, the RMS error to expect. Figures are
    in the units given; an empty cell is unknown.

    Args:
        path: The CSV; one that was written as such is replaced.
        ids: The targets' names.
        correction: What to command.
        robot: Whose joints they are of.
        units: Of the figures.

    Raises:
        InputError: It cannot be written, or is another file.
    """
    length, angle = units.factor("m"), units.factor("rad")
    quaternion = Rotation.from_matrix(correction.rotation.copy()).as_quat(canonical=True)
    readings = correction.readings / [units.factor(joint.unit) for joint in robot.joints]
    columns: dict[str, Any] = {
        "id": np.array(ids, dtype=np.str_),
        "reached": np.where(correction.reached, "yes", "no"),
        **dict(zip(joint_columns(robot), readings.T, strict=True)),
        **dict(zip("xyz", correction.position.T / length, strict=True)),
        **{f"q{axis}": quaternion[:, k] for k, axis in enumerate("xyzw")},
    }
    for name in ("uncorrected", "missed", "expected"):
        errors = getattr(correction, name)
        columns[f"{name}_position"] = errors[:, 0] / length
        if correction.turns or name == "expected":
            columns[f"{name}_orientation"] = errors[:, 1] / angle
    require_commands(path)
    write_csv(path, columns)
