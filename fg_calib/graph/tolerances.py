"""Tolerances by group: which parameters share a scale that is estimated, and their priors with other scales."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fg_calib.arrays import Floats, FrozenArrays, Integers
from fg_calib.graph.problem import Problem, with_factors
from fg_calib.graph.variables import Variables
from fg_calib.options import SharedScale
from fg_calib.robot.model import Parameter, Robot, tolerance_kind

FIRST = 1e-3
"""Tolerance that a joint's parameter starts from where none is stated, [m] and [rad]."""


@dataclass(frozen=True)
class ToleranceScale:
    """A factor on the tolerances stated of a group of parameters, estimated with them.

    Attributes:
        group: What shares the scale: `a`, `theta`, `tool`; or a joint's name.
        parameters: The parameters.
        scale: Tolerance estimated over tolerance stated.
        low: Lower end of its 95 % interval.
        high: Upper end.
        seen: How many of the parameters' corrections the data tell of.
    """

    group: str
    parameters: tuple[str, ...]
    scale: float
    low: float
    high: float
    seen: float


@dataclass(frozen=True)
class ToleranceScales(FrozenArrays):
    """The scales of all groups.

    Attributes:
        scales: Group by group.
        unsure: What not knowing them adds to the covariance of the estimate, shape (n_columns, n_columns).
    """

    scales: tuple[ToleranceScale, ...]
    unsure: Floats


def with_first_tolerances(robot: Robot) -> Robot:
    """The robot whose joints' estimated parameters all have a tolerance: `FIRST` where none is stated."""
    n = robot.n_joints
    parameters = tuple(
        replace(p, tolerance=FIRST) if p.tolerance is None and p.estimated and 1 <= p.owner <= n else p
        for p in robot.parameters
    )
    return replace(robot, parameters=parameters)


def prior_parameters(variables: Variables) -> list[Parameter]:
    """The parameter of each row of `prior_rows`, in their order."""
    owned = [variables.robot.parameters[i] for v in variables.items if v.kind != "frame" for i in v.parameters]
    return [p for p in owned if p.tolerance is not None] if variables.priors else []


def groups_of(robot: Robot, parameters: Sequence[Parameter], by: SharedScale) -> tuple[tuple[str, ...], Integers]:
    """What shares a scale.

    Args:
        robot: The robot.
        parameters: Those that have a tolerance.
        by: What they share it by.

    Returns:
        The groups in the order in which they come first, and the number of each parameter's, shape (n,).
    """
    names = [_group_of(robot, p, by) for p in parameters]
    groups = tuple(dict.fromkeys(names))
    return groups, np.array([groups.index(name) for name in names], dtype=np.int64)


def _group_of(robot: Robot, parameter: Parameter, by: SharedScale) -> str:
    owner = ("base", *(joint.name for joint in robot.joints), "tool")[parameter.owner]
    return owner if by == "joint" else tolerance_kind(parameter) or f"{owner} angles"


def with_scales(problem: Problem, by: SharedScale, scales: Mapping[str, float]) -> Problem:
    """The problem from its start, with the tolerances of each group multiplied, those of fixed parameters too.

    Args:
        problem: The problem.
        by: What shares a scale.
        scales: Factor on the tolerances of each group.
    """
    parameters = tuple(
        p
        if p.tolerance is None
        else replace(p, tolerance=p.tolerance * scales.get(_group_of(problem.robot, p, by), 1.0))
        for p in problem.robot.parameters
    )
    robot = replace(problem.robot, parameters=parameters)
    return with_factors(problem, problem.start, robot=robot, variables=replace(problem.variables, robot=robot))
