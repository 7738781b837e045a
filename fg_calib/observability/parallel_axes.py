"""Small motions between neighbouring joint axes that a robot's convention has no parameter for.

The four parameters of a Denavit-Hartenberg joint hold every small motion between two axes only while these are not
parallel. Between parallel axes a tilt about y is missing, which the fifth parameter of Hayati (1983) adds. Between
revolute axes on one line there is no common normal, and a shift along y is missing too. Near to that the parameters
would have to change by many times the small motion that they follow. Six parameters a joint leave nothing out.

References:
    Hayati (1983), Robot arm geometric link parameter estimation. 22nd IEEE Conf. on Decision and Control.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fg_calib.inputs import Floats, Record
from fg_calib.robot import CONVENTIONS, Axis, Robot, pose

PARALLEL_RAD = np.deg2rad(3.0)
"""Angle of two axes below which parameters would have to change by 20 times the tilt that they follow, or more."""

COAXIAL_SHARE = 1.0 / 300.0
"""Distance of parallel axes, over the arm's reach, below which angles would have to change 300 times as much."""

EXACT_RAD = 1e-6
"""Angle below which axes are called parallel without saying within what."""

UPRIGHT_COSINE = 0.2
"""Cosine of a pitch below which tilts across need five and more times the change of roll and yaw."""

WORDS = {Axis.RX: "a tilt about x", Axis.RY: "a tilt about y", Axis.TY: "a shift along y"}


class MissingMotion(Record):
    """A small motion between neighbouring axes that the convention has no parameter for.

    Attributes:
        axes: 1-based numbers of the joints, neighbours in chain order; of a frame the joints before and after it.
        motions: Small motions that are missing between each two of them, in the frame of the link from one to the next.
        convention: The robot's convention.
        use: The convention that has the parameters.
        angle: Largest angle between two neighbours' axes, [rad].
        frame: The frame whose angles lack it, being pitched by a quarter turn; empty for axes of a convention.
    """

    axes: tuple[int, ...]
    motions: tuple[Axis, ...]
    convention: str
    use: str
    angle: float
    frame: str = ""

    def __str__(self) -> str:
        if self.frame:
            how = "is pitched by about 90 deg, where its roll and yaw turn about nearly the same axis"
            return f"{self.frame} {how}: hardly a parameter for a tilt across it; {self.use}"
        axes = f"{', '.join(map(str, self.axes[:-1]))} and {self.axes[-1]}"
        what = " and ".join(WORDS[motion] for motion in self.motions)
        how = "parallel" if self.angle < EXACT_RAD else f"parallel within {np.rad2deg(self.angle):.2g} deg"
        lacks = f"convention {self.convention} has no parameter for {what} between them"
        return f"axes {axes} are {how} and {lacks}: use {self.use}"


@lru_cache(maxsize=16)  # cross-validation and simulations ask of one robot again and again
def missing_motions(robot: Robot) -> tuple[MissingMotion, ...]:
    """Motions that a robot's parameters leave out at its nominal values; fixed parameters of a convention count."""
    return (*_of_convention(robot), *_of_frames(robot))


def _of_frames(robot: Robot) -> tuple[MissingMotion, ...]:
    """Frames whose roll, pitch and yaw are estimated as numbers, pitched by a quarter turn or nearly so."""
    found = []
    for owner in range(robot.n_joints + 2):
        own = [robot.parameters[i] for i in robot.owned_by(owner)]
        angles = {p.kind: p for p in own if p.kind in ("roll", "pitch", "yaw") and p.estimated}
        outer = owner in (0, robot.n_joints + 1)
        as_pose = outer and len(own) == 6 and all(p.estimated for p in own)  # a pose has no such place
        if len(angles) < 3 or as_pose or abs(np.cos(angles["pitch"].nominal)) > UPRIGHT_COSINE:
            continue
        name = angles["pitch"].name.removesuffix(".pitch")
        use = f"estimate all six of {name}" if outer else "describe the arm by mdh-hayati or dh-hayati"
        frame = f"the frame {name}" if outer else f"the origin of joint {name}"
        link = min(max(owner - 1, 0), robot.n_joints)
        found.append(MissingMotion((link, link + 1), (Axis.RX, Axis.RY, Axis.RZ), robot.convention, use, 0.0, frame))
    return tuple(found)


def _of_convention(robot: Robot) -> tuple[MissingMotion, ...]:
    """Motions that parallel axes of a Denavit-Hartenberg convention lack."""
    if robot.n_joints < 2 or robot.convention not in CONVENTIONS:
        return ()
    z, points = _axes(robot)
    prismatic = [joint.prismatic for joint in robot.joints]
    has_beta, hayati = "beta" in CONVENTIONS[robot.convention], f"{robot.convention}-hayati"
    found: list[MissingMotion] = []
    for i in range(robot.n_joints - 1):
        angle = float(np.arcsin(np.clip(np.linalg.norm(np.cross(z[i], z[i + 1])), 0.0, 1.0)))
        apart = float(np.linalg.norm(np.cross(points[i + 1] - points[i], z[i])))
        coaxial = not (prismatic[i] or prismatic[i + 1]) and apart < COAXIAL_SHARE * robot.reach
        motions = (Axis.TY,) * coaxial + (Axis.RY,) * (not has_beta)
        if angle > PARALLEL_RAD or not motions:
            continue
        one = MissingMotion((i + 1, i + 2), motions, robot.convention, "a URDF" if coaxial else hayati, angle)
        last = found[-1] if found else None
        if last is not None and last.axes[-1] == i + 1 and (last.motions, last.use) == (motions, one.use):
            found[-1] = replace(last, axes=(*last.axes, i + 2), angle=max(last.angle, angle))
        else:
            found.append(one)
    return tuple(found)


def _axes(robot: Robot) -> tuple[Floats, Floats]:
    """Directions of the axes in the base frame, and a point of each, at readings of 0, shape (n_joints, 3) each.

    A revolute joint moves the tool point p by w x (p - o), so p + w x (w x (p - o)) is on its axis.
    """
    at = pose(robot, np.zeros((1, robot.n_joints)))
    w, v = np.split(at.jacobian[0][:, len(robot.parameters) :].T, 2, axis=1)
    prismatic = np.array([joint.prismatic for joint in robot.joints])[:, None]
    return np.where(prismatic, v, w), at.position[0] + np.cross(w, v)
