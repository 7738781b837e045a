"""The calibration problem: measurements gathered in blocks, whitened, with a start, and its GTSAM graph.

`build_problem` makes it, `solve` solves it; in between it can be looked at: the graph, the initial values, which rows
take part and why the others do not.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import cached_property, lru_cache
from typing import Any

import gtsam
import numpy as np

from fg_calib.graph.error_states import Eliminated, WhitenedRows, correlation_of, whitened_rows
from fg_calib.graph.factors import linearize_factors, measurement_factors, prior_factors, with_added
from fg_calib.graph.knowledge import Knowledge
from fg_calib.graph.noise_models import JOINT_NOISE, POSE_SLOTS, NoiseState, RowNoise, TableState, same_everywhere
from fg_calib.graph.normal_system import NormalSystem, eliminate, eliminate_more
from fg_calib.graph.robust import effect
from fg_calib.graph.variables import Variables, build_variables, frame_of, pose_of, prior_rows, unknown_prior_rows
from fg_calib.initialization import Frame
from fg_calib.inputs import Floats, FrozenArrays, Integers, Options, ProblemError, SolverError
from fg_calib.measurements import Dataset, MeasurementBlock, Measurements, Table, Tables, by_station, start_frames
from fg_calib.robot import Chain, Parameter, Robot, forward

N_REMEMBERED = 4
"""Parameter vectors whose square root a problem remembers: the start, nominal and the estimate are asked for often."""

NO_ROWS = whitened_rows((), sharing=False, joints=False, weights=None)
"""The rows of a problem before they are whitened."""


class Problem(FrozenArrays):
    """A calibration problem, ready to be solved.

    Attributes:
        robot: The nominal robot.
        data: Everything measured.
        options: The options.
        variables: The GTSAM variables and their columns.
        start: Initial parameter vector (see `Variables`).
        state: Estimated noise.
        rows: The whitened train rows.
        whole: The problem with everything estimated, where this one leaves parameters out to fix the gauge.
        added: Factors that a user added to `graph`.
        evaluated: Whether there are test rows alone: the arm is taken as it is, and measurement frame, base and tool,
            where they are estimated, are fitted to these.
        knowledge: Information of earlier rows about the arm; None without any.
    """

    robot: Robot
    data: Dataset
    options: Options
    variables: Variables
    start: Floats
    state: NoiseState
    rows: WhitenedRows
    whole: "Problem | None" = None
    added: tuple[gtsam.NonlinearFactor, ...] = ()
    evaluated: bool = False
    knowledge: Knowledge | None = None

    def __getstate__(self) -> dict[str, Any]:
        """All but what follows from the rest.

        Raises:
            ProblemError: A user added factors, which would be lost.
        """
        if self.added or self._more_factors:
            raise ProblemError("problem.graph", "added factors", "none: GTSAM's factors cannot be written")
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """One factor a measurement, error variables where measurements share errors, and priors.

        Factors that a user adds are solved and assessed with it.
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in self.own_factors:
            graph.add(factor)
        return graph

    @cached_property
    def initial(self) -> gtsam.Values:
        """GTSAM's initial values; a user inserts here those of variables that added factors bring with them."""
        values = self.variables.values(self.start)
        values.insert(self._measured[1])
        return values

    @cached_property
    def own_factors(self) -> tuple[gtsam.NonlinearFactor, ...]:
        """The factors that `graph` is made of."""
        known = [] if self.known is None else [self.known.factor(self.variables, self.data.landmarks)]
        return (*self._measured[0], *prior_factors(self.variables), *known, *self.added)

    @cached_property
    def _measured(self) -> tuple[list[gtsam.NonlinearFactor], gtsam.Values]:
        """Factors of the measurements, and estimates of the errors that they share, in units of their sigma."""
        return measurement_factors(self.rows, self.variables, self.variables.at(self.start))

    @property
    def _more_factors(self) -> tuple[gtsam.NonlinearFactor, ...]:
        """The factors in `graph` that it was not made of.

        Raises:
            ProblemError: Factors were removed or replaced.
        """
        graph = self.__dict__.get("graph")
        if graph is None:
            return ()
        every = [graph.at(i) for i in range(graph.size())]
        if any(a is not b for a, b in zip(every, self.own_factors, strict=False)) or len(every) < len(self.own_factors):
            found = "factors removed or replaced"
            raise ProblemError("problem.graph", found, f"all {len(self.own_factors)} of the problem, in their places")
        return tuple(every[len(self.own_factors) :])

    def __repr__(self) -> str:
        v, models = self.variables, ", ".join(str(table.model) for table in self.data.tables)
        frame = ", measurement frame unknown" if v.frames else ""
        unknowns = f"{v.n_columns + v.n_nuisance} unknowns in {len(v.keys)} variables"
        head = f"Problem of {self.robot.name!r}: {models}{frame}, {self.n_configurations} configurations"
        return f"{head}\n  {self.n_residuals} residuals and {self.n_priors} priors on {unknowns}"

    @cached_property
    def system(self) -> NormalSystem:
        """The normal system at `start`."""
        return self.linearize(self.start)

    @property
    def curves_are_states(self) -> bool:
        """Whether error curves are eliminated as states, or held: no errors are shared, and nothing was added."""
        return bool(self.variables.n_curves) and not self.rows.states.n_states and not self.has_more

    def linearize(self, parameters: Floats, *, with_loss: bool = False, held: bool = False) -> NormalSystem:
        """The normal system at a parameter vector: all train rows, priors and added factors.

        Noise and the loads of effects are those at `start`: see `relinearized_at` and `loaded_at`.

        Args:
            parameters: The parameter vector.
            with_loss: Whether a robust loss counts for what it loses of clean data (see `robust.Effect`).
            held: Whether error curves stay as they are, if they are states.

        Raises:
            SolverError: A residual or derivative is not finite.
        """
        v, given = self.variables, self.rows  # of the system, which would keep the problem in a cycle
        priors = np.column_stack(prior_rows(v, parameters)[::-1])
        if self.curves_are_states:
            rows: Floats | Eliminated = self._without_curves(parameters, with_loss, held)
        else:
            rows = square_root(self, parameters, with_loss=with_loss)
        with np.errstate(over="ignore"):
            size = rows if isinstance(rows, np.ndarray) else rows.A
            if not np.isfinite(np.vdot(size, size) + np.vdot(priors, priors)):
                raise SolverError("a residual is not finite: the measurements or the robot hold absurd numbers")
        gather = lambda: given.private(v.at(parameters))  # noqa: E731 -- for statistics of single rows alone
        return NormalSystem(rows, v.n_columns, v.prior_scales, priors, self.rows.states, gather)

    def _without_curves(self, parameters: Floats, with_loss: bool, held: bool) -> Eliminated:
        """The rows with error curves, then landmarks, eliminated."""
        v, variance = self.variables, loss_variance(self) if with_loss else 1.0
        found = self._curve_roots(parameters.tobytes(), variance, held)
        (r, J), n = unknown_prior_rows(v, parameters, of_curves=False), v.n_columns
        others = np.column_stack([np.delete(J, np.s_[n : n + v.n_curves], axis=1), r])
        return eliminate_more(found, others, n)

    @cached_property
    def noises(self) -> tuple[RowNoise, ...]:
        """The rows of each block and their noise at `start`: of a million pairs as large as everything else."""
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
        """Names of the entries of a variable of the arm, in their order."""
        names = {v.key: self.variables.names[v.columns] for v in self.variables.items}
        if key not in names:
            raise ProblemError("key", "no variable of the arm", "that of one of problem.variables.items")
        return names[key]

    @property
    def estimated(self) -> list[Parameter]:
        """The robot's estimated parameters, in the order of the columns."""
        by_name = {p.name: p for p in self.robot.parameters}
        return [by_name[name] for name in self.variables.names[: self.variables.n_robot_columns]]

    @property
    def pair_blocks(self) -> tuple[MeasurementBlock, ...]:
        """Blocks of pairs of configurations."""
        return tuple(s for s in self.data.blocks if s.kind.ends == 2)

    @property
    def formed(self) -> bool:
        """Whether pairs were formed from measured poses."""
        return any(s.formed for s in self.data.blocks)

    @property
    def n_pairs(self) -> int:
        """Train pairs that give at least one row."""
        each = [s.table * 2**32 + s.number[s.train].astype(np.int64) for s in self.pair_blocks]
        return len(np.unique(np.concatenate([np.zeros(0, np.int64), *each])))

    @property
    def n_configurations(self) -> int:
        """Configurations that the train rows come from."""
        return int(np.sum(self.data.fitted))

    @property
    def n_residuals(self) -> int:
        """Scalar residuals of the fit, priors and added factors not counted."""
        return sum(int(s.used[s.train].sum()) for s in self.data.blocks)

    @property
    def n_independent(self) -> int:
        """Residuals that the noise can make differ freely: pairs formed from poses hold no more than the poses do."""
        return self.n_residuals - round(self.rows.n_spare)

    @property
    def n_priors(self) -> int:
        """Scalar priors."""
        of_unknowns = sum(len(v.prior[0]) for v in self.variables.nuisance if v.prior is not None)
        return of_unknowns + sum(len(places) for places, _ in self.variables.prior_weights.values())

    @property
    def n_added(self) -> int:
        """Scalar rows of added factors, in the problem of a solution; 0 before `solve`."""
        return sum(factor.dim() for factor in self.added)

    @cached_property
    def known(self) -> Knowledge | None:
        """Information of earlier rows about what is estimated; None without any."""
        found = self.knowledge and self.knowledge.seen_by(self.variables, self.data.landmarks)
        return found if found and found.n else None

    @property
    def has_more(self) -> bool:
        """Whether more than measurements and tolerances says something of the arm."""
        return bool(self.added) or self.knowledge is not None

    @property
    def is_exchangeable(self) -> bool:
        """Whether no row counts for more than others: none has a robust weight or depends on landmarks."""
        return not (self.variables.nuisance or self.options.loss != "none" or self.state.weights is not None)

    @property
    def n_excluded(self) -> dict[str, int]:
        """Train pairs that take no part, by reason: once each, whatever was measured of them."""
        found = {reason: set[tuple[int, int]]() for s in self.data.blocks for reason in s.excluded}
        for s in self.data.blocks:
            for reason, mask in s.excluded.items():
                found[reason].update((s.table, pair) for pair in s.number[mask & ~s.test].tolist())
        return {reason: len(pairs) for reason, pairs in found.items()}

    @property
    def sigma_joint(self) -> Floats:
        """1 sigma of the joint readings as it is taken to be, shape (n_joints,), [rad] (prismatic: [m])."""
        return self.data.sigma_joint * self.state.factors.get(JOINT_NOISE, 1.0)

    @property
    def joints_estimated(self) -> bool:
        """Whether true joint values are estimated."""
        return self.options.encoder == "estimated" and bool(np.any(self.data.sigma_joint > 0.0))

    @cached_property
    def _square_roots(self) -> Callable[[bytes], Floats]:
        """Rows [A r] with the Gram matrix of the train rows, error states eliminated, at a parameter vector's bytes."""
        rows, variables = self.rows, self.variables
        return lru_cache(N_REMEMBERED)(lambda x: rows.square_root(variables.at(np.frombuffer(x))))

    @cached_property
    def _curve_roots(self) -> Callable[[bytes, float, bool], Eliminated]:
        """The same with error curves held, or eliminated at so many times the variance, where no errors are shared."""
        rows, at = self.rows, self.variables.at

        def roots(x: bytes, variance: float, held: bool) -> Eliminated:
            state = at(np.frombuffer(x))
            return rows.with_curves_held(state) if held else rows.without_curves(state, variance)

        return lru_cache(N_REMEMBERED)(roots)


def with_factors(problem: Problem, start: Floats, state: NoiseState | None = None, **changes: Any) -> Problem:
    """A problem with its rows whitened, and started, at a parameter vector.

    Args:
        problem: The problem, of which the rows are made anew.
        start: The parameter vector.
        state: Estimated noise; None for what the problem has.
        changes: Other changes of the problem.
    """
    p = replace(problem, start=start, state=state or problem.state, **changes)
    given = p.state.weights
    weights = None if given is None else [w[s.train] for w, s in zip(given, p.data.blocks, strict=True)]
    noises, sharing = noises_at(p, start, fitted=True), p.options.pair_errors == "shared"
    return replace(p, rows=whitened_rows(noises, sharing=sharing, joints=p.joints_estimated, weights=weights))


def with_user_factors(problem: Problem) -> Problem:
    """The problem with what a user added to its graph, and changed in its initial values, as a part of it.

    Raises:
        ProblemError: Factors were removed or replaced, an added variable has no start, or there is no factor of it.
    """
    if not problem.__dict__.keys() & {"graph", "initial"}:
        return problem
    more = problem._more_factors
    added = (*problem.added, *more)
    if more and problem.whole is not None:
        raise ProblemError("problem.graph", "added factors with gauge keep", "gauge prior or none")
    variables, start = with_added(problem.variables, added, problem.initial, problem._measured[1])
    if not more and np.allclose(start, problem.start, rtol=0.0, atol=1e-12):
        return problem
    return with_factors(problem, start, variables=variables, added=added)


def noises_at(problem: Problem, parameters: Floats, *, fitted: bool = False) -> tuple[RowNoise, ...]:
    """The rows of each block and their noise at a parameter vector.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        fitted: Whether they are the train rows alone; else train and test.
    """
    data, at, trigs = problem.data, problem.variables.at(parameters), problem.data.trigs(problem.robot, parameters)
    if (nowhere := np.isnan(data.landmarks.start) & (at.columns < 0)).any():  # points of test rows alone
        at = replace(at, coordinates=np.where(nowhere, contact_points(data, at.chains, trigs), at.coordinates))
    width = problem.robot.n_joints + POSE_SLOTS * len(data.tables)
    n_errors = width * data.n_configurations
    each = enumerate(zip(data.tables, data.places, trigs, at.chains, strict=True))
    places = [
        TableState(t.measurements, k, c, q, chain, at.coordinates, width, n_errors) for k, (t, c, q, chain) in each
    ]
    return tuple(RowNoise(s.fitted if fitted else s, places[s.table], problem.state) for s in data.blocks)


def start_of(robot: Robot, data: Dataset, variables: Variables) -> Floats:
    """The nominal parameters with frames, tool and landmarks from closed forms, as a parameter vector.

    Args:
        robot: The nominal robot.
        data: The tables.
        variables: Variables to estimate.

    Raises:
        ProblemError: No image shows enough of a board.
    """
    start, tool = variables.nominal(), np.array(robot.owned_by(robot.n_joints + 1), dtype=np.int64)
    nominal, free, bare = np.zeros(6), np.zeros(6, dtype=np.bool_), robot.nominal
    if len(tool):
        nominal, free, bare[tool] = start[tool], np.array([robot.parameters[i].estimated for i in tool]), 0.0
    begun = start_frames(robot.with_values(bare), data, Frame(pose_of(nominal).rotation().matrix(), nominal[:3]), free)
    if begun.found.any():
        start[tool[begun.found]] = _coordinates(begun.tool, nominal)[begun.found]
    for v in variables.frames:
        if v.number in begun.frames:
            start[v.places] = _coordinates(begun.frames[v.number])
    if len(variables.coordinates):
        at = variables.at(start)
        places = np.where(np.isnan(begun.places), contact_points(data, at.chains, data.trigs(robot)), begun.places)
        there = variables.coordinates >= 0
        start[variables.coordinates[there]] = places[there]
    return start


def _coordinates(frame: Frame, near: Floats | None = None) -> Floats:
    """x, y, z, yaw, pitch, roll of a frame (see `frame_of`)."""
    return frame_of(gtsam.Pose3(gtsam.Rot3(frame.rotation), frame.translation), near)


def contact_points(data: Dataset, chains: Sequence[Chain], trigs: Sequence[Floats]) -> Floats:
    """Start of each landmark coordinate; a contact point starts at the mean of its tool positions.

    Train touches say where a point is; test touches do where there are no others.
    """
    found: Floats = data.landmarks.start
    for s, test in ((s, test) for test in (True, False) for s in data.blocks):
        if s.kind.is_contact and s.kind.n_nuisances:
            touches = np.flatnonzero(s.test == test)
            p = forward(chains[s.table].without_columns(), trigs[s.table], s.ends[touches, 0]).position
            place = s.nuisances[touches].ravel()
            n, total = np.bincount(place), np.bincount(place, p.ravel())
            found[np.flatnonzero(n)] = total[n > 0] / n[n > 0]
    return found


def relinearized_at(problem: Problem, parameters: Floats, state: NoiseState | None = None) -> Problem:
    """Whiten and start a problem at other parameters.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        state: Estimated noise; None for what the problem has.
    """
    same = all(same_everywhere(s, problem.data.sigma_joint) for s in problem.data.blocks)
    if (state is None or state is problem.state) and same:
        return loaded_at(problem, parameters)
    return with_factors(problem, parameters, state)


def loaded_at(problem: Problem, parameters: Floats) -> Problem:
    """Start a problem at other parameters, its rows whitened as they are, with loads as they are there."""
    started = replace(problem, start=parameters)
    if problem.robot.loads:
        return replace(started, rows=problem.rows.with_readings(problem.data.trigs(problem.robot, parameters)))
    vars(started).update(_square_roots=problem._square_roots, _curve_roots=problem._curve_roots)
    return started


def subsampled(problem: Problem, share: float, parameters: Floats | None = None) -> Problem:
    """Draw some train rows of a problem evenly, whitened by their noise alone, without robust weights.

    Args:
        problem: The problem.
        share: Which share of each block.
        parameters: The parameter vector at which they are whitened; the problem's start if None.
    """
    rng, given = np.random.default_rng(0), problem.data.blocks
    blocks = [s.select(np.sort(rng.permutation(s.train)[: round(share * len(s.train))])) for s in given]
    data, state = replace(problem.data, blocks=tuple(blocks)), replace(problem.state, weights=None)
    return with_factors(problem, problem.start if parameters is None else parameters, state, data=data)


def mahalanobis_distances(problem: Problem, parameters: Floats) -> list[tuple[Floats, Integers]]:
    """Length of each measurement's residual by block, whitened by all its noise, and its number of rows.

    Args:
        problem: The problem.
        parameters: The parameter vector.

    Returns:
        Shapes (n,) each, train and test; both are 0 for a measurement that takes no part.
    """
    return [noise.lengths() for noise in noises_at(problem, parameters)]


def joint_errors(problem: Problem, parameters: Floats) -> Floats:
    """Posterior mean of the errors of the joint readings: true values minus readings, to first order.

    Returns:
        Shape (n_configurations, n_joints), [rad] (prismatic: [m]).
    """
    rows, sigma = problem.rows, problem.sigma_joint
    joints = rows.slots[rows.slots < len(sigma)]  # the first ones
    found = np.zeros((problem.data.n_configurations, len(sigma)))
    z = rows.posterior_mean(problem.variables.at(parameters))[:, : len(joints)]
    found[np.ix_(rows.configurations, joints)] = -sigma[joints] * z
    return found


def square_root(problem: Problem, parameters: Floats, *, with_loss: bool = False, with_known: bool = True) -> Floats:
    """Rows [A r] with the Gram matrix of train rows, landmarks' priors and added factors, error states eliminated.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        with_loss: Whether a robust loss counts for what it loses of clean data (see `robust.Effect`).
        with_known: Whether information of earlier rows counts.

    Returns:
        Shape (m, n_columns + n_nuisance + 1).
    """
    v = problem.variables
    others = [unknown_prior_rows(v, parameters)] if v.nuisance else []
    if problem.known is not None and with_known:
        others.append(problem.known.at_parameters(v, problem.data.landmarks, parameters))
    if problem.added:
        others.append(linearize_factors(problem.added, v, v.values(parameters)))
    measured = problem._square_roots(parameters.tobytes()) / np.sqrt(loss_variance(problem) if with_loss else 1.0)
    return np.vstack([*(np.column_stack([J, r]) for r, J in others), measured])


def named_rows(variables: Variables, parameters: Floats, J: Floats) -> Floats:
    """Whitened rows of the core by named parameters, measurement frames projected out: shape (m, n_robot_columns).

    At a pitch of 90 degrees of base or tool the columns of yaw and roll are parallel: only their sum acts.
    """
    n = variables.n_robot_columns
    wide = np.hstack([J @ variables.tangent_derivative(parameters)[:, :n], J[:, n:]])
    return eliminate(wide, np.zeros(len(wide)), n).A


def directions(problem: Problem, parameters: Floats) -> tuple[Floats, Floats]:
    """Signal-to-noise ratios of data and priors at some parameters, and their unit-free directions as columns."""
    system = problem.linearize(parameters)
    return system.singular_values, (system.directions / problem.variables.prior_scales).T


def named_triangle(problem: Problem, parameters: Floats) -> Floats:
    """The system's triangle by named parameters, measurement frames projected out, shape (m, n_robot_columns)."""
    return named_rows(problem.variables, parameters, problem.linearize(parameters).left.A)


def loss_variance(problem: Problem) -> float:
    """The factor by which a robust loss makes the variance of the estimate larger: the mean over the measurements."""
    if problem.state.weights is None:
        return 1.0
    blocks, loss = problem.data.blocks, problem.options.loss
    n_rows = np.concatenate([s.used[s.train].sum(axis=1) for s in blocks])
    low = np.concatenate([w[s.train] < 0.5 for w, s in zip(problem.state.weights, blocks, strict=True)])
    each = [(effect(loss, dim, float(low[n_rows == dim].mean())), n_rows == dim) for dim in np.unique(n_rows).tolist()]
    return float(sum(of.variance * np.count_nonzero(rows) for of, rows in each) / len(n_rows))


def correlation(problem: Problem, parameters: Floats) -> Floats | None:
    """J^T (C - 1) J of the train rows where they share errors but count as independent, else None.

    Args:
        problem: The problem.
        parameters: The parameter vector.

    Returns:
        With J the whitened Jacobian, landmarks eliminated, and C the covariance of the whitened rows, shape
        (n_columns, n_columns).
    """
    if not problem.rows.counted_as_private:
        return None
    n, wide = problem.variables.n_columns, problem.rows.private(problem.variables.at(parameters))
    J = wide[:, :n] + wide[:, n:-1] @ problem.linearize(parameters).left.follow
    return correlation_of(problem.noises, problem.rows, J)


def frames_only(problem: Problem) -> Problem | None:
    """Keep the arm nominal: estimate measurement frame, base and tool alone; None if none is estimated."""
    variables = variables_of(problem.robot, problem.data, problem.options, arm=False)
    if not variables.items:
        return None
    options = replace(problem.options, encoder="propagated", pair_errors="independent")  # good enough for a start
    start = problem.start[: variables.nuisance_span.stop]
    alone = replace(problem, added=(), knowledge=None, whole=None)
    return with_factors(alone, start, variables=variables, options=options)


def with_curves_held(problem: Problem, parameters: Floats) -> Problem:
    """The problem started at a parameter vector, whose error curves are taken as known."""
    robot = problem.robot.with_curves_held(parameters[problem.variables.robot_span])
    variables = variables_of(robot, problem.data, problem.options)
    whole = None if problem.whole is None else with_curves_held(problem.whole, parameters)
    return with_factors(problem, parameters, robot=robot, variables=variables, whole=whole)


def variables_of(robot: Robot, data: Dataset, options: Options, *, arm: bool = True) -> Variables:
    """The variables of a robot, its measurement frames and the measurements' unknowns; those of joints if `arm`."""
    variables = build_variables(robot, [table.unknown_frame for table in data.tables], options.has_priors, arm=arm)
    return variables.with_unknowns(data.landmarks, data.estimated())


def tables_of(measurements: Tables, options: Options) -> tuple[Table, ...]:
    """Tables, those without choices of their own with those of the options.

    Raises:
        ProblemError: There is none.
    """
    given = [measurements] if isinstance(measurements, Measurements | Table) else list(measurements)
    if not given:
        raise ProblemError("measurements", "no table", "at least one")
    tables = [t if isinstance(t, Table) else Table(t, options.model, options.pairing, options.frame) for t in given]
    return tuple(part for table in tables for part in by_station(table))


def problem_at(
    robot: Robot, data: Dataset, options: Options, variables: Variables, start: Floats, **more: Any
) -> Problem:
    """A problem with its rows whitened at a start."""
    return with_factors(Problem(robot, data, options, variables, start, NoiseState(), NO_ROWS, **more), start)
