"""Laser trackers, motion capture: poses, positions or orientations of the tool, or positions of targets on it."""

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.initialization import FrameStart, targets_from_positions
from fg_calib.inputs import POSE_MODELS, Floats
from fg_calib.measurements import Frames, Kind, LandmarkKind, Landmarks, Rows, Table, stack
from fg_calib.measurements.kinds.instrument import Blocks, Column, Instrument, Kinds, Quantity
from fg_calib.robot import cross_matrix, inverse_right_jacobian, kernels

_TARGETS, _PLACES = "Targets (in the tool frame), mm", "the unknown places of the targets on the tool"
TARGET = LandmarkKind("P", "target", _TARGETS, _PLACES, key="targets", n_configurations=2, stays=True)

POSE_COLUMNS = (
    Column(("x", "y", "z"), "length", "Measured position; of model board that of the board before the camera"),
    Column(("qx", "qy", "qz", "qw"), "", "Measured orientation as unit quaternion, or"),
    Column(("roll", "pitch", "yaw"), "angle", "the same as Rz(yaw) Ry(pitch) Rx(roll), or"),
    Column(("rx", "ry", "rz"), "angle", "the same as rotation vector"),
    Column(("sigma_position",), "length", "1 sigma of the row's position on each axis, or"),
    Column(("sigma_x", "sigma_y", "sigma_z"), "length", "1 sigma on each axis by itself"),
    Column(("sigma_orientation",), "angle", "1 sigma of the row's orientation about each axis, or"),
    Column(("sigma_rx", "sigma_ry", "sigma_rz"), "angle", "1 sigma about each axis by itself"),
    Column(("station",), "", "Where it was seen from; each has a frame, or pairs, of its own"),
)

ANGLES = "qx, qy, qz, qw or roll, pitch, yaw"


POSITION = Quantity("position", "position", "x, y, z", "measured positions", (3,))
ORIENTATION = Quantity("rotation", "orientation", ANGLES, "measured orientations", (3, 3))


def point_on_tool(at: Frames, t: Floats) -> tuple[Floats, Floats]:
    """Points t of the tool, `p + R t`, shape (n, 3), and `dp + w x R t`, shape (n, 1, 3, 6)."""
    arm = np.einsum("nij,nj->ni", at.rotation[:, 0], t)
    D = np.zeros((len(t), 1, 3, 6))
    D[:, 0, :, :3], D[:, 0, :, 3:] = -cross_matrix(arm), np.eye(3)
    return at.position[:, 0] + arm, D


class Position(Kind):
    """`p - measured` in the frame that the chain starts in, [m]; its derivative is `dp`.

    Data: the position, 3 columns, [m].
    """

    names, units = ("position.x", "position.y", "position.z"), ("m", "m", "m")
    ends, residual_dim, width = 1, 3, 3
    code: int | None = kernels.POSITION

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        p, D = point_on_tool(at, np.zeros((len(data), 3)))
        return Rows(p - data, D)


class TargetPosition(Position):
    """`p + R t - measured` in the frame that the chain starts in, [m]; its derivative is `dp + w x R t + R dt`.

    Data: the position, 3 columns, [m]. Nuisances: the target t in the tool frame, 3 coordinates, [m].
    """

    n_nuisances, code = 3, None

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        p, D = point_on_tool(at, nuisances)
        return Rows(p - data, D, at.rotation[:, 0])


class Orientation(Kind):
    """`r = Log(R_measured^T R)`, the rotation vector in the tool frame, [rad]; its derivative is `Jr^-1(r) R^T w`.

    Jr is the right Jacobian of SO(3) (Sola et al. 2018, Eq. 144).

    Data: the rotation matrix in the frame that the chain starts in, row by row, 9 columns.
    """

    names, units = ("orientation.x", "orientation.y", "orientation.z"), ("rad", "rad", "rad")
    ends, residual_dim, width = 1, 3, 9
    code = kernels.ORIENTATION

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        R_T = np.swapaxes(at.rotation[:, 0], 1, 2)
        r = -Rotation.from_matrix(R_T @ data[:, :9].reshape(-1, 3, 3)).as_rotvec()
        D = np.zeros((len(r), 1, 3, 6))
        D[:, 0, :, :3] = inverse_right_jacobian(r) @ R_T
        return Rows(r, D)

    def predict(self, at: Frames, nuisances: Floats) -> Floats:
        """See `Kind.predict`."""
        return at.rotation[:, 0].reshape(-1, 9)


class PoseTracker(Instrument):
    """Poses, positions or orientations of the tool; positions of targets where a row names one.

    Args:
        model: Which of them.
        orientation: Whether orientations take part.
        position: Whether positions do.
    """

    optional_labels = ("target",)
    columns = (*POSE_COLUMNS, Column(("target",), "", "Which point of the tool was seen; empty: the tool itself"))
    is_pose = True

    def __init__(self, model: str, orientation: bool, position: bool) -> None:
        self.model, self.words = model, f"measured {model}s"
        self.sees_orientation, self.sees_position = orientation, position
        self.quantities = (ORIENTATION,) * orientation + (POSITION,) * position
        self.noise = ("position",) * position + ("orientation",) * orientation
        self.landmarks, self.labels = (TARGET,) * position, ("target",) * position + ("station",)

    def kinds(self, table: Table) -> Kinds:
        """See `Instrument.kinds`."""
        rotated = (Orientation(),) * self.sees_orientation
        if not self.sees_position:
            return [(Orientation(), ~np.zeros_like(table.measurements.test))]
        of_target = self.names(table.measurements, TARGET).index >= 0
        return [(stack(*rotated, Position()), ~of_target), (stack(*rotated, TargetPosition()), of_target)]

    def start_frames(self, start: FrameStart, table: Table, blocks: Blocks, landmarks: Landmarks) -> None:
        """Frame and tool from poses; of targets only their orientations say something of the tool."""
        m, labels = table.measurements, table.measurements.labels.get("target")
        train = np.flatnonzero(~m.test)
        R_F, p_F = start.flange[0][train], start.flange[1][train]
        R = m.rotation[train] if self.sees_orientation and m.rotation is not None else None
        p = m.position[train] if self.sees_position and m.position is not None else None
        start.align(train, (R, p if labels is None else None))
        if p is None or labels is None or not any(block.kind.n_nuisances for block in blocks):
            return
        coordinates = landmarks.coordinates_of(TARGET, labels.names)
        known = np.vstack([start.places[coordinates], np.zeros(3)])  # the tool point itself at the end, as row -1
        target = np.where(labels.index[train] < 0, len(labels.names), labels.index[train])
        tool = R_F @ start.tool.rotation, p_F + R_F @ start.tool.translation
        frame, places = targets_from_positions(tool, p, target, known, start.unknown_frame)
        start.places[coordinates] = places[:-1]
        start.set_frame(frame)


INSTRUMENTS = tuple(PoseTracker(model, *uses) for model, uses in POSE_MODELS.items())
