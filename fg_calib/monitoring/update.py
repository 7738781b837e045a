"""A calibration with new rows added to its information: the old rows are no longer needed.

What the old rows say stands as they were linearised at the old estimate (see `graph.knowledge`), so that new and old
together are as a solution of all rows would have them, but for what is not linear between the old estimate and the new.
Rows old and new share no errors: encoders, instruments and measured poses of another month are other draws.

Where the arm may have changed, tolerances no longer say where it is, but where it was: they become part of what is
known before that grows by the change, and are no priors of the new calibration.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fg_calib import measurements, statistics
from fg_calib.graph import Knowledge, Problem, Solution, kept_of, solve
from fg_calib.inputs import Floats, InputError, ProblemError, check_names, expect
from fg_calib.monitoring.hypotheses import named_changes
from fg_calib.monitoring.new_data import Rows, place_new_data, started
from fg_calib.monitoring.prior_information import Calibrated
from fg_calib.robot import Robot, tolerance_kind


def updated(
    calibrated: Calibrated, rows: Rows, *, growth: Mapping[str, float], changed: Sequence[str], anchors_stay: bool
) -> Solution:
    """The solution of new rows with what is known.

    Args:
        calibrated: The arm.
        rows: The rows.
        growth: 1 sigma by which parameters may have wandered, by name or kind, [m] and [rad].
        changed: Parameters, or zeros of joints, that have changed by nobody knows how much.
        anchors_stay: Whether anchors of the same name are where they were.

    Raises:
        InputError: There is no such parameter, the calibration holds nothing to go on from, or its gauge is none and
            there are directions that no rows determine.
        ProblemError: The rows lack what their model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    if (known := calibrated.knowledge) is None:
        found = "a calibration that does not hold what its rows say"
        raise InputError("update", found, "one that this version of fg-calib wrote, with an arm that was estimated")
    known = known.about([name for name in known.unknowns if name[0] == measurements.TARGET.letter or anchors_stay])
    robot = calibrated.robot
    if growth or changed:
        information = replace(calibrated, knowledge=known).information
        assert information is not None
        known = _with_change(information, growth, changed)
        robot = replace(robot, parameters=tuple(replace(p, tolerance=None) for p in robot.parameters))
    fit = place_new_data(replace(calibrated, knowledge=known), rows, calibrated.values).solution
    return solve(_problem(calibrated, robot, known, rows, fit))


def predicted_before(calibrated: Calibrated, rows: Rows) -> tuple[statistics.HeldOut, ...]:
    """How well the arm as it was calibrated before predicts new rows, by table and kind: it has not seen them.

    Args:
        calibrated: The arm.
        rows: The rows; test rows count as the others do.
    """
    found = place_new_data(calibrated, rows.all_train(), calibrated.values).errors()
    return tuple(replace(held, by="the arm before this update") for held in found)


def _problem(calibrated: Calibrated, robot: Robot, known: Knowledge, rows: Rows, fit: Solution) -> Problem:
    """The problem of the rows with what is known, started at the arm as it was calibrated."""
    options, data = calibrated.fixed_options, measurements.build_dataset(robot, rows.free_of(known))

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
    found = f"gauge none, and rows that do not determine {', '.join(lost)} given the others"
    expect(not lost, "update", found, "a calibration with gauge keep or prior")
    return whole


def _with_change(known: Knowledge, growth: Mapping[str, float], changed: Sequence[str]) -> Knowledge:
    """Information about an arm that may have changed since, the tolerances among it.

    Growth of a parameter's name counts before that of its kind.
    """
    kinds = {p.name: tolerance_kind(p) or "" for p in known.robot.parameters}
    names, free = known.variables.names, dict.fromkeys(known.robot.own_names(changed), 1.0)
    of_kinds = sorted({kinds[name] for name in names if kinds[name]})
    changes = list(named_changes(known.variables))
    for key, given, possible in (("growth", growth, [*names, *of_kinds]), ("changed", free, changes)):
        check_names(key, given, possible)
    sigma = {name: growth.get(name, growth.get(kinds[name], 0.0)) for name in names}
    wandered = _columns(known, {name: size for name, size in sigma.items() if size > 0.0})
    columns = np.hstack([wandered, _columns(known, free)])
    grown = known.grown(columns, np.arange(columns.shape[1]) >= wandered.shape[1])
    if known.nominal is None:
        return grown
    columns = _columns(known.nominal, free)
    return replace(grown, nominal=known.nominal.grown(columns, np.ones(columns.shape[1], dtype=np.bool_)))


def _columns(known: Knowledge, sizes: Mapping[str, float]) -> Floats:
    """Named changes of some size as columns of what is known, shape (n_columns + len(at), n)."""
    of, n = named_changes(known.variables), known.variables.n_columns
    columns = np.hstack([np.zeros((n, 0)), *(size * of[name] for name, size in sizes.items())])
    return np.pad(columns, ((0, len(known.at)), (0, 0)))
