"""Where a robot is sent to be measured: configurations drawn, given, or in sight of a board; and frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.options import check, check_number
from fg_calib.sizes import MOST_DRAWN

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """A frame in another one, such as world_T_base or base_T_board.

    Attributes:
        rotation: Shape (3, 3).
        position: Shape (3,), [m].
    """

    rotation: Floats
    position: Floats

    def summary(self) -> dict[str, list[float]]:
        """For programs: position, [m], and rotation."""
        from scipy.spatial.transform import Rotation

        quaternion = Rotation.from_matrix(self.rotation.copy()).as_quat(canonical=True)
        return {"xyz": self.position.tolist(), "quaternion_xyzw": quaternion.tolist()}


@dataclass(frozen=True)
class BoardViews:
    """Configurations in which the tool's z axis, a camera's optical axis, meets the centre of a board.

    The first is A, `height` above the centre. The others are spread evenly over the half sphere of `radius` about A
    on the side away from the board (Jia et al. 2019, section 5.1), or, with `distance`, drawn at such distances from
    the centre, evenly in distance and in direction within `cone` of the normal.

    Attributes:
        board: base_T_board; z is the normal on the camera's side.
        count: Number of configurations beside A.
        height: Distance of A from the centre, [m].
        radius: Of the half sphere about A, [m].
        distance: Smallest and largest distance from the centre, [m]; None for the half sphere.
        cone: Largest angle between the normal and the direction from the centre to the camera, [rad].
        roll: Of the camera about its optical axis, [rad]; at 0 its x axis at A is the board's, and elsewhere what
            the smallest turn of the optical axis makes of that. None draws it.
        self_motion: `random`: every configuration has its own, from a random start of the inverse kinematics;
            `held`: all continue from that of A by steps of minimum norm.
        posture: Configuration near which that of A is sought, if self-motion is held, shape (n_joints,), [rad]
            (prismatic: [m]); None draws it.
    """

    board: Placement
    count: int = 51
    height: float = 0.5
    radius: float = 0.5
    distance: tuple[float, float] | None = None
    cone: float = math.pi / 3.0
    roll: float | None = None
    self_motion: Literal["random", "held"] = "random"
    posture: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check("board: self_motion", self.self_motion, ("random", "held"))
        check_number("board: count", self.count, whole=True, most=MOST_DRAWN)
        for key in ("height", "radius", "cone"):
            check_number(f"board: {key}", getattr(self, key), above=True)


@dataclass(frozen=True)
class RandomReadings:
    """Configurations drawn evenly within the joint limits, +-180 degrees or +-1 m where there are none."""

    count: int

    def __post_init__(self) -> None:
        check_number("random: count", self.count, above=True, whole=True, most=MOST_DRAWN)


@dataclass(frozen=True)
class GivenReadings:
    """Configurations of a table.

    Attributes:
        readings: Shape (n_configurations, n_joints), [rad] (prismatic: [m]).
    """

    readings: Floats


Configurations = BoardViews | RandomReadings | GivenReadings
