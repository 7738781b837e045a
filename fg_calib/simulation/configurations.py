"""Where a robot is sent to be measured: configurations drawn, given, or in sight of a board or a tracker; frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays, as_floats
from fg_calib.errors import InputError, shown
from fg_calib.options import check, check_number
from fg_calib.robot.shape import Box
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


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What configurations of any kind may have to keep to.

    Attributes:
        keep_out: Boxes that nothing of the arm may be inside, see `robot.shape.enters`.
        apart: Least distance of two configurations, [rad]: how far the joint turns that turns furthest from one to the
            other; that a joint slides counts as its share of the arm's reach. None: any.
    """

    keep_out: tuple[Box, ...] = ()
    apart: float | None = None

    def __post_init__(self) -> None:
        for i, box in enumerate(self.keep_out):
            if not isinstance(box, Box):
                raise InputError(f"keep_out[{i}]", f"found {shown(box)}", "a Box")
        if self.apart is not None:
            check_number("apart", self.apart, above=True)


@dataclass(frozen=True)
class BoardViews(Conditions):
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
        field_of_view: Half angle of the cone about the optical axis in which the camera sees, [rad]. The camera, placed
            and rolled as above, is turned from the board's centre so that this is anywhere in that cone, evenly in
            solid angle; at 0 the optical axis meets the centre.
        board_size: Width along the board's x and height along its y, [m]: only views with its four corners in the
            field of view are taken. None: the centre alone is seen.
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
    field_of_view: float = 0.0
    board_size: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check("board: self_motion", self.self_motion, ("random", "held"))
        check_number("board: count", self.count, whole=True, most=MOST_DRAWN)
        for key in ("height", "radius", "cone"):
            check_number(f"board: {key}", getattr(self, key), above=True)
        check_number("board: field_of_view", self.field_of_view)
        if self.field_of_view >= 0.5 * math.pi:
            raise InputError("board: field_of_view", f"found {self.field_of_view:g}", "less than a quarter turn")
        if self.board_size is not None:
            for figure in as_floats("board: board_size", self.board_size, "(2,)"):
                check_number("board: board_size", figure, above=True)
            if self.field_of_view == 0.0:
                raise InputError("board: board_size", f"found {shown(self.board_size)}", "none without field_of_view")


@dataclass(frozen=True)
class TargetViews(Conditions, FrozenArrays):
    """Configurations in which a tracker in its place sees a reflector on the tool.

    The reflector, such as a corner cube, returns light that comes from within `acceptance` of its axis. A random
    configuration says where it is, or `region` does; from there it is turned towards the tracker, to anywhere within
    the acceptance and with any roll about its axis, and inverse kinematics, from that configuration, find the joints.
    Where it faces the tracker already, the random configuration is taken as it is; so are all of an arm of fewer than
    six joints, which cannot be turned at will. The arm or a box in the line of sight is not looked for.

    Attributes:
        station: Where the tracker is, in the robot's base frame, shape (3,), [m].
        target: The reflector in the tool frame, shape (3,), [m].
        count: Number of configurations.
        axis: Direction in which the reflector looks, in the tool frame, shape (3,), of any length.
        acceptance: Largest angle between that and the direction to the tracker, [rad].
        distance: Smallest and largest distance of the reflector from the tracker, [m].
        region: Where the reflector may be; None: wherever the arm brings it.
    """

    station: Floats
    target: Floats
    count: int = 50
    axis: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    acceptance: float = math.pi / 6.0
    distance: tuple[float, float] = (0.0, math.inf)
    region: Box | None = None

    def __post_init__(self) -> None:
        Conditions.__post_init__(self)
        for key in ("station", "target", "axis"):
            object.__setattr__(self, key, as_floats(f"tracker: {key}", getattr(self, key), "(3,)"))
        if not self.axis.any():
            raise InputError("tracker: axis", "found 0, 0, 0", "a direction")
        check_number("tracker: count", self.count, above=True, whole=True, most=MOST_DRAWN)
        check_number("tracker: acceptance", self.acceptance, above=True)
        if self.acceptance > math.pi:
            raise InputError("tracker: acceptance", f"found {self.acceptance:g}", "at most half a turn")
        nearest, farthest = self.distance
        check_number("tracker: distance", nearest)
        check_number("tracker: distance", farthest, least=nearest, finite=False)
        if not isinstance(self.region, Box | None):
            raise InputError("tracker: region", f"found {shown(self.region)}", "a Box")
        FrozenArrays.__post_init__(self)


@dataclass(frozen=True)
class RandomReadings(Conditions):
    """Configurations drawn evenly within the joint limits, +-180 degrees or +-1 m where there are none."""

    count: int

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("random: count", self.count, above=True, whole=True, most=MOST_DRAWN)


@dataclass(frozen=True)
class GivenReadings(Conditions):
    """Configurations of a table.

    Attributes:
        readings: Shape (n_configurations, n_joints), [rad] (prismatic: [m]).
    """

    readings: Floats


Configurations = BoardViews | TargetViews | RandomReadings | GivenReadings
