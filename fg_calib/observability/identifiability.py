"""Which parameters measurements can determine: of a robot in principle, or at given configurations.

*Structural*: at the nominal parameters and many random configurations within the joint limits; what is lost there is
lost whatever one measures. *Practical*: at the user's configurations and noise; more may be lost, and some of the rest
may be weak.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from fg_calib import inputs
from fg_calib.graph import SIGNAL_FLOOR, Problem, named_triangle
from fg_calib.inputs import Brief, Floats, FrameKnowledge, Model, ProblemError, check_names, check_number
from fg_calib.measurements import Measurements
from fg_calib.observability.indices import Observability, observability_of_rows
from fg_calib.observability.parallel_axes import MissingMotion, missing_motions
from fg_calib.observability.predicted import STRUCTURAL_FLOOR, predicted_problem, random_problem
from fg_calib.observability.reasons import LostDirection, explain
from fg_calib.parallel import single_threaded
from fg_calib.robot import Robot, names_of


def observability_of(
    problem: Problem, parameters: Floats, prefer: Sequence[str] = (), floor: float = SIGNAL_FLOOR
) -> Observability:
    """Observability of the robot's parameters by the train rows, without priors, around a parameter vector.

    Args:
        problem: The problem.
        parameters: The parameter vector (see `Variables`).
        prefer: Parameters to keep, first choice first, where only combinations are determined.
        floor: Signal-to-noise ratio below which a direction counts as not determined.
    """
    J, n = named_triangle(problem, parameters), sum(len(s.train) for s in problem.data.blocks)
    scales = np.array([problem.robot.scale_of(p.unit) for p in problem.estimated])
    return observability_of_rows(J, problem.estimated, scales=scales, n_measurements=n, prefer=prefer, floor=floor)


class Identifiability(Brief):
    """Identifiability of a robot's parameters, with reasons for the rest.

    Attributes:
        robot: The robot's name.
        model: Model of the measurements; `pixels` count as the boards' poses.
        kind: On random configurations, or on the user's.
        n_configurations: How many.
        observability: Rank, classes, groups, indices.
        lost: Every null-space direction with its reason.
        with_fixed_known: The same where the parameters that the robot's file calls fixed are known; None if it calls
            none fixed, or if only the others were looked at anyway.
        fixed: The fixed parameters.
        missing: Small motions between neighbouring axes that the robot's convention has no parameter for.
    """

    robot: str
    model: Model
    kind: Literal["structural", "practical"]
    n_configurations: int
    observability: Observability
    with_fixed_known: "Identifiability | None" = None
    fixed: tuple[str, ...] = ()
    missing: tuple[MissingMotion, ...] = ()
    lost: tuple[LostDirection, ...] = ()


@single_threaded
def observe_structure(
    robot: Robot,
    model: Model,
    *,
    frame: FrameKnowledge = "known",
    prefer: Sequence[str] = (),
    n_configurations: int = 0,
    seed: int = 0,
) -> Identifiability:
    """Identifiability of a robot's parameters by a model at all.

    All parameters of the joints are looked at, and those of base and tool that the robot's file has estimated; what
    it calls fixed is looked at both as unknown and as known.

    Args:
        robot: The robot.
        model: Model of the measurements.
        frame: Whether the measurement frame is unknown too.
        prefer: Parameters to keep, first choice first, where only combinations are determined.
        n_configurations: Random configurations; 0 for ten for every parameter, 300 at least.
        seed: Of the random configurations.

    Raises:
        InputError: An option is not one of those possible.
    """
    check_names("prefer", prefer, names_of(robot.parameters))
    check_number("n_configurations", n_configurations, whole=True)
    check_number("seed", seed, whole=True)
    estimated = [p for p in robot.parameters if p.estimated]
    everything = [p for p in robot.parameters if p.estimated or 1 <= p.owner <= robot.n_joints]

    def look(names: Sequence[str]) -> Identifiability:
        arm = robot.with_estimated(names)
        problem = random_problem(arm, model, frame, n_configurations=n_configurations, seed=seed)
        return replace(identifiability_of(problem, problem.start, "structural", prefer), model=model)

    whole, fixed = look(names_of(everything)), tuple(p.name for p in everything if not p.estimated)
    return replace(whole, with_fixed_known=look(names_of(estimated)), fixed=fixed) if fixed and estimated else whole


@single_threaded
def observe_configurations(
    robot: Robot,
    measurements: Measurements,
    model: Model,
    *,
    frame: FrameKnowledge = "known",
    pairing: inputs.Pairing | None = None,
    prefer: Sequence[str] = (),
) -> Identifiability:
    """Identifiability by a model at given configurations, with their noise; measured values are not looked at.

    Args:
        robot: The robot; what is fixed counts as known.
        measurements: The configurations (train rows) and their noise; 1 mm and 1 mrad where it is not specified.
        model: Model of the measurements.
        frame: Whether the measurement frame is unknown too.
        pairing: How pairs are formed; a star if None.
        prefer: Parameters to keep, first choice first, where only combinations are determined.

    Raises:
        InputError: An option is not one of those possible.
        ProblemError: Nothing is estimated, or no row takes part.
    """
    check_names("prefer", prefer, names_of(robot.parameters))
    if not any(p.estimated for p in robot.parameters):
        raise ProblemError(f"robot {robot.name}", "nothing to estimate", "at least one parameter that is not fixed")
    problem = predicted_problem(robot, measurements, model, frame=frame, pairing=pairing)
    if not problem.rows.parts:
        raise ProblemError(measurements.source, "no train row takes part", "train rows, of configurations that differ")
    return replace(identifiability_of(problem, problem.start, "practical", prefer), model=model)


def identifiability_of(
    problem: Problem, parameters: Floats, kind: Literal["structural", "practical"], prefer: Sequence[str] = ()
) -> Identifiability:
    """Identifiability by the train rows of a problem, without priors, around a parameter vector."""
    floor = STRUCTURAL_FLOOR if kind == "structural" else SIGNAL_FLOOR
    observability = observability_of(problem, parameters, prefer, floor)
    missing, lost = missing_motions(problem.robot), explain(problem, parameters, observability)
    head = problem.robot.name, problem.options.model, kind, problem.n_configurations
    return Identifiability(*head, observability, missing=missing, lost=lost)
