"""The calibration problem: measurements judged, whitened and gathered in blocks, as a GTSAM graph with a start.

`build_problem` makes it, `solve` solves it; in between it can be looked at: the graph, the initial values, which rows
take part and why the others do not.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib import frames, residuals
from fg_calib.choices import FrameKnowledge, Gauge, Model, PairErrors
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
from fg_calib.kinematics import build_chain, forward, precompute_trig
from fg_calib.measurements import Measurements, Pairing, Pairs, form_pairs
from fg_calib.observability import RANK_TOLERANCE, SIGNAL_FLOOR, Observability, analyse, determined, singular_values
from fg_calib.residuals import AnyBlock, Block, CorrelatedBlock
from fg_calib.robot import Parameter, Robot
from fg_calib.whitening import (
    MAX_SHARED,
    Adjustment,
    PairJudgement,
    PairWhitening,
    PoseWhitening,
    Sharing,
    pair_block,
    pose_block,
)

_log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

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


@dataclass(frozen=True)
class Settings:
    """What is estimated from what.

    Attributes:
        model: Which measurements take part.
        pairing: How pairs are formed from poses where none were measured directly.
        frame: Whether the measurement frame is known to be the base, or world_T_base is estimated too.
        prior: Whether the robot's tolerances are priors.
        gauge: What holds the directions that the data do not determine.
        pair_errors: Whether pairs of one configuration share its errors or count as independent.
    """

    model: Model = "distance-rotation"
    pairing: Pairing = field(default_factory=Pairing)
    frame: FrameKnowledge = "known"
    prior: bool = True
    gauge: Gauge = "prior"
    pair_errors: PairErrors = "shared"

    @property
    def uses_pairs(self) -> bool:
        """Whether the model is one of pairs."""
        return self.model in PAIR_KINDS


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
        sharing: Which errors of configurations the rows carry in common.
        adjustment: What has been learned of the measurements' noise.
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
    blocks: tuple[AnyBlock, ...]
    graph: gtsam.NonlinearFactorGraph
    sharing: Sharing
    adjustment: Adjustment
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
        return int(np.sum(self.judgement.used & ~self.pairs.test))

    @property
    def n_configurations(self) -> int:
        """Configurations that the train rows come from."""
        if self.pairs is None or self.judgement is None:
            return int(np.sum(~self.measurements.test))
        used = self.judgement.used & ~self.pairs.test
        return len(np.unique(np.concatenate([self.pairs.a[used], self.pairs.b[used]])))

    @property
    def formed(self) -> bool:
        """Whether pairs were formed from measured poses."""
        return self.pairs is not None and self.measurements.pairs is None

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
            return sum(b.n * b.height for b in self.blocks)
        j, train = self.judgement, ~self.pairs.test
        return int(np.sum(j.distance & train) + np.sum(j.angle & train) + 3 * np.sum(j.same_point & train))

    @property
    def n_independent(self) -> int:
        """Residuals that the noise can make differ freely: pairs formed from poses hold no more than the poses do."""
        block = self.blocks[0] if self.blocks else None
        if not (self.sharing.poses and isinstance(block, CorrelatedBlock)):
            return self.n_residuals
        return min(self.n_residuals, round(block.n_shared_rows))

    @property
    def approximate(self) -> bool:
        """Whether rows share errors but were too many to carry them, and were weighted as if independent."""
        return self.settings.pair_errors == "shared" and self.sharing != self.common

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
    pair_errors: PairErrors = "shared",
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
        pair_errors: `shared`: pairs carry the errors of their configurations in common, as long as these are not too
            many (`MAX_SHARED`); then, and with `independent`, they are weighted as if independent.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
    """
    with_priors = prior is not False and gauge == "prior"
    settings = Settings(model, pairing or Pairing(), frame, with_priors, gauge, pair_errors)
    if not any(p.estimated for p in robot.parameters):
        raise ProblemError(f"robot {robot.name}", "nothing to estimate", "at least one parameter that is not fixed")
    unknown_frame = frame == "unknown" and not settings.uses_pairs
    variables = build_variables(robot, unknown_frame, settings.prior)
    pairs = _usable_pairs(measurements, settings) if settings.uses_pairs else None
    if pairs is None:
        _check_poses(measurements, settings)
        if measurements.pairs is not None:
            _log.warning("%s: not used, model %s is of poses", measurements.pairs.source, model)
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
        "pair_errors": job.pair_errors,
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
    settings = Settings(model, pairing or Pairing(), frame, prior=False, pair_errors=pair_errors)
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
    return predicted_problem(robot, readings, model, frame=frame, pairing=Pairing("chain"), pair_errors="independent")


def noise_kinds(model: Model) -> tuple[str, str]:
    """The kinds of noise that an adjustment's factors are of."""
    return ("distance", "angle") if model in PAIR_KINDS else ("orientation", "position")


def judged_at(problem: Problem, parameters: Floats) -> Problem:
    """The same problem with its rows judged and whitened, and started, at other parameters."""
    p = problem
    anew = _assemble(p.robot, p.measurements, p.settings, p.variables, parameters, p.trig, p.pairs, p.adjustment)
    return replace(anew, whole=p.whole)


def correlation(problem: Problem, parameters: Floats) -> Floats | None:
    """J^T (C - 1) J of the train rows where they share errors but are weighted as independent, else None.

    Args:
        problem: The problem.
        parameters: The parameter vector.

    Returns:
        With J the whitened Jacobian and C the covariance of the whitened rows, shape (n_columns, n_columns).
    """
    p, missing = problem, problem.common != problem.sharing
    if p.pairs is None or not missing:
        return None
    chain, kinds = p.variables.chain.at(parameters), PAIR_KINDS[p.settings.model]
    of_pairs = PairWhitening(p.trig, chain, p.measurements, p.pairs, kinds, p.formed, p.adjustment)
    return of_pairs.correlation(chain, p.common)


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
    m, model = problem.measurements, problem.settings.model
    if problem.pairs is not None:
        return pair_block(problem.trig, problem.pairs, PAIR_KINDS[model])
    return pose_block(problem.trig, np.arange(m.n_configurations), m, POSE_KINDS[model])


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
    adjustment: Adjustment | None = None,
) -> Problem:
    """The problem with rows judged and whitened at `start`."""
    chain = variables.chain.at(start)
    adjustment = adjustment or Adjustment()
    judgement, sharing = None, Sharing()
    if pairs is not None:
        formed = measurements.pairs is None
        kinds = PAIR_KINDS[settings.model]
        of_pairs = PairWhitening(trig, chain, measurements, pairs, kinds, formed, adjustment)
        judgement, sigma = of_pairs.judgement, of_pairs.sigma
        if settings.pair_errors == "shared":
            wanted = Sharing(poses=formed, joints=bool(np.any(measurements.sigma_joint > 0.0)))
            sharing = wanted if of_pairs.n_shared(wanted) <= MAX_SHARED else Sharing()
        blocks = of_pairs.blocks(sharing)
    else:
        of_poses = PoseWhitening(trig, chain, measurements, POSE_KINDS[settings.model], adjustment)
        sigma, blocks = of_poses.sigma, of_poses.blocks()
    graph = gtsam.NonlinearFactorGraph()
    for block in blocks:
        graph.add(measurement_factor(block, variables))
    for factor in prior_factors(variables):
        graph.add(factor)
    return Problem(
        robot=robot,
        measurements=measurements,
        settings=settings,
        variables=variables,
        start=start,
        trig=trig,
        pairs=pairs,
        judgement=judgement,
        sigma=sigma,
        blocks=tuple(blocks),
        graph=graph,
        sharing=sharing,
        adjustment=adjustment,
    )
