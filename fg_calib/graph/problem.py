"""The calibration problem: measurements judged, whitened and gathered in blocks, as a GTSAM graph with a start.

`build_problem` makes it, `solve` solves it; in between it can be looked at: the graph, the initial values, which rows
take part and why the others do not.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import gtsam
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fg_calib.errors import ProblemError
from fg_calib.graph import frames
from fg_calib.graph.factors import (
    Eliminated,
    Term,
    Variables,
    build_variables,
    dense,
    eliminate,
    frame_of,
    measurement_factor,
    pose_of,
    prior_factors,
    prior_rows,
    stacked_terms,
    term_factor,
)
from fg_calib.graph.frames import Frame, Unknown
from fg_calib.graph.joints import MAX_JOINT_VARIABLES, MovedRows, TrueJoints
from fg_calib.graph.observability import (
    RANK_TOLERANCE,
    SIGNAL_FLOOR,
    Observability,
    analyse,
    determined,
    singular_values,
)
from fg_calib.graph.points import PointGroups
from fg_calib.graph.whitening import (
    MAX_SHARED,
    Adjustment,
    PairJudgement,
    PairWhitening,
    PoseWhitening,
    Sharing,
    pose_block,
)
from fg_calib.job import Job
from fg_calib.measurements import residuals
from fg_calib.measurements.dataset import Measurements, Pairs, form_pairs, no_pairs
from fg_calib.measurements.residuals import AnyBlock, Block, CorrelatedBlock
from fg_calib.options import (
    PAIR_MODELS,
    POSE_MODELS,
    FrameKnowledge,
    Gauge,
    Model,
    Options,
    PairErrors,
    Pairing,
    as_pairing,
    check_names,
    check_type,
)
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import build_chain, forward, precompute_trig
from fg_calib.robot.model import Parameter, Robot, names_of
from fg_calib.threads import single_threaded

_log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

QUARTER_TURN = 1e-3
"""Cosine of a pitch at which yaw and roll of a frame may be told apart no more."""

STRUCTURAL_FLOOR = 1e-6
"""Signal-to-noise ratio that counts as nothing on random configurations with an assumed noise: rounding alone."""


@dataclass(frozen=True)
class Problem:
    """A calibration problem, ready to be solved.

    Attributes:
        robot: The nominal robot.
        measurements: Everything measured.
        options: What is estimated from what.
        variables: The GTSAM variables and their columns.
        start: Initial parameter vector (see `Variables`).
        trig: Readings for the kernels.
        pairs: All pairs, train and test; None for models of poses.
        judgement: What each pair contributes; None for models of poses.
        sigma: 1 sigma of distance and angle, shape (n_pairs, 2), or of orientation and position components,
            shape (n_configurations, 6): measurement noise and joint noise together, [m] and [rad].
        blocks: The whitened train rows.
        graph: Factors and priors, as GTSAM's own tools take them. Factors added to it are solved and assessed with it.
        initial: GTSAM's initial values; those of variables that added factors bring with them are inserted here.
        sharing: Which errors of configurations the rows carry in common.
        adjustment: What has been learned of the measurements' noise.
        whole: The problem with everything estimated, where this one leaves parameters out to fix the gauge.
        points: The groups that touched the same point; None if none did.
        joints: The true joint values, where they are variables; else None.
        sigma_point: 1 sigma of a touch, joint noise included, shape (n_configurations, 3), [m]; empty without groups.
        terms: The whitened train rows that depend on nuisance variables.
        factors: The factors that `graph` was made of.
        added: Those among them that somebody added (see `extension`).
        evaluated: Whether there are test rows alone: the arm is taken as it is, and measurement frame, base and tool,
            where they are estimated, are fitted to these.
    """

    robot: Robot
    measurements: Measurements
    options: Options
    variables: Variables
    start: Floats
    trig: Floats
    pairs: Pairs | None
    judgement: PairJudgement | None
    sigma: Floats
    blocks: tuple[AnyBlock, ...]
    graph: gtsam.NonlinearFactorGraph
    initial: gtsam.Values
    sharing: Sharing
    adjustment: Adjustment
    whole: Problem | None = None
    points: PointGroups | None = None
    joints: TrueJoints | None = None
    sigma_point: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    terms: tuple[Term, ...] = ()
    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    added: tuple[gtsam.NonlinearFactor, ...] = ()
    evaluated: bool = False

    @property
    def estimated(self) -> list[Parameter]:
        """The robot's estimated parameters, in the order of the columns."""
        parameters = {p.name: p for p in self.robot.parameters}
        return [parameters[name] for name in self.variables.names[: self.variables.n_robot_columns]]

    @property
    def n_pairs(self) -> int:
        """Train pairs that give at least one row."""
        if self.pairs is None or self.judgement is None:
            return 0
        return int(np.sum(self.judgement.used & ~self.pairs.test))

    @property
    def n_configurations(self) -> int:
        """Configurations that the train rows come from."""
        if self.pairs is None or self.judgement is None:
            return int(np.sum(~self.measurements.test))
        used = self.judgement.used & ~self.pairs.test
        touched = [] if self.points is None else [np.flatnonzero(self.points.train)]
        return len(np.unique(np.concatenate([self.pairs.a[used], self.pairs.b[used], *touched])))

    @property
    def height(self) -> int:
        """Rows of a measurement that has all that the model uses."""
        if self.options.uses_pairs:
            return sum(PAIR_MODELS[self.options.model])
        return 3 * sum(POSE_MODELS[self.options.model])

    @property
    def formed(self) -> bool:
        """Whether pairs were formed from measured poses."""
        return self.pairs is not None and self.measurements.pairs is None and self.pairs.n_pairs > 0

    @property
    def common(self) -> Sharing:
        """Which errors of configurations reach more than one row, carried in common or not."""
        if self.pairs is None:
            return Sharing()
        return Sharing(poses=self.formed, joints=bool(np.any(self.measurements.sigma_joint > 0.0)))

    @property
    def n_residuals(self) -> int:
        """Scalar residuals of the fit, priors not counted."""
        if self.pairs is None or self.judgement is None:
            return self.height * int(np.sum(~self.measurements.test))
        j, train = self.judgement, ~self.pairs.test
        of_pairs = int(np.sum(j.distance & train) + np.sum(j.angle & train) + 3 * np.sum(j.same_point & train))
        return of_pairs + self.n_of_points

    @property
    def n_of_points(self) -> int:
        """Scalar residuals of touches, and of distances between touched points."""
        return 0 if self.points is None else self.points.n_residuals

    @property
    def n_independent(self) -> int:
        """Residuals that the noise can make differ freely: pairs formed from poses hold no more than the poses do."""
        rows = (*self.blocks, *(term.block for term in self.terms if isinstance(term, MovedRows)))
        block = rows[0] if rows else None
        if not (self.sharing.poses and isinstance(block, CorrelatedBlock)):
            return self.n_residuals
        return self.n_residuals - round(block.n_spare)

    @property
    def n_added(self) -> int:
        """Scalar rows of the factors that somebody added."""
        return sum(factor.dim() for factor in self.added)

    @property
    def approximate(self) -> bool:
        """Whether rows share errors but were too many to carry them, and were weighted as if independent."""
        return self.options.pair_errors == "shared" and self.sharing != self.common

    @property
    def n_priors(self) -> int:
        """Scalar priors."""
        return len(prior_rows(self.variables, self.start)[0])

    @property
    def n_excluded(self) -> dict[str, int]:
        """Measured train rows that take no part, by reason."""
        if self.pairs is None or self.judgement is None:
            return {}
        return {reason: int(np.sum(mask & ~self.pairs.test)) for reason, mask in self.judgement.reasons.items()}


@single_threaded
def build_problem(robot: Robot, measurements: Measurements, options: Options | None = None, **choices: Any) -> Problem:
    """The calibration problem of a robot and its measurements.

    Measurements that are all test rows make a problem of evaluation (see `Problem.evaluated`): their rows are those of
    the fit, of which the arm has no part.

    Args:
        robot: The nominal robot.
        measurements: What was measured.
        options: What is estimated from what.
        choices: Instead of `options`, any of theirs as keywords.

    Raises:
        InputError: An option is not one of those possible.
        ProblemError: The measurements lack what the model needs, or do not suffice.
    """
    check_type("options", options, Options, "Options(model='pose')")
    options = options or Options.of(**choices)
    check_names("prefer", options.prefer, names_of(robot.parameters))
    if not any(p.estimated for p in robot.parameters):
        raise ProblemError(f"robot {robot.name}", "nothing to estimate", "at least one parameter that is not fixed")
    evaluated = _all_test(measurements, options)
    if evaluated:
        robot, measurements, options = _for_evaluation(robot, measurements, options)
    variables = build_variables(robot, options.unknown_frame, options.has_priors)
    points = None if measurements.groups is None else PointGroups(measurements, options.model)
    if points is not None:
        _check_points(measurements, options)
        variables = points.add_points(variables)
    pairs = _usable_pairs(measurements, options) if options.uses_pairs else None
    if pairs is None:
        _check_poses(measurements, options)
        if measurements.pairs is not None:
            _log.warning("%s: not used, model %s is of poses", measurements.pairs.source, options.model)
    trig = precompute_trig(robot, measurements.readings)
    start = _start(robot, measurements, options, variables, trig, pairs, points)
    joints = _true_joints(robot, measurements, options, pairs)
    if joints is not None:
        variables = joints.add_joints(variables)
        start = np.concatenate([start, joints.start()])
    problem = _assemble(robot, measurements, options, variables, start, trig, pairs, None, points, joints)
    problem = replace(problem, evaluated=evaluated)
    _check_enough(problem)
    if options.gauge != "keep":
        return problem
    kept = _kept(problem, options.prefer)
    if not kept:
        raise ProblemError(
            measurements.source if pairs is None else pairs.source,
            "the rows determine none of the parameters to estimate",
            "rows that some of them act on",
        )
    reduced = robot.with_estimated(kept)
    variables = build_variables(reduced, options.unknown_frame, False)
    if points is not None:
        variables = points.add_points(variables)
    if joints is not None:
        variables = joints.add_joints(variables)
    anew = _assemble(reduced, measurements, options, variables, start, trig, pairs, None, points, joints)
    return replace(anew, whole=problem, evaluated=evaluated)


def _kept(problem: Problem, prefer: Sequence[str]) -> list[str]:
    """The parameters that gauge `keep` estimates.

    At a pitch of a quarter turn yaw and roll of a frame are relative for want of coordinates, not of data: a frame that
    lacks nothing else is kept whole, as a pose.
    """
    kept = observe(problem, problem.start, prefer).kept
    for v in problem.variables.items:
        if v.kind in ("base", "tool") and abs(np.cos(problem.start[v.parameters[4]])) < QUARTER_TURN:
            lacking = set(problem.variables.names[v.columns]).difference(kept)
            if len(lacking) == 1 and lacking <= {problem.variables.names[v.columns][k] for k in (3, 5)}:
                kept += lacking
    return kept


def _all_test(measurements: Measurements, options: Options) -> bool:
    """Whether all rows that the model uses are test rows."""
    m = measurements
    if not options.uses_pairs or m.pairs is None:
        return bool(m.test.all()) and m.n_configurations > 0
    touches = np.zeros(0, dtype=np.bool_) if m.groups is None else m.test[m.groups.index >= 0]
    rows = np.concatenate([m.pairs.test, touches])
    return bool(rows.all()) and len(rows) > 0


def _for_evaluation(robot: Robot, measurements: Measurements, options: Options) -> tuple[Robot, Measurements, Options]:
    """A robot whose base and tool alone are estimated, where they were, and test rows that these are fitted to."""
    m, nothing = measurements, np.zeros(measurements.n_configurations, dtype=np.bool_)

    def fitted(pairs: Pairs) -> Pairs:
        return replace(pairs, test=np.zeros(pairs.n_pairs, dtype=np.bool_))

    m = replace(
        m,
        test=nothing,
        pairs=None if m.pairs is None else fitted(m.pairs),
        groups=None if m.groups is None else replace(m.groups, pairs=fitted(m.groups.pairs)),
    )
    of_frames = [p.name for p in robot.parameters if p.estimated and not 1 <= p.owner <= robot.n_joints]
    gauge: Gauge = "none" if options.gauge == "keep" else options.gauge
    return robot.with_estimated(of_frames), m, replace(options, gauge=gauge, encoder="propagated")


def problem_of(job: Job, **changes: Any) -> Problem:
    """The calibration problem of a job.

    Args:
        job: The job.
        changes: Options that shall differ from the job's.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
    """
    return build_problem(job.robot, job.measurements, replace(job.options, **changes))


@single_threaded
def predicted_problem(
    robot: Robot,
    readings: Floats,
    model: Model,
    *,
    frame: FrameKnowledge = "known",
    pairing: Pairing | None = None,
    sigmas: tuple[Floats | None, Floats | None, Floats | None] = (None, None, None),
    pair_errors: PairErrors = "shared",
) -> Problem:
    """The problem that a robot's own predictions at some configurations make: what could be measured there.

    Args:
        robot: The robot.
        readings: Joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
        model: Which measurements take part.
        frame: Whether the measurement frame is estimated too.
        pairing: How pairs are formed; a star if None.
        sigmas: Of positions, shape (n, 3), [m], of orientations, shape (n, 3), [rad], and of readings, shape
            (n_joints,); 1 mm, 1 mrad and none where None.
        pair_errors: Whether pairs of one configuration share its errors or count as independent.
    """
    options = Options(model, as_pairing(pairing), frame, gauge="none", pair_errors=pair_errors)
    variables = build_variables(robot, options.unknown_frame, priors=False)
    trig = precompute_trig(robot, readings)
    poses = forward(build_chain(robot), trig)
    n = len(readings)
    usual = np.full((n, 3), 1e-3)
    sigma_position, sigma_orientation, sigma_joint = sigmas
    measurements = Measurements(
        readings=readings,
        ids=np.arange(n).astype(str),
        test=np.zeros(n, dtype=np.bool_),
        position=poses.position,
        rotation=poses.rotation,
        sigma_position=usual if sigma_position is None else sigma_position,
        sigma_orientation=usual if sigma_orientation is None else sigma_orientation,
        sigma_joint=np.zeros(robot.n_joints) if sigma_joint is None else sigma_joint,
        source="predictions",
    )
    pairs = _usable_pairs(measurements, options) if options.uses_pairs else None
    return _assemble(robot, measurements, options, variables, variables.nominal(), trig, pairs)


def random_problem(
    robot: Robot, model: Model, frame: FrameKnowledge = "known", *, n_configurations: int = 0, seed: int = 0
) -> Problem:
    """`predicted_problem` at random configurations: what a model can determine at all.

    Args:
        robot: The robot; its joints move as `random_readings` says.
        model: Which measurements take part; pairs are chained. Noise is assumed as `Robot.scale_of` says.
        frame: Whether the measurement frame is estimated too.
        n_configurations: How many; 0 for ten for every parameter, 300 at least.
        seed: Of the random configurations.
    """
    n = n_configurations or max(300, 10 * len(robot.parameters))
    return predicted_problem(
        robot,
        random_readings(robot, n, np.random.default_rng(seed)),
        model,
        frame=frame,
        pairing=Pairing("chain"),
        sigmas=(np.full((n, 3), robot.scale_of("m")), np.full((n, 3), robot.scale_of("rad")), None),
        pair_errors="independent",
    )


def added_rows(problem: Problem, parameters: Floats) -> Floats:
    """Derivatives of the added factors' whitened rows, shape (n_added, n_columns + n_nuisance)."""
    variables = problem.variables
    wide = np.zeros((problem.n_added, variables.n_columns + variables.n_nuisance))
    if problem.added:
        graph = gtsam.NonlinearFactorGraph()
        for factor in problem.added:
            graph.add(factor)
        present = set(graph.keyVector())
        chosen = [v for v in variables.items + variables.nuisance if v.key in present]
        A, _ = dense(graph.linearize(variables.values(parameters)), [v.key for v in chosen])
        wide[:, np.concatenate([np.arange(wide.shape[1])[v.columns] for v in chosen])] = A
    return wide


def started_at(problem: Problem, start: Floats) -> Problem:
    """The same problem, its rows as they are whitened, with another start: a parameter vector."""
    return replace(problem, start=start, initial=problem.variables.values(start))


def noise_kinds(model: Model) -> tuple[str, str]:
    """The kinds of noise that an adjustment's factors are of."""
    return ("distance", "angle") if model in PAIR_MODELS else ("orientation", "position")


def judged_at(problem: Problem, parameters: Floats, adjustment: Adjustment | None = None) -> Problem:
    """The same problem with its rows judged and whitened, and started, at other parameters.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        adjustment: What has been learned of the noise; None for what the problem has.
    """
    p, a = problem, adjustment or problem.adjustment
    given = (p.robot, p.measurements, p.options, p.variables, parameters, p.trig, p.pairs)
    anew = _assemble(*given, a, p.points, p.joints, p.added)
    return replace(anew, whole=p.whole, evaluated=p.evaluated)


def same_rows(a: Problem, b: Problem) -> bool:
    """Whether two problems have the very same rows, to the last figure."""
    return _equal((a.blocks, a.terms), (b.blocks, b.terms))


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
    return all(_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a)) if is_dataclass(a) else bool(a == b)


def lengths(problem: Problem, parameters: Floats, *, of_test: bool = False) -> tuple[Floats, Integers]:
    """Length of each measurement's residual, whitened by all its noise as stated, and its number of rows.

    Args:
        problem: The problem.
        parameters: The parameter vector.
        of_test: Whether those of the test rows are wanted, instead of the train rows'.

    Returns:
        Shapes (n_pairs,) or (n_configurations,); both are 0 for a measurement that takes no part.
    """
    length, height = _whitening(problem, parameters).lengths()
    test = problem.measurements.test if problem.pairs is None else problem.pairs.test
    wanted = test == of_test
    return np.where(wanted, length, 0.0), np.where(wanted, height, 0)


def joint_errors(problem: Problem, parameters: Floats) -> Floats:
    """What the train rows say of the errors of the joint readings: true values less readings, to first order.

    Returns:
        Shape (n_configurations, n_joints), [rad] (prismatic: [m]); about the joint values that the problem has.
    """
    whitening, chain = _whitening(problem, problem.start), problem.variables.chain.at(parameters)
    if isinstance(whitening, PoseWhitening):
        return whitening.joint_errors(chain)
    block = problem.blocks[0]
    assert isinstance(block, CorrelatedBlock)
    return whitening.joint_errors(block, chain)


def _whitening(problem: Problem, parameters: Floats) -> PairWhitening | PoseWhitening:
    """The rows of a problem, judged and whitened at a parameter vector."""
    p, chain = problem, problem.variables.chain.at(parameters)
    trig = _trig(p.robot, p.measurements, p.trig, p.adjustment)
    if p.joints is not None:
        trig = precompute_trig(p.robot, p.joints.values(p.variables, parameters))
    if p.pairs is None:
        return PoseWhitening(trig, chain, p.measurements, POSE_MODELS[p.options.model], p.adjustment)
    kinds, estimated = PAIR_MODELS[p.options.model], p.options.encoder == "estimated"
    return PairWhitening(trig, chain, p.measurements, p.pairs, kinds, p.formed, p.adjustment, estimated)


def pair_rows(problem: Problem, parameters: Floats) -> PairWhitening:
    """All pairs of a problem at a parameter vector, at their readings.

    Raises:
        ValueError: The problem is one of poses.
    """
    at_readings = replace(problem.adjustment, joint_errors=None)
    whitening = _whitening(replace(problem, adjustment=at_readings, joints=None), parameters)
    if not isinstance(whitening, PairWhitening):
        raise ValueError("a problem of poses has no pairs")
    return whitening


def _trig(robot: Robot, measurements: Measurements, trig: Floats, adjustment: Adjustment) -> Floats:
    """Readings for the kernels, or the joint values that are estimated in their place."""
    if adjustment.joint_errors is None:
        return trig
    return precompute_trig(robot, measurements.readings + adjustment.joint_errors)


def correlation(problem: Problem, parameters: Floats) -> Floats | None:
    """J^T (C - 1) J of the train rows where they share errors but are weighted as independent, else None.

    Args:
        problem: The problem.
        parameters: The parameter vector.

    Returns:
        With J the whitened Jacobian and C the covariance of the whitened rows, shape (n_columns, n_columns).
    """
    p, missing = problem, problem.common != problem.sharing
    if p.pairs is None or not missing or p.joints is not None:
        return None
    of_pairs = _whitening(problem, parameters)
    assert isinstance(of_pairs, PairWhitening)
    return of_pairs.correlation(p.variables.chain.at(parameters), p.common)


def frames_only(problem: Problem) -> Problem | None:
    """The same problem with the arm at nominal: measurement frame, base and tool alone; None if none is estimated."""
    n = problem.robot.n_joints
    parameters = tuple(replace(p, estimated=p.estimated and not 1 <= p.owner <= n) for p in problem.robot.parameters)
    robot = replace(problem.robot, parameters=parameters)
    variables = build_variables(
        robot, any(v.kind == "frame" for v in problem.variables.items), problem.options.has_priors
    )
    if not variables.items:
        return None
    p = problem
    if p.points is not None:
        variables = p.points.add_points(variables)
    options = replace(p.options, encoder="propagated", pair_errors="independent")  # good enough for a start
    start = p.start[: variables.nuisance_span.stop]
    return _assemble(robot, p.measurements, options, variables, start, p.trig, p.pairs, points=p.points)


def whitened_triangle(problem: Problem, parameters: Floats) -> Floats:
    """Triangular factor of the train rows' whitened Jacobian at a parameter vector, shape (m, n_columns).

    Nuisance variables are eliminated: what is left of the rows are what they say of the core.
    """
    chain = problem.variables.chain.at(parameters)
    blocks = [residuals.triangle(block, chain)[:, :-1] for block in problem.blocks]
    return np.vstack([*blocks, eliminated_terms(problem, parameters).A])


def eliminated_terms(problem: Problem, parameters: Floats) -> Eliminated:
    """Rows of terms and added factors, with the nuisance columns eliminated; zero as right-hand side."""
    terms = stacked_terms(problem.terms, problem.variables, parameters)
    A = np.vstack([terms, added_rows(problem, parameters)])
    return eliminate(A, np.zeros(len(A)), problem.variables.n_columns)


def named_triangle(problem: Problem, parameters: Floats) -> Floats:
    """`whitened_triangle` by named parameters, the measurement frame projected out: shape (m, n_robot_columns).

    At a pitch of a quarter turn of base or tool the columns of yaw and roll are parallel: only their sum acts.
    """
    variables = problem.variables
    n = variables.n_robot_columns
    J = whitened_triangle(problem, parameters)
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


def observe(
    problem: Problem, parameters: Floats, prefer: Sequence[str] = (), floor: float = SIGNAL_FLOOR
) -> Observability:
    """What the train rows, without priors, determine of the robot's parameters around a parameter vector.

    Args:
        problem: The problem.
        parameters: The parameter vector (see `Variables`).
        prefer: Parameters to keep, first choice first, where only combinations are determined.
        floor: Signal-to-noise ratio below which a direction counts as not determined.
    """
    return analyse(
        named_triangle(problem, parameters),
        problem.estimated,
        scales=np.array([problem.robot.scale_of(p.unit) for p in problem.estimated]),
        n_measurements=(problem.n_pairs + problem.n_of_points) or problem.n_configurations,
        prefer=prefer,
        floor=floor,
    )


def all_rows(problem: Problem, parameters: Floats) -> Block:
    """Every measured row, train and test, in [m] and [rad]: the block behind predictions and residual tables.

    Args:
        problem: The problem.
        parameters: The parameter vector at which the rows are wanted: the mean of a noisy length depends on it.
    """
    m, model = problem.measurements, problem.options.model
    if problem.pairs is not None:
        return pair_rows(problem, parameters).rows()
    return pose_block(problem.trig, np.arange(m.n_configurations), m, POSE_MODELS[model])


def _usable_pairs(measurements: Measurements, options: Options) -> Pairs:
    """The pairs, with nan where the model does not want a measurement; every wanted one has its sigma."""
    with_distance, with_angle = PAIR_MODELS[options.model]
    missing = (with_distance and measurements.position is None) or (with_angle and measurements.rotation is None)
    if measurements.pairs is not None:
        pairs = measurements.pairs
    elif measurements.groups is not None and missing:  # touched points suffice
        pairs = no_pairs(measurements.source)
    else:
        if with_distance and measurements.position is None:
            raise ProblemError(
                measurements.source, "no columns x, y, z", f"measured positions for model {options.model}"
            )
        if with_angle and measurements.rotation is None:
            raise ProblemError(
                measurements.source,
                "no columns qx, qy, qz, qw or roll, pitch, yaw",
                f"orientations for model {options.model}",
            )
        pairs = form_pairs(measurements, options.pairing)
    nothing = np.full(pairs.n_pairs, np.nan)
    pairs = replace(
        pairs,
        distance=pairs.distance if with_distance else nothing,
        angle=pairs.angle if with_angle else nothing,
    )
    for kind, values, sigma in (
        ("distance", pairs.distance, pairs.sigma_distance),
        ("angle", pairs.angle, pairs.sigma_angle),
    ):
        if np.any(np.isfinite(values) & ~np.isfinite(sigma)):
            formed = measurements.pairs is None
            noise = {"distance": "position", "angle": "orientation"}[kind] if formed else kind
            raise ProblemError(pairs.source, f"no sigma for {kind}", f"noise.{noise} or a column sigma_{noise}")
    measured = np.isfinite(pairs.distance) | np.isfinite(pairs.angle)
    return pairs.select(measured)


def _check_points(measurements: Measurements, options: Options) -> None:
    """What has not been made for touched points is refused, rather than done to the other rows alone."""
    for key, value, only in (("loss", options.loss, "none"), ("encoder", options.encoder, "propagated")):
        if value != only:
            raise ProblemError(measurements.source, f"a column group with {key} {value}", f"{key} {only}")


def _check_poses(measurements: Measurements, options: Options) -> None:
    with_orientation, with_position = POSE_MODELS[options.model]
    for wanted, values, sigma, columns, noise in (
        (
            with_orientation,
            measurements.rotation,
            measurements.sigma_orientation,
            "qx, qy, qz, qw or roll, pitch, yaw",
            "orientation",
        ),
        (with_position, measurements.position, measurements.sigma_position, "x, y, z", "position"),
    ):
        if wanted and values is None:
            raise ProblemError(
                measurements.source, f"no columns {columns}", f"measured {noise}s for model {options.model}"
            )
        if wanted and sigma is None:
            raise ProblemError(measurements.source, f"no sigma for {noise}", f"noise.{noise} or a column sigma_{noise}")


def _check_enough(problem: Problem) -> None:
    """Whether there are rows at all, and as many as unknowns that random configurations could determine."""
    touches_only = problem.points is not None and problem.pairs is not None and not problem.pairs.n_pairs
    source = problem.measurements.source if problem.pairs is None or touches_only else problem.pairs.source
    unit = "touch" if touches_only else "row" if problem.pairs is None else "pair"
    if problem.n_residuals == 0:
        reasons = ", ".join(
            f"{count} excluded for {reason.replace('_', ' ')}" for reason, count in problem.n_excluded.items() if count
        )
        found = f"no {unit} left to fit"
        if reasons:
            raise ProblemError(source, f"{found}: {reasons}", f"{unit}s that tell something")
        if problem.pairs is not None and not problem.pairs.n_pairs and not touches_only:
            raise ProblemError(source, f"{found}: none has a measurement that model {problem.options.model} uses")
        raise ProblemError(source, found, "train rows")
    rows = problem.n_residuals + problem.n_priors - problem.variables.n_without_prior
    if rows >= problem.variables.n_columns:
        return
    s = problem.options
    anywhere = random_problem(problem.robot, s.model, s.frame)
    priors = prior_rows(problem.variables, problem.start)[1]
    stacked = np.vstack([whitened_triangle(anywhere, anywhere.start), priors])
    needed = determined(singular_values(stacked * problem.variables.prior_scales), STRUCTURAL_FLOOR)
    if rows < needed:
        raise ProblemError(
            source, f"{rows} residuals", f"at least {needed} to determine what model {problem.options.model} can"
        )


def _true_joints(robot: Robot, measurements: Measurements, options: Options, pairs: Pairs | None) -> TrueJoints | None:
    """The true joint values as variables, where they are estimated and not too many for that."""
    if options.encoder == "propagated" or not np.any(measurements.sigma_joint > 0.0):
        return None
    rows = np.flatnonzero(~measurements.test)
    if pairs is not None:
        train = ~pairs.test
        rows = np.unique(np.concatenate([pairs.a[train], pairs.b[train]]))
    return TrueJoints(robot, measurements, rows) if 0 < len(rows) <= MAX_JOINT_VARIABLES else None


def _start(
    robot: Robot,
    measurements: Measurements,
    options: Options,
    variables: Variables,
    trig: Floats,
    pairs: Pairs | None,
    points: PointGroups | None,
) -> Floats:
    """The nominal parameters with the unknown frames from closed form, as a parameter vector; then touched points."""
    start = _start_of_core(robot, measurements, options, variables, trig, pairs, points)
    if points is not None:
        start[variables.nuisance_span] = points.start(variables.chain.at(start), trig)
    return start


def _start_of_core(
    robot: Robot,
    measurements: Measurements,
    options: Options,
    variables: Variables,
    trig: Floats,
    pairs: Pairs | None,
    points: PointGroups | None,
) -> Floats:
    start = variables.nominal()
    tool = robot.owned_by(robot.n_joints + 1)  # in the order of FRAME_KINDS
    free = np.array([robot.parameters[i].estimated for i in tool])
    unknown = Unknown(
        frame=any(v.kind == "frame" for v in variables.items),
        tool_rotation=bool(free[3:].all()),
        tool_translation=free[:3],
    )
    if not unknown.frame and not unknown.tool_rotation and not unknown.tool_translation.any():
        return start
    bare = robot.nominal
    bare[tool] = 0.0
    train = np.flatnonzero(~measurements.test)
    flange = forward(build_chain(robot.with_values(bare)), trig)
    nominal_tool = Frame(_rotation(start[tool]), start[tool][:3])
    if pairs is not None:
        chosen = np.isfinite(pairs.distance) & ~pairs.test
        poses = (flange.rotation, flange.position)
        T = frames.start_from_distances(
            poses, pairs.a[chosen], pairs.b[chosen], pairs.distance[chosen], nominal_tool, free[:3]
        )
        if points is not None and not chosen.any():
            T = Frame(T.rotation, points.tool_point(poses, nominal_tool.translation, free[:3]))
        X = None
    else:
        with_orientation, with_position = POSE_MODELS[options.model]
        X, T = frames.start_from_poses(
            (flange.rotation[train], flange.position[train]),
            (
                measurements.rotation[train] if with_orientation and measurements.rotation is not None else None,
                measurements.position[train] if with_position and measurements.position is not None else None,
            ),
            (Frame(np.eye(3), np.zeros(3)), nominal_tool),
            unknown,
        )
    found = free & np.repeat([True, unknown.tool_rotation], 3)
    start[np.array(tool)[found]] = _coordinates(T, start[tool])[found]
    if X is not None and unknown.frame:
        start[variables.frame_span] = _coordinates(X)
    return start


def _rotation(frame: Floats) -> Floats:
    """Rotation matrix of x, y, z, yaw, pitch, roll."""
    return pose_of(frame).rotation().matrix()


def _coordinates(frame: Frame, near: Floats | None = None) -> Floats:
    """x, y, z, yaw, pitch, roll of a frame (see `frame_of`)."""
    return frame_of(gtsam.Pose3(gtsam.Rot3(frame.rotation), frame.translation), near)


def _assemble(
    robot: Robot,
    measurements: Measurements,
    options: Options,
    variables: Variables,
    start: Floats,
    trig: Floats,
    pairs: Pairs | None,
    adjustment: Adjustment | None = None,
    points: PointGroups | None = None,
    joints: TrueJoints | None = None,
    added: tuple[gtsam.NonlinearFactor, ...] = (),
) -> Problem:
    """The problem with rows judged and whitened at `start`."""
    chain = variables.chain.at(start)
    adjustment = adjustment or Adjustment()
    joint_noise = bool(np.any(measurements.sigma_joint > 0.0))
    encoder = options.encoder == "estimated" and joint_noise and joints is None
    if encoder and adjustment.joint_errors is None:
        adjustment = replace(adjustment, joint_errors=np.zeros_like(measurements.readings))
    moved = _trig(robot, measurements, trig, adjustment)
    if joints is not None:
        moved = precompute_trig(robot, joints.values(variables, start))
    judgement, sharing = None, Sharing()
    if pairs is not None:
        formed = measurements.pairs is None and pairs.n_pairs > 0
        kinds = PAIR_MODELS[options.model]
        estimated = options.encoder == "estimated"
        of_pairs = PairWhitening(moved, chain, measurements, pairs, kinds, formed, adjustment, estimated)
        judgement, sigma = of_pairs.judgement, of_pairs.sigma
        wanted = Sharing(poses=formed, joints=joint_noise) if options.pair_errors == "shared" else Sharing()
        wanted = replace(wanted, joints=(wanted.joints or encoder) and joints is None)
        if of_pairs.size(wanted) <= MAX_SHARED:
            sharing = wanted
        elif encoder:
            found = f"{of_pairs.size(wanted)} rows or errors that they share"
            raise ProblemError("encoder: estimated", found, f"at most {MAX_SHARED} for models of pairs", "propagated")
        blocks = of_pairs.blocks(sharing, joint_noise=joints is None)
    else:
        of_poses = PoseWhitening(moved, chain, measurements, POSE_MODELS[options.model], adjustment)
        sigma, blocks = of_poses.sigma, of_poses.blocks(joint_noise=joints is None)
    terms: tuple[Term, ...] = ()
    if joints is not None:
        terms, blocks, sharing = joints.terms(blocks, variables), [], replace(sharing, joints=pairs is not None)
    graph = gtsam.NonlinearFactorGraph()
    for block in blocks if variables.items else ():
        graph.add(measurement_factor(block, variables))
    sigma_point = np.zeros((0, 3))
    if points is not None:
        covariance = points.covariance(chain, trig)
        sigma_point = np.sqrt(np.einsum("nii->ni", covariance))
        terms += points.terms(trig, covariance)
    for term in terms:
        graph.add(term_factor(term, variables))
    for factor in (*prior_factors(variables), *added):
        graph.add(factor)
    return Problem(
        robot=robot,
        measurements=measurements,
        options=options,
        variables=variables,
        start=start,
        trig=trig,
        pairs=pairs,
        judgement=judgement,
        sigma=sigma,
        blocks=tuple(blocks),
        graph=graph,
        initial=variables.values(start),
        sharing=sharing,
        adjustment=adjustment,
        points=points,
        joints=joints,
        sigma_point=sigma_point,
        terms=terms,
        factors=gtsam.NonlinearFactorGraph(graph),
        added=added,
    )
