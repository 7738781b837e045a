"""Candidates of a job: its measurements count already, and more are chosen, anywhere or among the job's own rows.

A solved job becomes a scenario: each table is an instrument in the frame in which it measured, and landmarks stand
where they were estimated. Candidates for more rows are then drawn as those of any scenario.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib import assessment, graph, measurements, observability, simulation
from fg_calib.designs.candidates import Pool, pool_of
from fg_calib.initialization import Camera
from fg_calib.inputs import PAIR_MODELS, POSE_MODELS, Floats, InputError, expect
from fg_calib.job import Job
from fg_calib.robot import pose
from fg_calib.simulation import Configurations, Errors, Instrument, Placement, Plane, RandomReadings, Scenario, Spot

MIN_CONE_RAD = np.deg2rad(60.0)
"""New views may be at least as oblique as this angle between a board's normal and the direction to the camera."""


def solve_for_design(job: Job) -> graph.Problem:
    """Solve a job, with everything estimated; the problem at its solution.

    Raises:
        ProblemError: The measurements lack what the model needs, or do not suffice.
        SolverError: GTSAM could not solve a step at all.
    """
    expected = "tables of poses, which pairs may be formed from"
    for m in (table.measurements for table in job.tables):
        expect(m.pairs is None, m.source, "pairs that are measured directly", expected)
    gauge = "prior" if job.options.gauge == "keep" else job.options.gauge
    options = replace(job.options, gauge=gauge, folds=None, encoder="propagated")
    solution = assessment.solve_job(replace(job, options=options))
    if solution.problem.evaluated:
        raise InputError(str(job.path or "job"), "test rows alone", "train rows: what was measured is what counts")
    return graph.relinearized_at(solution.problem, solution.parameters)


def pool_of_rows(problem: graph.Problem, source: str) -> Pool:
    """The pool of a solved problem's train rows.

    Pairs must share one reference pose: the information of any other pair belongs to two poses.

    Raises:
        InputError: Pairs without one reference pose.
    """
    data = problem.data
    train = np.concatenate([data.places[s.table][s.ends[s.train]].ravel() for s in data.blocks])
    pool = pool_of(problem, train, source)
    return replace(pool, found={"": simulation.Candidates(pool.readings, len(pool.readings), {})})


def scenario_of(problem: graph.Problem, configurations: Configurations | None = None, source: str = "job") -> Scenario:
    """The scenario in which a solved problem's tables were measured.

    Args:
        problem: The problem, at its solution.
        configurations: Where to measure; if None what cameras see of their boards, and anywhere for the others.
        source: The job's name, for messages.

    Raises:
        InputError: A table holds custom measurements.
    """
    names, instruments = list[str](), list[Instrument]()
    for number, table in enumerate(problem.data.tables):
        stem = re.sub("[^A-Za-z0-9_-]", "_", Path(table.measurements.source).stem).strip("_-") or "table"
        names.append(stem if stem not in names else f"{stem}_{len(names) + 1}")
        if table.own or table.model is None:
            expected = "candidates from the job's own rows: --candidates rows"
            raise InputError(f"{source}: {table.measurements.source}", "custom measurements", expected)
        instruments.append(_instrument_of(problem, number, names[-1], configurations))
    robot = problem.robot.with_values(problem.start[problem.variables.robot_span])
    noise = measurements.Noise(joint=tuple(problem.sigma_joint.tolist()))
    none, at, job = Errors("values", {}), configurations or RandomReadings(1), {"gauge": problem.options.gauge}
    return Scenario(robot, none, at, noise, "base", job=job, name=source, source=source, instruments=tuple(instruments))


def _instrument_of(problem: graph.Problem, number: int, name: str, configurations: Configurations | None) -> Instrument:
    """The instrument that measured a table, landmarks where the solution puts them."""
    table, places = problem.data.tables[number], observability.places_of(problem, problem.start)
    m, model = table.measurements, table.model
    given: dict[str, Any] = {"name": name, "model": model, "noise": _noise_of(problem, number)}
    given["configurations"] = configurations or RandomReadings(1)
    contact = not np.nan_to_num(m.columns.get("distance", np.zeros(1))).any()

    def points(letter: str, column: str) -> dict[str, Spot]:
        names, prior = _names(m, column), {one: point.tolerance or 0.0 for one, point in table.known.items()}
        return {one: Spot(places[letter, one], prior.get(one)) for one in names}

    frame: Placement | str = "base"
    if table.unknown_frame:
        found = graph.pose_of(places["X", problem.data.labels[number]])
        frame = Placement(found.rotation().matrix(), found.translation())
    if m.groups is not None:
        given |= {"model": "distance", "sockets": {one: Spot(places["L", one]) for one in m.groups.names}}
    elif model in PAIR_MODELS:
        given["pairing"] = table.pairing
    elif model in POSE_MODELS:
        tool_too = "target" in m.labels and bool((m.labels["target"].index < 0).any())
        given |= {"targets": points("P", "target") or None, "tool_too": tool_too, "frame": frame}
    elif model == "anchor":
        offset = float(places["O", f"offset of {m.source}"][0]) if table.offset else None
        given |= {"anchors": points("A", "anchor"), "offset": offset, "contact": contact}
    elif model == "plane":
        planes = {one: _plane(places["C", one], places["F", one]) for one in _names(m, "plane")}
        given |= {"planes": planes, "contact": contact}
    elif table.fixed_camera:
        given |= {"fixed": True, "frame": frame}
    elif "board" in measurements.INSTRUMENTS[str(model)].labels:
        robot = problem.robot.with_values(problem.start[problem.variables.robot_span])
        boards = {one: places["B", one] for one in _names(m, "board") or ("board",)}
        given = given | _seen(boards, pose(robot, m.readings).position, m.image, table.camera)
        given |= {} if configurations is None else {"configurations": configurations}
    if m.image is not None:
        given |= {"camera": table.camera, "corners": np.unique(m.image[:, 2:], axis=0)}
    return Instrument(**given)


def _names(m: measurements.Measurements, column: str) -> tuple[str, ...]:
    """Landmarks that a column names; none without such a column."""
    return m.labels[column].names if column in m.labels else ()


def _plane(c: Floats, f: Floats) -> Plane:
    """The plane of the points whose residual is 0, by two points along its normal, the second on it."""
    n = (f - c) / np.linalg.norm(f - c)
    return Plane(n, float(n @ f))


def _noise_of(problem: graph.Problem, number: int) -> measurements.Noise:
    """Specified noise of a table's train rows, times the factors where noise was estimated."""
    table = problem.data.tables[number]
    m, formed = table.measurements, dict[str, str]()
    kinds = ("orientation", "position", "distance", "point", "pixel", *m.sigmas)
    sigmas = {kind: sigma[~m.test] for kind in kinds if (sigma := m.sigma(kind)) is not None}
    if m.covariance is not None:
        S = np.sqrt(np.diagonal(m.covariance, axis1=1, axis2=2))[~m.test]
        sigmas |= {"orientation": S[:, :3], "position": S[:, 3:]}
    if m.groups is not None:
        sigmas["distance"] = m.groups.pairs.sigma_distance
    elif table.model in PAIR_MODELS:
        formed = {"position": "distance", "orientation": "angle"}
    specified: dict[str, Any] = {}
    for kind, sigma in sigmas.items():
        if np.isfinite(sigma).any():
            factor = problem.state.factors.get((number, formed.get(kind, kind)), 1.0)
            specified[kind] = factor * float(np.sqrt(np.nanmean(np.square(sigma))))
    return measurements.Noise().updated(**specified)


def _seen(boards: Mapping[str, Floats], tool: Floats, image: Floats | None, camera: Camera | None) -> dict[str, Any]:
    """The boards, whether they were seen from behind, and views of the first of them.

    Views are from the measured range of distances, at the measured angles and a little more oblique ones. Corners stay
    in the largest circle about the optical axis that the measured ones reach in u and in v.
    """
    placed = {name: Placement(Rotation.from_rotvec(at[:3]).as_matrix(), at[3:]) for name, at in boards.items()}
    behind = [name for name, b in placed.items() if np.median((tool - b.position) @ b.rotation[:, 2]) < 0.0]
    first, board = next(iter(placed.items()))
    points = np.zeros((1, 2)) if image is None else image[:, 2:]
    centre, size = 0.5 * (points.min(axis=0) + points.max(axis=0)), np.ptp(points, axis=0)
    turn = np.diag([1.0, -1.0, -1.0]) if first in behind else np.eye(3)
    board = Placement(board.rotation @ turn, board.position + board.rotation[:, :2] @ centre)
    away = tool - board.position
    distance = np.linalg.norm(away, axis=1)
    oblique = np.arccos(np.clip(away @ board.rotation[:, 2] / distance, -1.0, 1.0))
    span, cone = (0.8 * float(distance.min()), 1.2 * float(distance.max())), float(np.quantile(oblique, 0.9))
    views = simulation.BoardViews(board, count=1, distance=span, cone=max(MIN_CONE_RAD, cone))
    if image is not None and camera is not None and size.min() > 0.0:
        off = np.abs(image[:, :2] - [camera.cx, camera.cy]).max(axis=0) / [camera.fx, camera.fy]
        angle = np.arctan(max(off.min(), 0.5 * np.hypot(*size) / distance.max()))  # far away all of the board is seen
        views = replace(views, field_of_view=float(angle), board_size=tuple(size.tolist()))
    return {"boards": placed, "from_behind": tuple(behind), "configurations": views}
