"""The front door: from a robot and its measurements to a calibration that prints, predicts, and is saved and loaded.

    robot = Robot.from_dh(rows, convention="dh-hayati", tool=[0, 0, 0.1])
    data = Measurements.from_arrays(q, position=p, sigma_position=1e-4)
    result = calibrate(robot, data, model="position", frame="unknown")

`calibrate_job` does the same of a job, and the command line calls it. What only a calibration of before needs (checks
and updates by new rows, its history) is imported there: that takes as long as to solve a small one.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from functools import cached_property
from hashlib import sha256
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from fg_calib.arguments import checked
from fg_calib.arrays import as_floats, shape_of
from fg_calib.assessment import Assessment as Uncertainty
from fg_calib.assessment import assess, solve_job
from fg_calib.errors import InputError, SolverError, escaped, shown
from fg_calib.graph.factors import Variables, build_variables, frame_of
from fg_calib.graph.knowledge import SIZE, Knowledge
from fg_calib.graph.problem import tables_of
from fg_calib.graph.solver import Solution
from fg_calib.io.atomic import exists, is_folder, noting_reads
from fg_calib.io.job import UNSTATED, read_job, read_table_like
from fg_calib.io.parts import JobInParts, read_parts
from fg_calib.io.result import (
    ROUNDING,
    Carried,
    Covariance,
    KindGoodness,
    Parameter,
    Posterior,
    Previous,
    Result,
    read_result,
)
from fg_calib.io.result import Knowledge as SavedKnowledge
from fg_calib.io.robot_file import read_robot
from fg_calib.job import Job
from fg_calib.measurements.checks import check_readings
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.table import Table
from fg_calib.monitoring.fingerprints import counted_before
from fg_calib.options import NEAR, Options, Pairing, check_flag, check_names, did_you_mean, listed
from fg_calib.progress import tell
from fg_calib.report.documents import ResidualFile, result_of, write_result
from fg_calib.report.summary import format_result, html, judged, summary
from fg_calib.report.text import format_report
from fg_calib.robot.kinematics import forward
from fg_calib.robot.model import Robot, names_of
from fg_calib.statistics.covariance import TangentCovariance
from fg_calib.statistics.estimates import FrameEstimate
from fg_calib.statistics.residual_table import ResidualTable
from fg_calib.threads import single_threaded

if TYPE_CHECKING:
    from fg_calib.io.assessed_parts import AssessedParts
    from fg_calib.io.history import Run
    from fg_calib.monitoring.check import Check
    from fg_calib.monitoring.new_data import Calibrated, Rows

Floats = NDArray[np.float64]

SAME = 1e-12
"""How far the saved robot's values may be from the estimates in `result.json`, [m] and [rad]: rounding in its units."""


@checked
def calibrate(
    robot: Robot,
    measurements: Measurements | Table | Sequence[Measurements | Table],
    options: Options | None = None,
    *,
    executor: Executor | None = None,
    **choices: Any,
) -> Calibration:
    """Estimate a robot's parameters from measurements, with their uncertainties.

    It builds the problem, solves it (`estimate_noise=True`: with the noise), looks for other optima, and assesses what
    it found. For the steps one by one see `build_problem`, `solve`, `multistart` and `assess`; for jobs in files
    `calibrate_job`.

    Args:
        robot: The nominal robot.
        measurements: What was measured: a table, or several; those that are no `Table` are understood as the options
            say. With `estimate_noise` sigmas that are not stated start at 1 mm and 1 mrad.
        options: What is estimated from what.
        executor: Where folds are calibrated, such as `local_processes(4)`; in this process if None.
        choices: Instead of `options`, any of theirs as keywords: model, frame, pairing, loss, ...

    Raises:
        InputError: An option is not one of those possible, or readings are not of this robot or outside its limits.
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    options = Options.given(options, choices)
    tables = []
    for table in tables_of(measurements, options):
        check_readings(table.measurements.readings, robot, table.measurements.source)
        first = _with_first_sigmas(table.measurements) if options.estimate_noise else table.measurements
        tables.append(replace(table, measurements=first))
    return calibrate_job(Job(None, robot, tuple(tables), options), executor)


@checked
def calibrate_job(job: Job | Path | str, executor: Executor | None = None) -> Calibration:
    """`calibrate` of a job: what `fg-calib calibrate` does.

    Args:
        job: The job, or the path of its file.
        executor: Where folds are calibrated; in this process if None. For many jobs see `calibrate_jobs`.

    Raises:
        InputError: The job, or a file that it names, cannot be used.
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    given = job if isinstance(job, Job) else read_job(job)
    tell("calibrating")
    with _estimable(given.options):
        solution = solve_job(given)
        tell("judging the result")
        uncertainty = assess(solution)
        if given.options.folds is not None:
            from fg_calib.statistics.cross_validation import cross_validate

            folds = cross_validate(given, solve_job, given.options.folds, executor=executor)
            uncertainty = uncertainty.with_folds(folds, solution)
        return Calibration.of(solution, uncertainty, given.inputs, job=given.document)


@contextmanager
def _estimable(options: Options) -> Iterator[None]:
    """Within, noise or tolerances that rows do not tell at all may be estimated beyond what figures hold: one line."""
    try:
        yield
    except (ArithmeticError, np.linalg.LinAlgError, ValidationError) as error:
        given = {"noise": options.estimate_noise, "tolerance": options.estimate_tolerance is not None}
        asked = " and ".join(name for name, is_estimated in given.items() if is_estimated)
        if not asked:
            raise
        raise SolverError(f"{asked} cannot be estimated from these rows, which leave no error: state it") from error


@checked
def calibrate_parts(job: JobInParts | Path | str, executor: Executor | None = None) -> Calibration:
    """Calibrate a job whose table is read in parts: what `fg-calib calibrate --parts` does.

    Memory does not grow with the number of rows. No single row is judged, and no outlier, mistake or other optimum
    looked for: the result says so, and not that it is to be trusted. There is no residual table.

    Args:
        job: The job, from `read_parts`, or the path of its file.
        executor: Where parts are reduced; one after the other in this process if None.

    Raises:
        InputError: The job, or a file that it names, cannot be used, or its table not be cut.
        ProblemError: Rows of a part share errors with those of others, or cannot be used.
    """
    from fg_calib.io.assessed_parts import assess_parts
    from fg_calib.io.parts_solver import solve_parts
    from fg_calib.report.parts import result_of_parts

    given = job if isinstance(job, JobInParts) else read_parts(job)
    solution = solve_parts(given.robot, given.parts, given.options, executor)
    tell("judging the result")
    assessed = assess_parts(solution, given.parts[0])
    return Calibration(solution.robot, result_of_parts(given, assessed), solution.posterior, assessed)


def _with_first_sigmas(m: Measurements) -> Measurements:
    """Sigmas for what was measured without any, as the noise to be estimated starts from."""
    shape = (m.n_configurations, 3)
    first: dict[str, Any] = {}
    for name in ("position", "orientation"):
        measured = m.position if name == "position" else m.rotation
        if measured is not None and getattr(m, f"sigma_{name}") is None:
            first[f"sigma_{name}"] = np.full(shape, getattr(UNSTATED, name))
    if m.pairs is not None:
        of_pairs: dict[str, Any] = {
            f"sigma_{name}": np.where(np.isnan(sigma), getattr(UNSTATED, name), sigma)
            for name, sigma in (("distance", m.pairs.sigma_distance), ("angle", m.pairs.sigma_angle))
        }
        first["pairs"] = replace(m.pairs, **of_pairs)
    return replace(m, **first)


Given = Path | str | Job | Measurements | Table | Sequence[Measurements | Table]
"""New rows: a table or a job, by its path or in memory."""


@dataclass(frozen=True)
class PredictedPoses:
    """Tool poses that a calibrated robot takes, with what its parameters may be off.

    Attributes:
        position: Of the tool point, shape (n, 3), [m].
        rotation: Of the tool, shape (n, 3, 3).
        covariance: Of position, then of a small turn, both along and about the axes of the frame that the poses are
            in, shape (n, 6, 6), [m] and [rad]; nan where nothing determines it.
    """

    position: Floats
    rotation: Floats
    covariance: Floats

    @property
    def sigma_position(self) -> Floats:
        """1 sigma of the position along the axes, shape (n, 3), [m]."""
        return self._sigma[:, :3]

    @property
    def sigma_rotation(self) -> Floats:
        """1 sigma of a turn about the axes, shape (n, 3), [rad]."""
        return self._sigma[:, 3:]

    @property
    def _sigma(self) -> Floats:
        sigma: Floats = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        return sigma

    def __repr__(self) -> str:
        n = len(self.position)
        rms = np.sqrt(np.mean(np.sum(self.sigma_position**2, axis=1))) * 1e3 if n else np.nan
        return f"PredictedPoses, {n} poses, expected RMS error of the position {rms:.3g} mm"


class Parameters(Mapping[str, Parameter]):
    """The parameters of a calibration by name, in the robot's order."""

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self._by_name = {p.name: p for p in parameters}

    def __getitem__(self, name: str) -> Parameter:
        if name not in self._by_name:
            raise KeyError(" ".join(filter(None, (str(name), did_you_mean(name, self._by_name, NEAR)))))
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def __repr__(self) -> str:
        names = escaped(", ".join(self._by_name))
        return f"Parameters: {names if len(names) <= 80 else names[:80] + ' ...'}"


@dataclass(frozen=True, repr=False, eq=False)
class Calibration:
    """What a calibration found; printed it is the report.

    Attributes:
        robot: The calibrated robot.
        result: All that `result.json` holds.
        posterior: The covariance of all parameters in the tangent space of the variables.
        assessed: The solution and its assessment; of one in parts what is known of it; None of one that was loaded.
        history: The runs that it came from, itself not among them; of one that was loaded itself the last.
    """

    robot: Robot
    result: Result
    posterior: TangentCovariance
    assessed: tuple[Solution, Uncertainty] | AssessedParts | None = None
    history: tuple[Run, ...] = ()

    @classmethod
    @checked
    def of(
        cls,
        solution: Solution,
        uncertainty: Uncertainty,
        inputs: Mapping[str, str] | None = None,
        **more: Any,
    ) -> Calibration:
        """The calibration of a solution and its assessment.

        Args:
            solution: The solution.
            uncertainty: Its assessment.
            inputs: SHA-256 of the files it came from, by path.
            more: The job's document, the date, what it came from: see `report.documents.result_of`.
        """
        result = result_of(solution, uncertainty, inputs, **more)
        return cls(uncertainty.robot, result, uncertainty.whole, (solution, uncertainty))

    @classmethod
    @checked
    def load(cls, path: Path | str) -> Calibration:
        """The calibration in a folder that `save` or `calibrate --out` wrote, or in its `result.json`.

        It has all but the solution, its assessment and the residuals.

        Raises:
            InputError: There is none, or it is damaged.
        """
        from fg_calib.io.history import history_of

        result, folder = read_result(path), Path(path) if is_folder(Path(path)) else Path(path).parent
        robot = _saved_robot(folder, result)
        nominal = robot.with_values([p.nominal for p in result.parameters])  # by its reach columns are scaled
        posterior = _saved_posterior(nominal, result, f"{folder / 'result.json'}: posterior")
        return cls(robot, result, posterior, history=history_of(path).runs)

    @checked
    def save(self, folder: Path | str, *, residuals: ResidualFile = "csv") -> None:
        """Write what `calibrate --out` writes: `result.json`, the calibrated robot and the residuals, if there are any.

        Args:
            folder: Where to.
            residuals: How single residuals are written: `csv`, `parquet`, or `none` where there are millions.

        Raises:
            InputError: The folder cannot be written, or the calibration was itself loaded from one.
        """
        if self.assessed is not None and not isinstance(self.assessed, tuple):
            from fg_calib.report.parts import write_result_of_parts

            write_result_of_parts(folder, self.result, self.assessed)
            return
        history = self._history if self.history else None
        write_result(folder, self.result, self.solution, self.uncertainty, history, residuals)

    def _history(self, digest: str) -> dict[str, str]:
        """What is written of the runs that it came from, with itself."""
        from fg_calib.io.history import HISTORY, History, run_of

        runs = (*self.history, run_of(self.result, digest, self.history[-1]))
        return {HISTORY: History(robot=self.result.robot, runs=runs).text()}

    @property
    def runs(self) -> tuple[Run, ...]:
        """The runs that it came from, and itself."""
        from fg_calib.io.history import run_of

        if self.assessed is None:
            return self.history
        digest = sha256(json.dumps(self.result.document()).encode()).hexdigest()
        return (*self.history, run_of(self.result, digest, self.history[-1] if self.history else None))

    @property
    def calibrated(self) -> Calibrated:
        """What is known of the arm, for new rows."""
        from fg_calib.monitoring.new_data import Calibrated

        of_result = {p.name: p.prior_sigma for p in self.result.parameters}  # as they were estimated, perhaps
        nominal = self.posterior.variables.robot
        nominal = replace(
            nominal,
            parameters=tuple(replace(p, tolerance=of_result[p.name] or p.tolerance) for p in nominal.parameters),
        )
        values = np.array([p.estimate for p in self.result.parameters])
        carried = self.result.carried or Carried()
        known = None
        if carried.knowledge is not None and not self.result.evaluated_only:
            known = _saved_knowledge(nominal.with_values(values), carried.knowledge)
        kept = {*self.result.noise_kept, "joint"}
        estimated = [kind for kind in self.result.noise_factors or () if kind not in kept]
        degrees = sum(self.result.goodness[kind].expected or 0.0 for kind in estimated)
        return Calibrated(
            robot=nominal,
            values=values,
            posterior=self.posterior,
            knowledge=known,
            options=_saved_options(self.result),
            noise=carried.noise,
            noise_degrees=degrees or None,
        )

    @checked
    def check(
        self,
        rows: Given,
        *,
        limit: float | None = None,
        limit_angle: float | None = None,
        pairs: Path | str | None = None,
        like: str | None = None,
    ) -> Check:
        """Whether it is still good by new rows: what `fg-calib check` does.

        Args:
            rows: A table like the calibration's (a file, or measurements), or a job with several.
            limit: The largest RMS error of positions, or of distances where there are no others, [m]; those of the
                job's `accept` if None.
            limit_angle: The same of orientations, or angles, [rad].
            pairs: Table of pairs that were measured directly.
            like: Of which of the job's tables that is, where it has several.

        Raises:
            InputError: The rows cannot be read, or are of another robot; or the calibration is not to be trusted.
            ProblemError: The rows lack what their model needs.
        """
        from fg_calib.monitoring.check import check_rows

        self._require_trust()
        new, _ = self._rows(rows, pairs, like)
        between = all(table.model not in ("pose", "position", "orientation", "board") for table in new.tables)
        stated = dict(
            zip(("distance", "angle") if between else ("position", "orientation"), (limit, limit_angle), strict=True)
        )
        stated = {name: figure for name, figure in stated.items() if figure is not None}
        limits = replace(_saved_options(self.result).accept, **stated)
        return check_rows(self.calibrated, new, limits)

    @checked
    def update(
        self,
        rows: Given,
        *,
        date: str | None = None,
        growth: Mapping[str, float] | None = None,
        changed: Sequence[str] = (),
        anchors_stay: bool = False,
        pairs: Path | str | None = None,
        like: str | None = None,
    ) -> Calibration:
        """The calibration with new rows added, from its posterior: what `fg-calib update` does.

        Args:
            rows: A table like the calibration's (a file, or measurements), or a job with several.
            date: When they were measured, such as 2026-03-01; now if None.
            growth: 1 sigma by which parameters wander in a day, by name or kind, [m] and [rad]; as the root of days.
            changed: Parameters, or zeros of joints, that have changed since: nothing is taken over of them.
            anchors_stay: Whether anchors of the same name are where they were.
            pairs: Table of pairs that were measured directly.
            like: Of which of the job's tables that is, where it has several.

        Raises:
            InputError: The rows cannot be read, or are of another robot; the calibration is not to be trusted or holds
                nothing to go on from; or there is no such parameter.
            ProblemError: The rows lack what their model needs, or do not suffice.
            SolverError: GTSAM could not solve a step at all.
        """
        from fg_calib.monitoring.update import predicted_before, updated

        self._require_trust()
        if self.result.in_parts:
            in_parts = "a calibration in parts, which does not hold what its rows say"
            raise InputError("update", in_parts, "one that was calibrated whole, without --parts")
        history = self.runs
        new, before = _date(date), history[-1]
        growth = {} if growth is None else growth
        days = _days(before.date, new, needed=bool(growth))
        table, inputs = self._rows(rows, pairs, like)
        counted = {mark for run in history for mark in run.rows}
        for one in table.tables:
            if counted_before(one, counted):
                source = one.measurements.source
                raise InputError(source, "its rows are in the calibration already", "new rows")
        names = listed("changed", changed)
        found = updated(
            self.calibrated,
            table,
            growth={name: size * float(np.sqrt(days)) for name, size in growth.items()},
            changed=names,
            anchors_stay=anchors_stay,
        )
        uncertainty = assess(found)
        if uncertainty.acceptance is not None and not names:
            uncertainty = uncertainty.with_held_out(predicted_before(self.calibrated, table), found)
        job = {} if self.result.carried is None else self.result.carried.job
        previous = Previous(sha256=before.sha256, date=before.date)
        made = Calibration.of(found, uncertainty, inputs, job=job, date=new, previous=previous)
        return replace(made, history=history)

    def _require_trust(self) -> None:
        if self.trustworthy is False:
            reason = (*self.findings, self.result.solver.message)[0]
            raise InputError(self.result.robot, f"the calibration is not to be trusted: {reason}", "one that is")

    def _rows(self, given: Given, pairs: Path | str | None, like: str | None) -> tuple[Rows, dict[str, str]]:
        """New rows, understood as the calibration's own, and SHA-256 of the files that they are from.

        Raises:
            InputError: They are of another robot, or cannot be read.
        """
        from fg_calib.monitoring.new_data import Rows

        options, robot = _saved_options(self.result), self.posterior.variables.robot
        if isinstance(given, Path | str) and Path(given).suffix.lower() not in (".yaml", ".yml"):
            path, of_pairs = Path(given), None if pairs is None else Path(pairs)
            job = {} if self.result.carried is None else self.result.carried.job
            if not job:
                found = "the calibration does not say how its tables were read"
                raise InputError(path.name, found, "a job that names the table")
            with noting_reads() as files:
                table = read_table_like(job, robot, path, pairs=of_pairs, like=like)
            inputs = {file.name: digest for file, digest in files.items()}
            return Rows.of([table], [like or path.name], options), inputs
        if pairs is not None or like is not None:
            raise InputError("pairs" if pairs else "like", "given beside rows that say it themselves", "none")
        new, inputs = given, {}
        if isinstance(new, Path | str):
            new = read_job(new)
        if isinstance(new, Job):
            if names_of(new.robot.parameters) != names_of(robot.parameters) or new.robot.convention != robot.convention:
                expected = f"that of the result, {robot.name}"
                raise InputError(str(new.path or "job"), f"the robot {new.robot.name}", expected)
            inputs, new = new.inputs, new.tables
        tables = tables_of(new, options)
        for one in tables:
            check_readings(one.measurements.readings, robot, one.measurements.source)
        return Rows.of(tables, [one.measurements.source for one in tables], options), inputs

    @property
    def solution(self) -> Solution:
        """The solution.

        Raises:
            InputError: The calibration was loaded, or is one in parts: these do not hold it.
        """
        return self._assessed[0]

    @property
    def uncertainty(self) -> Uncertainty:
        """The assessment of the solution.

        Raises:
            InputError: The calibration was loaded, or is one in parts: these do not hold it.
        """
        return self._assessed[1]

    @property
    def residuals(self) -> ResidualTable:
        """Every residual, before and after.

        Raises:
            InputError: The calibration was loaded (its residuals are in `residuals.csv`), or is one in parts.
        """
        return self.uncertainty.fit.residuals

    @property
    def _assessed(self) -> tuple[Solution, Uncertainty]:
        if isinstance(self.assessed, tuple):
            return self.assessed
        found = "it was loaded from a folder, which holds no solution, assessment or residual table"
        found = "it was calibrated in parts, without assessment or residual table" if self.result.in_parts else found
        raise InputError("calibration", found, hint="calibrate again to have them")

    @cached_property
    def parameters(self) -> Parameters:
        """Every parameter of the robot by name, with `estimate`, `sigma`, `nominal`, `correction`, ..."""
        return Parameters(self.result.parameters)

    def covariance(self, names: Sequence[str] | None = None) -> Floats:
        """Covariance of the errors of parameters, [m] and [rad]; nan where nothing determines them.

        Args:
            names: The parameters, in the order wanted; those that were estimated if None. What is fixed has no error.

        Raises:
            InputError: There is no such parameter.
        """
        given = self.result.covariance
        names = given.names if names is None else names if isinstance(names, str) else listed("covariance", names)
        check_names("covariance", names, list(self.parameters))
        every = np.zeros((len(given.names) + 1,) * 2)  # the last one stands for what is fixed
        every[:-1, :-1] = _array(given.matrix, len(given.names))
        rows = [given.names.index(name) if name in given.names else len(given.names) for name in names]
        return every[np.ix_(rows, rows)]

    @property
    def frame(self) -> FrameEstimate | None:
        """The measurement frame world_T_base; None where it was not estimated."""
        f = self.result.frame_estimate
        return None if f is None else FrameEstimate(*(np.array(v, float) for v in (f.xyz, f.quaternion_xyzw, f.sigma)))

    @property
    def goodness(self) -> dict[str, KindGoodness]:
        """Noise stated and noise seen, by kind; more of it in `uncertainty.goodness`."""
        return self.result.goodness

    @property
    def findings(self) -> tuple[str, ...]:
        """Why it is not to be trusted; empty if it is."""
        return self.result.findings

    @property
    def not_accepted(self) -> tuple[str, ...]:
        """The limits of `accept` that it does not keep to, or that could not be judged, each in a line."""
        found = () if self.result.acceptance is None else self.result.acceptance.judgements
        return tuple(judged(one for one in found if one.verdict != "pass"))

    @property
    def trustworthy(self) -> bool | None:
        """Whether nothing speaks against it; None of one in parts, where no single row was asked."""
        if self.findings or not self.result.solver.converged:
            return False
        return None if self.result.in_parts else True

    @single_threaded
    def predict(self, readings: ArrayLike, *, world: bool = False, table: int | None = None) -> PredictedPoses:
        """Where the tool truly is at joint readings, and how well that is known.

        Args:
            readings: Shape (n, n_joints), or (n_joints,) of one configuration, [rad] (prismatic: [m]).
            world: Whether the poses are wanted in the measurement frame, instead of in the base frame.
            table: Number of the table whose measurement frame it is, from 0; there must be one if there are several.

        Raises:
            InputError: The readings are of other joints, or there is no measurement frame.
        """
        check_flag("world", world)
        shape_of("readings", readings, f"(n, {self.robot.n_joints})")
        q = as_floats("readings", np.atleast_2d(readings), f"(n, {self.robot.n_joints})")
        v = self.posterior.variables
        if world and v.n_robot_columns == v.n_columns:
            raise InputError("world", "the measurement frame was not estimated, or not saved", "the base frame")
        known = build_variables(v.robot, [False]).chains[0]
        chain = v.chains[self._table_of(table)] if world else known
        at = forward(chain.at(self.posterior.parameters), v.robot.trig(q))
        jacobian = np.zeros((len(q), 6, v.n_columns))
        jacobian[:, :, : at.jacobian.shape[2]] = at.jacobian[:, [3, 4, 5, 0, 1, 2]]
        covariance = [self.posterior.covariance(rows) for rows in jacobian]
        return PredictedPoses(at.position, at.rotation, np.array(covariance).reshape(-1, 6, 6))

    def _table_of(self, number: int | None) -> int:
        """The table whose measurement frame is meant."""
        there = _tables_with_frame(self.posterior.variables)
        if number is None and len(there) == 1:
            return there[0]
        if not isinstance(number, Integral) or number not in there:
            found = "several measurement frames" if number is None else f"found {shown(number)}"
            raise InputError("table", found, f"one of {', '.join(map(str, there))}: the table whose frame is meant")
        return int(number)

    def __repr__(self) -> str:
        return "\n".join(summary(self.result))

    def __str__(self) -> str:
        return format_report(*self.assessed) if isinstance(self.assessed, tuple) else format_result(self.result)

    def _repr_html_(self) -> str:
        return html(self.result)


def _tables_with_frame(variables: Variables) -> list[int]:
    """The tables whose measurement frame was estimated."""
    return [int(v.symbol[2:-1]) for v in variables.frames]


def _array(matrix: Sequence[Sequence[float | None]], width: int) -> Floats:
    """A matrix of a result, nan for None, shape (n, width)."""
    return np.array(matrix, dtype=np.float64).reshape(len(matrix), width)


def _saved_robot(folder: Path, result: Result) -> Robot:
    """The calibrated robot beside a result: that which the result is of."""
    files = [folder / f"robot_calibrated.{ending}" for ending in ("yaml", "urdf")]
    file = next((file for file in files if exists(file)), None)
    if file is None:
        raise InputError(str(folder), "neither robot_calibrated.yaml nor robot_calibrated.urdf beside its result.json")
    links = result.links or (None, None)
    robot = read_robot(file, base_link=links[0], tip_link=links[1])
    names, estimates = [p.name for p in result.parameters], [p.estimate for p in result.parameters]
    same = [p.name for p in robot.parameters] == names
    if not same or np.abs(robot.nominal - estimates).max(initial=0.0) > SAME:
        found = "other values" if same else "other parameters"
        raise InputError(str(file), f"{found} than in result.json", "the files of one calibration")
    tolerances = [p.prior_sigma for p in result.parameters]
    parameters = zip(robot.with_estimated(result.covariance.names).parameters, tolerances, strict=True)
    return replace(robot, parameters=tuple(replace(p, tolerance=p.tolerance or t) for p, t in parameters))


def _saved_posterior(robot: Robot, result: Result, place: str) -> TangentCovariance:
    """The covariance that was saved, of a nominal robot; of version 1 what that of the parameters says."""
    estimates = result.frames or ({} if result.frame_estimate is None else {"X(0)": result.frame_estimate})
    frames = [] if estimates else [np.zeros(6)]
    for frame in estimates.values():
        x, y, z, w = map(float, np.array(frame.quaternion_xyzw, float))
        frames.append(frame_of(gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), np.array(frame.xyz, float))))
    parameters = np.concatenate([[p.estimate for p in result.parameters], *frames])
    if result.posterior is None:
        return _posterior_of_names(robot, parameters, result)
    unknown = [int(symbol[2:-1]) for symbol in estimates]
    variables = build_variables(robot, [t in unknown for t in range(max(unknown, default=0) + 1)], False)
    wanted = {v.symbol: variables.names[v.columns] for v in variables.items}
    saved: Posterior = result.posterior
    n = variables.n_columns
    matrices = (saved.covariance, saved.undetermined, saved.undetermined_at_nominal)
    if saved.variables != wanted or len(saved.covariance) != n or any(len(row) != n for m in matrices for row in m):
        raise InputError(place, "other variables than the robot and the covariance have", f"{n} columns of them")
    arrays = [_array(matrix, n) for matrix in matrices]
    if not all(np.isfinite(array).all() for array in arrays):
        raise InputError(place, "figures that are not finite", "covariances, and directions that are not determined")
    found = TangentCovariance(variables, parameters, *arrays)
    _require_same(found, result.covariance, place)
    return found


def _require_same(found: TangentCovariance, stated: Covariance, place: str) -> None:
    """Check that a saved posterior says of the robot's parameters what their covariance says, where both know it.

    Raises:
        InputError: It does not.
    """
    order = [stated.names.index(name) for name in found.variables.names[: len(stated.names)]]
    matrix = _array(stated.matrix, len(order))[np.ix_(order, order)]
    sigma = np.sqrt(matrix.diagonal())
    if (np.abs(found.named() - matrix) > ROUNDING * np.outer(sigma, sigma)).any():
        raise InputError(place, "contradicts the covariance of the parameters", "the same of both", "was it changed?")


def _saved_options(result: Result) -> Options:
    """The options of a result, its folds not among them."""
    given = {name: value for name, value in result.options.items() if name in {f.name for f in fields(Options)}}
    words = str(given.get("pairing", "star")).partition(" ")
    pairing = Pairing("star") if words[0] not in ("chain", "all") else Pairing(words[0])  # type: ignore[arg-type]
    if drawn := re.fullmatch(r"random \((\d+), seed (\d+)\)", str(given.get("pairing"))):
        pairing = Pairing("random", int(drawn[1]), int(drawn[2]))
    accept = given.get("accept") or {}
    return Options.of(**{**given, "pairing": pairing, "accept": accept, "folds": None})


def _saved_knowledge(robot: Robot, saved: SavedKnowledge) -> Knowledge:
    """What was saved of what rows say.

    Raises:
        InputError: It is of another robot, or damaged.
    """
    width = len(saved.columns) + len(saved.at)
    found = Knowledge(
        robot=robot,
        unknowns=saved.unknowns,
        at=np.array(saved.at, dtype=np.float64),
        rows=_array(saved.rows, width),
        right=np.array(saved.right, dtype=np.float64),
        views=saved.views,
    )
    sizes = len(saved.at) == SIZE * len(saved.unknowns) and len(saved.right) == len(saved.rows)
    drawn = saved.nominal
    if drawn is not None:
        sizes &= len(drawn.at) == len(saved.at) and len(drawn.parameters) == len(robot.parameters)
    if found.variables.names != saved.columns or not sizes:
        raise InputError(
            "result.json: carried", "knowledge of other parameters than those estimated", "that of one run"
        )
    if drawn is None:
        return found
    rows = _array(drawn.rows, width)
    nominal = Knowledge(
        robot=robot.with_values(drawn.parameters),
        unknowns=saved.unknowns,
        at=np.array(drawn.at, dtype=np.float64),
        rows=rows,
        right=np.zeros(len(rows)),
        views=saved.views,
    )
    return replace(found, nominal=nominal)


def _date(given: str | None) -> str:
    """A date as it is written; now if None.

    Raises:
        InputError: It is none.
    """
    if given is None:
        return datetime.now(UTC).isoformat(timespec="seconds")
    try:
        return datetime.fromisoformat(given).isoformat()
    except ValueError:
        raise InputError("date", f"found {shown(given)}", "a date such as 2026-03-01") from None


def _days(before: str, now: str, *, needed: bool) -> float:
    """Days from one date to another; 0 where the second has no time zone, and may be of the same day.

    Raises:
        InputError: The first is not known although it is needed, or after the other.
    """
    if not before:
        if needed:
            raise InputError("growth", "the calibration has no date", "one that this version of fg-calib wrote")
        return 0.0
    dates = [datetime.fromisoformat(date) for date in (before, now)]
    first, second = (d if d.tzinfo else d.replace(tzinfo=UTC) for d in dates)
    days = (second - first).total_seconds() / 86400.0
    same_day = dates[1].tzinfo is None and days > -1.0
    if days < 0.0 and not same_day:
        raise InputError("date", f"{now} is before the calibration, {before}", "a later one")
    return max(days, 0.0)


def _posterior_of_names(robot: Robot, parameters: Floats, result: Result) -> TangentCovariance:
    """Of version 1: what the parameters' own covariance says; what has none there counts as undetermined."""
    variables = build_variables(robot, [False], False)
    n = variables.n_columns
    named = _array(result.covariance.matrix, n)
    unknown = np.isnan(np.diag(named))
    E = variables.tangent_derivative(parameters)
    loose = (E @ np.eye(n)[:, unknown]).T / variables.scales
    loose = loose / np.linalg.norm(loose, axis=1, keepdims=True)
    known = np.where(unknown[:, None] | unknown, 0.0, named)
    return TangentCovariance(variables, parameters, E @ known @ E.T, loose, loose)
