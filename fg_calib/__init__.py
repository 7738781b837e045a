"""fg_calib: robot-arm calibration as a factor graph.

    robot = read_robot("robot.yaml")
    measurements = read_measurements("poses.csv", robot, noise=Noise(position=1e-3, orientation=2e-4))
    problem = build_problem(robot, measurements, model="distance-rotation")
    solution = solve(problem)
    uncertainty = assess(solution)
    print(format_report(solution, uncertainty))

Names are imported when they are first used, so that `fg-calib --help` need not wait for GTSAM.
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fg_calib.analysis.bounds import Bound, cramer_rao
    from fg_calib.analysis.identifiability import Identifiability, observe_configurations, observe_structure
    from fg_calib.analysis.mistakes import SetupCheck, check_setup
    from fg_calib.analysis.restarts import look_elsewhere
    from fg_calib.analysis.uncertainty import Uncertainty, assess
    from fg_calib.analysis.variance_components import estimate_noise, solve_job
    from fg_calib.baseline.comparison import Comparison, compare
    from fg_calib.baseline.least_squares import LeastSquares, fit_least_squares
    from fg_calib.errors import CalibrationError, InputError, ProblemError, SolverError
    from fg_calib.files.job import read_job
    from fg_calib.files.robot_yaml import read_robot, write_robot
    from fg_calib.files.scenario import read_scenario
    from fg_calib.files.simulation import write_simulation
    from fg_calib.files.tables import read_measurements
    from fg_calib.files.units import Units
    from fg_calib.graph.problem import Problem, build_problem, problem_of
    from fg_calib.graph.solver import Solution, SolverOptions, solve
    from fg_calib.job import Job
    from fg_calib.measurements.dataset import Measurements, Noise
    from fg_calib.options import Options, Pairing
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
    from fg_calib.report.text import format_report
    from fg_calib.robot.kinematics import pose
    from fg_calib.robot.model import Robot
    from fg_calib.simulation.scenario import Scenario, Simulation
    from fg_calib.simulation.simulator import simulate

__version__ = "0.1.0"

_HOMES = {
    "fg_calib.analysis.bounds": ("Bound", "cramer_rao"),
    "fg_calib.baseline.comparison": ("Comparison", "compare"),
    "fg_calib.errors": ("CalibrationError", "InputError", "ProblemError", "SolverError"),
    "fg_calib.files.job": ("read_job",),
    "fg_calib.job": ("Job",),
    "fg_calib.files.robot_yaml": ("read_robot", "write_robot"),
    "fg_calib.files.scenario": ("read_scenario",),
    "fg_calib.files.simulation": ("write_simulation",),
    "fg_calib.files.tables": ("read_measurements",),
    "fg_calib.files.units": ("Units",),
    "fg_calib.analysis.identifiability": ("Identifiability", "observe_configurations", "observe_structure"),
    "fg_calib.robot.kinematics": ("pose",),
    "fg_calib.baseline.least_squares": ("LeastSquares", "fit_least_squares"),
    "fg_calib.measurements.dataset": ("Measurements", "Noise"),
    "fg_calib.analysis.mistakes": ("SetupCheck", "check_setup"),
    "fg_calib.analysis.variance_components": ("estimate_noise", "solve_job"),
    "fg_calib.graph.problem": ("Problem", "build_problem", "problem_of"),
    "fg_calib.options": ("Options", "Pairing"),
    "fg_calib.report.comparison": ("format_comparison",),
    "fg_calib.report.identifiability": ("format_identifiability",),
    "fg_calib.report.text": ("format_report",),
    "fg_calib.report.documents": (
        *("comparison_document", "observability_document", "result_document"),
        *("write_comparison", "write_observability", "write_results"),
    ),
    "fg_calib.robot.model": ("Robot",),
    "fg_calib.simulation.scenario": ("Scenario", "Simulation"),
    "fg_calib.simulation.simulator": ("simulate",),
    "fg_calib.analysis.restarts": ("look_elsewhere",),
    "fg_calib.graph.solver": ("Solution", "SolverOptions", "solve"),
    "fg_calib.analysis.uncertainty": ("Uncertainty", "assess"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Bound",
    "CalibrationError",
    "Comparison",
    "Identifiability",
    "InputError",
    "Job",
    "LeastSquares",
    "Measurements",
    "Noise",
    "Options",
    "Pairing",
    "Problem",
    "ProblemError",
    "Robot",
    "Scenario",
    "SetupCheck",
    "Simulation",
    "Solution",
    "SolverError",
    "SolverOptions",
    "Uncertainty",
    "Units",
    "assess",
    "build_problem",
    "check_setup",
    "compare",
    "comparison_document",
    "cramer_rao",
    "estimate_noise",
    "fit_least_squares",
    "format_comparison",
    "format_identifiability",
    "format_report",
    "look_elsewhere",
    "observability_document",
    "observe_configurations",
    "observe_structure",
    "pose",
    "problem_of",
    "read_job",
    "read_measurements",
    "read_robot",
    "read_scenario",
    "result_document",
    "simulate",
    "solve",
    "solve_job",
    "write_comparison",
    "write_observability",
    "write_results",
    "write_robot",
    "write_simulation",
]

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    """Import a public name from the module where it lives."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    """The public names."""
    return sorted([*globals(), *__all__])
