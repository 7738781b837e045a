"""What plain least squares fits, as a function of its unknowns: parameters, measurement frames, then places."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fg_calib.baseline.methods import Fit, Solver
from fg_calib.baseline.rows import Rows, evaluate, said_places, train_rows, whitening_of, without_kinks
from fg_calib.errors import InputError
from fg_calib.measurements.gathering import Dataset
from fg_calib.robot.kinematics import Chain, build_chain
from fg_calib.robot.model import AXIS_OF_KIND, FRAME_KINDS, Element, Parameter, Robot
from fg_calib.robot.rotations import rotation_of, yaw_pitch_roll

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

REWEIGHTED = 1e-10
"""Weights are final once a fit with them moves the unknowns by less than this, [m] and [rad]."""

_ROUNDS = 20
"""Fits with new weights at most."""

Weights = tuple[Floats, ...]
"""Whitening of each set of rows."""


@dataclass(frozen=True)
class Start:
    """Where a fit starts.

    Attributes:
        values: Of the robot's parameters, shape (n_parameters,), [m] and [rad].
        frames: x, y, z, yaw, pitch, roll of each unknown measurement frame, shape (n_frames, 6), [m] and [rad].
        coordinates: Of all places, nan where nothing depends on one, shape (n_coordinates,).
        unknown: Which coordinates are estimated, shape (n_unknown,).
    """

    values: Floats
    frames: Floats
    coordinates: Floats
    unknown: Integers


def start_at(robot: Robot, data: Dataset, given: Floats | None) -> Start:
    """The start as a parameter vector of the robot, the unknown frames and the estimated places says it.

    Args:
        robot: The robot.
        data: What was measured.
        given: The robot's values; with those of the unknown frames (six at least), and of the estimated places, as
            `Problem.start` has them. Nominal values and the identity if None.

    Raises:
        InputError: It is of another length, or not finite.
    """
    n, n_frames = len(robot.parameters), sum(table.unknown_frame for table in data.tables)
    sizes = np.array(data.unknowns.sizes, dtype=np.int64)
    unknown = np.flatnonzero(np.repeat(data.estimated(), sizes))
    with_frames = n + 6 * max(1, n_frames)
    values = robot.nominal if given is None else np.asarray(given, dtype=np.float64)
    lengths = (with_frames + len(unknown),) if len(unknown) else (n, with_frames)
    fits = values.ndim == 1 and len(values) in lengths
    if not fits or not np.isfinite(values).all():
        found = "a value that is not finite" if fits else f"shape {values.shape}"
        expected = f"{n} values of the robot, or {with_frames} with the measurement frame's"
        if len(unknown):
            expected = f"{lengths[0]} values: of the robot, of measurement frames and of places"
        raise InputError("start", found, expected)
    coordinates: Floats = np.concatenate([np.zeros(0), *data.unknowns.starts])
    coordinates[unknown] = values[with_frames:]
    frames = np.zeros((n_frames, 6)) if len(values) == n else values[n : n + 6 * n_frames].reshape(-1, 6)
    return Start(values[:n], frames, coordinates, unknown)


@dataclass(frozen=True)
class System:
    """Rows as a function of the unknowns: parameters, a correction of each unknown frame, coordinates of places.

    Attributes:
        robot: The nominal robot.
        chosen: Its parameters to estimate.
        start: Where the fit starts.
        rows: What is fitted.
        chains: The arm behind each table's measurement frame and a correction of it.
        frame_of: Which unknown frame each table has, -1 for none.
        places: What is said of places: coordinates, where they are said to be and 1 sigma of that.
        sigma_joint: Of the joint readings, shape (n_joints,), [rad] or [m].
    """

    robot: Robot
    chosen: list[int]
    start: Start
    rows: tuple[Rows, ...]
    chains: tuple[Chain, ...]
    frame_of: tuple[int, ...]
    places: tuple[tuple[Integers, Floats, float], ...]
    sigma_joint: Floats

    @property
    def first(self) -> Floats:
        """The unknowns at the start, shape (n_unknowns,)."""
        s = self.start
        return np.concatenate([s.values[self.chosen], np.zeros(s.frames.size), s.coordinates[s.unknown]])

    @property
    def n_core(self) -> int:
        """Number of unknowns before the places'."""
        return len(self.chosen) + self.start.frames.size

    def chain(self, table: int, x: Floats) -> Chain:
        """The arm as a table sees it at the unknowns x."""
        values, m, frame = self.start.values.copy(), len(self.chosen), self.frame_of[table]
        values[self.chosen] = x[:m]
        correction = np.zeros(6) if frame < 0 else x[m + 6 * frame : m + 6 * frame + 6]
        return self.chains[table].at(np.concatenate([values, correction]))

    def coordinates(self, x: Floats) -> Floats:
        """Coordinates of all places at the unknowns x."""
        out = self.start.coordinates.copy()
        out[self.start.unknown] = x[self.n_core :]
        return out

    def evaluate(self, x: Floats, weights: Weights | None) -> tuple[Floats, Floats]:
        """Residuals, shape (m,), and derivatives, shape (m, n_unknowns); not weighted if `weights` is None."""
        coordinates, column = self.coordinates(x), self._columns()
        found_r, found_J = [], []
        for i, rows in enumerate(self.rows):
            r, J, of = evaluate(rows, self.chain(rows.table, x), coordinates, None if weights is None else weights[i])
            wide = np.zeros((len(r), len(x) + 1))  # the last for coordinates that are known
            wide[:, : self.n_core] = J[:, : self.n_core]
            for k, of_row in enumerate(column[rows.nuisances[of]].T):
                wide[np.arange(len(r)), of_row] = J[:, self.n_core + k]
            found_r.append(r)
            found_J.append(wide[:, :-1])
        for there, place, sigma in self.places:
            found_r.append((coordinates[there] - place) / (1.0 if weights is None else sigma))
            found_J.append(np.eye(len(x) + 1)[column[there], :-1] / (1.0 if weights is None else sigma))
        return np.concatenate(found_r), np.concatenate(found_J)

    def weights(self, x: Floats) -> Weights:
        """`whitening_of` the rows at the unknowns x."""
        coordinates = self.coordinates(x)
        return tuple(whitening_of(r, self.chain(r.table, x), coordinates, self.sigma_joint) for r in self.rows)

    def solve(self, solver: Solver, weighted: bool) -> tuple[Fit, Weights | None]:
        """The fit, and the weights that it was made with: those at the estimate, if they matter."""
        if not weighted:
            return solver(lambda x: self.evaluate(x, None), self.first), None
        fit = Fit(self.first, converged=False, message="", iterations=0, steps=())
        for _ in range(_ROUNDS):
            weights = self.weights(fit.x)
            again = solver(partial(self.evaluate, weights=weights), fit.x)
            moved = float(np.linalg.norm(again.x - fit.x))
            fit = replace(again, iterations=fit.iterations + again.iterations, steps=fit.steps + again.steps)
            if not fit.converged or moved <= REWEIGHTED or not np.any(self.sigma_joint > 0.0):
                return fit, weights
        message = f"not converged: new weights still move it by {moved:.1e}"
        return replace(fit, converged=False, message=message), weights

    def frames(self, x: Floats) -> Floats:
        """x, y, z, yaw, pitch, roll of each unknown frame at the unknowns x, shape (n_frames, 6)."""
        corrections = x[len(self.chosen) : self.n_core].reshape(-1, 6)
        return np.array([_composed(*both) for both in zip(self.start.frames, corrections, strict=True)]).reshape(-1, 6)

    def _columns(self) -> Integers:
        """Which unknown each coordinate is, -1 for those that are known."""
        column = np.full(len(self.start.coordinates), -1, dtype=np.int64)
        column[self.start.unknown] = self.n_core + np.arange(len(self.start.unknown))
        return column


def build_system(robot: Robot, data: Dataset, chosen: list[int], start: Start) -> System:
    """What is fitted, from where.

    Raises:
        InputError: There is no row to fit.
    """
    n, m = len(robot.parameters), len(chosen)
    frame_of, chains, seen = [], [], 0
    for table in data.tables:
        frame = seen if table.unknown_frame else -1
        seen += table.unknown_frame
        # The chain starts in the measurement frame as the fit does; a correction of it is six more parameters.
        extended = _with_frame(robot.with_values(start.values), np.zeros(6) if frame < 0 else start.frames[frame])
        columns = {c: k for k, c in enumerate(chosen)}
        columns |= {n + k: m + 6 * frame + k for k in range(6) if frame >= 0}
        chains.append(replace(build_chain(extended, columns), n_columns=m + start.frames.size))
        frame_of.append(frame)
    places, sigma_joint = tuple(said_places(data)), data.sigma_joint
    system = System(robot, chosen, start, (), tuple(chains), tuple(frame_of), places, sigma_joint)
    rows = (without_kinks(r, system.chain(r.table, system.first)) for r in train_rows(robot, data))
    system = replace(system, rows=tuple(r for r in rows if r.use.any()))
    if not system.rows:
        models = ", ".join(dict.fromkeys(str(table.model) for table in data.tables))
        raise InputError(data.source, "no row left to fit", f"train rows for model {models}")
    return system


def _with_frame(robot: Robot, world_T_base: Floats) -> Robot:
    """The robot behind a frame and a correction of it, whose six parameters come last."""
    n = len(robot.parameters)
    fixed = [Element(AXIS_OF_KIND[kind], float(v)) for kind, v in zip(FRAME_KINDS, world_T_base, strict=True)]
    free = [Element(AXIS_OF_KIND[kind], parameter=n + i) for i, kind in enumerate(FRAME_KINDS)]
    correction = (Parameter(f"frame.{kind}", kind, 0, 0.0) for kind in FRAME_KINDS)
    return replace(robot, parameters=(*robot.parameters, *correction), elements=(*fixed, *free, *robot.elements))


def _composed(start: Floats, correction: Floats) -> Floats:
    """x, y, z, yaw, pitch, roll of a frame and its correction, one after the other."""
    R = rotation_of(*start[3:])
    return np.concatenate([start[:3] + R @ correction[:3], yaw_pitch_roll(R @ rotation_of(*correction[3:]))])
