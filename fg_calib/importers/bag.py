"""ROS bags: joint readings and poses over time, averaged where the arm stands still, with the offset of the clocks.

| bag | is |
|---|---|
| ROS 1 | a file `.bag` |
| ROS 2 | a folder with `metadata.yaml`, or one file `.db3` (SQLite) or `.mcap` |

Messages are read by the definitions of their types in the bag, or by the standard ones. Needs the extra `ros`.

A stop is where all joints stay within a few scatters for long enough; its beginning and end, in which the arm may still
swing, are left out. The sigma is that of the mean, from the scatter within the stop, with the autocorrelation of all
stops.

Of n samples with autocorrelation rho_k the mean of samples of variance s^2 has the variance

    s^2 tau / n,    tau = 1 + 2 sum_k (1 - k / n) rho_k

(integrated autocorrelation time, in samples; Sokal 1997, *Monte Carlo Methods in Statistical Mechanics*, Sec. 3). tau
is estimated from all standstills together, as one is too short. As s is estimated too, the variance is Student's. Where
tau is more than an eighth of a stop, averaging is taken to gain nothing, with a warning.

Note:
    Errors that are constant during a stop do not scatter: those of the instrument in one place, and noise that is
    slower than several stops.

The nominal arm gives the tool's motion at each joint reading. Its speed depends on no frame: the offset of the clocks
is that at which it correlates most with the speed of the measured positions, to a hundredth of a second. Stops are cut
by more than that at both ends.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_dilation, find_objects, label, uniform_filter1d
from scipy.spatial.transform import Rotation

from fg_calib import inputs, io
from fg_calib.inputs import CalibrationError, Floats, FrozenArrays, InputError, check_number, checked, expect
from fg_calib.robot import Robot, build_chain, forward


class Source(inputs.Record):
    """Origin of a stream.

    Attributes:
        topic: Its topic.
        type: Type of its messages.
        lag: Median of the time of receipt minus the stamp, [s]: latency, and the offset of the two clocks.
        notes: Notes on rows left out or reordered.
    """

    topic: str
    type: str
    lag: float = 0.0
    notes: tuple[str, ...] = ()


class JointStream(FrozenArrays):
    """Joint readings over time.

    Attributes:
        time: By the sender's clock, ascending, shape (n,), [s].
        readings: In chain order, shape (n, n_joints), [rad] (prismatic: [m]).
        source: Where they are from.
    """

    time: Floats
    readings: Floats
    source: Source


class PoseStream(FrozenArrays):
    """Poses over time.

    Attributes:
        time: By the sender's clock, ascending, shape (n,), [s].
        position: world_p_tool, shape (n, 3), [m].
        rotation: world_R_tool, shape (n, 3, 3); None where orientations are not measured.
        source: Where they are from.
    """

    time: Floats
    position: Floats
    rotation: Floats | None
    source: Source


def period(time: Floats) -> float:
    """Median time from one sample to the next, [s]."""
    return float(np.median(np.diff(time)))


MIN_CORRELATION = 0.7
"""Below it the poses are not those of the arm's tool."""

MAX_LAG_S = 2.0
"""The offset of the clocks is looked for within so much of that by times of receipt, [s]."""

LAG_STEP_S = 0.01
"""Step of the search, [s]."""

SPEED_WIDTH_S = 0.1
"""Time over which speeds are taken, [s]."""


class ClockOffset(inputs.Record):
    """The stamp of a pose minus that of the joint reading of the same moment.

    Attributes:
        seconds: The offset, [s].
        correlation: Of the tool's speed by the joints with that by the poses.
    """

    seconds: float
    correlation: float


def estimate_offset(joints: JointStream, poses: PoseStream, robot: Robot) -> ClockOffset:
    """The offset of the poses' clock at which speeds correlate most, near that by times of receipt.

    Args:
        joints: Joint readings.
        poses: The measured poses, in any frame.
        robot: The nominal robot.

    Raises:
        InputError: The poses do not follow the joints.
    """
    first = joints.source.lag - poses.source.lag - MAX_LAG_S
    begin = max(joints.time[0], poses.time[0] - first)
    end = min(joints.time[-1], poses.time[-1] - first - 2.0 * MAX_LAG_S)
    n, n_lags = max(2, int((end - begin) / LAG_STEP_S)), round(2.0 * MAX_LAG_S / LAG_STEP_S)
    path = forward(build_chain(robot, {}), robot.trig(joints.readings)).position
    by_joints = _speed(joints.time, path, begin + LAG_STEP_S * np.arange(n))
    by_poses = _speed(poses.time, poses.position, begin + first + LAG_STEP_S * np.arange(n + n_lags))
    with np.errstate(invalid="ignore"):  # of what does not move
        correlation = np.nan_to_num([np.corrcoef(by_joints, one)[0, 1] for one in sliding_window_view(by_poses, n)])
    best = int(np.argmax(correlation))
    if correlation[best] < MIN_CORRELATION:
        place = f"topics {joints.source.topic} and {poses.source.topic}"
        found = f"the poses do not move as the joints do (correlation {correlation[best]:.2f})"
        raise InputError(place, found, "poses of this robot's tool", "or specify the offset of the clocks: --offset 0")
    return ClockOffset(float(first + best * LAG_STEP_S), float(correlation[best]))


def _speed(time: Floats, position: Floats, at: Floats) -> Floats:
    """Speed along a path at some times, shape (n,), [m/s]."""
    ends = [at - SPEED_WIDTH_S / 2.0, at + SPEED_WIDTH_S / 2.0]
    before, after = (np.array([np.interp(end, time, axis) for axis in position.T]) for end in ends)
    return np.linalg.norm(after - before, axis=0) / SPEED_WIDTH_S


MIN_SAMPLES = 12
"""Poses, and joint readings, of which a mean is taken."""

STILL_SCATTERS = 3.0
"""Joints stand still within so many of their scatters."""

MIN_SCATTER = {"rad": 1e-4, "m": 2e-5}
"""Scatter of joint readings, at least, [rad] or [m]: encoders may be coarse, or without noise."""

MAX_SCATTER_RATIO = 10.0
"""Stops whose poses scatter by more than so many times the median are left out: they drift, swing or are hidden."""


MIN_SIGMA = 1e-6
"""1 sigma of a mean, at least, [m] or [rad]: poses without any scatter are not exact either."""

WINDOW = 4.0
"""Correlation times at which the sum over the lags ends (Sokal)."""


class Skipped(inputs.Record):
    """A standstill that gave no row: its name, when it began, [s] from the first joint reading, and why not."""

    id: str
    begin: float
    reason: str


class Scatter(inputs.Record):
    """Scatter during stops of one quantity.

    Attributes:
        single: Of single measurements, the median over stops of the largest component, [m] or [rad].
        mean: Sigma of a stop's mean, likewise.
        correlation_samples: Integrated autocorrelation time in samples, 1 for white noise.
        slow: Whether it is too long to be estimated, and averaging is taken to gain nothing.
    """

    single: float
    mean: float
    correlation_samples: float
    slow: bool


class Stops(FrozenArrays):
    """Measurements while the arm stood still, a row a stop.

    Attributes:
        ids: Names, by the order of all stops that were found.
        interval: Beginning and end of what was averaged, by the joints' clock, shape (n, 2), [s].
        samples: Poses averaged, shape (n,).
        means: Of joint readings (`joint`), shape (n, n_joints), [rad] (prismatic: [m]), of world_p_tool (`position`),
            shape (n, 3), [m], and where orientations are measured of world_R_tool (`orientation`), shape (n, 3, 3).
        sigmas: Sigma of each mean: of positions along the world's axes, shape (n, 3), [m]; of orientations about the
            tool's axes, shape (n, 3), [rad].
        skipped: Stops that gave no row.
        offset: The offset of the clocks as estimated; None where one was specified.
        applied: The offset that was used, [s].
        scatter: Of `position`, `orientation` and `joint`.
    """

    ids: tuple[str, ...]
    interval: Floats
    samples: Floats
    means: dict[str, Floats]
    sigmas: dict[str, Floats]
    skipped: tuple[Skipped, ...]
    offset: ClockOffset | None
    applied: float
    scatter: dict[str, Scatter]


def average_stops(
    joints: JointStream,
    poses: PoseStream,
    robot: Robot,
    *,
    still: float = 1.0,
    offset: float | None = None,
    most_offset: float | None = None,
) -> Stops:
    """Mean joint readings and mean poses of all standstills, matched in time.

    Args:
        joints: Joint readings.
        poses: Poses of the tool, in one frame.
        robot: The nominal robot.
        still: How long the arm stands still at least, [s].
        offset: The stamp of a pose minus that of the joint reading of the same moment, [s]; estimated if None.
        most_offset: The largest offset that may be estimated, [s].

    Raises:
        InputError: The arm never stands still, the offset cannot be estimated or is too large, or no stop has poses.
    """
    check_number("still", still, above=True)
    pauses = find_standstills(joints, robot, still)
    spans = [_inner(span) for span in pauses if span[1] - span[0] >= still]
    hint = f"the longest pause is {max(b - a for a, b in pauses):.2g} s" if pauses else ""
    expected = "the arm at rest for a while, several times"
    expect(spans, f"topic {joints.source.topic}", f"no standstill of {still:g} s", expected, hint)
    estimate = None
    if offset is None:
        estimate = estimate_offset(joints, poses, robot)
        offset, most = estimate.seconds, np.inf if most_offset is None else most_offset
        found = f"an offset of {offset:.4g} s against the joints' clock"
        expect(abs(offset) <= most, f"topic {poses.source.topic}", found, f"at most {most:g} s")
    stops, reasons = _centre(joints, poses, np.array(spans), offset)
    skipped = tuple(Skipped(f"stop{k + 1}", spans[k][0] - float(joints.time[0]), reasons[k]) for k in sorted(reasons))
    good = [k for k in stops if k not in reasons]
    hint = "; ".join(f"{s.id}: {s.reason}" for s in skipped[:3])
    expect(good, f"topic {poses.source.topic}", f"no stop of {len(spans)} can be used", hint=hint)
    means, residuals = ({kind: [stops[k][kind][part] for k in good] for kind in stops[good[0]]} for part in (0, 1))
    scatter, sigmas = _scatter(residuals)
    ids, interval = tuple(f"stop{k + 1}" for k in good), np.array([spans[k] for k in good])
    samples = np.array([float(len(one)) for one in residuals["position"]])
    mean = {kind: np.array(each) for kind, each in means.items()}
    return Stops(ids, interval, samples, mean, sigmas, skipped, estimate, offset, scatter)


def find_standstills(joints: JointStream, robot: Robot, still: float) -> list[tuple[float, float]]:
    """Beginning and end of each pause in which no joint moves, [s]; those of half of `still` and more.

    In windows of that length the standard deviation of every joint is within a few times its scatter: that of the
    calmest windows, or what encoders may hide.
    """
    time, width = joints.time, 2 * max(1, round(0.25 * still / period(joints.time))) + 1
    if len(time) < width:
        return []
    centred = joints.readings - joints.readings.mean(axis=0)
    mean, square = (uniform_filter1d(x, width, axis=0) for x in (centred, centred**2))
    scatter = np.sqrt(np.maximum(square - mean**2, 0.0))
    least = [MIN_SCATTER[joint.unit] for joint in robot.joints]
    calm = np.all(scatter <= STILL_SCATTERS * np.maximum(np.quantile(scatter, 0.02, axis=0), least), axis=1)
    pauses = find_objects(label(binary_dilation(calm, np.ones(width - 2, dtype=np.bool_)))[0])
    return [(float(time[pause][0]), float(time[pause][-1])) for (pause,) in pauses]


def _inner(stop: tuple[float, float]) -> tuple[float, float]:
    """A stop without its beginning and end, in which the arm may still swing."""
    length = stop[1] - stop[0]
    trim = min(max(0.15, length / 8.0), length / 4.0)
    return stop[0] + trim, stop[1] - trim


def _centre(
    joints: JointStream, poses: PoseStream, spans: Floats, offset: float
) -> tuple[dict[int, dict[str, tuple[Floats, Floats]]], dict[int, str]]:
    """Means of what was measured during stops, and measurements minus these; and why some stops give no row.

    Args:
        joints: Joint readings.
        poses: Poses.
        spans: Beginning and end of each stop, by the joints' clock, shape (n, 2), [s].
        offset: Of the poses' clock, [s].

    Returns:
        By number and quantity, in [m] and [rad], rotations minus their mean about its axes; and the reasons by number:
        too few measurements, or poses that scatter far more than those of others.
    """
    stops, reasons = dict[int, dict[str, tuple[Floats, Floats]]](), dict[int, str]()
    for k, span in enumerate(spans):
        (a, b), (c, d) = np.searchsorted(joints.time, span), np.searchsorted(poses.time, span + offset)
        n, what = min((b - a, "joint readings"), (d - c, "poses"))
        if n < MIN_SAMPLES:
            reasons[k] = f"{n} {what}, fewer than {MIN_SAMPLES}"
            continue
        stops[k] = {"position": _minus_mean(poses.position[c:d])}
        if poses.rotation is not None:
            single = Rotation.from_matrix(poses.rotation[c:d].copy())
            turns = (single.mean().inv() * single).as_rotvec()
            stops[k]["orientation"] = single.mean().as_matrix(), _minus_mean(turns)[1]
        stops[k]["joint"] = _minus_mean(joints.readings[a:b])
    for kind in ("position", "orientation") if poses.rotation is not None else ("position",):
        rms = {k: np.sqrt(np.mean(of[kind][1] ** 2)) for k, of in stops.items()}
        usual = max(np.median([*rms.values()]), MIN_SIGMA) if rms else 0.0
        for k, size in rms.items():
            if size > MAX_SCATTER_RATIO * usual:
                reasons.setdefault(k, f"the {kind} scatters {size / usual:.0f} times as much as usual")
    return stops, reasons


def _minus_mean(values: Floats) -> tuple[Floats, Floats]:
    """The mean, and values minus it."""
    return values.mean(axis=0), values - values.mean(axis=0)


def _scatter(residuals: Mapping[str, Sequence[Floats]]) -> tuple[dict[str, Scatter], dict[str, Floats]]:
    """Scatter, and the sigma of each stop's mean, by quantity."""
    scatter, sigma = dict[str, Scatter](), dict[str, Floats]()
    for kind, of in residuals.items():
        tau = correlation_time(of)
        sigma[kind] = sigmas_of_means(of, tau)
        single, mean = np.median([r.std(axis=0) for r in of], axis=0), np.median(sigma[kind], axis=0)
        slow = tau >= int(np.median([len(r) for r in of]))
        scatter[kind] = Scatter(float(single.max()), float(mean.max()), tau, slow)
    return scatter, sigma


# --- means of correlated samples --------------------------------------------------------------------------------------


def correlation_time(residuals: Sequence[Floats]) -> float:
    """Integrated autocorrelation time of noise over a stop, in samples, at least 1; that of a stop for slow noise.

    The variance v of a stop's mean is missing in the autocovariances c_k of residuals: c_k = C_k - v, and
    n v = C_0 + 2 sum_k (1 - k / n) C_k, which give v. The sum ends at `WINDOW` correlation times,
    which for slow noise are more than half of a stop.

    Args:
        residuals: Of each stop, minus its mean, shape (n, k).
    """
    scaled = [r / np.maximum(r.std(axis=0), np.finfo(np.float64).tiny) for r in residuals]  # stops count alike
    n = int(np.median([len(r) for r in scaled]))
    lags = np.arange(max(n // 2, 1))
    size = 2 * max(len(r) for r in scaled)
    power = [np.mean(np.abs(np.fft.rfft(r, size, axis=0)) ** 2, axis=1) for r in scaled]
    c = np.fft.irfft(np.sum(power, axis=0), size)[: len(lags)] / sum(np.maximum(len(r) - lags, 0) for r in scaled)
    weights = np.where(lags == 0, 1.0, 2.0 * (1.0 - lags / n))
    of_mean = np.cumsum(weights * c) / (n - np.cumsum(weights))
    times = np.maximum(n * of_mean / np.maximum(c[0] + of_mean, np.finfo(np.float64).tiny), 1.0)
    ended = np.flatnonzero(lags >= WINDOW * times)
    return float(times[ended[0]]) if len(ended) else float(n)


def sigmas_of_means(residuals: Sequence[Floats], tau: float) -> Floats:
    """Sigma of each stop's mean of correlated samples, shape (n_stops, k).

    The variance of Student's t, for the scatter is estimated from the same samples: with 2 n tau / (tau^2 + 1) - 1
    degrees of freedom, those of the mean square of AR(1) noise (Bartlett), n - 1 of white noise.

    Args:
        residuals: Of each stop, minus its mean, shape (n, k).
        tau: Integrated autocorrelation time, in samples.
    """
    n = np.array([len(r) for r in residuals], dtype=np.float64)[:, None]
    square = np.array([np.mean(r**2, axis=0) for r in residuals])
    part = np.minimum(tau / n, 0.5)
    freedom = np.maximum(2.0 * n * tau / (tau**2 + 1.0) - 1.0, 3.0)
    return np.maximum(np.sqrt(square * part / (1.0 - part) * freedom / (freedom - 2.0)), MIN_SIGMA)


# --- the table of stops -----------------------------------------------------------------------------------------------


@checked
def write_stops(path: Path | str, stops: Stops, robot: Robot) -> None:
    """Write the table of configurations and poses, in m and rad, whole or not at all.

    Columns: `id`; `begin` and `seconds` of what was averaged, from the first joint reading on, and `samples`, which
    nothing reads; the joints' names (`q1 ... qn` where these mean something else in a table); `x y z`; `qx qy qz qw`
    where orientations were measured; `sigma_x ...` and `sigma_rx ...`.

    Args:
        path: The CSV, a new file.
        stops: The stops.
        robot: Whose joints they are of.

    Raises:
        InputError: The table cannot be written, or is there already.
    """
    path = Path(path)
    io.require_absent(path.parent, [path.name])
    begin, seconds = np.round(stops.interval[:, 0], 3), np.round(np.diff(stops.interval, axis=1)[:, 0], 3)
    columns: dict[str, Any] = {"id": np.array(stops.ids), "begin": begin, "seconds": seconds}
    columns |= {"samples": stops.samples.astype(np.int64)}
    means = stops.means
    columns |= io.pose_columns(robot, means["joint"], means["position"], means.get("orientation"), io.Units())
    for kind, prefix in (("position", "sigma_"), ("orientation", "sigma_r")):
        if kind in stops.sigmas:
            columns |= {f"{prefix}{axis}": stops.sigmas[kind][:, k] for k, axis in enumerate("xyz")}
    io.write_csv(path, columns)


JOINT_TYPE = "sensor_msgs/msg/JointState"

POSE_TYPES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
    "nav_msgs/msg/Odometry": "pose.pose",
    "tf2_msgs/msg/TFMessage": "transform",
}
"""Types of messages with poses, and where these are in one, or in each of its `transforms`."""

MAX_BACK_S = 1.0
"""Stamps that go back by less, [s], are put in order."""


Sample = tuple[int, int, Sequence[float]]
"""Stamp and time of receipt of a message, [ns], and its values."""

Topic = tuple[str, str]
"""Name of a topic, and the type of its messages."""


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
    expect(path.exists(), str(path), "no such bag")
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


def _choose_topic(reader: Any, bag: str, name: str | None, kinds: tuple[str, ...], what: str) -> Topic:
    """The topic of a name, or the only one with messages of these types.

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
    expect(not fitting, bag, f"{len(fitting)} topics fit: {listed}", f"one of them: --{what} TOPIC")
    raise InputError(bag, f"no topic {name or ''} for --{what}", hint=f"the bag has {listed or 'nothing'}")


def _messages(reader: Any, topic: Topic) -> Iterator[tuple[int, Any]]:
    """Times of receipt, [ns], and messages of a topic, in the order in which they were received."""
    connections = [c for c in reader.connections if (c.topic, c.msgtype) == topic]
    for connection, received, raw in reader.messages(connections):
        yield received, reader.deserialize(raw, connection.msgtype)


def _stamp(header: Any) -> int:
    """Time stamp of a message's header, [ns]."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _read_joints(reader: Any, topic: Topic, wanted: tuple[str, ...], bag: str) -> tuple[Any, Floats, Source]:
    """Stamps, [ns], and readings of the joints wanted, shape (n, n_joints), in order of time."""
    samples, present, n = list[Sample](), dict[str, None](), 0
    for received, m in _messages(reader, topic):
        values = dict(zip(m.name, m.position, strict=False))
        present.update(dict.fromkeys(m.name))
        n += 1
        if set(wanted) <= values.keys():
            samples.append((_stamp(m.header), received, [values[name] for name in wanted]))
    missing = next((f"joint {name}" for name in wanted if name not in present), "message with all joints")
    hint = "name the bag's joints in chain order: --names, or `name` in the robot file"
    expect(samples, f"{bag}: topic {topic[0]}", f"no {missing}", f"the robot's joints among {', '.join(present)}", hint)
    return _sort(samples, topic, {"without the robot's joints left out": n - len(samples)}, bag)


def _read_poses(reader: Any, topic: Topic, frames: tuple[str | None, str | None], origin: int, bag: str) -> PoseStream:
    """The poses of one frame in another; without rotations where all are the same."""
    place, samples = f"{bag}: topic {topic[0]}", dict[tuple[str, str], list[Sample]]()
    for received, message in _messages(reader, topic):
        for m in getattr(message, "transforms", [message]):
            at = attrgetter(POSE_TYPES[topic[1]])(m)
            p, q = (at.translation, at.rotation) if hasattr(at, "translation") else (at.position, at.orientation)
            frame, child = m.header.frame_id, getattr(m, "child_frame_id", "")
            pair = frame.removeprefix("/"), child.removeprefix("/")  # ROS 1 had a slash before names
            samples.setdefault(pair, []).append((_stamp(m.header), received, (p.x, p.y, p.z, q.x, q.y, q.z, q.w)))
    wanted = [None if frame is None else frame.removeprefix("/") for frame in frames]
    fitting = [pair for pair in samples if all(f in (None, g) for f, g in zip(wanted, pair, strict=True))]
    listed = ", ".join(f"{a or '(no name)'} -> {b}" if b else a or "(no name)" for a, b in samples)
    what = f"poses of {len(fitting)} frames" if fitting else "no poses of these frames"
    expect(len(fitting) == 1, place, what, "one: --parent FRAME --child FRAME", f"it has {listed}")
    stamps, values, source = _sort(samples[fitting[0]], topic, {}, bag)
    quaternions, rotation = values[:, 3:], None
    norm = np.linalg.norm(quaternions, axis=1)
    wrong = np.abs(norm - 1.0) > inputs.NORM_TOLERANCE
    if not np.any(quaternions - quaternions[0]):
        source = replace(source, notes=(*source.notes, "all orientations are the same: taken as not measured"))
    elif wrong.any():
        found = f"quaternion of norm {norm[np.argmax(wrong)]:.6g}"
        raise InputError(place, found, f"1 within {inputs.NORM_TOLERANCE:g}", f"{wrong.sum()} of {len(norm)} poses")
    else:
        rotation = np.asarray(Rotation.from_quat(quaternions).as_matrix(), dtype=np.float64)
    return PoseStream((stamps - origin) * 1e-9, values[:, :3], rotation, source)


def _sort(samples: Sequence[Sample], topic: Topic, counts: Mapping[str, int], bag: str) -> tuple[Any, Floats, Source]:
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
    expect(len(stamps) >= 2, place, f"{len(stamps)} different stamps with finite values", "a recording")
    found = {**counts, "with nan left out": np.sum(~finite), "out of order put in order": np.sum(back > 0.0)}
    found["with the stamp of another left out"] = len(values) - len(first)
    notes += [f"{n} message{'s' * int(n != 1)} {what}" for what, n in found.items() if n]
    return stamps, values[first], Source(*topic, lag, tuple(notes))
