"""Residuals of the nominal arm, compared with what noise and prior sigmas let them be.

The nominal arm, its unknown frames, tool and landmarks fitted to the rows, misses what was measured by

    r = J e + n,    its length on average by the root of tr(J T^2 J^T + N)

with J the derivatives in the arm's estimated parameters, T their prior sigmas (`USUAL_LENGTH` and `USUAL_ANGLE` where
there are none) and N the covariance of the noise. The *excess* is the median length over the median expected: medians
are not moved by a few gross errors. What is fitted takes up a part of the arm's errors, so healthy tables have an
excess of a fifth to one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.errors import InputError, ProblemError, SolverError
from fg_calib.graph.build import problem_of_tables
from fg_calib.graph.noise_models import RowNoise
from fg_calib.graph.problem import Problem, noises_at, tables_of
from fg_calib.graph.variables import build_variables, pose_of
from fg_calib.initialization.hand_eye import Frame
from fg_calib.measurements import residuals
from fg_calib.measurements.table import Table
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Options, Pairing
from fg_calib.robot.kinematics import Chain, pose
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]

USUAL_LENGTH, USUAL_ANGLE = 2e-3, 5e-3
"""1 sigma of true minus nominal where a parameter has no prior: 2 mm and 5 mrad (0.3 degrees)."""

MAX_ROWS, MAX_IMAGES, MAX_CORNERS = 60, 20, 8
"""Train configurations that are looked at, spread over the table; images, and corners of each."""

STEPS, HALVINGS = 6, 4
"""Gauss-Newton steps from the start in closed form that suffice where the set-up is right, and halvings of each."""

FARTHEST = 1e6
"""A coordinate beyond all measurements, [m]."""

_UNITS: dict[str, Literal["m", "rad", "px"]] = {"orientation": "rad", "angle": "rad", "pixel": "px"}


@dataclass(frozen=True)
class TypicalResidual:
    """Residuals of one kind of measurement before a calibration.

    Attributes:
        kind: `position`, `orientation`, `distance`, `angle`, `point` or `pixel`.
        unit: `m`, `rad` or `px`.
        size: Median of their lengths, [m], [rad] or [px].
        expected: Median expected from noise and prior sigmas.
        motion: How far the arm moves between these rows: readings that hardly move it show nothing.
        n: Number of measurements.
    """

    kind: str
    unit: Literal["m", "rad", "px"]
    size: float
    expected: float
    motion: float
    n: int

    @property
    def excess(self) -> float:
        """Size over expected size."""
        return self.size / self.expected


@dataclass(frozen=True)
class Setup:
    """Some rows of a table, and what the job says of them.

    Attributes:
        robot: The nominal robot; the parameters of its tool that are estimated are fitted.
        table: The rows; pairs among them.
        of_base: Whether the frame that is fitted as world_T_base is the base, which all tables share.
    """

    robot: Robot
    table: Table
    of_base: bool = False

    @property
    def tool(self) -> tuple[str, ...]:
        """Names of the tool's parameters, in the order x, y, z, yaw, pitch, roll."""
        return tuple(self.robot.parameters[i].name for i in self.robot.owned_by(self.robot.n_joints + 1))

    @property
    def fitted_tool(self) -> frozenset[str]:
        """Names of those of the tool's parameters that are fitted."""
        return frozenset(p.name for p in self.robot.parameters if p.estimated) & frozenset(self.tool)

    @property
    def has_landmarks(self) -> bool:
        """Whether landmarks have to be located before anything can be said of the table."""
        model = self.table.model
        return model not in (*POSE_MODELS, *PAIR_MODELS) or "target" in self.table.measurements.labels

    def with_tool(self, fitted: frozenset[str]) -> Setup:
        """The set-up with these of the tool's parameters fitted."""
        names = [p.name for p in self.robot.parameters if p.estimated and p.name not in self.tool]
        return replace(self, robot=self.robot.with_estimated([*names, *sorted(fitted)]))


class Fitted(NamedTuple):
    """Residuals of a set-up by kind, and the robot (tool fitted) and world_T_base that they are of."""

    residuals: tuple[TypicalResidual, ...]
    robot: Robot
    world_T_base: Frame  # noqa: N815


def setup_of(robot: Robot, table: Table) -> Setup | None:
    """Some train rows of a table as the job says they are; None if the table has no train rows.

    Pairs are formed anew from some of the rows, whatever the job's pairing. Rows of landmarks are drawn at random, for
    rows in turn may be of one target or anchor.
    """
    m, model = table.measurements, table.model
    rows, pairs = np.flatnonzero(~m.test), None
    if model is None or not len(rows):
        return None
    if model in PAIR_MODELS and m.pairs is not None:
        train = np.flatnonzero(~m.pairs.test)
        pairs = m.pairs.select(train[_spread(len(train), 3 * MAX_ROWS)])
    rows = rows if m.groups is None else rows[np.argsort(m.groups.index[rows], kind="stable")]
    if model == "pixels" or "target" in m.labels or model not in (*POSE_MODELS, *PAIR_MODELS):
        rng, names = np.random.default_rng(0), np.unique(m.ids[rows])
        most = MAX_IMAGES if model == "pixels" else max(10, MAX_ROWS * len(names) // len(rows))
        rows = rng.permutation(rows[np.isin(m.ids[rows], rng.permutation(names)[:most])])
        if model == "pixels":  # some corners of each image
            _, image = np.unique(m.ids[rows], return_inverse=True)
            rows = np.concatenate([rows[image == i][:MAX_CORNERS] for i in range(image.max() + 1)])
    elif pairs is None or m.groups is not None:
        rows = rows[_spread(len(rows), MAX_ROWS)]
    else:
        rows = rows[:0]
    rows = np.unique(rows if pairs is None else np.concatenate([rows, pairs.a, pairs.b]))
    groups = None if m.groups is None else replace(m.groups, index=m.groups.index[rows])
    if pairs is not None:
        pairs = replace(pairs, a=np.searchsorted(rows, pairs.a), b=np.searchsorted(rows, pairs.b))
    base = {robot.parameters[i].name for i in robot.owned_by(0) if robot.parameters[i].estimated}
    free = model in POSE_MODELS and table.frame == "known" and bool(base)
    robot = robot.with_estimated([p.name for p in robot.parameters if p.estimated and not (free and p.name in base)])
    some = replace(m.select(rows), pairs=pairs, groups=groups)
    table = replace(table, measurements=some, pairing=Pairing("chain"), own=())
    return Setup(robot, replace(table, frame="unknown") if free else table, of_base=table.frame == "known")


def _spread(n: int, most: int) -> NDArray[np.int64]:
    """At most so many of n numbers, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(most, n)).astype(np.int64))


def nominal_residuals(setup: Setup) -> tuple[TypicalResidual, ...]:
    """Residuals of a set-up by kind, frame, tool and landmarks fitted; empty if there are too few rows, or no fit."""
    return fit_setup(setup).residuals


def residuals_in(setup: Setup, fit: Fitted, *, in_frame: bool = True) -> tuple[TypicalResidual, ...]:
    """Residuals of a set-up by kind with the tool, and the world_T_base, of another fit.

    Args:
        setup: The set-up.
        fit: Tool and world_T_base.
        in_frame: Whether world_T_base is taken; else it is fitted.
    """
    robot, tool = setup.robot, setup.robot.owned_by(setup.robot.n_joints + 1)
    values = robot.nominal
    values[tool] = fit.robot.nominal[tool]
    held = replace(setup, robot=robot.with_values(values)).with_tool(frozenset())
    m, X = setup.table.measurements, fit.world_T_base
    if in_frame and setup.table.model in POSE_MODELS:
        R, p = m.rotation, m.position
        R = None if R is None else X.rotation.T @ R
        p = None if p is None else (p - X.translation) @ X.rotation
        held = replace(held, table=replace(held.table, measurements=replace(m, rotation=R, position=p), frame="known"))
    return fit_setup(held).residuals


def fit_setup(setup: Setup) -> Fitted:
    """Frame, tool and landmarks of a set-up fitted, the arm at nominal."""
    m = setup.table.measurements
    tests = np.ones(m.n_configurations, dtype=np.bool_)  # test rows alone: the arm is evaluated as it is
    pairs = None if m.pairs is None else replace(m.pairs, test=np.ones(m.pairs.n_pairs, dtype=np.bool_))
    table = replace(setup.table, measurements=replace(m, test=tests, pairs=pairs)).by_itself()
    nothing = Fitted((), setup.robot, Frame(np.eye(3), np.zeros(3)))
    try:
        problem = problem_of_tables(setup.robot, tables_of(table, options := Options(gauge="none")), options)
        start = problem.start
        direct = setup.table.model in POSE_MODELS and not setup.has_landmarks
        parameters = start if direct else fit_landmarks(problem)
    except (InputError, ProblemError, SolverError, RuntimeError, np.linalg.LinAlgError):
        return nothing
    found = residuals_at(problem, parameters, setup.robot)
    n_free = problem.variables.n_columns + problem.variables.n_nuisance
    if problem.n_residuals < 2 * n_free + 6 + setup.has_landmarks * n_free:
        found = ()
    frame = nothing.world_T_base
    for v in problem.variables.frames:
        X = pose_of(parameters[v.places])
        frame = Frame(X.rotation().matrix(), X.translation())
    return Fitted(found, setup.robot.with_values(parameters[problem.variables.robot_span]), frame)


def residuals_at(
    problem: Problem, parameters: Floats, robot: Robot, table: int | None = None
) -> tuple[TypicalResidual, ...]:
    """Residuals by kind at a parameter vector.

    Args:
        problem: The problem; at most `3 * MAX_ROWS` rows of a series are looked at.
        parameters: The parameter vector.
        robot: The robot with what is estimated of the arm.
        table: Number of the table that is asked for; all if None.
    """
    series = [s for s in problem.data.series if table is None or s.table == table]
    series = [
        s for s in series if len(s.train) and s.kind.ends
    ]  # rows of landmarks alone have none of the arm's errors
    some = tuple(s.select(s.train[_spread(len(s.train), 3 * MAX_ROWS)]) for s in series)
    sampled = replace(problem, data=replace(problem.data, series=some))
    variables = build_variables(robot, [t.unknown_frame for t in problem.data.tables])
    of_arm, of_frame = problem.variables.robot_span, problem.variables.frame_span
    values = np.concatenate([parameters[of_arm], parameters[of_frame]])
    scale = prior_sigmas_of(robot, variables.names)
    found: list[TypicalResidual] = []
    for noise in noises_at(sampled, parameters):
        chain = variables.chains[noise.series.table].at(values)
        found += _by_kind(noise, chain, scale, robot.with_values(parameters[of_arm]))
    return tuple(found) if all(np.isfinite([r.size, r.expected]).all() for r in found) else ()


def fit_landmarks(problem: Problem) -> Floats:
    """The parameter vector with frames, tool and landmarks fitted to the rows, whitened as at the start.

    Args:
        problem: A problem of the arm as it is (see `Problem.evaluated`).
    """
    variables, values = problem.variables, problem.initial
    parameters = variables.parameters(values)

    def cost(at: Floats) -> float:
        return sum(rows.squared_norm(variables.at(at)) for rows in problem.rows)

    least = cost(parameters)
    for _ in range(STEPS if variables.n_columns + variables.n_nuisance else 0):
        found = [rows.linearise(variables.at(parameters)) for rows in problem.rows]
        r, J = (np.concatenate(parts) for parts in zip(*found, strict=True))
        size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        step = -np.linalg.lstsq(J / size, r, rcond=1e-10)[0] / size
        before = least
        for _ in range(HALVINGS):
            moved = variables.moved(values, step)
            at = variables.parameters(moved)
            if np.abs(at).max() < FARTHEST and (left := cost(at)) < least:
                values, parameters, least = moved, at, left
                break
            step = 0.5 * step
        if not least < (1.0 - 1e-3) * before:
            break
    return parameters


def prior_sigmas_of(robot: Robot, names: tuple[str, ...]) -> Floats:
    """1 sigma of the arm's parameters in the order of the columns, 0 of those that were fitted, shape (n_columns,)."""
    scale, by_name = np.zeros(len(names)), {p.name: p for p in robot.parameters}
    for column, name in enumerate(names):
        p = by_name.get(name)
        if p is not None and 1 <= p.owner <= robot.n_joints:
            usual = USUAL_LENGTH if p.unit == "m" else USUAL_ANGLE
            scale[column] = usual if p.tolerance is None else p.tolerance
    return scale


def _by_kind(noise: RowNoise, chain: Chain, scale: Floats, robot: Robot) -> list[TypicalResidual]:
    """Residuals of one series, by kind of noise.

    Args:
        noise: Its rows and their noise.
        chain: The chain with columns for all that is estimated of the arm.
        scale: 1 sigma of each column.
        robot: The robot, tool and base fitted.
    """
    kinds = np.array([name.partition(".")[0] for name in noise.series.kind.names])
    r, J = residuals.linearise(noise.rows, chain)
    variance = np.sum((J[:, :, : len(scale)] * scale) ** 2, axis=2) + noise.sigma**2
    used, found = noise.series.used, []
    for kind in dict.fromkeys(kinds.tolist()):
        of = (kinds == kind) & used.any(axis=0)
        rows = used[:, of].any(axis=1)
        if rows.any():
            size, expected = (
                float(np.median(np.sqrt(np.where(used, v, 0.0)[:, of].sum(axis=1)[rows]))) for v in (r**2, variance)
            )
            unit, motion = _UNITS.get(kind, "m"), _motion(noise, kind, robot)
            found.append(TypicalResidual(kind, unit, size, max(expected, 1e-9), motion, int(rows.sum())))
    return found


def _motion(noise: RowNoise, kind: str, robot: Robot) -> float:
    """How far the arm, or a point's image, typically moves between the rows of a series, [m], [rad] or [px]."""
    m = noise.place.measurements
    if kind == "pixel" and m.image is not None:
        points = m.image[:, :2]
    else:
        ends = np.unique(noise.series.ends) if noise.series.ends.size else np.arange(m.n_configurations)
        at = pose(robot, m.readings[ends])
        if kind in ("orientation", "angle"):
            return float(np.median(Rotation.from_matrix(at.rotation[0].T @ at.rotation).magnitude()))
        points = at.position
    return float(np.median(np.linalg.norm(points - points.mean(axis=0), axis=1)))
