"""Tolerances by group: which parameters share a scale that is estimated, and their priors with other scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.graph.factors import Variables
from fg_calib.graph.problem import Problem, assembled
from fg_calib.options import SharedScale
from fg_calib.robot.model import Parameter, Robot, tolerance_kind

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FIRST = 1e-3
"""Tolerance that a joint's parameter starts from where none is stated, [m] and [rad]."""


@dataclass(frozen=True)
class ToleranceScales(FrozenArrays):
    """Factors on the tolerances stated, estimated with the parameters.

    Attributes:
        groups: What shares a scale: `a`, `theta`, `tool`; or a joint's name.
        members: The parameters of each.
        scale: Tolerance estimated over tolerance stated, shape (n_groups,).
        low: Lower end of the 95 % interval of each, shape (n_groups,).
        high: Upper end, shape (n_groups,).
        seen: How many of its members' corrections the data tell of, shape (n_groups,).
        unsure: What not knowing the scales adds to the covariance of the estimate, shape (n_columns, n_columns).
    """

    groups: tuple[str, ...]
    members: tuple[tuple[str, ...], ...]
    scale: Floats
    low: Floats
    high: Floats
    seen: Floats
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
    owners = ("base", *(joint.name for joint in robot.joints), "tool")
    names = []
    for p in parameters:
        kind = tolerance_kind(p)
        names.append(owners[p.owner] if by == "joint" else f"{owners[p.owner]} angles" if kind is None else kind)
    groups = tuple(dict.fromkeys(names))
    return groups, np.array([groups.index(name) for name in names], dtype=np.int64)


def with_scales(problem: Problem, members: Sequence[Sequence[str]], scale: Floats) -> Problem:
    """The problem from its start, with the tolerances of some parameters multiplied.

    Args:
        problem: The problem.
        members: Names of the parameters of each group.
        scale: Factor on the tolerances of each, shape (n_groups,).
    """
    factor = {name: float(s) for names, s in zip(members, scale, strict=True) for name in names}
    parameters = tuple(
        p if p.tolerance is None else replace(p, tolerance=p.tolerance * factor.get(p.name, 1.0))
        for p in problem.robot.parameters
    )
    robot = replace(problem.robot, parameters=parameters)
    return assembled(problem, problem.start, robot=robot, variables=replace(problem.variables, robot=robot))
