from .assessment import Assessment, assess
from .baseline.comparison import compare
from .batch import calibrate_jobs
from .calibration import Calibration, calibrate, calibrate_job, correct, predict
from .designs.design import Design, design
from .exports.export import export
from .graph.build import build_problem
from .graph.factors import DistanceFactor, RotationAngleFactor
from .graph.problem import Problem
from .graph.solver import Solution, SolverOptions, solve
from .inputs import CalibrationError, InputError, ProblemError, SolverError
from .inputs.options import Limits, Options, Pairing
from .io.job import read_job
from .io.result import Result
from .io.robot_file import read_robot
from .job import Job
from .measurements.dataset import Measurements, Noise
from .measurements.table import CustomMeasurements, KnownPoint, Table
from .observability.identifiability import observe_configurations, observe_structure
from .robot.model import Robot
from .simulation.scenario import Scenario
from .simulation.simulator import simulate

__version__: str

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
