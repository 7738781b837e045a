"""A job as a scenario: the instruments that measured its tables, and where everything is by its solution.

So candidates for more rows come about as those of a scenario do. Each table is an instrument with candidates of its
own, in the frame in which it measured: a tracker stays where it stood.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.errors import InputError
from fg_calib.graph.factors import pose_of
from fg_calib.graph.knowledge import coordinates_of
from fg_calib.graph.problem import Problem
from fg_calib.measurements.dataset import Measurements, Noise
from fg_calib.measurements.table import Table
from fg_calib.options import PAIR_MODELS, POSE_MODELS
from fg_calib.robot.kinematics import pose
from fg_calib.simulation.configurations import BoardViews, Configurations, Placement, RandomReadings
from fg_calib.simulation.instruments import (
    BoardCamera,
    BoardPoints,
    Indicator,
    Instrument,
    LengthGauge,
    PairGauge,
    Plane,
    Sockets,
    Spot,
    Tracker,
)
from fg_calib.simulation.scenario import Errors, Scenario

Floats = NDArray[np.float64]

WIDEST = np.deg2rad(60.0)
"""Largest angle between a board's normal and the direction to the camera, where measured ones are smaller."""


def scenario_of(problem: Problem, configurations: Configurations | None = None, source: str = "job") -> Scenario:
    """The scenario that a solved problem's tables were measured in.

    Args:
        problem: The problem, at its solution.
        configurations: Where to measure; if None what cameras see of their boards, and anywhere else for the others.
        source: The job's name, for messages.

    Raises:
        InputError: A table holds measurements of a kind of one's own.
    """
    v = problem.variables
    robot = problem.robot.with_values(problem.start[v.robot_span])
    names = _names([table.measurements.source for table in problem.data.tables])
    instruments = tuple(
        _Table(problem, number, names[number], source).instrument(configurations)
        for number in range(len(problem.data.tables))
    )
    return Scenario(
        robot=robot,
        errors=Errors("values", {}),
        configurations=configurations or RandomReadings(1),
        noise=Noise(joint=tuple(problem.sigma_joint.tolist())),
        frame="base",
        job={"gauge": problem.options.gauge},
        name=source,
        source=source,
        instruments=instruments,
    )


def _names(sources: list[str]) -> list[str]:
    """A name for each table, no two the same."""
    found: list[str] = []
    for source in sources:
        stem = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in Path(source).stem).strip("_-")
        name, k = stem or "table", 2
        while name in found:
            name, k = f"{stem or 'table'}_{k}", k + 1
        found.append(name)
    return found


class _Table:
    """One table, and where what it measured is."""

    def __init__(self, problem: Problem, number: int, name: str, source: str) -> None:
        self._problem, self._number, self._name = problem, number, name
        self._table: Table = problem.data.tables[number]
        self._m: Measurements = self._table.measurements
        self._place = f"{source}: {self._m.source}"

    def instrument(self, configurations: Configurations | None) -> Instrument:
        """What measured the table."""
        table, model = self._table, self._table.model
        if table.own or model is None:
            expected = "candidates from the job's own rows: --candidates rows"
            raise InputError(self._place, "measurements of a kind of one's own", expected)
        given: dict[str, Any] = {
            "name": self._name,
            "model": model,
            "noise": self._noise(),
            "configurations": configurations or RandomReadings(1),
        }
        if model in POSE_MODELS:
            frame: Placement | str = self._frame() if table.unknown_frame else "base"
            return Tracker(**given, targets=self._spots("P", "target"), frame=frame)
        if model in PAIR_MODELS:
            if self._m.groups is not None:
                return Sockets(**given | {"model": "distance"}, sockets=self._points("L", self._m.groups.names))
            return PairGauge(**given) if self._m.pairs is not None else Tracker(**given, pairing=table.pairing)
        if model == "anchor":
            return LengthGauge(
                **given, anchors=self._spots("A", "anchor"), offset=self._offset(), contact=self._in_contact()
            )
        if model == "plane":
            return Indicator(**given, planes=self._planes(), contact=self._in_contact())
        return self._camera(given, configurations)

    def _noise(self) -> Noise:
        """The noise of train rows as it is stated, times the factors that were found where it was estimated."""
        m, pairs = self._m, self._m.pairs if self._m.pairs is not None else None
        if pairs is None and m.groups is not None and m.groups.pairs.n_pairs:
            pairs = m.groups.pairs
        train, between = ~m.test, None if pairs is None else ~pairs.test
        of_pose = None if m.covariance is None else np.sqrt(np.einsum("nii->ni", m.covariance))
        lengths = _typical(m.sigma_length, train) if pairs is None else _typical(pairs.sigma_distance, between)
        formed = self._table.model in PAIR_MODELS and pairs is None
        position = _typical(m.sigma_position if of_pose is None else of_pose[:, 3:], train)
        orientation = _typical(m.sigma_orientation if of_pose is None else of_pose[:, :3], train)
        return Noise(
            position=self._found("distance" if formed else "position", position),
            orientation=self._found("angle" if formed else "orientation", orientation),
            distance=self._found("distance", lengths),
            angle=self._found("angle", None if pairs is None else _typical(pairs.sigma_angle, between)),
            point=self._found("point", _typical(m.sigma_point, train)),
            pixel=self._found("pixel", _typical(m.sigma_pixel, train)),
        )

    def _found(self, kind: str, stated: float | None) -> float | None:
        """A sigma of one of the table's kinds as it was found to be."""
        return None if stated is None else stated * self._problem.state.factors.get((self._number, kind), 1.0)

    def _frame(self) -> Placement:
        """world_T_base of the table."""
        p = self._problem
        frame = next(v for v in p.variables.frames if v.symbol == f"X({self._number})")
        found = pose_of(p.start[frame.places])
        return Placement(found.rotation().matrix(), found.translation())

    def _known(self, letter: str, name: str) -> Floats:
        """Coordinates of an unknown by its solution, or where it is said to be."""
        p = self._problem
        u = p.data.unknowns
        place = coordinates_of(p.variables, u, (letter, name))
        index = next(i for i, key in enumerate(zip(u.letters, u.names, strict=True)) if key == (letter, name))
        return np.array(u.starts[index] if place is None else p.start[place])

    def _points(self, letter: str, names: tuple[str, ...]) -> Mapping[str, Spot]:
        known = self._table.known
        tolerance = {name: (point.tolerance or 0.0) for name, point in known.items()}
        return {name: Spot(self._known(letter, name), tolerance.get(name)) for name in names}

    def _spots(self, letter: str, column: str) -> Any:
        """Points that a column names; none where there is no such column."""
        labels = self._m.labels.get(column)
        return {} if labels is None else self._points(letter, labels.names)

    def _offset(self) -> float | None:
        return float(self._known("O", f"offset of {self._m.source}")[0]) if self._table.offset else None

    def _in_contact(self) -> bool:
        return self._m.length is None or not np.nan_to_num(self._m.length).any()

    def _planes(self) -> Mapping[str, Plane]:
        """The planes: those points x whose residual is 0."""
        found = {}
        for name in self._m.labels["plane"].names:
            c, f = self._known("C", name), self._known("F", name)
            n = (f - c) / np.linalg.norm(f - c)
            found[name] = Plane(n, float(n @ f))
        return found

    def _camera(self, given: dict[str, Any], configurations: Configurations | None) -> Instrument:
        """A camera, and where its boards are."""
        table, m = self._table, self._m
        if table.model == "pixels":
            assert m.image is not None
            corners = np.unique(m.image[:, 2:], axis=0)
            given |= {"camera": table.camera, "corners": BoardPoints(corners)}
        if table.fixed_camera:
            return BoardCamera(**given, fixed=True, frame=self._frame())
        names = m.labels["board"].names if "board" in m.labels else ("board",)
        boards = {name: self._board(self._known("B", name)) for name in names}
        if configurations is None:
            given["configurations"] = self._views(next(iter(boards.values())))
        return BoardCamera(**given, boards=boards)

    def _board(self, known: Floats) -> Placement:
        """A board, turned over about its x axis if it was seen from below: simulated ones are seen from above."""
        R = Rotation.from_rotvec(known[:3]).as_matrix()
        above = (self._tool() - known[3:]) @ R[:, 2]
        return Placement(R if np.median(above) > 0.0 else R @ np.diag([1.0, -1.0, -1.0]), known[3:])

    def _tool(self) -> Floats:
        """Where the tool was, shape (n, 3), [m]."""
        p = self._problem
        points: Floats = pose(p.robot.with_values(p.start[p.variables.robot_span]), self._m.readings).position
        return points

    def _views(self, board: Placement) -> BoardViews:
        """Views of a board from as far and as near as it was seen from, and a little more aslant."""
        away = self._tool() - board.position
        distance = np.linalg.norm(away, axis=1)
        aslant = np.arccos(np.clip(away @ board.rotation[:, 2] / distance, -1.0, 1.0))
        range_ = (0.8 * float(distance.min()), 1.2 * float(distance.max()))
        return BoardViews(board, count=1, distance=range_, cone=max(WIDEST, float(np.quantile(aslant, 0.9))))


def along_axes(table: Table, like: Table) -> Table:
    """A table whose poses are as noisy along each axis, beside the others, as the train rows of another table.

    Args:
        table: It, as noisy along all of them.
        like: The other.
    """
    m, of = table.measurements, like.measurements
    changes = {}
    for name in ("sigma_position", "sigma_orientation"):
        sigma, stated = getattr(m, name), getattr(of, name)
        whole = _typical(stated, ~of.test)
        if sigma is not None and whole and np.isfinite(stated[~of.test]).any(axis=0).all():
            axes = [_typical(stated[:, k], ~of.test) for k in range(stated.shape[1])]
            changes[name] = sigma * (np.array(axes, dtype=np.float64) / whole)
    return replace(table, measurements=replace(m, **changes))


def _typical(sigma: Floats | None, chosen: NDArray[np.bool_] | None) -> float | None:
    """Root mean square of sigmas that are stated, of those chosen."""
    if sigma is None or not np.isfinite(sigma[chosen]).any():
        return None
    sigma = sigma[chosen]
    largest = float(np.nanmax(sigma)) or 1.0  # equal figures stay what they are, to the last digit
    return largest * float(np.sqrt(np.nanmean(np.square(sigma / largest))))
