"""New rows of an arm that was calibrated before, with what that calibration says of it.

The rows are whitened by their noise and linearised at the calibrated arm, measurement frames and whatever else does not
stay with the arm fitted to them. What the arm and its targets may be off is fitted, too, with the calibration's
information as rows `R s` of its own, R^T R its inverse covariance; what nothing determined, frames, anchors, planes,
boards, touched points and offsets have no such rows. So the smallest sum of squares is chi-square by the covariance
`N + J Sigma J^T` after what is free has been fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from fg_calib.diagnostics import basis_of
from fg_calib.graph import (
    JOINT_NOISE,
    Knowledge,
    NoiseName,
    NoiseState,
    Problem,
    Solution,
    State,
    WhitenedBlock,
    at_parameters,
    coordinates_of,
    problem_at,
    solve,
    start_of,
    tables_of,
    unknown_prior_rows,
    variables_of,
    with_factors,
)
from fg_calib.inputs import Floats, Integers, ProblemError
from fg_calib.measurements import INSTRUMENTS, KnownPoint, Table, build_dataset, residuals
from fg_calib.monitoring.prior_information import with_tolerances
from fg_calib.options import Options
from fg_calib.robot import Robot, names_of

_NOTHING = 1e-9
"""Part of a column's length that counts as nothing."""


@dataclass(frozen=True)
class Calibrated:
    """An arm that was calibrated before.

    Attributes:
        robot: The nominal robot, with its tolerances; what the calibration is of is estimated.
        values: Its parameters as calibrated, shape (n_parameters,).
        knowledge: What the calibration's rows say; None where the arm was evaluated only.
        options: Its options.
        noise: What stated sigmas are multiplied by, by table and kind, where noise was estimated.
        noise_degrees: Degrees of freedom that it was estimated by; None where it was stated, or is not known.
    """

    robot: Robot
    values: Floats
    knowledge: Knowledge | None
    options: Options
    noise: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    noise_degrees: float | None = None

    @cached_property
    def information(self) -> Knowledge | None:
        """What rows and tolerances say."""
        if self.knowledge is None or not self.options.has_priors:
            return self.knowledge
        estimated = {p.name: p.tolerance for p in self.robot.parameters if p.estimated and p.tolerance is not None}
        return with_tolerances(self.knowledge, self.robot.nominal, estimated)

    def state_for(self, tables: Sequence[Table], like: Sequence[str]) -> NoiseState:
        """The noise of new tables: as it was found, of the only table if there was one.

        Args:
            tables: The tables, those of one station each.
            like: By the number of each which of the calibration's it is like.
        """
        factors: dict[NoiseName, float] = {}
        of_tables = {name: kinds for name, kinds in self.noise.items() if name}
        if "joint" in self.noise.get("", {}):
            factors[JOINT_NOISE] = self.noise[""]["joint"]
        for number, name in enumerate(like):
            kinds = of_tables.get(name) or (next(iter(of_tables.values())) if len(of_tables) == 1 else {})
            factors |= {(number, kind): factor for kind, factor in kinds.items()}
        return NoiseState(factors=factors)


@dataclass(frozen=True)
class Rows:
    """New tables, as they are to be compared with a calibrated arm.

    Attributes:
        tables: They, those of one station each.
        like: Of each the name of the calibration's table that it is like.
    """

    tables: tuple[Table, ...]
    like: tuple[str, ...]

    @classmethod
    def of(cls, tables: Sequence[Table], like: Sequence[str], options: Options) -> Rows:
        """Tables apart by their stations.

        Args:
            tables: They.
            like: Of each the name of the calibration's table that it is like.
            options: Of the calibration.
        """
        parts = [(part, name) for t, name in zip(tables, like, strict=True) for part in tables_of([t], options)]
        return cls(tuple(part for part, _ in parts), tuple(name for _, name in parts))

    def turned(self, offsets: Floats) -> Rows:
        """The same with the joints turned by so much more than was read, shape (n_joints,)."""
        moved = [
            replace(t, measurements=replace(t.measurements, readings=t.measurements.readings + offsets))
            for t in self.tables
        ]
        return replace(self, tables=tuple(moved))

    def at_known_places(self, known: Knowledge | None, tolerance: float | None) -> tuple[Table, ...]:
        """The tables with targets and anchors where they were found to be.

        Args:
            known: What says where they are.
            tolerance: Figure that lets them be estimated from there on; None to hold them.
        """
        if known is None:
            return self.tables

        def with_places(table: Table) -> Table:
            letters = {kind.letter for kind in INSTRUMENTS[str(table.model)].landmarks} if table.model else set()
            places = {
                name: KnownPoint(known.place((letter, name)), tolerance)
                for letter, name in known.unknowns
                if letter in letters
            }
            return replace(table, known={**table.known, **places}).by_itself()

        return tuple(map(with_places, self.tables))


@dataclass(frozen=True)
class Placed:
    """New rows with the arm held, frames and all that does not stay with it fitted.

    Attributes:
        solution: The fit.
        problem: The same rows with every parameter of the robot, and targets, estimated; started there.
        pinned: Unknowns that the calibration says where they are.
    """

    solution: Solution
    problem: Problem
    pinned: tuple[tuple[str, str], ...]


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
    options = replace(
        calibrated.options,
        gauge="none",
        encoder="propagated",
        loss="none",
        estimate_noise=False,
        estimate_tolerance=None,
        prefer=(),
    )
    state = calibrated.state_for(rows.tables, rows.like)

    def problem(arm: Robot, tables: Sequence[Table], start: Solution | None) -> Problem:
        data = build_dataset(arm, tables)
        variables = variables_of(arm, data, options)
        x = start_of(arm, data, variables) if start is None else variables.nominal()
        if start is not None:
            x[variables.frame_span] = start.parameters[variables.frame_span]
            there = variables.coordinates >= 0
            x[variables.coordinates[there]] = at_parameters(start.problem, start.parameters).coordinates[there]
        return with_factors(problem_at(arm, data, options, variables, x), x, state)

    held = problem(robot.with_estimated([]), rows.at_known_places(known, None), None)
    if not held.n_residuals:
        raise ProblemError(held.data.source, "no row takes part", "rows that model and options use")
    solution = solve(held)
    wide = problem(robot.with_estimated(names_of(robot.parameters)), rows.at_known_places(known, 1.0), solution)
    seen = () if known is None else known.unknowns
    pinned = tuple(n for n in seen if coordinates_of(wide.variables, wide.data.unknowns, n) is not None)
    return Placed(solution, wide, pinned)


@dataclass(frozen=True)
class Linear:
    """New rows and what is known of the arm as one linear system, what the arm may be off fitted.

    Attributes:
        placed: The rows.
        r: Residuals, zeros for what is known below them, shape (m + k,).
        system: The rows by what is fitted, then what is known of that, shape (m + k, n).
        directions: What is fitted, in the columns of `placed.problem`, shape (n_columns + n_nuisance, n).
        fitted: Basis of `system`, shape (m + k, rank).
        columns: Derivatives in the columns of `placed.problem`, shape (m, n_columns + n_nuisance).
        joints: Derivatives in the joints' zeros, shape (m, n_joints).
        dof: Degrees of freedom of chi-square.
        n_free: Directions that were fitted to the new rows alone.
    """

    placed: Placed
    r: Floats
    system: Floats
    directions: Floats
    fitted: Floats
    columns: Floats
    joints: Floats
    dof: int
    n_free: int

    @property
    def left(self) -> Floats:
        """What the fit leaves of the residuals."""
        out: Floats = self.r - self.fitted @ (self.fitted.T @ self.r)
        return out

    @property
    def chi2(self) -> float:
        """Chi-square, by noise and by what the arm may be off."""
        return float(np.sum(self.left**2))

    def stacked(self, columns: Floats) -> Floats:
        """Columns of the rows with zeros for what is known, shape (m + k, n)."""
        return np.vstack([columns, np.zeros((len(self.r) - len(columns), columns.shape[1]))])

    def without(self, columns: Floats) -> Linear:
        """The same with more columns fitted, such as those of gross errors, shape (m, n)."""
        U, s, _ = np.linalg.svd(self.new(columns), full_matrices=False)
        more = U[:, s > _NOTHING * s.max(initial=0.0)]
        return replace(
            self,
            system=np.hstack([self.system, self.stacked(columns)]),
            directions=np.hstack([self.directions, np.zeros((len(self.directions), columns.shape[1]))]),
            fitted=np.hstack([self.fitted, more]),
            dof=self.dof - more.shape[1],
        )

    def new(self, columns: Floats) -> Floats:
        """What columns of the rows have that is not fitted, shape (m + k, n)."""
        wide = self.stacked(columns)
        for _ in range(2):  # once more: rounding of the first time
            wide = wide - self.fitted @ (self.fitted.T @ wide)
        return wide


def linearise_new_data(calibrated: Calibrated, at: Placed) -> Linear:
    """The rows and what is known as a linear system.

    What is fitted are the arm and the landmarks that the calibration knows, held by its information, and everything
    else of the rows, held by what the job says of it.
    """
    problem, v = at.problem, at.problem.variables
    J, joints, r = linearised(problem)
    stated, J_stated = unknown_prior_rows(v, problem.start)
    pinned = np.concatenate([np.zeros(0, dtype=np.int64), *(_columns_of(problem, name) for name in at.pinned)])
    own = ~np.any(J_stated[:, pinned] != 0.0, axis=1)  # what it says of landmarks that the calibration knows is in it
    stated, J_stated = stated[own], J_stated[own]
    every, known = np.eye(v.n_columns + v.n_nuisance), np.zeros((v.n_columns + v.n_nuisance, 0))
    information = np.zeros((0, 0))
    if calibrated.information is not None:
        knowledge = calibrated.information.about(at.pinned)
        arm = np.zeros((len(every), knowledge.variables.n_columns))
        arm[: v.n_columns] = v.columns_of(knowledge.variables, problem.start)
        known, information = np.hstack([arm, every[:, pinned]]), knowledge.rows
    frames = [np.arange(v.n_columns)[f.columns] for f in v.frames]
    free = np.concatenate([*frames, np.setdiff1d(np.arange(v.n_columns, len(every)), pinned)])
    directions = np.hstack([known, every[:, free.astype(np.int64)]])
    of_known = np.hstack([information, np.zeros((len(information), len(free)))])
    system = np.vstack([J @ directions, of_known, J_stated @ directions])
    fitted = basis_of(system)
    n_given = len(information) + len(stated)
    return Linear(
        placed=at,
        r=np.concatenate([r, np.zeros(len(information)), stated]),
        system=system,
        directions=directions,
        fitted=fitted,
        columns=J,
        joints=joints,
        dof=problem.n_independent + n_given - fitted.shape[1],
        n_free=fitted.shape[1] - n_given,
    )


def linearised(problem: Problem) -> tuple[Floats, Floats, Floats]:
    """Whitened rows: derivatives in all columns, in the joints' zeros, and residuals."""
    at = problem.variables.at(problem.start)
    n = at.n_columns + at.n_nuisance
    blocks = []
    for rows in problem.rows:
        wide = np.hstack([rows.private(at), _of_joints(rows, at)])
        blocks.append(wide if rows.states is None else rows.states.whiten(wide))
    every = np.vstack(blocks)
    return every[:, :n], every[:, n + 1 :], every[:, n]


def _of_joints(rows: WhitenedBlock, at: State) -> Floats:
    """Derivatives of rows in the joints' zeros, the same for all configurations, shape (n_rows, n_joints)."""
    found = []
    for part in rows.parts:
        chain, block = at.chains[part.table], part.at(at)
        ends = block.kind.ends
        J = residuals.linearise(block, chain.without_columns().with_joint_columns())[1]
        J = J[:, :, : ends * chain.n_joints].reshape(*J.shape[:2], ends, chain.n_joints).sum(axis=2)
        found.append(J.reshape(-1, chain.n_joints))
    return np.vstack(found)


def _columns_of(problem: Problem, name: tuple[str, str]) -> Integers:
    v = problem.variables
    place = coordinates_of(v, problem.data.unknowns, name)
    assert place is not None
    out: Integers = place - v.nuisance_span.start + v.n_columns
    return out
