"""How far the clock of measured poses is ahead of that of joint readings.

The nominal arm gives the tool's motion at each joint reading. Its speed and angular speed depend on no frame and are
correlated with those of the measured poses: the offset of the highest correlation is right to a few milliseconds. Each
move between two stops then gives an offset, by least squares on the distances from the places where the move began and
ends. The scatter of these offsets is the sigma of their mean, so that noise of poses and stamps, and errors of the
nominal arm, are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import correlate, correlation_lags, find_peaks
from scipy.special import ndtr, stdtrit

from fg_calib.importers.recording import PoseStream, period
from fg_calib.inputs import Floats, InputError

MIN_CORRELATION = 0.7
"""Below it the poses are not those of the arm's tool."""

MIN_MOVES = 2
MIN_MOVE = 5e-3
"""Smaller moves, [m] or [rad], give no offset."""

MARGIN_S = 0.2
"""Part of the stops before and after a move that belongs to it, [s]."""

MAX_GRID = 2**20
"""Samples at most of the speeds that are correlated."""


@dataclass(frozen=True)
class ClockOffset:
    """The stamp of a pose minus that of the joint reading of the same moment.

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
    place = f"topics {tool.source.topic} and {poses.source.topic}"
    coarse, correlation, others = _align_speeds(tool, poses)
    if correlation < MIN_CORRELATION:
        found = f"the poses do not move as the joints do (correlation {correlation:.2f})"
        hint = "or specify the offset of the clocks: --offset 0"
        raise InputError(place, found, "poses of this robot's tool", hint)
    moves = [_fit_move(tool, poses, before, after, coarse) for before, after in pairwise(stops)]
    offsets, weights = np.reshape([move for move in moves if move is not None], (-1, 2)).T
    if len(offsets):
        off = np.abs(offsets - np.median(offsets))
        good = off <= 5.0 * 1.4826 * np.median(off) + 1e-6  # without moves that are far off all others
        offsets, weights = offsets[good], weights[good]
    n = len(offsets)
    if n < MIN_MOVES:
        found = f"{n} moves between stops that show the offset"
        raise InputError(place, found, f"at least {MIN_MOVES}", "see --offset")
    mean = float(np.average(offsets, weights=weights))
    variance = n / (n - 1) * np.sum((weights * (offsets - mean)) ** 2) / np.sum(weights) ** 2  # for any weights
    student = stdtrit(n - 1, ndtr(1.0))  # half the interval of 68 %: of few moves the scatter is hardly known
    return ClockOffset(mean, float(np.sqrt(variance) * student), n, correlation, others)


# --- the coarse offset ------------------------------------------------------------------------------------------------


def _align_speeds(tool: PoseStream, poses: PoseStream) -> tuple[float, float, tuple[float, ...]]:
    """Offset at which the speeds correlate best, [s], their correlation, and other offsets that fit nearly as well.

    Of several that fit, the one nearest to the offset by times of receipt is taken.
    """
    span = max(np.ptp(tool.time), np.ptp(poses.time))
    step = max(period(tool.time), period(poses.time), 0.01, float(span) / MAX_GRID)
    found = [_correlate(*(_speed(stream, values, step) for stream, values in zip((tool, poses), pair, strict=True)))
             for pair in _quantities(tool, poses)]  # fmt: skip
    lags, correlation = max(found, key=lambda of: float(of[1].max()))
    lags = lags * step + (poses.time[0] - tool.time[0])
    top = float(correlation.max())
    peaks, _ = find_peaks(np.concatenate([[-2.0], correlation, [-2.0]]), height=top - 0.5 * (1.0 - top) - 0.01)
    peaks -= 1
    chosen = peaks[np.argmin(np.abs(lags[peaks] - (tool.source.lag - poses.source.lag)))]
    same = np.abs(lags[peaks] - lags[chosen]) < 0.5  # ripples of one peak
    chosen = peaks[same][np.argmax(correlation[peaks[same]])]
    return float(lags[chosen]), float(correlation[chosen]), tuple(lags[peaks[~same]].tolist())


def _quantities(tool: PoseStream, poses: PoseStream) -> list[tuple[Floats, Floats]]:
    """Positions, and rotation matrices over sqrt(2), whose distances are small angles: of the tool and as measured."""
    both = [(tool.position, poses.position)]
    if tool.rotation is not None and poses.rotation is not None:
        both.append((tool.rotation.reshape(-1, 9) / np.sqrt(2.0), poses.rotation.reshape(-1, 9) / np.sqrt(2.0)))
    return both


def _speed(stream: PoseStream, values: Floats, step: float) -> Floats:
    """Speed on a grid of this step that begins with the stream, shape (n,), [m/s] or [rad/s]."""
    width = max(0.1, 4.0 * step)
    grid = np.arange(stream.time[0], stream.time[-1], step)
    moved = _interpolate(grid + width / 2, stream.time, values) - _interpolate(grid - width / 2, stream.time, values)
    speed: Floats = np.linalg.norm(moved, axis=1) / width
    return speed


def _correlate(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Lags of b behind a in samples, and the correlation of what overlaps at each; -1 where little does."""
    a, b = a - a.mean(), b - b.mean()
    one_a, one_b = np.ones_like(a), np.ones_like(b)
    overlap = correlate(one_b, one_a, method="fft")
    energy = correlate(one_b, a * a, method="fft") * correlate(b * b, one_a, method="fft")
    enough = (overlap >= 0.5 * min(len(a), len(b))) & (energy > 1e-6 * np.sum(a * a) * np.sum(b * b))
    correlation = np.where(enough, correlate(b, a, method="fft") / np.sqrt(np.where(enough, energy, 1.0)), -1.0)
    return correlation_lags(len(b), len(a)).astype(np.float64), correlation


# --- moves ------------------------------------------------------------------------------------------------------------


def _fit_move(
    tool: PoseStream, poses: PoseStream, before: tuple[float, float], after: tuple[float, float], coarse: float
) -> tuple[float, float] | None:
    """Offset by positions and by orientations on one move, and its weight; None where neither shows the move."""
    time = poses.time - coarse
    found = [_fit(tool.time, a, time, b, before, after) for a, b in _quantities(tool, poses)]
    fits = [fit for fit in found if fit is not None]
    if not fits:
        return None
    offsets, weights = np.transpose(fits)
    return coarse + float(np.average(offsets, weights=weights)), float(weights.sum())


def _fit(
    tool_time: Floats, tool: Floats, time: Floats, values: Floats, before: tuple[float, float],
    after: tuple[float, float],
) -> tuple[float, float] | None:  # fmt: skip
    """Least squares of the offset on one move by one quantity, and its weight: information over the mean square.

    Compared are the distances from where the move began and from where it ends, over its length. None where the tool
    moves too little or was not seen.
    """
    begin, end = before[1] - MARGIN_S, after[0] + MARGIN_S
    inside = slice(*np.searchsorted(time, (begin, end)))
    seen, measured = time[inside], values[inside]
    tool_ends, ends = _ends(tool_time, tool, before, after), _ends(time, values, before, after)
    if tool_ends is None or ends is None or len(seen) < 10 or np.diff(seen).max() > 0.25 * (end - begin):
        return None

    def residual(offset: Floats) -> Floats:
        predicted = _interpolate(seen - offset, tool_time, tool)
        return (_progress(predicted, tool_ends) - _progress(measured, ends)).ravel()

    found: Any = least_squares(residual, 0.0, method="lm", x_scale=1e-3)
    if not found.success or abs(found.x[0]) > 0.5 * (end - begin):
        return None
    return float(found.x[0]), float(np.sum(found.jac**2)) / max(float(np.mean(found.fun**2)), 1e-18)


def _ends(time: Floats, values: Floats, before: tuple[float, float], after: tuple[float, float]) -> Floats | None:
    """Means at the stops before and after a move, shape (2, k); None where they were not seen, or are one place."""
    stops = [values[slice(*np.searchsorted(time, stop))] for stop in (before, after)]
    if min(map(len, stops)) < 3:
        return None
    ends = np.stack([stop.mean(axis=0) for stop in stops])
    return ends if np.linalg.norm(ends[1] - ends[0]) >= MIN_MOVE else None


def _progress(values: Floats, ends: Floats) -> Floats:
    """Distances from both ends of a move over its length, shape (n, 2)."""
    far: Floats = np.linalg.norm(values[:, None] - ends, axis=2) / np.linalg.norm(ends[1] - ends[0])
    return far


def _interpolate(at: Floats, time: Floats, values: Floats) -> Floats:
    return np.stack([np.interp(at, time, column) for column in values.T], axis=-1)
