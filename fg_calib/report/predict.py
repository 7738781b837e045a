"""Expected errors of a calibrated arm, and joint positions that correct them: for the terminal and for programs."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table
from scipy.spatial.transform import Rotation

from fg_calib.inputs import Floats, shorten
from fg_calib.io import Result, Units, fill_folder, pose_columns, require_absent, write_csv
from fg_calib.prediction import Correction, PredictedErrors, ToolErrors, summed_up
from fg_calib.report import tables
from fg_calib.report.charts import standalone
from fg_calib.report.figures import error_slices
from fg_calib.report.tables import POSE_KINDS, figure, in_words, line, section, table_of
from fg_calib.report.text import verdict_word
from fg_calib.robot import Robot

NOT_NEAR = ", where nothing was measured near"

MAX_LISTED = 20
"""Configurations, or targets, that a report lists; the tables have all."""

FRAMES = {"base": "in the base frame", "fitted": "after the best rigid fit"}

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
    sizes = {**_frames(errors), "total": found.with_joint_noise}
    of_worst: dict[str, Any] | None = None
    if worst is not None:
        of_worst = _configuration(worst.errors, 0, "" if worst.row is None else names[worst.row], worst.far)
        classes = {p.name: p.identifiability for p in result.parameters}
        shares = [vars(p) | {"identifiability": classes[p.name]} for p in worst.responsible]
        of_worst |= {"axes": worst.axes, "sigma": worst.sigma, "responsible": shares}
    return tables.document_of(
        "predict",
        found,
        "unknown undetermined limit within",
        **{key: getattr(result, key) for key in ("robot", "findings", "reservations")},
        trustworthy=not result.findings,
        at="configurations" if found.given else "workspace",
        n=len(errors.readings),
        counts="fitted" if found.fitted else "base",
        expected={
            key: None if of is None else dict(zip(POSE_KINDS, map(summed_up, of.T), strict=False))
            for key, of in sizes.items()
        },
        far=np.mean(found.far),
        worst=of_worst,
        configurations=[_configuration(errors, k, names[k], found.far[k]) for k in range(len(names) * found.given)],
    )


def _names(found: PredictedErrors, ids: Sequence[str]) -> tuple[str, ...]:
    """Names of the configurations; drawn ones have numbers."""
    return tuple(ids) or tuple(map(str, range(len(found.errors.readings))))


def _frames(errors: ToolErrors) -> Mapping[str, Floats | None]:
    return {"base": errors.base, "fitted": errors.fitted, "joint_noise": errors.joint_noise}


def _configuration(errors: ToolErrors, k: int, name: str, far: bool) -> dict[str, Any]:
    known = {key: of for key, of in _frames(errors).items() if of is not None}
    kinds = {"joint_noise": None} | {key: dict(zip(POSE_KINDS, of[k], strict=True)) for key, of in known.items()}
    return {"id": name, "readings": errors.readings[k], "position": errors.position[k], **kinds, "near": not far}


FILES = {"predict.json": b'{\n "schema": "fg-calib/predict/', "predict.csv": b"id,", "predict.svg": b"<svg"}
"""Files that `write_prediction` may write, and how each begins."""


def write_prediction(
    folder: Path, found: PredictedErrors, result: Result, robot: Robot, ids: Sequence[str], units: Units
) -> None:
    """Write `predict.json` and `predict.csv` into a folder, all or none; over the workspace also its picture.

    Args:
        folder: Where to.
        found: The prediction.
        result: The result of the calibration.
        robot: The calibrated robot.
        ids: Names of the configurations; empty where they were not given.
        units: Of joint values and positions in the table; errors are in mm and deg.

    Raises:
        InputError: The folder cannot be written.
    """
    errors = found.errors
    columns: dict[str, Any] = {"id": np.array(_names(found, ids), dtype=np.str_)}
    columns |= pose_columns(robot, errors.readings, errors.position, None, units)
    for name, of in _frames(errors).items():
        for column, (kind, unit) in zip(() if of is None else of.T, POSE_KINDS.items(), strict=False):
            columns[f"{name}_{kind}_{tables.shown_in(unit).unit}"] = column * tables.shown_in(unit).factor
    columns["measured_near"] = np.where(found.far, "no", "yes")
    document = tables.json_text(prediction_document(found, result, ids))
    files: dict[str, Any] = {"predict.json": document, "predict.csv": partial(write_csv, columns=columns)}
    if not found.given and found.unknown < 1.0:
        files["predict.svg"] = standalone(error_slices(errors.position, found.expected[:, 0], found.measured))
    fill_folder(folder, files, FILES)


def build_prediction_report(found: PredictedErrors, result: Result, robot: Robot, ids: Sequence[str] = ()) -> Group:
    """A prediction for the terminal.

    Args:
        found: The prediction.
        result: The result of the calibration.
        robot: The calibrated robot.
        ids: Names of the configurations, where they were given.
    """
    n, names = len(found.errors.readings), _names(found, ids)
    where = f"at {n} configurations" if found.given else "over the workspace"
    in_part = ", as far as it is known" * bool(found.unknown)
    return tables.report(
        line(f"{result.robot}: expected error of the tool {where}", "bold"),
        line(f"the calibration was {verdict_word(result)}", "bold red" if result.findings else "bold green"),
        *(*result.findings, *result.reservations),
        *section("Expected error, by the covariance of the calibration", size_table(found), *percentages(found)),
        *section(f"Where it is largest{in_part}", *_worst_in_words(found, robot, names)),
        *section("Parameters that it comes from there", _responsible(found, result)),
        *section("Configurations", *[_configurations(found, robot, names)] if found.given else []),
        *section("Notes", *_prediction_notes(found, robot)),
    )


def size_table(found: PredictedErrors) -> Table:
    """RMS and quantiles, in both frames, with joint noise and without."""
    order = ("fitted", "base") if found.fitted else ("base", "fitted")
    errors: dict[str, Floats | None] = {FRAMES[name]: getattr(found.errors, name) for name in order}
    errors[f"{FRAMES[order[0]]}, with joint noise"] = found.with_joint_noise
    rows: list[tuple[Any, ...]] = []
    for frame, of in errors.items():
        sizes = [] if of is None else [summed_up(column) for column in of.T]
        for name, unit, size in zip((frame, ""), POSE_KINDS.values(), sizes, strict=False):
            rows.append((name, unit, *size.values()))
    return table_of(("", "|unit", "RMS|q", "median|q", "95 % below|q", "largest|q"), rows)


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


def _worst_in_words(found: PredictedErrors, robot: Robot, names: Sequence[str]) -> Iterator[str]:
    if (worst := found.worst) is None:
        return
    x, y, z = (f"{v:.4f}" for v in worst.errors.position[0])
    at = "" if worst.row is None else f"{names[worst.row]}: "
    size = in_words(float(np.linalg.norm(worst.sigma)), "m", ".4f")
    yield f"{at}{size} with the tool at x {x}, y {y}, z {z} m from the base{NOT_NEAR * worst.far}"
    readings = zip(robot.joints, worst.errors.readings[0], strict=True)
    joints = (f"{joint.name} {in_words(q, joint.unit, '.2f')}" for joint, q in readings)
    yield f"joints: {', '.join(joints)}"
    axis, (first, *across) = ", ".join(f"{v:+.2f}" for v in worst.axes[0]), [figure(v, "m") for v in worst.sigma]
    yield f"1 sigma is {first} mm along ({axis}), {' and '.join(across)} mm across"


def _responsible(found: PredictedErrors, result: Result) -> Table:
    """The parameters responsible for the largest error: the error's fall if known, and what goes with 1 sigma of it."""
    classes = {p.name: p.identifiability for p in result.parameters}
    worst = () if found.worst is None else found.worst.responsible
    rows = [(p.name, p.share, in_words(p.change, p.unit, "+.3g"), classes[p.name]) for p in worst]
    return table_of(("", "mean square falls if known by|.0%", "with 1 sigma along it|>", "class"), rows)


def _configurations(found: PredictedErrors, robot: Robot, names: Sequence[str]) -> Table:
    """The given configurations, the worst first."""
    error = np.where(np.isnan(found.expected[:, 0]), np.inf, found.expected[:, 0])
    near = np.where(found.far, "no", "yes").tolist()
    rows = [(names[k], *found.errors.readings[k], *found.expected[k], near[k]) for k in np.argsort(-error).tolist()]
    return table_of(("", *tables.joint_columns(robot, ":.2f"), "mm|m", "deg|rad", "near|>"), rows, most=MAX_LISTED)


def _prediction_notes(found: PredictedErrors, robot: Robot) -> Iterator[str]:
    yield "Errors are RMS, from the specified noise and prior sigmas. Unmodelled effects are not included."
    yield from _assumed(robot, found.context)
    if not found.given:
        unlimited = [j.name for j in robot.joints if not np.isfinite(j.upper - j.lower)]
        instead = f" ({', '.join(unlimited)} without any: +-180 deg, or +-1 m)" if unlimited else ""
        yield f"{len(found.errors.readings)} configurations were drawn within the joint limits{instead}."
    if found.fitted:
        yield "Nothing was measured in the base frame: errors count after the best rigid fit to all measurements."
    if found.errors.joint_noise is None:
        yield "The job specifies no joint noise: the repeatability of the arm is not in these errors."


def _errors(correction: Correction) -> dict[str, dict[str, Floats]]:
    """Errors at the targets by what they are of, then by kind, shape (n,); orientations only where they are wanted."""
    kinds = {of: list(POSE_KINDS)[: 2 if correction.turns or of == "expected" else 1] for of in ERRORS}
    return {of: dict(zip(kinds[of], getattr(correction, of).T, strict=False)) for of in ERRORS}


def correction_document(name: str, ids: Sequence[str], correction: Correction) -> dict[str, Any]:
    """The content of `correct --json`: [m], [rad]; null where it is unknown.

    Args:
        name: The robot's name.
        ids: The targets' names.
        correction: The commands.
    """
    keys = ("reached", "readings", "nominal_readings", "position")
    quaternion = Rotation.from_matrix(correction.rotation.copy()).as_quat(canonical=True)
    errors = _errors(correction)
    targets = [
        {"id": target, **{key: getattr(correction, key)[i] for key in keys}, "quaternion_xyzw": quaternion[i]}
        | {of: {kind: values[i] for kind, values in kinds.items()} for of, kinds in errors.items()}
        for i, target in enumerate(ids)
    ]
    counts = {"n_targets": len(ids), "n_reached": int(correction.reached.sum())}
    return tables.document_of("correct", correction, "expected_fitted", robot=name, **counts, targets=targets)


def build_correction_report(ids: Sequence[str], correction: Correction, robot: Robot) -> Group:
    """Commands for the terminal.

    Args:
        ids: The targets' names.
        correction: The commands.
        robot: The calibrated robot.
    """
    return tables.report(
        line(f"{robot.name}: {int(correction.reached.sum())} of {len(ids)} targets can be reached", "bold"),
        line(""),
        _target_errors(correction),
        *section("Joint positions to command", _commands(ids, correction, robot)),
        *section("Notes", *_correction_notes(ids, correction, robot)),
    )


def _target_errors(correction: Correction) -> Table:
    rows: list[tuple[Any, ...]] = []
    for of, kinds in _errors(correction).items():
        for kind, values in kinds.items():
            known = values[np.isfinite(values)]
            sizes = (np.sqrt(np.mean(known**2)), known.max()) if len(known) else (None, None)
            rows.append((ERRORS[of] if kind == "position" else "", *sizes, POSE_KINDS[kind]))
    rows.append(("the same after the best rigid fit of all targets", correction.expected_fitted, "", "m"))
    return table_of(("error at the targets", "RMS|q|-", "largest|q|-", "|unit"), rows)


def _commands(ids: Sequence[str], correction: Correction, robot: Robot) -> Table:
    """Joint positions and errors of the targets."""
    before, after = correction.uncorrected[:, 0], np.hypot(correction.missed[:, 0], correction.expected[:, 0])
    rows = [(*of, b, a) for *of, b, a in zip(ids, *correction.readings.T, before, after, strict=True)]
    return table_of(("target", *tables.joint_columns(robot), "before mm|m|-", "after mm|m|-"), rows, most=MAX_LISTED)


def _assumed(robot: Robot, known: Collection[str]) -> Iterator[str]:
    if words := [one for effect in robot.effects for one in effect.assumed(known)]:
        yield f"Taken for granted: {', '.join(dict.fromkeys(words))}."


def _correction_notes(ids: Sequence[str], correction: Correction, robot: Robot) -> Iterator[str]:
    yield from _assumed(robot, correction.context)
    yield "Give the controller the joint positions; or the poses that --out writes, with its nominal model unchanged."
    point = correction.missed[:, 0] < 1e-9
    doubts = {
        "Reached with the point alone, the tool rotated as near as the arm can": ~correction.reached & point,
        "Out of reach within the joint limits": ~correction.reached & ~point,
        "Look at these first: a joint changes far (singularity, another branch, or another tool)": correction.far,
    }
    for words, rows in doubts.items():
        if rows.any():
            yield f"{words}: {shorten([ids[i] for i in np.flatnonzero(rows).tolist()], 5)}."
    if np.isnan(correction.expected).any():
        yield "The expected error is unknown where it depends on what the calibration did not determine."


def write_commands(path: Path, ids: tuple[str, ...], correction: Correction, robot: Robot, units: Units) -> None:
    """Write a table of commands, whole or not at all.

    Columns: `id`; `reached`: yes, or no; joint values by the joints' names (`q1 ... qn` where these mean something else
    in a table); `x y z qx qy qz qw`, the pose to command from the base; `uncorrected_position` and
    `uncorrected_orientation`, how far the nominal values miss; `missed_position` and `missed_orientation`, what is left
    where a target is out of reach; `expected_position` and `expected_orientation`, the RMS error to expect. Figures are
    in the units given; an empty cell is unknown.

    Args:
        path: The CSV, a new file.
        ids: The targets' names.
        correction: The commands.
        robot: Whose joints they are of.
        units: Of the figures.

    Raises:
        InputError: The table cannot be written, or is there already.
    """
    columns: dict[str, Any] = {"id": np.array(ids, dtype=np.str_), "reached": np.where(correction.reached, "yes", "no")}
    columns |= pose_columns(robot, correction.readings, correction.position, correction.rotation, units)
    for of, kinds in _errors(correction).items():
        columns |= {f"{of}_{kind}": values / units.factor(POSE_KINDS[kind]) for kind, values in kinds.items()}
    require_absent(path.parent, [path.name])
    write_csv(path, columns)
