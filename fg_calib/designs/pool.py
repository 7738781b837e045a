"""Stops to choose from: what the instruments of a scenario would measure at many configurations, row by row.

Every instrument of the scenario measures at all candidates what the arm as drawn would show it, without noise but with
the sigmas that it states: so the rows, and what is not seen, are those of `simulate`. Instruments with configurations
of their own, and what the tool has to touch, have stops of their own.

Of pairs a stop is one end: in a star all are measured against a hub, which is the first configuration.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import Brief
from fg_calib.designs.candidates import Candidates, candidates
from fg_calib.designs.rows import StopRows, stop_rows
from fg_calib.designs.scene import along_axes
from fg_calib.designs.task import Posterior, n_measured
from fg_calib.errors import InputError
from fg_calib.graph.build import true_problem
from fg_calib.graph.factors import Variables, unknown_prior_rows
from fg_calib.graph.information import whitened_jacobian
from fg_calib.graph.knowledge import coordinates_of
from fg_calib.graph.problem import Problem
from fg_calib.measurements.dataset import Noise
from fg_calib.measurements.landmarks import Landmarks
from fg_calib.measurements.table import KnownPoint, Table
from fg_calib.observability.random_configurations import Places, places_of
from fg_calib.options import PAIR_MODELS, Gauge, Model, Options, Pairing
from fg_calib.robot.model import Robot
from fg_calib.robot.rotations import left_jacobian
from fg_calib.simulation.configurations import BoardViews, Configurations, GivenReadings, Placement
from fg_calib.simulation.instruments import BoardCamera, Instrument, PairGauge, Tracker, with_figures
from fg_calib.simulation.scenario import Errors, Scenario, Simulation
from fg_calib.simulation.simulator import pairing_of, simulate

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

HUB, NONE = -1, -2
"""Instead of the number of a stop: what all pairs of a star are measured against, and a test row."""

_ID = re.compile(r"^(?:(\S+) (?:\S+ )?)?p(\d+)$")
"""How a simulation names a configuration: what instrument it is of, where it is one's own, and its number."""


@dataclass(frozen=True)
class Pool(Brief):
    """Stops to choose from.

    Attributes:
        scenario: What measures, with all that it leaves to be drawn as it was drawn; None where rows of tables are
            chosen.
        tables: What it would measure at all of them.
        problem: The problem of these.
        readings: Of each stop, shape (n_stops, n_joints), [rad] (prismatic: [m]).
        group: The instrument whose own stop each is; "" for those where all others measure.
        stop: The stop of each configuration of the problem, shape (n_configurations,); `HUB`, or `NONE` where nothing
            is fitted.
        rows: What each stop would add.
        given: Stops that were measured already, or will be anyway.
        found: How the candidates of each group came about.
        before: What was measured already, as the problem of its rows at its solution; None where nothing was.
        formed: By the number of a table of poses that pairs are formed of: of which model, and how.
    """

    scenario: Scenario | None
    tables: tuple[Table, ...]
    problem: Problem
    readings: Floats
    group: NDArray[np.str_]
    stop: Integers
    rows: StopRows
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
        """What was measured already, whitened, by the columns of the stops' rows, shape (m, n_columns)."""
        wide = known_rows_of(self.before, self.problem)
        return np.pad(wide, ((0, 0), (0, len(self.rows.scales) - wide.shape[1])))

    @property
    def hubs(self) -> Integers:
        """Configurations of the problem that all pairs of a star are measured against, of each star one."""
        return np.flatnonzero(self.stop == HUB)

    def groups_of(self, configurations: Integers) -> NDArray[np.str_]:
        """The instrument whose own some configurations of the problem are, hubs among them; "" for common ones."""
        names = self.problem.data.names
        own = [_named(names[k])[0] if self.scenario is not None else "" for k in configurations.tolist()]
        return np.array(own, dtype=np.str_)

    def tables_of(self, stops: Integers, pairing: Pairing | None = None) -> list[Table]:
        """What would be measured at some of the stops, in their order, behind hubs that have pairs.

        Args:
            stops: They.
            pairing: How pairs are formed instead, where they are formed of poses.
        """
        names = self.problem.data.names[: self.problem.data.n_configurations]
        of_stop: dict[int, list[int]] = {}
        for k, stop in enumerate(self.stop.tolist()):
            of_stop.setdefault(stop, []).append(k)
        wanted = [*self.hubs.tolist(), *(k for stop in stops.tolist() for k in of_stop.get(stop, []))]
        order = {names[k]: place for place, k in enumerate(wanted)}
        found = [_between_used(selected(table, order), known=self.before is not None) for table in self.tables]
        for number, (model, own) in self.formed.items():
            found[number] = replace(found[number], model=model, frame="known", pairing=pairing or own)
        return [table if _says_something(table) else selected(table, {}) for table in found]

    @property
    def _as_it_is(self) -> Posterior:
        """What is known of what was measured already."""
        assert self.before is not None
        return Posterior(self.before, whitened_jacobian(self.before, self.before.start, with_loss=True))

    def posterior(self, stops: Integers, pairing: Pairing | None = None) -> Posterior:
        """What would be known with some stops measured beside what was, exactly as a calibration would say it.

        Args:
            stops: They, and those given among them.
            pairing: How pairs are formed instead, where they are formed of poses.
        """
        if not len(stops) and self.before is not None:
            return self._as_it_is
        places = places_of(self.problem, self.problem.start)
        problem = true_problem(self.robot, self.tables_of(stops, pairing), self.problem.options, places)
        rows = whitened_jacobian(problem, problem.start)
        if self.before is None:
            return Posterior(problem, rows)
        if not problem.rows:  # one end of a pair
            return self._as_it_is
        # What is told of points is in what was measured, and counts once.
        rows = rows[len(unknown_prior_rows(problem.variables, problem.start)[0]) :]
        return Posterior(problem, np.vstack([rows, known_rows_of(self.before, problem)]), n_measured(self.before))


def selected(table: Table, order: Mapping[str, int]) -> Table:
    """The rows of a table at some configurations, in an order by their names."""
    m = table.measurements
    ids = m.ids.tolist()
    rows = np.array(sorted((k for k, n in enumerate(ids) if n in order), key=lambda k: order[ids[k]]), dtype=np.int64)
    part = m.select(rows)
    if m.groups is not None:
        part = replace(part, groups=replace(m.groups, index=m.groups.index[rows]))
    if m.pairs is not None:
        place = np.full(len(ids), -1)
        place[rows] = np.arange(len(rows))
        a, b = place[m.pairs.a], place[m.pairs.b]
        there = np.flatnonzero((a >= 0) & (b >= 0))
        part = replace(part, pairs=replace(m.pairs.select(there), a=a[there], b=b[there]))
    return replace(table, measurements=part)


def _between_used(table: Table, *, known: bool) -> Table:
    """A table of touched points with lengths between those alone that are touched, and with none that are known.

    Args:
        table: It, or any other, which stays as it is.
        known: Whether lengths were measured already: they count once.
    """
    m = table.measurements
    if m.groups is None:
        return table
    pairs = m.groups.pairs
    used = np.isin(pairs.a, m.groups.index) & np.isin(pairs.b, m.groups.index) & (not known)
    return replace(table, measurements=replace(m, groups=replace(m.groups, pairs=pairs.select(np.flatnonzero(used)))))


def _says_something(table: Table) -> bool:
    """Whether a table holds more than the hub of a star that has no other stop."""
    m = table.measurements
    if m.pairs is not None:
        return bool(m.pairs.n_pairs)
    return table.model not in PAIR_MODELS or m.groups is not None or m.n_configurations > 1


def known_rows_of(before: Problem | None, problem: Problem) -> Floats:
    """What a problem's rows say, whitened, by the columns of another problem of the same arm and tables.

    Landmarks that the other has not are eliminated.

    Returns:
        Shape (m, n_columns + n_nuisance) of the other's.
    """
    v = problem.variables
    n = v.n_columns + v.n_nuisance
    if before is None:
        return np.zeros((0, n))
    A, own = whitened_jacobian(before, before.start, with_loss=True), before.variables
    there = _columns_by_name(v, problem.data.unknowns)
    of_own = _columns_by_name(own, before.data.unknowns)
    both = [name for name in of_own if name in there]
    mine = np.concatenate([of_own[name] for name in both])
    place = np.concatenate([there[name] for name in both])
    for name in both:
        if name[0] == "B":  # turned by the same, about the base's axes
            turns = [left_jacobian(p.start[_place_of(p, columns[:3])][None])[0] for p, columns in
                     ((before, of_own[name]), (problem, there[name]))]  # fmt: skip
            A[:, of_own[name][:3]] = A[:, of_own[name][:3]] @ np.linalg.solve(*turns)
    others = np.setdiff1d(np.arange(A.shape[1]), mine)
    Q = np.linalg.qr(A[:, others])[0] if len(others) else np.zeros((len(A), 0))
    left = A[:, mine] - Q @ (Q.T @ A[:, mine])
    out = np.zeros((len(left), n))
    out[:, place] = left
    return out


def _place_of(problem: Problem, columns: Integers) -> Integers:
    """Where nuisance columns stand in the parameter vector."""
    v = problem.variables
    place: Integers = columns - v.n_columns + v.nuisance_span.start
    return place


def _columns_by_name(variables: Variables, unknowns: Landmarks) -> dict[tuple[str, str], Integers]:
    """Columns of each variable: of the core's by its symbol, of the unknowns' by letter and name."""
    found = {("", v.symbol): np.arange(v.columns.start, v.columns.stop) for v in variables.items}
    for letter, name in zip(unknowns.letters, unknowns.names, strict=True):
        place = coordinates_of(variables, unknowns, (letter, name))
        if place is not None:
            found[letter, name] = place - variables.nuisance_span.start + variables.n_columns
    return found


def _staying(before: Problem) -> Places:
    """Where things are by what was measured already, boards left out: those may be turned over (see `scene`)."""
    return {name: place for name, place in places_of(before, before.start).items() if name[0] != "B"}


def drawn(scenario: Scenario, n: int, generator: np.random.Generator) -> dict[str, Candidates]:
    """Candidates for the stops of a scenario's instruments, by the instrument whose own they are, "" for all others.

    Args:
        scenario: The arm, the instruments, where they may measure, and how well.
        n: How many are drawn for each; of a table all are taken.
        generator: Draws them.

    Raises:
        InputError: None can be had.
    """
    return {name: candidates(scenario.robot, of, generator, n=n) for name, of in _groups(scenario).items()}


def pool_of(
    scenario: Scenario,
    found: Mapping[str, Candidates],
    *,
    given: Floats | None = None,
    before: Problem | None = None,
    hubs: Mapping[str, int] | None = None,
) -> Pool:
    """The stops that a scenario's instruments may measure at.

    Args:
        scenario: The arm, the instruments, where they may measure, and how well.
        found: Candidates, see `drawn`.
        given: Readings of stops that were measured already, or will be anyway, shape (n, n_joints).
        before: What was measured already.
        hubs: Which of the candidates comes first, by whose they are: of a star it is the hub.

    Raises:
        InputError: The scenario cannot be, or nothing is seen from anywhere.
    """
    scenario = _with_instruments(scenario)
    simulation = simulate(_silent(scenario, _in_order(found, given, hubs or {})), leave_out=True)
    tables = _as_told(simulation)
    if before is not None:
        tables = tuple(map(along_axes, tables, before.data.tables))
    options = Options(tables[0].model or "pose", gauge=_gauge(scenario)) if before is None else before.options
    problem = true_problem(scenario.robot, tables, options, None if before is None else _staying(before))
    data = problem.data
    _check_rows(problem)
    names = [_named(name) for name in data.names[: data.n_configurations]]
    common = _hubs(problem)
    kept = np.setdiff1d(np.arange(len(names)), common)
    stop = np.full(len(names), HUB)
    stop[kept] = np.arange(len(kept))
    n_given = 0 if given is None else len(given)
    if n_given and not any(name == "" and k < n_given for name, k in names):
        raise InputError("given", "configurations at which nothing is measured", "a job with what was touched")
    return Pool(
        scenario=_placed(scenario, simulation),
        tables=tables,
        problem=problem,
        readings=data.readings[kept],
        group=np.array([names[k][0] for k in kept], dtype=np.str_),
        stop=stop,
        rows=stop_rows(problem, stop, common, alone=before is None),
        given=np.array([stop[k] for k in kept if names[k][0] == "" and names[k][1] < n_given], dtype=np.int64),
        found=found,
        before=before,
        formed=_formed(scenario),
    )


def _in_order(found: Mapping[str, Candidates], given: Floats | None, hubs: Mapping[str, int]) -> dict[str, Floats]:
    """Readings of candidates by whose they are, hubs first, and before those in common the ones that are given."""
    readings = {name: one.readings for name, one in found.items()}
    if given is not None and "" not in readings:
        reason = "where every instrument has configurations of its own"
        raise InputError("given", reason, "a job with what was measured")
    for name, first in hubs.items():
        q = readings[name]
        readings[name] = np.vstack([q[first : first + 1], np.delete(q, first, axis=0)])
    if given is not None:
        readings[""] = np.vstack([given, readings[""]])
    return readings


def _check_rows(problem: Problem) -> None:
    """Check that anything is measured at any candidate."""
    if not problem.rows:
        n = problem.data.n_configurations
        found = "one, of which no pair is made" if n == 1 else f"{n}, at none of which anything is measured"
        raise InputError("candidates", found, "more configurations")


def _formed(scenario: Scenario) -> dict[int, tuple[Model, Pairing]]:
    """Instruments by whose poses pairs are formed, by their numbers."""
    return {
        k: (i.model, i.pairing)
        for k, i in enumerate(scenario.instruments)
        if isinstance(i, Tracker) and i.model in PAIR_MODELS
    }


def _hubs(problem: Problem) -> Integers:
    """Configurations that all pairs of a star have in common."""
    found = []
    for s in problem.pair_series:
        ends = problem.data.places[s.table][s.ends[s.train]]
        if len(ends) and np.all(ends[:, 0] == ends[0, 0]):
            found.append(ends[0, 0])
    return np.unique(np.array(found, dtype=np.int64))


def _with_instruments(scenario: Scenario) -> Scenario:
    """The same with what measures poses, where the scenario names no instrument, as one."""
    if scenario.instruments:
        return scenario
    model, pairing = scenario.job.get("model", "distance-rotation"), pairing_of(scenario.job.get("pairing", "star"))
    return replace(scenario, instruments=(Tracker(model=model, name="poses", pairing=pairing),))


def _groups(scenario: Scenario) -> dict[str, Configurations]:
    """Where measures who: the common configurations, and those that an instrument has for itself."""
    own = {i.name: i.configurations for i in scenario.instruments if i.configurations is not None}
    return own if len(own) == len(scenario.instruments) > 0 else {"": scenario.configurations} | own


def _named(name: str) -> tuple[str, int]:
    """The group and the number of a configuration."""
    found = _ID.match(name)
    assert found is not None, name
    return found[1] or "", int(found[2])


def _silent(scenario: Scenario, readings: Mapping[str, Floats]) -> Scenario:
    """A scenario whose arm is as drawn, without noise, though what is stated of noise stays, at some readings."""
    stated = scenario.stated_noise or scenario.noise
    instruments: list[Instrument] = []
    for i in scenario.instruments:
        views = i.configurations or scenario.configurations
        told = with_figures(with_figures(stated, i.noise), i.stated_noise)
        changes: dict[str, Any] = {"noise": _without(told), "stated_noise": told}
        if i.configurations is not None:
            changes["configurations"] = GivenReadings(readings[i.name])
        if isinstance(i, Tracker) and i.model in PAIR_MODELS:
            changes |= _as_poses(i)
        elif isinstance(i, PairGauge):
            changes["pairs"] = Pairing("star")
        elif isinstance(i, BoardCamera) and not (i.boards or i.fixed) and isinstance(views, BoardViews):
            changes["boards"] = {"board": views.board}
        instruments.append(replace(i, **changes))
    return replace(
        scenario,
        errors=Errors("values", {}),
        noise=_without(stated),
        stated_noise=stated,
        validation=None,
        configurations=GivenReadings(readings.get("", np.zeros((0, scenario.robot.n_joints)))),
        instruments=tuple(instruments),
    )


def _without(noise: Noise) -> Noise:
    """No noise of the kinds that are stated; of others there is still none stated."""
    nothing: dict[str, Any] = {f.name: None if getattr(noise, f.name) is None else 0.0 for f in fields(Noise)[:-1]}
    return Noise(**nothing)


def _as_poses(i: Tracker) -> dict[str, Any]:
    """What measures poses that pairs are formed of, where these are no star: see `MEASURED`."""
    if i.pairing.strategy == "star":
        return {}
    return {"model": MEASURED[i.model], "frame": Placement(np.eye(3), np.zeros(3))}


MEASURED: Mapping[Model, Model] = {"distance": "position", "rotation": "orientation", "distance-rotation": "pose"}
"""What is measured for pairs of each model to be formed.

All distances between points say where they are but for one motion `x -> U x + t`; all angles of `R_a^T R_b` how they
are turned but for rotations on both sides, `R -> U' R V`. Positions in an unknown frame hold as much as the former.
Poses in an unknown frame hold more than both together: V is 1, and U' is U, six unknowns less. Whatever the stops,
their error is no larger, so that stops chosen by poses are the best for all pairs to the share by which all pairs of
these very stops give a larger one."""


def _as_told(simulation: Simulation) -> tuple[Table, ...]:
    """The tables; what is told of points is where they are, without an error."""
    places = {name: spot for kind in ("targets", "anchors") for name, spot in simulation.truth.get(kind, {}).items()}
    return tuple(
        replace(t, known={name: KnownPoint(places[name].xyz, known.tolerance) for name, known in t.known.items()})
        for t in simulation.tables
    )


def _placed(scenario: Scenario, simulation: Simulation) -> Scenario:
    """The scenario with what it leaves to be drawn where it was drawn."""
    truth, instruments = simulation.truth, []
    for i in scenario.instruments:
        changes: dict[str, Any] = {}
        for key in ("targets", "anchors", "planes", "sockets"):
            count = getattr(i, key, None)
            if isinstance(count, int) and count:
                changes[key] = {n: thing for n, thing in truth[key].items() if n.startswith(i.name)}
        instruments.append(replace(i, **changes))
    frame = simulation.frame if scenario.frame == "unknown" else scenario.frame
    return replace(scenario, frame=frame, instruments=tuple(instruments))


def _gauge(scenario: Scenario) -> Gauge:
    """Whether tolerances count: they do unless the scenario's job says that nothing does."""
    job = scenario.job
    return "none" if job.get("gauge") == "none" or job.get("prior") is False else "prior"
