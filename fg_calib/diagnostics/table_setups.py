"""The set-up of each table of a job: alone, and beside the other tables.

Base and tool are one for all tables, so a table that is wrong spoils the residuals of all others; each is therefore
judged by the base and tool that it says itself. A table that no base and tool fit is wrong by itself. Only where all
are right alone can they disagree on base and tool, and it is said of the tables that disagree with most others: both,
where there are two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.diagnostics.setup import Setup, has_places, setup_of
from fg_calib.diagnostics.setup_check import EXPLAINED, FAR, REDUCTION, Explanation, SetupCheck, check_setup
from fg_calib.diagnostics.typical_residuals import fitted_residuals, residuals_at, residuals_beside
from fg_calib.graph.factors import pose_of
from fg_calib.graph.problem import Problem
from fg_calib.initialization.hand_eye import Frame
from fg_calib.robot.model import Robot
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]

OTHER_TOOL = "tool or base are others here than in the other tables (another target on the tool, another frame)"
"""What a table may say that is right by itself, with a tool and a base of its own."""


def check_problem(problem: Problem, before: Floats, *, doubtful: bool = False) -> SetupCheck:
    """`check_setup` of a problem: of the table that has most to say, those of `others` that have something too.

    Args:
        problem: The problem.
        before: The parameter vector with base, tool and measurement frame fitted, the arm at nominal.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
    """
    every, found = check_tables(problem, before, doubtful=doubtful, placed=doubtful)
    found = found or sorted(every, key=lambda check: -check.excess)[:1]
    checked = {name for name, check in zip(_labels(problem), every, strict=True) if check.residuals}
    unchecked = tuple(name for name in problem.data.labels if name not in checked)
    told = replace(found[0], others=tuple(found[1:])) if found else SetupCheck()
    return replace(told, unchecked=unchecked) if doubtful else told


def check_tables(
    problem: Problem, before: Floats, *, doubtful: bool = False, placed: bool = False
) -> tuple[list[SetupCheck], list[SetupCheck]]:
    """`check_setup` of each table with a model, and those of them that have something to say, worst first.

    Args:
        problem: The problem.
        before: The parameter vector with base, tool and measurement frame fitted, the arm at nominal.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        placed: Look at tables whose targets, anchors, planes or boards have to be placed first.
    """
    whole, variables = problem.whole or problem, problem.variables
    robot = whole.robot.with_values(before[variables.robot_span])
    frame_of_table = {v.symbol: before[v.places] for v in variables.frames}
    checks, setups, frames = [], [], []
    for number, (name, table) in enumerate(zip(problem.data.labels, problem.data.tables, strict=True)):
        if table.model is None:
            continue
        frame = Frame(np.eye(3), np.zeros(3))
        if f"X({number})" in frame_of_table:
            world_T_base = pose_of(frame_of_table[f"X({number})"])
            frame = Frame(world_T_base.rotation().matrix(), world_T_base.translation())
        given = (whole.robot, table.measurements, table.model, table.frame)
        places = has_places(table.measurements, table.model)
        look = placed if places else doubtful
        check = check_setup(*given, doubtful=look, fitted=(robot, frame), table=table)
        checks.append(replace(check, table=name if len(problem.data.labels) > 1 else ""))
        setups.append(None if places else setup_of(*given))
        frames.append(frame)
    found = _alone(checks)
    if not found and len(checks) > 1:
        with one_blas_thread:
            found = _disagreeing(robot, checks, setups, frames)
    return checks, found


def _labels(problem: Problem) -> list[str]:
    """Names of the tables that have a model."""
    named = zip(problem.data.labels, problem.data.tables, strict=True)
    return [name for name, table in named if table.model is not None]


def _alone(checks: Sequence[SetupCheck]) -> list[SetupCheck]:
    """Tables that are wrong by themselves, those first whose mistake was found, then the worst."""
    far = [check for check in checks if check.far] or [check for check in checks if check.explanations]
    return sorted(far, key=lambda check: (not check.explanations, -check.excess))


def _disagreeing(
    robot: Robot, checks: Sequence[SetupCheck], setups: Sequence[Setup | None], frames: Sequence[Frame]
) -> list[SetupCheck]:
    """Tables that only a tool and a base of their own fit.

    Args:
        robot: With the base and the tool that all tables say together.
        checks: Of the tables, each alone.
        setups: The tables.
        frames: Their world_T_base that go with `robot`.
    """
    there = [
        (setup, replace(check, residuals=residuals_at(setup, robot, frame)))
        for setup, check, frame in zip(setups, checks, frames, strict=True)
        if setup is not None and check.residuals
    ]
    alone = [fitted_residuals(setup) for setup, _ in there]
    fits = [max((r.excess for r in found), default=np.inf) for found in alone]
    spoilt = [
        check.far and fit <= min(EXPLAINED, check.excess / REDUCTION)
        for (_, check), fit in zip(there, fits, strict=True)
    ]
    if not any(spoilt):
        return []
    apart = np.zeros((len(there), len(there)), dtype=np.bool_)
    for i, (one, _) in enumerate(there):
        for j, (other, _) in enumerate(there[:i]):
            # What one table hardly determines the other does not agree with by chance: the better of both ways.
            both = (SetupCheck(residuals_beside(one, other)), SetupCheck(residuals_beside(other, one)))
            apart[i, j] = apart[j, i] = min(check.excess for check in both) > FAR
    disagrees = apart.sum(axis=1)
    named = disagrees == disagrees.max() if disagrees.any() else np.array(spoilt)
    return [
        replace(check, explanations=(Explanation((OTHER_TOOL,), residuals),))
        for (_, check), residuals, chosen in zip(there, alone, named, strict=True)
        if chosen
    ]
