"""How large residuals are before any calibration where targets, anchors, planes or boards have to be placed first.

`typical_residuals` fits frame and tool of poses and pairs in closed form. What instruments measure has more unknowns
(see `places`): here the arm is taken as drawn, as in an evaluation by test rows alone, and these unknowns, frame and
tool are estimated, without tolerances of base and tool, from some rows. A look takes some ten milliseconds. What is
expected is of the arm's errors in full: what is placed takes up a part of them, so that healthy tables have an excess
of a fifth to one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.diagnostics.setup import Setup
from fg_calib.diagnostics.typical_residuals import USUAL_ANGLE, USUAL_LENGTH, TypicalResidual, fitted_residuals
from fg_calib.errors import InputError, ProblemError, SolverError
from fg_calib.graph.build import problem_of_tables
from fg_calib.graph.factors import build_variables
from fg_calib.graph.noise import RowNoise
from fg_calib.graph.problem import Problem, noises_at, tables_of
from fg_calib.measurements import residuals
from fg_calib.options import FrameKnowledge, Options
from fg_calib.robot.kinematics import Chain, pose
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]

_STEPS, _HALVINGS = 6, 4
"""Gauss-Newton steps from the start in closed form that suffice where the set-up is right, and halvings of each."""

_FARTHEST = 1e6
"""Where nothing is that was measured, [m]."""

_UNITS: dict[str, Literal["m", "rad", "px"]] = {"orientation": "rad", "angle": "rad", "pixel": "px"}


def residuals_of(setup: Setup) -> tuple[TypicalResidual, ...]:
    """Typical residuals by kind, frame, tool and places fitted; empty if there are too few rows, or no fit."""
    return fitted_residuals(setup) if setup.table is None else _placed_residuals(setup)


def _placed_residuals(setup: Setup) -> tuple[TypicalResidual, ...]:
    assert setup.table is not None
    m = setup.measurements
    m = replace(m, test=np.ones(m.n_configurations, dtype=np.bool_))  # test rows alone: the arm is taken as it is
    frame: FrameKnowledge = "unknown" if setup.frame else setup.table.frame
    table = replace(setup.table, measurements=m, frame=frame).by_itself()
    robot = _with_tool(setup)
    try:
        problem = problem_of_tables(robot, tables_of(table, options := Options(gauge="none")), options)
        parameters = placed(problem)
    except (InputError, ProblemError, SolverError, RuntimeError, np.linalg.LinAlgError):
        return ()
    n_free = problem.variables.n_columns + problem.variables.n_nuisance
    if problem.n_residuals < 3 * n_free + 6:
        return ()
    variables = build_variables(robot, [t.unknown_frame for t in problem.data.tables])
    of_arm, of_frame = problem.variables.robot_span, problem.variables.frame_span
    values = np.concatenate([parameters[of_arm], parameters[of_frame]])
    chains = [chain.at(values) for chain in variables.chains]
    scale = tolerances_of(robot, variables.names)
    at = robot.with_values(parameters[of_arm])
    found: list[TypicalResidual] = []
    for noise in noises_at(problem, parameters):
        found += _by_kind(noise, chains[noise.series.table], scale, at)
    return tuple(found) if all(np.isfinite([r.size, r.expected]).all() for r in found) else ()


def placed(problem: Problem) -> Floats:
    """The parameter vector with what is unknown where the rows, whitened as at the start, say it is.

    Args:
        problem: A problem of the arm as it is (see `Problem.evaluated`).
    """
    variables, values = problem.variables, problem.initial
    parameters = variables.parameters(values)

    def cost(at: Floats) -> float:
        return sum(rows.squared_norm(variables.at(at)) for rows in problem.rows)

    least = cost(parameters)
    for _ in range(_STEPS):
        found = [rows.linearise(variables.at(parameters)) for rows in problem.rows]
        r, J = (np.concatenate(parts) for parts in zip(*found, strict=True))
        size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        step = -np.linalg.lstsq(J / size, r, rcond=1e-10)[0] / size
        before = least
        for _ in range(_HALVINGS):
            moved = variables.moved(values, step)
            at = variables.parameters(moved)
            if np.abs(at).max() < _FARTHEST and (left := cost(at)) < least:
                values, parameters, least = moved, at, left
                break
            step = 0.5 * step
        if not least < (1.0 - 1e-3) * before:
            break
    return parameters


def _with_tool(setup: Setup) -> Robot:
    """The robot with those of the tool's parameters estimated that the set-up lets be."""
    robot, tool = setup.robot, setup.robot.owned_by(setup.robot.n_joints + 1)
    free = [*setup.tool_translation.tolist(), *[setup.tool_rotation] * 3]
    kept = {p.name for p in robot.parameters if p.estimated}
    freed = {robot.parameters[i].name for i, is_free in zip(tool, free, strict=False) if is_free}
    return robot.with_estimated(sorted(kept | freed))


def tolerances_of(robot: Robot, names: tuple[str, ...]) -> Floats:
    """1 sigma of the arm's parameters in the order of the columns, 0 of those that were fitted, shape (n_columns,)."""
    scale, by_name = np.zeros(len(names)), {p.name: p for p in robot.parameters}
    for column, name in enumerate(names):
        p = by_name.get(name)
        if p is not None and 1 <= p.owner <= robot.n_joints:
            usual = USUAL_LENGTH if p.unit == "m" else USUAL_ANGLE
            scale[column] = usual if p.tolerance is None else p.tolerance
    return scale


def _by_kind(noise: RowNoise, chain: Chain, scale: Floats, robot: Robot) -> list[TypicalResidual]:
    """Typical residuals of one series, by kind of noise.

    Args:
        noise: Its rows and their noise.
        chain: The chain with columns for all that is estimated of the arm.
        scale: 1 sigma of each column.
        robot: The robot, tool and base fitted.
    """
    kinds = np.array([name.partition(".")[0] for name in noise.series.kind.names])
    r, J = residuals.linearise(noise.rows, chain)
    moved = np.sum((J[:, :, : len(scale)] * scale) ** 2, axis=2)
    variance = np.where(noise.series.used, moved + noise.sigma**2, 0.0)
    squares = np.where(noise.series.used, r**2, 0.0)
    found = []
    for kind in dict.fromkeys(kinds.tolist()):
        of, used = kinds == kind, noise.series.used[:, kinds == kind].any(axis=1)
        if not used.any():
            continue
        size, expected = (np.median(np.sqrt(v[:, of].sum(axis=1)[used])) for v in (squares, variance))
        unit = _UNITS.get(kind, "m")
        found.append(
            TypicalResidual(
                kind, unit, float(size), max(float(expected), 1e-9), _motion(noise, kind, robot), int(used.sum())
            )
        )
    return found


def _motion(noise: RowNoise, kind: str, robot: Robot) -> float:
    """How far the arm, or a point's image, moves between the rows of a series, [m], [rad] or [px]."""
    m = noise.place.measurements
    if kind == "pixel" and m.image is not None:
        uv = m.image[:, :2]
        return float(np.median(np.linalg.norm(uv - uv.mean(axis=0), axis=1)))
    at = pose(robot, m.readings)
    if kind == "orientation":
        turns = Rotation.from_matrix(at.rotation[0].T @ at.rotation).magnitude()
        return float(np.median(turns))
    return float(np.median(np.linalg.norm(at.position - at.position.mean(axis=0), axis=1)))
