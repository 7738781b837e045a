"""Small motions between neighbouring joint axes that a robot's convention has no parameter for.

The four parameters of a Denavit-Hartenberg joint hold every small motion between two axes only while these are not
parallel. Between parallel axes a tilt about y is missing, and between axes on one line a shift along y too; near to
that the parameters would have to change without bound to follow a small tilt (Hayati 1983).

Nothing here knows that. Each of the six small motions of a link in its own frame moves the tool at random
configurations; what is not among the effects of the arm's parameters, base and tool counted as free, is missing. A
parameter's change per change that it follows is bounded by least squares with a small penalty on it:

    v = min over p of |t - J p|^2 + |t|^2 NOTICED (|p| / MOST_CHANGE)^2        missing where v > |t|^2 NOTICED

with t the effect of the motion and J those of the parameters, lengths in units of the arm's length.

References:
    Hayati (1983), Robot arm geometric link parameter estimation. 22nd IEEE Conf. on Decision and Control.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fg_calib.robot.kinematics import Poses, build_chain, forward, pose
from fg_calib.robot.model import CONVENTIONS, Axis, Element, Robot

Floats = NDArray[np.float64]

MOST_CHANGE = 300.0
"""Change of parameters per motion that they follow, beyond which they do not: axes parallel within some 3 degrees."""

NOTICED = 0.05
"""Part of a motion's squared effect beyond which it counts as missing: other parameters mimic the rest."""

WORDS = {
    **{Axis.RX: "a tilt about x", Axis.RY: "a tilt about y", Axis.RZ: "a turn about z"},
    **{Axis.TX: "a shift along x", Axis.TY: "a shift along y", Axis.TZ: "a shift along z"},
}
_TURNS = (Axis.RX, Axis.RY, Axis.RZ)
_SHIFTS = (Axis.TX, Axis.TY, Axis.TZ)
_PARALLEL, _NEARLY_PARALLEL = 1e-6, 0.2  # [rad]
_NEARLY_UPRIGHT = 0.2
"""Cosine of a pitch below which tilts across need five and more times the change of roll and yaw."""


@dataclass(frozen=True)
class MissingMotion:
    """A small motion between neighbouring axes that the convention has no parameter for.

    Attributes:
        axes: 1-based numbers of the joints, neighbours in chain order.
        motions: What is missing between each two of them, in the frame of the link from the one to the other.
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
        if self.angle > _NEARLY_PARALLEL:
            return f"convention {self.convention} has no parameter for {what} between axes {axes}: use {self.use}"
        how = "parallel" if self.angle < _PARALLEL else f"parallel within {np.rad2deg(self.angle):.2g} deg"
        lacks = f"convention {self.convention} has no parameter for {what} between them"
        return f"axes {axes} are {how} and {lacks}: use {self.use}"


def end_of_link(robot: Robot, owner: int) -> int:
    """How many of a robot's elements come before the end of the link that joint `owner` moves (0: the base)."""

    def of_link(i: int) -> bool:
        e = robot.elements[i]
        return e.joint == owner - 1 or (e.parameter is not None and robot.parameters[e.parameter].owner == owner)

    return max(filter(of_link, range(len(robot.elements))), default=-1) + 1


@lru_cache(maxsize=16)  # folds and simulations ask of one robot again and again
def missing_motions(robot: Robot) -> tuple[MissingMotion, ...]:
    """What a robot's parameters leave out at its nominal values; what is fixed in a convention counts as there."""
    return (*_of_convention(robot), *_of_frames(robot))


def _of_frames(robot: Robot) -> tuple[MissingMotion, ...]:
    """Frames whose roll, pitch and yaw are estimated as numbers, pitched by a quarter turn or nearly so."""
    found = []
    for owner in range(robot.n_joints + 2):
        own = [robot.parameters[i] for i in robot.owned_by(owner)]
        angles = {p.kind: p for p in own if p.kind in ("roll", "pitch", "yaw") and p.estimated}
        outer = owner in (0, robot.n_joints + 1)
        as_pose = outer and len(own) == 6 and all(p.estimated for p in own)  # a pose has no such place
        if len(angles) < 3 or as_pose or abs(np.cos(angles["pitch"].nominal)) > _NEARLY_UPRIGHT:
            continue
        name = angles["pitch"].name.removesuffix(".pitch")
        use = f"estimate all six of {name}" if outer else "describe the arm by mdh-hayati or dh-hayati"
        frame = f"the frame {name}" if outer else f"the origin of joint {name}"
        found.append(MissingMotion((owner,), (Axis.RX,), robot.convention, use, 0.0, frame))
    return tuple(found)


def _of_convention(robot: Robot) -> tuple[MissingMotion, ...]:
    """What parallel axes of a Denavit-Hartenberg convention lack."""
    n = robot.n_joints
    if n < 2 or robot.convention not in CONVENTIONS:
        return ()  # six parameters a joint leave nothing out between axes
    spans = np.array([1.0 if joint.prismatic else np.pi for joint in robot.joints])
    readings = np.random.default_rng(0).uniform(-spans, spans, (5 * n + 30, n))
    at = pose(robot, readings)
    length = float(np.sqrt(np.mean(np.sum((at.position - at.position.mean(axis=0)) ** 2, axis=1)))) or 1.0
    of_joints = [i for i, p in enumerate(robot.parameters) if 1 <= p.owner <= n]
    unit = np.array([length if robot.parameters[i].unit == "m" else 1.0 for i in of_joints])
    own = _unitless(at.jacobian[:, :, of_joints] * unit, length)
    links = [_motions(robot, readings, at, owner, length) for owner in range(n + 1)]  # link 0 is the base
    tool = _motions_at(at, at, length)
    J = np.hstack([own, links[0], tool])
    missing = [_missing(links[i], J) for i in range(1, n)]
    if not any(missing):
        return ()
    with_beta = np.hstack([J, *(link[:, [Axis.RY]] for link in links[1:])])
    hayati = f"{robot.convention}-hayati"
    axes = _axes(at, robot)
    found: list[MissingMotion] = []
    for i, motions in enumerate(missing, start=1):
        if not motions:
            continue
        use = hayati if hayati in CONVENTIONS and not _missing(links[i], with_beta) else "a URDF"
        angle = float(np.arcsin(np.linalg.norm(np.cross(axes[:, i - 1], axes[:, i]), axis=1).max().clip(0.0, 1.0)))
        one = MissingMotion((i, i + 1), motions, robot.convention, use, angle)
        last = found[-1] if found else None
        if last is not None and last.axes[-1] == i and (last.motions, last.use) == (motions, use):
            found[-1] = replace(last, axes=(*last.axes, i + 1), angle=max(last.angle, angle))
        else:
            found.append(one)
    return tuple(found)


def _missing(motions: Floats, J: Floats) -> tuple[Axis, ...]:
    """Those of a link's six motions, shape (n_rows, 6), that no bounded change of the columns of J follows."""
    size = np.sum(motions**2, axis=0)  # (6,)
    penalty = NOTICED * float(np.mean(size)) / MOST_CHANGE**2
    along = J.T @ motions
    left = size - np.sum(along * np.linalg.solve(J.T @ J + penalty * np.eye(J.shape[1]), along), axis=0)
    return tuple(Axis(int(i)) for i in np.flatnonzero(left > NOTICED * size))


def _motions(robot: Robot, readings: Floats, at: Poses, owner: int, length: float) -> Floats:
    """Effects of the six small motions of the link behind joint `owner` in its own frame, shape (n_rows, 6)."""
    nothing = Element(Axis.TX)  # of a robot without a base frame
    link = replace(robot, elements=(nothing, *robot.elements[: end_of_link(robot, owner)]))
    return _motions_at(forward(build_chain(link), robot.trig(readings)), at, length)


def _motions_at(link: Poses, at: Poses, length: float) -> Floats:
    """Effects on the tool of the six small motions of a frame in itself, by `Axis`, shape (n_rows, 6)."""
    effect = np.zeros((len(link.position), 6, 6))
    arm = at.position - link.position
    for k, (shift, turn) in enumerate(zip(_SHIFTS, _TURNS, strict=True)):
        axis = link.rotation[:, :, k]
        effect[:, 3:, shift] = axis * length
        effect[:, :3, turn] = axis
        effect[:, 3:, turn] = np.cross(axis, arm)
    return _unitless(effect, length)


def _unitless(effect: Floats, length: float) -> Floats:
    """Turns and shifts of the tool, shape (n, 6, m), as rows with lengths in units of the arm's."""
    scaled: Floats = effect * np.array([1.0, 1.0, 1.0, *[1.0 / length] * 3])[:, None]
    return scaled.reshape(-1, effect.shape[2])


def _axes(at: Poses, robot: Robot) -> Floats:
    """The joints' axes in the base frame, shape (n, n_joints, 3)."""
    J = at.jacobian[:, :, len(robot.parameters) :]
    slides = np.array([joint.prismatic for joint in robot.joints])
    axes: Floats = np.moveaxis(np.where(slides, J[:, 3:], J[:, :3]), 2, 1)
    return axes
