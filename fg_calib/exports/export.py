"""The door to all formats: a calibration or a robot, and the text that others read."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fg_calib import __version__, inputs, report
from fg_calib.calibration import Calibration
from fg_calib.exports import dh
from fg_calib.exports.poe import link_content, screw_content
from fg_calib.exports.urdf import BASE_LINK, TOOL_LINK, dumped, new_urdf, tesseract_text, ur_kinematics
from fg_calib.exports.zeros import Zero, tell_zeros
from fg_calib.inputs import Floats, InputError, Record, as_floats, checked, expect, printable, shown
from fg_calib.io import Units, effects_mapping, require_absent, robot_text, urdf_text, write_text
from fg_calib.robot import CONVENTIONS, PARAMETER_KINDS, Robot, UrdfSource, build_chain, frame_values, spline

EXACT = 1e-9
"""A table is exact if its tool is that of the arm within, [m] and [rad]."""

_MM_DEG = Units("mm", "deg")

_TABLES: Mapping[str, tuple[dh.TableConvention, str]] = {
    "dh": ("dh", "Denavit and Hartenberg"),
    "mdh": ("mdh", "Craig (modified Denavit-Hartenberg)"),
    "mdh-hayati": ("mdh-hayati", "Hayati: rows of Craig with beta"),
    "hayati": ("dh-hayati", "Hayati: rows of Denavit and Hartenberg, with beta in place of d between parallel axes"),
}


class Export(Record):
    """An arm as others read it.

    Attributes:
        to: The format.
        robot: The arm's name.
        text: Content of the file.
        notes: Notes on what the format could not hold, where it is instead, and the like: a line each.
        findings: Why the calibration is not to be trusted; empty if it is, or of a robot.
        not_accepted: The limits of `accept` that it does not keep to.
        details: The same as figures: see `document`.
        effects: Text of the files that hold the effects that the format cannot hold, by how their names end.
    """

    to: str
    robot: str
    text: str = field(repr=False)
    notes: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()
    not_accepted: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict, repr=False)
    effects: Mapping[str, str] = field(default_factory=dict, repr=False)

    @checked
    def write(self, path: Path | str) -> None:
        """Write the file, whole or not at all, and next to it what of effects it cannot hold.

        Raises:
            InputError: A file is there already, or cannot be written.
        """
        path = Path(path)
        texts = {path: with_names(self.text, path.stem)}
        texts |= {path.with_name(path.stem + end): text for end, text in self.effects.items()}
        require_absent(path.parent, [one.name for one in texts])
        for one, text in texts.items():
            write_text(one, text)

    def document(self) -> dict[str, Any]:
        """The document of `--json`.

        { "schema": "fg-calib/export/1", "version", "to", "robot", "text", "notes": [text], "findings": [text],
          "not_accepted": [text],
          of tables: "convention", "exact", "reasons": [text], "error": {errors},
          "effects": {end of a file's name: text},
          of poe: "axes": {joint: {"offset", "tilt", "sigma": {x, y, pitch, roll, offset, tilt: those known}}},
          of zeros: "zeros": {joint: {see `Zero`}}, "before", "after": {"workspace": {errors}, "measured": ...},
          of ur: "base", "hash", "tool0_T_tool": [[...]], of tesseract: "joints": [names] }

        with errors as in `PoseErrors`; SI.
        """
        keys = "to robot text notes findings not_accepted effects"
        return report.document_of("export", self, keys, **self.details)

    def __str__(self) -> str:
        return self.text


def with_names(text: str, stem: str) -> str:
    """Text with the real names of the files of effects next to a file, but for a name that no comment can hold."""
    return re.sub(r"\*(?=_curves\.csv|_effects\.yaml)", lambda _: "*" if "--" in stem else printable(stem), text)


@checked
def export(
    arm: Robot | Calibration,
    to: inputs.ExportFormat,
    *,
    nominal: Robot | None = None,
    configurations: ArrayLike | None = None,
    tool: inputs.ToolOfZeros = "calibrated",
    far: bool = False,
    ur_base: inputs.UrBase | None = None,
    ur_hash: str | None = None,
) -> Export:
    """An arm in a format of others: `print(export(result, "ur"))`, `export(result, "urdf").write("arm.urdf")`.

    Args:
        arm: A calibration, or a robot.
        to: `urdf`, `ur` (ROS' ur_description), `tesseract` (joint origins), `dh`, `mdh`, `mdh-hayati`, `hayati`, `cpc`
            (tables in mm and deg), `poe` (axes at zero readings), `zeros` (joint zeros alone), `yaml` (a robot file).
        nominal: The nominal robot, for `zeros` and the axis report of `poe`; a calibration has it.
        configurations: Of `zeros`: where the fit is wanted, shape (n, n_joints), [rad] (prismatic: [m]); all over the
            joint limits if None.
        tool: Of `zeros`: the tool that the controller works with: as calibrated, as it is set there on its own and the
            tool of a calibration is often an instrument's target; or nominal, so that zeros make up for it.
        far: Of `dh` and `mdh`: take common normals of nearly parallel axes however far away they are, and be exact.
        ur_base: Of `ur`: the frame that the arm's base is; if None `base_link` if a URDF calls it so, else `base`.
        ur_hash: Of `ur`: the controller's own hash, for which the driver asks.

    Raises:
        InputError: The format cannot hold the arm, its nominal robot is unknown or another, or an option means nothing.
    """
    given: dict[str, Any] = {"configurations": configurations is not None, "tool": tool != "calibrated", "far": far}
    given |= {"ur_base": ur_base, "ur_hash": ur_hash}
    for name, value in given.items():
        if value not in (None, False) and to not in _ONLY_IN[name]:
            raise InputError(name, f"means nothing for {to}", f"the format {' or '.join(_ONLY_IN[name])}")
    if isinstance(arm, Calibration):
        robot, nominal, doubts = arm.robot, nominal or arm.nominal, (arm.findings, arm.not_accepted)
    else:
        robot, doubts = arm, ((), ())
    kinds = [(joint.name, joint.prismatic) for joint in robot.joints]
    if nominal is not None and [(joint.name, joint.prismatic) for joint in nominal.joints] != kinds:
        raise InputError("nominal", f"{nominal.name} has other joints", ", ".join(name for name, _ in kinds))
    left_out, files = list[str](), dict[str, str]()
    if robot.effects and not (to == "yaml" and robot.urdf is None):
        left_out, files = _left_out(robot, to, arm.measured if isinstance(arm, Calibration) else None)
        robot = robot.geometry
    comments = [f"by fg-calib {__version__}", *(f"NOT TO BE TRUSTED: {finding}" for finding in doubts[0])]
    comments += [*(f"not accepted: {reason}" for reason in doubts[1]), *left_out]
    formats: dict[str, Callable[[], _Content]] = {
        "urdf": lambda: _urdf(robot, comments),
        "ur": lambda: _ur(robot, ur_base, ur_hash),
        "tesseract": lambda: _tesseract(robot),
        "poe": lambda: screw_content(arm, nominal),
        "cpc": lambda: link_content(robot),
        "zeros": lambda: _zeros(arm, nominal, tool, configurations),
        "yaml": lambda: _yaml(robot),
    }
    text, notes, details = formats[to]() if to in formats else _table(robot, to, far)
    if to != "urdf":
        text = "".join(f"# {printable(comment)}\n" for comment in (*comments, *notes)) + text
    return Export(to, robot.name, text, (*left_out, *notes), *doubts, details, files)


def _left_out(robot: Robot, to: str, measured: Floats | None) -> tuple[list[str], dict[str, str]]:
    """A note on the effects of an arm, with the error without them, and the files that hold them, in SI units."""
    mapping, where = effects_mapping(robot), "over the joint limits" if measured is None else "where it was measured"
    values = {name: value for name, value in mapping.pop("values", {}).items() if not name.endswith(".curve")}
    error = dh.errors(robot.geometry, robot, dh.drawn(robot, dh.N_JUDGED, 1) if measured is None else measured)
    note = f"it cannot hold {', '.join(mapping)}, without which the tool is off {where}: {error}"
    assumed = ", ".join(words for effect in robot.effects for words in effect.assumed())
    note += f" (at {assumed}; more otherwise)" * bool(assumed)
    if to == "zeros":  # which are fitted to the arm with them
        return [note], {}
    rows, files, angle = list[str](), dict[str, str](), np.radians(np.arange(-180.0, 180.0, 0.5))
    for joint, _, values_of_curve in build_chain(robot).curves:
        knots, weights = spline(angle, len(values_of_curve))
        turns = np.sum(weights * values_of_curve[knots], axis=1)
        name = json.dumps(robot.joints[joint].name, ensure_ascii=False)
        rows += [f"{name},{q:.9g},{turn:.9g}" for q, turn in zip(angle, turns, strict=True)]
    if rows:
        files["_curves.csv"] = "\n".join(["joint,angle,correction", *rows, ""])
    if mapping.keys() - {"error_curve"}:
        of = f"# in the frames, and with the names, of {robot.name} as {robot.convention}\n"
        files["_effects.yaml"] = of + dumped({"effects": mapping | {"values": values}})
    return [f"{note}; next to it: {', '.join(f'*{end}' for end in files)} in rad and SI units"], files


_Content = tuple[str, Sequence[str], dict[str, Any]]
"""Text of a format, without comments unless it is XML; notes, and details as in `Export`."""

_ONLY_IN = {"configurations": ["zeros"], "tool": ["zeros"], "far": ["dh", "mdh"], "ur_base": ["ur"], "ur_hash": ["ur"]}
"""The formats for which an option means something."""


def _frame_words(robot: Robot, owner: int) -> str:
    """A frame of an arm in words; empty where it is none."""
    own = [robot.parameters[i] for i in robot.owned_by(owner)]
    return ", ".join(f"{p.kind} {_MM_DEG.from_si(p.nominal, p.unit):.9g}" for p in own if p.nominal != 0.0)


def _frames_outside(robot: Robot, urdf: UrdfSource) -> list[str]:
    """Notes that a URDF has no place for the arm's base and tool, if any."""
    start, end = f"base, which is before link {urdf.base_link}", f"tool, which is behind link {urdf.tip_link}"
    owners = {start: 0, end: robot.n_joints + 1}
    found = {name: [robot.parameters[i].nominal for i in robot.owned_by(owner)] for name, owner in owners.items()}
    form = 'it has no place for the frame {0}: <origin xyz="{1:.9g} {2:.9g} {3:.9g}" rpy="{6:.9g} {5:.9g} {4:.9g}"/>'
    return [form.format(name, *values) for name, values in found.items() if any(values)]


def _urdf(robot: Robot, comments: Sequence[str]) -> _Content:
    if robot.urdf is not None:
        return urdf_text(robot), _frames_outside(robot, robot.urdf), {}
    notes = [
        f"the same arm to rounding: link {BASE_LINK} is the base frame, {TOOL_LINK} the tool; joints turn about z",
        "URDF knows no slide without limits, which has 1000 m here, and no turn with one limit, which has none",
        "effort and velocity in <limit> are 0: they are not known",
    ]
    return new_urdf(robot, [printable(c) for c in (*comments, *notes)]), notes, {}


def _ur(robot: Robot, base: inputs.UrBase | None, word: str | None) -> _Content:
    base = base or ("base_link" if robot.urdf and robot.urdf.base_link.endswith("base_link") else "base")
    if word is not None and (not word.isprintable() or " " in word or not word):
        raise InputError("ur_hash", f"found {shown(word)}", "a word such as calib_12788084448423163542")
    kinematics, tool = ur_kinematics(robot, base)
    own = f"fg_calib_{sha256(repr(kinematics).encode()).hexdigest()[:16]}"  # which no controller has
    notes = [f"kinematics_parameters_file of ur_description; its frame {base} is the base of {robot.name}"]
    values = frame_values("tool", tool)
    if max(map(abs, values.values())) > EXACT:
        words = ", ".join(f"{k} {_MM_DEG.from_si(v, 'm' if k in 'xyz' else 'rad'):.9g}" for k, v in values.items())
        notes.append(f"the tool is not in it: from tool0 it is at {words} (mm, deg; Rz(yaw) Ry(pitch) Rx(roll))")
    if word is None:
        notes.append("the driver will say that the controller's hash is another: its own kinematics are")
    details = {"base": base, "hash": word or own, "tool0_T_tool": tool.tolist()}
    return dumped({"kinematics": {**kinematics, "hash": word or own}}), notes, details


def _tesseract(robot: Robot) -> _Content:
    text, joints = tesseract_text(robot)
    notes = [f"joints of the URDF that `export --to urdf` makes; {joints[0]} and {joints[-1]} are base and tool"]
    notes = notes if robot.urdf is None else _frames_outside(robot, robot.urdf)
    return text, [*notes, 'named in the SRDF: <calibration_config filename="..."/>'], {"joints": joints}


def _table(robot: Robot, to: str, far: bool) -> _Content:
    convention, words = _TABLES[to]
    table = dh.in_table(robot, convention, np.inf) if far else dh.in_table(robot, convention)
    found = table.robot
    if table.nearly:
        found = dh.fit_parameters(found, robot, dh.drawn(robot, dh.N_FITTED, 0))
    error = dh.errors(found, robot, dh.drawn(robot, dh.N_JUDGED, 1))
    exact = max(error.position_max, error.rotation_max) <= EXACT
    reasons = [] if exact else [str(nearly) for nearly in table.nearly] or ["figures too large for their digits"]
    order = " ".join(f"{PARAMETER_KINDS[kind].axis.name.capitalize()}({kind})" for kind in CONVENTIONS[convention])
    notes = [f"{words}: {order} a joint; readings are added to theta, of slides to d; mm and deg"]
    if exact:
        notes.append(f"the same arm, base and tool hold what rows do not; over {error.n} configurations {error}")
    else:
        notes += [f"NOT EXACT: {reason}" for reason in reasons]
        notes.append(f"the best fit over the joint limits, base and tool included: {error}")
    details = {"convention": convention, "exact": exact, "reasons": reasons, "error": asdict(error)}
    return robot_text(found, units=_MM_DEG), notes, details


def _yaml(robot: Robot) -> _Content:
    if robot.urdf is None:
        return robot_text(robot), [], {}
    note = "the same arm as rows of dh-hayati, as it came from a URDF: `--to urdf` writes that"
    return robot_text(dh.in_table(robot, "dh-hayati").robot), [note], {}


def _zeros(arm: Robot | Calibration, start: Robot | None, tool: inputs.ToolOfZeros, at: ArrayLike | None) -> _Content:
    if start is None:
        raise InputError("zeros", "an arm without its nominal robot", "a RESULT of calibrate, or a nominal robot")
    robot = arm.robot if isinstance(arm, Calibration) else arm
    fitted, given = dh.drawn(robot, dh.N_FITTED, 0), dict[str, Floats]()
    if at is not None:
        given["measured"] = fitted = as_floats("configurations", at, f"(n, {robot.n_joints})")
        expect(len(fitted), "configurations", "none", "at least one")
    behind = robot.n_joints + 1
    kept = (0, behind) if tool == "calibrated" else (0,)
    nominal = dh.with_frames_of(start, robot, kept)
    zeros = dh.fit_zeros(nominal, robot, fitted)

    def fit(one: Robot) -> Floats:
        return dh.step_zeros(dh.with_frames_of(start, one, kept), one, fitted, zeros)

    told = {joint.name: Zero(zero, joint.unit) for joint, zero in zip(robot.joints, zeros.tolist(), strict=True)}
    if isinstance(arm, Calibration) and not arm.result.evaluated_only:
        told = tell_zeros(arm, fit)
    notes = [
        "joint zeros, all else nominal: zero is what to add to a joint's reading (angle = reading + zero);",
        "it is subtracted from what is commanded, and from a stored encoder offset (angle = encoder - offset)",
        f"fitted at {len(fitted)} configurations {'given' if given else 'within the joint limits'}",
    ]
    tools = {which: _frame_words(one, behind) for which, one in (("nominal", start), ("calibrated", robot))}
    if tools["nominal"] != tools["calibrated"]:
        notes.append(f"with the {tool} tool: {tools[tool] or 'none'} (mm, deg)")
    details: dict[str, Any] = {"zeros": {name: asdict(zero) for name, zero in told.items()}, "before": {}, "after": {}}
    for name, q in (given | {"workspace": dh.drawn(robot, dh.N_JUDGED, 1)}).items():
        where = "over the joint limits" if name == "workspace" else "at the configurations given"
        for when, offsets in (("before", None), ("after", zeros)):
            error = dh.errors(nominal, robot, q, offsets)
            details[when][name] = asdict(error)
            notes.append(f"{when}, {where}: {error}")
    rows = {}
    for name, zero in told.items():
        sigma = "not determined" if not zero.determined else zero.sigma and _MM_DEG.from_si(zero.sigma, zero.unit)
        row = {"zero": _MM_DEG.from_si(zero.reading, zero.unit), "unit": _MM_DEG.name(zero.unit), "sigma": sigma}
        rows[name] = {key: value for key, value in (row | {"note": zero.note}).items() if value not in (None, "")}
        if zero.note:
            notes.append(f"{name} {'is' if zero.determined else 'is not determined and left at 0'}: {zero.note}")
    return dumped({"robot": robot.name, "zeros": rows}), notes, details
