"""A calibration with new rows added to what it has learned, of which the old rows are no longer needed.

What the old rows say stands as they were linearised at the old estimate (see `graph.knowledge`), so that new and old
together are as a solution of all rows would have them, but for what is not linear between the old estimate and the new.
Rows old and new share no errors: encoders, instruments and measured poses of another month are other draws.

Where the arm may have changed, tolerances no longer say where it is, but where it was: they become part of what is
known before that grows by the change, and are no priors of the new calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fg_calib.graph import (
    Knowledge,
    Problem,
    Solution,
    at_parameters,
    coordinates_of,
    kept_of,
    problem_at,
    solve,
    variables_of,
    with_factors,
)
from fg_calib.inputs import NEAR, Floats, InputError, ProblemError, did_you_mean, known_names
from fg_calib.measurements import TARGET, build_dataset
from fg_calib.monitoring.hypotheses import motions, zero_names
from fg_calib.monitoring.new_data import Calibrated, Placed, Rows, place_new_data
from fg_calib.robot import Robot, names_of, random_readings, tolerance_kind
from fg_calib.statistics import HeldOut
from fg_calib.statistics.residual_table import residual_table


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
    known = calibrated.knowledge
    if known is None:
        found = "a calibration that does not hold what its rows say"
        raise InputError("update", found, "one that this version of fg-calib wrote, with an arm that was estimated")
    known = known.about([name for name in known.unknowns if name[0] == TARGET.letter or anchors_stay])
    robot = calibrated.robot
    if growth or changed:
        information = replace(calibrated, knowledge=known).information
        assert information is not None
        known = _with_change(calibrated, information, growth, changed)
        robot = replace(robot, parameters=tuple(replace(p, tolerance=None) for p in robot.parameters))
    at = place_new_data(replace(calibrated, knowledge=known), rows, calibrated.values)
    return solve(_problem(calibrated, robot, known, rows, at))


def predicted_before(calibrated: Calibrated, rows: Rows) -> tuple[HeldOut, ...]:
    """How well the arm as it was calibrated before predicts new rows, by table and kind: it has not seen them.

    Args:
        calibrated: The arm.
        rows: The rows; test rows count as the others do.
    """
    rows = replace(rows, tables=tuple(table.all_train() for table in rows.tables))
    solution = place_new_data(calibrated, rows, calibrated.values).solution
    table = residual_table(solution)
    tested = replace(table, test=np.ones_like(table.test), n_fitted=0, seen=np.zeros_like(table.seen))
    found = tested.held_out(solution.problem.data.labels)
    return tuple(replace(held, by="the arm before this update") for held in found)


def _problem(calibrated: Calibrated, robot: Robot, known: Knowledge, rows: Rows, at: Placed) -> Problem:
    """The problem of the rows with what is known, started at the arm as it was calibrated."""
    options = replace(calibrated.options, estimate_noise=False, estimate_tolerance=None)
    stays = {name for _, name in known.unknowns}
    tables = tuple(
        replace(t, known={name: place for name, place in t.known.items() if name not in stays}) for t in rows.tables
    )
    data = build_dataset(robot, tables)
    state = calibrated.state_for(rows.tables, rows.like)
    places = at_parameters(at.solution.problem, at.solution.parameters).coordinates

    def problem(arm: Robot, whole: Problem | None) -> Problem:
        v = variables_of(arm, data, options)
        x = np.append(calibrated.values, np.zeros(v.nuisance_span.stop - len(calibrated.values)))
        x[v.frame_span] = at.solution.parameters[v.frame_span]
        there = v.coordinates >= 0
        x[v.coordinates[there]] = places[there]
        for name in known.unknowns:
            place = coordinates_of(v, data.unknowns, name)
            if place is not None:
                x[place] = known.place(name)
        made = problem_at(arm, data, options, v, x, whole=whole, knowledge=known)
        return with_factors(made, x, replace(made.state, factors=state.factors))

    whole = problem(robot, None)
    if not whole.n_residuals:
        raise ProblemError(data.source, "no row takes part", "train rows that model and options use")
    if options.gauge == "prior":
        return whole
    kept = kept_of(whole, options.prefer)
    if options.gauge == "none":
        _require_determined(robot, kept)
        return whole
    return problem(robot.with_estimated(kept), whole)


def _require_determined(robot: Robot, kept: Sequence[str]) -> None:
    """Check that rows old and new determine all that is estimated, where neither tolerances nor gauge hold the rest.

    What parameters may do unseen bends as they move, and the old rows stand as they were linearised: new rows would be
    at odds with them about it, and a miss of one sigma move an arm by metres along it.

    Raises:
        InputError: They do not.
    """
    lost = [p.name for p in robot.parameters if p.estimated and p.name not in kept]
    if lost:
        found = f"gauge none, and rows that do not determine {', '.join(lost)} beside the others"
        raise InputError("update", found, "a calibration with gauge keep or prior")


def _with_change(
    calibrated: Calibrated, known: Knowledge, growth: Mapping[str, float], changed: Sequence[str]
) -> Knowledge:
    """What is known of an arm that may have changed since, the tolerances among it."""
    sigma = _growth_of(calibrated.robot, known, growth)
    named = _named_columns(known)
    directions = [named[name] * size for name, size in sigma.items()]
    free = _changes(known, changed)
    every = _wide(known, [*directions, *free])
    grown = known.grown(every, np.arange(len(directions) + len(free)) >= len(directions))
    if known.nominal is None:
        return grown
    free = _changes(known.nominal, changed)
    nominal = known.nominal.grown(_wide(known.nominal, free), np.ones(len(free), dtype=np.bool_))
    return replace(grown, nominal=nominal)


def _named_columns(known: Knowledge) -> dict[str, Floats]:
    """A change of each parameter in the arm's columns."""
    E = known.variables.tangent_derivative(np.append(known.robot.nominal, np.zeros(6)))
    return dict(zip(known.variables.names, E.T, strict=True))


def _wide(known: Knowledge, directions: Sequence[Floats]) -> Floats:
    """Directions of the arm as columns by all that is known, shape (n_columns + len(at), n)."""
    n = known.variables.n_columns
    out = np.zeros((known.rows.shape[1], len(directions)))
    out[:n] = np.array(directions).reshape(len(directions), n).T
    return out


def _growth_of(robot: Robot, known: Knowledge, growth: Mapping[str, float]) -> dict[str, float]:
    """1 sigma of growth by parameter; that of a name counts before that of its kind."""
    of_kind = {p.name: tolerance_kind(p) or "" for p in robot.parameters}
    kinds = {of_kind[name] for name in known.variables.names if of_kind[name]}
    for key in growth:
        _check_name("growth", key, [*known.variables.names, *sorted(kinds)])
    found = {name: growth.get(name, growth.get(of_kind[name], 0.0)) for name in known.variables.names}
    return {name: size for name, size in found.items() if size > 0.0}


def _changes(known: Knowledge, changed: Sequence[str]) -> list[Floats]:
    """Directions of what has changed, in the arm's columns."""
    by_name, robot = _named_columns(known), known.robot
    zeros = [name for name in zero_names(robot) if name not in names_of(robot.parameters)]
    tool = [name for name in by_name if name.startswith("tool.")]
    possible = [*by_name, *zeros, *(["tool"] if tool else [])]
    found = []
    for name in changed:
        _check_name("changed", name, possible)
        if name == "tool":
            found += [by_name[part] for part in tool]
        elif name in by_name:
            found.append(by_name[name])
        else:
            found.append(_zero(robot, name, by_name))
    return found


def _zero(robot: Robot, name: str, by_name: Mapping[str, Floats]) -> Floats:
    """A joint's zero as a combination of what was estimated of its origin.

    Raises:
        InputError: It is none.
    """
    of = motions(robot, random_readings(robot, 20, np.random.default_rng(0)))
    owner = f"{name.removesuffix('.zero')}."
    own = [n for n in by_name if n.startswith(owner)]
    A, b = np.array([of[n].ravel() for n in own]).T, of[name].ravel()
    v = np.linalg.lstsq(A, b, rcond=None)[0] if own else np.zeros(0)
    if not own or np.linalg.norm(A @ v - b) > 1e-6 * np.linalg.norm(b):
        raise InputError("changed", f"{name} cannot be expressed by what was estimated of that joint", "its roll, ...")
    out: Floats = sum((by_name[n] * x for n, x in zip(own, v, strict=True)), np.zeros(len(by_name)))
    return out


def _check_name(key: str, name: str, possible: Sequence[str]) -> None:
    if name not in possible:
        raise InputError(key, f"unknown parameter {name!r}", known_names(possible), did_you_mean(name, possible, NEAR))
