"""Simulations, written as calibration jobs that run as they are; tables of instruments, in the units of a file."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from fg_calib import inputs, io
from fg_calib.io import NOISE_UNITS, Units
from fg_calib.measurements import GENERIC_COLUMNS, INSTRUMENTS, Measurements, Pairs, Table
from fg_calib.robot import Robot, outside_joints, yaw_pitch_roll
from fg_calib.simulation.scenario import Placement, Plane, Spot
from fg_calib.simulation.simulator import Simulation

Columns = Mapping[str, Any]

_FIRST_WORDS = "# fg-calib simulate "
"""How the job of a simulation begins."""

MEASURED = (*"xyz", "qx", "qy", "qz", "qw", "angle", *"uv", *GENERIC_COLUMNS)
"""Columns of measured values."""


@inputs.checked
def write_simulation(folder: Path | str, simulation: Simulation) -> tuple[str, ...]:
    """Write a simulation as a calibration job that runs as it is, all of its files or none.

    The files are `robot_nominal.yaml`, `robot_true.yaml` (each with its `.urdf` where the robot is from one),
    `calibration.yaml`, which names the true robot as `truth`, and `poses.csv`; with instruments a table for each in the
    place of that, and `truth.yaml`, where landmarks truly are.

    Args:
        folder: Where to; files of these names are replaced where they are of another simulation, others stay.
        simulation: The simulation.

    Returns:
        The names of the files.

    Raises:
        InputError: The folder cannot be written, or holds another job.
    """
    folder, robots = Path(folder), {"robot_nominal": simulation.robot, "robot_true": simulation.true_robot}
    units = Units(length=simulation.scenario.length_unit, angle=simulation.scenario.angle_unit)
    files: dict[str, Any] = {}
    for name, robot in robots.items():
        urdf = None if robot.urdf is None else f"{name}.urdf"
        files |= {} if urdf is None else {urdf: partial(io.write_urdf, robot=robot)}
        files[f"{name}.yaml"] = partial(io.write_robot, robot=robot, units=units, urdf_name=urdf)
    for table in simulation.tables:
        for name, columns in table_columns(table, simulation.robot, units).items():
            files[name] = partial(io.write_csv, columns=columns)
    if simulation.scenario.instruments:
        truth = {kind: {n: _place(one, units) for n, one in found.items()} for kind, found in simulation.truth.items()}
        files["truth.yaml"] = _yaml({"units": asdict(units)} | truth)

    def write_job(path: Path) -> None:
        words, _, rest = _job_text(simulation, units).partition("\n")
        io.write_text(path, f"{words}; {_digest(path.parent, rest)}\n{rest}")

    files["calibration.yaml"] = write_job
    job = folder / "calibration.yaml"
    words, _, rest = io.read_text(job).partition("\n") if io.exists(job) else ("", "", "")
    if words.startswith(_FIRST_WORDS) and not words.endswith(_digest(folder, rest)):
        raise inputs.InputError(str(folder), "files that were changed since they were simulated", "another folder")
    own = {"calibration.yaml": _FIRST_WORDS.encode()}
    io.fill_folder(folder, files, own | dict.fromkeys(files, b"") | own)
    return tuple(sorted(files))


def _digest(folder: Path, job: str) -> str:
    """A digest of the tables and robots in a folder, and of the rest of their job."""
    files = [*folder.glob("*.csv"), *folder.glob("robot_*.yaml"), *folder.glob("*.urdf"), *folder.glob("truth.yaml")]
    return sha256(b"".join(path.read_bytes() for path in sorted(files)) + job.encode()).hexdigest()[:16]


# --- tables -----------------------------------------------------------------------------------------------------------


def _pairs(m: Measurements) -> tuple[Pairs, tuple[str, ...]] | None:
    """The pairs of a table and the names of their ends: configurations, or contact points."""
    if m.pairs is not None:
        return m.pairs, tuple(m.ids.tolist())
    if m.groups is not None and m.groups.pairs.n_pairs:
        return m.groups.pairs, m.groups.names
    return None


def table_columns(table: Table, robot: Robot, units: Units) -> dict[str, Columns]:
    """The columns of each of a simulated table's files, by the file's name.

    Args:
        table: The table.
        robot: The nominal robot.
        units: Of the files.
    """
    m, length = table.measurements, units.factor("m")
    columns: dict[str, Any] = {"id": m.ids}
    columns |= {f"q{i + 1}": m.readings[:, i] / units.factor(joint.unit) for i, joint in enumerate(robot.joints)}
    labels = {name: (of.names, of.index) for name, of in m.labels.items()}
    if m.groups is not None:
        labels["group"] = (m.groups.names, m.groups.index)
    columns |= {name: np.array(["", *names])[index + 1] for name, (names, index) in labels.items()}
    if m.position is not None:
        columns |= dict(zip("xyz", m.position.T / length, strict=True))
    if m.rotation is not None:
        quaternion = Rotation.from_matrix(m.rotation.copy()).as_quat(canonical=True)
        columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True))
    factors = {name: units.factor(joint.unit) for name, joint in outside_joints(robot).items()}
    columns |= {name: values / factors.get(name, 1.0) for name, values in m.context.items() if values.ndim == 1}
    sides = {name: values for name, values in m.context.items() if values.ndim == 2 and name != "moves"}
    columns |= {f"{name}{i + 1}": v for name, values in sides.items() for i, v in enumerate(values.T)}
    columns |= {name: values / units.factor(GENERIC_COLUMNS[name].si) for name, values in m.columns.items()}
    if m.image is not None:
        columns |= dict(zip("uv", m.image.T[:2], strict=True))
        columns |= dict(zip(("corner_x", "corner_y"), m.image.T[2:] / length, strict=True))
    found: dict[str, Columns] = {m.source: columns | {"split": np.where(m.test, "test", "train")}}
    if (between := _pairs(m)) is not None:
        pairs, names = between
        measured = {"distance": pairs.distance / length, "angle": pairs.angle / units.factor("rad")}
        ends = {"a": np.array(names)[pairs.a], "b": np.array(names)[pairs.b]}
        found[pairs.source] = ends | {name: v for name, v in measured.items() if np.isfinite(v).any()}
    return found


def to_fill_in(columns: Columns, *, touched: bool = False) -> Columns:
    """The columns of a table with nothing measured yet.

    Args:
        columns: The columns.
        touched: Whether something is touched: the joint readings are measured then.
    """
    empty = [name for name, v in columns.items() if name in MEASURED and np.any(np.asarray(v) != 0.0)]
    return {**columns, **dict.fromkeys([*empty, *(c for c in columns if touched and re.fullmatch(r"q\d+", c))])}


# --- the job ----------------------------------------------------------------------------------------------------------


def job_text(words: str, keys: Mapping[str, Any], tables: Sequence[Table], robot: Robot, units: Units) -> str:
    """A job of tables, each with its own keys.

    Args:
        words: Comments that it begins with.
        keys: Its other keys.
        tables: The tables.
        robot: The nominal robot.
        units: Of the job and the tables.
    """
    noise = {"joint": joint_noise(tables[0].measurements.sigma_joint, robot, units)}
    return words + _yaml({**keys, "units": asdict(units), "noise": noise} | instrument_keys(tables, units))


def _job_text(simulation: Simulation, units: Units) -> str:
    scenario, m, robot = simulation.scenario, simulation.measurements, simulation.robot
    words = f"{_FIRST_WORDS}{scenario.source} --seed {simulation.seed}\n"
    keys: dict[str, Any] = {"robot": "robot_nominal.yaml", "truth": "robot_true.yaml"}
    if scenario.instruments:
        return job_text(words, {**keys, **scenario.job}, simulation.tables, robot, units)
    keys |= {"measurements": m.source, **scenario.job, "frame": simulation.tables[0].frame, "units": asdict(units)}
    return words + _yaml(keys | {"noise": _noise(m, units) | {"joint": joint_noise(m.sigma_joint, robot, units)}})


def _yaml(document: Mapping[str, Any]) -> str:
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, allow_unicode=True, width=np.inf)


def joint_noise(sigma: inputs.Floats, robot: Robot, units: Units) -> float | list[float]:
    """Sigma of the joint readings as a job specifies it: one value, or one a joint."""
    values = [_rounded(units.from_si(s, joint.unit)) for s, joint in zip(sigma, robot.joints, strict=True)]
    return values[0] if len(set(values)) == 1 else values


def instrument_keys(tables: Sequence[Table], units: Units) -> dict[str, Any]:
    """Keys of a job for its tables, and for the points that it knows."""
    found: dict[str, Any] = {"measurements": [_entry(table, units) for table in tables]}
    for table in tables:
        if table.known:
            found[INSTRUMENTS[str(table.model)].key] = {
                name: _xyz(point.xyz, units)
                | ({} if point.tolerance is None else {"tolerance": units.from_si(point.tolerance, "m")})
                for name, point in table.known.items()
            }
    return found


def _entry(table: Table, units: Units) -> dict[str, Any]:
    """A table in the list of a job."""
    m, between, pairing = table.measurements, _pairs(table.measurements), table.pairing
    entry: dict[str, Any] = {"table": m.source, "model": table.model}
    if between is not None:
        entry["pairs"] = between[0].source
    elif table.model in inputs.PAIR_MODELS and m.groups is None:
        random = {"random": pairing.count, "seed": pairing.seed}
        entry["pairing"] = random if pairing.strategy == "random" else pairing.strategy
    if table.model in inputs.POSE_MODELS or table.fixed_camera:
        entry["frame"] = table.frame
    if table.offset:
        entry["offset"] = "estimate"
    if table.camera is not None:
        entry["camera"] = asdict(table.camera) | ({"fixed": True} if table.fixed_camera else {})
    return entry | {"noise": _noise(m, units)}


def _noise(m: Measurements, units: Units) -> dict[str, float]:
    """The sigmas of a simulated table: one a kind."""
    between = _pairs(m)
    sigmas = {kind: m.sigma(kind) for kind in NOISE_UNITS}
    if between is not None:
        sigmas |= {"distance": between[0].sigma_distance, "angle": between[0].sigma_angle}
    specified = {kind: float(s.flat[0]) for kind, s in sigmas.items() if s is not None and np.isfinite(s).any()}
    return {kind: _rounded(units.from_si(sigma, NOISE_UNITS[kind])) for kind, sigma in specified.items()}


def _rounded(sigma: float) -> float:
    """A sigma with the digits that a person writes: 0.03 of 0.029999999999999995."""
    return float(f"{sigma:.12g}")


# --- the truth --------------------------------------------------------------------------------------------------------


def _xyz(point: inputs.Floats, units: Units) -> dict[str, float]:
    return {axis: units.from_si(float(v), "m") for axis, v in zip("xyz", point, strict=True)}


def _place(landmark: Any, units: Units) -> Any:
    """True place of a landmark, as a scenario would state it, in a file's units."""
    match landmark:
        case Placement():
            yaw, pitch, roll = yaw_pitch_roll(landmark.rotation)
            angles = {"roll": roll, "pitch": pitch, "yaw": yaw}
            return _xyz(landmark.position, units) | {k: units.from_si(float(v), "rad") for k, v in angles.items()}
        case Spot():
            return _xyz(landmark.xyz, units)
        case Plane():
            return {"normal": landmark.normal.tolist(), "distance": units.from_si(landmark.distance, "m")}
    return units.from_si(float(landmark), "m")
