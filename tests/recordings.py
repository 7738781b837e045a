"""Recordings of an arm that moves from stop to stop, as streams in memory and as ROS bags."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from fg_calib import Robot
from fg_calib.importers.bag import JointStream, PoseStream, Source
from fg_calib.robot.kinematics import pose

NAMES = ["pan", "lift", "elbow", "wrist1", "wrist2", "wrist3"]
UR_LIKE = [[0, np.pi / 2, 0.09, 0], [-0.42, 0, 0, 0], [-0.39, 0, 0, 0],
           [0, np.pi / 2, 0.11, 0], [0, -np.pi / 2, 0.095, 0], [0, 0, 0.08, 0]]  # fmt: skip
FRAME = Rotation.from_euler("xyz", [0.3, -0.2, 1.1])
ORIGIN = np.array([1.0, -2.0, 0.5])
"""world_T_base."""


def arm(errors=0.0, **more):
    """A 6R arm; its lengths and angles off by so much, [m] and [rad]."""
    rows = np.array(UR_LIKE)
    rows = rows + errors * np.random.default_rng(99).standard_normal(rows.shape) * (rows != 0.0)
    return Robot.from_dh(rows, convention="dh", names=NAMES, tool=[0.02, 0.01, 0.1], **more)


@dataclass
class Motion:
    """What was recorded, and the truth: joint values and world_T_tool of the stops."""

    joint_time: np.ndarray
    readings: np.ndarray
    pose_time: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    true_readings: np.ndarray
    true_position: np.ndarray
    true_rotation: np.ndarray
    offset: float

    def streams(self):
        source = Source("/joints", "sensor_msgs/msg/JointState")
        lag = Source("/pose", "geometry_msgs/msg/PoseStamped", lag=-self.offset)
        poses = PoseStream(self.pose_time, self.position, self.rotation, lag)
        return JointStream(self.joint_time, self.readings, source), poses


def correlated(generator, shape, phi):
    """Noise of variance 1, AR(1) along the first axis."""
    white = generator.standard_normal(shape)
    white[0] /= np.sqrt(1.0 - phi**2)
    return np.sqrt(1.0 - phi**2) * lfilter([1.0], [1.0, -phi], white, axis=0)


def record(seed=0, *, robot=None, n_stops=12, rest=1.5, move=1.2, offset=0.137, joint_rate=100.0, pose_rate=60.0,
           sigma_position=1e-4, sigma_orientation=2e-4, sigma_joint=2e-5, phi=0.0, tool=(0.0, 0.0, 0.0)):  # fmt: skip
    """An arm that rests `n_stops` times between moves of minimum jerk; poses are stamped `offset` later."""
    generator = np.random.default_rng(seed)
    robot = robot or arm()
    targets = generator.uniform(-1.2, 1.2, (n_stops, robot.n_joints))
    moves = move * generator.uniform(0.7, 1.3, n_stops - 1)
    rests = np.broadcast_to(np.asarray(rest, dtype=float), n_stops)
    begin = np.concatenate([[0.0], np.cumsum(rests[:-1] + moves)])
    duration = begin[-1] + rests[-1]

    def joints_at(time):
        k = np.clip(np.searchsorted(begin, time, side="right") - 1, 0, n_stops - 1)
        ahead = np.minimum(k + 1, n_stops - 1)
        u = np.clip((time - begin[k] - rests[k]) / np.append(moves, 1.0)[k], 0.0, 1.0)[:, None]
        return targets[k] + (targets[ahead] - targets[k]) * (10 * u**3 - 15 * u**4 + 6 * u**5)

    def world(q):
        poses = pose(robot, q)
        rotation = FRAME * Rotation.from_matrix(poses.rotation)
        return FRAME.apply(poses.position) + ORIGIN + rotation.apply(tool), rotation

    joint_time = np.arange(0.0, duration, 1.0 / joint_rate)
    pose_time = np.arange(0.003, duration, 1.0 / pose_rate)
    position, rotation = world(joints_at(pose_time))
    turned = Rotation.from_rotvec(sigma_orientation * correlated(generator, position.shape, phi))
    position = position + sigma_position * correlated(generator, position.shape, phi)
    readings = joints_at(joint_time)
    true_position, true_rotation = world(targets)
    return Motion(
        joint_time, readings + sigma_joint * generator.standard_normal(readings.shape), pose_time + offset,
        position, (rotation * turned).as_matrix(), targets, true_position, true_rotation.as_matrix(), offset,
    )  # fmt: skip


FORMATS = ("ros1", "sqlite3", "mcap")
POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry", "TFMessage")
START = 1_700_000_000_000_000_000
"""Of all recordings, [ns]."""


class BagWriter:
    """Writes messages of the standard types to a bag of one format, in the order in which they are given."""

    def __init__(self, folder, form):
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros1 = form == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
            self.path = folder / "run.bag"
            self.writer = rosbag1.Writer(self.path)
        else:
            self.path = folder / f"run_{form}"
            plugin = rosbag2.StoragePlugin.MCAP if form == "mcap" else rosbag2.StoragePlugin.SQLITE3
            self.writer = rosbag2.Writer(self.path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.connections = {}

    def make(self, kind, **values):
        return self.store.types[kind](**values)

    def header(self, stamp, frame=""):
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def write(self, topic, kind, message, received):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], received, serialize(message, kind))

    def joints(self, stamp, names, positions, topic="/joint_states", received=None):
        kind, empty = "sensor_msgs/msg/JointState", np.zeros(0)
        message = self.make(kind, header=self.header(stamp), name=list(names), position=np.asarray(positions, float),
                            velocity=empty, effort=empty)  # fmt: skip
        self.write(topic, kind, message, stamp if received is None else received)

    def pose(self, stamp, position, quaternion, form="PoseStamped", topic="/pose", received=None, frames=("w", "t")):
        package = {"Odometry": "nav_msgs", "TFMessage": "tf2_msgs"}.get(form, "geometry_msgs")
        kind, (parent, child), g = f"{package}/msg/{form}", frames, "geometry_msgs/msg"
        x = dict(zip("xyz", map(float, position), strict=True))
        given = {
            "header": self.header(stamp, parent),
            "position": self.make(f"{g}/Point", **x),
            "translation": self.make(f"{g}/Vector3", **x),
            "orientation": self.make(f"{g}/Quaternion", **dict(zip("xyzw", map(float, quaternion), strict=True))),
            "covariance": np.zeros(36),
            "child_frame_id": child,
            "linear": self.make(f"{g}/Vector3", x=0.0, y=0.0, z=0.0),
        }
        given |= {"rotation": given["orientation"], "angular": given["linear"]}

        def build(name, *fields):
            """A message of these fields, which are given or were built before."""
            return self.make(name, **{field: given[field] for field in fields})

        given["transform"] = build(f"{g}/Transform", "translation", "rotation")
        given["transforms"] = [build(f"{g}/TransformStamped", "header", "child_frame_id", "transform")]
        given["pose"] = build(f"{g}/Pose", "position", "orientation")
        if form in ("PoseWithCovarianceStamped", "Odometry"):
            given["pose"] = build(f"{g}/PoseWithCovariance", "pose", "covariance")
            given["twist"] = build(f"{g}/Twist", "linear", "angular")
            given["twist"] = build(f"{g}/TwistWithCovariance", "twist", "covariance")
        fields = {
            "TransformStamped": ("header", "child_frame_id", "transform"),
            "TFMessage": ("transforms",),
            "Odometry": ("header", "child_frame_id", "pose", "twist"),
        }.get(form, ("header", "pose"))
        self.write(topic, kind, build(kind, *fields), stamp if received is None else received)

    def close(self):
        self.writer.close()
        return self.path


def write_bag(folder, motion, form="ros1", pose_type="PoseStamped", *, names=None, seed=0):
    """A bag of a motion: joints in another order, one more among them, quaternions of any sign."""
    generator = np.random.default_rng(seed)
    bag = BagWriter(folder, form)
    names = names or ["gripper", *reversed(NAMES)]
    quaternions = Rotation.from_matrix(motion.rotation).as_quat()
    quaternions *= generator.choice([-1.0, 1.0], (len(quaternions), 1))
    events = [(t, "joints", k) for k, t in enumerate(motion.joint_time)]
    events += [(t - motion.offset, "pose", k) for k, t in enumerate(motion.pose_time)]
    for time, what, k in sorted(events):
        received = START + round(1e9 * (time + 0.004))
        if what == "joints":
            values = dict(zip(NAMES, motion.readings[k], strict=True))
            bag.joints(START + round(1e9 * time), names, [values.get(name, 0.04) for name in names], received=received)
        else:
            stamp = START + round(1e9 * (time + motion.offset))
            bag.pose(stamp, motion.position[k], quaternions[k], pose_type, received=received)
    return bag.close()
