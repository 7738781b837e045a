"""The calibration problem: measurements judged, whitened and gathered in blocks, as a GTSAM graph with a start.

`build_problem` makes it, `solve` solves it; in between it can be looked at: the graph, the initial values, which rows
take part and why the others do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib import frames, residuals
from fg_calib.choices import FrameKnowledge, Gauge, Model
from fg_calib.errors import ProblemError
from fg_calib.factors import (
    Variables,
    build_variables,
    frame_of,
    measurement_factor,
    pose_of,
    prior_factors,
    prior_rows,
)
from fg_calib.files.job import Job
from fg_calib.frames import Frame, Unknown
from fg_calib.kinematics import Chain, build_chain, forward, precompute_trig
from fg_calib.measurements import Measurements, Pairing, Pairs, form_pairs
from fg_calib.observability import RANK_TOLERANCE, SIGNAL_FLOOR, Observability, analyse, determined, singular_values
from fg_calib.residuals import Block, PairBlock, PoseBlock, SamePointBlock
from fg_calib.robot import Parameter, Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

KINK_SIGMAS = 5.0
"""An angle nearer to 0 or pi, or a distance nearer to 0, than this many sigma gives no row of its own."""

SAME_POINT_SIGMAS = 3.0
"""A small distance that was measured as 0 within this many sigma says that both points are the same."""

PAIR_KINDS: dict[str, tuple[bool, bool]] = {
    "distance": (True, False),
    "rotation": (False, True),
    "distance-rotation": (True, True),
}
"""Whether a model uses distances and angles of pairs."""

POSE_KINDS: dict[str, tuple[bool, bool]] = {
    "orientation": (True, False),
    "position": (False, True),
    "pose": (True, True),
}
"""Whether a model uses orientations and positions."""

STRUCTURAL_FLOOR = 1e-6
"""Signal-to-noise ratio that counts as nothing on random configurations with an assumed noise: rounding alone."""

_CHUNK = 65_536
"""Rows whose derivatives in the joints are held at once."""


@dataclass(frozen=True)
class Settings:
    """What is estimated from what.

    Attributes:
        model: Which measurements take part.
        pairing: How pairs are formed from poses where none were measured directly.
        frame: Whether the measurement frame is known to be the base, or world_T_base is estimated too.
        prior: Whether the robot's tolerances are priors.
        gauge: What holds the directions that the data do not determine.
    """

    model: Model = "distance-rotation"
    pairing: Pairing = field(default_factory=Pairing)
    frame: FrameKnowledge = "known"
    prior: bool = True
    gauge: Gauge = "prior"

    @property
    def uses_pairs(self) -> bool:
        """Whether the model is one of pairs."""
        return self.model in PAIR_KINDS


@dataclass(frozen=True)
class PairJudgement:
    """What each pair contributes, shapes (n_pairs,).

    Attributes:
        distance: Gives a distance row.
        angle: Gives an angle row.
        same_point: Gives the 3-vector between its points instead of a distance.
        reasons: Why measured rows take no part: masks by reason.
    """

    distance: Booleans
    angle: Booleans
    same_point: Booleans
    reasons: dict[str, Booleans]

    def __eq__(self, other: object) -> bool:
        """Whether both use the same rows."""
        if not isinstance(other, PairJudgement):
            return NotImplemented
        fields = ("distance", "angle", "same_point")
        return all(np.array_equal(getattr(self, f), getattr(other, f)) for f in fields)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True)
class Problem:
    """A calibration problem, ready to be solved.

    Attributes:
        robot: The nominal robot.
        measurements: Everything measured.
        settings: What is estimated from what.
        variables: The GTSAM variables and their columns.
        start: Initial parameter vector (see `Variables`).
        trig: Readings for the kernels.
        pairs: All pairs, train and test; None for models of poses.
        judgement: What each pair contributes; None for models of poses.
        sigma: 1 sigma of distance and angle, shape (n_pairs, 2), or of orientation and position components,
            shape (n_configurations, 6): measurement noise and joint noise together, [m] and [rad].
        blocks: The whitened train rows.
        graph: Factors and priors.
        whole: The problem with everything estimated, where this one leaves parameters out to fix the gauge.
    """

    robot: Robot
    measurements: Measurements
    settings: Settings
    variables: Variables
    start: Floats
    trig: Floats
    pairs: Pairs | None
    judgement: PairJudgement | None
    sigma: Floats
    blocks: tuple[Block, ...]
    graph: gtsam.NonlinearFactorGraph
    whole: Problem | None = None

    @property
    def initial(self) -> gtsam.Values:
        """GTSAM's initial values."""
        return self.variables.values(self.start)

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
        used = self.judgement.distance | self.judgement.angle | self.judgement.same_point
        return int(np.sum(used & ~self.pairs.test))

    @property
    def n_configurations(self) -> int:
        """Configurations that the train rows come from."""
        if self.pairs is None or self.judgement is None:
            return int(np.sum(~self.measurements.test))
        used = (self.judgement.distance | self.judgement.angle | self.judgement.same_point) & ~self.pairs.test
        return len(np.unique(np.concatenate([self.pairs.a[used], self.pairs.b[used]])))

    @property
    def n_residuals(self) -> int:
        """Scalar residuals of the fit, priors not counted."""
        if self.pairs is None or self.judgement is None:
            return sum(b.n * b.height for b in self.blocks)
        j, train = self.judgement, ~self.pairs.test
        return int(np.sum(j.distance & train) + np.sum(j.angle & train) + 3 * np.sum(j.same_point & train))

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


def build_problem(
    robot: Robot,
    measurements: Measurements,
    *,
    model: Model,
    pairing: Pairing | None = None,
    frame: FrameKnowledge = "known",
    prior: bool | None = None,
    gauge: Gauge = "prior",
    prefer: Sequence[str] = (),
) -> Problem:
    """The calibration problem of a robot and its measurements.

    Args:
        robot: The nominal robot.
        measurements: What was measured.
        model: Which measurements take part.
        pairing: How pairs are formed from poses where none were measured directly; a star if None.
        frame: `unknown` estimates world_T_base with the parameters; of no meaning for models of pairs.
        prior: Whether the robot's tolerances are priors; None for yes.
        gauge: What holds the directions that the data do not determine. `prior`: the tolerances. `none`: nothing;
            everything is estimated by minimum-norm steps, and what is not determined has no sigma. `keep`: only
            the independent parameters and those kept of each relative group are estimated, without priors, the
            others stay at nominal (the paper's way).
        prefer: For `keep`: parameters to keep, first choice first.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
    """
    settings = Settings(model, pairing or Pairing(), frame, prior is not False and gauge == "prior", gauge)
    if not any(p.estimated for p in robot.parameters):
        raise ProblemError(f"robot {robot.name}", "nothing to estimate", "at least one parameter that is not fixed")
    unknown_frame = frame == "unknown" and not settings.uses_pairs
    variables = build_variables(robot, unknown_frame, settings.prior)
    pairs = _usable_pairs(measurements, settings) if settings.uses_pairs else None
    if pairs is None:
        _check_poses(measurements, settings)
    trig = precompute_trig(robot, measurements.readings)
    start = _start(robot, measurements, settings, variables, trig, pairs)
    problem = _assemble(robot, measurements, settings, variables, start, trig, pairs)
    _check_enough(problem)
    if gauge != "keep":
        return problem
    kept = observe(problem, start, prefer).kept
    if not kept and not unknown_frame:
        raise ProblemError(
            measurements.source if pairs is None else pairs.source,
            "the rows determine none of the parameters to estimate",
            "rows that some of them act on",
        )
    reduced = robot.with_estimated(kept)
    variables = build_variables(reduced, unknown_frame, False)
    return replace(_assemble(reduced, measurements, settings, variables, start, trig, pairs), whole=problem)


def problem_of(job: Job, **changes: Any) -> Problem:
    """The calibration problem of a job.

    Args:
        job: The job.
        changes: Arguments of `build_problem` that shall differ from the job's.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
    """
    settings: dict[str, Any] = {
        "model": job.model,
        "pairing": job.pairing,
        "frame": job.frame,
        "prior": job.prior,
        "gauge": job.gauge,
        "prefer": job.prefer,
    }
    return build_problem(job.robot, job.measurements, **settings | changes)


def predicted_problem(
    robot: Robot,
    readings: Floats,
    model: Model,
    *,
    frame: FrameKnowledge = "known",
    pairing: Pairing | None = None,
    sigmas: tuple[Floats | None, Floats | None, Floats | None] = (None, None, None),
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
    """
    settings = Settings(model, pairing or Pairing(), frame, prior=False)
    variables = build_variables(robot, frame == "unknown" and not settings.uses_pairs, priors=False)
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
    pairs = _usable_pairs(measurements, settings) if settings.uses_pairs else None
    return _assemble(robot, measurements, settings, variables, variables.nominal(), trig, pairs)


def random_problem(
    robot: Robot, model: Model, frame: FrameKnowledge = "known", *, n_configurations: int = 0, seed: int = 0
) -> Problem:
    """`predicted_problem` at random configurations: what a model can determine at all.

    Args:
        robot: The robot; revolute joints without limits turn over +-180 degrees, prismatic ones slide over +-1 m.
        model: Which measurements take part; pairs are chained.
        frame: Whether the measurement frame is estimated too.
        n_configurations: How many; 0 for ten for every parameter, 300 at least.
        seed: Of the random configurations.
    """
    n = n_configurations or max(300, 10 * len(robot.parameters))
    span = np.array([1.0 if joint.prismatic else np.pi for joint in robot.joints])
    lower, upper = np.clip(robot.limits, -span[:, None], span[:, None]).T
    readings = np.random.default_rng(seed).uniform(lower, upper, (n, robot.n_joints))
    return predicted_problem(robot, readings, model, frame=frame, pairing=Pairing("chain"))


def judged_at(problem: Problem, parameters: Floats) -> Problem:
    """The same problem with its rows judged and whitened, and started, at other parameters."""
    p = problem
    anew = _assemble(p.robot, p.measurements, p.settings, p.variables, parameters, p.trig, p.pairs)
    return replace(anew, whole=p.whole)


def frames_only(problem: Problem) -> Problem | None:
    """The same problem with the arm at nominal: measurement frame, base and tool alone; None if none is estimated."""
    n = problem.robot.n_joints
    parameters = tuple(replace(p, estimated=p.estimated and not 1 <= p.owner <= n) for p in problem.robot.parameters)
    robot = replace(problem.robot, parameters=parameters)
    variables = build_variables(robot, any(v.kind == "frame" for v in problem.variables.items), problem.settings.prior)
    if not variables.items:
        return None
    p = problem
    return _assemble(robot, p.measurements, p.settings, variables, p.start, p.trig, p.pairs)


def whitened_triangle(problem: Problem, parameters: Floats) -> Floats:
    """Triangular factor of the train rows' whitened Jacobian at a parameter vector, shape (m, n_columns)."""
    chain = problem.variables.chain.at(parameters)
    return np.vstack([residuals.triangle(block, chain)[:, :-1] for block in problem.blocks])


def named_triangle(problem: Problem, parameters: Floats) -> Floats:
    """`whitened_triangle` by named parameters, the measurement frame projected out: shape (m, n_robot_columns).

    Note:
        At a tool pitch of a quarter turn there is no way back from tangent columns to angles; the nearest is taken.
    """
    variables = problem.variables
    n = variables.n_robot_columns
    D = np.nan_to_num(variables.named_derivative(parameters), posinf=1e12, neginf=-1e12)
    J: Floats = whitened_triangle(problem, parameters) @ np.linalg.pinv(D)
    out: Floats = J[:, :n]
    if n == variables.n_columns:
        return out
    U, s, _ = np.linalg.svd(J[:, n:], full_matrices=False)
    Q = U[:, s > RANK_TOLERANCE * s.max(initial=0.0)]
    out = out - Q @ (Q.T @ out)
    # What projecting leaves of a column that was all frame is rounding.
    out[:, np.linalg.norm(out, axis=0) <= RANK_TOLERANCE * np.linalg.norm(J[:, :n], axis=0)] = 0.0
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
        n_measurements=problem.n_pairs or problem.n_configurations,
        prefer=prefer,
        floor=floor,
    )


def all_rows(problem: Problem) -> Block:
    """Every measured row, train and test, in [m] and [rad]: the block behind predictions and residual tables."""
    m, n = problem.measurements, problem.measurements.n_configurations
    if problem.pairs is not None:
        return _pair_block(problem.trig, problem.pairs, PAIR_KINDS[problem.settings.model], np.array([1.0, 0.0, 1.0]))
    kinds = POSE_KINDS[problem.settings.model]
    return _pose_block(problem.trig, np.arange(n), m, kinds, np.eye(3 * sum(kinds)))


def _usable_pairs(measurements: Measurements, settings: Settings) -> Pairs:
    """The pairs, with nan where the model does not want a measurement; every wanted one has its sigma."""
    with_distance, with_angle = PAIR_KINDS[settings.model]
    if measurements.pairs is not None:
        pairs = measurements.pairs
    else:
        if with_distance and measurements.position is None:
            raise ProblemError(
                measurements.source, "no columns x, y, z", f"measured positions for model {settings.model}"
            )
        if with_angle and measurements.rotation is None:
            raise ProblemError(
                measurements.source,
                "no columns qx, qy, qz, qw or roll, pitch, yaw",
                f"orientations for model {settings.model}",
            )
        pairs = form_pairs(measurements, settings.pairing)
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


def _check_poses(measurements: Measurements, settings: Settings) -> None:
    with_orientation, with_position = POSE_KINDS[settings.model]
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
                measurements.source, f"no columns {columns}", f"measured {noise}s for model {settings.model}"
            )
        if wanted and sigma is None:
            raise ProblemError(measurements.source, f"no sigma for {noise}", f"noise.{noise} or a column sigma_{noise}")


def _check_enough(problem: Problem) -> None:
    """Whether there are rows at all, and as many as unknowns that random configurations could determine."""
    source = problem.measurements.source if problem.pairs is None else problem.pairs.source
    unit = "row" if problem.pairs is None else "pair"
    if problem.n_residuals == 0:
        reasons = ", ".join(
            f"{count} excluded for {reason.replace('_', ' ')}" for reason, count in problem.n_excluded.items() if count
        )
        found = f"no {unit} left to fit"
        if reasons:
            raise ProblemError(source, f"{found}: {reasons}", f"{unit}s that tell something")
        if problem.pairs is not None and not problem.pairs.n_pairs:
            raise ProblemError(source, f"{found}: none has a measurement that model {problem.settings.model} uses")
        raise ProblemError(source, found, "train rows")
    rows = problem.n_residuals + problem.n_priors
    if rows >= problem.variables.n_columns:
        return
    s = problem.settings
    anywhere = random_problem(problem.robot, s.model, s.frame)
    priors = prior_rows(problem.variables, problem.start)[1]
    stacked = np.vstack([whitened_triangle(anywhere, anywhere.start), priors])
    needed = determined(singular_values(stacked * problem.variables.scales), STRUCTURAL_FLOOR)
    if rows < needed:
        raise ProblemError(
            source, f"{rows} residuals", f"at least {needed} to determine what model {problem.settings.model} can"
        )


def _start(
    robot: Robot,
    measurements: Measurements,
    settings: Settings,
    variables: Variables,
    trig: Floats,
    pairs: Pairs | None,
) -> Floats:
    """The nominal parameters with the unknown frames from closed form, as a parameter vector."""
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
        X = None
    else:
        with_orientation, with_position = POSE_KINDS[settings.model]
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
    start[np.array(tool)[found]] = _coordinates(T)[found]
    if X is not None and unknown.frame:
        start[-6:] = _coordinates(X)
    return start


def _rotation(frame: Floats) -> Floats:
    """Rotation matrix of x, y, z, yaw, pitch, roll."""
    return pose_of(frame).rotation().matrix()


def _coordinates(frame: Frame) -> Floats:
    """x, y, z, yaw, pitch, roll of a frame."""
    return frame_of(gtsam.Pose3(gtsam.Rot3(frame.rotation), frame.translation))


def _assemble(
    robot: Robot,
    measurements: Measurements,
    settings: Settings,
    variables: Variables,
    start: Floats,
    trig: Floats,
    pairs: Pairs | None,
) -> Problem:
    """The problem with rows judged and whitened at `start`."""
    chain = variables.chain.at(start).without_columns()
    judgement = None
    blocks: list[Block] = []
    if pairs is not None:
        kinds = PAIR_KINDS[settings.model]
        whole = _pair_block(trig, pairs, kinds, np.array([1.0, 0.0, 1.0]))
        covariance = _pair_covariance(whole, chain, pairs, measurements.sigma_joint, kinds)
        sigma = np.sqrt(covariance[:, [0, 2]])
        same = np.all(measurements.readings[pairs.a] == measurements.readings[pairs.b], axis=1)
        judgement = _judge(pairs, _predicted(whole, chain, kinds), sigma, same)
        blocks = _pair_blocks(trig, chain, pairs, judgement, covariance, measurements.sigma_joint, kinds)
    else:
        pose_kinds = POSE_KINDS[settings.model]
        whole_poses = _pose_block(
            trig, np.arange(measurements.n_configurations), measurements, pose_kinds, np.eye(3 * sum(pose_kinds))
        )
        factors, sigma = _pose_whitening(whole_poses, chain, measurements, pose_kinds)
        train = np.flatnonzero(~measurements.test)
        if len(train):
            blocks = [_pose_block(trig, train, measurements, pose_kinds, factors[train])]
    graph = gtsam.NonlinearFactorGraph()
    for block in blocks:
        graph.add(measurement_factor(block, variables))
    for factor in prior_factors(variables):
        graph.add(factor)
    return Problem(robot, measurements, settings, variables, start, trig, pairs, judgement, sigma, tuple(blocks), graph)


def _pair_block(trig: Floats, pairs: Pairs, kinds: tuple[bool, bool], whitening: Floats) -> PairBlock:
    measured = np.nan_to_num(np.stack([pairs.distance, pairs.angle], axis=1))
    return PairBlock(
        trig, pairs.a, pairs.b, measured, np.ascontiguousarray(np.broadcast_to(whitening, (pairs.n_pairs, 3))), kinds
    )


def _pose_block(
    trig: Floats, rows: Integers, measurements: Measurements, kinds: tuple[bool, bool], whitening: Floats
) -> PoseBlock:
    n, height = len(rows), 3 * sum(kinds)
    rotation = np.zeros((n, 3, 3)) if measurements.rotation is None else measurements.rotation[rows]
    position = np.zeros((n, 3)) if measurements.position is None else measurements.position[rows]
    weights = np.ascontiguousarray(np.broadcast_to(whitening, (n, height, height)))
    return PoseBlock(trig, rows, np.ascontiguousarray(rotation), np.ascontiguousarray(position), weights, kinds)


def _predicted(block: PairBlock, chain: Chain, kinds: tuple[bool, bool]) -> Floats:
    """Predicted distance and angle of each pair, shape (n, 2); zero where the model has none."""
    predicted = np.zeros((block.n, 2))
    predicted[:, kinds] = residuals.residual(block, chain) + block.measured[:, kinds]
    return predicted


def _judge(pairs: Pairs, predicted: Floats, sigma: Floats, same: Booleans) -> PairJudgement:
    """Which rows of each pair take part; none where both readings are the same: no parameter changes the prediction."""
    measured_distance, measured_angle = np.isfinite(pairs.distance) & ~same, np.isfinite(pairs.angle) & ~same
    smallest = np.fmin(pairs.distance, predicted[:, 0])
    small = measured_distance & (smallest < KINK_SIGMAS * sigma[:, 0])
    same_point = small & (pairs.distance <= SAME_POINT_SIGMAS * sigma[:, 0])
    margin = KINK_SIGMAS * sigma[:, 1]
    near_zero = measured_angle & (np.fmin(pairs.angle, predicted[:, 1]) < margin)
    near_pi = measured_angle & ~near_zero & (np.fmax(pairs.angle, predicted[:, 1]) > np.pi - margin)
    return PairJudgement(
        distance=measured_distance & ~small,
        angle=measured_angle & ~near_zero & ~near_pi,
        same_point=same_point,
        reasons={
            "distance_near_zero": small & ~same_point,
            "angle_near_zero": near_zero,
            "angle_near_pi": near_pi,
            "same_configuration": same,
        },
    )


def _pair_covariance(
    block: PairBlock, chain: Chain, pairs: Pairs, sigma_joint: Floats, kinds: tuple[bool, bool]
) -> Floats:
    """Variance of distance, covariance, variance of angle of each pair, shape (n, 3), [m^2, m rad, rad^2].

    The noise of the readings reaches a measurement to first order through its derivatives in the joints. Pairs
    count as independent of each other even where they share a configuration.
    """
    covariance = np.zeros((block.n, 3))
    covariance[:, 0] = np.nan_to_num(pairs.sigma_distance) ** 2
    covariance[:, 2] = np.nan_to_num(pairs.sigma_angle) ** 2
    if np.any(sigma_joint > 0.0):
        for rows, J in _joint_derivatives(block, chain, sigma_joint):
            wide = np.zeros((len(J), 2, J.shape[2]))
            wide[:, kinds] = J
            covariance[rows, 0] += np.sum(wide[:, 0] ** 2, axis=1)
            covariance[rows, 1] += np.sum(wide[:, 0] * wide[:, 1], axis=1)
            covariance[rows, 2] += np.sum(wide[:, 1] ** 2, axis=1)
    return covariance


def _joint_derivatives(block: Block, chain: Chain, sigma_joint: Floats) -> list[tuple[slice, Floats]]:
    """Derivatives of a block's rows in the readings times their sigma, in chunks: (rows, (n, height, n_own))."""
    scale = np.tile(sigma_joint, block.n_configurations)
    chain = chain.with_joint_columns()
    chunks = []
    for start in range(0, block.n, _CHUNK):
        rows = slice(start, min(start + _CHUNK, block.n))
        chunks.append((rows, residuals.linearise(residuals.rows_of(block, rows), chain)[1] * scale))
    return chunks


def _pair_blocks(
    trig: Floats,
    chain: Chain,
    pairs: Pairs,
    judgement: PairJudgement,
    covariance: Floats,
    sigma_joint: Floats,
    kinds: tuple[bool, bool],
) -> list[Block]:
    """The train rows: a block of distances and angles, a block of same points."""
    blocks: list[Block] = []
    train = ~pairs.test
    rows = np.flatnonzero((judgement.distance | judgement.angle) & train)
    if len(rows):
        whitening = _whiten_2x2(covariance[rows], judgement.distance[rows], judgement.angle[rows])
        blocks.append(_pair_block(trig, pairs.select(rows), kinds, whitening))
    rows = np.flatnonzero(judgement.same_point & train)
    if len(rows):
        variance = pairs.sigma_distance[rows] ** 2
        same = SamePointBlock(trig, pairs.a[rows], pairs.b[rows], np.tile(np.eye(3), (len(rows), 1, 1)))
        S = np.eye(3) * variance[:, None, None]
        if np.any(sigma_joint > 0.0):
            for chunk, J in _joint_derivatives(same, chain, sigma_joint):
                S[chunk] += J @ np.swapaxes(J, 1, 2)
        blocks.append(replace(same, whitening=_inverse_cholesky(S)))
    return blocks


def _whiten_2x2(covariance: Floats, distance: Booleans, angle: Booleans) -> Floats:
    """(w_dd, w_ad, w_aa) that whiten the rows in use, shape (n, 3)."""
    d, c, a = covariance.T
    both = distance & angle
    with np.errstate(divide="ignore", invalid="ignore"):
        rest = np.sqrt(np.where(both, a - c * c / d, a))
        w_dd = np.where(distance, 1.0 / np.sqrt(d), 0.0)
        w_aa = np.where(angle, 1.0 / rest, 0.0)
        w_ad = np.where(both, -c / d / rest, 0.0)
    return np.stack([w_dd, w_ad, w_aa], axis=1)


def _pose_whitening(
    block: PoseBlock, chain: Chain, measurements: Measurements, kinds: tuple[bool, bool]
) -> tuple[Floats, Floats]:
    """Whitening of each pose, shape (n, height, height), and 1 sigma of (orientation, position), shape (n, 6)."""
    n = block.n
    sigmas = [measurements.sigma_orientation if kinds[0] else None, measurements.sigma_position if kinds[1] else None]
    wanted = [s for s in sigmas if s is not None]
    variance = np.concatenate(wanted, axis=1) ** 2  # (n, height)
    S = variance[:, :, None] * np.eye(block.height)
    if np.any(measurements.sigma_joint > 0.0):
        for rows, J in _joint_derivatives(block, chain, measurements.sigma_joint):
            S[rows] += J @ np.swapaxes(J, 1, 2)
    sigma = np.full((n, 6), np.nan)
    sigma[:, np.repeat(kinds, 3)] = np.sqrt(np.einsum("nii->ni", S))
    return _inverse_cholesky(S), sigma


def _inverse_cholesky(S: Floats) -> Floats:
    """W with W S W^T = 1, lower triangular, for each of many small covariances."""
    W: Floats = np.linalg.inv(np.linalg.cholesky(S))
    return np.tril(W)
