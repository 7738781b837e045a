"""ROS bags: joint readings and poses over time.

| bag | is |
|---|---|
| ROS 1 | a file `.bag` |
| ROS 2 | a folder with `metadata.yaml`, or one file `.db3` (SQLite) or `.mcap` |

Messages are read by the definitions of their types in the bag, or by the standard ones. Needs the extra `ros`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.arguments import checked
from fg_calib.arrays import NORM_TOLERANCE, Floats
from fg_calib.errors import CalibrationError, InputError
from fg_calib.importers.recording import JointStream, PoseStream, Source
from fg_calib.robot.model import Robot

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

_MOST_BACK = 1.0
"""Stamps that go back by less, [s], are put in order."""


def _transform(m: Any) -> _Pose:
    return m.header, m.child_frame_id, m.transform.translation, m.transform.rotation


@dataclass(frozen=True)
class _Message:
    """A message with the time of its receipt, [ns]."""

    received: int
    content: Any


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
    with _opened(path) as bag:
        of_joints = bag.topic(joints, (JOINT_TYPE,), "--joints")
        of_pose = bag.topic(pose, tuple(POSE_TYPES), "--pose")
        stamps, readings, source = _readings(bag.messages(of_joints), wanted, of_joints, path.name)
        poses = _poses(bag.messages(of_pose), of_pose, (parent, child), int(stamps[0]), path.name)
    return JointStream((stamps - stamps[0]) * 1e-9, readings, source), poses


class _Bag:
    """An open bag: its topics, and the messages of one."""

    def __init__(self, name: str, reader: Any) -> None:
        self.name, self._reader = name, reader

    def topic(self, name: str | None, kinds: tuple[str, ...], option: str) -> tuple[str, str]:
        """The topic of a name, or the only one with messages of these types; and its type."""
        every = sorted({(c.topic, c.msgtype) for c in self._reader.connections})
        fitting = [one for one in every if one[1] in kinds]
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in every) or "nothing"
        if name is not None:
            found = [one for one in fitting if one[0] == name]
            if not found:
                others = [kind for topic, kind in every if topic == name]
                what = f"topic {name} is of {others[0]}" if others else f"no topic {name}"
                raise InputError(self.name, what, " or ".join(kinds) if others else "", f"the bag has {listed}")
            return found[0]
        fitting = [one for one in fitting if one[0].rpartition("/")[2] != "tf_static"]
        fitting = [one for one in fitting if one[1] != "tf2_msgs/msg/TFMessage"] or fitting
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            fit = ", ".join(f"{topic} ({kind})" for topic, kind in fitting)
            raise InputError(self.name, f"{len(fitting)} topics fit: {fit}", f"one of them: {option} TOPIC")
        raise InputError(self.name, f"no topic of type {' or '.join(kinds)}", hint=f"the bag has {listed}")

    def messages(self, topic: tuple[str, str]) -> Iterator[_Message]:
        """The messages of a topic, in the order in which they were received."""
        connections = [c for c in self._reader.connections if (c.topic, c.msgtype) == topic]
        n = 0
        for connection, received, raw in self._reader.messages(connections):
            yield _Message(received, self._reader.deserialize(raw, connection.msgtype))
            n += 1
        if n < 2:
            raise InputError(f"{self.name}: topic {topic[0]}", _counted(n), "a recording")


@contextmanager
def _opened(path: Path) -> Iterator[_Bag]:
    """A bag while it is read; any failure of the library is one line.

    Raises:
        InputError: There is no such bag, or it is damaged.
    """
    try:
        from rosbags import highlevel, typesys
    except ImportError:
        raise CalibrationError("fg-calib bag needs rosbags: pip install 'fg_calib[ros]'") from None
    _check_ending(path)
    try:
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            yield _Bag(path.name, reader)
    except (CalibrationError, MemoryError):
        raise
    except PermissionError:
        raise InputError(str(path), "may not be read", hint="check the permissions of file and folder") from None
    except Exception as error:  # readers of damaged files raise whatever their libraries do
        hint = "was the recording cut off? `rosbag reindex` repairs a .bag" if path.suffix == ".bag" else ""
        raise InputError(path.name, f"a bag that cannot be read: {error or type(error).__name__}", hint=hint) from error


def _check_ending(path: Path) -> None:
    """Raise where there is nothing, or something else than a bag."""
    if not path.exists():
        raise InputError(str(path), "no such bag")
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise InputError(str(path), "a folder without metadata.yaml", "a ROS 2 bag, or a file in it")
    elif path.suffix not in (".bag", ".db3", ".mcap"):
        raise InputError(path.name, f"ending {path.suffix!r}", "a folder, or one of .bag, .db3, .mcap")
    elif path.stat().st_size == 0:
        raise InputError(path.name, "an empty file", "a bag")


def _counted(n: int) -> str:
    return f"{n} message{'s' * (n != 1)}"


def _stamp(header: Any) -> int:
    """Of a message's header, [ns]."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _readings(
    messages: Iterable[_Message], wanted: tuple[str, ...], topic: tuple[str, str], bag: str
) -> tuple[Any, Floats, Source]:
    """Stamps, [ns], and readings of the joints wanted, shape (n, n_joints), in order of time."""
    place = f"{bag}: topic {topic[0]}"
    columns: dict[tuple[str, ...], list[int] | None] = {}
    stamps, received, rows, left = [], [], [], 0
    for message in messages:
        m = message.content
        there = tuple(m.name)
        if there not in columns:
            columns[there] = [there.index(name) for name in wanted] if set(wanted) <= set(there) else None
        chosen = columns[there]
        if chosen is None or len(m.position) != len(there):
            left += 1
            continue
        stamps.append(_stamp(m.header))
        received.append(message.received)
        rows.append(m.position[chosen])
    if not rows:
        names = dict.fromkeys(name for there in columns for name in there)
        missing = [name for name in wanted if name not in names]
        if not missing:
            found = "no message has positions of all joints"
            raise InputError(place, found, f"one with {', '.join(wanted)}")
        hint = "name the bag's joints in chain order: --names, or `name` in the robot file"
        raise InputError(place, f"no joint {missing[0]}", f"the robot's joints among {', '.join(names)}", hint)
    notes = []
    if left:
        notes.append(f"{_counted(left)} without the robot's joints left out")
    order, values, lag, more = _in_order(stamps, received, np.array(rows, dtype=np.float64), place)
    return order, values, Source(*topic, lag, (*notes, *more))


def _poses(
    messages: Iterable[_Message], topic: tuple[str, str], frames: tuple[str | None, str | None], origin: int, bag: str
) -> PoseStream:
    """The poses of one frame in another."""
    place = f"{bag}: topic {topic[0]}"
    take = POSE_TYPES[topic[1]]
    found = [
        (
            (_bare(header.frame_id), _bare(child)),
            (_stamp(header), message.received),
            (p.x, p.y, p.z, q.x, q.y, q.z, q.w),
        )
        for message in messages
        for header, child, p, q in take(message.content)
    ]
    there = Counter(pair for pair, *_ in found)
    fitting = [pair for pair in there if all(f is None or _bare(f) == g for f, g in zip(frames, pair, strict=True))]
    listed = ", ".join(f"{a or '(no name)'} -> {b}" if b else a or "(no name)" for a, b in there)
    if len(fitting) != 1:
        what = f"poses of {len(fitting)} frames" if fitting else "no poses of these frames"
        raise InputError(place, what, "one: --parent FRAME --child FRAME", f"it has {listed}")
    sent, received = zip(*(both for pair, both, _ in found if pair == fitting[0]), strict=True)
    figures = np.array([row for pair, _, row in found if pair == fitting[0]], dtype=np.float64)
    stamps, figures, lag, notes = _in_order(sent, received, figures, place)
    rotation, more = _rotations(figures[:, 3:], place)
    source = Source(*topic, lag, (*notes, *more))
    return PoseStream((stamps - origin) * 1e-9, figures[:, :3], rotation, source)


def _bare(frame: str) -> str:
    """A frame's name without the slash that ROS 1 had before it."""
    return str(frame).removeprefix("/")


def _rotations(quaternions: Floats, place: str) -> tuple[Floats | None, tuple[str, ...]]:
    """Rotation matrices of quaternions x y z w; None where they are all 0 or all the same."""
    if len(quaternions) > 1 and not np.any(quaternions - quaternions[0]):
        return None, ("all orientations are the same: taken as not measured",)
    norm = np.linalg.norm(quaternions, axis=1)
    wrong = np.abs(norm - 1.0) > NORM_TOLERANCE
    if wrong.any():
        found = f"quaternion of norm {norm[np.argmax(wrong)]:.6g}"
        raise InputError(place, found, f"1 within {NORM_TOLERANCE:g}", f"{wrong.sum()} of {len(norm)} poses")
    return Rotation.from_quat(quaternions).as_matrix(), ()


def _in_order(
    stamps: Sequence[int], received: Sequence[int], values: Floats, place: str
) -> tuple[Any, Floats, float, tuple[str, ...]]:
    """Stamps, ascending, [ns], with what belongs to them; the median lag of receipt, [s]; and what was mended."""
    notes = []
    at, then = np.array(stamps, dtype=np.int64), np.array(received, dtype=np.int64)
    if not at.all():
        notes.append("no stamps in the headers: times of receipt are used")
        at = then
    lag = float(np.median((then - at) * 1e-9))
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        notes.append(f"{_counted(int(np.sum(~finite)))} with nan left out")
        at, values = at[finite], values[finite]
    back = (np.maximum.accumulate(at) - at) * 1e-9
    if len(at) and back.max() > _MOST_BACK:
        found = f"stamps go back by {back.max():.3g} s at message {int(np.argmax(back > _MOST_BACK)) + 1}"
        raise InputError(place, found, "a clock that runs on")
    if np.any(back):
        notes.append(f"{_counted(int(np.sum(back > 0)))} out of order put in order")
    at, first = np.unique(at, return_index=True)
    if len(first) < len(values):
        notes.append(f"{_counted(len(values) - len(first))} with the stamp of another left out")
    if len(at) < 2:
        raise InputError(place, f"{len(at)} different stamps with finite values", "a recording")
    return at, values[first], lag, tuple(notes)
