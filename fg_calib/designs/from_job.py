"""The pool of a job: earlier measurements count, and more are chosen, anywhere or among the job's own rows.

A job becomes a scenario: each table is an instrument with candidates of its own, in the frame in which it measured, and
everything is where the solution puts it. So candidates for more rows are found as those of a scenario.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.assessment import solve_job
from fg_calib.designs.candidates import NONE, REFERENCE, Pool, build_pool, draw_groups
from fg_calib.designs.information import gather_rows
from fg_calib.graph import Problem, places_of, pose_of, relinearized_at
from fg_calib.inputs import PAIR_MODELS, POSE_MODELS, Floats, InputError
from fg_calib.job import Job
from fg_calib.measurements import Noise, Table
from fg_calib.robot import pose
from fg_calib.simulation import (
    BoardViews,
    Candidates,
    Configurations,
    Errors,
    Instrument,
    Placement,
    Plane,
    RandomReadings,
    Scenario,
    Spot,
)

MIN_CONE_RAD = np.deg2rad(60.0)
"""Angle between a board's normal and the direction to the camera that new views may have at least."""


def solve_for_design(job: Job) -> Problem:
    """Solve a job, with everything estimated; the problem at its solution.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    for table in job.tables:
        if table.measurements.pairs is not None:
            expected = "tables of poses, which pairs may be formed from"
            raise InputError(table.measurements.source, "pairs that are measured directly", expected)
    gauge = "prior" if job.options.gauge == "keep" else job.options.gauge
    options = replace(job.options, gauge=gauge, folds=None, encoder="propagated")
    solution = solve_job(replace(job, options=options))
    if solution.problem.evaluated:
        raise InputError(str(job.path or "job"), "test rows alone", "train rows: what was measured is what counts")
    return relinearized_at(solution.problem, solution.parameters)


def pool_for_more_rows(
    problem: Problem, n: int, generator: np.random.Generator, configurations: Configurations | None, source: str
) -> Pool:
    """The pool for more rows of a solved problem's tables.

    Args:
        problem: The problem, at its solution.
        n: Number of candidates that are drawn for each table.
        generator: Draws them.
        configurations: Where to measure; see `scenario_of`.
        source: The job's name, for messages.

    Raises:
        InputError: A table holds custom measurements, or nothing can be measured from anywhere.
    """
    scenario = scenario_of(problem, configurations, source)
    return build_pool(scenario, draw_groups(scenario, n, generator), before=problem)


def pool_of_rows(problem: Problem, source: str) -> Pool:
    """The pool of a solved problem's train rows.

    Pairs must share one reference pose: what other pairs share is not one pose's.

    Raises:
        InputError: Pairs without one reference pose.
    """
    data = problem.data
    references, used = np.zeros(0, dtype=np.int64), np.zeros(data.n_configurations, dtype=np.bool_)
    for s in data.series:
        ends = data.places[s.table][s.ends[s.train]]
        if s.kind.ends == 2:
            if len(np.unique(ends[:, 0])) > 1:
                raise InputError(source, "pairs that are no star", "pairing star, or candidates that are no rows")
            references = np.union1d(references, ends[:, 0])
        used[ends] = True
    used[references] = False
    which = np.full(data.n_configurations, NONE)  # test rows
    which[references] = REFERENCE
    which[used] = np.arange(int(used.sum()))
    readings = data.readings[used]
    return Pool(
        scenario=None,
        tables=data.tables,
        problem=problem,
        readings=readings,
        group=np.full(len(readings), ""),
        pose_of=which,
        rows=gather_rows(problem, which, references),
        given=np.zeros(0, dtype=np.int64),
        found={"": Candidates(readings, len(readings), {})},
    )


def scenario_of(problem: Problem, configurations: Configurations | None = None, source: str = "job") -> Scenario:
    """The scenario in which a solved problem's tables were measured.

    Args:
        problem: The problem, at its solution.
        configurations: Where to measure; if None what cameras see of their boards, and anywhere for the others.
        source: The job's name, for messages.

    Raises:
        InputError: A table holds custom measurements.
    """
    names = list[str]()
    for table in problem.data.tables:
        stem = Path(table.measurements.source).stem
        stem = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stem).strip("_-") or "table"
        names.append(stem if stem not in names else f"{stem}_{len(names) + 1}")
    instruments = []
    for number, (table, name) in enumerate(zip(problem.data.tables, names, strict=True)):
        if table.own or table.model is None:
            expected = "candidates from the job's own rows: --candidates rows"
            raise InputError(f"{source}: {table.measurements.source}", "custom measurements", expected)
        instruments.append(_Reader(problem, table, number, name, configurations).instrument())
    return Scenario(
        robot=problem.robot.with_values(problem.start[problem.variables.robot_span]),
        errors=Errors("values", {}),
        configurations=configurations or RandomReadings(1),
        noise=Noise(joint=tuple(problem.sigma_joint.tolist())),
        frame="base",
        job={"gauge": problem.options.gauge},
        name=source,
        source=source,
        instruments=tuple(instruments),
    )


@dataclass(frozen=True)
class _Reader:
    """One table as an instrument, with landmarks where the solution puts them."""

    problem: Problem
    table: Table
    number: int
    name: str
    configurations: Configurations | None

    def instrument(self) -> Instrument:
        """The instrument that measured the table."""
        table, m, model = self.table, self.table.measurements, self.table.model
        given: dict[str, Any] = {
            "name": self.name,
            "model": model,
            "noise": self.noise(),
            "configurations": self.configurations or RandomReadings(1),
        }
        contact = m.length is None or not np.nan_to_num(m.length).any()
        if model in POSE_MODELS:
            frame: Placement | str = self.frame() if table.unknown_frame else "base"
            return Instrument(**given, targets=self.points("P", "target") or None, frame=frame)
        if model in PAIR_MODELS:
            if m.groups is not None:
                sockets = {name: Spot(self.place("L", name)) for name in m.groups.names}
                return Instrument(**given | {"model": "distance"}, sockets=sockets)
            return Instrument(**given, pairing=table.pairing)
        if model == "anchor":
            offset = float(self.place("O", f"offset of {m.source}")[0]) if table.offset else None
            return Instrument(**given, anchors=self.points("A", "anchor"), offset=offset, contact=contact)
        if model == "plane":
            return Instrument(**given, planes={n: self.plane(n) for n in m.labels["plane"].names}, contact=contact)
        return self.camera(given)

    def noise(self) -> Noise:
        """Specified noise of the train rows, times the factors where noise was estimated."""
        m = self.table.measurements
        pairs, train = m.pairs, ~m.test
        formed = self.table.model in PAIR_MODELS and pairs is None and m.groups is None
        if pairs is None and m.groups is not None and m.groups.pairs.n_pairs:
            pairs = m.groups.pairs
        covariance = None if m.covariance is None else np.sqrt(np.einsum("nii->ni", m.covariance))
        sigmas = {
            "position": m.sigma_position if covariance is None else covariance[:, 3:],
            "orientation": m.sigma_orientation if covariance is None else covariance[:, :3],
            "distance": m.sigma_length if pairs is None else pairs.sigma_distance,
            "angle": None if pairs is None else pairs.sigma_angle,
            "point": m.sigma_point,
            "pixel": m.sigma_pixel,
        }
        estimated_as = {"position": "distance", "orientation": "angle"} if formed else {}
        found = dict[str, Any]()
        for kind, sigma in sigmas.items():
            of_pairs = pairs is not None and kind in ("distance", "angle")
            used = None if sigma is None else sigma[~pairs.test if pairs is not None and of_pairs else train]
            measured = used is not None and np.isfinite(used).any()
            specified = float(np.sqrt(np.nanmean(np.square(used)))) if used is not None and measured else None
            factor = self.problem.state.factors.get((self.number, estimated_as.get(kind, kind)), 1.0)
            found[kind] = None if specified is None else specified * factor
        return Noise(**found)

    def frame(self) -> Placement:
        """world_T_base of the table."""
        p = self.problem
        frame = next(v for v in p.variables.frames if v.symbol == f"X({self.number})")
        found = pose_of(p.start[frame.places])
        return Placement(found.rotation().matrix(), found.translation())

    def place(self, letter: str, name: str) -> Floats:
        """Coordinates of a landmark."""
        return places_of(self.problem, self.problem.start)[letter, name]

    def points(self, letter: str, column: str) -> Mapping[str, Spot]:
        """Points that a column names; none without such a column."""
        labels, known = self.table.measurements.labels.get(column), self.table.known
        names = () if labels is None else labels.names
        prior = {name: (point.tolerance or 0.0) for name, point in known.items()}
        return {name: Spot(self.place(letter, name), prior.get(name)) for name in names}

    def plane(self, name: str) -> Plane:
        """The plane of the points whose residual is 0."""
        c, f = self.place("C", name), self.place("F", name)
        n = (f - c) / np.linalg.norm(f - c)
        return Plane(n, float(n @ f))

    def camera(self, given: dict[str, Any]) -> Instrument:
        """A camera, and where its boards are."""
        table, m = self.table, self.table.measurements
        if table.model == "pixels":
            assert m.image is not None
            given |= {"camera": table.camera, "corners": np.unique(m.image[:, 2:], axis=0)}
        if table.fixed_camera:
            return Instrument(**given, fixed=True, frame=self.frame())
        boards, from_behind = dict[str, Placement](), list[str]()
        robot = self.problem.robot.with_values(self.problem.start[self.problem.variables.robot_span])
        tool = pose(robot, m.readings).position
        for name in m.labels["board"].names if "board" in m.labels else ("board",):
            place = self.place("B", name)
            board = Placement(Rotation.from_rotvec(place[:3]).as_matrix(), place[3:])
            if np.median((tool - board.position) @ board.rotation[:, 2]) < 0.0:
                from_behind.append(name)
            boards[name] = board
        if self.configurations is None:
            name = next(iter(boards))
            given["configurations"] = self.views(boards[name], tool, flip=name in from_behind)
        return Instrument(**given, boards=boards, from_behind=tuple(from_behind))

    def views(self, board: Placement, tool: Floats, *, flip: bool) -> BoardViews:
        """Views of a board from as far and as near as it was seen from, and a little more oblique."""
        if flip:
            board = Placement(board.rotation @ np.diag([1.0, -1.0, -1.0]), board.position)
        away = tool - board.position
        distance = np.linalg.norm(away, axis=1)
        oblique = np.arccos(np.clip(away @ board.rotation[:, 2] / distance, -1.0, 1.0))
        span = (0.8 * float(distance.min()), 1.2 * float(distance.max()))
        return BoardViews(board, count=1, distance=span, cone=max(MIN_CONE_RAD, float(np.quantile(oblique, 0.9))))
