"""Where an arm stands still in a recording, and the mean pose of each stop with its sigma.

A stop is where all joints stay within a few scatters for long enough; its beginning and end, in which the arm may still
swing, are left out. The sigma is that of the mean, from the scatter within the stop, with the autocorrelation of all
stops.

Of n samples with autocorrelation rho_k the mean of samples of variance s^2 has the variance

    s^2 tau / n,    tau = 1 + 2 sum_k (1 - k / n) rho_k

(integrated autocorrelation time, in samples; Sokal 1997, *Monte Carlo Methods in Statistical Mechanics*, Sec. 3). tau
is estimated from all standstills together, as one is too short. As s is estimated too, the variance is Student's.

Note:
    Errors that are constant during a stop do not scatter: those of the instrument in one place, and noise that is
    slower than several stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import toeplitz
from scipy.optimize import brute
from scipy.spatial.transform import Rotation

from fg_calib.importers.clock import ClockOffset, estimate_offset
from fg_calib.importers.recording import JointStream, PoseStream, period
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


MIN_SIGMA = 1e-6
"""1 sigma of a mean, at least, [m] or [rad]: poses without any scatter are not exact either."""

MAX_BLOCKS = 64
"""Blocks at most in which the samples of a stop are averaged before their correlation is estimated."""

MIN_GAIN = 12.0
"""Gain in twice the log-likelihood from which noise counts as correlated: white noise reaches it once in 400 times."""

MAX_TIME_SHARE = 1.0 / 6.0
"""Share of a stop that the correlation time may have: averaging slower noise reduces it too little to be relied on."""


class Skipped(NamedTuple):
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
        correlation_samples: Integrated autocorrelation time in samples, 1 for white noise.
        slow: Whether that is so much of a stop that averaging says little.
    """

    single: float
    mean: float
    correlation_samples: float
    slow: bool


@dataclass(frozen=True)
class Stops(FrozenArrays):
    """What was measured while the arm stood still, a row a stop.

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


class _Stop(NamedTuple):
    """What was measured during one stop: means, and measurements minus these, by quantity, [m] and [rad].

    Rotations are relative to their mean, about its axes.
    """

    id: str
    span: tuple[float, float]
    n_readings: int
    n_poses: int
    means: dict[str, Floats]
    residuals: dict[str, Floats]


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
    if not spans:
        hint = f"the longest pause is {max(b - a for a, b in pauses):.2g} s" if pauses else ""
        expected = "the arm at rest for a while, several times"
        raise InputError(f"topic {joints.source.topic}", f"no standstill of {still:g} s", expected, hint)
    estimate = None if offset is not None else estimate_offset(joints.tool_path(robot), poses, spans)
    if estimate is not None and most_offset is not None and abs(estimate.seconds) > most_offset:
        found = f"an offset of {estimate.seconds:.4g} +- {estimate.sigma:.2g} s against the joints' clock"
        raise InputError(f"topic {poses.source.topic}", found, f"at most {most_offset:g} s")
    applied = offset if estimate is None else estimate.seconds
    assert applied is not None
    stops = [_average(f"stop{k + 1}", joints, poses, span, applied) for k, span in enumerate(spans)]
    reasons = _reasons_to_skip(stops)
    good = [stop for stop in stops if stop.id not in reasons]
    origin = float(joints.time[0])
    skipped = tuple(Skipped(s.id, s.span[0] - origin, reasons[s.id]) for s in stops if s.id in reasons)
    if not good:
        hint = "; ".join(f"{s.id}: {s.reason}" for s in skipped[:3])
        raise InputError(f"topic {poses.source.topic}", f"no stop of {len(stops)} can be used", hint=hint)
    scatter, sigmas = _scatter(good)
    return Stops(
        ids=tuple(stop.id for stop in good),
        interval=np.array([stop.span for stop in good]),
        samples=np.array([float(stop.n_poses) for stop in good]),
        means={kind: np.array([stop.means[kind] for stop in good]) for kind in good[0].means},
        sigmas=sigmas,
        skipped=skipped,
        offset=estimate,
        applied=applied,
        scatter=scatter,
    )


def find_standstills(joints: JointStream, robot: Robot, still: float) -> list[tuple[float, float]]:
    """Beginning and end of each pause in which no joint moves, [s]; those of half of `still` and more.

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


def _average(name: str, joints: JointStream, poses: PoseStream, span: tuple[float, float], offset: float) -> _Stop:
    """Means of what was measured during a stop."""
    a, b = np.searchsorted(joints.time, span)
    c, d = np.searchsorted(poses.time, np.asarray(span) + offset)
    if min(b - a, d - c) < MIN_SAMPLES:
        return _Stop(name, span, int(b - a), int(d - c), {}, {})
    values, means = {"position": poses.position[c:d]}, dict[str, Floats]()
    if poses.rotation is not None:
        single = Rotation.from_matrix(poses.rotation[c:d].copy())
        means["orientation"] = single.mean().as_matrix()
        values["orientation"] = (single.mean().inv() * single).as_rotvec()
    values["joint"] = joints.readings[a:b]
    residuals = {kind: v - v.mean(axis=0) for kind, v in values.items()}
    means = {kind: v.mean(axis=0) for kind, v in values.items()} | means
    return _Stop(name, span, int(b - a), int(d - c), means, residuals)


def _reasons_to_skip(stops: Sequence[_Stop]) -> dict[str, str]:
    """Why stops give no row, by name: too few measurements, or poses that scatter far more than those of others."""
    reasons = {}
    for stop in stops:
        if not stop.means:
            n, what = min((stop.n_readings, "joint readings"), (stop.n_poses, "poses"))
            reasons[stop.id] = f"{n} {what}, fewer than {MIN_SAMPLES}"
    for kind in ("position", "orientation"):
        rms = {stop.id: np.sqrt(np.mean(stop.residuals[kind] ** 2)) for stop in stops if kind in stop.residuals}
        usual = max(np.median(list(rms.values())), MIN_SIGMA) if rms else 0.0
        for name, size in rms.items():
            if size > MAX_SCATTER_RATIO * usual:
                reasons.setdefault(name, f"the {kind} scatters {size / usual:.0f} times as much as usual")
    return reasons


def _scatter(stops: Sequence[_Stop]) -> tuple[dict[str, Scatter], dict[str, Floats]]:
    """Scatter, and the sigma of each stop's mean, by quantity."""
    scatter, sigma = dict[str, Scatter](), dict[str, Floats]()
    for kind in stops[0].residuals:
        of = [stop.residuals[kind] for stop in stops]
        tau = correlation_time(of)
        sigma[kind] = sigmas_of_means(of, tau)
        single, mean = np.median([r.std(axis=0) for r in of], axis=0), np.median(sigma[kind], axis=0)
        slow = bool(tau > MAX_TIME_SHARE * np.median([len(r) for r in of]))
        scatter[kind] = Scatter(float(single.max()), float(mean.max()), tau, slow)
    return scatter, sigma


# --- means of correlated samples --------------------------------------------------------------------------------------


def correlation_time(residuals: Sequence[Floats]) -> float:
    """Integrated autocorrelation time of noise over a stop, in samples, at least 1.

    Noise is white and AR(1) together, by maximum likelihood of the steps from sample to sample, which do not depend on
    a stop's mean. It is white where correlation gains too little likelihood (`MIN_GAIN`).

    Args:
        residuals: Of each stop, minus its mean, shape (n, k).
    """
    scales = [np.sqrt(np.mean(np.diff(r, axis=0) ** 2, axis=0)) for r in residuals]
    scaled = [r / np.where(s > 0.0, s, 1.0) for r, s in zip(residuals, scales, strict=True)]  # stops count alike
    n = int(np.median([len(r) for r in scaled]))
    size = -(-n // MAX_BLOCKS)
    n_blocks = n // size
    whole = [r[: n_blocks * size].reshape(n_blocks, size, -1).mean(axis=1) for r in scaled if len(r) >= n_blocks * size]
    steps = np.diff(np.concatenate(whole, axis=1), axis=0)  # (n_blocks - 1, n_series)
    if n_blocks < 3 or not steps.any():
        return 1.0
    within = np.arange(1 - size, size)
    lags = np.abs(size * np.arange(n_blocks)[:, None] + within)  # between samples of two blocks, (n_blocks, 2 size - 1)

    most = float(np.log(20.0 * n))  # slower noise is indistinguishable from a walk

    def fit(log_time: float, logit: float) -> tuple[float, float]:
        """Twice the negative log-likelihood, and the variance of a stop's mean."""
        white, time = 1.0 / (1.0 + np.exp(-logit)), 1.0 + np.exp(min(log_time, most))
        rho = np.where(lags == 0, 1.0, (1.0 - white) * ((time - 1.0) / (time + 1.0)) ** lags)
        V = toeplitz(rho @ (size - np.abs(within)) / size**2)
        L = np.linalg.cholesky(np.diff(np.diff(V, axis=0), axis=1))
        misfit = float(np.sum(np.linalg.solve(L, steps) ** 2))
        cost = 2.0 * steps.shape[1] * np.log(np.diag(L)).sum() + steps.size * np.log(misfit)
        return cost, float(V.mean()) * misfit / steps.size

    def cost(x: Floats) -> float:
        return fit(*x)[0]

    (least, of_mean), white = fit(*brute(cost, ((-2.0, most), (-6.0, 4.0)), Ns=8)), fit(0.0, 50.0)
    if white[0] - least < MIN_GAIN:
        of_mean = white[1]
    square = float(np.mean(np.concatenate(scaled) ** 2))  # of residuals: the variance of the mean is missing in it
    return max(1.0, n * of_mean / (square + of_mean))


def sigmas_of_means(residuals: Sequence[Floats], tau: float) -> Floats:
    """Sigma of each stop's mean of correlated samples, shape (n_stops, k).

    The variance of Student's t, for the scatter is estimated from the same samples: with 2 n tau / (tau^2 + 1) - 1
    degrees of freedom, those of the mean square of AR(1) noise (Bartlett), n - 1 of white noise. The scatter of slow
    noise is that of all stops together, as one stop hardly shows it.

    Args:
        residuals: Of each stop, minus its mean, shape (n, k).
        tau: Integrated autocorrelation time, in samples.
    """
    each = np.array([len(r) for r in residuals], dtype=np.float64)[:, None]
    square = np.array([np.mean(r**2, axis=0) for r in residuals])
    middle = float(np.median(each))
    if tau > MAX_TIME_SHARE * middle:
        variance = square.mean(axis=0) * np.minimum(tau / each, 1.0) / (1.0 - min(tau / middle, 0.99))
    else:
        part = np.minimum(tau / each, 0.5)
        freedom = np.maximum(2.0 * each * tau / (tau**2 + 1.0) - 1.0, 3.0)
        variance = square * part / (1.0 - part) * (freedom / (freedom - 2.0))
    sigma: Floats = np.maximum(np.sqrt(variance), MIN_SIGMA)
    return sigma


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
        **dict(zip(joint_columns(robot), stops.means["joint"].T, strict=True)),
        **dict(zip("xyz", stops.means["position"].T, strict=True)),
    }
    if "orientation" in stops.means:
        quaternion = Rotation.from_matrix(stops.means["orientation"]).as_quat(canonical=True)
        columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True))
    for kind, prefix in (("position", "sigma_"), ("orientation", "sigma_r")):
        if kind in stops.sigmas:
            columns |= {f"{prefix}{axis}": stops.sigmas[kind][:, k] for k, axis in enumerate("xyz")}
    write_csv(path, columns)
