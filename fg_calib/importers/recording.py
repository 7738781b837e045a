"""Recordings: joint readings and poses over time, each by its sender's clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fg_calib.inputs import Floats, FrozenArrays
from fg_calib.robot import Robot, build_chain, forward


@dataclass(frozen=True)
class Source:
    """Where a stream is from.

    Attributes:
        topic: Its topic.
        type: Type of its messages.
        lag: Median of the time of receipt minus the stamp, [s]: latency, and the offset of the two clocks.
        notes: What was left out or put in order, in words.
    """

    topic: str
    type: str
    lag: float = 0.0
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class JointStream(FrozenArrays):
    """Joint readings over time.

    Attributes:
        time: By the sender's clock, ascending, shape (n,), [s].
        readings: In chain order, shape (n, n_joints), [rad] (prismatic: [m]).
        source: Where they are from.
    """

    time: Floats
    readings: Floats
    source: Source

    def tool_path(self, robot: Robot) -> PoseStream:
        """The tool's poses at the readings, of the nominal robot in its base frame."""
        poses = forward(build_chain(robot, {}), robot.trig(self.readings))
        return PoseStream(self.time, poses.position, poses.rotation, self.source)


@dataclass(frozen=True)
class PoseStream(FrozenArrays):
    """Poses over time.

    Attributes:
        time: By the sender's clock, ascending, shape (n,), [s].
        position: world_p_tool, shape (n, 3), [m].
        rotation: world_R_tool, shape (n, 3, 3); None where orientations are not measured.
        source: Where they are from.
    """

    time: Floats
    position: Floats
    rotation: Floats | None
    source: Source


def period(time: Floats) -> float:
    """Median time from one sample to the next, [s]."""
    return float(np.median(np.diff(time)))
