"""Arms that several experiments simulate: the paper's, a UR10-like 6R and a SCARA, with their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import fg_calib
from fg_calib.robot.model import Joint, Robot, RobotBuilder

Floats = NDArray[np.float64]

ENCODER = np.deg2rad(0.005)
"""1 sigma of a revolute joint's reading where it has noise, [rad]."""

ENCODER_SLIDE = 1e-5
"""The same of a prismatic joint, [m]."""

UR10 = [(0, 0, 0.1273), (90, 0, 0), (0, -0.612, 0), (0, -0.5723, 0.163941), (90, 0, 0.1157), (-90, 0, 0.0922)]
"""alpha [deg], a [m], d [m] of each joint, modified DH: the maker's figures of a UR10."""

SCARA = [(0, 0, 0.35, 130), (0, 0.325, 0, 145), (180, 0.275, 0.05, 0.2), (0, 0, 0.1, 180)]
"""alpha [deg], a, d [m], limit [deg] or [m] of each joint, modified DH; the third slides."""


@dataclass(frozen=True)
class Arm:
    """A nominal robot and how it is measured.

    Attributes:
        robot: Its tolerances are the 1 sigma of its true errors.
        sigma: Of positions and distances, [m], and of orientations and angles, [rad].
    """

    robot: Robot
    sigma: tuple[float, float]

    @property
    def sigma_joint(self) -> Floats:
        """Of the readings where they have noise, shape (n_joints,), [rad] (prismatic: [m])."""
        return np.array([ENCODER_SLIDE if joint.prismatic else ENCODER for joint in self.robot.joints])

    def readings(self, n: int, rng: np.random.Generator) -> Floats:
        """Random configurations within the limits, shape (n, n_joints)."""
        lower, upper = np.clip(self.robot.limits, -np.pi, np.pi).T
        return rng.uniform(lower, upper, (n, self.robot.n_joints))

    def true_robot(self, rng: np.random.Generator) -> Robot:
        """The robot with errors drawn from its priors."""
        sigma = np.array([(p.tolerance or 0.0) if p.estimated else 0.0 for p in self.robot.parameters])
        return self.robot.with_values(self.robot.nominal + sigma * rng.normal(size=len(sigma)))

    def scaled(self, noise: float = 1.0, tolerance: float = 1.0) -> Arm:
        """The same arm with other noise and tolerances, as multiples."""
        parameters = tuple(
            replace(p, tolerance=None if p.tolerance is None else tolerance * p.tolerance)
            for p in self.robot.parameters
        )
        return Arm(replace(self.robot, parameters=parameters), (noise * self.sigma[0], noise * self.sigma[1]))


def build_arms() -> dict[str, Arm]:
    """The arms by name."""
    tolerance = {"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3}
    ur10 = RobotBuilder("UR10", "mdh-hayati")
    for i, (alpha, a, d) in enumerate(UR10):
        values = {"alpha": np.deg2rad(alpha), "a": a, "d": d, "theta": 0.0, "beta": 0.0}
        ur10.add_convention_joint(Joint(f"q{i + 1}", lower=-np.pi, upper=np.pi), values)
    scara = RobotBuilder("SCARA", "mdh-hayati")
    for i, (alpha, a, d, limit) in enumerate(SCARA):
        values = {"alpha": np.deg2rad(alpha), "a": a, "d": d, "theta": 0.0, "beta": 0.0}
        bound = np.deg2rad(limit)
        joint = Joint(f"q{i + 1}", True, 0.0, limit) if i == 2 else Joint(f"q{i + 1}", lower=-bound, upper=bound)
        scara.add_convention_joint(joint, values)
    for builder, n in ((ur10, 6), (scara, 4)):
        builder.add_frame("tool", {}, n + 1, False)
    space = fg_calib.read_scenario("space-robot").robot
    return {
        "space robot": Arm(space, (1e-3, np.deg2rad(0.01))),
        "UR10": Arm(ur10.build(tolerance=tolerance), (1e-4, np.deg2rad(0.01))),
        "SCARA": Arm(scara.build(tolerance=tolerance), (5e-5, np.deg2rad(0.01))),
    }


def random_arm(n_joints: int, rng: np.random.Generator) -> Robot:
    """An arm of revolute joints whose axes are parallel or at right angles, links of up to half a metre.

    No three axes in a row are parallel; a link has a length along its axis, across it, or both. All may be off by 1 mm
    and 1 mrad (1 sigma) but the first, which is where the base is.
    """
    builder = RobotBuilder(f"{n_joints}R", "mdh-hayati")
    turns = [0.0]
    while len(turns) < n_joints:
        turn = float(rng.choice([0.0, 0.5 * np.pi, -0.5 * np.pi]))
        if turn or len(turns) < 2 or turns[-1]:
            turns.append(turn)
    for i, alpha in enumerate(turns):
        kind = rng.integers(3)
        a = 0.0 if i == 0 or kind == 0 else float(rng.uniform(0.1, 0.5))
        d = 0.0 if kind == 1 else float(rng.uniform(0.1, 0.5))
        limit = np.deg2rad(rng.uniform(90.0, 170.0))
        values = {"alpha": alpha, "a": a, "d": d, "theta": 0.0, "beta": 0.0}
        builder.add_convention_joint(Joint(f"q{i + 1}", lower=-limit, upper=limit), values)
    builder.add_frame("tool", {"x": 0.05, "z": float(rng.uniform(0.1, 0.2))}, n_joints + 1, False)
    tolerance = {"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3}
    fixed = ("a1", "alpha1", "d1", "theta1", "beta1")
    return builder.build(tolerance=tolerance, fixed=fixed)


def random_rotations(n: int, sigma: float, rng: np.random.Generator) -> Floats:
    """Small random rotations of 1 `sigma` about each axis, [rad], shape (n, 3, 3)."""
    return Rotation.from_rotvec(sigma * rng.normal(size=(n, 3))).as_matrix()
