"""Recordings: joint readings and poses over time, each by its sender's clock; means of samples with correlated noise.

Of n samples with autocorrelation rho_k the mean of samples of variance s^2 has the variance

    s^2 tau / n,    tau = 1 + 2 sum_k (1 - k / n) rho_k

(integrated autocorrelation time, in samples; Sokal 1997, *Monte Carlo Methods in Statistical Mechanics*, Sec. 3). tau
is estimated from all standstills together, as one is too short. As s is estimated too, the variance is Student's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fg_calib.arrays import Floats, FrozenArrays
from fg_calib.robot.kinematics import build_chain, forward
from fg_calib.robot.model import Robot

LEAST_SIGMA = 1e-6
"""Of a mean, [m] or [rad]: poses without any scatter are not exact either."""

_WINDOW = 3.0
"""Autocorrelations are summed up to so many times the time itself."""

_BLOCKS = 64
"""Blocks at most that a stop is averaged in where its slow noise is looked for."""

_WHITE = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98)
"""Shares of white noise that are tried."""

_MUCH = 1.5
"""How much more slow noise must say than the sum, which holds for noise of any shape that ends within a stop."""

_BETTER = 12.0
"""What slow noise must gain in twice the logarithm of the likelihood: white noise alone gains it once in 400 times."""


@dataclass(frozen=True)
class Source:
    """Where a stream is from.

    Attributes:
        topic: Its topic.
        kind: Type of its messages.
        lag: Median of the time of receipt less the stamp, [s]: latency, and how far the two clocks are apart.
        notes: What was left out or mended, in words.
    """

    topic: str
    kind: str
    lag: float = 0.0
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
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

    def tool_path(self, robot: Robot) -> PoseStream:
        """The tool's poses at the readings, of the nominal robot in its base frame."""
        trig = robot.trig(self.readings)
        poses = forward(build_chain(robot, {}), trig)
        return PoseStream(self.time, poses.position, poses.rotation, self.source)


@dataclass(frozen=True)
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


# --- means of correlated samples --------------------------------------------------------------------------------------


def correlation_time(residuals: Sequence[Floats]) -> float:
    """Integrated autocorrelation time of noise, in samples, at least 1.

    The autocovariance of what is left of a stop after its mean is too small by about the variance v of that mean, which
    is therefore added: v = A / (1 - B) with the sums A of the covariances and B of ones up to the lag where the sum
    ends. That lag is the first beyond three times the time itself (Sokal's window). Where there is none within half a
    stop, or where that says much more, noise is white and AR(1) together: `_time_of_white_and_slow`.

    Args:
        residuals: Of each stop, less its mean, shape (n, k).
    """
    steps = [np.sqrt(np.mean(np.diff(r, axis=0) ** 2, axis=0)) for r in residuals]
    scaled = [r / np.where(s > 0.0, s, 1.0) for r, s in zip(residuals, steps, strict=True)]  # stops count alike
    n = int(np.median([len(r) for r in scaled]))
    longest = n // 2
    products = np.zeros(longest + 1)
    counts = np.zeros(longest + 1)
    for r in scaled:
        size = 1 << (2 * len(r)).bit_length()
        spectrum = np.abs(np.fft.rfft(r, size, axis=0)) ** 2
        here = min(longest + 1, len(r))
        products[:here] += np.fft.irfft(spectrum, size, axis=0)[:here].sum(axis=1)
        counts[:here] += (len(r) - np.arange(here)) * r.shape[1]
    if products[0] <= 0.0:
        return 1.0
    covariance = products / np.maximum(counts, 1.0)
    weight = np.append(1.0, 2.0 * (1.0 - np.arange(1, longest + 1) / n))
    total, ones = np.cumsum(weight * covariance), np.cumsum(weight) / n
    of_mean = total / n / np.maximum(1.0 - ones, 0.1)
    tau = np.maximum(n * of_mean / (covariance[0] + of_mean), 1.0)
    over = np.arange(longest + 1) >= _WINDOW * tau
    slow = _time_of_white_and_slow(scaled, n, float(covariance[0]))
    if not over.any():
        return max(slow, n / (2.0 * _WINDOW))
    fast = float(tau[np.argmax(over)])
    return slow if slow > _MUCH * fast else fast


def _time_of_white_and_slow(scaled: Sequence[Floats], n: int, square: float) -> float:
    """Integrated time over a stop of n samples where noise is white and AR(1) together; 1 where white alone will do.

    By the likelihood of the steps from sample to sample, which know nothing of a stop's mean, on a grid of how much is
    white and how slow the rest is. Long stops are averaged in blocks. What is slower than ten stops cannot be told from
    a walk.

    Args:
        scaled: Of each stop, shape (n_samples, k).
        n: Samples of a stop.
        square: Mean square of the residuals.
    """
    size = -(-n // _BLOCKS)
    length = n // size
    whole = [r[: length * size].reshape(length, size, -1).mean(axis=1) for r in scaled if len(r) >= length * size]
    steps = np.diff(np.concatenate(whole, axis=1), axis=0)  # (length - 1, n_series)
    lags = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    best, found = np.inf, 1.0
    for time in np.geomspace(1.0, 20.0 * length, 30):
        slow = ((time - 1.0) / (time + 1.0)) ** lags
        for share in _WHITE if time > 1.0 else (1.0,):
            V = share * np.eye(length) + (1.0 - share) * slow
            L = np.linalg.cholesky(np.diff(np.diff(V, axis=0), axis=1))
            misfit = float(np.sum(np.linalg.solve(L, steps) ** 2))
            cost = 2.0 * steps.shape[1] * np.log(np.diag(L)).sum() + steps.size * np.log(max(misfit, 1e-300))
            if time == 1.0:
                best = cost - _BETTER  # of white noise alone
            elif cost < best:
                best, of_mean = cost, float(V.mean()) * misfit / steps.size
                found = n * of_mean / (square + of_mean)
    return found


def is_slow(tau: float, n: float) -> bool:
    """Whether noise is correlated over so much of a stop of n samples that averaging it is not worth counting."""
    return tau > n / (2.0 * _WINDOW)


def sigmas_of_means(residuals: Sequence[Floats], tau: float) -> Floats:
    """Sigma of each stop's mean of correlated samples, shape (n_stops, k).

    The variance of Student's t, for the scatter is estimated from the same samples: with 2 n tau / (tau^2 + 1) - 1
    degrees of freedom, those of the mean square of AR(1) noise (Bartlett), n - 1 of white noise. Of slow noise a stop
    hardly shows the scatter, which is then that of all stops together.

    Args:
        residuals: Of each stop, less its mean, shape (n, k).
        tau: Integrated autocorrelation time, in samples.
    """
    each = np.array([len(r) for r in residuals], dtype=np.float64)[:, None]
    square = np.array([np.mean(r**2, axis=0) for r in residuals])
    middle = float(np.median(each))
    if is_slow(tau, middle):
        variance = square.mean(axis=0) * np.minimum(tau / each, 1.0) / (1.0 - tau / middle)
    else:
        part = np.minimum(tau / each, 0.5)
        freedom = np.maximum(2.0 * each * tau / (tau**2 + 1.0) - 1.0, 3.0)
        variance = square * part / (1.0 - part) * (freedom / (freedom - 2.0))
    sigma: Floats = np.maximum(np.sqrt(variance), LEAST_SIGMA)
    return sigma
