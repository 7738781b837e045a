"""Robots and simulated measurements that several test files use."""

import numpy as np
import yaml
from oracle import random_robot
from scipy.spatial.transform import Rotation

from fg_calib.io.robot_file import write_robot
from fg_calib.io.tables import write_csv
from fg_calib.measurements.dataset import Measurements
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Joint, Robot, RobotBuilder

PAPER_A = [0, 0, 0, 5, 5, 0, 0]
PAPER_ALPHA = [0, -90, -90, 0, 0, 90, 90]
PAPER_D = [2.3, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]
TOOL = [f"tool.{k}" for k in ("x", "y", "z", "roll", "pitch", "yaw")]


def paper_robot(tolerance=None, fixed=(), estimate=()) -> Robot:
    """Table 2 of Jia et al. (2019)."""
    builder = RobotBuilder("space-robot", "mdh-hayati")
    builder.add_frame("base", {}, 0, False)
    for i in range(7):
        values = {"a": PAPER_A[i], "alpha": np.deg2rad(PAPER_ALPHA[i]), "d": PAPER_D[i], "theta": 0.0, "beta": 0.0}
        builder.add_convention_joint(Joint(f"q{i + 1}"), values)
    builder.add_frame("tool", {}, 8, False)
    return builder.build(tolerance=tolerance, fixed=fixed, estimate=estimate)


def planar_robot(tolerance=None) -> Robot:
    """Two links of 2 m and 1 m in the plane; only the lengths and the second offset are unknown."""
    builder = RobotBuilder("planar", "dh")
    builder.add_frame("base", {}, 0, False)
    for i, length in enumerate((2.0, 1.0)):
        builder.add_convention_joint(Joint(f"q{i + 1}"), {"theta": 0.0, "d": 0.0, "a": length, "alpha": 0.0})
    builder.add_frame("tool", {}, 3, False)
    return builder.build(fixed=["theta1", "d1", "alpha1", "d2", "alpha2"], tolerance=tolerance)


def small_arm(tolerance=None, estimate=()) -> Robot:
    """A generic 4-joint arm without special geometry, one joint prismatic: 4 DH parameters a joint."""
    base = random_robot("mdh", 4, np.random.default_rng(2))
    builder = RobotBuilder("small-arm", "mdh")
    builder.add_frame("base", {}, 0, False)
    for i, joint in enumerate(base.joints):
        values = {p.kind: p.nominal for p in base.parameters if p.owner == i + 1}
        builder.add_convention_joint(Joint(joint.name, prismatic=i == 2), values)
    builder.add_frame("tool", {"x": 0.1, "y": -0.05, "z": 0.2, "roll": 0.3, "pitch": 0.4, "yaw": -0.5}, 5, False)
    return builder.build(tolerance=tolerance, estimate=estimate)


def true_robot(robot: Robot, rng: np.random.Generator) -> Robot:
    """The robot with errors of one ordinary size (tolerance, else 1 mm or 1 mrad) in what is estimated."""
    error = [p.scale * rng.normal() if p.estimated else 0.0 for p in robot.parameters]
    return robot.with_values(robot.nominal + error)


def plus(array, rows, amount):
    """A copy of an array with something added at some rows."""
    changed = array.copy()
    changed[rows] += amount
    return changed


def measure(
    true: Robot,
    n: int,
    rng: np.random.Generator,
    *,
    sigma=(1e-3, 2e-4),
    sigma_joint=0.0,
    frame=None,
    n_test=0,
    readings=None,
) -> Measurements:
    """Poses of the true robot at random configurations, with noise; `frame` is (Rotation, translation) world_T_base."""
    total = n + n_test
    q = rng.uniform(-np.pi, np.pi, (total, true.n_joints)) if readings is None else readings
    at = pose(true, q + sigma_joint * rng.normal(size=q.shape))
    turn, shift = frame or (Rotation.identity(), np.zeros(3))
    position = turn.apply(at.position) + shift + sigma[0] * rng.normal(size=(total, 3))
    noise = Rotation.from_rotvec(sigma[1] * rng.normal(size=(total, 3)))
    rotation = (turn * Rotation.from_matrix(at.rotation) * noise).as_matrix()
    return Measurements(
        readings=q,
        ids=np.arange(total).astype(str),
        test=np.arange(total) >= n,
        position=position,
        rotation=rotation,
        sigma_position=np.full((total, 3), sigma[0]),
        sigma_orientation=np.full((total, 3), sigma[1]),
        sigma_joint=np.full(true.n_joints, sigma_joint),
    )


def write_job(folder, robot: Robot, m: Measurements, /, **job):
    """Robot, poses, pairs between groups and a job in SI as files; the path of the job."""
    columns = {"id": m.ids} | {f"q{i + 1}": q for i, q in enumerate(m.readings.T)}
    if m.position is not None:
        columns |= dict(zip("xyz", m.position.T, strict=True))
    if m.rotation is not None:
        quaternion = Rotation.from_matrix(m.rotation.copy()).as_quat()
        columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True))
    if m.groups is not None:
        columns["group"] = np.array(["", *m.groups.names])[m.groups.index + 1]
        pairs = m.groups.pairs
        ends = {end: np.array(m.groups.names)[getattr(pairs, end)] for end in "ab"}
        write_csv(folder / "pairs.csv", ends | {"distance": pairs.distance, "sigma_distance": pairs.sigma_distance})
        job |= {"pairs": "pairs.csv"}
    write_csv(folder / "poses.csv", columns | {"split": np.where(m.test, "test", "train")})
    if robot.urdf is None:
        write_robot(folder / "robot.yaml", robot)
    stated = {"position": m.sigma_position, "orientation": m.sigma_orientation, "point": m.sigma("point")}
    noise = {kind: float(np.max(sigma)) for kind, sigma in stated.items() if sigma is not None}
    noise |= {"joint": float(m.sigma_joint[0])} if m.sigma_joint[0] else {}
    given = {"robot": "robot.yaml", "measurements": "poses.csv", "noise": noise} | job
    (folder / "calibration.yaml").write_text(yaml.safe_dump(given))
    return folder / "calibration.yaml"
