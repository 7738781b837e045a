"""Arms of four structures, and poses of them with systematic effects that the model lacks."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from simulated import measure, specified, true_robot

from fg_calib import Pairing, Robot, build_problem

QUARTER = np.pi / 2
PLACED = (Rotation.from_rotvec([0.3, 0.2, -0.5]), np.array([1.0, 2.0, 3.0]))
SIGMA, SIGMA_JOINT = (5e-5, 2e-4), 2e-5
TOLERANCE = {"a": 5e-4, "d": 5e-4, "alpha": 1e-3, "theta": 1e-3, "tool": 2e-3}

ARMS = {
    "6R": ("dh-hayati", "rrrrrr", [(0, QUARTER, 0.16, 0), (-0.43, 0, 0, 0), (-0.39, 0, 0, 0), (0, QUARTER, 0.13, 0),
                                   (0, -QUARTER, 0.1, 0), (0, 0, 0.1, 0)]),
    "scara": ("dh-hayati", "rrpr", [(0.35, 0, 0.3, 0), (0.3, np.pi, 0, 0), (0, 0, 0.1, 0), (0, 0, 0.05, 0)]),
    "gantry": ("dh-hayati", "ppprr", [(0, QUARTER, 0.5, 0), (0, QUARTER, 0.4, QUARTER), (0, 0, 0.3, 0),
                                      (0, QUARTER, 0.1, 0), (0, 0, 0.1, 0)]),
    "7R": ("dh", "rrrrrrr", [(0, -QUARTER, 0.34, 0), (0, QUARTER, 0, 0), (0, QUARTER, 0.4, 0), (0, -QUARTER, 0, 0),
                             (0, -QUARTER, 0.4, 0), (0, QUARTER, 0, 0), (0, 0, 0.13, 0)]),
}  # fmt: skip
"""Convention, turning or prismatic joints, and a, alpha, d, theta of each."""


def arm(name):
    convention, kinds, rows = ARMS[name]
    hayati = convention.endswith("hayati")
    types = ["revolute" if kind == "r" else "prismatic" for kind in kinds]
    tool = {"tool": [0.05, -0.03, 0.12], "estimate": ["tool.x", "tool.y", "tool.z"]}
    tolerance = TOLERANCE | ({"beta": 1e-3} if hayati else {})
    return Robot.from_dh(rows, convention, types=types, tolerance=tolerance, **tool)


def measured(name, rng, *, n=60, n_test=0, effect=None, unit=1.0):
    """An arm and its poses in a frame of their own, joints off by `effect(true, readings)`; noise times `unit`."""
    robot = arm(name)
    true = true_robot(robot, rng)
    most = np.array([0.5 if joint.prismatic else 2.0 for joint in robot.joints])
    q = rng.uniform(-most, most, (n + n_test, robot.n_joints))
    moved = q + (0.0 if effect is None else effect(true, q))
    m = measure(true, n, rng, sigma=SIGMA, sigma_joint=SIGMA_JOINT, frame=PLACED, n_test=n_test, readings=moved)
    return robot, replace(specified(m, unit, unit), readings=q)


def problem_of(robot, m, model):
    if model == "pairs":
        return build_problem(robot, m, model="distance-rotation", pairing=Pairing("star"))
    return build_problem(robot, m, model=model, frame="unknown")


def of_joint(k, error):
    def effect(true, q):
        return np.where(np.arange(true.n_joints) == k, error(true, q), 0.0)

    return effect
