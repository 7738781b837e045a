"""An arm by its screw axes (a product of exponentials, or links of CPC), and an axis report: how far each is off.

The point of an axis is that nearest to the base's origin, p - z (z . p) with any point p on it. From a frame there with
the axis as its z, another axis crosses the plane across z at (x, y), and its direction is

    z' = Ry(pitch) Rx(roll) e_z = (sin pitch cos roll, -sin roll, cos pitch cos roll)

These are the four parameters of `RobotBuilder.add_screw_joint`. The offset of the nominal axis is the length of (x, y),
its tilt that of (pitch, roll), each with the sigma along it.

References:
    Brockett (1984), Robotic manipulators and the product of exponentials formula. Mathematical Theory of Networks and
    Systems. Okamura, Park (1996), Kinematic calibration using the product of exponentials formula. Robotica 14.
"""

from collections.abc import Sequence
from dataclasses import asdict
from itertools import accumulate
from typing import Any

import numpy as np

from fg_calib.calibration import Calibration
from fg_calib.exports.dh import N_JUDGED, SAME, drawn, errors, inverse, links_of, tidy
from fg_calib.inputs import Floats
from fg_calib.io import Units, cpc_text, robot_text
from fg_calib.robot import POE, SCREW_KINDS, Robot, RobotBuilder, frame_values

KEYS = (*SCREW_KINDS, "offset", "tilt")
"""Figures of an axis that have a sigma, [m] and [rad]."""


def in_screws(robot: Robot) -> Robot:
    """The geometry of an arm by its axes at zero readings in the base frame; the point of a slide is the origin."""
    builder, (*frames, tool) = RobotBuilder(robot.name, POE), axis_frames(robot)
    for joint, T in zip(robot.joints, frames, strict=True):
        point = T[:3, 3] - T[:3, 2] * (T[:3, 2] @ T[:3, 3])
        builder.add_screw_joint(joint, T[:3, 2], np.where(joint.prismatic | (np.abs(point) <= SAME), 0.0, point))
    builder.add_frame("tool", frame_values("tool", tidy(tool)), robot.n_joints + 1, False)
    return builder.build()


def axis_frames(robot: Robot) -> list[Floats]:
    """Frames in the base frame at zero readings: the joints' axes as their z, then the tool's, shape (4, 4) each."""
    links = links_of(robot.geometry)
    _, *frames, _, tool = accumulate((links.base, *links.between, links.tool), np.matmul)
    return [*frames, tool]


def axis_changes(robot: Robot, start: Sequence[Floats]) -> Floats:
    """x, y, pitch and roll that bring axes onto those of a robot, shape (n_joints, 2, 2), [m] and [rad].

    Args:
        robot: The robot, at its nominal values.
        start: Frames with the axes as their z, shape (4, 4) each. Slides have no x and y: these are 0.
    """
    changes = np.zeros((robot.n_joints, 2, 2))
    for change, joint, T, before in zip(changes, robot.joints, axis_frames(robot), start, strict=False):
        M = inverse(before) @ T
        z, p = M[:3, 2], M[:3, 3]
        change[0] = 0.0 if joint.prismatic else (p - z * (p[2] / z[2]))[:2]
        change[1] = np.arctan2(z[0], z[2]), -np.arcsin(z[1])
    return changes


def screw_content(arm: Robot | Calibration, nominal: Robot | None) -> tuple[str, list[str], dict[str, Any]]:
    """Text of an arm's axes with their sigmas, notes with the axis report, and details as in `Export`."""
    robot = arm.robot if isinstance(arm, Calibration) else arm
    found, n = in_screws(robot), robot.n_joints
    own, error = axis_frames(found), errors(found, robot.geometry, drawn(robot, N_JUDGED, 1))
    changes = axis_changes(nominal or robot, own)
    lengths = np.linalg.norm(changes, axis=2)[:, :, None]
    along = np.divide(changes, lengths, out=np.full(changes.shape, np.sqrt(0.5)), where=lengths > 0.0)

    def values(one: Robot) -> Floats:
        changes = axis_changes(one, own)
        return np.hstack([changes.reshape(n, 4), np.sum(along * changes, axis=2)])

    sigmas = np.full((n, 6), np.nan)
    if isinstance(arm, Calibration) and not arm.result.evaluated_only:
        sigmas = np.sqrt(arm.posterior.variance(arm.posterior.derivative(values))).reshape(n, 6)
    notes = [f"axes at zero readings in the base frame; the same arm to {error.position_max:.1g} m"]
    notes += ["x, y, pitch, roll: across each axis, at its point nearest to the base's origin; sigma: 1 sigma of them"]
    axes = dict[str, Any]()
    for joint, sizes, s in zip(robot.joints, lengths[:, :, 0].tolist(), sigmas, strict=True):
        known = {key: float(f"{one:.3g}") for key, one in zip(KEYS, s, strict=True) if np.isfinite(one)}
        axes[joint.name] = {"offset": sizes[0], "tilt": sizes[1], "sigma": known}
        offset = f"offset {1e3 * sizes[0]:.4g} mm (sigma {1e3 * s[4]:.2g})"
        tilt = f"tilt {np.rad2deg(sizes[1]):.4g} deg (sigma {np.rad2deg(s[5]):.2g})"
        notes += [f"{joint.name}: {offset}, {tilt} from nominal".replace("nan", "unknown")] * (nominal is not None)
    rows = [{kind: s for kind, s in axis["sigma"].items() if kind in SCREW_KINDS} for axis in axes.values()]
    text = robot_text(found, sigmas=rows if isinstance(arm, Calibration) else ())
    return text, notes, {"convention": POE, "axes": axes}


def link_content(robot: Robot) -> tuple[str, list[str], dict[str, Any]]:
    """Text of an arm in links of CPC (see `io.robot_file`), notes, and details as in `Export`."""
    text, back = cpc_text(robot, axis_frames(robot), Units("mm", "deg"))
    error = errors(back, robot, drawn(robot, N_JUDGED, 1))
    notes = ["CPC: Rz or Tz(sign q) R(b) Rz(beta) Txyz(l) a joint, link0 before them; mm and deg"]
    notes += [f"the same arm; over {error.n} configurations {error}"]
    return text, notes, {"convention": "cpc", "error": asdict(error)}
