"""A calibration with new rows added to its information: the old rows are no longer needed.

What the old rows say stands as they were linearised at the old estimate (see `graph.knowledge`), so that new and old
together are as a solution of all rows would have them, but for what is not linear between the old estimate and the new.
Rows old and new share no errors: encoders, instruments and measured poses of another month are other draws.

Where the arm has changed, tolerances no longer say where it is, but where it was: they become part of what is known,
of which nothing is left along the change, and are no priors of the new calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fg_calib.graph import Knowledge, Problem, Solution, kept_of, solve
from fg_calib.inputs import InputError, ProblemError, check_names
from fg_calib.measurements import TARGET, build_dataset
from fg_calib.monitoring.hypotheses import named_changes
from fg_calib.monitoring.new_data import Rows, place_new_data, started
from fg_calib.monitoring.prior_information import Calibrated
from fg_calib.robot import Robot
from fg_calib.statistics import HeldOut


def updated(calibrated: Calibrated, rows: Rows, *, changed: Sequence[str], anchors_stay: bool) -> Solution:
    """The solution of new rows with what is known.

    Args:
        calibrated: The arm.
        rows: The rows.
        changed: Parameters, or zeros of joints, that have changed by nobody knows how much.
        anchors_stay: Whether anchors of the same name are where they were.

    Raises:
        InputError: There is no such parameter, the calibration holds nothing to go on from, or its gauge is none and
            there are directions that no rows determine.
        ProblemError: The rows lack what their model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    known = calibrated.knowledge
    if known is None:
        found = "a calibration that does not hold what its rows say"
        raise InputError("update", found, "one that this version of fg-calib wrote, with an arm that was estimated")
    known = known.about([name for name in known.unknowns if name[0] == TARGET.letter or anchors_stay])
    robot = calibrated.robot
    if changed:
        information = replace(calibrated, knowledge=known).information
        assert information is not None
        known = _with_change(information, changed)
        robot = replace(robot, parameters=tuple(replace(p, tolerance=None) for p in robot.parameters))
    fit = place_new_data(replace(calibrated, knowledge=known), rows, calibrated.values).solution
    return solve(_problem(calibrated, robot, known, rows, fit))


def predicted_before(calibrated: Calibrated, rows: Rows) -> tuple[HeldOut, ...]:
    """How well the arm as it was calibrated before predicts new rows, by table and kind: it has not seen them.

    Args:
        calibrated: The arm.
        rows: The rows; test rows count as the others do.
    """
    found = place_new_data(calibrated, rows.all_train(), calibrated.values).errors()
    return tuple(replace(held, by="the arm before this update") for held in found)


def _problem(calibrated: Calibrated, robot: Robot, known: Knowledge, rows: Rows, fit: Solution) -> Problem:
    """The problem of the rows with what is known, started at the arm as it was calibrated."""
    options, data = calibrated.fixed_options, build_dataset(robot, rows.free_of(known))

    def problem(arm: Robot, whole: Problem | None) -> Problem:
        return started(arm, data, options, calibrated.values, fit, whole=whole, knowledge=known)

    whole = problem(robot, None)
    if not whole.n_residuals:
        raise ProblemError(data.source, "no row takes part", "train rows that model and options use")
    if options.gauge == "prior":
        return whole
    kept = kept_of(whole, options.prefer)
    if options.gauge == "keep":
        return problem(robot.with_estimated(kept), whole)
    # What nothing determines is nonlinear in what it does, and the old rows stand as they were linearised: new rows
    # would contradict them, and a miss of one sigma would move an arm by metres.
    lost = [p.name for p in robot.parameters if p.estimated and p.name not in kept]
    if lost:
        found = f"gauge none, and rows that do not determine {', '.join(lost)} given the others"
        raise InputError("update", found, "a calibration with gauge keep or prior")
    return whole


def _with_change(known: Knowledge, changed: Sequence[str]) -> Knowledge:
    """Information about an arm that has changed since, the tolerances among it."""
    of = named_changes(known.variables)
    check_names("changed", changed, list(of))
    columns = np.pad(np.hstack([of[name] for name in changed]), ((0, len(known.at)), (0, 0)))
    nominal = None if known.nominal is None else _with_change(known.nominal, changed)
    return replace(known.grown(columns, np.ones(columns.shape[1], dtype=np.bool_)), nominal=nominal)
