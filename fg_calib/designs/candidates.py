"""Candidate poses: everything that the instruments of a scenario would measure at many configurations.

Every instrument measures at all candidates what the nominal arm would show it, without noise, with the sigmas that it
specifies. So the rows, and what is not seen, are those of `simulate`. Instruments with configurations of their own, and
those that the tool must contact, have poses of their own.

Pairs have two ends. In a star all pairs share the reference pose, the first candidate; the pose is the other end.
"""

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib import simulation
from fg_calib.designs.information import PoseRows, Posterior, count_measurements, gather_rows
from fg_calib.graph import Problem, Variables, coordinates_of, square_root, unknown_prior_rows
from fg_calib.inputs import PAIR_MODELS, Brief, Floats, Gauge, InputError, Integers, Model, Options, Pairing, expect
from fg_calib.measurements import INSTRUMENTS, Landmarks, Table
from fg_calib.observability import places_of, true_problem
from fg_calib.robot import Robot
from fg_calib.simulation import BoardViews, Candidates, Errors, GivenReadings, Instrument, Scenario

REFERENCE, NONE = -1, -2
"""Instead of the number of a pose: the reference of a star, and a configuration at which nothing is fitted."""

MEASURED: Mapping[Model, Model] = {"distance": "position", "rotation": "orientation", "distance-rotation": "pose"}
"""Model to measure for pairs of each model to be formed.

All distances between points determine them but for one motion `x -> U x + t`; all angles of `R_a^T R_b` determine the
rotations but for `R -> U' R V`. Positions in an unknown frame hold as much as the former. Poses in an unknown frame
hold more than both together: V is 1 and U' is U, six unknowns fewer. So poses chosen for poses in an unknown frame are
nearly the best for all pairs formed from them."""


class Pool(Brief):
    """Candidate poses.

    Attributes:
        scenario: The instruments; None where rows of tables are chosen.
        tables: Tables that it would measure at all candidates.
        problem: The problem of these tables.
        readings: Of each pose, shape (n_poses, n_joints), [rad] (prismatic: [m]).
        pose_of: The pose of each configuration of the problem, shape (n_configurations,); `REFERENCE` or `NONE`.
        rows: Rows that each pose would add.
        given: Poses that were measured already, or will be anyway.
        found: How the candidates of each group were found.
        before: The problem of earlier measurements, at its solution; None without any.
        formed: By the number of a table of poses that pairs are formed from: their model and pairing.
    """

    scenario: Scenario | None
    tables: tuple[Table, ...]
    problem: Problem
    readings: Floats
    pose_of: Integers
    rows: PoseRows
    given: Integers
    found: Mapping[str, Candidates] = field(default_factory=dict)
    before: Problem | None = None
    formed: Mapping[int, tuple[Model, Pairing]] = field(default_factory=dict)

    @property
    def robot(self) -> Robot:
        """The arm, where the rows are linearised."""
        p = self.problem
        return p.robot.with_values(p.start[p.variables.robot_span])

    @property
    def known(self) -> Floats:
        """Whitened rows of earlier measurements, in the columns of the poses' rows, shape (m, n_columns)."""
        wide = np.zeros((0, 0)) if self.before is None else rows_in_columns_of(self.before, self.problem)
        return np.pad(wide, ((0, 0), (0, len(self.rows.scales) - wide.shape[1])))

    @property
    def references(self) -> Integers:
        """Configurations of the problem that are references, one a star."""
        return np.flatnonzero(self.pose_of == REFERENCE)

    def groups_of(self, configurations: Integers) -> NDArray[np.str_]:
        """The instrument whose own some configurations of the problem are; "" for common ones."""
        names = self.problem.data.names
        own = [_split_name(names[k])[0] if self.scenario is not None else "" for k in configurations.tolist()]
        return np.array(own, dtype=np.str_)

    def select_tables(self, poses: Integers) -> list[Table]:
        """Select what would be measured at some poses, in their order, after references that have pairs."""
        names = self.problem.data.names[: self.problem.data.n_configurations]
        wanted = np.concatenate([self.references, *(np.flatnonzero(self.pose_of == number) for number in poses)])
        order = {names[k]: place for place, k in enumerate(wanted.tolist())}
        found = [_between_used(select_rows(table, order), known=self.before is not None) for table in self.tables]
        for number, table in enumerate(found):
            if number in self.formed:
                model, pairing = self.formed[number]
                found[number] = replace(table, model=model, frame="known", pairing=pairing)
        return [table if _has_rows(table) else select_rows(table, {}) for table in found]

    def posterior(self, poses: Integers) -> Posterior:
        """Posterior with some poses, given ones included, after the earlier ones, as a calibration would report it."""
        here, measured = self.problem, [] if self.before is None else [self.before]
        if len(poses):
            new = true_problem(self.robot, self.select_tables(poses), here.options, places_of(here, here.start))
            measured += [new] * bool(new.rows.parts or not measured)  # one end of a pair measures nothing
        rows = [rows_in_columns_of(problem, here) for problem in measured]
        rows = rows or [unknown_prior_rows(here.variables, here.start)[1]]
        if len(measured) == 2:  # priors of landmarks are in the rows of earlier measurements, and count once
            rows[1] = rows[1][len(unknown_prior_rows(new.variables, new.start)[0]) :]
        return Posterior(here, np.vstack(rows), sum(map(count_measurements, measured)))


def select_rows(table: Table, order: Mapping[str, int]) -> Table:
    """Select the rows of a table at some configurations, in an order by their names."""
    m = table.measurements
    ids = m.ids.tolist()
    rows = np.array(sorted((k for k, n in enumerate(ids) if n in order), key=lambda k: order[ids[k]]), dtype=np.int64)
    groups = None if m.groups is None else replace(m.groups, index=m.groups.index[rows])
    return replace(table, measurements=replace(m.select(rows), groups=groups))


def _between_used(table: Table, *, known: bool) -> Table:
    """A table of contact points with lengths between those alone that are used; without lengths that are known."""
    m = table.measurements
    if m.groups is None:
        return table
    pairs = m.groups.pairs
    used = np.isin(pairs.a, m.groups.index) & np.isin(pairs.b, m.groups.index) & (not known)
    return replace(table, measurements=replace(m, groups=replace(m.groups, pairs=pairs.select(np.flatnonzero(used)))))


def _has_rows(table: Table) -> bool:
    """Whether a table holds more than the reference of a star."""
    m = table.measurements
    return table.model not in PAIR_MODELS or m.groups is not None or m.n_configurations > 1


def rows_in_columns_of(before: Problem, problem: Problem) -> Floats:
    """Whitened rows of a problem, at its start, in the columns of another one of the same arm and tables.

    Landmarks that the other problem does not have are eliminated.

    Returns:
        Shape (m, n_columns + n_nuisance) of the other problem.
    """
    v = problem.variables
    A = square_root(before, before.start, with_loss=True)[:, :-1]
    columns = _columns_by_name(v, problem.data.landmarks)
    own = _columns_by_name(before.variables, before.data.landmarks)
    both = [name for name in own if name in columns]
    shared = np.concatenate([own[name] for name in both])
    others = np.setdiff1d(np.arange(A.shape[1]), shared)
    Q = np.linalg.qr(A[:, others])[0] if len(others) else np.zeros((len(A), 0))
    out = np.zeros((len(A), v.n_columns + v.n_nuisance))
    out[:, np.concatenate([columns[name] for name in both])] = A[:, shared] - Q @ (Q.T @ A[:, shared])
    return out


def _columns_by_name(variables: Variables, unknowns: Landmarks) -> dict[tuple[str, str], Integers]:
    """Columns of each variable: of the core's and of curves by their symbols, of landmarks by letter and name."""
    own = (*variables.items, *(v for v in variables.nuisance if v.kind == "curve"))
    found = {("", v.symbol): np.arange(v.columns.start, v.columns.stop) for v in own}
    for letter, name in unknowns.keys:
        if (place := coordinates_of(variables, unknowns, (letter, name))) is not None:
            found[letter, name] = variables.columns_at(place)
    return found


def draw_groups(scenario: Scenario, n: int, generator: np.random.Generator) -> dict[str, Candidates]:
    """Draw candidates, by the instrument whose own they are, "" for all others.

    Args:
        scenario: The arm, the instruments, and where they may measure.
        n: How many are drawn for each; of a table all are taken.
        generator: Draws them.

    Raises:
        InputError: None are found, with the shares of the reasons; or with self-motion held, the first view of a board
            is not reached.
    """
    own = {i.name: i.configurations for i in scenario.instruments if i.configurations is not None}
    groups = own if len(own) == len(scenario.instruments) > 0 else {"": scenario.configurations} | own
    draw, robot = simulation.draw_candidates, scenario.robot
    found = {name: draw(robot, of, generator, n, "candidates") for name, of in groups.items()}
    for one in found.values():
        hint = "is the base itself in a box of keep_out?" * (one.rejected.get("in keep_out") == one.asked)
        expect(len(one.readings), "candidates", f"none in {one.reasons()}", "some that the arm can take", hint)
    return found


def build_pool(
    scenario: Scenario, found: Mapping[str, Candidates], *, given: Floats | None = None, before: Problem | None = None
) -> Pool:
    """Build the pool of poses at which a scenario's instruments may measure.

    Args:
        scenario: The arm, the instruments, where they may measure, and how well.
        found: Candidates, see `draw_groups`.
        given: Readings of poses that were measured already, or will be anyway, shape (n, n_joints).
        before: The problem of earlier measurements, at its solution.

    Raises:
        InputError: The scenario is impossible, or nothing is seen from anywhere.
    """
    scenario = _with_instruments(scenario)
    tables = _measure_all(scenario, found, given)
    gauge: Gauge = "none" if scenario.job.get("gauge") == "none" or scenario.job.get("prior") is False else "prior"
    options = Options(tables[0].model or "pose", gauge=gauge) if before is None else before.options
    problem = true_problem(scenario.robot, tables, options, None if before is None else places_of(before, before.start))
    n, n_given = problem.data.n_configurations, 0 if given is None else len(given)
    reason = "one, of which no pair is made" if n == 1 else f"{n}, at none of which anything is measured"
    expect(problem.rows.parts, "candidates", reason, "more configurations")
    names = [_split_name(name) for name in problem.data.names[:n]]
    among_given = np.array([name == "" and k < n_given for name, k in names])
    if n_given and not among_given.any():
        raise InputError("given", "configurations at which nothing is measured", "a job with what was touched")
    own = [(k, i) for k, i in enumerate(scenario.instruments) if i.model in PAIR_MODELS and i.sockets is None]
    formed = {k: (i.model, i.pairing or Pairing()) for k, i in own}
    more = {"scenario": scenario, "tables": tables, "found": found, "before": before, "formed": formed}
    pool = pool_of(problem, np.arange(len(names)), scenario.source, alone=before is None, **more)
    return replace(pool, given=pool.pose_of[among_given & (pool.pose_of >= 0)])


def pool_of(problem: Problem, poses: Integers, source: str, *, alone: bool = True, **more: Any) -> Pool:
    """The pool of some configurations of a problem, without references that pairs share.

    Args:
        problem: The problem.
        poses: The configurations.
        source: Name of the scenario or the job, for messages.
        alone: See `gather_rows`.
        more: Other fields.

    Raises:
        InputError: Pairs without one reference pose.
    """
    references = _find_references(problem, source)
    poses = np.setdiff1d(poses, references)
    pose_of = np.full(problem.data.n_configurations, NONE)
    pose_of[references], pose_of[poses] = REFERENCE, np.arange(len(poses))
    rows = gather_rows(problem, pose_of, references, alone=alone)
    fields = {"scenario": None, "tables": problem.data.tables, "given": np.zeros(0, dtype=np.int64)} | more
    return Pool(problem=problem, readings=problem.data.readings[poses], pose_of=pose_of, rows=rows, **fields)


def _measure_all(scenario: Scenario, found: Mapping[str, Candidates], given: Floats | None) -> tuple[Table, ...]:
    """The tables of all candidates and of given configurations, without noise.

    Raises:
        InputError: Configurations are given where every instrument has its own.
    """
    readings = {name: one.readings for name, one in found.items()}
    if given is not None:
        reason = "where every instrument has configurations of its own"
        expect("" in readings, "given", reason, "a job with what was measured")
        readings[""] = np.vstack([given, readings[""]])
    return simulation.simulate(_nominal(scenario, readings), exact=True).tables


def _find_references(problem: Problem, source: str) -> Integers:
    """Configurations that all pairs of a table have in common.

    Raises:
        InputError: Pairs without one reference pose: what other pairs share is not one pose's.
    """
    ends = [problem.data.places[s.table][s.ends[s.train, 0]] for s in problem.pair_blocks]
    if any(len(np.unique(first)) > 1 for first in ends):
        raise InputError(source, "pairs that are no star", "pairing star, or candidates that are no rows")
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *ends]))


def _with_instruments(scenario: Scenario) -> Scenario:
    """The scenario with what measures poses, where it names no instrument, as one.

    Raises:
        InputError: An instrument measures pairs directly.
    """
    if name := next((i.name for i in scenario.instruments if i.pairs is not None), ""):
        expected = "model: pose with frame: unknown to choose the configurations of pairs"
        raise InputError(f"instruments: {name}", "pairs that are measured directly", expected)
    if scenario.instruments:
        return scenario
    model = scenario.job.get("model", "distance-rotation")
    pairing = scenario.pairing if model in PAIR_MODELS else None
    return replace(scenario, instruments=(Instrument(model=model, name="poses", pairing=pairing),))


def _split_name(name: str) -> tuple[str, int]:
    """The group and the number of a configuration, `p7`, `wire p7`, or `wire wire p7` where something is touched."""
    *own, last = name.split(" ")
    return own[0] if own else "", int(last.removeprefix("p"))


def _nominal(scenario: Scenario, readings: Mapping[str, Floats]) -> Scenario:
    """A scenario of the nominal arm at some readings."""
    instruments: list[Instrument] = []
    for i in scenario.instruments:
        views, changes = i.configurations or scenario.configurations, dict[str, Any]()
        if i.configurations is not None:
            changes["configurations"] = GivenReadings(readings[i.name])
        if i.pairing is not None and i.pairing.strategy != "star":
            in_base = simulation.Placement(np.eye(3), np.zeros(3))
            changes |= {"model": MEASURED[i.model], "frame": in_base, "pairing": None}
        elif "board" in INSTRUMENTS[i.model].labels and not (i.boards or i.fixed) and isinstance(views, BoardViews):
            changes["boards"] = {"board": views.board}
        instruments.append(replace(i, **changes))
    at, none = GivenReadings(readings.get("", np.zeros((0, scenario.robot.n_joints)))), Errors("values", {})
    return replace(scenario, errors=none, validation=None, configurations=at, instruments=tuple(instruments))
