"""What to expect of a calibrated arm: how far off its tool is at given configurations, or over the workspace.

Where the error is largest it has a covariance of its own, v Cov v^T, whose axes say in which direction. *Responsible*
for it are the parameters whose errors it follows: if parameter i were known exactly, the expected square would fall by
the share sum_k cov(e_k, p_i)^2 / (var(p_i) sum_k var(e_k)), the sum being over the coordinates of the error. Shares of
correlated parameters overlap, so they need not add to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.prediction.tool_pose import ToolErrorModel, ToolErrors
from fg_calib.prediction.workspace import N_DRAWN, JointRange, survey
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

QUANTILES: Mapping[str, float] = {"median": 0.5, "p95": 0.95, "largest": 1.0}
"""What errors are summed up by."""

_NAMED = 5
"""Parameters that are named as responsible, at most."""

_LEAST_SHARE = 0.05
"""What a parameter is responsible for at least, if it is named."""

_CLIMBERS, _STEPS, _TRIED, _FIRST_STEP, _SHORTER = 6, 14, 50, 0.2, 0.7
"""To find the largest error: configurations that it is looked for from, steps, what each tries, 1 sigma of the first
step in the range of each joint, and how the steps shrink."""

_SOME = 1000
"""Configurations of the workspace by which its radius, or what is responsible for its errors, is told."""


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
        limit: What position errors are held to, [m]; None without any.
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
        """Errors as they count, position [m] and orientation [rad], shape (n, 2); nan where they are not known."""
        return self.errors.of(self.fitted)

    @property
    def with_joint_noise(self) -> Floats | None:
        """The same with errors of the joint readings; None where their noise is not known."""
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
    model: ToolErrorModel,
    measured: Floats,
    readings: Floats | None = None,
    *,
    fitted: bool,
    limit: float | None = None,
) -> PredictedErrors:
    """Expected errors at configurations, or all over the workspace, and where they are largest.

    Args:
        robot: The calibrated robot, with its limits.
        model: What is expected of its tool.
        measured: Readings of the measured configurations, shape (m, n_joints), [rad] (prismatic: [m]).
        readings: The configurations, shape (n, n_joints); drawn all over the workspace if None.
        fitted: Whether errors count after the best rigid fit.
        limit: What position errors are held to, [m].
    """
    workspace = survey(robot, model, measured, fitted=fitted, n=N_DRAWN if readings is None else _SOME)
    errors = workspace.errors if readings is None else model.at(readings)
    expected, worst = errors.of(fitted)[:, 0], None
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
        responsible=_responsible(model, _some(errors, expected), fitted),
        undetermined=_undetermined(model) if np.isnan(expected).any() else (),
        limit=limit,
    )


def _some(errors: ToolErrors, expected: Floats) -> Floats:
    """Some configurations where the error is known, evenly taken."""
    known = errors.readings[np.isfinite(expected)]
    evenly: Floats = known[np.unique(np.linspace(0, len(known) - 1, min(_SOME, len(known))).astype(np.int64))]
    return evenly


def _climbed(model: ToolErrorModel, drawn: ToolErrors, fitted: bool) -> Floats:
    """The configuration with the largest error found by a random search from the worst that were drawn.

    Shape (1, n_joints). A larger one may be between them; it is a local search.
    """
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


def _worst(model: ToolErrorModel, there: ToolErrors, fitted: bool, row: int | None, far: bool) -> WorstConfiguration:
    """What one configuration's error is made of."""
    _, motion = model.motions(there.readings, fitted=fitted)
    v = motion[0, 3:]
    size, axes = np.linalg.eigh(v @ model.spread.tangent @ v.T)
    sigma, axes = np.sqrt(np.maximum(size[::-1], 0.0)), axes.T[::-1]
    axes = axes * np.where(axes[np.arange(3), np.argmax(np.abs(axes), axis=1)] < 0.0, -1.0, 1.0)[:, None]
    return WorstConfiguration(
        there, row, axes, sigma, far, _responsible(model, there.readings, fitted, along=axes[0] @ v)
    )


def _responsible(
    model: ToolErrorModel, readings: Floats, fitted: bool, along: Floats | None = None
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
    spread, variables = model.spread, model.spread.variables
    _, motion = model.motions(readings, fitted=fitted)
    v = motion[:, 3:].reshape(-1, variables.n_columns)
    named = variables.named_derivative(spread.parameters)[: variables.n_robot_columns]
    with np.errstate(invalid="ignore", divide="ignore"):  # nan: yaw and roll at a pitch of a quarter turn
        covariance = named @ spread.tangent  # of parameters with the columns
        variance = spread.variance(named)  # nan: not determined, and so of no part in what is
        total = float(np.einsum("ij,ji->", v @ spread.tangent, v.T))
        shares = np.square(covariance @ v.T).sum(axis=1) / (variance * total)
        change = None if along is None else covariance @ along / np.sqrt(along @ spread.tangent @ along)
    order = np.argsort(-np.nan_to_num(shares, nan=-1.0), kind="stable")[:_NAMED].tolist()
    units = {p.name: p.unit for p in variables.robot.parameters}
    return tuple(
        Responsible(variables.names[i], units[variables.names[i]], float(shares[i]), _float(change, i))
        for i in order
        if shares[i] >= _LEAST_SHARE
    )


def _float(values: Floats | None, i: int) -> float | None:
    return None if values is None else float(values[i])


def _undetermined(model: ToolErrorModel) -> tuple[str, ...]:
    """Parameters that nothing determines."""
    names = model.spread.variables.names
    return tuple(name for name, one in zip(names, np.diag(model.spread.named()), strict=False) if np.isnan(one))
