"""Start of measurement frames, tool and landmarks, which instruments fill in table by table."""

import numpy as np

from fg_calib.initialization import hand_eye
from fg_calib.initialization.hand_eye import Frame, Unknown
from fg_calib.inputs import Booleans, Floats, Integers

WORLD = Frame(np.eye(3), np.zeros(3))


class FrameStart:
    """Start of frames, tool and landmarks; the first table that has something of the tool gives it all.

    Args:
        tool: flange_T_tool at the nominal parameters.
        free: Which of its parameters are estimated, translation first, shape (6,).
        places: Coordinates of the landmarks, nan where nothing is known of them yet, shape (n_coordinates,).

    Attributes:
        tool: flange_T_tool as found so far.
        found: Which of its parameters were found, shape (6,).
        frames: world_T_base by the number of its table, where it was found.
        places: Coordinates of the landmarks as found so far.
        unknown_frame: Whether the frame of the table at hand is unknown.
        flange: base_T_flange of its configurations: rotations (n, 3, 3), translations (n, 3), [m].
    """

    def __init__(self, tool: Frame, free: Booleans, places: Floats) -> None:
        self.tool, self.places = tool, places
        self.found = np.zeros(6, dtype=np.bool_)
        self.frames: dict[int, Frame] = {}
        self.unknown_frame = False
        self._rotation, self._translation = bool(free[3:].all()), free[:3].copy()  # what is still to be found
        self._number = -1
        self.flange: tuple[Floats, Floats] = (np.zeros((0, 3, 3)), np.zeros((0, 3)))

    def begin(self, number: int, unknown_frame: bool, flange: tuple[Floats, Floats]) -> None:
        """Take up a table."""
        self._number, self.unknown_frame, self.flange = number, unknown_frame, flange
        self._settle()

    def align(self, rows: Integers, measured: tuple[Floats | None, Floats | None]) -> None:
        """Start frame and tool from poses in the table's frame.

        Args:
            rows: Their configurations, shape (n,).
            measured: Rotations (n, 3, 3) and positions (n, 3), [m]; None where not measured.
        """
        turned, placed = (values is not None for values in measured)
        unknown = Unknown(self.unknown_frame, self._rotation and turned, self._translation & placed)
        if (turned or placed) and unknown.anything:
            X, self.tool = hand_eye.start_from_poses(self._at(rows), measured, (WORLD, self.tool), unknown)
            self._note(unknown)
            self.set_frame(X)

    def align_choices(self, rows: Integers, choices: tuple[Floats, Floats], unknown_frame: bool) -> Frame:
        """Start frame and tool from poses that may each be one of several; the frame.

        Args:
            rows: Their configurations, shape (n,).
            choices: Rotations (n, k, 3, 3) and positions (n, k, 3), [m], the likeliest first.
            unknown_frame: Whether the frame that they are in is unknown.
        """
        unknown = Unknown(unknown_frame, self._rotation, self._translation.copy())
        if not unknown.anything:
            return WORLD
        X, self.tool = hand_eye.start_from_most_poses(self._at(rows), choices, (WORLD, self.tool), unknown)
        self._note(unknown)
        self._settle()
        self.set_frame(X)
        return X

    def tool_from_distances(self, ends: Integers, distance: Floats) -> None:
        """Start the tool point from distances between configurations. See `hand_eye.start_from_distances`."""
        if self._translation.any() and len(ends):
            self.tool = hand_eye.start_from_distances(self.flange, ends, distance, self.tool, self._translation)
            self.found[:3] |= self._translation

    def tool_from_contacts(self, rows: Integers, touched: Integers) -> None:
        """Start the tool point from contacts with points by number. See `hand_eye.start_from_touches`."""
        if self._translation.any():
            point = hand_eye.start_from_touches(self._at(rows), touched, self.tool.translation, self._translation)
            self.tool = Frame(self.tool.rotation, point)
            self.found[:3] |= self._translation

    def set_frame(self, frame: Frame) -> None:
        """Start the frame of the table at hand, if it is unknown."""
        if self.unknown_frame:
            self.frames[self._number] = frame

    def _at(self, rows: Integers) -> tuple[Floats, Floats]:
        """base_T_flange of configurations."""
        return self.flange[0][rows], self.flange[1][rows]

    def _note(self, unknown: Unknown) -> None:
        """Note what of the tool was found."""
        self.found |= np.append(unknown.tool_translation, [unknown.tool_rotation] * 3)

    def _settle(self) -> None:
        """Look no more for what was found."""
        self._rotation, self._translation = self._rotation and not self.found[3], self._translation & ~self.found[:3]
