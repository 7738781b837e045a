"""Make the bundled example: the paper's space robot, calibrated with its own hand-eye camera.

Command: python experiments/make_example.py (some seconds; writes fg_calib/examples/space-robot)

The robot is Table 2 of Jia et al. (2019); its true errors are drawn uniformly within the bounds of Table 6 (0.01 m,
0.05 deg; joint 1 known), the noises are those of Table 5 (1 mm, 0.01 deg, encoders 0.005 deg). As in section 5.1 the
camera looks at the centre of a board from 0.5 m above it and from points spread over the hemisphere about that place;
assumed are the board's centre (0, 6.5, 2.55) m with its normal along +z, a random roll about the optical axis, and
a random start of the inverse kinematics (self-motion). 52 configurations are marked train, 20 more test.
Poses are measured in the board's frame, which nobody knows in the base's.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import fg_calib
from fg_calib.files.tables import write_csv

FOLDER = Path(__file__).parents[1] / "fg_calib" / "examples" / "space-robot"
BOARD = np.array([0.0, 6.5, 2.55])
RADIUS = 0.5
BOUND = {"m": 0.01, "rad": np.deg2rad(0.05)}
SIGMA_POSITION, SIGMA_ORIENTATION, SIGMA_JOINT = 1e-3, np.deg2rad(0.01), np.deg2rad(0.005)

ROBOT = """\
# The space robot of Jia et al. (2019), Table 2; tolerance = bound of Table 6 / sqrt(3), the sigma of a uniform error
name: space-robot
convention: mdh-hayati
units: {length: m, angle: deg}
joints:
  - {a: 0, alpha: 0, d: 2.3, theta: 0, beta: 0, limits: [-180, 180]}
  - {a: 0, alpha: -90, d: 0.5, theta: 0, beta: 0, limits: [-180, 180]}
  - {a: 0, alpha: -90, d: 0.5, theta: 0, beta: 0, limits: [-180, 180]}
  - {a: 5, alpha: 0, d: 0.5, theta: 0, beta: 0, limits: [-180, 180]}
  - {a: 5, alpha: 0, d: 0.5, theta: 0, beta: 0, limits: [-180, 180]}
  - {a: 0, alpha: 90, d: 0.5, theta: 0, beta: 0, limits: [-180, 180]}
  - {a: 0, alpha: 90, d: 0.5, theta: 0, beta: 0, limits: [-180, 180]}
fixed: [a1, alpha1, d1, theta1, beta1]
tolerance: {a: 0.0058, alpha: 0.029, d: 0.0058, theta: 0.029, beta: 0.029}
"""

JOB = """\
# Calibrate from what needs no frame: how far the tool moved, and by what angle it turned, between pairs of poses
robot: robot_nominal.yaml
measurements: poses.csv
model: distance-rotation
pairing: star
units: {length: m, angle: deg}
noise: {position: 0.001, orientation: 0.01, joint: 0.005}
"""


def looking_at_board(point: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and position of a tool at `point` whose z axis meets the board's centre, with a random roll."""
    z = (BOARD - point) / np.linalg.norm(BOARD - point)
    x = np.cross(rng.normal(size=3), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1), point


def solve_inverse(
    robot: fg_calib.Robot, rotation: np.ndarray, position: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Joint angles within +-180 degrees that put the tool there, by damped Newton from random starts."""
    for _ in range(500):
        q = rng.uniform(-np.pi, np.pi, robot.n_joints)
        for _ in range(100):
            now = fg_calib.pose(robot, q[None])
            turn = Rotation.from_matrix(rotation @ now.rotation[0].T).as_rotvec()
            miss = np.concatenate([turn, position - now.position[0]])
            if np.linalg.norm(miss) < 1e-12:
                return (q + np.pi) % (2 * np.pi) - np.pi
            J = now.jacobian[0][:, -robot.n_joints :]
            step = J.T @ np.linalg.solve(J @ J.T + 1e-6 * min(1.0, miss @ miss) * np.eye(6), miss)
            q = q + step * min(1.0, 0.5 / np.linalg.norm(step))
    raise RuntimeError(f"no configuration reaches {position}")


def simulate(seed: int, folder: Path) -> None:
    """Write robot_nominal.yaml, robot_true.yaml, poses.csv and calibration.yaml."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot_nominal.yaml").write_text(ROBOT)
    (folder / "calibration.yaml").write_text(JOB)
    robot = fg_calib.read_robot(folder / "robot_nominal.yaml")
    errors = [rng.uniform(-BOUND[p.unit], BOUND[p.unit]) if p.estimated else 0.0 for p in robot.parameters]
    true = replace(robot.with_values(robot.nominal + errors), name="space-robot-true")
    fg_calib.write_robot(folder / "robot_true.yaml", true, units=fg_calib.Units(angle="deg"))

    top = BOARD + np.array([0.0, 0.0, RADIUS])
    points = [top]
    for n in (51, 20):  # a golden spiral over the hemisphere, down to nearly its rim
        k = np.arange(n) + 0.5
        height, azimuth = 1.0 - 0.95 * k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
        ring = np.sqrt(1.0 - height**2)
        points += list(top + RADIUS * np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=1))
    q = np.array([solve_inverse(robot, *looking_at_board(point, rng), rng) for point in points])
    at = fg_calib.pose(true, q + rng.normal(scale=SIGMA_JOINT, size=q.shape))
    board_R_base = Rotation.from_euler("z", 30, degrees=True)
    position = board_R_base.apply(at.position - BOARD) + rng.normal(scale=SIGMA_POSITION, size=(len(q), 3))
    turned = Rotation.from_rotvec(rng.normal(scale=SIGMA_ORIENTATION, size=(len(q), 3)))
    quaternion = (board_R_base * Rotation.from_matrix(at.rotation) * turned).as_quat(canonical=True)
    write_csv(
        folder / "poses.csv",
        {
            "id": [f"p{i}" for i in range(len(q))],
            **{f"q{j + 1}": np.round(np.rad2deg(q[:, j]), 6) for j in range(7)},
            **{axis: np.round(position[:, k], 6) for k, axis in enumerate("xyz")},
            **{f"q{axis}": np.round(quaternion[:, k], 9) for k, axis in enumerate("xyzw")},
            "split": ["train"] * 52 + ["test"] * 20,
        },
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=FOLDER)
    arguments = parser.parse_args()
    simulate(arguments.seed, arguments.out)
