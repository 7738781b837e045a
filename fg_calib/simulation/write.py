"""Simulations, written as calibration jobs that run as they are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fg_calib.arguments import checked
from fg_calib.errors import InputError
from fg_calib.io.atomic import fill_folder, read_text, write_text
from fg_calib.io.csv_writer import write_csv
from fg_calib.io.robot_file import write_robot
from fg_calib.io.units import Units
from fg_calib.io.urdf import write_urdf
from fg_calib.io.yaml import read_yaml
from fg_calib.simulation.scenario import Simulation
from fg_calib.simulation.simulated_tables import instrument_keys, table_columns, table_files, truth_in


@checked
def write_simulation(folder: Path | str, simulation: Simulation) -> tuple[str, ...]:
    """Write a simulation as a calibration job that runs as it is, all of its files or none.

    The files are `robot_nominal.yaml`, `robot_true.yaml` (each with its `.urdf` where the robot is from one),
    `calibration.yaml`, which names the true robot as `truth`, and `poses.csv`; with instruments a table for each in the
    place of that, and `truth.yaml`, where things truly are.

    Args:
        folder: Where to; files of these names are replaced where they are of another simulation.
        simulation: What to write.

    Returns:
        The names of the files.

    Raises:
        InputError: The folder cannot be written, or holds another job.
    """
    scenario, folder = simulation.scenario, Path(folder)
    units = Units(length=scenario.length_unit, angle=scenario.angle_unit)

    def write(into: Path) -> None:
        for name, robot in (("robot_nominal", simulation.robot), ("robot_true", simulation.true_robot)):
            urdf_name = None if robot.urdf is None else f"{name}.urdf"
            if urdf_name is not None:
                write_urdf(into / urdf_name, robot)
            write_robot(into / f"{name}.yaml", robot, units=units, urdf_name=urdf_name)
        for name, columns in _tables(simulation, units).items():
            write_csv(into / name, columns)
        if scenario.instruments:
            write_text(into / "truth.yaml", _yaml(truth_in(simulation, units)))
        write_text(into / "calibration.yaml", _job_text(simulation, units))

    names = simulation_files(simulation)
    fill_folder(folder, write, _OWN | dict.fromkeys((*names, *_earlier(folder)), b"") | _JOB)
    return names


_FIRST_WORDS = "# fg-calib simulate "
"""How the job of a simulation begins."""

_URDFS = ("robot_nominal.urdf", "robot_true.urdf")
_JOB = {"calibration.yaml": _FIRST_WORDS.encode()}
_OWN = _JOB | dict.fromkeys(("poses.csv", "robot_nominal.yaml", "robot_true.yaml", *_URDFS), b"")
"""What a simulation may write beside the tables of instruments, and how it begins."""


def _earlier(folder: Path) -> tuple[str, ...]:
    """The tables of a simulation that is in a folder, by its job."""
    job = folder / "calibration.yaml"
    try:
        if not job.is_file() or not read_text(job).startswith(_FIRST_WORDS):
            return ()
        tables = read_yaml(job).get("measurements")
    except InputError:
        return ()
    entries = [entry for entry in tables if isinstance(entry, dict)] if isinstance(tables, list) else []
    names = [entry.get(key) for entry in entries for key in ("table", "pairs")]
    found = [name for name in names if isinstance(name, str) and Path(name).name == name and name.endswith(".csv")]
    return (*found, "truth.yaml") if entries else ()


def simulation_files(simulation: Simulation) -> tuple[str, ...]:
    """The names of the files of a simulation."""
    urdfs = _URDFS if simulation.robot.urdf is not None else ()
    tables: tuple[str, ...] = ("poses.csv",)
    if simulation.scenario.instruments:
        tables = ("truth.yaml", *(name for table in simulation.tables for name in table_files(table)))
    return tuple(sorted(("calibration.yaml", "robot_nominal.yaml", "robot_true.yaml", *urdfs, *tables)))


def _tables(simulation: Simulation, units: Units) -> Mapping[str, Mapping[str, Any]]:
    """The columns of each table."""
    if not simulation.scenario.instruments:
        return {"poses.csv": _pose_columns(simulation, units)}
    return {
        name: columns
        for table in simulation.tables
        for name, columns in table_columns(table, simulation.robot, units).items()
    }


def _pose_columns(simulation: Simulation, units: Units) -> Mapping[str, Any]:
    """The table of poses, in the units of the job."""
    from scipy.spatial.transform import Rotation

    m, robot = simulation.measurements, simulation.robot
    if m.position is None or m.rotation is None:
        raise ValueError("a simulation measures positions and orientations")
    quaternion = Rotation.from_matrix(m.rotation.copy()).as_quat(canonical=True)
    return {
        "id": m.ids,
        **{f"q{i + 1}": m.readings[:, i] / units.factor(joint.unit) for i, joint in enumerate(robot.joints)},
        **{axis: m.position[:, k] / units.factor("m") for k, axis in enumerate("xyz")},
        **{f"q{axis}": quaternion[:, k] for k, axis in enumerate("xyzw")},
        "split": np.where(m.test, "test", "train"),
    }


def _job_text(simulation: Simulation, units: Units) -> str:
    m = simulation.measurements
    joint = [
        units.from_si(sigma, joint.unit) for sigma, joint in zip(m.sigma_joint, simulation.robot.joints, strict=True)
    ]
    of_joints = {"joint": joint[0] if len(set(joint)) == 1 else joint}
    job: dict[str, Any] = {"robot": "robot_nominal.yaml"}
    if simulation.scenario.instruments:
        keys = {key: value for key, value in simulation.scenario.job.items() if key not in ("model", "pairing")}
        job |= {"truth": "robot_true.yaml", **keys, "units": asdict(units), "noise": of_joints}
        job |= instrument_keys(simulation.tables, units)
    else:
        if m.sigma_position is None or m.sigma_orientation is None:
            raise ValueError("a simulation states its noise")
        noise = {
            "position": units.from_si(m.sigma_position[0, 0], "m"),
            "orientation": units.from_si(m.sigma_orientation[0, 0], "rad"),
        }
        job |= {"measurements": "poses.csv", "truth": "robot_true.yaml", **simulation.job}
        job |= {"units": asdict(units), "noise": noise | of_joints}
    return f"{_FIRST_WORDS}{simulation.scenario.source} --seed {simulation.seed}\n" + _yaml(job)


def _yaml(document: Mapping[str, Any]) -> str:
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, allow_unicode=True, width=math.inf)
