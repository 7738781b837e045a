"""fg_calib: robot-arm calibration as a factor graph.

    robot = Robot.from_dh(rows, convention="dh-hayati", tool=[0, 0, 0.1])
    data = Measurements.from_arrays(q, position=p, sigma_position=1e-4)
    result = calibrate(robot, data, model="position", frame="unknown")
    print(result)

Names are imported when they are first used, so that `fg-calib --help` need not wait for GTSAM.
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

import lazy_loader  # type: ignore[import-untyped]

if TYPE_CHECKING:
    from fg_calib.assessment import Assessment, assess
    from fg_calib.baseline.comparison import compare
    from fg_calib.batch import calibrate_jobs
    from fg_calib.calibration import Calibration, calibrate, calibrate_job
    from fg_calib.designs.design import Design, design
    from fg_calib.exports.export import export
    from fg_calib.graph.build import build_problem
    from fg_calib.graph.factors import DistanceFactor, RotationAngleFactor
    from fg_calib.graph.problem import Problem
    from fg_calib.graph.solver import Solution, SolverOptions, solve
    from fg_calib.inputs import CalibrationError, InputError, ProblemError, SolverError
    from fg_calib.io.job import read_job
    from fg_calib.io.result import Result
    from fg_calib.io.robot_file import read_robot
    from fg_calib.job import Job
    from fg_calib.measurements.dataset import Measurements, Noise
    from fg_calib.measurements.table import CustomMeasurements, KnownPoint, Table
    from fg_calib.observability.identifiability import observe_configurations, observe_structure
    from fg_calib.options import Limits, Options, Pairing
    from fg_calib.predictions import correct, predict
    from fg_calib.robot.model import Robot
    from fg_calib.simulation.scenario import Scenario
    from fg_calib.simulation.simulator import simulate

__version__ = "0.1.0"

_import, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "assessment": ["Assessment", "assess"],
        "baseline.comparison": ["compare"],
        "batch": ["calibrate_jobs"],
        "calibration": ["Calibration", "calibrate", "calibrate_job"],
        "designs.design": ["Design", "design"],
        "inputs.errors": ["CalibrationError", "InputError", "ProblemError", "SolverError"],
        "exports.export": ["export"],
        "graph.build": ["build_problem"],
        "graph.factors": ["DistanceFactor", "RotationAngleFactor"],
        "graph.problem": ["Problem"],
        "graph.solver": ["Solution", "SolverOptions", "solve"],
        "io.job": ["read_job"],
        "io.result": ["Result"],
        "io.robot_file": ["read_robot"],
        "job": ["Job"],
        "measurements.dataset": ["Measurements", "Noise"],
        "measurements.table": ["KnownPoint", "CustomMeasurements", "Table"],
        "observability.identifiability": ["observe_configurations", "observe_structure"],
        "options": ["Limits", "Options", "Pairing"],
        "predictions": ["correct", "predict"],
        "robot.model": ["Robot"],
        "simulation.scenario": ["Scenario"],
        "simulation.simulator": ["simulate"],
    },
)

__all__ = [
    "Assessment",
    "Calibration",
    "CalibrationError",
    "CustomMeasurements",
    "Design",
    "DistanceFactor",
    "InputError",
    "Job",
    "KnownPoint",
    "Limits",
    "Measurements",
    "Noise",
    "Options",
    "Pairing",
    "Problem",
    "ProblemError",
    "Result",
    "Robot",
    "RotationAngleFactor",
    "Scenario",
    "Solution",
    "SolverError",
    "SolverOptions",
    "Table",
    "assess",
    "build_problem",
    "calibrate",
    "calibrate_job",
    "calibrate_jobs",
    "compare",
    "correct",
    "design",
    "export",
    "observe_configurations",
    "observe_structure",
    "predict",
    "read_job",
    "read_robot",
    "simulate",
    "solve",
]
"""The names of most users: 40. Others are public in the folders: `fg_calib.io`, `fg_calib.statistics`, ..."""

_READERS = {"Robot": ("from_urdf", "urdf", "read_urdf"), "Measurements": ("from_frame", "tables", "read_measurements")}
"""Constructors that read files, which the folders of these classes do not import: they are attached here."""


def __getattr__(name: str) -> Any:
    """Import a public name from the module that has it."""
    found = _import(name)
    if name in _READERS:
        constructor, module, reader = _READERS[name]
        setattr(found, constructor, staticmethod(getattr(import_module(f"fg_calib.io.{module}"), reader)))
    return found


logging.getLogger(__name__).addHandler(logging.NullHandler())
