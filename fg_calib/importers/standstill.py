"""Where an arm stands still in a recording, and the mean pose of each stop with its sigma.

A stop is where all joints stay within a few scatters for long enough; its beginning and end, in which the arm may still
swing, are left out. The sigma is that of the mean, from the scatter within the stop, with the autocorrelation of all
stops (`correlated`).

Note:
    What stays the same during a stop does not scatter: neither errors of the instrument in one place, nor noise that
    wanders more slowly than several stops last. Noise that is slow beside a stop is told from white noise by the steps
    from sample to sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.arguments import checked
from fg_calib.arrays import Floats, FrozenArrays
from fg_calib.errors import InputError
from fg_calib.importers.clock import ClockOffset, estimate_offset
from fg_calib.importers.recording import (
    LEAST_SIGMA,
    JointStream,
    PoseStream,
    correlation_time,
    is_slow,
    period,
    sigmas_of_means,
)
from fg_calib.io.columns import require_own_csv, write_csv
from fg_calib.io.tables import joint_columns
from fg_calib.options import check_number
from fg_calib.robot.model import Robot

LEAST_SAMPLES = 8
"""Poses, and joint readings, of which a mean is taken."""

_SCATTERS = 3.0
"""Joints stand still within so many of their scatters."""
_LEAST_SCATTER = {"rad": 1e-4, "m": 2e-5}
"""Of joint readings, [rad] or [m]: encoders may be coarse, or without noise."""
_DRIFT = 6.0
_LEAST_DRIFT = {"position": 5e-5, "orientation": 1e-4}
"""A pose drifts during a stop by more than so many sigmas, and by more than this, [m] and [rad]."""
_ODD_SCATTER = 10.0
"""Stops whose poses scatter by more than so many times the usual are left out."""
_CALM = 3.0
"""Stops whose poses scatter by no more than so many times the usual say how noise is correlated."""


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
        offset: The stamp of a pose less that of the joint reading of the same moment, [s]; estimated if None.
        most_offset: The largest offset that may be estimated, [s].

    Raises:
        InputError: The arm never stands still, the offset cannot be estimated or is too large, or no stop has poses.
    """
    check_number("still", still, above=True)
    found = find_standstills(joints, robot, still)
    long = [(a, b) for a, b in found if b - a >= still]
    place = f"topic {joints.source.topic}"
    if not long:
        hint = f"the longest pause is {max(b - a for a, b in found):.2g} s" if found else ""
        raise InputError(place, f"no standstill of {still:g} s", "the arm at rest for a while, several times", hint)
    estimate, applied = _offset(joints, poses, robot, [_inner(stop) for stop in long], offset, most_offset)
    candidates, skipped = [], []
    for k, stop in enumerate(found):
        taken = _Samples.of(f"stop{k + 1}", joints, poses, _inner(stop), applied)
        reason = f"{stop[1] - stop[0]:.2g} s, shorter than {still:g} s" if stop not in long else taken.lack()
        if reason:
            skipped.append(Skipped(taken.id, stop[0] - float(joints.time[0]), reason))
        else:
            candidates.append(taken)
    good, odd = _without_odd(candidates)
    skipped += [Skipped(taken.id, taken.begin - float(joints.time[0]), reason) for taken, reason in odd]
    if not good:
        reasons = "; ".join(f"{s.id}: {s.reason}" for s in skipped[:3])
        raise InputError(f"topic {poses.source.topic}", f"no stop of {len(found)} can be used", hint=reasons)
    return _averaged(good, sorted(skipped, key=lambda s: s.begin), estimate, applied)


def _offset(
    joints: JointStream, poses: PoseStream, robot: Robot, stops: Sequence[tuple[float, float]],
    stated: float | None, most: float | None,
) -> tuple[ClockOffset | None, float]:  # fmt: skip
    """The offset of the clocks as estimated, and the one that is used: as stated, where it is."""
    for name, figure, least in (("offset", stated, -np.inf), ("most offset", most, 0.0)):
        if figure is not None:
            check_number(name, figure, least=least)
    try:
        estimate = estimate_offset(joints.tool_path(robot), poses, stops)
    except InputError:
        if stated is None:
            raise
        return None, stated
    if most is not None and abs(estimate.seconds) > most:
        found = f"an offset of {estimate.seconds:.4g} +- {estimate.sigma:.2g} s against the joints' clock"
        raise InputError(f"topic {poses.source.topic}", found, f"at most {most:g} s")
    return estimate, estimate.seconds if stated is None else stated


def find_standstills(joints: JointStream, robot: Robot, still: float) -> list[tuple[float, float]]:
    """Beginning and end of each time in which no joint moves, [s]; those of half of `still` and more.

    In windows of that length the standard deviation of every joint is within a few times its scatter: that of the
    calmest windows, or what encoders may hide.
    """
    time, readings = joints.time, joints.readings
    width = 0.5 * still
    rate = period(time)
    first = np.arange(len(time))
    end = np.searchsorted(time, time + width + 0.5 * rate)
    n = end - first
    whole = (time + width <= time[-1] + 0.5 * rate) & (n >= max(3.0, 0.5 * width / rate))
    if not whole.any():
        return []
    first, end, n = first[whole], end[whole], n[whole, None]
    centred = readings - readings.mean(axis=0)
    sums, squares = (np.vstack([np.zeros(robot.n_joints), np.cumsum(x, axis=0)]) for x in (centred, centred**2))
    mean = (sums[end] - sums[first]) / n
    scatter = np.sqrt(np.maximum((squares[end] - squares[first]) / n - mean**2, 0.0))  # (n_windows, n_joints)
    least = [_LEAST_SCATTER[joint.unit] for joint in robot.joints]
    limit = _SCATTERS * np.maximum(np.quantile(scatter, 0.02, axis=0), least)
    calm = np.all(scatter <= limit, axis=1)
    begins, ends = time[first[calm]], time[end[calm] - 1]
    if not len(begins):
        return []
    apart = np.flatnonzero(begins[1:] > np.maximum.accumulate(ends)[:-1])
    return list(
        zip(begins[np.append(0, apart + 1)].tolist(), ends[np.append(apart, len(ends) - 1)].tolist(), strict=True)
    )


def _inner(stop: tuple[float, float]) -> tuple[float, float]:
    """A stop without its beginning and end, in which the arm may still swing."""
    length = stop[1] - stop[0]
    trim = min(max(0.15, length / 8.0), length / 4.0)
    return stop[0] + trim, stop[1] - trim


@dataclass(frozen=True)
class _Samples:
    """What was measured during one stop; residuals as rotation vectors about the mean's axes."""

    id: str
    begin: float
    end: float
    readings: Floats
    position: Floats
    turned: Floats | None
    rotation: Floats | None

    @classmethod
    def of(
        cls, name: str, joints: JointStream, poses: PoseStream, stop: tuple[float, float], offset: float
    ) -> _Samples:
        a, b = np.searchsorted(joints.time, stop)
        c, d = np.searchsorted(poses.time, np.asarray(stop) + offset)
        turned = rotation = None
        if poses.rotation is not None and d > c:
            single = Rotation.from_matrix(poses.rotation[c:d].copy())
            mean = single.mean()
            turned, rotation = (mean.inv() * single).as_rotvec(), mean.as_matrix()
        return cls(name, *stop, joints.readings[a:b], poses.position[c:d], turned, rotation)

    def lack(self) -> str:
        """Why there is no mean; empty if there is one."""
        for n, what in ((len(self.readings), "joint readings"), (len(self.position), "poses")):
            if n < LEAST_SAMPLES:
                return f"{n} {what}, fewer than {LEAST_SAMPLES}"
        return ""

    def residuals(self) -> dict[str, Floats]:
        """Measurements less their mean by quantity, each of shape (n, 3), [m] or [rad]."""
        found = {"position": self.position - self.position.mean(axis=0)}
        return found if self.turned is None else {**found, "orientation": self.turned - self.turned.mean(axis=0)}


def _without_odd(stops: Sequence[_Samples]) -> tuple[list[_Samples], list[tuple[_Samples, str]]]:
    """Stops in which the pose neither drifts nor scatters far more than usual, and the others with the reason."""
    if not stops:
        return [], []
    good, odd = [], []
    residuals = [stop.residuals() for stop in stops]
    usual, tau = {}, {}
    for kind in residuals[0]:
        usual[kind] = max(float(np.median([_rms(r[kind]) for r in residuals])), LEAST_SIGMA)
        calm = [r[kind] for r in residuals if _rms(r[kind]) <= _CALM * usual[kind]]
        tau[kind] = correlation_time(calm)
    for stop, of in zip(stops, residuals, strict=True):
        reason = ""
        for kind in of:
            unit = "mm" if kind == "position" else "mrad"
            drift, sigma = _drift(of[kind], min(tau[kind], len(of[kind])))
            if np.any((drift > _DRIFT * sigma) & (drift > _LEAST_DRIFT[kind])):
                reason = f"the {kind} drifts by {drift.max() * 1e3:.2g} {unit} while the joints stand"
            elif _rms(of[kind]) > _ODD_SCATTER * usual[kind]:
                reason = f"the {kind} scatters {_rms(of[kind]) / usual[kind]:.0f} times as much as usual"
        if reason:
            odd.append((stop, reason))
        else:
            good.append(stop)
    return good, odd


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _drift(residuals: Floats, tau: float) -> tuple[Floats, Floats]:
    """How far the means of both halves are apart, and its sigma from the scatter within them, shape (3,)."""
    n = len(residuals)
    first, second = residuals[: n // 2], residuals[n // 2 :]
    scatter = np.sqrt(0.5 * (first.var(axis=0, ddof=1) + second.var(axis=0, ddof=1)))
    return np.abs(second.mean(axis=0) - first.mean(axis=0)), scatter * np.sqrt(4.0 * tau / n)


def _averaged(
    stops: Sequence[_Samples], skipped: Sequence[Skipped], estimate: ClockOffset | None, applied: float
) -> Stops:
    residuals = [stop.residuals() for stop in stops]
    scatter, sigma = {}, {}
    for kind in residuals[0]:
        scatter[kind], sigma[kind] = _scatter([r[kind] for r in residuals])
    scatter["joint"], _ = _scatter([stop.readings - stop.readings.mean(axis=0) for stop in stops])
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


def _scatter(residuals: Sequence[Floats]) -> tuple[Scatter, Floats]:
    """Scatter of one quantity, its largest component's, and the sigma of each stop's mean, shape (n_stops, k)."""
    tau = correlation_time(residuals)
    sigma = sigmas_of_means(residuals, tau)
    single = np.median([r.std(axis=0) for r in residuals], axis=0)
    n = float(np.median([len(r) for r in residuals]))
    return Scatter(float(single.max()), float(np.median(sigma, axis=0).max()), tau, is_slow(tau, n)), sigma


# --- the table of stops -----------------------------------------------------------------------------------------------


_BEGINNING = b"id,begin,seconds,samples,"
"""How such a table begins."""


def require_replaceable(path: Path) -> None:
    """Check that a table of stops can be written: a CSV that is not there yet, or was written as one.

    Raises:
        InputError: It cannot.
    """
    require_own_csv(path, _BEGINNING)


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
    require_replaceable(path)
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
