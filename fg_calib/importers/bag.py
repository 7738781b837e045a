"""ROS bags: joint readings and poses over time.

| bag | is |
|---|---|
| ROS 1 | a file `.bag` |
| ROS 2 | a folder with `metadata.yaml`, or one file `.db3` (SQLite) or `.mcap` |

Messages are read by the definitions of their types in the bag, or by the standard ones. Needs the extra `ros`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.importers.recording import JointStream, PoseStream, Source
from fg_calib.inputs import NORM_TOLERANCE, CalibrationError, Floats, InputError, checked
from fg_calib.robot import Robot

JOINT_TYPE = "sensor_msgs/msg/JointState"

_Pose = tuple[Any, str, Any, Any]
"""Header, child frame, position and quaternion of one pose in a message."""

POSE_TYPES: dict[str, Callable[[Any], list[_Pose]]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: [(m.header, "", m.pose.position, m.pose.orientation)],
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: [
        (m.header, "", m.pose.pose.position, m.pose.pose.orientation)
    ],
    "geometry_msgs/msg/TransformStamped": lambda m: [_transform(m)],
    "nav_msgs/msg/Odometry": lambda m: [(m.header, m.child_frame_id, m.pose.pose.position, m.pose.pose.orientation)],
    "tf2_msgs/msg/TFMessage": lambda m: [_transform(one) for one in m.transforms],
}
"""Types of messages with poses, and how these are taken out of one."""

MAX_BACK_S = 1.0
"""Stamps that go back by less, [s], are put in order."""


def _transform(m: Any) -> _Pose:
    return m.header, m.child_frame_id, m.transform.translation, m.transform.rotation


Sample = tuple[int, int, Sequence[float]]
"""Stamp and time of receipt of a message, [ns], and its values."""


@checked
def read_bag(
    path: Path | str,
    robot: Robot,
    *,
    joints: str | None = None,
    pose: str | None = None,
    parent: str | None = None,
    child: str | None = None,
    names: Sequence[str] = (),
) -> tuple[JointStream, PoseStream]:
    """Joint readings and poses in a ROS bag, by the stamps in their headers; times of receipt where these are 0.

    Both times count from the first joint reading's stamp.

    Args:
        path: The bag.
        robot: Whose joints are read.
        joints: Topic of joint states; the only one if None.
        pose: Topic of poses; the only one if None, and of `/tf` only where there is no other.
        parent: Frame that the poses are in, where a topic has several.
        child: Frame whose poses they are, likewise.
        names: The joints' names in the bag, in chain order, where the robot calls them otherwise.

    Raises:
        InputError: The extra `ros` is not installed; there is no such bag, topic, frame or joint; the bag is damaged;
            its stamps go back.
    """
    path = Path(path)
    wanted = tuple(names) or tuple(joint.name for joint in robot.joints)
    if len(wanted) != robot.n_joints or len(set(wanted)) != len(wanted):
        raise InputError("joint names", f"found {', '.join(wanted)}", f"{robot.n_joints} different ones")
    try:
        from rosbags import highlevel, typesys
    except ImportError:
        raise CalibrationError("fg-calib bag needs rosbags: pip install 'fg_calib[ros]'") from None
    if not path.exists():
        raise InputError(str(path), "no such bag")
    try:
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            of_joints = _choose_topic(reader, path.name, joints, (JOINT_TYPE,), "joints")
            of_pose = _choose_topic(reader, path.name, pose, tuple(POSE_TYPES), "pose")
            stamps, readings, source = _read_joints(reader, of_joints, wanted, path.name)
            poses = _read_poses(reader, of_pose, (parent, child), int(stamps[0]), path.name)
    except (CalibrationError, MemoryError):
        raise
    except Exception as error:  # readers of damaged files raise whatever their libraries do
        hint = "was the recording cut off? `rosbag reindex` repairs a .bag" if path.suffix == ".bag" else ""
        raise InputError(path.name, f"a bag that cannot be read: {error or type(error).__name__}", hint=hint) from error
    return JointStream((stamps - stamps[0]) * 1e-9, readings, source), poses


def _choose_topic(reader: Any, bag: str, name: str | None, kinds: tuple[str, ...], what: str) -> tuple[str, str]:
    """The topic of a name, or the only one with messages of these types; and its type.

    Raises:
        InputError: There is none, or there are several.
    """
    every = sorted({(c.topic, c.msgtype) for c in reader.connections})
    fitting = [one for one in every if one[1] in kinds and name in (None, one[0])]
    if name is None:
        fitting = [one for one in fitting if one[0].rpartition("/")[2] != "tf_static"]
        fitting = [one for one in fitting if one[1] != "tf2_msgs/msg/TFMessage"] or fitting
    if len(fitting) == 1:
        return fitting[0]
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in fitting or every)
    if fitting:
        raise InputError(bag, f"{len(fitting)} topics fit: {listed}", f"one of them: --{what} TOPIC")
    raise InputError(bag, f"no topic {name or ''} for --{what}", hint=f"the bag has {listed or 'nothing'}")


def _messages(reader: Any, topic: tuple[str, str]) -> Iterator[tuple[int, Any]]:
    """Times of receipt, [ns], and messages of a topic, in the order in which they were received."""
    connections = [c for c in reader.connections if (c.topic, c.msgtype) == topic]
    for connection, received, raw in reader.messages(connections):
        yield received, reader.deserialize(raw, connection.msgtype)


def _stamp(header: Any) -> int:
    """Of a message's header, [ns]."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _read_joints(reader: Any, topic: tuple[str, str], wanted: tuple[str, ...], bag: str) -> tuple[Any, Floats, Source]:
    """Stamps, [ns], and readings of the joints wanted, shape (n, n_joints), in order of time."""
    samples, present, n = list[Sample](), dict[str, None](), 0
    for received, m in _messages(reader, topic):
        values = dict(zip(m.name, m.position, strict=False))
        present.update(dict.fromkeys(m.name))
        n += 1
        if set(wanted) <= values.keys():
            samples.append((_stamp(m.header), received, [values[name] for name in wanted]))
    if not samples:
        missing = next((f"joint {name}" for name in wanted if name not in present), "message with all joints")
        hint = "name the bag's joints in chain order: --names, or `name` in the robot file"
        expected = f"the robot's joints among {', '.join(present)}"
        raise InputError(f"{bag}: topic {topic[0]}", f"no {missing}", expected, hint)
    return _sort(samples, topic, {"without the robot's joints left out": n - len(samples)}, bag)


def _read_poses(
    reader: Any, topic: tuple[str, str], frames: tuple[str | None, str | None], origin: int, bag: str
) -> PoseStream:
    """The poses of one frame in another; without rotations where all are the same."""
    place, samples = f"{bag}: topic {topic[0]}", dict[tuple[str, str], list[Sample]]()
    for received, message in _messages(reader, topic):
        for header, child, p, q in POSE_TYPES[topic[1]](message):
            pair = header.frame_id.removeprefix("/"), child.removeprefix("/")  # ROS 1 had a slash before names
            sample = (_stamp(header), received, (p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            samples.setdefault(pair, []).append(sample)
    wanted = [None if frame is None else frame.removeprefix("/") for frame in frames]
    fitting = [pair for pair in samples if all(f in (None, g) for f, g in zip(wanted, pair, strict=True))]
    if len(fitting) != 1:
        listed = ", ".join(f"{a or '(no name)'} -> {b}" if b else a or "(no name)" for a, b in samples)
        what = f"poses of {len(fitting)} frames" if fitting else "no poses of these frames"
        raise InputError(place, what, "one: --parent FRAME --child FRAME", f"it has {listed}")
    stamps, values, source = _sort(samples[fitting[0]], topic, {}, bag)
    quaternions, rotation = values[:, 3:], None
    norm = np.linalg.norm(quaternions, axis=1)
    wrong = np.abs(norm - 1.0) > NORM_TOLERANCE
    if not np.any(quaternions - quaternions[0]):
        source = replace(source, notes=(*source.notes, "all orientations are the same: taken as not measured"))
    elif wrong.any():
        found = f"quaternion of norm {norm[np.argmax(wrong)]:.6g}"
        raise InputError(place, found, f"1 within {NORM_TOLERANCE:g}", f"{wrong.sum()} of {len(norm)} poses")
    else:
        rotation = np.asarray(Rotation.from_quat(quaternions).as_matrix(), dtype=np.float64)
    return PoseStream((stamps - origin) * 1e-9, values[:, :3], rotation, source)


def _sort(
    samples: Sequence[Sample], topic: tuple[str, str], counts: Mapping[str, int], bag: str
) -> tuple[Any, Floats, Source]:
    """Stamps, ascending, [ns], with what belongs to them, shape (n, k), and where they are from.

    Raises:
        InputError: Stamps go back, or there are not two.
    """
    place, notes = f"{bag}: topic {topic[0]}", list[str]()
    stamps, received = np.array([sample[:2] for sample in samples], dtype=np.int64).T
    values = np.array([sample[2] for sample in samples], dtype=np.float64)
    if not stamps.all():
        notes, stamps = ["no stamps in the headers: times of receipt are used"], received
    lag = float(np.median((received - stamps) * 1e-9))
    finite = np.isfinite(values).all(axis=1)
    stamps, values = stamps[finite], values[finite]
    back = (np.maximum.accumulate(stamps) - stamps) * 1e-9
    if back.max(initial=0.0) > MAX_BACK_S:
        what = f"stamps go back by {back.max():.3g} s at message {int(np.argmax(back > MAX_BACK_S)) + 1}"
        raise InputError(place, what, "a clock that runs on")
    stamps, first = np.unique(stamps, return_index=True)
    if len(stamps) < 2:
        raise InputError(place, f"{len(stamps)} different stamps with finite values", "a recording")
    found = {
        **counts,
        "with nan left out": np.sum(~finite),
        "out of order put in order": np.sum(back > 0.0),
        "with the stamp of another left out": len(values) - len(first),
    }
    notes += [f"{n} message{'s' * int(n != 1)} {what}" for what, n in found.items() if n]
    return stamps, values[first], Source(*topic, lag, tuple(notes))
