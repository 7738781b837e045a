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
from scipy.linalg import toeplitz
from scipy.optimize import brute

from fg_calib.inputs import Floats, FrozenArrays
from fg_calib.robot import Robot, build_chain, forward

MIN_SIGMA = 1e-6
"""1 sigma of a mean, at least, [m] or [rad]: poses without any scatter are not exact either."""

MAX_BLOCKS = 64
"""Blocks at most in which the samples of a stop are averaged before their correlation is estimated."""

MIN_GAIN = 12.0
"""Gain in twice the log-likelihood from which noise counts as correlated: white noise reaches it once in 400 times."""

MAX_TIME_SHARE = 1.0 / 6.0
"""Share of a stop that the correlation time may have: averaging slower noise reduces it too little to be relied on."""


@dataclass(frozen=True)
class Source:
    """Where a stream is from.

    Attributes:
        topic: Its topic.
        kind: Type of its messages.
        lag: Median of the time of receipt minus the stamp, [s]: latency, and the offset of the two clocks.
        notes: What was left out or put in order, in words.
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
        poses = forward(build_chain(robot, {}), robot.trig(self.readings))
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


def is_slow(tau: float, n: float) -> bool:
    """Whether noise is correlated over so much of a stop of n samples that its mean's sigma is rough."""
    return tau > MAX_TIME_SHARE * n


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
    if is_slow(tau, middle):
        variance = square.mean(axis=0) * np.minimum(tau / each, 1.0) / (1.0 - min(tau / middle, 0.99))
    else:
        part = np.minimum(tau / each, 0.5)
        freedom = np.maximum(2.0 * each * tau / (tau**2 + 1.0) - 1.0, 3.0)
        variance = square * part / (1.0 - part) * (freedom / (freedom - 2.0))
    sigma: Floats = np.maximum(np.sqrt(variance), MIN_SIGMA)
    return sigma
