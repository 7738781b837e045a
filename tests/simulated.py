"""Robots and simulated measurements that several test files use."""

from dataclasses import replace

import numpy as np
import yaml
from oracle import random_robot
from scipy.spatial.transform import Rotation

from fg_calib import Measurements, Robot, Table
from fg_calib.io import Units, write_csv, write_robot
from fg_calib.measurements import Pairs
from fg_calib.robot import build_chain, forward, pose, rotation_angle
from fg_calib.simulation import table_columns

PAPER_A = [0, 0, 0, 5, 5, 0, 0]
PAPER_ALPHA = [0, -90, -90, 0, 0, 90, 90]
PAPER_D = [2.3, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]
ROWS = [(0.1, 1.4, 0.3, 0.2), (0.5, 0.2, 0.1, -0.3), (0.3, -1.2, 0.2, 0.1), (0.05, 0.7, 0.1, 0.4)]  # a, alpha, d, theta
TOLERANCE = {"a": 1e-3, "d": 1e-3, "alpha": 2e-3, "theta": 2e-3}
LARGE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}
TOOL = [f"tool.{k}" for k in ("x", "y", "z", "roll", "pitch", "yaw")]


def paper_robot(tolerance=None, fixed=(), estimate=()) -> Robot:
    """Table 2 of Jia et al. (2019)."""
    rows, more = np.column_stack([PAPER_A, np.deg2rad(PAPER_ALPHA), PAPER_D, np.zeros((7, 2))]), {"estimate": estimate}
    return Robot.from_dh(rows, "mdh-hayati", name="space-robot", tolerance=tolerance, fixed=fixed, **more)


KNOWN = ("theta1", "d1", "alpha1", "d2", "alpha2")


def planar_robot(tolerance=None, *, name="planar", fixed=KNOWN, **more) -> Robot:
    """Two links of 2 m and 1 m in the plane; by default only the lengths and the second offset are unknown."""
    return Robot.from_dh([[2, 0, 0, 0], [1, 0, 0, 0]], "dh", name=name, fixed=fixed, tolerance=tolerance, **more)


def small_arm(tolerance=None, estimate=()) -> Robot:
    """A generic 4-joint arm without special geometry, one joint prismatic: 4 DH parameters a joint."""
    values = {p.name: p.nominal for p in random_robot("mdh", 4, np.random.default_rng(2)).parameters}
    rows = [[values[f"{kind}{i + 1}"] for kind in ("a", "alpha", "d", "theta")] for i in range(4)]
    more = {"names": ["j1", "j2", "j3", "j4"], "types": ["revolute", "revolute", "prismatic", "revolute"]}
    tool = [0.1, -0.05, 0.2, 0.3, 0.4, -0.5]
    return Robot.from_dh(rows, "mdh", name="small-arm", tool=tool, tolerance=tolerance, estimate=estimate, **more)


def true_robot(robot: Robot, rng: np.random.Generator) -> Robot:
    """The robot with errors of one ordinary size (tolerance, else 1 mm or 1 mrad) in what is estimated."""
    error = [p.scale * rng.normal() if p.estimated else 0.0 for p in robot.parameters]
    return robot.with_values(robot.nominal + error)


def arm_with(*effects, tolerance=TOLERANCE) -> Robot:
    """A 4-joint arm with effects beyond its geometry."""
    return Robot.from_dh(ROWS, "dh", tool=[0.1, 0, 0.2], tolerance=tolerance).with_effects(*effects)


def within_tolerance(robot: Robot, rng: np.random.Generator) -> Robot:
    """The robot with errors of its tolerances, coefficients of effects among them."""
    tolerance = np.array([p.tolerance or 0.0 for p in robot.parameters])
    return robot.with_values(robot.nominal + tolerance * rng.normal(size=len(tolerance)))


def tool_points(robot, q, context=None):
    """Tool points of a robot with its effects, shape (n, 3)."""
    return forward(build_chain(robot), robot.trig(q, context)).position


def measure_points(true, q, rng, sigma=1e-4) -> Measurements:
    """Tool points of the true robot at readings q, with noise."""
    points = tool_points(true, q) + sigma * rng.normal(size=(len(q), 3))
    return Measurements.from_arrays(q, position=points, sigma_position=sigma)


def nees(found, true: Robot) -> tuple[float, int]:
    """Squared error of an assessed arm over its covariance, and the number of its estimated parameters."""
    error = (found.robot.nominal - true.nominal)[[found.robot.index(name) for name in found.names]]
    return error @ np.linalg.solve(found.covariance, error), len(error)


def errors_of_all(solution, true: Robot):
    """Errors of a solution's robot in all columns, of curves too, and the root of their covariance."""
    v = solution.problem.variables
    columns = np.concatenate([np.r_[one.columns] for one in (*v.items, *v.nuisance)])
    places = np.concatenate([one.places for one in (*v.items, *v.nuisance)])
    return solution.parameters[places] - true.nominal[places], solution.system.full_root[columns]


def with_changes(robot: Robot, /, **changes) -> Robot:
    """The robot with some parameters changed."""
    values = robot.nominal
    for name, change in changes.items():
        values[robot.index(name)] += change
    return robot.with_values(values)


def plus(array, rows, amount):
    """A copy of an array with something added at some rows."""
    changed = array.copy()
    changed[rows] += amount
    return changed


def pairs_between(true, q, ends, rng, *, sigma=(1e-3, 5e-4), source="measurements") -> Pairs:
    """Distances, and angles if they have a sigma, of the true arm between joint values q measured directly."""
    (a, b), at, n = ends, pose(true, q), len(ends[0])
    distance = np.abs(np.linalg.norm(at.position[b] - at.position[a], axis=1) + sigma[0] * rng.normal(size=n))
    angle = of_angle = np.full(n, np.nan)
    if sigma[1]:
        angle = rotation_angle(np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b])[0] + sigma[1] * rng.normal(size=n)
        angle, of_angle = np.pi - np.abs(np.pi - np.abs(angle)), np.full(n, sigma[1])
    return Pairs(a, b, distance, angle, np.full(n, sigma[0]), of_angle, np.zeros(n, dtype=bool), source)


def measure(true, n, rng, *, sigma=(1e-3, 2e-4), sigma_joint=0.0, frame=None, n_test=0, readings=None) -> Measurements:
    """Poses of the true robot at random configurations, with noise; `frame` is (Rotation, translation) world_T_base."""
    total = n + n_test
    q = rng.uniform(-np.pi, np.pi, (total, true.n_joints)) if readings is None else readings
    at = pose(true, q + sigma_joint * rng.normal(size=q.shape))
    turn, shift = frame or (Rotation.identity(), np.zeros(3))
    position = turn.apply(at.position) + shift + sigma[0] * rng.normal(size=(total, 3))
    noise = Rotation.from_rotvec(sigma[1] * rng.normal(size=(total, 3)))
    rotation = (turn * Rotation.from_matrix(at.rotation) * noise).as_matrix()
    sigmas = (*(np.full((total, 3), one) for one in sigma), np.full(true.n_joints, sigma_joint))
    return Measurements(q, np.arange(total).astype(str), np.arange(total) >= n, position, rotation, *sigmas)


def specified(m: Measurements, own, joint=1.0) -> Measurements:
    """Measurements whose noise is specified so many times as large."""
    changes = {name: getattr(m, name) for name in ("sigma_position", "sigma_orientation")}
    changes = {name: own * sigma for name, sigma in changes.items() if sigma is not None}
    changes["sigmas"] = {name: own * sigma for name, sigma in m.sigmas.items()}
    if m.pairs is not None:
        changes["pairs"] = replace(m.pairs, sigma_distance=own * m.pairs.sigma_distance)
    if m.groups is not None:
        pairs = m.groups.pairs
        changes["groups"] = replace(m.groups, pairs=replace(pairs, sigma_distance=own * pairs.sigma_distance))
    return replace(m, sigma_joint=joint * m.sigma_joint, **changes)


def measure_drawn(robot: Robot, n, seed, **how) -> Measurements:
    """Poses of a true robot that is drawn first."""
    rng = np.random.default_rng(seed)
    return measure(true_robot(robot, rng), n, rng, **how)


def write_job(folder, robot: Robot, m: Measurements, /, **job):
    """Robot, poses, pairs between groups and a job in SI as files; the path of the job."""
    tables = table_columns(Table(replace(m, source="poses.csv"), None), robot, Units())
    if m.groups is not None:
        tables["pairs.csv"]["sigma_distance"] = m.groups.pairs.sigma_distance
        job |= {"pairs": "pairs.csv"}
    for name, columns in tables.items():
        write_csv(folder / name, columns)
    if robot.urdf is None:
        write_robot(folder / "robot.yaml", robot)
    stated = {"position": m.sigma_position, "orientation": m.sigma_orientation, "point": m.sigma("point")}
    noise = {kind: float(np.max(sigma)) for kind, sigma in stated.items() if sigma is not None}
    noise |= {"joint": float(m.sigma_joint[0])} if m.sigma_joint[0] else {}
    given = {"robot": "robot.yaml", "measurements": "poses.csv", "noise": noise} | job
    (folder / "calibration.yaml").write_text(yaml.safe_dump(given))
    return folder / "calibration.yaml"
