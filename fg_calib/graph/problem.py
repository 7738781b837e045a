"""The calibration problem: measurements gathered in series, whitened, with a start, and its GTSAM graph.

`build_problem` makes it, `solve` solves it; in between it can be looked at: the graph, the initial values, which rows
take part and why the others do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
import scipy.sparse

from fg_calib.graph.error_states import (
    ErrorStates,
    SchurComplement,
    State,
    WhitenedBlock,
    correlation_of,
    felt_errors,
    share_errors,
    whitened_rows,
)
from fg_calib.graph.factors import (
    check_added,
    linearize_factors,
    measurement_factors,
    prior_factors,
    reduced_factor,
)
from fg_calib.graph.knowledge import Knowledge
from fg_calib.graph.noise_models import JOINT_NOISE, NoiseState, RowNoise, TableState, row_noise, same_everywhere
from fg_calib.graph.normal_system import RANK_TOLERANCE, LinearRows, NormalSystem
from fg_calib.graph.robust import effect
from fg_calib.graph.variables import Variables, build_variables, frame_of, pose_of, prior_rows, unknown_prior_rows
from fg_calib.initialization import Frame
from fg_calib.inputs import Booleans, Floats, FrozenArrays, Integers, Options, ProblemError, SolverError, shown
from fg_calib.measurements import Dataset, MeasurementBlock, Measurements, Table, by_station, start_frames
from fg_calib.robot import Chain, Parameter, Robot, forward


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
        whole: The problem with everything estimated, where this one leaves parameters out to fix the gauge.
        added: Factors that a user added to `graph`.
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
    rows: tuple[WhitenedBlock, ...]
    whole: Problem | None = None
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
        return (*self._measured[0], *prior_factors(self.variables), *known_factors(self), *self.added)

    @cached_property
    def _measured(self) -> tuple[list[gtsam.NonlinearFactor], gtsam.Values]:
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
        n, own = graph.size(), self.own_factors
        kept = sum(graph.at(i) is own[i] for i in range(min(n, len(own))))
        if kept < len(own):
            found = f"{kept} of the problem's {len(own)} factors"
            raise ProblemError("problem.graph", found, "all of them, in their places")
        return tuple(graph.at(i) for i in range(len(own), n))

    def __repr__(self) -> str:
        v, models = self.variables, ", ".join(str(table.model) for table in self.data.tables)
        frame = ", measurement frame unknown" if v.frames else ""
        return (
            f"Problem of {self.robot.name!r}: {models}{frame}, {self.n_configurations} configurations\n"
            f"  {self.n_residuals} residuals and {self.n_priors} priors on {v.n_columns + v.n_nuisance} unknowns in"
            f" {len(v.keys)} variables"
        )

    def linearize(self, parameters: Floats | None = None) -> NormalSystem:
        """The normal system of measurements, priors and added factors at a parameter vector, at `start` if None.

        Raises:
            SolverError: A residual or derivative is not finite.
        """
        return linear_system(self, self.start if parameters is None else parameters)

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
        """Series of pairs of configurations."""
        return tuple(s for s in self.data.blocks if s.kind.ends == 2)

    @property
    def formed(self) -> bool:
        """Whether pairs were formed from measured poses."""
        return any(s.formed for s in self.data.blocks)

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
        return sum(int(s.used[s.train].sum()) for s in self.data.blocks)

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
        """Scalar rows of added factors."""
        return sum(factor.dim() for factor in self.added)

    @cached_property
    def known(self) -> Knowledge | None:
        """What earlier rows say of what is estimated; None where they say nothing."""
        if self.knowledge is None:
            return None
        found = self.knowledge.seen_by(self.variables, self.data.landmarks)
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
        for s in self.data.blocks:
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


def with_factors(problem: Problem, start: Floats, state: NoiseState | None = None, **changes: Any) -> Problem:
    """A problem with its rows whitened, and started, at a parameter vector.

    Args:
        problem: The problem, of which the rows are made anew.
        start: The parameter vector.
        state: What has been learned of the noise; None for what the problem has.
        changes: What else of the problem is to change.
    """
    p = replace(problem, start=start, state=state or problem.state, **changes)
    return replace(p, rows=_whitened(p, noises_at(p, start, fitted=True)))


def with_user_factors(problem: Problem) -> Problem:
    """The problem with what a user added to its graph, and changed in its initial values, as a part of it.

    Raises:
        ProblemError: Factors were removed or replaced, an added variable has no start, or there is no factor of it.
    """
    if not problem.__dict__.keys() & {"graph", "initial"}:
        return problem
    more, variables = problem._more_factors, problem.variables.without_own()
    own = check_added((*problem.added, *more), problem.initial, variables, problem._measured[1])
    if more and problem.whole is not None:
        raise ProblemError("problem.graph", "added factors with gauge keep", "gauge prior or none")
    if not more and problem.variables.values(problem.start).equals(_without_errors(problem), 0.0):
        return problem
    variables = variables.with_own(own)
    start = variables.parameters(problem.initial)
    return with_factors(problem, start, variables=variables, added=(*problem.added, *more))


def _without_errors(problem: Problem) -> gtsam.Values:
    values = gtsam.Values(problem.initial)
    for key in filter(values.exists, list(problem._measured[1].keys())):
        values.erase(key)
    return values


def check_graph(problem: Problem) -> None:
    """Check that nothing was added to the graph of a problem that has been solved.

    Raises:
        ProblemError: Its graph has other factors than it was solved with.
    """
    n = len(problem._more_factors)
    if n:
        raise ProblemError("solution.problem.graph", f"{n} factors added since it was solved", "to be solved again")


def reduced_graph(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """Every block of rows, whatever its size, as one factor, with priors and added factors, for damped steps."""
    graph = gtsam.NonlinearFactorGraph()
    for block in problem.rows:
        if depends(block, problem.variables):
            graph.add(reduced_factor(block, problem.variables))
    for factor in (*prior_factors(problem.variables), *known_factors(problem), *problem.added):
        graph.add(factor)
    return graph


def depends(rows: WhitenedBlock, variables: Variables) -> bool:
    """Whether rows depend on any variable: on the core, or on a landmark that is estimated."""
    return bool(variables.items) or bool(np.any(variables.coordinates[rows.coordinates] >= 0))


def known_factors(problem: Problem) -> list[gtsam.NonlinearFactor]:
    """What earlier rows say as a factor, where they say anything."""
    known = problem.known
    return [] if known is None else [known.factor(problem.variables, problem.data.landmarks)]


def _whitened(problem: Problem, noises: tuple[RowNoise, ...]) -> tuple[WhitenedBlock, ...]:
    """The train rows whitened by their noise."""
    state, sharing = problem.state, problem.options.pair_errors == "shared"
    weights = None
    if state.weights is not None:
        weights = [w[s.train] for w, s in zip(state.weights, problem.data.blocks, strict=True)]
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
    series = [s.fitted if fitted else s for s in problem.data.blocks]
    return tuple(row_noise(s, places[s.table], problem.state) for s in series)


def _places(problem: Problem, parameters: Floats, at_readings: bool) -> list[TableState]:
    data, errors = problem.data, problem.state.joint_errors
    trigs = data.trigs(problem.robot)
    if errors is not None and not at_readings:
        moved = [t.measurements.readings + errors[place] for t, place in zip(data.tables, data.places, strict=True)]
        trigs = tuple(problem.robot.trig(readings) for readings in moved)
    at = at_parameters(problem, parameters, trigs)
    estimated = problem.options.encoder == "estimated"
    return [
        TableState(table.measurements, place, trig, chain, at.coordinates, estimated)
        for table, place, trig, chain in zip(data.tables, data.places, trigs, at.chains, strict=True)
    ]


def at_parameters(problem: Problem, parameters: Floats, trigs: Sequence[Floats] | None = None) -> State:
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
    found: Floats = data.landmarks.start
    for s in data.blocks:
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
    first, start = series.nuisances[:, 0], data.landmarks.start
    says: Booleans = np.isnan(start[first]) & ~(series.test & np.isin(first, first[~series.test]))
    return says


def relinearized_at(problem: Problem, parameters: Floats, state: NoiseState | None = None) -> Problem:
    """The same problem with its rows whitened, and started, at other parameters.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        state: What has been learned of the noise; None for what the problem has.
    """
    same = all(same_everywhere(s, problem.data.sigma_joint) for s in problem.data.blocks)
    if (state is None or state is problem.state) and same:
        return replace(problem, start=parameters)
    return with_factors(problem, parameters, state)


def subsampled(problem: Problem, share: float) -> Problem | None:
    """The same problem with some of its train rows, drawn evenly, whitened at its start.

    Args:
        problem: The problem.
        share: Which share of each series.

    Returns:
        None where single rows count for more than others do: where they have robust weights, or depend on landmarks.
    """
    if problem.variables.nuisance or problem.options.loss != "none" or problem.state.weights is not None:
        return None
    rng, series = np.random.default_rng(0), []
    for s in problem.data.blocks:
        series.append(s.select(np.sort(rng.permutation(s.train)[: round(share * len(s.train))])))
    return with_factors(replace(problem, data=replace(problem.data, blocks=tuple(series))), problem.start)


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
    """Posterior mean of the errors of the joint readings: true values minus readings, to first order.

    Returns:
        Shape (n_configurations, n_joints), [rad] (prismatic: [m]); about the joint values that the problem has.
    """
    sigma = problem.sigma_joint
    joints = np.flatnonzero(sigma > 0.0)
    found = np.zeros((problem.data.n_configurations, len(sigma)))
    at = problem.variables.at(parameters)
    for block in problem.rows:
        if block.states is not None:
            z = block.posterior_mean(at)[:, block.joints : block.joints + len(joints)]
            found[np.ix_(block.configurations, joints)] = -sigma[joints] * z
    return found


def linear_system(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> NormalSystem:
    """The normal system of a problem at a parameter vector: all train rows, priors and added factors.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        with_loss: Whether a robust loss counts for what it loses of clean data (see `robust.Effect`).

    Raises:
        SolverError: A residual or derivative is not finite.
    """
    v = problem.variables
    r, J = prior_rows(v, parameters)
    rows, priors = square_root(problem, parameters, with_loss=with_loss), np.column_stack([J, r])
    if not (np.isfinite(rows).all() and np.isfinite(priors).all()):
        raise SolverError("a residual or derivative is not finite")

    def gather() -> LinearRows:
        return _linear_rows(problem, _with_loss(problem)[0] if with_loss else problem.rows, v.at(parameters))

    return NormalSystem(rows, v.n_columns, v.prior_scales, priors, gather)


def square_root(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> Floats:
    """Rows [A r] with the Gram matrix of train rows, landmarks' priors and added factors, error states eliminated.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        with_loss: Whether a robust loss counts for what it loses of clean data (see `robust.Effect`).

    Returns:
        Shape (m, n_columns + n_nuisance + 1).
    """
    v = problem.variables
    others = [unknown_prior_rows(v, parameters)] if v.nuisance else []
    if problem.known is not None:
        others.append(problem.known.at_parameters(v, problem.data.landmarks, parameters))
    if problem.added:
        others.append(linearize_factors(problem.added, v, v.values(parameters)))
    triangles = row_triangles(problem, parameters, with_loss=with_loss)
    empty = np.zeros((0, v.n_columns + v.n_nuisance + 1))
    return np.vstack([empty, *(np.column_stack([J, r]) for r, J in others), *triangles])


def cost_at(problem: Problem, parameters: Floats) -> float:
    """Half the sum of squares of all whitened rows and priors at a parameter vector."""
    priors = prior_rows(problem.variables, parameters)[0]
    return 0.5 * float(np.sum(square_root(problem, parameters)[:, -1] ** 2) + np.sum(priors**2))


def named_rows(variables: Variables, parameters: Floats, J: Floats) -> Floats:
    """Whitened rows of the core by named parameters, measurement frames projected out: shape (m, n_robot_columns).

    At a pitch of 90 degrees of base or tool the columns of yaw and roll are parallel: only their sum acts.
    """
    n = variables.n_robot_columns
    out: Floats = J @ variables.tangent_derivative(parameters)[:, :n]
    if n == variables.n_columns:
        return out
    length = np.linalg.norm(out, axis=0)
    U, s, _ = np.linalg.svd(J[:, n:], full_matrices=False)
    Q = U[:, s > RANK_TOLERANCE * s.max(initial=0.0)]
    out = out - Q @ (Q.T @ out)
    # What projecting leaves of a column that was all frame is rounding.
    out[:, np.linalg.norm(out, axis=0) <= RANK_TOLERANCE * length] = 0.0
    return out


def row_triangles(problem: Problem, parameters: Floats, *, with_loss: bool = False) -> list[Floats]:
    """A square root of [J r] of each block, shape (n_columns + n_nuisance + 1,) * 2 each."""
    at, (blocks, variance) = problem.variables.at(parameters), _with_loss(problem) if with_loss else (problem.rows, 1.0)
    triangles = [block.triangle(at) for block in blocks]
    return triangles if variance == 1.0 else [triangle / np.sqrt(variance) for triangle in triangles]


def directions(problem: Problem, parameters: Floats) -> tuple[Floats, Floats]:
    """Signal-to-noise ratios of data and priors at some parameters, and their unit-free directions as columns."""
    system = linear_system(problem, parameters)
    return system.singular_values, (system.directions / problem.variables.prior_scales).T


def named_triangle(problem: Problem, parameters: Floats) -> Floats:
    """`whitened_triangle` by named parameters, the measurement frames projected out: shape (m, n_robot_columns)."""
    return named_rows(problem.variables, parameters, linear_system(problem, parameters).left.A)


def felt(problem: Problem, parameters: Floats, errors: ErrorStates, wanted: Integers) -> Floats:
    """M: the estimate is off by `-K M e` because of errors e of configurations, K its covariance.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        errors: The errors of all configurations.
        wanted: Numbers of those that are asked for.

    Returns:
        M by core and nuisance variables, these not eliminated, shape (n_columns + n_nuisance, len(wanted)).
    """
    if not len(wanted):
        return np.zeros((problem.variables.n_columns + problem.variables.n_nuisance, 0))
    row_sets, variance = _with_loss(problem)
    return felt_errors(problem.noises, row_sets, problem.variables.at(parameters), errors, wanted) / variance


def _linear_rows(problem: Problem, blocks: Sequence[WhitenedBlock], at: State) -> LinearRows:
    """Whitened train rows one by one, those of each block and each of its parts after the other."""
    rows, loadings, counts, used = [np.zeros((0, at.n_columns + at.n_nuisance + 1))], [], [np.zeros(0, np.int64)], []
    shared = next((block for block in blocks if block.states is not None), None)
    for block in blocks:
        rows.append(block.private(at))
        for part in block.parts:
            series = problem.data.blocks[part.series]
            counts.append(np.full(part.block.n, part.block.residual_dim))
            used.append(series.used[series.train].ravel())
        if shared is not None and shared.states is not None:
            none = scipy.sparse.csr_array((len(rows[-1]), shared.states.loadings.shape[1]))
            loadings.append(none if block.states is None else block.states.loadings)
    wide, states, count = np.concatenate(rows), None, np.concatenate(counts)
    if shared is not None and shared.states is not None:
        L = scipy.sparse.csr_array(scipy.sparse.vstack(loadings))
        states = shared.states if len(blocks) == 1 else SchurComplement(L, shared.states.width)
    return LinearRows(
        r=wide[:, -1],
        A=wide[:, :-1],
        measurement=np.repeat(np.arange(len(count)), count),
        states=states,
        used=np.concatenate([np.zeros(0, dtype=np.bool_), *used]),
        configurations=np.zeros(0, dtype=np.int64) if shared is None else shared.configurations,
        joints=0 if shared is None else shared.joints,
    )


def _with_loss(problem: Problem) -> tuple[tuple[WhitenedBlock, ...], float]:
    """The rows, and the factor by which a robust loss makes the variance of the estimate larger.

    Measurements of fewer rows lose less or more than others; they count relative to those that lose least.
    """
    state, loss = problem.state, problem.options.loss
    if state.weights is None:
        return problem.rows, 1.0
    dims = [s.used.sum(axis=1) for s in problem.data.blocks]
    largest = max(int(d.max(initial=0)) for d in dims)
    of_dim = np.array([effect(loss, max(dim, 1)).variance for dim in range(largest + 1)])
    of_train = np.concatenate([d[s.train] for d, s in zip(dims, problem.data.blocks, strict=True)])
    present = np.unique(of_train[of_train > 0])
    variance = float(of_dim[present].min(initial=np.inf)) if len(present) else 1.0
    if len(present) <= 1:
        return problem.rows, variance
    share = np.minimum(variance / of_dim, 1.0)
    weights = tuple(w * share[d] for w, d in zip(state.weights, dims, strict=True))
    counted = replace(problem, state=replace(state, weights=weights))
    return _whitened(counted, noises_at(counted, problem.start, fitted=True)), variance


def correlation(problem: Problem, parameters: Floats) -> Floats | None:
    """J^T (C - 1) J of the train rows where they share errors but count as independent, else None.

    Args:
        problem: The problem.
        parameters: The parameter vector.

    Returns:
        With J the whitened Jacobian, landmarks eliminated, and C the covariance of the whitened rows, shape
        (n_columns, n_columns).
    """
    if not problem.missing_correlation:
        return None
    follow = linear_system(problem, parameters).left.follow
    return correlation_of(problem.noises, problem.rows, problem.variables.at(parameters), follow)


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
    state = replace(problem.state, joint_errors=None)
    return with_factors(
        problem, start, state, robot=robot, variables=variables, options=options, added=(), knowledge=None, whole=None
    )


def variables_of(robot: Robot, data: Dataset, options: Options) -> Variables:
    """The variables of a robot, its measurement frames and the measurements' unknowns."""
    frames = [table.unknown_frame for table in data.tables]
    return build_variables(robot, frames, options.has_priors).with_unknowns(data.landmarks, data.estimated())


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
    estimated = options.encoder == "estimated" and bool(np.any(data.sigma_joint > 0.0))
    state = NoiseState(joint_errors=np.zeros_like(data.readings) if estimated else None)
    return with_factors(Problem(robot, data, options, variables, start, state, (), **more), start)
