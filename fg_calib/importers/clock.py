"""How far the clock of measured poses is ahead of that of joint readings.

The nominal arm says how the tool moved at each joint reading. Its speed, and how fast it turned, depend on no frame, so
they can be laid over those of the measured poses: the offset at which they correlate best is right to a few
milliseconds. Each move between two stops then gives an offset of its own, by least squares on how far the tool is from
where the move began and where it ends; the scatter of these is the sigma of their mean, so that all that differs from
move to move is counted: noise of poses and stamps, and the error of the nominal arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import ndtr, stdtrit

from fg_calib.arrays import Floats
from fg_calib.errors import InputError
from fg_calib.importers.recording import PoseStream, period

LEAST_CORRELATION = 0.7
"""Below it the poses are not those of the arm's tool."""

_LEAST_MOVES = 2
_MOST_GRID = 2**20
_SMALLEST_MOVE = {"position": 5e-3, "orientation": 5e-3}
"""Moves below it, [m] and [rad], say little of time."""


@dataclass(frozen=True)
class ClockOffset:
    """The stamp of a pose less that of the joint reading of the same moment.

    Attributes:
        seconds: The offset, [s].
        sigma: Its 1 sigma, from the scatter from move to move, [s].
        n_moves: Moves that it is the mean of.
        correlation: Of the tool's speed by the joints with that by the poses.
        others: Offsets that fit nearly as well, as where motions repeat themselves, [s].
    """

    seconds: float
    sigma: float
    n_moves: int
    correlation: float
    others: tuple[float, ...] = ()


def estimate_offset(tool: PoseStream, poses: PoseStream, stops: Sequence[tuple[float, float]]) -> ClockOffset:
    """The offset of the poses' clock, [s].

    Args:
        tool: The nominal arm's tool at the joint readings.
        poses: The measured poses, in any frame.
        stops: Beginning and end of each standstill by the joints' clock, [s], in order of time.

    Raises:
        InputError: The poses do not follow the joints, or there are not enough moves between stops.
    """
    expected = tool.source.lag - poses.source.lag
    coarse, correlation, others = _align_speeds(tool, poses, expected)
    if correlation < LEAST_CORRELATION:
        raise InputError(
            f"topics {tool.source.topic} and {poses.source.topic}",
            f"the poses do not move as the joints do (correlation {correlation:.2f})",
            "poses of this robot's tool",
            "or state the offset of the clocks: --offset 0",
        )
    offsets, weights = _offsets_of_moves(tool, poses, stops, coarse)
    if len(offsets) < _LEAST_MOVES:
        found = f"{len(offsets)} moves between stops that tell the offset of the clocks"
        raise InputError(
            f"topics {tool.source.topic} and {poses.source.topic}", found, f"at least {_LEAST_MOVES}", "see --offset"
        )
    mean, sigma = _weighted_mean(offsets, weights)
    return ClockOffset(mean, sigma, len(offsets), correlation, others)


def _weighted_mean(offsets: Floats, weights: Floats) -> tuple[float, float]:
    """Weighted mean, and its sigma from the scatter whatever the weights are (sandwich estimate).

    Student's: of a few moves the scatter is hardly known, so half the interval that holds 68 % is wider.
    """
    mean = float(np.average(offsets, weights=weights))
    n = len(offsets)
    variance = n / (n - 1) * np.sum((weights * (offsets - mean)) ** 2) / np.sum(weights) ** 2
    return mean, float(np.sqrt(variance) * stdtrit(n - 1, ndtr(1.0)))


def _align_speeds(tool: PoseStream, poses: PoseStream, expected: float) -> tuple[float, float, tuple[float, ...]]:
    """Offset at which the speeds correlate best, [s], their correlation, and other offsets that fit nearly as well.

    Args:
        tool: The tool by the joints.
        poses: The tool as measured.
        expected: The offset by times of receipt, [s]: where several fit, the nearest to it is taken.
    """
    step = max(period(tool.time), period(poses.time), 0.01)
    span = max(np.ptp(tool.time), np.ptp(poses.time))
    step = max(step, float(span) / _MOST_GRID)
    best = (np.zeros(1), np.full(1, -1.0))
    for kind in _kinds(tool, poses):
        lags, correlation = _correlate(_speed(tool, kind, step), _speed(poses, kind, step))
        if correlation.max() > best[1].max():
            best = (lags * step + (poses.time[0] - tool.time[0]), correlation)
    lags, correlation = best
    inner = correlation[1:-1]
    peaks = np.flatnonzero((inner >= correlation[:-2]) & (inner > correlation[2:])) + 1
    top = float(correlation.max())
    peaks = peaks[1.0 - correlation[peaks] <= 1.5 * (1.0 - top) + 0.01]
    if not len(peaks):
        return float(lags[np.argmax(correlation)]), top, ()
    chosen = peaks[np.argmin(np.abs(lags[peaks] - expected))]
    main = np.abs(lags[peaks] - lags[chosen]) < 0.5  # ripples of the same peak
    chosen = peaks[main][np.argmax(correlation[peaks[main]])]
    return float(lags[chosen]), float(correlation[chosen]), tuple(float(x) for x in lags[peaks[~main]])


def _kinds(tool: PoseStream, poses: PoseStream) -> tuple[str, ...]:
    return ("position",) if tool.rotation is None or poses.rotation is None else ("position", "orientation")


def _values(stream: PoseStream, kind: str) -> Floats:
    """Positions, shape (n, 3), or rotation matrices over sqrt(2), shape (n, 9): their distances are small angles."""
    if kind == "position" or stream.rotation is None:
        return stream.position
    rows: Floats = stream.rotation.reshape(-1, 9) / np.sqrt(2.0)
    return rows


def _speed(stream: PoseStream, kind: str, step: float) -> Floats:
    """Speed on a grid of this step that begins with the stream, shape (n,), [m/s] or [rad/s]."""
    width = max(0.1, 4.0 * step)
    grid = np.arange(stream.time[0], stream.time[-1], step)
    values = _values(stream, kind)
    moved = [
        np.interp(grid + width / 2, stream.time, column) - np.interp(grid - width / 2, stream.time, column)
        for column in values.T
    ]
    speed: Floats = np.linalg.norm(moved, axis=0) / width
    return speed


def _correlate(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Lags of b behind a in samples, and the correlation coefficient of what overlaps at each; -1 where little does."""
    size = 1 << (len(a) + len(b)).bit_length()

    def products(x: Floats, y: Floats) -> Floats:
        """Sums over i of x[i] y[i + lag], lags from 1 - len(a) to len(b) - 1."""
        found = np.fft.irfft(np.conj(np.fft.rfft(x, size)) * np.fft.rfft(y, size), size)
        return np.concatenate([found[size - len(a) + 1 :], found[: len(b)]])

    a, b = a - a.mean(), b - b.mean()
    one_a, one_b = np.ones_like(a), np.ones_like(b)
    n = np.maximum(np.round(products(one_a, one_b)), 1.0)
    mean_a, mean_b = products(a, one_b) / n, products(one_a, b) / n
    variance = (products(a * a, one_b) / n - mean_a**2) * (products(one_a, b * b) / n - mean_b**2)
    covariance = products(a, b) / n - mean_a * mean_b
    least = 1e-6 * a.var() * b.var()
    good = (n >= 0.5 * min(len(a), len(b))) & (variance > least) & (least > 0.0)
    correlation = np.where(good, covariance / np.sqrt(np.where(good, variance, 1.0)), -1.0)
    return np.arange(1 - len(a), len(b)).astype(np.float64), correlation


def _offsets_of_moves(
    tool: PoseStream, poses: PoseStream, stops: Sequence[tuple[float, float]], coarse: float
) -> tuple[Floats, Floats]:
    """The offset that each move gives, [s], and its weight; without moves that are far off all others."""
    kinds = _kinds(tool, poses)
    fits: dict[str, dict[int, _Fit]] = {kind: {} for kind in kinds}
    for kind in kinds:
        for k, (before, after) in enumerate(pairwise(stops)):
            fit = _fit_move(tool, poses, kind, before, after, coarse)
            if fit is not None:
                fits[kind][k] = fit
    offsets, weights = [], []
    variance = {kind: np.mean([f.variance for f in fits[kind].values()]) if fits[kind] else 1.0 for kind in kinds}
    for k in range(len(stops) - 1):
        found = [
            (fits[kind][k].offset, fits[kind][k].information / max(float(variance[kind]), 1e-18))
            for kind in kinds
            if k in fits[kind]
        ]
        if found:
            offset, information = np.transpose(found)
            offsets.append(np.average(offset, weights=information))
            weights.append(information.sum())
    delta, weight = np.array(offsets), np.array(weights)
    if len(delta):
        off = np.abs(delta - np.median(delta))
        good = off <= 5.0 * 1.4826 * np.median(off) + 1e-6
        delta, weight = delta[good], weight[good]
    return delta, weight


@dataclass(frozen=True)
class _Fit:
    """Offset of one move, [s], squared slopes summed, [1/s^2], and the mean square of what is left."""

    offset: float
    information: float
    variance: float


_MARGIN = 0.2
"""Of the stops around a move this much belongs to it, [s]."""


def _fit_move(
    tool: PoseStream, poses: PoseStream, kind: str, before: tuple[float, float], after: tuple[float, float],
    coarse: float,
) -> _Fit | None:  # fmt: skip
    """Least squares of the offset on one move; None where it moves too little or was not seen."""
    begin, end = before[1] - _MARGIN, after[0] + _MARGIN
    predicted = _progress(tool, kind, before, after, (begin - 1.0, end + 1.0), 0.0)
    seen = _progress(poses, kind, before, after, (begin, end), coarse)
    if predicted is None or seen is None or len(seen[0]) < 10 or np.diff(seen[0]).max() > 0.25 * (end - begin):
        return None
    slope = np.gradient(predicted[1], predicted[0], axis=0)  # (n, 2)
    offset = coarse
    for _ in range(20):
        at = seen[0] - offset
        left = seen[1] - _interpolate(at, predicted[0], predicted[1])
        g = _interpolate(at, predicted[0], slope)
        information = float(np.sum(g * g))
        if information == 0.0:
            return None
        change = -float(np.sum(g * left)) / information
        offset += change
        if abs(offset - coarse) > 0.5 * (end - begin):
            return None
        if abs(change) < 1e-7:
            return _Fit(offset, information, float(np.mean(left**2)))
    return None


def _progress(
    stream: PoseStream, kind: str, before: tuple[float, float], after: tuple[float, float],
    within: tuple[float, float], offset: float,
) -> tuple[Floats, Floats] | None:  # fmt: skip
    """Times, shape (n,), and distances from where a move began and from where it ends, shape (n, 2), over its length.

    None where the stops were not seen, or are one place. Times are the stream's; all that is given is the joints'.
    """
    values = _values(stream, kind)
    ends = []
    for stop in (before, after):
        a, b = np.searchsorted(stream.time, np.asarray(stop) + offset)
        if b - a < 3:
            return None
        ends.append(values[a:b].mean(axis=0))
    length = np.linalg.norm(ends[1] - ends[0])
    a, b = np.searchsorted(stream.time, np.asarray(within) + offset)
    if length < _SMALLEST_MOVE[kind] or b - a < 3:
        return None
    far = np.linalg.norm(values[a:b, None, :] - np.stack(ends), axis=2) / length
    return stream.time[a:b], far


def _interpolate(at: Floats, time: Floats, values: Floats) -> Floats:
    return np.stack([np.interp(at, time, column) for column in values.T], axis=-1)
