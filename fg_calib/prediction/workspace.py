"""Expected errors of a calibrated arm's tool at given configurations, or over the workspace.

Over the workspace, configurations are drawn evenly within the joint limits; the expected error at each is that of
`tool_pose`. Where it is largest, it has a covariance v Cov v^T of its own, whose axes give its direction. *Responsible*
for it are the parameters whose errors it follows: if parameter i were known exactly, its expected square would fall by
the share sum_k cov(e_k, p_i)^2 / (var(p_i) sum_k var(e_k)), summed over the coordinates of the error. Shares of
correlated parameters overlap, so they need not add to 1.
"""

from collections.abc import Mapping
from dataclasses import field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from fg_calib.inputs import Booleans, Floats, FrozenArrays, Record
from fg_calib.prediction.tool_pose import ToolErrors, ToolPoseUncertainty
from fg_calib.robot import Context, Robot, context_at, pose, random_readings, unit_of
from fg_calib.statistics import TangentCovariance

QUANTILES: Mapping[str, float] = {"median": 0.5, "p95": 0.95, "largest": 1.0}
"""Statistics by which errors are summarised."""

_NAMED = 5
"""Parameters that are named as responsible, at most."""

_LEAST_SHARE = 0.05
"""Share from which a parameter is named as responsible."""

N_DRAWN = 12_000
"""Configurations that are drawn."""

FAR = 0.15
"""Distance from the nearest measured position, in the radius of the workspace, beyond which nothing was measured."""

_N_SAMPLED = 1000
"""Configurations that give the radius of the workspace where configurations are given."""


class Responsible(Record):
    """A parameter that an error follows.

    Attributes:
        name: Its name.
        unit: `m` or `rad`.
        share: Of the expected square of the position error, by how much it would fall were this one known, 0 to 1.
        change: Its error that goes with one sigma along the longest axis of the error.
    """

    name: str
    unit: str
    share: float
    change: float


class WorstConfiguration(FrozenArrays):
    """Configuration with the largest expected position error, as far as known.

    Attributes:
        errors: Expected there, of one configuration.
        row: Its row among the configurations that were given; None among drawn ones.
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


class PredictedErrors(FrozenArrays):
    """Expected errors of the tool of a calibrated arm.

    Attributes:
        model: Expected error of the tool.
        errors: Configuration by configuration.
        fitted: Whether they count after the best rigid fit of what was measured, because nothing was measured in the
            base frame; else in the base frame.
        given: Whether the configurations were given; else they were drawn all over the workspace.
        far: Whether no measured position is near each of them, shape (n,).
        measured: Where the tool was measured, shape (m, 3), [m].
        limit: Largest allowed position error, [m]; None without any.
        context: What effects depend on besides: see `Robot.trig`.
    """

    model: ToolPoseUncertainty
    errors: ToolErrors
    fitted: bool
    given: bool
    far: Booleans
    measured: Floats
    limit: float | None
    context: Context = field(default_factory=dict)

    @cached_property
    def worst(self) -> WorstConfiguration | None:
        """Configuration with the largest error; None where it is known nowhere."""
        return None if self.unknown == 1.0 else _worst(self, int(np.nanargmax(self.expected[:, 0])))

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters that neither measurements nor priors determine, if some errors depend on them."""
        covariance = self.model.covariance
        variances = zip(covariance.variables.names, np.diag(covariance.named()), strict=False)
        return tuple(name for name, variance in variances if np.isnan(variance)) if self.unknown else ()

    @property
    def expected(self) -> Floats:
        """Position [m] and orientation [rad] errors in the frame that counts, shape (n, 2); nan where unknown."""
        return self.errors.fitted if self.fitted else self.errors.base

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
    found: dict[str, float | None] = {"rms": float(np.sqrt(np.mean(errors**2))) if np.isfinite(errors).all() else None}
    ordered = np.where(np.isnan(errors), np.inf, errors)
    for name, share in QUANTILES.items():
        value = float(np.quantile(ordered, share, method="higher"))
        found[name] = value if np.isfinite(value) else None
    return found


def predict_errors(
    robot: Robot,
    posterior: TangentCovariance,
    measured: Floats,
    readings: Floats | None = None,
    *,
    fitted: bool,
    sigma_joint: Floats | None = None,
    limit: float | None = None,
    context: Context | None = None,
) -> PredictedErrors:
    """Expected errors at configurations, or all over the workspace, and where they are largest.

    In the workspace a revolute joint without limits rotates by +-180 degrees, a prismatic one slides by +-1 m.

    Args:
        robot: The calibrated robot, with its limits.
        posterior: The covariance of its parameters.
        measured: Readings of the measured configurations, shape (m, n_joints), [rad] (prismatic: [m]).
        readings: The configurations, shape (n, n_joints); drawn all over the workspace if None.
        fitted: Whether errors count after the best rigid fit.
        sigma_joint: Of joint readings, shape (n_joints,), [rad] (prismatic: [m]); None where it is not known.
        limit: Largest allowed position error, [m].
        context: What effects depend on besides at given configurations: see `Robot.trig`.
    """
    model = ToolPoseUncertainty.of(posterior, measured, sigma_joint)
    n, rng = N_DRAWN if readings is None else _N_SAMPLED, np.random.default_rng(0)
    drawn = random_readings(robot, n, rng)
    errors = model.at(drawn if readings is None else readings, context)
    points = errors.position if readings is None else pose(robot, drawn).position
    radius = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    measured_points = pose(robot, measured).position
    far = np.asarray(cKDTree(measured_points).query(errors.position)[0]) > FAR * radius
    return PredictedErrors(model, errors, fitted, readings is not None, far, measured_points, limit, context or {})


def _worst(found: PredictedErrors, row: int) -> WorstConfiguration:
    """The error ellipsoid and the responsible parameters at one configuration."""
    model, there = found.model, context_at(found.context, slice(row, row + 1))
    errors = model.at(found.errors.readings[row : row + 1], there)
    v = model.motions(errors.readings, there, fitted=found.fitted)[0, 3:]
    size, axes = np.linalg.eigh(model.covariance.covariance(v))
    sigma, axes = np.sqrt(np.maximum(size[::-1], 0.0)), axes.T[::-1]
    axes = axes * np.where(axes[np.arange(3), np.argmax(np.abs(axes), axis=1)] < 0.0, -1.0, 1.0)[:, None]
    responsible = _responsible(model.covariance, v, axes[0] @ v)
    return WorstConfiguration(errors, row if found.given else None, axes, sigma, bool(found.far[row]), responsible)


def _responsible(posterior: TangentCovariance, v: Floats, along: Floats) -> tuple[Responsible, ...]:
    """The parameters that a position error follows.

    Args:
        posterior: The covariance.
        v: The error as rows of the covariance, shape (3, m).
        along: The same along one direction, shape (m,): changes are those that go with it.
    """
    variables, curves = posterior.variables, posterior.curves.reshape(-1, v.shape[1])
    named = variables.named_derivative(posterior.parameters)[: variables.n_robot_columns]
    named = np.vstack([np.pad(named, ((0, 0), (0, len(curves)))), curves])
    names = (*variables.names[: variables.n_robot_columns], *posterior.curve_names)
    with np.errstate(invalid="ignore", divide="ignore"):  # nan: yaw and roll at a pitch of a quarter turn
        of_core, own = np.split(named, [len(posterior.tangent)], axis=1)
        covariance = np.hstack([of_core @ posterior.tangent, own])  # of parameters with the columns
        variance = posterior.variance(named)  # nan: not determined, and so of no part in what is
        shares = np.square(covariance @ v.T).sum(axis=1) / (variance * posterior.variance(v).sum())
        changes = covariance @ along / np.sqrt(posterior.variance(along[None]))
    order = np.argsort(-np.nan_to_num(shares, nan=-1.0), kind="stable")[:_NAMED].tolist()
    chosen = [(names[i], i) for i in order if shares[i] >= _LEAST_SHARE]
    return tuple(Responsible(name, unit_of(name), float(shares[i]), float(changes[i])) for name, i in chosen)
