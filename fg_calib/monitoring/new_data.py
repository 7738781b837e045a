"""New rows of an arm that was calibrated before, with what that calibration says of it.

The rows are whitened by their noise and linearised at the calibrated arm, measurement frames and whatever else does not
stay with the arm fitted to them. Errors of the arm and its targets are fitted, too, with the calibration's information
as rows `R s` of its own, R^T R its inverse covariance. Frames, anchors, planes, boards, contact points, offsets and
what nothing determined have no such rows. So the smallest sum of squares is chi-square by the covariance
`N + J Sigma J^T`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fg_calib import diagnostics, graph, statistics
from fg_calib.inputs import Booleans, Floats, Integers, Options, ProblemError, Record
from fg_calib.measurements import INSTRUMENTS, Dataset, KnownPoint, Table, build_dataset
from fg_calib.monitoring.prior_information import Calibrated
from fg_calib.robot import Robot, names_of
from fg_calib.statistics.residual_table import residual_table


class Rows(Record):
    """New tables, as they are to be compared with a calibrated arm.

    Attributes:
        tables: The new tables, split by station.
        like: Of each the name of the calibration's table that it is like.
    """

    tables: tuple[Table, ...]
    like: tuple[str, ...]

    @classmethod
    def of(cls, tables: Sequence[Table], like: Sequence[str], options: Options) -> "Rows":
        """Tables apart by their stations.

        Args:
            tables: The new tables.
            like: Of each the name of the calibration's table that it is like.
            options: Of the calibration.
        """
        parts = [(part, name) for t, name in zip(tables, like, strict=True) for part in graph.tables_of([t], options)]
        return cls(tuple(part for part, _ in parts), tuple(name for _, name in parts))

    def all_train(self) -> "Rows":
        """The rows with test rows as train rows."""
        return replace(self, tables=tuple(table.all_train() for table in self.tables))

    def without(self, configurations: Sequence[Booleans]) -> "Rows":
        """The rows with those at some configurations, shape (n_configurations,) a table, as the only test rows."""
        tables = (t.tested_on(which) for t, which in zip(self.tables, configurations, strict=True))
        return replace(self, tables=tuple(tables))

    def held_at(self, known: graph.Knowledge | None) -> tuple[Table, ...]:
        """The tables with targets and anchors held where they were found to be."""
        found = {} if known is None else {name: known.place(name) for name in known.unknowns}

        def held(table: Table) -> Table:
            letters = {kind.letter for kind in INSTRUMENTS[str(table.model)].landmarks} if table.model else set()
            places = {n: KnownPoint(at, None) for (letter, n), at in found.items() if letter in letters}
            return replace(table, known={**table.known, **places}).by_itself()

        return tuple(map(held, self.tables))

    def free_of(self, known: graph.Knowledge | None) -> tuple[Table, ...]:
        """The tables with targets and anchors to be estimated of which the calibration says where they are."""
        stays = () if known is None else {name for _, name in known.unknowns}
        return tuple(replace(t, known={n: at for n, at in t.known.items() if n not in stays}) for t in self.tables)


class Placed(Record):
    """New rows with the arm held, frames and all that does not stay with it fitted.

    Attributes:
        calibrated: The arm.
        solution: The fit.
        problem: The same rows with every parameter of the robot, and targets, estimated; started there.
        pinned: Unknowns that the calibration says where they are.
    """

    calibrated: Calibrated
    solution: graph.Solution
    problem: graph.Problem
    pinned: tuple[tuple[str, str], ...]

    def errors(self) -> tuple[statistics.HeldOut, ...]:
        """How well the arm predicts the rows, frames and what does not stay with it fitted, by table and kind."""
        table = residual_table(self.solution)
        tested = replace(table, test=table.used, n_fitted=0, seen=np.zeros_like(table.seen))
        return tested.held_out(self.problem.data.labels)


def place_new_data(calibrated: Calibrated, rows: Rows, values: Floats) -> Placed:
    """New rows at an arm that is held.

    Args:
        calibrated: The arm.
        rows: The rows.
        values: Its parameters.

    Raises:
        ProblemError: The rows lack what their model needs, or do not suffice for a frame.
    """
    robot, known = calibrated.robot.with_values(values), calibrated.knowledge
    options = replace(calibrated.fixed_options, gauge="none", encoder="propagated", loss="none", prefer=())
    state, arm = calibrated.noise_of(rows.like), robot.with_estimated([])
    data = build_dataset(arm, rows.held_at(known))
    v = graph.variables_of(arm, data, options)
    x = graph.start_of(arm, data, v)
    held = graph.with_factors(graph.problem_at(arm, data, options, v, x), x, state)
    if not held.n_residuals:
        raise ProblemError(data.source, "no row takes part", "rows that model and options use")
    solution, arm = graph.solve(held), robot.with_estimated(names_of(robot.parameters))
    problem = started(arm, build_dataset(arm, rows.free_of(known)), options, values, solution)
    seen, of = () if known is None else known.unknowns, problem.data.landmarks
    pinned = tuple(name for name in seen if graph.coordinates_of(problem.variables, of, name) is not None)
    return Placed(calibrated, solution, problem, pinned)


def started(
    arm: Robot, data: Dataset, options: Options, values: Floats, fit: graph.Solution, **more: Any
) -> graph.Problem:
    """The problem of new rows, started at the arm as it was calibrated and at what was fitted to the rows.

    Args:
        arm: The robot, with what is to be estimated.
        data: The rows.
        options: The options.
        values: The robot's parameters as calibrated.
        fit: The fit of the same rows with the arm held.
        more: Other fields of the problem.
    """
    v = graph.variables_of(arm, data, options)
    x, there = v.nominal(), v.coordinates >= 0
    x[v.robot_span], x[v.frame_span] = values, fit.parameters[v.frame_span]
    x[v.coordinates[there]] = fit.problem.variables.at(fit.parameters).coordinates[there]
    made = graph.problem_at(arm, data, options, v, x, **more)
    return graph.with_factors(made, x, replace(made.state, factors=fit.problem.state.factors))


class Linear(Record):
    """New rows and what is known of the arm as one linear system, what the arm may be off fitted.

    Attributes:
        placed: The rows.
        left: Residuals after the fit of the rows, then of what is known, shape (m + k,).
        fitted: Basis of what is fitted, shape (m + k, rank).
        of_arm: Derivatives in the arm's columns, shape (m, n_robot_columns).
        dof: Degrees of freedom of chi-square.
        n_free: Directions that were fitted to the new rows alone.
    """

    placed: Placed
    left: Floats
    fitted: Floats
    of_arm: Floats
    dof: int
    n_free: int

    @property
    def robot(self) -> Robot:
        """The arm with its values where the rows are linearised."""
        return self.placed.problem.robot

    @property
    def chi2(self) -> float:
        """Chi-square, by noise and by what the arm may be off."""
        return float(np.sum(self.left**2))

    def new(self, columns: Floats) -> Floats:
        """Part of columns of the rows, shape (m, n), that is not fitted, shape (m + k, n)."""
        wide = np.pad(columns, ((0, len(self.left) - len(columns)), (0, 0)))
        for _ in range(2):  # once more: rounding of the first time
            wide = wide - self.fitted @ (self.fitted.T @ wide)
        return wide


def linearise_new_data(at: Placed) -> Linear:
    """The rows and what is known as a linear system.

    What is fitted are the arm and the landmarks that the calibration knows, held by its information, and everything
    else of the rows, held by what the job says of it.
    """
    calibrated, problem, v = at.calibrated, at.problem, at.problem.variables
    wide = v.n_columns + v.n_nuisance
    every = problem.rows.states.whiten(problem.rows.private(v.at(problem.start)))
    J, r = every[:, :wide], every[:, wide]
    r_priors, J_priors = graph.unknown_prior_rows(v, problem.start)
    places = [graph.coordinates_of(v, problem.data.landmarks, name) for name in at.pinned]
    pinned = v.columns_at(np.array(places, dtype=np.int64).ravel())
    unit, known, information = np.eye(wide), np.zeros((wide, 0)), np.zeros((0, 0))
    if calibrated.information is not None:
        knowledge = calibrated.information.about(at.pinned)
        arm = np.pad(v.columns_of(knowledge.variables, problem.start), ((0, wide - v.n_columns), (0, 0)))
        known, information = np.hstack([arm, unit[:, pinned]]), knowledge.rows
    frames = [np.arange(v.n_columns)[f.columns] for f in v.frames]
    free = np.concatenate([*frames, np.setdiff1d(np.arange(v.n_columns, wide), pinned)])
    directions = np.hstack([known, unit[:, free.astype(np.int64)]])
    of_known = np.hstack([information, np.zeros((len(information), len(free)))])
    fitted = diagnostics.basis_of(np.vstack([J @ directions, of_known, J_priors @ directions]))
    r = np.concatenate([r, np.zeros(len(information)), r_priors])
    n_free = fitted.shape[1] - len(information) - len(r_priors)
    left, dof = r - fitted @ (fitted.T @ r), problem.n_independent - n_free
    return Linear(at, left, fitted, J[:, : v.n_robot_columns], dof, n_free)


def ends_of_rows(problem: graph.Problem) -> Integers:
    """The configurations of each row that is whitened by its private noise, -1 for no second one, shape (n, 2)."""
    found = []
    for part in problem.rows.parts:
        ends = np.pad(problem.data.places[part.table][part.block.ends], ((0, 0), (0, 2)), constant_values=-1)
        found.append(np.repeat(ends[:, :2], part.block.residual_dim, axis=0))
    return np.concatenate(found)
