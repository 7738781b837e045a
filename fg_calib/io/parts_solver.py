"""One table of very many rows, in parts: each is reduced where it is, and the sum is that of the whole table.

With `[J r] = Q R` the whitened rows of a part, R (n_columns + 1 rows, 10 kB for 35 parameters) holds all that they say
at a parameter vector. Rows of different parts share no errors, so the R of all parts, one below the other, are what the
R of the whole table is: `R^T R = sum of R_k^T R_k`. Rows are whitened at the parameters that they are linearised at, so
Gauss-Newton steps on the sum end where `J^T C^-1 r = 0`, as `solve` does. All parts are read anew for every step. So
the last step is taken without looking at its end, where the steps before say that nothing will be left to go there.

The parts, not the workers, say what is added to what, and in which order: any number of workers gives the same bits.

Which rows share no errors: pairs that were measured directly, without noise of the joint readings (which two pairs of
one configuration would share); and poses, a frame for all of them unknown or not. Pairs that are formed of poses share
these. All pairs of some poses hold what the poses hold in an unknown frame, so those are what to cut.

References:
    Golub, Plemmons, Sameh (1988), Parallel block schemes for large-scale least-squares computations. In High-Speed
    Computing: Scientific Applications and Algorithm Design: the reduction of blocks, each by itself.
"""

from __future__ import annotations

import time
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.arguments import checked
from fg_calib.arrays import Brief, FrozenArrays, as_floats
from fg_calib.errors import InputError, ProblemError, shown
from fg_calib.executors import Failure, map_jobs
from fg_calib.graph.factors import Variables, build_variables, prior_rows
from fg_calib.graph.noise import RowNoise
from fg_calib.graph.normal_system import determined
from fg_calib.graph.problem import Problem, noises_at, start_of, unassembled, variables_of
from fg_calib.graph.rows import whitened_rows
from fg_calib.graph.solver import NEAR_ENOUGH, Iteration, SolverOptions, options_of
from fg_calib.measurements.build import build_dataset
from fg_calib.measurements.dataset import Measurements, joined
from fg_calib.measurements.table import Table
from fg_calib.options import POSE_MODELS, Limits, Options, check_number
from fg_calib.robot.model import Robot
from fg_calib.statistics.covariance import TangentCovariance, held_frames
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

Part = Measurements | Callable[[], Measurements]
"""Some rows of a table, or a function that reads them where they are reduced."""

ROWS = 200_000
"""Rows of a part."""

HALVINGS = 6
"""How often a step that raises the cost is halved."""

STARTED_FROM = 100
"""Rows of each part that frame and tool are started from."""


@dataclass(frozen=True)
class Reduced(FrozenArrays):
    """What rows say at a parameter vector.

    Attributes:
        triangle: R with `R^T R = [J r]^T [J r]` of the whitened rows, shape (n_columns + 1, n_columns + 1).
        n_residuals: Number of scalar rows.
        n_measurements: Number of pairs or poses that give at least one.
        squares: By kind of noise the number of measurements, and the sum of their squared residuals, [m^2] or [rad^2].
        n_excluded: Number of measurements that take no part, by reason.
        fitted: Of pairs, by the CRC-32 of the ids of a table of configurations, which of these they are of: one a bit.
    """

    triangle: Floats
    n_residuals: int
    n_measurements: int = 0
    squares: Mapping[str, tuple[int, float]] = field(default_factory=dict)
    n_excluded: Mapping[str, int] = field(default_factory=dict)
    fitted: Mapping[int, NDArray[np.uint8]] = field(default_factory=dict)

    @property
    def n_configurations(self) -> int | None:
        """Number of configurations that rows are of; None of pairs whose parts have tables of their own of these."""
        if len(self.fitted) > 1:
            return None
        return (
            sum(int(np.unpackbits(bits).sum()) for bits in self.fitted.values()) if self.fitted else self.n_measurements
        )

    @property
    def rms(self) -> dict[str, float]:
        """By kind of noise the RMS of the length of a measurement's residuals, [m] or [rad]."""
        return {kind: float(np.sqrt(total / n)) for kind, (n, total) in self.squares.items() if n}


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
        decrement: How far the optimum still is, [sigma]; after a last step that was not looked at as it is expected.
        rank: Number of directions that data and priors determine.
        start: The parameter vector that it started from, the arm at nominal.
        at_start: What the rows of all parts say there.
        history: Its steps.
        seconds: Time taken.
        options: What was estimated from what.
    """

    robot: Robot
    parameters: Floats
    posterior: TangentCovariance
    reduced: Reduced
    chi2: float
    converged: bool
    iterations: int
    decrement: float
    rank: int
    start: Floats
    at_start: Reduced
    history: tuple[Iteration, ...]
    seconds: float
    options: Options

    @property
    def message(self) -> str:
        """Why it ended."""
        if self.converged:
            return f"converged: less than {max(self.decrement, SolverOptions().decrement):.0e} sigma from the optimum"
        return f"not converged: {self.decrement:.3g} sigma are left after {self.iterations} steps"

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
    return tuple(_with_pairs(m, train[k : k + n_rows]) for k in range(0, len(train), n_rows))


def _with_pairs(m: Measurements, rows: Integers) -> Measurements:
    """Some of a table's pairs, and the configurations that they are of."""
    assert m.pairs is not None
    chosen = m.pairs.select(rows)
    there, ends = np.unique(np.concatenate([chosen.a, chosen.b]), return_inverse=True)
    a, b = np.split(ends.ravel(), 2)
    return replace(m.select(there), pairs=replace(chosen, a=a, b=b))


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
        parameters: The parameter vector, shape (n_parameters + 6,): the robot's, then those of the measurement frame,
            also where that is known (see `Variables`).
        options: Which measurements take part.
        executor: Where the parts are reduced; in this process if None.
        choices: Instead of `options`, any of theirs as keywords.

    Raises:
        InputError: An option makes no sum of parts.
        ProblemError: Rows of a part share errors with those of others, or cannot be used.
    """
    options = Options.given(options, choices)
    _check_options(options)
    n = len(robot.parameters) + 6
    at = as_floats("parameters", parameters, f"({n})")
    return _reduce(_Task(robot, options, at), parts, executor)


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
        ProblemError: Rows of a part share errors with those of others, or cannot be used; or there is no train row.

    Note:
        Rows that the parameters' own uncertainty bends are taken as if it did not (`solve` counts that as noise).
        It is for numbers: no residual is kept, and no outlier, mistake or other optimum looked for. Calibrate some
        parts with `calibrate` to see whether the model fits.
    """
    options = Options.given(options, choices)
    solver = solver or options_of(options)
    _check_options(options)
    if not len(parts):
        raise InputError("parts", "none", "at least one")
    clock = time.perf_counter()
    variables = build_variables(robot, [options.unknown_frame], options.has_priors)

    def at(parameters: Floats) -> _At:
        return _At(variables, parameters, _reduce(_Task(robot, options, parameters), parts, executor))

    first = at(_start(robot, parts, options, executor))
    here, history = _descended(first, at, solver)
    return PartsSolution(
        robot=robot.with_values(here.parameters[variables.robot_span]),
        parameters=here.parameters,
        posterior=here.posterior(first),
        reduced=here.reduced,
        chi2=here.chi2,
        converged=here.decrement <= NEAR_ENOUGH,
        iterations=len(history),
        decrement=here.decrement,
        rank=here.rank,
        start=first.parameters,
        at_start=first.reduced,
        history=tuple(history),
        seconds=time.perf_counter() - clock,
        options=options,
    )


def _descended(here: _At, at: Callable[[Floats], _At], solver: SolverOptions) -> tuple[_At, list[Iteration]]:
    """Where Gauss-Newton steps lead, and the steps.

    What a step leaves to go is a part of what there was that does not grow. So the last step need not be looked at.
    """
    history: list[Iteration] = []
    while here.decrement > solver.decrement and len(history) < solver.max_iterations:
        contraction = here.decrement / history[-1].decrement if history else np.inf
        left = here.decrement * contraction
        there = here.stepped_unseen(left) if left <= solver.decrement else _stepped(here, at)
        if there is None:
            break
        history.append(here.iteration(there))
        here = there
    return here, history


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
        self._scales = variables.prior_scales
        with one_blas_thread:
            U, s, Vt = np.linalg.svd(rows[:, :-1] * self._scales, full_matrices=False)
        self.rank = determined(s)
        along = -(U[:, : self.rank].T @ rows[:, -1])
        directions = Vt * self._scales
        self._half = directions[: self.rank].T / s[: self.rank]
        self._loose = directions[self.rank :]
        self.step: Floats = self._half @ along
        self.decrement = float(np.linalg.norm(along))
        self.chi2 = float(rows[:, -1] @ rows[:, -1])

    def posterior(self, first: _At) -> TangentCovariance:
        """The covariance here, of a descent that began at the nominal arm."""
        v = self.variables
        held = held_frames(self._loose, first._loose, self._scales, v.n_robot_columns)
        tangent = self._half @ self._half.T + held @ held.T
        loose, loose_at_nominal = (np.linalg.qr((one._loose / v.scales).T)[0].T for one in (self, first))
        return TangentCovariance(v, self.parameters, tangent, loose, loose_at_nominal)

    def stepped_unseen(self, left: float) -> _At:
        """Where the step leads if rows are linear, with so much left to go, [sigma]."""
        triangle = self.reduced.triangle.copy()
        triangle[:, -1] += triangle[:, :-1] @ self.step
        parameters = self.variables.stepped(self.parameters, self.step)
        there = _At(self.variables, parameters, replace(self.reduced, triangle=triangle))
        there.decrement = left
        return there

    def iteration(self, there: _At) -> Iteration:
        """The step from here."""
        length = float(np.linalg.norm(self.step / self._scales))
        return Iteration(cost=0.5 * there.chi2, damping=0.0, step=length, decrement=self.decrement)


@dataclass(frozen=True)
class _Task:
    """What is done with every part."""

    robot: Robot
    options: Options
    parameters: Floats

    def __call__(self, part: Part) -> Reduced | None:
        table = table_of_part(part, self.options)
        if not _n_rows(table.measurements):
            return None
        problem = problem_of_table(self.robot, table, self.options, self.parameters)
        with one_blas_thread:
            noises = noises_at(problem, self.parameters)
            sharing, at = self.options.pair_errors == "shared", problem.variables.at(self.parameters)
            rows = whitened_rows(noises, sharing=sharing, joint_errors=None, weights=None)
            triangle = _upper([one.triangle(at) for one in rows], problem.variables.n_columns + 1)
        n, fitted = problem.n_configurations, dict[int, NDArray[np.uint8]]()
        if self.options.uses_pairs:
            n, fitted = (
                problem.n_pairs,
                {zlib.crc32(table.measurements.ids.tobytes()): np.packbits(problem.data.fitted)},
            )
        return Reduced(triangle, problem.n_residuals, n, _squares(noises), problem.n_excluded, fitted)


def problem_of_table(robot: Robot, table: Table, options: Options, parameters: Floats) -> Problem:
    """The problem that a table is at a parameter vector, without its rows."""
    data = build_dataset(robot, (table,))
    return unassembled(robot, data, options, variables_of(robot, data, options), parameters)


def _n_rows(m: Measurements) -> int:
    """Pairs, or else configurations, of a table."""
    return m.n_configurations if m.pairs is None else m.pairs.n_pairs


def _squares(noises: Sequence[RowNoise]) -> dict[str, tuple[int, float]]:
    """By kind of noise the number of train measurements, and the sum of their squared residuals."""
    found: dict[str, tuple[int, float]] = {}
    for noise in noises:
        series = noise.series
        used = series.used & ~series.test[:, None]
        squares = np.where(used, noise.residual(), 0.0) ** 2
        families = np.array([name.partition(".")[0] for name in series.kind.names])
        for family in dict.fromkeys(families.tolist()):
            n, total = found.get(family, (0, 0.0))
            mine = families == family
            found[family] = (n + int(np.sum(used[:, mine].any(axis=1))), total + float(np.sum(squares[:, mine])))
    return found


def _start(robot: Robot, parts: Sequence[Part], options: Options, executor: Executor | None) -> Floats:
    """Where `solve` would start, by some rows of every part: one may not tell where frame and tool are."""
    variables = build_variables(robot, [options.unknown_frame], options.has_priors)
    if not options.unknown_frame and not any(p.estimated and p.owner > robot.n_joints for p in robot.parameters):
        return variables.nominal()
    names = [f"part {k + 1}" for k in range(len(parts))]
    found = map_jobs(
        partial(_some, robot=robot, options=options), parts, executor, names=names, what="looking at parts"
    )
    table = _joined([_checked(one) for one in found])
    if not table.n_configurations:
        return variables.nominal()
    data = build_dataset(robot, (table_of_part(table, options),))
    return start_of(robot, data, variables)


def _some(part: Part, robot: Robot, options: Options) -> Measurements:
    """Train rows of a part, `STARTED_FROM` at most, evenly spread; they are this robot's."""
    m = table_of_part(part, options).measurements
    train = np.flatnonzero(~(m.pairs.test if options.uses_pairs and m.pairs is not None else m.test))
    rows = train[:: max(1, -(-len(train) // STARTED_FROM))]
    some = _with_pairs(m, rows) if options.uses_pairs else m.select(rows)
    if len(rows):
        build_dataset(robot, (table_of_part(some, options),)).trigs(robot)
    return some


def _joined(tables: Sequence[Measurements]) -> Measurements:
    """Several tables, one below the other."""

    def below(name: str) -> Any:
        values = [getattr(m, name) for m in tables]
        return None if any(v is None for v in values) else np.concatenate(values)

    firsts = np.cumsum([0, *(m.n_configurations for m in tables)]).tolist()
    pairs = [
        replace(m.pairs, a=m.pairs.a + first, b=m.pairs.b + first)
        for m, first in zip(tables, firsts, strict=False)
        if m.pairs is not None
    ]
    names = ("readings", "test", "position", "rotation", "sigma_position", "sigma_orientation")
    return Measurements(
        **{name: below(name) for name in names},
        ids=np.arange(firsts[-1]).astype(str),
        sigma_joint=tables[0].sigma_joint,
        pairs=joined(pairs) if pairs else None,
        source=tables[0].source,
    )


def _reduce(task: _Task, parts: Sequence[Part], executor: Executor | None) -> Reduced:
    names = [f"part {k + 1}" for k in range(len(parts))]
    all_found = [_checked(one) for one in map_jobs(task, parts, executor, names=names, what="reducing parts")]
    found: list[Reduced] = [one for one in all_found if one is not None]
    if not sum(one.n_residuals for one in found):
        raise ProblemError("parts", "no train row", "at least one", "test rows and empty cells are never fitted")
    n_all = build_variables(task.robot, [task.options.unknown_frame], False).n_columns + 1
    squares: dict[str, tuple[int, float]] = {}
    fitted: dict[int, NDArray[np.uint8]] = {}
    excluded: Counter[str] = Counter()
    for one in found:
        excluded.update(one.n_excluded)
        for table, bits in one.fitted.items():
            fitted[table] = fitted.get(table, np.zeros_like(bits)) | bits
        for kind, (n, total) in one.squares.items():
            before = squares.get(kind, (0, 0.0))
            squares[kind] = (before[0] + n, before[1] + total)
    return Reduced(
        triangle=_upper([one.triangle for one in found], n_all),
        n_residuals=sum(one.n_residuals for one in found),
        n_measurements=sum(one.n_measurements for one in found),
        squares=squares,
        n_excluded=dict(excluded),
        fitted=fitted,
    )


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


def table_of_part(part: Part, options: Options) -> Table:
    """A part as a table of which no row shares errors with another's.

    Raises:
        InputError: It is no table, or one whose rows do.
    """
    m = part() if callable(part) else part
    if not isinstance(m, Measurements):
        raise InputError("part", f"found {shown(m)}", "measurements, or a function that reads some")
    if m.labels or m.groups is not None:
        found = "targets, stations, anchors or touched points, which rows of all parts are of"
        raise InputError(m.source, found, "poses, or pairs that were measured directly")
    if m.pairs is not None and not options.uses_pairs:
        found = f"pairs beside the poses, which model {options.model} does not use"
        raise InputError(m.source, found, "the table without them: parts cut by pairs hold a pose many times")
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
    for name, only in (("loss", "none"), ("encoder", "propagated")):
        if getattr(options, name) != only:
            raise InputError(name, f"found {shown(getattr(options, name))}", f"{only}: parts are reduced once each")
    if options.estimate_noise:
        raise InputError("noise", "to be estimated", "as stated: parts are reduced once each")
    if options.gauge == "keep" or options.estimate_tolerance is not None:
        raise InputError("gauge", "keep, or estimated tolerances", "prior or none: parts are reduced once each")
    for name, given in (("accept", options.accept != Limits()), ("folds", options.folds is not None)):
        if given:
            raise InputError(name, "given for a table in parts", "none: no rows are held out of them")
