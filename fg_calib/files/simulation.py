"""Simulations, written as calibration jobs that run as they are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fg_calib.files.csv_writer import write_csv
from fg_calib.files.disk import fill_folder, require_absent, write_text
from fg_calib.files.robot_yaml import write_robot
from fg_calib.files.units import Units
from fg_calib.files.urdf import write_urdf
from fg_calib.simulation.scenario import Simulation


def write_simulation(folder: Path | str, simulation: Simulation) -> tuple[str, ...]:
    """Write a simulation as a calibration job that runs as it is, all of its files or none.

    The files are `robot_nominal.yaml`, `robot_true.yaml` (each with its `.urdf` where the robot is from one),
    `poses.csv` and `calibration.yaml`, which names the true robot as `truth`.

    Args:
        folder: Where to; existing files of these names are replaced.
        simulation: What to write.

    Returns:
        The names of the files.

    Raises:
        InputError: The folder cannot be written.
    """
    scenario = simulation.scenario
    units = Units(length=scenario.length_unit, angle=scenario.angle_unit)

    def write(into: Path) -> None:
        for name, robot in (("robot_nominal", simulation.robot), ("robot_true", simulation.true_robot)):
            urdf_name = None if robot.urdf is None else f"{name}.urdf"
            if urdf_name is not None:
                write_urdf(into / urdf_name, robot)
            write_robot(into / f"{name}.yaml", robot, units=units, urdf_name=urdf_name)
        write_csv(into / "poses.csv", _pose_columns(simulation, units))
        write_text(into / "calibration.yaml", _job_text(simulation, units))

    fill_folder(Path(folder), write)
    return simulation_files(simulation)


def require_no_other_job(folder: Path, simulation: Simulation) -> None:
    """Check that a folder holds no files that a simulation would replace, but for those of another simulation.

    Raises:
        InputError: It does.
    """
    try:
        if (folder / "calibration.yaml").read_text(encoding="utf-8", errors="replace").startswith(_FIRST_WORDS):
            return
    except OSError:
        pass
    require_absent(folder, simulation_files(simulation))


_FIRST_WORDS = "# fg-calib simulate "
"""How the job of a simulation begins."""


def simulation_files(simulation: Simulation) -> tuple[str, ...]:
    """The names of the files of a simulation."""
    urdfs = ("robot_nominal.urdf", "robot_true.urdf") if simulation.robot.urdf is not None else ()
    return tuple(sorted(("calibration.yaml", "poses.csv", "robot_nominal.yaml", "robot_true.yaml", *urdfs)))


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
    m, scenario = simulation.measurements, simulation.scenario
    if m.sigma_position is None or m.sigma_orientation is None:
        raise ValueError("a simulation states its noise")
    joint = [
        units.from_si(sigma, joint.unit) for sigma, joint in zip(m.sigma_joint, simulation.robot.joints, strict=True)
    ]
    job = {
        "robot": "robot_nominal.yaml",
        "measurements": "poses.csv",
        "truth": "robot_true.yaml",
        **simulation.job,
        "units": asdict(units),
        "noise": {
            "position": units.from_si(m.sigma_position[0, 0], "m"),
            "orientation": units.from_si(m.sigma_orientation[0, 0], "rad"),
            "joint": joint[0] if len(set(joint)) == 1 else joint,
        },
    }
    command = f"{_FIRST_WORDS}{scenario.source} --seed {simulation.seed}\n"
    return command + yaml.safe_dump(job, sort_keys=False, default_flow_style=None, allow_unicode=True, width=math.inf)
