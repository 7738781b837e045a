"""The front door: from a robot and its measurements to a calibration that prints, predicts, and is saved and loaded.

    robot = Robot.from_dh(rows, convention="dh-hayati", tool=[0, 0, 0.1])
    data = Measurements.from_arrays(q, position=p, sigma_position=1e-4)
    result = calibrate(robot, data, model="position", frame="unknown")

`calibrate_job` does the same for a job, and the command line calls it.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from fg_calib import inputs, io, parallel
from fg_calib.assessment import Assessment, assess, solve_job
from fg_calib.graph import Knowledge, Solution, Variables, build_variables, frame_of, tables_of
from fg_calib.inputs import Brief, CalibrationError, Floats, InputError, Options, Record, SolverError, checked, pl
from fg_calib.job import Job
from fg_calib.measurements import Measurements, Table, check_readings
from fg_calib.monitoring import Calibrated, Check, Rows, check_rows, counted_before, predicted_before, updated
from fg_calib.prediction import Correction, PredictedErrors, correct_targets, predict_errors, predict_poses
from fg_calib.report import Drawing, ReportData, draw, format_result, judged, notebook_html, notes_of, pages_of, summary
from fg_calib.robot import Context, Robot, names_of
from fg_calib.selection import select_effects
from fg_calib.statistics import CrossValidation, ParameterEstimate, TangentCovariance, cross_validate

DataFrameOf = Literal["parameters", "covariance", "residuals", "configurations"]


@checked
def calibrate(
    robot: Robot,
    measurements: Measurements | Table | Sequence[Measurements | Table],
    options: Options | None = None,
    *,
    executor: Executor | None = None,
    **choices: Any,
) -> "Calibration":
    """Estimate a robot's parameters from measurements, with their uncertainties.

    It builds the problem, solves it (`estimate_noise=True`: with the noise), looks for other optima, and assesses what
    it found. For the steps one by one see `build_problem`, `solve`, `multistart` and `assess`; for jobs in files
    `calibrate_job`.

    Args:
        robot: The nominal robot.
        measurements: A table, or several; those that are no `Table` are understood as the options
            say. With `estimate_noise` sigmas that are not specified start at 1 mm and 1 mrad.
        options: The options.
        executor: Where folds are calibrated, such as `local_processes(4)`; in this process if None.
        choices: Instead of `options`, any of theirs as keywords: model, frame, pairing, loss, ...

    Raises:
        InputError: An option is not one of those possible, or readings are not of this robot or outside its limits.
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    options = Options.of(options, **choices)
    tables = tables_of(measurements, options)
    for table in tables:
        check_readings(table.measurements.readings, robot, table.measurements.source)
    if options.estimate_noise:
        tables = tuple(replace(table, measurements=_with_first_sigmas(table.measurements)) for table in tables)
    return calibrate_job(Job(None, robot, tables, options), executor)


@checked
def calibrate_job(job: Job | Path | str, executor: Executor | None = None) -> "Calibration":
    """`calibrate` of a job: what `fg-calib calibrate` does.

    Args:
        job: The job, or the path of its file.
        executor: Where folds are calibrated; in this process if None. For many jobs see `calibrate_jobs`.

    Raises:
        InputError: The job, or a file that it names, cannot be used.
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    given = job if isinstance(job, Job) else io.read_job(job)
    options = given.options
    try:
        parallel.tell("calibrating")
        given, effects = select_effects(given, solve_job)
        solution = solve_job(given)
        parallel.tell("judging the result")
        assessment = assess(solution)
        if options.folds is not None:
            folds = cross_validate(given, solve_job, options.folds, executor=executor)
            assessment = replace(assessment.with_held_out(folds.by_table, solution), cross_validation=folds)
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        if not options.estimate_noise:
            raise
        raise SolverError("noise cannot be estimated from these rows, which leave no error: specify it") from error
    return Calibration.of(solution, assessment, inputs=given.inputs, job=given.document, effects=effects)


def _with_first_sigmas(m: Measurements) -> Measurements:
    """Sigmas for what was measured without any, as the noise to be estimated starts from."""
    first: dict[str, Any] = {}
    for name, measured in (("position", m.position), ("orientation", m.rotation)):
        if measured is not None and getattr(m, f"sigma_{name}") is None:
            first[f"sigma_{name}"] = np.full((m.n_configurations, 3), getattr(io.UNSPECIFIED, name))
    if m.pairs is not None:
        distance = np.nan_to_num(m.pairs.sigma_distance, nan=io.UNSPECIFIED.distance or 0.0)
        angle = np.nan_to_num(m.pairs.sigma_angle, nan=io.UNSPECIFIED.angle or 0.0)
        first["pairs"] = replace(m.pairs, sigma_distance=distance, sigma_angle=angle)
    return replace(m, **first)


Given = Path | str | Job | Measurements | Table | Sequence[Measurements | Table]
"""New rows: a table or a job, by its path or in memory."""


class PredictedPoses(Brief):
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
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, :3])

    @property
    def sigma_rotation(self) -> Floats:
        """1 sigma of a turn about the axes, shape (n, 3), [rad]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, 3:])


class Calibration(Record, repr=False, eq=False):
    """A calibrated robot with its typed result and tables; printed it is the report.

    Attributes:
        robot: The calibrated robot.
        result: All that `result.json` holds.
        posterior: The covariance of all parameters in the tangent space of the variables.
        assessed: The solution and its assessment; None for a loaded calibration.
        folder: The folder that it was loaded from; None for a new one.
    """

    robot: Robot
    result: io.Result
    posterior: TangentCovariance
    assessed: tuple[Solution, Assessment] | None = None
    folder: Path | None = None

    @classmethod
    @checked
    def of(cls, solution: Solution, uncertainty: Assessment, **origin: Any) -> "Calibration":
        """The calibration of a solution and its assessment.

        Args:
            solution: The solution.
            uncertainty: Its assessment.
            origin: Files, job, date and history: see `io.Result.of`.
        """
        result = io.Result.of(solution, uncertainty, notes=tuple(notes_of(solution, uncertainty)), **origin)
        return cls(uncertainty.robot, result, uncertainty.whole, (solution, uncertainty))

    @classmethod
    @checked
    def load(cls, path: Path | str) -> "Calibration":
        """The calibration in a folder that `save` or `calibrate --out` wrote, or in its `result.json`.

        It prints, draws and predicts like a new one; the solution and its assessment are not saved.

        Raises:
            InputError: There is none, or it is damaged.
        """
        result, folder = io.read_result(path), Path(path) if io.is_folder(Path(path)) else Path(path).parent
        robot = _with_priors(io.read_calibrated_robot(folder, result), result)
        nominal = robot.with_values([p.nominal for p in result.parameters])  # columns are scaled by its reach
        return cls(robot, result, _posterior(nominal, result, f"{folder / 'result.json'}: posterior"), folder=folder)

    @checked
    def save(
        self, folder: Path | str, *, residuals: io.ResidualFile = "csv", report: bool = False, figures: bool = False
    ) -> None:
        """Write what `calibrate --out` writes: `result.json`, the calibrated robot and the tables.

        Args:
            folder: Where to.
            residuals: How single residuals are written: `csv`, `parquet`, or `none` for millions of rows.
            report: Whether to write `report.html` too.
            figures: Whether to write the figures of the page too, as SVG files.

        Raises:
            InputError: The folder cannot be written, or the calibration was itself loaded from one.
        """
        joint_errors = self.assessment.estimates.joint_errors
        tables = {"configurations.csv": self.configurations}
        if residuals != "none":
            tables[f"residuals.{residuals}"] = self.residuals
        if joint_errors is not None:
            tables["joints.csv"] = io.joint_frame(joint_errors, self.solution)
        known = {name: table for name, table in tables.items() if table is not None}
        pages = pages_of(self.report_data, report=report, figures=figures)
        io.write_calibration(Path(folder), self.result, self.robot, known, pages)

    @cached_property
    def configurations(self) -> "pl.DataFrame | None":
        """Every measured configuration, as `configurations.csv` has it; None if that file is missing."""
        if self.assessed is not None:
            return io.configuration_frame(*self.assessed)
        return None if self.folder is None else io.read_table(self.folder, "configurations", self.result)

    @cached_property
    def residuals(self) -> "pl.DataFrame | None":
        """Every scalar residual, as `residuals.csv` has it; None if it was not saved."""
        if self.assessed is not None:
            return io.residual_frame(*self.assessed)
        return None if self.folder is None else io.read_table(self.folder, "residuals", self.result)

    @property
    def measured(self) -> Floats | None:
        """Readings of the measured configurations, shape (n, n_joints), [rad] (prismatic: [m]); None if not saved."""
        return None if self.configurations is None else self.report_data.readings

    @property
    def report_data(self) -> ReportData:
        """Data of its report, page and figures."""
        return ReportData(self.result, self.robot, self.posterior, self.configurations, self.residuals)

    @property
    def nominal(self) -> Robot:
        """The robot that it began with."""
        return self.robot.with_values([p.nominal for p in self.result.parameters])

    @property
    def calibrated(self) -> Calibrated:
        """The arm's prior information for new rows."""
        result = self.result
        nominal = _with_priors(self.posterior.variables.robot, result)
        values, known = np.array([p.estimate for p in result.parameters]), None
        nominal = nominal.with_curves_held(values)  # few new rows say little of them
        if result.carried.knowledge is not None and not result.evaluated_only:
            known = _knowledge(nominal.with_values(values), result.carried.knowledge)
        estimated = set(result.noise_factors or ()).difference((*result.noise_kept, "joint"))
        degrees = sum(result.goodness[kind].expected for kind in sorted(estimated))
        return Calibrated(nominal, values, known, result.options, result.carried.noise, degrees or None)

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
            limit_angle: Limit of orientations, or angles, [rad].
            pairs: Table of pairs that were measured directly.
            like: Of which of the job's tables that is, where it has several.

        Raises:
            InputError: The rows cannot be read, or are of another robot; or the calibration is not to be trusted.
            ProblemError: The rows lack what their model needs.
        """
        self._require_trust()
        new, _ = self._rows(rows, pairs, like)
        of_poses = any(table.model in ("pose", "position", "orientation", "board") for table in new.tables)
        names = ("position", "orientation") if of_poses else ("distance", "angle")
        given = {name: most for name, most in zip(names, (limit, limit_angle), strict=True) if most is not None}
        return check_rows(self.calibrated, new, replace(self.result.options.accept, **given))

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
    ) -> "Calibration":
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
        self._require_trust()
        history, names = (*self.result.history, self.result.run), inputs.listed("changed", changed)
        new, days = _date_and_days(date, self.result.date)
        if growth and days is None:
            raise InputError("growth", "the calibration has no date", "one that this version of fg-calib wrote")
        table, digests = self._rows(rows, pairs, like)
        grown = {name: size * float(np.sqrt(days or 0.0)) for name, size in (growth or {}).items()}
        add = partial(updated, self.calibrated, growth=grown, changed=names, anchors_stay=anchors_stay)
        found = add(table)
        uncertainty = assess(found)
        if uncertainty.acceptance is not None and not names:
            uncertainty = uncertainty.with_held_out(predicted_before(self.calibrated, table), found)
        elif self.result.options.folds:
            with suppress(CalibrationError):  # too few new rows to be without any
                folds = self._cross_validate(table, add)
                uncertainty = replace(uncertainty.with_held_out(folds.by_table, found), cross_validation=folds)
        job = self.result.carried.job
        return Calibration.of(found, uncertainty, inputs=digests, job=job, date=new, history=history)

    def _cross_validate(self, rows: Rows, add: Callable[[Rows], Solution]) -> CrossValidation:
        """New rows held out in folds, each predicted by an update with the others."""
        like = {t.measurements.source: name for t, name in zip(rows.tables, rows.like, strict=True)}
        n = min(self.result.options.folds or 0, sum(int(np.sum(~t.measurements.test)) for t in rows.tables))

        def solve(job: Job) -> Solution:
            return add(Rows(job.tables, tuple(like[t.measurements.source] for t in job.tables)))

        return cross_validate(Job(None, self.robot, rows.tables, self.result.options), solve, n)

    def _require_trust(self) -> None:
        if not self.trustworthy:
            reason = (*self.findings, self.result.solver.message)[0]
            raise InputError(self.result.robot, f"the calibration is not to be trusted: {reason}", "one that is")

    def _rows(self, given: Given, pairs: Path | str | None, like: str | None) -> tuple[Rows, dict[str, str]]:
        """New rows, understood as the calibration's own, and SHA-256 of the files that they are from.

        Raises:
            InputError: The rows are of another robot, or cannot be read.
        """
        options, robot = self.result.options, self.posterior.variables.robot
        if isinstance(given, Path | str) and Path(given).suffix.lower() not in (".yaml", ".yml"):
            path, of_pairs = Path(given), None if pairs is None else Path(pairs)
            job = self.result.carried.job
            found = "the calibration does not say how its tables were read"
            inputs.expect(job, path.name, found, "a job that names the table")
            with io.noting_reads() as files:
                table = io.read_table_like(job, robot, path, pairs=of_pairs, like=like)
            digests = {file.name: digest for file, digest in files.items()}
            return self._not_counted(Rows.of([table], [like or path.name], options)), digests
        if pairs is not None or like is not None:
            raise InputError("pairs" if pairs else "like", "given with rows that say it themselves", "none")
        new, digests = io.read_job(given) if isinstance(given, Path | str) else given, {}
        if isinstance(new, Job):
            names, known = names_of(new.robot.parameters), names_of(robot.parameters)
            if new.robot.select_effects:  # the calibration kept some of them
                names = [name for name in names if name in known]
            if names != known or new.robot.convention != robot.convention:
                expected = f"that of the result, {robot.name}"
                raise InputError(str(new.path or "job"), f"the robot {new.robot.name}", expected)
            digests, new = new.inputs, new.tables
        tables = tables_of(new, options)
        for one in tables:
            check_readings(one.measurements.readings, robot, one.measurements.source)
        return self._not_counted(Rows.of(tables, [one.measurements.source for one in tables], options)), digests

    def _not_counted(self, rows: Rows) -> Rows:
        """New rows of which none was fitted before.

        Raises:
            InputError: They are in the calibration already.
        """
        counted = {mark for run in (*self.result.history, self.result.run) for mark in run.rows}
        for one in rows.tables:
            if counted_before(one, counted):
                raise InputError(one.measurements.source, "its rows are in the calibration already", "new rows")
        return rows

    @property
    def solution(self) -> Solution:
        """The solution.

        Raises:
            InputError: The calibration was loaded.
        """
        return self._computed()[0]

    @property
    def assessment(self) -> Assessment:
        """The assessment of the solution.

        Raises:
            InputError: The calibration was loaded.
        """
        return self._computed()[1]

    def _computed(self) -> tuple[Solution, Assessment]:
        if self.assessed is None:
            found = "it was loaded from a folder, which holds no solution and no assessment"
            raise InputError("calibration", found, hint="calibrate again to have them")
        return self.assessed

    @cached_property
    def parameters(self) -> dict[str, ParameterEstimate]:
        """Every parameter of the robot by name, with `estimate`, `sigma`, `nominal`, `correction`, ..."""
        return {p.name: p for p in self.result.parameters}

    def covariance(self, names: Sequence[str] | None = None) -> Floats:
        """Covariance of the errors of parameters, [m] and [rad]; nan where nothing determines them.

        Args:
            names: The parameters, in the order wanted; those that were estimated if None. A fixed one has no error.

        Raises:
            InputError: There is no such parameter.
        """
        given = self.result.covariance
        names = given.names if names is None else inputs.listed("covariance", names)
        inputs.check_names("covariance", names, list(self.parameters))
        every = np.zeros((len(given.names) + 1,) * 2)  # the last one stands for what is fixed
        every[:-1, :-1] = given.matrix.reshape(len(given.names), len(given.names))
        rows = [given.names.index(name) if name in given.names else len(given.names) for name in names]
        return every[np.ix_(rows, rows)]

    def to_dataframe(self, of: DataFrameOf = "parameters") -> "pl.DataFrame":
        """A part of it as a polars table; its `.to_pandas()` needs pandas and pyarrow.

        Args:
            of: `parameters`, or `covariance` with a column for each, in [m] and [rad]; `residuals` or `configurations`
                as in their files.

        Raises:
            InputError: There is no such part, or it was loaded from a folder that lacks that table.
        """
        inputs.check("of", of, DataFrameOf)
        if of == "covariance":
            names, matrix = list(self.result.covariance.names), self.covariance()
            return pl.DataFrame({"name": names, **dict(zip(names, matrix.T, strict=True))})
        if of == "parameters":
            rows = ({k: v for k, v in vars(p).items() if k != "stands_for"} for p in self.result.parameters)
            return pl.DataFrame(list(rows), infer_schema_length=None)
        table = self.residuals if of == "residuals" else self.configurations
        if table is None:
            raise InputError("of", f"{of} were not saved with this calibration", "parameters or covariance")
        return table

    def plot_parameters(self) -> Drawing:
        """Draw each correction with its sigma."""
        return draw(self.report_data, "parameters")

    def plot_curves(self) -> Drawing:
        """Draw the error curves of joints with 2 sigma, and where they were measured."""
        return draw(self.report_data, "curves")

    def plot_compliances(self) -> Drawing:
        """Draw errors of joints over their torque, with and without their compliance."""
        return draw(self.report_data, "compliances")

    def plot_residuals(self) -> Drawing:
        """Draw residuals row by row, and how they are distributed."""
        return draw(self.report_data, "residuals")

    def plot_workspace(self) -> Drawing:
        """Draw slices of the workspace with the expected error of the tool."""
        return draw(self.report_data, "workspace")

    @property
    def findings(self) -> tuple[str, ...]:
        """Why it is not to be trusted; empty if it is."""
        return self.result.findings

    @property
    def not_accepted(self) -> tuple[str, ...]:
        """The limits of `accept` that are exceeded or could not be judged, a line each."""
        judgements = () if self.result.acceptance is None else self.result.acceptance.judgements
        return tuple(judged(one for one in judgements if one.verdict != "pass"))

    @property
    def trustworthy(self) -> bool:
        """Whether the solver has converged and nothing speaks against the result."""
        return self.result.trustworthy

    @parallel.single_threaded
    def predict(
        self, readings: ArrayLike, context: Context | None = None, *, world: bool = False, table: int | None = None
    ) -> PredictedPoses:
        """Predict the true tool poses at joint readings, with their uncertainty.

        Args:
            readings: Shape (n, n_joints), or (n_joints,) of one configuration, [rad] (prismatic: [m]).
            context: What effects depend on besides, a row each: see `Robot.trig`.
            world: Whether the poses are wanted in the measurement frame, instead of in the base frame.
            table: Number of the table whose measurement frame it is, from 0; there must be one if there are several.

        Raises:
            InputError: The readings are of other joints, or there is no measurement frame.
        """
        q = _as_readings("readings", readings, self.robot)
        return PredictedPoses(*predict_poses(self.posterior, q, self.table_in_world(table, world=world), context))

    def table_in_world(self, number: int | None, *, world: bool) -> int | None:
        """The number of the table whose estimated measurement frame is meant; None without `world`: the base frame.

        Raises:
            InputError: There is no such frame, or there are several.
        """
        if not world:
            if number is not None:
                raise InputError("table", f"found {number} without world", "the measurement frame asked for")
            return None
        known = [int(frame.symbol[2:-1]) for frame in self.posterior.variables.frames]
        if not known or self.posterior.variables.n_robot_columns == self.posterior.variables.n_columns:
            raise InputError("world", "the measurement frame was not estimated, or not saved", "the base frame")
        if number is None and len(known) == 1:
            return known[0]
        if number is None or number not in known:
            found = "several measurement frames" if number is None else f"found {inputs.shown(number)}"
            raise InputError("table", found, f"one of {', '.join(map(str, known))}: the table whose frame is meant")
        return int(number)

    def __repr__(self) -> str:
        return "\n".join(summary(self.result))

    def __str__(self) -> str:
        return format_result(self.report_data)

    def _repr_html_(self) -> str:
        return notebook_html(self.result)


@parallel.single_threaded
def predict(
    calibration: Calibration | Path | str,
    readings: ArrayLike | None = None,
    context: Context | None = None,
    *,
    limit: float | None = None,
    measured: ArrayLike | None = None,
) -> PredictedErrors:
    """Expected errors of the tool: what `fg-calib predict` shows.

    They are those of the covariance: of the noise and the prior sigmas. Unmodelled effects are not part of them.

    Args:
        calibration: The calibration; or the folder that `save` or `calibrate --out` wrote, which says what was
            measured, as a calibration just made does.
        readings: Configurations, shape (n, n_joints), or (n_joints,) of one, [rad] (prismatic: [m]); drawn all over the
            workspace if None.
        context: What effects depend on besides at `readings`, a row each: see `Robot.trig`.
        limit: Limit of position errors, [m].
        measured: Readings of the measured configurations, shape (m, n_joints), of a calibration that was loaded.

    Raises:
        InputError: The calibration cannot be read, estimated nothing, or does not say what was measured; readings are
            of other joints, not finite, or outside the limits.
    """
    if limit is not None:
        inputs.check_number("limit", limit, above=True)
    found = calibration if isinstance(calibration, Calibration) else Calibration.load(calibration)
    if found.result.evaluated_only:
        raise InputError(found.result.robot, "the arm was only evaluated: nothing was estimated", "a calibration")
    there = found.measured if measured is None else _possible_readings("measured", measured, found.robot)
    if there is None:
        place, expected = str(found.folder or "calibration"), "configurations.csv, or `measured`"
        raise InputError(place, "nothing says what was measured", expected)
    at = None if readings is None else _possible_readings("readings", readings, found.robot)
    sigma = found.result.sigma_joint if np.any(found.result.sigma_joint > 0.0) else None
    more: dict[str, Any] = {"fitted": found.result.free_of_frame, "limit": limit, "context": context}
    return predict_errors(found.robot, found.posterior, there, at, sigma_joint=sigma, **more)


def _as_readings(name: str, given: ArrayLike, robot: Robot) -> Floats:
    """Readings of one or many configurations, shape (n, n_joints)."""
    shape = f"(n, {robot.n_joints})"
    return inputs.as_floats(name, np.atleast_2d(inputs.as_figures(name, given, f"numbers of shape {shape}")), shape)


def _possible_readings(name: str, given: ArrayLike, robot: Robot) -> Floats:
    """Readings of at least one configuration, within the limits."""
    readings = _as_readings(name, given, robot)
    inputs.expect(len(readings), name, "no configurations", "one or more")
    check_readings(readings, robot, name)
    return readings


@checked
def correct(
    calibration: Calibration,
    position: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    context: Context | None = None,
    *,
    near: ArrayLike | None = None,
    world: bool = False,
    table: int | None = None,
) -> Correction:
    """Commands with which the calibrated arm reaches targets.

    Args:
        calibration: The calibration; the nominal arm, as the controller knows it, is that which it began with.
        position: Where the tool point is to be, shape (n, 3), or (3,) of one target, [m]. If None the targets are the
            poses of the nominal arm at `near`: what a program of joint values was meant to reach.
        rotation: Orientations wanted, shape (n, 3, 3), or (3, 3); any if None.
        context: What effects depend on besides at the targets, such as temperatures, a row each: see `Robot.trig`.
        near: Joint values to stay near, shape (n, n_joints) or (n_joints,), [rad] (prismatic: [m]): of an arm that
            reaches a target in several ways they choose one. If None that is the first that is found, searched for from
            the middle of the limits and, where that leads nowhere, from anywhere.
        world: Whether the targets are in the measurement frame, instead of the base frame.
        table: Number of the table whose measurement frame it is, from 0; there must be one if there are several.

    Raises:
        InputError: Targets or joint values are not of such a shape, not finite, or outside the limits; there is no
            measurement frame.
    """
    if world and position is None:
        raise InputError("world", "joint values reach poses in the base frame", "targets with positions")
    number = calibration.table_in_world(table, world=world)
    posterior, nominal = calibration.posterior, calibration.nominal
    return correct_targets(posterior, calibration.robot, nominal, position, rotation, context, near=near, table=number)


@checked
def write_report(path: Path | str, folder: Path | str | None = None, *, figures: bool = False) -> None:
    """Write `report.html` of a saved calibration: one page that needs no other file.

    Args:
        path: The folder that `save` or `calibrate --out` wrote, or its `result.json`.
        folder: Where to; the folder of the result if None.
        figures: Whether to write its figures too, as SVG files.

    Raises:
        InputError: There is no such calibration, it is damaged, or the folder cannot be written.
    """
    found = Calibration.load(path)
    texts = pages_of(found.report_data, report=True, figures=figures)
    io.fill_folder(Path(folder or found.folder or ""), texts, {name: io.RESULT_FILES[name] for name in texts})


def _with_priors(robot: Robot, result: io.Result) -> Robot:
    """A robot with the priors of a result, which may have been estimated, and with its estimated parameters."""
    curves = [p.name for p in robot.parameters if p.kind == "curve"]
    estimated = {p.name for p in result.estimated}.intersection(curves).union(result.covariance.names)
    robot, prior = robot.with_estimated(estimated), {p.name: p.prior_sigma for p in result.parameters}
    return replace(
        robot, parameters=tuple(replace(p, tolerance=prior[p.name] or p.tolerance) for p in robot.parameters)
    )


def _posterior(robot: Robot, result: io.Result, place: str) -> TangentCovariance:
    """The saved covariance, of a nominal robot.

    Raises:
        InputError: The covariance is that of another robot.
    """
    poses = [np.zeros(6)] if not result.frames else []
    for frame in result.frames.values():
        x, y, z, w = frame.quaternion_xyzw.tolist()
        poses.append(frame_of(gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), frame.xyz)))
    unknown = [int(symbol[2:-1]) for symbol in result.frames]
    variables = build_variables(robot, [t in unknown for t in range(max(unknown, default=0) + 1)], False)
    saved, n, covariance = result.posterior, variables.n_columns, result.covariance.matrix
    values = np.concatenate([[p.estimate for p in result.parameters], *poses])
    if saved is None and tuple(variables.names) == result.covariance.names:
        return _posterior_of_names(variables, values, covariance)
    if saved is None or saved.variables != {v.symbol: tuple(variables.names[v.columns]) for v in variables.items}:
        raise InputError(place, "other variables than the robot and the covariance have", f"{n} columns of them")
    matrices = (saved.covariance, saved.undetermined, saved.undetermined_at_nominal)
    curves = saved.curves if len(saved.curves) else np.zeros((0, n))
    found = TangentCovariance(variables, values, *(M.reshape(len(M), n) for M in matrices), curves=curves)
    if len(curves) != variables.n_curves:
        raise InputError(f"{place}: curves", f"{len(curves)} rows", f"{variables.n_curves}, one a coefficient")
    sigma_of = {one.name: one.sigma for one in result.parameters}
    sigma = [sigma_of[name] for name in found.curve_names]
    variance = np.append(np.diag(found.named()), found.variance(curves))
    expected = np.append(np.diag(covariance), np.array(sigma, dtype=np.float64) ** 2)
    if not np.allclose(variance, expected, 1e-6, 0.0, equal_nan=True):
        raise InputError(place, "variances of parameters other than those of covariance", "the same", "was it changed?")
    return found


def _posterior_of_names(variables: Variables, values: Floats, covariance: Floats) -> TangentCovariance:
    """The covariance of the parameters in the tangent space; what has no variance counts as undetermined."""
    E, unknown = variables.tangent_derivative(values), np.isnan(np.diag(covariance))
    undetermined = (E @ np.eye(len(covariance))[:, unknown]).T / variables.scales
    undetermined /= np.linalg.norm(undetermined, axis=1, keepdims=True)
    tangent = E @ np.where(unknown[:, None] | unknown, 0.0, covariance) @ E.T
    return TangentCovariance(variables, values, tangent, undetermined, undetermined)


def _knowledge(robot: Robot, saved: io.Knowledge) -> Knowledge:
    """The information of the rows of a saved result.

    Raises:
        InputError: The information is that of another robot.
    """
    nominal = None if saved.nominal is None else _knowledge(robot, saved.nominal)
    fields = {name: getattr(saved, name) for name in ("unknowns", "at", "rows", "right", "views")}
    found = Knowledge(robot=robot.with_values(saved.parameters), nominal=nominal, **fields)
    if found.variables.names != saved.columns:
        raise InputError(
            "result.json: carried", "information on other parameters than those estimated", "that of one run"
        )
    return replace(found, rows=saved.rows.reshape(len(saved.rows), len(found.scales)))


def _date_and_days(given: str | None, before: str) -> tuple[str, float | None]:
    """A date, now if None, and the days to it from the date before; None where that is not known.

    Raises:
        InputError: The text is no date, or the date is a day or more before the other.
    """
    text = given or datetime.now(UTC).isoformat(timespec="seconds")
    try:
        dates = [datetime.fromisoformat(date) for date in (before or text, text)]
    except ValueError:
        raise InputError("date", f"found {inputs.shown(given)}", "a date such as 2026-03-01") from None
    first, second = (date if date.tzinfo else date.replace(tzinfo=UTC) for date in dates)
    days = (second - first).total_seconds() / 86400.0
    if days <= -1.0:  # a date without a time zone may be of the same day
        raise InputError("date", f"{text} is before the calibration, {before}", "a later one")
    return text, max(days, 0.0) if before else None
