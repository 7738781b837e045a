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

if TYPE_CHECKING:
    from fg_calib.assessment import Assessment, assess, solve_job
    from fg_calib.baseline.comparison import Comparison, compare
    from fg_calib.baseline.least_squares import LeastSquares, fit_least_squares
    from fg_calib.batch import calibrate_jobs
    from fg_calib.calibration import Calibration, calibrate, calibrate_job, calibrate_parts
    from fg_calib.designs.design import Design, design
    from fg_calib.diagnostics.inspection import Inspection, inspect_job
    from fg_calib.diagnostics.multistart import multistart
    from fg_calib.diagnostics.setup_check import SetupCheck, check_setup
    from fg_calib.errors import CalibrationError, InputError, ProblemError, SolverError
    from fg_calib.executors import Failure, dask_executor, local_processes, map_jobs
    from fg_calib.exports.export import Export, export
    from fg_calib.graph.build import build_problem, problem_of
    from fg_calib.graph.extension import DistanceFactor, RotationAngleFactor, expand
    from fg_calib.graph.problem import Problem
    from fg_calib.graph.solver import Solution, SolverOptions, levenberg_marquardt_params, solve
    from fg_calib.initialization.camera import Camera
    from fg_calib.io.columns import Column
    from fg_calib.io.history import History, history_of
    from fg_calib.io.job import read_job
    from fg_calib.io.parts import JobInParts, read_parts
    from fg_calib.io.parts_solver import PartsSolution, cut, reduce_parts, solve_parts
    from fg_calib.io.result import Result, read_result, result_schema
    from fg_calib.io.robot_file import read_robot, write_robot
    from fg_calib.io.tables import read_measurements
    from fg_calib.io.targets import Targets, read_targets
    from fg_calib.io.units import Units
    from fg_calib.io.urdf import read_urdf
    from fg_calib.job import Job
    from fg_calib.measurements.dataset import Measurements, Noise
    from fg_calib.measurements.table import CustomMeasurements, KnownPoint, Table
    from fg_calib.monitoring.check import Check, Explanation
    from fg_calib.observability.cramer_rao import Bound, cramer_rao
    from fg_calib.observability.identifiability import Identifiability, observe_configurations, observe_structure
    from fg_calib.options import Limits, Options, Pairing
    from fg_calib.pages import write_report
    from fg_calib.prediction.correction import correct
    from fg_calib.prediction.predict import predict, write_prediction
    from fg_calib.prediction.prediction import PredictedErrors
    from fg_calib.report.comparison import format_comparison
    from fg_calib.report.documents import (
        comparison_document,
        observability_document,
        result_document,
        write_comparison,
        write_observability,
        write_results,
    )
    from fg_calib.report.identifiability import format_identifiability
    from fg_calib.report.inspection import format_inspection, inspection_document
    from fg_calib.report.text import format_report
    from fg_calib.robot.inverse import Inverse, solve_inverse
    from fg_calib.robot.kinematics import pose
    from fg_calib.robot.model import Robot
    from fg_calib.robot.reaching import Correction
    from fg_calib.simulation.scenario import (
        BoardViews,
        GivenReadings,
        RandomReadings,
        Scenario,
        TargetViews,
        read_scenario,
    )
    from fg_calib.simulation.simulator import Simulation, simulate
    from fg_calib.simulation.write import write_simulation
    from fg_calib.statistics.prior_scales import estimate_tolerances
    from fg_calib.statistics.variance_components import estimate_noise

__version__ = "0.1.0"

_HOMES = {
    "fg_calib.observability.cramer_rao": ("Bound", "cramer_rao"),
    "fg_calib.baseline.comparison": ("Comparison", "compare"),
    "fg_calib.batch": ("calibrate_jobs",),
    "fg_calib.calibration": ("Calibration", "calibrate", "calibrate_job", "calibrate_parts"),
    "fg_calib.prediction.correction": ("correct",),
    "fg_calib.designs.design": ("Design", "design"),
    "fg_calib.errors": ("CalibrationError", "InputError", "ProblemError", "SolverError"),
    "fg_calib.executors": ("Failure", "dask_executor", "local_processes", "map_jobs"),
    "fg_calib.exports.export": ("Export", "export"),
    "fg_calib.io.columns": ("Column",),
    "fg_calib.monitoring.check": ("Check", "Explanation"),
    "fg_calib.io.history": ("History", "history_of"),
    "fg_calib.io.job": ("read_job",),
    "fg_calib.io.parts": ("JobInParts", "read_parts"),
    "fg_calib.job": ("Job",),
    "fg_calib.io.result": ("Result", "read_result", "result_schema"),
    "fg_calib.io.urdf": ("read_urdf",),
    "fg_calib.robot.inverse": ("Inverse", "solve_inverse"),
    "fg_calib.robot.reaching": ("Correction",),
    "fg_calib.io.robot_file": ("read_robot", "write_robot"),
    "fg_calib.simulation.write": ("write_simulation",),
    "fg_calib.io.tables": ("read_measurements",),
    "fg_calib.io.targets": ("Targets", "read_targets"),
    "fg_calib.io.units": ("Units",),
    "fg_calib.observability.identifiability": ("Identifiability", "observe_configurations", "observe_structure"),
    "fg_calib.robot.kinematics": ("pose",),
    "fg_calib.baseline.least_squares": ("LeastSquares", "fit_least_squares"),
    "fg_calib.measurements.dataset": ("Measurements", "Noise"),
    "fg_calib.diagnostics.inspection": ("Inspection", "inspect_job"),
    "fg_calib.diagnostics.setup_check": ("SetupCheck", "check_setup"),
    "fg_calib.statistics.prior_scales": ("estimate_tolerances",),
    "fg_calib.statistics.variance_components": ("estimate_noise",),
    "fg_calib.graph.build": ("build_problem", "problem_of"),
    "fg_calib.graph.problem": ("Problem",),
    "fg_calib.initialization.camera": ("Camera",),
    "fg_calib.measurements.table": ("KnownPoint", "CustomMeasurements", "Table"),
    "fg_calib.pages": ("write_report",),
    "fg_calib.prediction.predict": ("predict", "write_prediction"),
    "fg_calib.prediction.prediction": ("PredictedErrors",),
    "fg_calib.options": ("Limits", "Options", "Pairing"),
    "fg_calib.report.comparison": ("format_comparison",),
    "fg_calib.report.identifiability": ("format_identifiability",),
    "fg_calib.report.inspection": ("format_inspection", "inspection_document"),
    "fg_calib.report.text": ("format_report",),
    "fg_calib.report.documents": (
        *("comparison_document", "observability_document", "result_document"),
        *("write_comparison", "write_observability", "write_results"),
    ),
    "fg_calib.robot.model": ("Robot",),
    "fg_calib.simulation.scenario": (
        *("BoardViews", "GivenReadings", "RandomReadings", "Scenario", "TargetViews", "read_scenario"),
    ),
    "fg_calib.simulation.simulator": ("Simulation", "simulate"),
    "fg_calib.io.parts_solver": ("PartsSolution", "cut", "reduce_parts", "solve_parts"),
    "fg_calib.diagnostics.multistart": ("multistart",),
    "fg_calib.graph.extension": ("DistanceFactor", "RotationAngleFactor", "expand"),
    "fg_calib.graph.solver": ("Solution", "SolverOptions", "levenberg_marquardt_params", "solve"),
    "fg_calib.assessment": ("Assessment", "assess", "solve_job"),
}
_FROM_FILES = {"Robot": ("from_urdf", "read_urdf"), "Measurements": ("from_frame", "read_measurements")}
"""Constructors that read files, which the folders of these classes know nothing of: they are attached here."""

_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Assessment",
    "BoardViews",
    "Bound",
    "Calibration",
    "CalibrationError",
    "Camera",
    "Check",
    "Column",
    "Comparison",
    "Correction",
    "CustomMeasurements",
    "Design",
    "DistanceFactor",
    "Explanation",
    "Export",
    "Failure",
    "GivenReadings",
    "History",
    "Identifiability",
    "InputError",
    "Inspection",
    "Inverse",
    "Job",
    "JobInParts",
    "KnownPoint",
    "LeastSquares",
    "Limits",
    "Measurements",
    "Noise",
    "Options",
    "Pairing",
    "PartsSolution",
    "PredictedErrors",
    "Problem",
    "ProblemError",
    "RandomReadings",
    "Result",
    "Robot",
    "RotationAngleFactor",
    "Scenario",
    "SetupCheck",
    "Simulation",
    "Solution",
    "SolverError",
    "SolverOptions",
    "Table",
    "TargetViews",
    "Targets",
    "Units",
    "assess",
    "build_problem",
    "calibrate",
    "calibrate_job",
    "calibrate_jobs",
    "calibrate_parts",
    "check_setup",
    "compare",
    "comparison_document",
    "correct",
    "cramer_rao",
    "cut",
    "dask_executor",
    "design",
    "estimate_noise",
    "estimate_tolerances",
    "expand",
    "export",
    "fit_least_squares",
    "format_comparison",
    "format_identifiability",
    "format_inspection",
    "format_report",
    "history_of",
    "inspect_job",
    "inspection_document",
    "levenberg_marquardt_params",
    "local_processes",
    "map_jobs",
    "multistart",
    "observability_document",
    "observe_configurations",
    "observe_structure",
    "pose",
    "predict",
    "problem_of",
    "read_job",
    "read_measurements",
    "read_parts",
    "read_result",
    "read_robot",
    "read_scenario",
    "read_targets",
    "read_urdf",
    "reduce_parts",
    "result_document",
    "result_schema",
    "simulate",
    "solve",
    "solve_inverse",
    "solve_job",
    "solve_parts",
    "write_comparison",
    "write_observability",
    "write_prediction",
    "write_report",
    "write_results",
    "write_robot",
    "write_simulation",
]

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    """Import a public name from the module where it lives."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_HOME_OF[name]), name)
    if name in _FROM_FILES:
        constructor, reader = _FROM_FILES[name]
        setattr(found, constructor, staticmethod(__getattr__(reader)))
    return found


def __dir__() -> list[str]:
    """The public names."""
    return sorted([*globals(), *__all__])
