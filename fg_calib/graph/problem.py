"""The calibration problem: measurements gathered in series, whitened, as a GTSAM graph with a start.

`build_problem` makes it, `solve` solves it; in between it can be looked at: the graph, the initial values, which rows
take part and why the others do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.errors import ProblemError, shown
from fg_calib.graph.factors import (
    Variables,
    build_variables,
    frame_of,
    pose_of,
    prior_factors,
    prior_rows,
    row_factor,
    unknown_prior_rows,
)
from fg_calib.graph.knowledge import Knowledge
from fg_calib.graph.noise import JOINT_NOISE, NoiseState, Place, RowNoise, row_noise, same_everywhere
from fg_calib.graph.rows import At, RowSet, share_errors, whitened_rows
from fg_calib.initialization.hand_eye import Frame
from fg_calib.measurements.build import Dataset, start_frames
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.table import MeasurementBlock, Table, by_station
from fg_calib.options import Options
from fg_calib.robot.kinematics import Chain, forward
from fg_calib.robot.model import Parameter, Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Problem(FrozenArrays):
    """A calibration problem, ready to be solved.

    Attributes:
        robot: The nominal robot.
        data: Everything measured.
        options: What is estimated from what.
        variables: The GTSAM variables and their columns.
        start: Initial parameter vector (see `Variables`).
        state: What has been learned of the measurements' noise.
        rows: The whitened train rows.
        graph: Factors and priors, as GTSAM's own tools take them. Factors added to it are solved and assessed with it.
        initial: GTSAM's initial values; those of variables that added factors bring with them are inserted here.
        whole: The problem with everything estimated, where this one leaves parameters out to fix the gauge.
        factors: The factors that `graph` was made of.
        added: Those among them that somebody added (see `extension`).
        evaluated: Whether there are test rows alone: the arm is taken as it is, and measurement frame, base and tool,
            where they are estimated, are fitted to these.
        knowledge: What earlier rows say of the arm; None without any.
    """

    robot: Robot
    data: Dataset
    options: Options
    variables: Variables
    start: Floats
    state: NoiseState
    rows: tuple[RowSet, ...]
    graph: gtsam.NonlinearFactorGraph
    initial: gtsam.Values
    whole: Problem | None = None
    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    added: tuple[gtsam.NonlinearFactor, ...] = ()
    evaluated: bool = False
    knowledge: Knowledge | None = None

    def __getstate__(self) -> dict[str, Any]:
        """All but GTSAM's objects, whose factors call back into Python: they are made anew of the rows.

        Raises:
            ProblemError: Somebody added factors, which would be lost.
        """
        if self.added or self.graph.size() != self.factors.size():
            raise ProblemError("problem.graph", "added factors", "none: GTSAM's factors cannot be written")
        left = ("graph", "factors", "initial", "known", "noises")
        return {name: value for name, value in self.__dict__.items() if name not in left}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over a state, and make GTSAM's objects of it."""
        super().__setstate__(state)
        graph = _graph_of(self, self.rows)
        initial = self.variables.values(self.start)
        self.__dict__.update(graph=graph, factors=gtsam.NonlinearFactorGraph(graph), initial=initial)

    def __repr__(self) -> str:
        v, models = self.variables, ", ".join(str(table.model) for table in self.data.tables)
        frame = ", measurement frame unknown" if v.frames else ""
        return (
            f"Problem of {self.robot.name!r}: {models}{frame}, {self.n_configurations} configurations\n"
            f"  {self.n_residuals} residuals and {self.n_priors} priors on {v.n_columns + v.n_nuisance} unknowns in"
            f" {len(v.keys)} variables"
        )

    @cached_property
    def noises(self) -> tuple[RowNoise, ...]:
        """The rows of each series and their noise at `start`: of a million pairs as large as everything else."""
        return noises_at(self, self.start)

    @property
    def measurements(self) -> Measurements:
        """The first table of measurements."""
        return self.data.tables[0].measurements

    @property
    def end_names(self) -> tuple[str, ...]:
        """Names of what a row can be of: nothing at all (""), the configurations, then the unknowns.

        Rows count configurations from 0, then unknowns, and -1 for nothing, so end k has the name at k + 1.
        """
        return ("", *self.data.names)

    def names_of(self, key: int) -> tuple[str, ...]:
        """Names of a variable's entries, in their order.

        Raises:
            ProblemError: There is no such variable.
        """
        for v in self.variables.items:
            if isinstance(key, int) and v.key == key:
                return self.variables.names[v.columns]
        known = ", ".join(v.symbol for v in self.variables.items)
        symbol = str(gtsam.Symbol(key)).strip() if isinstance(key, int) and 0 <= key < 2**64 else shown(key)
        raise ProblemError("key", f"no variable {symbol} of the arm", f"one of {known}")

    @property
    def estimated(self) -> list[Parameter]:
        """The robot's estimated parameters, in the order of the columns."""
        parameters = {p.name: p for p in self.robot.parameters}
        return [parameters[name] for name in self.variables.names[: self.variables.n_robot_columns]]

    @property
    def pair_series(self) -> tuple[MeasurementBlock, ...]:
        """MeasurementBlock of pairs of configurations."""
        return tuple(s for s in self.data.series if s.kind.ends == 2)

    @property
    def formed(self) -> bool:
        """Whether pairs were formed from measured poses."""
        return any(s.formed for s in self.data.series)

    @property
    def n_pairs(self) -> int:
        """Train pairs that give at least one row."""
        tables = {s.table for s in self.pair_series}
        return sum(_n_different([s.number[s.train] for s in self.pair_series if s.table == t]) for t in tables)

    @property
    def n_configurations(self) -> int:
        """Configurations that the train rows come from."""
        return int(np.sum(self.data.fitted))

    @property
    def n_residuals(self) -> int:
        """Scalar residuals of the fit, priors and added factors not counted."""
        return sum(int(s.used[s.train].sum()) for s in self.data.series)

    @property
    def n_independent(self) -> int:
        """Residuals that the noise can make differ freely: pairs formed from poses hold no more than the poses do."""
        return self.n_residuals - round(sum(rows.n_spare for rows in self.rows))

    @property
    def n_priors(self) -> int:
        """Scalar priors."""
        of_unknowns = unknown_prior_rows(self.variables, self.start)[0]
        return len(prior_rows(self.variables, self.start)[0]) + len(of_unknowns)

    @property
    def n_added(self) -> int:
        """Scalar rows of the factors that somebody added."""
        return sum(factor.dim() for factor in self.added)

    @cached_property
    def known(self) -> Knowledge | None:
        """What earlier rows say of what is estimated; None where they say nothing."""
        if self.knowledge is None:
            return None
        found = self.knowledge.seen_by(self.variables, self.data.unknowns)
        return found if found.n else None

    @property
    def n_known(self) -> int:
        """Scalar rows of what earlier rows say."""
        return 0 if self.known is None else self.known.n

    @property
    def has_more(self) -> bool:
        """Whether more than measurements and tolerances says something of the arm."""
        return bool(self.added) or self.knowledge is not None

    @property
    def n_excluded(self) -> dict[str, int]:
        """Train pairs that take no part, by reason: once each, whatever was measured of them."""
        found: dict[str, set[tuple[int, int]]] = {}
        for s in self.data.series:
            for reason, mask in s.excluded.items():
                pairs = s.number[mask & ~s.test].tolist()
                found.setdefault(reason, set()).update((s.table, pair) for pair in pairs)
        return {reason: len(pairs) for reason, pairs in found.items()}

    @property
    def sigma_joint(self) -> Floats:
        """1 sigma of the joint readings as it is taken to be, shape (n_joints,), [rad] (prismatic: [m])."""
        return self.data.sigma_joint * self.state.factors.get(JOINT_NOISE, 1.0)

    @property
    def missing_correlation(self) -> bool:
        """Whether measurements share errors but were asked to count as independent."""
        return self.options.pair_errors == "independent" and share_errors(self.noises)


def _n_different(numbers: Sequence[Integers]) -> int:
    """How many different numbers, from 0, there are."""
    seen = np.zeros(1 + max((int(some.max(initial=-1)) for some in numbers), default=-1), dtype=np.bool_)
    for some in numbers:
        seen[some] = True
    return int(np.sum(seen))


def assembled(problem: Problem, start: Floats, state: NoiseState | None = None, **changes: Any) -> Problem:
    """A problem with its rows whitened, and started, at a parameter vector.

    Args:
        problem: The problem, of which rows and graph are made anew.
        start: The parameter vector.
        state: What has been learned of the noise; None for what the problem has.
        changes: What else of the problem is to change.
    """
    p = replace(problem, start=start, state=state or problem.state, **changes)
    noises = noises_at(p, start, fitted=True)
    if p.state.spread is not None and not any(noise.bends for noise in noises):
        # Test rows may be shorter than any train row.
        p = p if any(s.test.any() for s in p.pair_series) else replace(p, state=replace(p.state, spread=None))
    rows = _row_sets(p, noises)
    graph = _graph_of(p, rows)
    factors, initial = gtsam.NonlinearFactorGraph(graph), p.variables.values(start)
    return replace(p, rows=rows, initial=initial, graph=graph, factors=factors)


def _graph_of(problem: Problem, rows: tuple[RowSet, ...]) -> gtsam.NonlinearFactorGraph:
    """Rows, a problem's priors and what somebody added as factors; rows that depend on no variable are none."""
    graph = gtsam.NonlinearFactorGraph()
    for row_set in rows:
        if depends(row_set, problem.variables):
            graph.add(row_factor(row_set, problem.variables))
    for factor in (*prior_factors(problem.variables), *known_factors(problem), *problem.added):
        graph.add(factor)
    return graph


def depends(rows: RowSet, variables: Variables) -> bool:
    """Whether rows depend on any variable: on the core, or on an unknown that is estimated."""
    return bool(variables.items) or bool(np.any(variables.coordinates[rows.coordinates] >= 0))


def known_factors(problem: Problem) -> list[gtsam.CustomFactor]:
    """What earlier rows say as a factor, where they say anything."""
    known = problem.known
    return [] if known is None else [known.factor(problem.variables, problem.data.unknowns)]


def _row_sets(problem: Problem, noises: tuple[RowNoise, ...]) -> tuple[RowSet, ...]:
    """The train rows whitened by their noise."""
    state, sharing = problem.state, problem.options.pair_errors == "shared"
    weights = None
    if state.weights is not None:
        weights = [w[s.train] for w, s in zip(state.weights, problem.data.series, strict=True)]
    return whitened_rows(noises, sharing=sharing, joint_errors=state.joint_errors, weights=weights)


def noises_at(
    problem: Problem, parameters: Floats, *, at_readings: bool = False, fitted: bool = False
) -> tuple[RowNoise, ...]:
    """The rows of each series and their noise at a parameter vector.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        at_readings: Whether they are those of the readings also where true joint values are estimated.
        fitted: Whether they are the train rows alone; else train and test.
    """
    places = _places(problem, parameters, at_readings)
    series = [s.fitted if fitted else s for s in problem.data.series]
    return tuple(row_noise(s, places[s.table], problem.state) for s in series)


def _places(problem: Problem, parameters: Floats, at_readings: bool) -> list[Place]:
    data, errors = problem.data, problem.state.joint_errors
    trigs = data.trigs(problem.robot)
    if errors is not None and not at_readings:
        moved = [t.measurements.readings + errors[place] for t, place in zip(data.tables, data.places, strict=True)]
        trigs = tuple(problem.robot.trig(readings) for readings in moved)
    at = at_parameters(problem, parameters, trigs)
    estimated = problem.options.encoder == "estimated"
    return [
        Place(table.measurements, place, trig, chain, at.coordinates, estimated)
        for table, place, trig, chain in zip(data.tables, data.places, trigs, at.chains, strict=True)
    ]


def at_parameters(problem: Problem, parameters: Floats, trigs: Sequence[Floats] | None = None) -> At:
    """The arm and the measurements' unknowns at a parameter vector; test rows alone say where the others are.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        trigs: Readings of each table for the kernels, or the joint values that are estimated in their place.
    """
    at = problem.variables.at(parameters)
    if np.all(at.columns >= 0):
        return at
    trigs = trigs or problem.data.trigs(problem.robot)
    return problem.variables.at(parameters, contact_points(problem.data, at.chains, trigs))


def start_of(robot: Robot, data: Dataset, variables: Variables) -> Floats:
    """The nominal parameters with frames, tool and landmarks from closed forms, as a parameter vector.

    Args:
        robot: The nominal robot.
        data: The tables.
        variables: What is estimated.

    Raises:
        ProblemError: No image shows enough of a board.
    """
    start, tool = variables.nominal(), np.array(robot.owned_by(robot.n_joints + 1), dtype=np.int64)
    nominal, free, bare = np.zeros(6), np.zeros(6, dtype=np.bool_), robot.nominal
    if len(tool):
        nominal, free, bare[tool] = start[tool], np.array([robot.parameters[i].estimated for i in tool]), 0.0
    before = Frame(pose_of(nominal).rotation().matrix(), nominal[:3])
    begun = start_frames(robot.with_values(bare), data, before, free)
    if begun.found.any():
        start[tool[begun.found]] = _coordinates(begun.tool, nominal)[begun.found]
    for v in variables.frames:
        if v.number in begun.frames:
            start[v.places] = _coordinates(begun.frames[v.number])
    if variables.nuisance:
        at = variables.at(start)
        places = np.where(np.isnan(begun.places), contact_points(data, at.chains, data.trigs(robot)), begun.places)
        there = variables.coordinates >= 0
        start[variables.coordinates[there]] = places[there]
    return start


def _coordinates(frame: Frame, near: Floats | None = None) -> Floats:
    """x, y, z, yaw, pitch, roll of a frame (see `frame_of`)."""
    return frame_of(gtsam.Pose3(gtsam.Rot3(frame.rotation), frame.translation), near)


def contact_points(data: Dataset, chains: Sequence[Chain], trigs: Sequence[Floats]) -> Floats:
    """Of each unknown coordinate of a touched point the mean of what touched it, of others the start as given."""
    found: Floats = np.concatenate([np.zeros(0), *data.unknowns.starts])
    for s in data.series:
        touches = np.flatnonzero(says_where(data, s))
        if len(touches):
            p = forward(chains[s.table].without_columns(), trigs[s.table], s.ends[touches, 0]).position
            place = s.nuisances[touches].ravel()
            n, total = np.bincount(place), np.bincount(place, p.ravel())
            found[np.flatnonzero(n)] = total[n > 0] / n[n > 0]
    return found


def says_where(data: Dataset, series: MeasurementBlock) -> Booleans:
    """Which measurements say where points are that start there: touches, test ones where no train row touched.

    Returns:
        Shape (n,).
    """
    if not (series.kind.is_contact and series.kind.n_nuisances):
        return np.zeros(series.n, dtype=np.bool_)
    first, start = series.nuisances[:, 0], np.concatenate([np.zeros(0), *data.unknowns.starts])
    says: Booleans = np.isnan(start[first]) & ~(series.test & np.isin(first, first[~series.test]))
    return says


def reweighted_at(problem: Problem, parameters: Floats, state: NoiseState | None = None) -> Problem:
    """The same problem with its rows whitened, and started, at other parameters.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        state: What has been learned of the noise; None for what the problem has.
    """
    same = all(same_everywhere(s, problem.data.sigma_joint) for s in problem.data.series)
    if (state is None or state is problem.state) and same:
        return started_at(problem, parameters)
    return assembled(problem, parameters, state)


def some_rows(problem: Problem, share: float) -> Problem | None:
    """The same problem with some of its train rows, drawn evenly, whitened at its start.

    Args:
        problem: The problem.
        share: Which share of each series.

    Returns:
        None where single rows count for more than others do: where they have robust weights, or depend on unknowns of
        their own.
    """
    if problem.variables.nuisance or problem.options.loss != "none" or problem.state.weights is not None:
        return None
    rng, series = np.random.default_rng(0), []
    for s in problem.data.series:
        series.append(s.select(np.sort(rng.permutation(s.train)[: round(share * len(s.train))])))
    return assembled(replace(problem, data=replace(problem.data, series=tuple(series))), problem.start)


def started_at(problem: Problem, start: Floats) -> Problem:
    """The same problem, its rows as they are whitened, with another start: a parameter vector."""
    return replace(problem, start=start, initial=problem.variables.values(start))


def by_columns_of(problem: Problem, variables: Variables) -> Problem:
    """The same problem and rows by the columns of the variables of more, or the same, parameters."""
    state = problem.state
    if state.spread is not None:
        state = replace(state, spread=variables.columns_of(problem.variables, problem.start) @ state.spread)
    return replace(problem, variables=variables, state=state)


def same_rows(a: Problem, b: Problem) -> bool:
    """Whether two problems have the very same rows, to the last figure."""
    return _equal(a.rows, b.rows)


def _equal(a: Any, b: Any) -> bool:
    """Whether two rows' data are equal: arrays, sparse arrays, tuples and dataclasses of them."""
    if a is b or type(a) is not type(b):
        return a is b
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(_equal, a, b))
    if isinstance(a, scipy.sparse.csr_array):
        return _equal((a.data, a.indices, a.indptr), (b.data, b.indices, b.indptr))
    return (
        all(_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.compare)
        if is_dataclass(a)
        else bool(a == b)
    )


def mahalanobis_distances(problem: Problem, parameters: Floats) -> list[tuple[Floats, Integers]]:
    """Of each series the length of each measurement's residual, whitened by all its noise, and its number of rows.

    The residuals are those at the readings: at joint values estimated from these very rows they would be shorter.

    Args:
        problem: The problem.
        parameters: The parameter vector.

    Returns:
        Shapes (n,) each, train and test; both are 0 for a measurement that takes no part.
    """
    return [noise.lengths() for noise in noises_at(problem, parameters, at_readings=True)]


def joint_errors(problem: Problem, parameters: Floats) -> Floats:
    """What the train rows say of the errors of the joint readings: true values less readings, to first order.

    Returns:
        Shape (n_configurations, n_joints), [rad] (prismatic: [m]); about the joint values that the problem has.
    """
    sigma = problem.sigma_joint
    joints = np.flatnonzero(sigma > 0.0)
    found = np.zeros((problem.data.n_configurations, len(sigma)))
    at = problem.variables.at(parameters)
    for rows in problem.rows:
        if rows.shared is not None:
            z = rows.most_likely(at)[:, rows.joints : rows.joints + len(joints)]
            found[np.ix_(rows.configurations, joints)] = -sigma[joints] * z
    return found


def frames_only(problem: Problem) -> Problem | None:
    """The same problem with the arm at nominal: measurement frame, base and tool alone; None if none is estimated."""
    robot, n = problem.robot, problem.robot.n_joints
    frames = [p.name for p in robot.parameters if p.estimated and not 1 <= p.owner <= n]
    if not frames and not problem.variables.frames:
        return None
    robot = robot.with_estimated(frames)
    variables = variables_of(robot, problem.data, problem.options)
    options = replace(problem.options, encoder="propagated", pair_errors="independent")  # good enough for a start
    start = problem.start[: variables.nuisance_span.stop]
    state = replace(problem.state, joint_errors=None, spread=None)  # of other columns
    return assembled(
        problem, start, state, robot=robot, variables=variables, options=options, added=(), knowledge=None, whole=None
    )


def variables_of(robot: Robot, data: Dataset, options: Options) -> Variables:
    """The variables of a robot, its measurement frames and the measurements' unknowns."""
    frames = [table.unknown_frame for table in data.tables]
    return build_variables(robot, frames, options.has_priors).with_unknowns(data.unknowns, data.estimated())


def tables_of(
    measurements: Measurements | Table | Sequence[Measurements | Table], options: Options
) -> tuple[Table, ...]:
    """Tables, those without choices of their own with those of the options.

    Raises:
        ProblemError: There is none.
    """
    given = [measurements] if isinstance(measurements, Measurements | Table) else list(measurements)
    if not given:
        raise ProblemError("measurements", "no table", "at least one")
    o = options
    tables = [t if isinstance(t, Table) else Table(t, o.model, o.pairing, o.frame) for t in given]
    return tuple(part for table in tables for part in by_station(table))


def problem_at(
    robot: Robot, data: Dataset, options: Options, variables: Variables, start: Floats, **more: Any
) -> Problem:
    """A problem with its rows whitened at a start."""
    return assembled(unassembled(robot, data, options, variables, start, **more), start)


def unassembled(
    robot: Robot, data: Dataset, options: Options, variables: Variables, start: Floats, **more: Any
) -> Problem:
    """A problem that has no rows and no graph yet."""
    estimated = options.encoder == "estimated" and bool(np.any(data.sigma_joint > 0.0))
    state = NoiseState(joint_errors=np.zeros_like(data.readings) if estimated else None)
    empty = gtsam.NonlinearFactorGraph()
    return Problem(robot, data, options, variables, start, state, (), empty, gtsam.Values(), **more)
