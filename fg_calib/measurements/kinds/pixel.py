"""Corners of boards as a camera sees them: a board in the room from the tool, or one on the tool from the room."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.initialization import Camera, FrameStart, boards_from_image
from fg_calib.inputs import Booleans, Floats, Integers, ProblemError
from fg_calib.measurements.dataset import Labels, Measurements
from fg_calib.measurements.kind import Frames, Kind, Rows
from fg_calib.measurements.kinds.board import BOARD_COLUMN, BoardCamera, board_coordinates, start_boards
from fg_calib.measurements.kinds.instrument import Blocks, Column
from fg_calib.measurements.landmarks import Landmarks
from fg_calib.measurements.table import MeasurementBlock, Table
from fg_calib.robot import cross_matrix, left_jacobian

MAX_CHOICES = 2
"""Poses of a board that one image may leave, at most."""

MAX_IMAGES = 60
"""Images of a board that it is started from: more would not make the start better."""

GOOD_SHARE = 0.5
"""Share of the points of a board's fullest image from which another is good for a start: a few corners say little."""


class Pixel(Kind):
    """Where a camera on the tool sees a point of a board in the room, minus where it did, [px].

    With R, p the camera, B = Exp(v), b the board and c the point on it, `R^T (B c + b - p)` is where it is in the
    camera's frame. A rotation w and a translation dp of the camera move it by `R^T ((B c + b - p) x w - dp)`, the
    board's coordinates by `R^T (Jl(v) dv x B c + db)`.

    Data: u, v, [px], and the point on the board, x and y, [m]. Nuisances: v, [rad], and b, [m], as of `BoardPose`.

    Args:
        camera: What the camera does to what it sees.
    """

    names, units = ("pixel.u", "pixel.v"), ("px", "px")
    ends, residual_dim, width, n_nuisances = 1, 2, 4, 6

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        R_T, v = np.swapaxes(at.rotation[:, 0], 1, 2), nuisances[:, :3]
        corner = np.einsum("nij,nj->ni", Rotation.from_rotvec(v).as_matrix()[:, :, :2], data[:, 2:4])
        step = corner + nuisances[:, 3:] - at.position[:, 0]
        seen, J = self.camera.image(np.einsum("nij,nj->ni", R_T, step))
        J = J @ R_T
        D = np.concatenate([J @ cross_matrix(step), -J], axis=2)[:, None]
        N = np.concatenate([-J @ cross_matrix(corner) @ left_jacobian(v), J], axis=2)
        return Rows(seen - data[:, :2], D, N)

    def figures(self, data: Floats) -> Floats:
        """See `Kind.figures`."""
        return data[:, :2]

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """See `Kind.simulate`; the point on the board is given."""
        seen = np.hstack([np.zeros((len(data), 2)), data[:, 2:]])
        return np.hstack([self.rows(at, seen, nuisances).residual + noise, data[:, 2:]])


class RoomPixel(Pixel):
    """Where a camera fixed in the room sees a point of a board on the tool, minus where it did, [px].

    The chain starts in the camera's frame: with R, p the board and c the point on it, `p + R c` is where it is.

    Data: u, v, [px], and the point on the board, x and y, [m]. Nuisances: none.

    Args:
        camera: What the camera does to what it sees.
    """

    n_nuisances = 0

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        corner = np.einsum("nij,nj->ni", at.rotation[:, 0, :, :2], data[:, 2:4])
        seen, J = self.camera.image(at.position[:, 0] + corner)
        D = np.concatenate([-J @ cross_matrix(corner), J], axis=2)[:, None]
        return Rows(seen - data[:, :2], D)


class PixelCamera(BoardCamera):
    """Images of the boards' points."""

    model, words = "pixels", "images of boards' points"
    columns = (
        BOARD_COLUMN,
        Column(("u", "v"), "pixel", "Where a corner was seen"),
        Column(("corner_x", "corner_y"), "length", "Where that corner is on the board"),
        Column(("sigma_pixel",), "pixel", "1 sigma of u and v, or"),
        Column(("sigma_u", "sigma_v"), "pixel", "1 sigma of each by itself"),
    )
    noise, options = ("pixel",), ("camera", "fixed_camera")

    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """See `Instrument.blocks`."""
        m = table.measurements
        image = self.require(table, m.image, "u, v, corner_x, corner_y", "images of a board's points")
        if table.camera is None:
            raise ProblemError(m.source, "no camera", f"the key camera for model {table.model}")
        rows = np.arange(m.n_configurations)
        kind = RoomPixel(table.camera) if table.fixed_camera else Pixel(table.camera)
        nuisances = np.zeros((len(rows), 0), dtype=np.int64)
        if kind.n_nuisances:
            index, place = board_coordinates(table, landmarks)
            nuisances = place[index]
        sigma = self.require_sigma(table, m.sigma_pixel, "pixel", rows)
        return [
            MeasurementBlock.of_rows(
                kind, table, number, rows, image, sigma, nuisances=nuisances, of=_corners(m, image)
            )
        ]

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:
        """Boards, or the frame, and the tool: first what the board's pose in each image may be."""
        for block in blocks:
            if not isinstance(block.kind, Pixel):
                continue
            rows, boards, choices = _poses_of_images(table, block, block.kind.camera)
            if block.kind.n_nuisances:
                start_boards(start, rows, boards, choices)
            else:
                start.align_choices(rows, choices, unknown_frame=start.unknown_frame)

    def random_model(self, table: Table) -> str:
        """Poses stand for points, which must be in sight. See `Instrument.random_model`."""
        return "pose" if table.fixed_camera else "board"


def _poses_of_images(
    table: Table, block: MeasurementBlock, camera: Camera
) -> tuple[Integers, Integers, tuple[Floats, Floats]]:
    """Configuration and first coordinate of the board of each good image, and the poses that it leaves.

    Raises:
        ProblemError: No image shows enough of a board.
    """
    _, first, of = np.unique(table.measurements.ids, return_index=True, return_inverse=True)
    place = first[of.ravel()]  # the first row of each one's configuration
    board = block.nuisances[:, 0] if block.kind.n_nuisances else np.zeros(block.n, dtype=np.int64)
    which = np.stack([place[block.ends[:, 0]], board], axis=1)[~block.test]
    image, of = np.unique(which, axis=0, return_inverse=True)
    train = np.flatnonzero(~block.test)[np.argsort(of.ravel(), kind="stable")]
    shown = np.bincount(of.ravel(), minlength=len(image))
    most = {name: shown[image[:, 1] == name].max() for name in np.unique(image[:, 1]).tolist()}
    share = shown / np.array([most[name] for name in image[:, 1].tolist()])
    used = _spread_out(image[:, 1], share >= GOOD_SHARE)
    rows, boards, poses = [], [], []
    for k, corners in enumerate(np.split(train, np.cumsum(shown)[:-1])):
        found = boards_from_image(camera, block.data[corners], block.sigma[corners]) if used[k] else []
        if found:
            rows.append(block.ends[corners[0], 0])
            boards.append(image[k, 1])
            poses.append([frame for _, frame in (found + found)[:MAX_CHOICES]])
    if not poses:
        expected = "four points or more that are not on a line"
        raise ProblemError(block.source, "no image of a board to start from", expected)
    rotations = np.array([[pose.rotation for pose in each] for each in poses])
    return np.array(rows), np.array(boards), (rotations, np.array([[p.translation for p in each] for each in poses]))


def _spread_out(board: Integers, good: Booleans) -> Booleans:
    """Of each board's good images `MAX_IMAGES` at most, evenly spread, shape (n,)."""
    found = np.zeros(len(good), dtype=np.bool_)
    for name in np.unique(board):
        rows = np.flatnonzero(good & (board == name))
        found[rows[np.unique(np.linspace(0, len(rows) - 1, min(MAX_IMAGES, len(rows))).round().astype(int))]] = True
    return found


def _corners(m: Measurements, image: Floats) -> Labels:
    """The point of a board that each row is of, with the board's name where a column says it."""
    board = m.labels.get("board")
    which = np.zeros(len(image)) if board is None else board.index
    places = np.column_stack([which, image[:, 2:] * 1e3]) + 0.0  # no -0
    different, index = np.unique(places, axis=0, return_inverse=True)
    of_board = [""] if board is None else [*(f"{name} " for name in board.names), ""]
    names = tuple(f"{of_board[int(k)]}corner {x:.6g} {y:.6g} mm" for k, x, y in different.tolist())
    return Labels(names, index.ravel())


INSTRUMENTS = (PixelCamera(),)
