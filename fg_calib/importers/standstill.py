"""Where an arm stands still in a recording, and the mean pose of each stop with its sigma.

A stop is where all joints stay within a few scatters for long enough; its beginning and end, in which the arm may still
swing, are left out. The sigma is that of the mean, from the scatter within the stop, with the autocorrelation of all
stops (`recording`).

Note:
    Errors that are constant during a stop do not scatter: those of the instrument in one place, and noise that is
    slower than several stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.importers.clock import ClockOffset, estimate_offset
from fg_calib.importers.recording import (
    MIN_SIGMA,
    JointStream,
    PoseStream,
    correlation_time,
    is_slow,
    period,
    sigmas_of_means,
)
from fg_calib.inputs import Floats, FrozenArrays, InputError, check_number, checked
from fg_calib.io import joint_columns, require_own_csv, write_csv
from fg_calib.robot import Robot

MIN_SAMPLES = 8
"""Poses, and joint readings, of which a mean is taken."""

STILL_SCATTERS = 3.0
"""Joints stand still within so many of their scatters."""

MIN_SCATTER = {"rad": 1e-4, "m": 2e-5}
"""Scatter of joint readings, at least, [rad] or [m]: encoders may be coarse, or without noise."""

MAX_SCATTER_RATIO = 10.0
"""Stops whose poses scatter by more than so many times the median are left out: they drift, swing or are hidden."""


@dataclass(frozen=True)
class Skipped:
    """A standstill that gave no row: its name, when it began, [s] from the first joint reading, and why not."""

    id: str
    begin: float
    reason: str


@dataclass(frozen=True)
class Scatter:
    """Scatter during stops of one quantity.

    Attributes:
        single: Of single measurements, the median over stops of the largest component, [m] or [rad].
        mean: Sigma of a stop's mean, likewise.
        correlation: Integrated autocorrelation time in samples, 1 for white noise.
        slow: Whether that is so much of a stop that averaging says little.
    """

    single: float
    mean: float
    correlation: float
    slow: bool


@dataclass(frozen=True)
class Stops(FrozenArrays):
    """What was measured while the arm stood still, a row a stop.

    Attributes:
        ids: Names, by the order of all stops that were found.
        interval: Beginning and end of what was averaged, by the joints' clock, shape (n, 2), [s].
        samples: Poses averaged, shape (n,).
        readings: Mean joint readings, shape (n, n_joints), [rad] (prismatic: [m]).
        position: Mean world_p_tool, shape (n, 3), [m].
        sigma_position: Sigma of it along the world's axes, shape (n, 3), [m].
        rotation: Mean world_R_tool, shape (n, 3, 3); None where orientations are not measured.
        sigma_orientation: Sigma of it about the tool's axes, shape (n, 3), [rad]; None likewise.
        skipped: Stops that gave no row.
        offset: The offset of the clocks as estimated; None where it could not be.
        applied: The offset that was used, [s].
        scatter: Of `position`, `orientation` and `joint`.
    """

    ids: tuple[str, ...]
    interval: Floats
    samples: Floats
    readings: Floats
    position: Floats
    sigma_position: Floats
    rotation: Floats | None
    sigma_orientation: Floats | None
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
    found = find_standstills(joints, robot, still)
    long = [(a, b) for a, b in found if b - a >= still]
    if not long:
        hint = f"the longest pause is {max(b - a for a, b in found):.2g} s" if found else ""
        expected = "the arm at rest for a while, several times"
        raise InputError(f"topic {joints.source.topic}", f"no standstill of {still:g} s", expected, hint)
    estimate, applied = _offset(joints, poses, robot, [_inner(stop) for stop in long], offset, most_offset)
    stops = [_Samples.of(f"stop{k + 1}", joints, poses, _inner(stop), applied) for k, stop in enumerate(found)]
    reasons = {}
    for sample, (begin, end) in zip(stops, found, strict=True):
        few = min((len(sample.readings), "joint readings"), (len(sample.position), "poses"))
        if end - begin < still:
            reasons[sample.id] = f"{end - begin:.2g} s, shorter than {still:g} s"
        elif few[0] < MIN_SAMPLES:
            reasons[sample.id] = f"{few[0]} {few[1]}, fewer than {MIN_SAMPLES}"
    residuals = {sample.id: sample.residuals() for sample in stops if sample.id not in reasons}
    for kind in ("position", "orientation"):
        rms = {name: float(np.sqrt(np.mean(of[kind] ** 2))) for name, of in residuals.items() if kind in of}
        usual = max(float(np.median(list(rms.values()))), MIN_SIGMA) if rms else 0.0
        for name, size in rms.items():
            if size > MAX_SCATTER_RATIO * usual:
                reasons.setdefault(name, f"the {kind} scatters {size / usual:.0f} times as much as usual")
    good = [sample for sample in stops if sample.id not in reasons]
    skipped = [Skipped(s.id, s.begin - float(joints.time[0]), reasons[s.id]) for s in stops if s.id in reasons]
    if not good:
        hint = "; ".join(f"{s.id}: {s.reason}" for s in skipped[:3])
        raise InputError(f"topic {poses.source.topic}", f"no stop of {len(found)} can be used", hint=hint)
    return _average(good, [residuals[s.id] for s in good], skipped, estimate, applied)


def _offset(
    joints: JointStream, poses: PoseStream, robot: Robot, stops: Sequence[tuple[float, float]],
    specified: float | None, most: float | None,
) -> tuple[ClockOffset | None, float]:  # fmt: skip
    """The offset of the clocks as estimated, and the one that is used: the specified one, where there is one."""
    if most is not None:
        check_number("most offset", most)
    try:
        estimate = estimate_offset(joints.tool_path(robot), poses, stops)
    except InputError:
        if specified is None:
            raise
        return None, specified
    if most is not None and abs(estimate.seconds) > most:
        found = f"an offset of {estimate.seconds:.4g} +- {estimate.sigma:.2g} s against the joints' clock"
        raise InputError(f"topic {poses.source.topic}", found, f"at most {most:g} s")
    return estimate, estimate.seconds if specified is None else specified


def find_standstills(joints: JointStream, robot: Robot, still: float) -> list[tuple[float, float]]:
    """Beginning and end of each time in which no joint moves, [s]; those of half of `still` and more.

    In windows of that length the standard deviation of every joint is within a few times its scatter: that of the
    calmest windows, or what encoders may hide.
    """
    time, readings = joints.time, joints.readings
    width, rate = 0.5 * still, period(time)
    first, end = np.arange(len(time)), np.searchsorted(time, time + width + 0.5 * rate)
    n = end - first
    whole = (time + width <= time[-1] + 0.5 * rate) & (n >= max(3.0, 0.5 * width / rate))
    if not whole.any():
        return []
    first, end, n = first[whole], end[whole], n[whole, None]
    centred = readings - readings.mean(axis=0)
    sums, squares = (np.vstack([np.zeros(robot.n_joints), np.cumsum(x, axis=0)]) for x in (centred, centred**2))
    mean = (sums[end] - sums[first]) / n
    scatter = np.sqrt(np.maximum((squares[end] - squares[first]) / n - mean**2, 0.0))  # (n_windows, n_joints)
    least = [MIN_SCATTER[joint.unit] for joint in robot.joints]
    calm = np.all(scatter <= STILL_SCATTERS * np.maximum(np.quantile(scatter, 0.02, axis=0), least), axis=1)
    begins, ends = time[first[calm]], time[end[calm] - 1]
    gaps = np.flatnonzero(begins[1:] > np.maximum.accumulate(ends)[:-1])
    parts = zip(np.split(begins, gaps + 1), np.split(ends, gaps + 1), strict=True)
    return [(float(a[0]), float(b[-1])) for a, b in parts if len(a)]


def _inner(stop: tuple[float, float]) -> tuple[float, float]:
    """A stop without its beginning and end, in which the arm may still swing."""
    length = stop[1] - stop[0]
    trim = min(max(0.15, length / 8.0), length / 4.0)
    return stop[0] + trim, stop[1] - trim


@dataclass(frozen=True)
class _Samples:
    """What was measured during one stop; rotations are relative to their mean, about its axes."""

    id: str
    begin: float
    end: float
    readings: Floats
    position: Floats
    rotation_vectors: Floats | None
    rotation: Floats | None

    @classmethod
    def of(
        cls, name: str, joints: JointStream, poses: PoseStream, stop: tuple[float, float], offset: float
    ) -> _Samples:
        a, b = np.searchsorted(joints.time, stop)
        c, d = np.searchsorted(poses.time, np.asarray(stop) + offset)
        vectors = rotation = None
        if poses.rotation is not None and d > c:
            single = Rotation.from_matrix(poses.rotation[c:d].copy())
            mean = single.mean()
            vectors, rotation = (mean.inv() * single).as_rotvec(), mean.as_matrix()
        return cls(name, *stop, joints.readings[a:b], poses.position[c:d], vectors, rotation)

    def residuals(self) -> dict[str, Floats]:
        """Measurements minus their mean by quantity, each of shape (n, k), [m] or [rad]."""
        values = {"position": self.position, "orientation": self.rotation_vectors, "joint": self.readings}
        return {kind: v - v.mean(axis=0) for kind, v in values.items() if v is not None}


def _average(
    stops: Sequence[_Samples],
    residuals: Sequence[dict[str, Floats]],
    skipped: Sequence[Skipped],
    estimate: ClockOffset | None,
    applied: float,
) -> Stops:
    """Means of the stops, with their sigmas."""
    scatter, sigma = dict[str, Scatter](), dict[str, Floats]()
    for kind in residuals[0]:
        of = [r[kind] for r in residuals]
        tau = correlation_time(of)
        sigma[kind] = sigmas_of_means(of, tau)
        single, mean = np.median([r.std(axis=0) for r in of], axis=0), np.median(sigma[kind], axis=0)
        slow = is_slow(tau, float(np.median([len(r) for r in of])))
        scatter[kind] = Scatter(float(single.max()), float(mean.max()), tau, slow)
    rotation = [stop.rotation for stop in stops if stop.rotation is not None]
    return Stops(
        ids=tuple(stop.id for stop in stops),
        interval=np.array([(stop.begin, stop.end) for stop in stops]),
        samples=np.array([float(len(stop.position)) for stop in stops]),
        readings=np.array([stop.readings.mean(axis=0) for stop in stops]),
        position=np.array([stop.position.mean(axis=0) for stop in stops]),
        sigma_position=sigma["position"],
        rotation=np.array(rotation) if rotation else None,
        sigma_orientation=sigma.get("orientation"),
        skipped=tuple(skipped),
        offset=estimate,
        applied=applied,
        scatter=scatter,
    )


# --- the table of stops -----------------------------------------------------------------------------------------------


TABLE_BEGINNING = b"id,begin,seconds,samples,"
"""How a table of stops begins."""


@checked
def write_stops(path: Path | str, stops: Stops, robot: Robot) -> None:
    """Write the table of configurations and poses, in m and rad, whole or not at all.

    Columns: `id`; `begin` and `seconds` of what was averaged, from the first joint reading on, and `samples`, which
    nothing reads; the joints' names (`q1 ... qn` where these mean something else in a table); `x y z`; `qx qy qz qw`
    where orientations were measured; `sigma_x ...` and `sigma_rx ...`.

    Args:
        path: The CSV; one that was written as such is replaced.
        stops: The stops.
        robot: Whose joints they are of.

    Raises:
        InputError: It cannot be written, or is another file.
    """
    path = Path(path)
    require_own_csv(path, TABLE_BEGINNING)
    columns: dict[str, Any] = {
        "id": np.array(stops.ids),
        "begin": np.round(stops.interval[:, 0], 3),
        "seconds": np.round(np.diff(stops.interval, axis=1)[:, 0], 3),
        "samples": stops.samples.astype(np.int64),
        **dict(zip(joint_columns(robot), stops.readings.T, strict=True)),
        **dict(zip("xyz", stops.position.T, strict=True)),
    }
    if stops.rotation is not None:
        quaternion = Rotation.from_matrix(stops.rotation.copy()).as_quat(canonical=True)
        columns |= {f"q{axis}": quaternion[:, k] for k, axis in enumerate("xyzw")}
    columns |= {f"sigma_{axis}": stops.sigma_position[:, k] for k, axis in enumerate("xyz")}
    if stops.sigma_orientation is not None:
        columns |= {f"sigma_r{axis}": stops.sigma_orientation[:, k] for k, axis in enumerate("xyz")}
    write_csv(path, columns)
