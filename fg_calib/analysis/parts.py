"""One table of very many rows, in parts: each is reduced where it is, and the sum is that of the whole table.

With `[J r] = Q R` the whitened rows of a part, R (n_columns + 1 rows, 10 kB for 35 parameters) holds all that they say
at a parameter vector. Rows of different parts share no errors, so the R of all parts, one below the other, are what the
R of the whole table is: `R^T R = sum of R_k^T R_k`. Rows are whitened at the parameters that they are linearised at, so
Gauss-Newton steps on the sum end where `J^T C^-1 r = 0`, as `solve` does.

The parts, not the workers, say what is added to what, and in which order: any number of workers gives the same bits.

Which rows share no errors: pairs that were measured directly, without noise of the joint readings (which two pairs of
one configuration would share); and poses, a frame for all of them unknown or not. Pairs that are formed of poses share
these. All pairs of some poses hold what the poses hold in an unknown frame, so those are what to cut.

References:
    Golub, Plemmons, Sameh (1988), Parallel block schemes for large-scale least-squares computations. In High-Speed
    Computing: Scientific Applications and Algorithm Design: the reduction of blocks, each by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.analysis.covariance import TangentCovariance
from fg_calib.arguments import checked
from fg_calib.arrays import Brief, FrozenArrays
from fg_calib.errors import InputError, ProblemError, shown
from fg_calib.executors import Failure, map_jobs
from fg_calib.graph.factors import Variables, build_variables, prior_rows
from fg_calib.graph.information import row_triangles
from fg_calib.graph.observability import determined
from fg_calib.graph.problem import problem_at, variables_of
from fg_calib.graph.solver import NEAR_ENOUGH, SolverOptions
from fg_calib.graph.start import start_of
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.gathering import gather
from fg_calib.measurements.series import Table
from fg_calib.options import POSE_MODELS, Options, check_number
from fg_calib.robot.model import Robot
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]

Part = Measurements | Callable[[], Measurements]
"""Some rows of a table, or a function that reads them where they are reduced."""

ROWS = 200_000
"""Rows of a part."""

HALVINGS = 6
"""How often a step that raises the cost is halved."""


@dataclass(frozen=True)
class Reduced(FrozenArrays):
    """What rows say at a parameter vector.

    Attributes:
        triangle: R with `R^T R = [J r]^T [J r]` of the whitened rows, shape (n_columns + 1, n_columns + 1).
        n_residuals: Number of scalar rows.
    """

    triangle: Floats
    n_residuals: int


@dataclass(frozen=True)
class PartsSolution(Brief):
    """A calibration of a table in parts.

    Attributes:
        robot: The calibrated robot.
        parameters: The parameter vector (see `Variables`).
        posterior: The covariance.
        reduced: What the rows of all parts say at the estimate; their number.
        chi2: Sum of squared whitened residuals and priors.
        converged: Whether the optimum was reached.
        iterations: Number of steps.
        decrement: How far the optimum still is, [sigma].
    """

    robot: Robot
    parameters: Floats
    posterior: TangentCovariance
    reduced: Reduced
    chi2: float
    converged: bool
    iterations: int
    decrement: float

    @property
    def sigma(self) -> dict[str, float]:
        """1 sigma of the estimated parameters by name, [m] and [rad]; nan where nothing determines it."""
        v = self.posterior.variables
        return dict(zip(v.names, np.sqrt(np.diag(self.posterior.named())).tolist(), strict=False))


@checked
def cut(measurements: Measurements, n_rows: int = ROWS) -> tuple[Measurements, ...]:
    """The train rows of a table in parts: its pairs, if any were measured directly, else its poses.

    Args:
        measurements: The table.
        n_rows: Rows of a part, but for the last.
    """
    check_number("n_rows", n_rows, above=True, whole=True)
    m, pairs = measurements, measurements.pairs
    if pairs is None:
        train = np.flatnonzero(~m.test)
        return tuple(m.select(train[k : k + n_rows]) for k in range(0, len(train), n_rows))
    train = np.flatnonzero(~pairs.test)
    parts = []
    for k in range(0, len(train), n_rows):
        chosen = pairs.select(train[k : k + n_rows])
        there, ends = np.unique(np.concatenate([chosen.a, chosen.b]), return_inverse=True)
        a, b = np.split(ends.ravel(), 2)
        parts.append(replace(m.select(there), pairs=replace(chosen, a=a, b=b)))
    return tuple(parts)


@checked
def reduce_parts(
    robot: Robot,
    parts: Sequence[Part],
    parameters: Floats,
    options: Options | None = None,
    executor: Executor | None = None,
    **choices: Any,
) -> Reduced:
    """What the rows of all parts say at a parameter vector, each reduced where the executor has it done.

    Args:
        robot: The nominal robot.
        parts: The parts, from `cut` for example.
        parameters: The parameter vector (see `Variables`).
        options: Which measurements take part.
        executor: Where the parts are reduced; in this process if None.
        choices: Instead of `options`, any of theirs as keywords.

    Raises:
        InputError: An option makes no sum of parts.
        ProblemError: Rows of a part share errors with those of others, or cannot be used.
    """
    options = Options.given(options, choices)
    _check_options(options)
    return _reduce(_Task(robot, options, parameters), parts, executor)


@checked
def solve_parts(
    robot: Robot,
    parts: Sequence[Part],
    options: Options | None = None,
    executor: Executor | None = None,
    solver: SolverOptions | None = None,
    **choices: Any,
) -> PartsSolution:
    """Calibrate from a table in parts, each reduced where the executor has it done.

    Args:
        robot: The nominal robot.
        parts: The parts, from `cut` for example.
        options: What is estimated from what: a model of poses, or of pairs that were measured directly.
        executor: Where the parts are reduced; in this process if None.
        solver: Settings of the solver.
        choices: Instead of `options`, any of theirs as keywords.

    Raises:
        InputError: An option makes no sum of parts, or there is no part.
        ProblemError: Rows of a part share errors with those of others, or cannot be used.

    Note:
        It is for numbers: no residual is kept, and no outlier, mistake or other optimum looked for. Calibrate some
        parts with `calibrate` to see whether the model fits.
    """
    options, solver = Options.given(options, choices), solver or SolverOptions()
    _check_options(options)
    if not len(parts):
        raise InputError("parts", "none", "at least one")
    variables = build_variables(robot, [options.unknown_frame], options.has_priors)
    start = variables.nominal()
    if options.unknown_frame:  # as the first part has it
        (found,) = map_jobs(_start, [(robot, options, parts[0])], executor, names=["part 1"])
        start = _checked(found)

    def at(parameters: Floats) -> _At:
        return _At(variables, parameters, _reduce(_Task(robot, options, parameters), parts, executor))

    here, n_steps = at(start), 0
    while here.decrement > solver.decrement and n_steps < solver.max_iterations:
        n_steps += 1
        there = _stepped(here, at)
        if there is None:
            break
        here = there
    return PartsSolution(
        robot=robot.with_values(here.parameters[variables.robot_span]),
        parameters=here.parameters,
        posterior=here.posterior,
        reduced=here.reduced,
        chi2=here.chi2,
        converged=here.decrement <= NEAR_ENOUGH,
        iterations=n_steps,
        decrement=here.decrement,
    )


def _stepped(here: _At, at: Callable[[Floats], _At]) -> _At | None:
    """Where a Gauss-Newton step leads, or a part of it; None if none comes nearer to the optimum."""
    for k in range(HALVINGS):
        there = at(here.variables.stepped(here.parameters, here.step * 0.5**k))
        if there.decrement < here.decrement or there.chi2 < here.chi2 - 1e-9 * here.chi2:
            return there
    return None


class _At:
    """All parts and the priors at a parameter vector, decomposed: the step to the optimum, and how far that is."""

    def __init__(self, variables: Variables, parameters: Floats, reduced: Reduced) -> None:
        self.variables, self.parameters, self.reduced = variables, parameters, reduced
        r, J = prior_rows(variables, parameters)
        rows = _upper([reduced.triangle, np.column_stack([J, r])], variables.n_columns + 1)
        scales = variables.prior_scales
        with one_blas_thread:
            U, s, Vt = np.linalg.svd(rows[:, :-1] * scales, full_matrices=False)
        rank = determined(s)
        along = -(U[:, :rank].T @ rows[:, -1])
        directions = Vt * scales
        self.step: Floats = directions[:rank].T @ (along / s[:rank])
        self.decrement = float(np.linalg.norm(along))
        self.chi2 = float(rows[:, -1] @ rows[:, -1])
        half = directions[:rank].T / s[:rank]
        loose, _ = np.linalg.qr((directions[rank:] / variables.scales).T)
        self.posterior = TangentCovariance(variables, parameters, half @ half.T, loose.T, loose.T)


@dataclass(frozen=True)
class _Task:
    """What is done with every part."""

    robot: Robot
    options: Options
    parameters: Floats

    def __call__(self, part: Part) -> Reduced:
        options = self.options
        data = gather(self.robot, (_table(part, options),))
        variables = variables_of(self.robot, data, options)
        with one_blas_thread:
            problem = problem_at(self.robot, data, options, variables, self.parameters)
            triangle = _upper(row_triangles(problem, self.parameters), variables.n_columns + 1)
        return Reduced(triangle, problem.n_residuals)


def _start(task: tuple[Robot, Options, Part]) -> Floats:
    """The start that a part has."""
    robot, options, part = task
    data = gather(robot, (_table(part, options),))
    return start_of(robot, data, variables_of(robot, data, options))


def _reduce(task: _Task, parts: Sequence[Part], executor: Executor | None) -> Reduced:
    names = [f"part {k + 1}" for k in range(len(parts))]
    found = [_checked(one) for one in map_jobs(task, parts, executor, names=names, what="reducing parts")]
    n_all = build_variables(task.robot, [task.options.unknown_frame], False).n_columns + 1
    return Reduced(_upper([one.triangle for one in found], n_all), sum(one.n_residuals for one in found))


def _checked(found: Any) -> Any:
    if isinstance(found, Failure):
        if found.trace:
            raise found.error()
        raise ProblemError("parts", f"{found.job}: {found.reason}")
    return found


def _upper(blocks: Sequence[Floats], n: int) -> Floats:
    """R of a QR of blocks one below the other, shape (n, n)."""
    with one_blas_thread:
        R: Floats = np.linalg.qr(np.vstack([*blocks, np.zeros((n, n))]), mode="r")  # type: ignore[assignment]
    return R


def _table(part: Part, options: Options) -> Table:
    """A part as a table of which no row shares errors with another's.

    Raises:
        InputError: It is no table, or one whose rows do.
    """
    m = part if isinstance(part, Measurements) else part()
    if not isinstance(m, Measurements):
        raise InputError("part", f"found {shown(m)}", "measurements, or a function that reads some")
    if m.labels or m.groups is not None:
        found = "targets, stations, anchors or touched points, which rows of all parts are of"
        raise InputError(m.source, found, "poses, or pairs that were measured directly")
    if options.uses_pairs and m.pairs is None:
        hint = "model: pose with frame: unknown holds what all pairs of the poses hold"
        raise InputError(m.source, "pairs formed of poses, whose errors they share", "pairs measured directly", hint)
    if options.uses_pairs and np.any(m.sigma_joint > 0.0) and options.pair_errors == "shared":
        found = "joint noise, which pairs of one configuration share"
        raise InputError(m.source, found, "noise: joint: 0, or pair_errors: independent")
    return Table(m, options.model, options.pairing, options.frame)


def _check_options(options: Options) -> None:
    """Whether the sum over parts is that of the whole table."""
    if options.model not in POSE_MODELS and not options.uses_pairs:
        raise InputError("model", f"found {options.model}", "one of poses or pairs")
    for name, only in (("loss", "none"), ("encoder", "propagated"), ("estimate_noise", False)):
        if getattr(options, name) != only:
            raise InputError(name, f"found {shown(getattr(options, name))}", f"{only}: parts are reduced once each")
    if options.gauge == "keep" or options.estimate_tolerance is not None:
        raise InputError("gauge", "keep, or estimated tolerances", "prior or none: parts are reduced once each")
