from .boards import boards_from_image, refine_board
from .camera import Camera
from .hand_eye import Frame
from .landmarks import anchors_from_lengths, offset_from_lengths, plane_from_distances, targets_from_positions
from .start import FrameStart

__all__ = [
    "Camera",
    "Frame",
    "FrameStart",
    "anchors_from_lengths",
    "boards_from_image",
    "offset_from_lengths",
    "plane_from_distances",
    "refine_board",
    "targets_from_positions",
]
