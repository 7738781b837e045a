"""Where a problem starts: the nominal parameters, with frames, tool and the measurements' unknowns from closed form."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.errors import ProblemError
from fg_calib.graph.factors import Variables, frame_of, pose_of
from fg_calib.graph.problem import contact_points
from fg_calib.initialization import hand_eye as frames
from fg_calib.initialization.boards import boards_from_image
from fg_calib.initialization.hand_eye import Frame, Unknown
from fg_calib.initialization.landmarks import targets_from_positions
from fg_calib.measurements.gathering import Dataset
from fg_calib.measurements.kinds import BoardPose, Pixel, RoomPixel, TargetPosition, TouchedPoint, parts_of
from fg_calib.measurements.series import Series
from fg_calib.options import POSE_MODELS
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]

HERE = Frame(np.eye(3), np.zeros(3))

MOST_CHOICES = 2
"""Poses of a board that one image may leave, at most."""

MOST_IMAGES = 60
"""Images of a board that it is started from: more would not make the start better."""

GOOD_SHARE = 0.5
"""Share of the points of a board's fullest image from which another is good for a start: a few corners say little."""


def start_of(robot: Robot, data: Dataset, variables: Variables) -> Floats:
    """The nominal parameters with the unknown frames and the measurements' unknowns, as a parameter vector.

    Raises:
        ProblemError: No image shows enough of a board.
    """
    trigs = data.trigs(robot)
    begun = _Start(robot, data, variables, trigs)
    begun.all_tables()
    start = begun.parameters
    if variables.nuisance:
        at = variables.at(start)
        places = np.where(np.isnan(begun.places), contact_points(data, at.chains, trigs), begun.places)
        there = variables.coordinates >= 0
        start[variables.coordinates[there]] = places[there]
    return start


class _Start:
    """A parameter vector that is filled table by table, poses first; who says where the tool is says it once.

    Attributes:
        parameters: The parameter vector.
        places: The measurements' unknown coordinates, nan where nothing is known of them yet.
    """

    def __init__(self, robot: Robot, data: Dataset, variables: Variables, trigs: tuple[Floats, ...]) -> None:
        self._robot, self._data, self._trigs = robot, data, trigs
        self.parameters = variables.nominal()
        self.places: Floats = np.concatenate([np.zeros(0), *data.unknowns.starts])
        self._tool = np.array(robot.owned_by(robot.n_joints + 1), dtype=np.int64)  # in the order of FRAME_KINDS
        free = np.zeros(6, dtype=np.bool_)
        free[: len(self._tool)] = [robot.parameters[i].estimated for i in self._tool]
        self._turn, self._shift = bool(free[3:].all()), free[:3].copy()  # of the tool: what is still to be found
        self._found = np.zeros(6, dtype=np.bool_)
        nominal = self.parameters[self._tool] if len(self._tool) else np.zeros(6)
        self._T = Frame(pose_of(nominal).rotation().matrix(), nominal[:3])
        self._frames = {int(v.symbol[2:-1]): v for v in variables.frames}

    def all_tables(self) -> None:
        """Fill in what each table says."""
        bare = self._robot.nominal
        bare[self._tool] = 0.0
        chain = build_chain(self._robot.with_values(bare))
        models = [table.model for table in self._data.tables]
        for number in sorted(range(len(models)), key=lambda t: -sum(POSE_MODELS.get(models[t], (0, 0)))):  # type: ignore[arg-type]
            flange = forward(chain, self._trigs[number])
            self._table(number, (flange.rotation, flange.position))
            self._turn, self._shift = self._turn and not self._found[3], self._shift & ~self._found[:3]
        if self._found.any():
            found = _coordinates(self._T, self.parameters[self._tool])
            self.parameters[self._tool[self._found]] = found[self._found]

    def _table(self, number: int, flange: tuple[Floats, Floats]) -> None:
        table = self._data.tables[number]
        series = [s for s in self._data.series if s.table == number]
        if table.model in POSE_MODELS:
            self._from_poses(number, flange)
            for s in series:
                if any(isinstance(part, TargetPosition) for part in parts_of(s.kind)):
                    self._from_targets(number, flange)
                    break
        elif table.model in ("board", "pixels"):
            for s in series:
                if isinstance(s.kind, BoardPose):
                    self._from_boards(flange, *_board_poses(s))
                elif isinstance(s.kind, Pixel | RoomPixel):
                    self._from_images(number, flange, s)
        elif self._shift.any():
            self._from_lengths(series, flange)

    def _from_poses(self, number: int, flange: tuple[Floats, Floats]) -> None:
        """Frame and tool of poses; of targets only their orientations say something here."""
        m, (turned, placed) = self._data.tables[number].measurements, POSE_MODELS[self._data.tables[number].model]  # type: ignore[index]
        placed = placed and "target" not in m.labels
        train = np.flatnonzero(~m.test)
        R = m.rotation[train] if turned and m.rotation is not None else None
        p = m.position[train] if placed and m.position is not None else None
        self._align(number, (flange[0][train], flange[1][train]), (R, p))

    def _align(self, number: int, flange: tuple[Floats, Floats], measured: tuple[Floats | None, Floats | None]) -> None:
        """What poses in a table's frame say of it and of the tool."""
        turned, placed = (values is not None for values in measured)
        unknown = Unknown(number in self._frames, self._turn and turned, self._shift & placed)
        if not (turned or placed) or not (unknown.frame or unknown.tool_rotation or unknown.tool_translation.any()):
            return
        X, self._T = frames.start_from_poses(flange, measured, (HERE, self._T), unknown)
        self._take(number, X, unknown)

    def _from_targets(self, number: int, flange: tuple[Floats, Floats]) -> None:
        m = self._data.tables[number].measurements
        labels, train = m.labels["target"], np.flatnonzero(~m.test)
        assert m.position is not None
        coordinates = self._coordinates_of("P", labels.names)
        known = np.vstack([self.places[coordinates], np.zeros(3)])  # the tool point itself at the end, as row -1
        R = flange[0][train] @ self._T.rotation
        p = flange[1][train] + flange[0][train] @ self._T.translation
        target = np.where(labels.index[train] < 0, len(labels.names), labels.index[train])
        X, places = targets_from_positions((R, p), m.position[train], target, known, HERE, number in self._frames)
        self.places[coordinates] = places[:-1]
        self._put(number, X)

    def _take(self, number: int, X: Frame, unknown: Unknown) -> None:
        """Note a table's frame, and what of the tool was found with it."""
        self._found |= np.append(unknown.tool_translation, [unknown.tool_rotation] * 3)
        self._put(number, X)

    def _from_boards(
        self, flange: tuple[Floats, Floats], rows: Integers, board: Integers, choices: tuple[Floats, Floats]
    ) -> None:
        """Boards and the camera from camera_T_board: seen from a board, the camera is a tool, and the base unknown.

        Args:
            flange: Poses of the flange.
            rows: Configuration of each pose, shape (n,).
            board: First coordinate of each one's board, shape (n,).
            choices: Rotations, shape (n, k, 3, 3), and positions, shape (n, k, 3), [m]: what each may be.
        """
        names, count = np.unique(board, return_counts=True)
        for first in names[np.argsort(-count, kind="stable")].tolist():
            mine = board == first
            R_T = np.swapaxes(choices[0][mine], 2, 3)
            seen = R_T, -np.einsum("nkij,nkj->nki", R_T, choices[1][mine])
            at = flange[0][rows[mine]], flange[1][rows[mine]]
            unknown = Unknown(True, self._turn, self._shift)
            X, self._T = frames.start_from_most_poses(at, seen, (HERE, self._T), unknown)
            self._found |= np.append(self._shift, [self._turn] * 3)
            self._turn, self._shift = False, np.zeros(3, dtype=np.bool_)
            place = np.concatenate([Rotation.from_matrix(X.rotation.T).as_rotvec(), -X.rotation.T @ X.translation])
            self.places[first : first + 6] = place

    def _from_images(self, number: int, flange: tuple[Floats, Floats], s: Series) -> None:
        """The same from the images of a board's points: first what the board's pose in each may be."""
        assert isinstance(s.kind, Pixel | RoomPixel)
        place = self._data.places[number][s.ends[:, 0]]
        board = s.nuisances[:, 0] if s.kind.n_nuisances else np.zeros(s.n, dtype=np.int64)
        image, of = np.unique(np.stack([place, board], axis=1)[~s.test], axis=0, return_inverse=True)
        order = np.argsort(of.ravel(), kind="stable")
        train = np.flatnonzero(~s.test)[order]
        rows, boards, poses = [], [], []
        shown = np.bincount(of.ravel(), minlength=len(image))
        most = {name: shown[image[:, 1] == name].max() for name in image[:, 1].tolist()}
        share = shown / np.array([most[name] for name in image[:, 1].tolist()])
        looked_at = _spread_out(image[:, 1], share >= GOOD_SHARE)
        for k, mine in enumerate(np.split(train, np.cumsum(shown)[:-1])):
            found = boards_from_image(s.kind.camera, s.data[mine], s.sigma[mine]) if looked_at[k] else []
            if found:
                rows.append(s.ends[mine[0], 0])
                boards.append(image[k, 1])
                poses.append([frame for _, frame in (found + found)[:MOST_CHOICES]])
        if not poses:
            raise ProblemError(
                s.source, "no image of a board to start from", "four points or more that are not on a line"
            )
        choices = (
            np.array([[pose.rotation for pose in each] for each in poses]),
            np.array([[pose.translation for pose in each] for each in poses]),
        )
        if s.kind.n_nuisances:
            self._from_boards(flange, np.array(rows), np.array(boards), choices)
            return
        unknown = Unknown(number in self._frames, self._turn, self._shift.copy())
        if unknown.frame or unknown.tool_rotation or unknown.tool_translation.any():
            at = flange[0][rows], flange[1][rows]
            X, self._T = frames.start_from_most_poses(at, choices, (HERE, self._T), unknown)
            self._take(number, X, unknown)

    def _from_lengths(self, series: list[Series], flange: tuple[Floats, Floats]) -> None:
        """The tool point from distances of pairs, or from touches of the same points where none was measured."""
        for s in series:
            if s.kind.ends == 2 and s.kind.names[0] == "distance":
                rows = np.flatnonzero(s.measured[:, 0] & ~s.test)
                a, b = s.ends[rows].T
                self._T = frames.start_from_distances(flange, a, b, s.data[rows, 0], self._T, self._shift)
                self._found[:3] |= self._shift
                return
        for s in series:
            if isinstance(s.kind, TouchedPoint):
                train = np.flatnonzero(~s.test)
                at = flange[0][s.ends[train, 0]], flange[1][s.ends[train, 0]]
                point = frames.start_from_touches(at, s.nuisances[train, 0], self._T.translation, self._shift)
                self._T = Frame(self._T.rotation, point)
                self._found[:3] |= self._shift
                return

    def _coordinates_of(self, letter: str, names: tuple[str, ...]) -> Integers:
        """Places of the coordinates of unknowns, a row each."""
        unknowns = self._data.unknowns
        first = np.cumsum([0, *unknowns.sizes])
        index = {
            (letter, name): i for i, (letter, name) in enumerate(zip(unknowns.letters, unknowns.names, strict=True))
        }
        return np.array([np.arange(first[i], first[i + 1]) for i in (index[letter, name] for name in names)])

    def _put(self, number: int, X: Frame) -> None:
        if number in self._frames:
            self.parameters[self._frames[number].places] = _coordinates(X)


def _spread_out(board: Integers, good: Booleans) -> Booleans:
    """Of each board's good images `MOST_IMAGES` at most, evenly spread, shape (n,)."""
    found = np.zeros(len(good), dtype=np.bool_)
    for name in np.unique(board):
        mine = np.flatnonzero(good & (board == name))
        found[mine[np.unique(np.linspace(0, len(mine) - 1, min(MOST_IMAGES, len(mine))).round().astype(int))]] = True
    return found


def _board_poses(s: Series) -> tuple[Integers, Integers, tuple[Floats, Floats]]:
    """Configuration, first coordinate of the board, rotation and position of each train row."""
    train = np.flatnonzero(~s.test)
    measured = s.data[train, None, :9].reshape(-1, 1, 3, 3), s.data[train, None, 9:]
    return s.ends[train, 0], s.nuisances[train, 0], measured


def _coordinates(frame: Frame, near: Floats | None = None) -> Floats:
    """x, y, z, yaw, pitch, roll of a frame (see `frame_of`)."""
    return frame_of(gtsam.Pose3(gtsam.Rot3(frame.rotation), frame.translation), near)
