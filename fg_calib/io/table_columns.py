"""The columns of tables that mean something, with what they mean: for the reference, and to recognise tables by."""

from __future__ import annotations

from typing import NamedTuple


class ColumnMeaning(NamedTuple):
    """Columns that mean something together, or one alone.

    Attributes:
        names: Their names.
        unit: `length`, `angle`, `pixel`, `joint` (its joint's), or empty of names and pure numbers.
        meaning: What they are.
    """

    names: tuple[str, ...]
    unit: str
    meaning: str


COVARIANCE = tuple(f"cov_{i}{j}" for i in range(1, 7) for j in range(i, 7))
"""Upper triangle of the covariance of a board's pose, row by row: about, then along the camera's x, y and z."""

COLUMNS: tuple[tuple[str, tuple[ColumnMeaning, ...]], ...] = (
    (
        "configurations",
        (
            ColumnMeaning(("q1 ... qn",), "joint", "Joint readings, in chain order; or the joints' own names"),
            ColumnMeaning(("id",), "", "Name of the configuration; the same id is the same one, in all tables"),
            ColumnMeaning(("split",), "", "train (or empty) or test: test rows are predicted, never fitted"),
        ),
    ),
    (
        "poses (models pose, position, orientation; distance, rotation, distance-rotation; board)",
        (
            ColumnMeaning(
                ("x", "y", "z"), "length", "Measured position; of model board that of the board before the camera"
            ),
            ColumnMeaning(("qx", "qy", "qz", "qw"), "", "Measured orientation as unit quaternion, or"),
            ColumnMeaning(("roll", "pitch", "yaw"), "angle", "the same as Rz(yaw) Ry(pitch) Rx(roll), or"),
            ColumnMeaning(("rx", "ry", "rz"), "angle", "the same as rotation vector"),
            ColumnMeaning(("target",), "", "Which point of the tool was seen; empty: the tool itself"),
            ColumnMeaning(("station",), "", "Where it was seen from; each has a frame of its own with frame unknown"),
            ColumnMeaning(("sigma_position",), "length", "1 sigma of the row's position on each axis, or"),
            ColumnMeaning(("sigma_x", "sigma_y", "sigma_z"), "length", "1 sigma on each axis by itself"),
            ColumnMeaning(("sigma_orientation",), "angle", "1 sigma of the row's orientation about each axis, or"),
            ColumnMeaning(("sigma_rx", "sigma_ry", "sigma_rz"), "angle", "1 sigma about each axis by itself"),
        ),
    ),
    (
        "touched points (models distance, distance-rotation)",
        (
            ColumnMeaning(("group",), "", "Which point the configuration touched; empty: none"),
            ColumnMeaning(("sigma_point",), "length", "1 sigma of the touch on each axis"),
        ),
    ),
    (
        "model anchor, model plane",
        (
            ColumnMeaning(("anchor",), "", "Which anchor the distance is to"),
            ColumnMeaning(("plane",), "", "Which plane the tool point is on, or at a distance from"),
            ColumnMeaning(("distance",), "length", "To the anchor (0: contact), or from the plane (0 without)"),
            ColumnMeaning(("sigma_distance",), "length", "1 sigma of that"),
        ),
    ),
    (
        "model board, model pixels",
        (
            ColumnMeaning(("board",), "", "Which board was seen, where there are several"),
            ColumnMeaning(("u", "v"), "pixel", "Where a corner was seen"),
            ColumnMeaning(("corner_x", "corner_y"), "length", "Where that corner is on the board"),
            ColumnMeaning(("sigma_pixel",), "pixel", "1 sigma of u and v, or"),
            ColumnMeaning(("sigma_u", "sigma_v"), "pixel", "1 sigma of each by itself"),
            ColumnMeaning(COVARIANCE, "", "Upper triangle of the covariance of a board's pose, orientation first"),
        ),
    ),
    (
        "a table of pairs",
        (
            ColumnMeaning(("a", "b"), "", "The two configurations (ids, or 0-based rows) or touched points"),
            ColumnMeaning(("distance",), "length", "The distance between them; empty: not measured"),
            ColumnMeaning(("angle",), "angle", "The angle turned between them, 0 to half a turn; empty: not measured"),
            ColumnMeaning(("sigma_distance",), "length", "1 sigma of the distance"),
            ColumnMeaning(("sigma_angle",), "angle", "1 sigma of the angle"),
            ColumnMeaning(("split",), "", "train (or empty) or test"),
        ),
    ),
)
"""The columns of tables, by what they are of."""
