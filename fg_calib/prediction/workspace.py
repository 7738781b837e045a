"""Expected errors of a calibrated arm's tool at given configurations, or over the workspace.

Over the workspace, configurations are drawn evenly within the joint limits; the expected error at each is that of
`tool_pose`. Where it is largest, it has a covariance v Cov v^T of its own, whose axes give its direction. *Responsible*
for it are the parameters whose errors it follows: if parameter i were known exactly, the expected square would fall by
the share sum_k cov(e_k, p_i)^2 / (var(p_i) sum_k var(e_k)), summed over the coordinates of the error. Shares of
correlated parameters overlap, so they need not add to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fg_calib.arrays import Floats, FrozenArrays
from fg_calib.prediction.tool_pose import ToolErrors, ToolPoseUncertainty
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Joint, Robot

Booleans = NDArray[np.bool_]

QUANTILES: Mapping[str, float] = {"median": 0.5, "p95": 0.95, "largest": 1.0}
"""Statistics by which errors are summarised."""

_NAMED = 5
"""Parameters that are named as responsible, at most."""

_LEAST_SHARE = 0.05
"""Share from which a parameter is named as responsible."""

_CLIMBERS, _STEPS, _TRIED, _FIRST_STEP, _SHORTER = 6, 14, 50, 0.2, 0.7
"""Random search of the largest error: starts, steps, trials of each, 1 sigma of the first step in the range of each
joint, and how the steps shrink."""

N_DRAWN = 12_000
"""Configurations that are drawn."""

FAR = 0.15
"""Distance from the nearest measured position, in the radius of the workspace, beyond which nothing was measured."""

LEAST_WIDTH = 1e-3
"""Width that pictures of a workspace have at least, [m]: a tool on its arm's only axis stays where it is."""

_N_SAMPLED = 1000
"""Drawn configurations that give the radius of the workspace, and the responsible parameters."""


@dataclass(frozen=True)
class JointRange(FrozenArrays):
    """Where a joint was read, and where it may be.

    Attributes:
        name: Its name.
        unit: `m` or `rad`.
        limits: Lower and upper, infinite where it has none.
        range: The lowest and the highest reading.
        gap: The widest interval between its limits, or lowest and highest reading, without a reading.
    """

    name: str
    unit: str
    limits: tuple[float, float]
    range: tuple[float, float]
    gap: tuple[float, float]


@dataclass(frozen=True)
class Workspace(FrozenArrays):
    """Expected errors of the tool over the workspace.

    Attributes:
        errors: At configurations that were drawn.
        radius: From the mean of the drawn positions to the farthest, [m].
        measured: Where the tool was measured, shape (m, 3), [m].
        fitted: Whether errors count after the best rigid fit, instead of in the base frame.
        joints: Joint by joint.
    """

    errors: ToolErrors
    radius: float
    measured: Floats
    fitted: bool
    joints: tuple[JointRange, ...]

    @property
    def position(self) -> Floats:
        """Tool points of the drawn configurations in the base frame, shape (n, 3), [m]."""
        return self.errors.position

    @property
    def error(self) -> Floats:
        """RMS position error expected of each, shape (n,), [m]; nan where it depends on what is not determined."""
        return self.errors.of(self.fitted)[:, 0]

    @property
    def far(self) -> Booleans:
        """Whether no measured position is near the drawn ones, shape (n,)."""
        return self.far_from_measured(self.position)

    def far_from_measured(self, points: Floats) -> Booleans:
        """Whether no measured position is near points, shape (n, 3): shape (n,)."""
        return np.asarray(cKDTree(self.measured).query(points)[0] > FAR * self.radius)


def survey(robot: Robot, model: ToolPoseUncertainty, readings: Floats, *, fitted: bool, n: int = N_DRAWN) -> Workspace:
    """Expected errors over the workspace, and where nothing was measured.

    A joint that turns without limits is taken to turn by +-180 degrees, one that slides without them between its lowest
    and its highest reading.

    Args:
        robot: The calibrated robot, with its limits.
        model: Expected errors of its tool.
        readings: Of the measured configurations, shape (m, n_joints), [rad] (prismatic: [m]).
        fitted: Whether errors count after the best rigid fit.
        n: Number of configurations that are drawn.
    """
    errors = model.at(random_readings(_bounded(robot, readings), n, np.random.default_rng(0)))
    radius = float(np.max(np.linalg.norm(errors.position - errors.position.mean(axis=0), axis=1), initial=0.0))
    joints = tuple(_range(joint, readings[:, i]) for i, joint in enumerate(robot.joints))
    return Workspace(errors, radius, pose(robot, readings).position, fitted, joints)


def _bounded(robot: Robot, readings: Floats) -> Robot:
    """The robot with its readings as the limits of joints that slide without any."""
    ends = zip(robot.joints, readings.min(axis=0).tolist(), readings.max(axis=0).tolist(), strict=True)
    joints = [
        replace(joint, lower=low, upper=high)
        if joint.prismatic and not np.isfinite(joint.upper - joint.lower)
        else joint
        for joint, low, high in ends
    ]
    return replace(robot, joints=tuple(joints))


def _range(joint: Joint, readings: Floats) -> JointRange:
    inside = np.unique(readings)
    ends = [limit for limit in (joint.lower, joint.upper) if np.isfinite(limit)]
    places = np.unique(np.concatenate([inside, ends]))
    widest = int(np.argmax(np.diff(places))) if len(places) > 1 else 0
    gap = (float(places[widest]), float(places[min(widest + 1, len(places) - 1)]))
    return JointRange(joint.name, joint.unit, (joint.lower, joint.upper), (float(inside[0]), float(inside[-1])), gap)


@dataclass(frozen=True)
class Responsible:
    """A parameter that errors follow.

    Attributes:
        name: Its name.
        unit: `m` or `rad`.
        share: Of the expected square of the position error, by how much it would fall were this one known, 0 to 1.
        change: Its error that goes with one sigma along the longest axis of the error; None over many configurations.
    """

    name: str
    unit: str
    share: float
    change: float | None


@dataclass(frozen=True)
class WorstConfiguration(FrozenArrays):
    """Where the expected position error is largest, as far as it is known.

    Attributes:
        errors: Expected there, of one configuration.
        row: Its row among the configurations that were given; None where it was looked for.
        axes: Directions of the error ellipsoid from the longest axis to the shortest, rows of shape (3, 3), in the base
            frame.
        sigma: 1 sigma along each, shape (3,), [m].
        far: Whether no measured position is near.
        responsible: The parameters that it follows, most first.
    """

    errors: ToolErrors
    row: int | None
    axes: Floats
    sigma: Floats
    far: bool
    responsible: tuple[Responsible, ...]


@dataclass(frozen=True)
class PredictedErrors(FrozenArrays):
    """Expected errors of the tool of a calibrated arm.

    Attributes:
        errors: Configuration by configuration.
        fitted: Whether they count after the best rigid fit of what was measured, because nothing was measured in the
            base frame; else in the base frame.
        given: Whether the configurations were given; else they were drawn all over the workspace.
        far: Whether no measured position is near each of them, shape (n,).
        measured: Where the tool was measured, shape (m, 3), [m].
        joints: Where each joint was read, and where it may be.
        worst: Where the error is largest; None where it is known nowhere.
        responsible: The parameters that errors follow over all configurations where they are known, most first.
        undetermined: Parameters that neither measurements nor tolerances determine, if some errors depend on them.
        limit: Largest allowed position error, [m]; None without any.
    """

    errors: ToolErrors
    fitted: bool
    given: bool
    far: Booleans
    measured: Floats
    joints: tuple[JointRange, ...]
    worst: WorstConfiguration | None
    responsible: tuple[Responsible, ...]
    undetermined: tuple[str, ...]
    limit: float | None

    @property
    def expected(self) -> Floats:
        """Position [m] and orientation [rad] errors in the frame that counts, shape (n, 2); nan where unknown."""
        return self.errors.of(self.fitted)

    @property
    def with_joint_noise(self) -> Floats | None:
        """Expected errors with those of the joint readings, shape (n, 2); None where their noise is not known."""
        noise = self.errors.joint_noise
        return None if noise is None else np.hypot(self.expected, noise)

    @property
    def unknown(self) -> float:
        """Share of the configurations whose position error is not known."""
        return float(np.mean(np.isnan(self.expected[:, 0])))

    @property
    def within(self) -> float | None:
        """Share of the configurations whose expected position error is within the limit; None without any.

        One that is not known is not within it.
        """
        return None if self.limit is None else float(np.mean(self.expected[:, 0] <= self.limit))


def summed_up(errors: Floats) -> dict[str, float | None]:
    """RMS and quantiles of errors, shape (n,); None where they depend on errors that are not known.

    What is not known counts as larger than all else: the median is known where more than half of the errors are.
    """
    known = np.isfinite(errors).all()
    found: dict[str, float | None] = {"rms": float(np.sqrt(np.mean(errors**2))) if known else None}
    ordered = np.where(np.isnan(errors), np.inf, errors)
    for name, share in QUANTILES.items():
        value = float(np.quantile(ordered, share, method="higher"))
        found[name] = value if np.isfinite(value) else None
    return found


def predict_errors(
    robot: Robot,
    model: ToolPoseUncertainty,
    measured: Floats,
    readings: Floats | None = None,
    *,
    fitted: bool,
    limit: float | None = None,
) -> PredictedErrors:
    """Expected errors at configurations, or all over the workspace, and where they are largest.

    Args:
        robot: The calibrated robot, with its limits.
        model: Expected errors of its tool.
        measured: Readings of the measured configurations, shape (m, n_joints), [rad] (prismatic: [m]).
        readings: The configurations, shape (n, n_joints); drawn all over the workspace if None.
        fitted: Whether errors count after the best rigid fit.
        limit: Largest allowed position error, [m].
    """
    workspace = survey(robot, model, measured, fitted=fitted, n=N_DRAWN if readings is None else _N_SAMPLED)
    errors = workspace.errors if readings is None else model.at(readings)
    expected, worst = errors.of(fitted)[:, 0], None
    known = errors.readings[np.isfinite(expected)]
    sampled = known[np.unique(np.linspace(0, len(known) - 1, min(_N_SAMPLED, len(known))).astype(np.int64))]
    named = zip(model.covariance.variables.names, np.diag(model.covariance.named()), strict=False)
    if np.isfinite(expected).any():
        row = int(np.nanargmax(expected)) if readings is not None else None
        there = model.at(_climbed(model, errors, fitted) if row is None else errors.readings[row : row + 1])
        worst = _worst(model, there, fitted, row, bool(workspace.far_from_measured(there.position)[0]))
    return PredictedErrors(
        errors=errors,
        fitted=fitted,
        given=readings is not None,
        far=workspace.far_from_measured(errors.position),
        measured=workspace.measured,
        joints=workspace.joints,
        worst=worst,
        responsible=_responsible(model, sampled, fitted),
        undetermined=tuple(name for name, one in named if np.isnan(one)) if len(known) < len(expected) else (),
        limit=limit,
    )


def _climbed(model: ToolPoseUncertainty, drawn: ToolErrors, fitted: bool) -> Floats:
    """The configuration with the largest error in a random local search from the worst drawn, shape (1, n_joints)."""
    rng, q = np.random.default_rng(0), drawn.readings
    low, high = q.min(axis=0), q.max(axis=0)
    height = np.nan_to_num(drawn.of(fitted)[:, 0], nan=-1.0)
    best = np.argsort(-height, kind="stable")[:_CLIMBERS]
    at, height = q[best], height[best]
    for k in range(_STEPS):
        steps = rng.normal(size=(len(at), _TRIED, q.shape[1])) * (_FIRST_STEP * _SHORTER**k * (high - low))
        tried = np.clip(at[:, None] + steps, low, high)
        found = model.at(tried.reshape(-1, q.shape[1])).of(fitted)[:, 0].reshape(len(at), _TRIED)
        found = np.nan_to_num(found, nan=-1.0)
        most, row = np.argmax(found, axis=1), np.arange(len(at))
        higher = found[row, most] > height
        at = np.where(higher[:, None], tried[row, most], at)
        height = np.where(higher, found[row, most], height)
    return at[[int(np.argmax(height))]]


def _worst(
    model: ToolPoseUncertainty, there: ToolErrors, fitted: bool, row: int | None, far: bool
) -> WorstConfiguration:
    """The error ellipsoid and the responsible parameters at one configuration."""
    v = model.motions(there.readings, fitted=fitted)[0, 3:]
    size, axes = np.linalg.eigh(v @ model.covariance.tangent @ v.T)
    sigma, axes = np.sqrt(np.maximum(size[::-1], 0.0)), axes.T[::-1]
    axes = axes * np.where(axes[np.arange(3), np.argmax(np.abs(axes), axis=1)] < 0.0, -1.0, 1.0)[:, None]
    return WorstConfiguration(
        there, row, axes, sigma, far, _responsible(model, there.readings, fitted, along=axes[0] @ v)
    )


def _responsible(
    model: ToolPoseUncertainty, readings: Floats, fitted: bool, along: Floats | None = None
) -> tuple[Responsible, ...]:
    """The parameters that position errors follow.

    Args:
        model: What is expected of the tool.
        readings: Where the errors are known, shape (n, n_joints).
        fitted: Whether errors count after the best rigid fit.
        along: The error along one direction, in the columns, shape (n_columns,): changes are those that go with it.
    """
    if not len(readings):
        return ()
    posterior, variables = model.covariance, model.covariance.variables
    v = model.motions(readings, fitted=fitted)[:, 3:].reshape(-1, variables.n_columns)
    named = variables.named_derivative(posterior.parameters)[: variables.n_robot_columns]
    with np.errstate(invalid="ignore", divide="ignore"):  # nan: yaw and roll at a pitch of a quarter turn
        covariance = named @ posterior.tangent  # of parameters with the columns
        variance = posterior.variance(named)  # nan: not determined, and so of no part in what is
        total = float(np.einsum("ij,ji->", v @ posterior.tangent, v.T))
        shares = np.square(covariance @ v.T).sum(axis=1) / (variance * total)
        change = None if along is None else covariance @ along / np.sqrt(along @ posterior.tangent @ along)
    order = np.argsort(-np.nan_to_num(shares, nan=-1.0), kind="stable")[:_NAMED].tolist()
    robot, names = variables.robot, variables.names
    return tuple(
        Responsible(
            name=names[i],
            unit=robot.parameters[robot.index(names[i])].unit,
            share=float(shares[i]),
            change=None if change is None else float(change[i]),
        )
        for i in order
        if shares[i] >= _LEAST_SHARE
    )
