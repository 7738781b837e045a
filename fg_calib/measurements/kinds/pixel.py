"""Corners of boards as a camera sees them: a board in the room from the tool, or one on the tool from the room."""

from typing import Any

import numpy as np

from fg_calib.initialization import Camera, Frame, FrameStart, boards_from_image
from fg_calib.inputs import Floats, Integers, ProblemError
from fg_calib.measurements import Frames, Kind, Labels, Landmarks, MeasurementBlock, Measurements, Rows, Table
from fg_calib.measurements.kinds.board import BOARD, BOARD_COLUMN, point_in_camera, start_boards
from fg_calib.measurements.kinds.instrument import Blocks, Column, Instrument, Kinds, Quantity
from fg_calib.measurements.kinds.pose import point_on_tool

MAX_IMAGES = 60
"""Images that a board's start is computed from, those with most corners."""


class Pixel(Kind):
    """Image of a point of a board in the room, predicted minus measured, by a camera on the tool, [px].

    Data: u, v, [px], and the point on the board, x and y, [m]. Nuisances: the board, as of `BoardPose`.

    Args:
        camera: The camera's model.
    """

    names, units = ("pixel.u", "pixel.v"), ("px", "px")
    ends, residual_dim, width, n_nuisances, shows_data = 1, 2, 4, 6, True

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    def place(self, at: Frames, boards: Floats, corners: Floats) -> tuple[Floats, Floats, Floats]:
        """Points in the camera's frame, with the derivatives in the tool and in the boards."""
        return point_in_camera(at, boards, corners)

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        place, D, N = self.place(at, nuisances, np.pad(data[:, 2:], ((0, 0), (0, 1))))
        seen, J = self.camera.image(place)
        return Rows(seen - data[:, :2], (J @ D)[:, None], J @ N)


class RoomPixel(Pixel):
    """Image of a point of a board on the tool, predicted minus measured, by a camera fixed in the room, [px].

    The chain starts in the camera's frame. Data: u, v, [px], and the point on the board, x and y, [m]. Nuisances: none.
    """

    n_nuisances = 0

    def place(self, at: Frames, boards: Floats, corners: Floats) -> tuple[Floats, Floats, Floats]:
        """See `Pixel.place`."""
        place, D = point_on_tool(at, corners)
        return place, D[:, 0], np.zeros((len(place), 3, 0))


class PixelCamera(Instrument):
    """Images of the boards' points."""

    model, words = "pixels", "images of boards' points"
    quantities = (Quantity("image", "pixel", "u, v, corner_x, corner_y", "images of a board's points", (4,)),)
    columns = (
        BOARD_COLUMN,
        Column(("u", "v"), "pixel", "Where a corner was seen"),
        Column(("corner_x", "corner_y"), "length", "Where that corner is on the board"),
        Column(("sigma_pixel",), "pixel", "1 sigma of u and v, or"),
        Column(("sigma_u", "sigma_v"), "pixel", "1 sigma of each by itself"),
    )
    labels, landmarks, n_landmarks = ("board",), (BOARD,), 1
    noise, options = ("pixel",), ("camera", "fixed_camera")
    sees_orientation = sees_landmarks = True

    def kinds(self, table: Table) -> Kinds:
        """See `Instrument.kinds`."""
        m, camera = table.measurements, table.camera
        if camera is None:
            raise ProblemError(m.source, "no camera", f"the key camera for model {table.model}")
        kind = RoomPixel(camera) if table.fixed_camera else Pixel(camera)
        return [(kind, np.ones(m.n_configurations, dtype=np.bool_))]

    def more(self, table: Table, rows: Integers) -> dict[str, Any]:
        """See `Instrument.more`: the corners."""
        return {"of": _corners(table.measurements).of(rows)}

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:
        """Start boards, or the frame, and the tool from the two poses that each image of a board leaves."""
        for block in blocks:
            if not isinstance(block.kind, Pixel):
                continue
            rows, boards, choices = _poses_of_images(table, block, block.kind.camera)
            if block.kind.n_nuisances:
                start_boards(start, rows, boards, choices)
            else:
                start.align_choices(rows, choices, unknown_frame=start.unknown_frame)

    def random_model(self, table: Table) -> str:
        """Poses, as points of random configurations would not be in sight. See `Instrument.random_model`."""
        return "pose" if table.fixed_camera else "board"


def _poses_of_images(
    table: Table, block: MeasurementBlock, camera: Camera
) -> tuple[Integers, Integers, tuple[Floats, Floats]]:
    """Configuration, first coordinate of the board, and the two possible poses of each image with enough corners.

    Raises:
        ProblemError: No image shows enough of a board.
    """
    _, first, of = np.unique(table.measurements.ids, return_index=True, return_inverse=True)
    board = block.nuisances[:, 0] if block.kind.n_nuisances else np.zeros(block.n, dtype=np.int64)
    which = np.stack([first[of.ravel()][block.ends[:, 0]], board], axis=1)  # the first row of each configuration
    train, poses = np.flatnonzero(~block.test), list[tuple[int, int, list[Frame]]]()
    images, of = np.unique(which[train], axis=0, return_inverse=True)
    corners = np.split(train[np.argsort(of.ravel(), kind="stable")], np.cumsum(np.bincount(of.ravel()))[:-1])
    for one in np.unique(board[train]).tolist():
        of_board = [k for k in range(len(images)) if images[k, 1] == one]
        for k in sorted(sorted(of_board, key=lambda k: -len(corners[k]))[:MAX_IMAGES]):
            found = boards_from_image(camera, block.data[corners[k]], block.sigma[corners[k]])
            if found:  # two poses, or one twice
                poses.append((block.ends[corners[k][0], 0], one, [frame for _, frame in (found + found)[:2]]))
    if not poses:
        expected = "four points or more that are not on a line"
        raise ProblemError(block.source, "no image of a board to start from", expected)
    rows, boards, choices = zip(*poses, strict=True)
    rotations = np.array([[frame.rotation for frame in each] for each in choices])
    places = np.array([[frame.translation for frame in each] for each in choices])
    return np.array(rows), np.array(boards), (rotations, places)


def _corners(m: Measurements) -> Labels:
    """The point of a board that each row is of, with the board's name where a column says it."""
    board, image = m.labels.get("board"), np.zeros((m.n_configurations, 4)) if m.image is None else m.image
    which = np.zeros(len(image)) if board is None else board.index
    places = np.column_stack([which, image[:, 2:] * 1e3]) + 0.0  # no -0
    different, index = np.unique(places, axis=0, return_inverse=True)
    of_board = [""] if board is None else [*(f"{name} " for name in board.names), ""]
    names = tuple(f"{of_board[int(k)]}corner {x:.6g} {y:.6g} mm" for k, x, y in different.tolist())
    return Labels(names, index.ravel())


INSTRUMENTS = (PixelCamera(),)
