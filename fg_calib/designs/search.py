"""Search for a good set of candidates: greedy choice, exchange, and the order in which to visit them.

Greedy choice and exchange look at all candidates at every step, by updates of rank h (see `criteria`). Exchange takes
out one of the chosen at a time and puts in the best candidate in its place (Fedorov 1972; Mitchell 1974). It ends where
a sweep over all chosen gains less than `MIN_GAIN`.

References:
    Fedorov (1972), Theory of Optimal Experiments. Academic Press.
    Mitchell (1974), An algorithm for the construction of D-optimal experimental designs. Technometrics 16(2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.information import System
from fg_calib.inputs import Floats, FrozenArrays, Integers
from fg_calib.robot import Robot

MAX_SWEEPS = 10
"""Largest number of sweeps of an exchange."""

MIN_GAIN = 1e-3
"""Share of the criterion that a sweep must gain for another one."""

SHORTLIST = 500
"""Number of candidates that exchange looks at first: those that would help most."""

_ROUNDING = 1e-12
"""Share of the criterion that an exchange must gain: less may be rounding."""

N_RANDOM = 100
"""Number of random sets that a design is compared with: exchange starts from one that is better."""

SMALL_PROBLEM = 40_000
"""Poses times candidates up to which exchange starts from random sets too: from all of them at a hundredth."""

MAX_POSES = 500
"""Largest number of poses with which a target is sought."""

UNKNOWN_SHARE = 1e-9
"""Share of a task that no candidate determines from which its error is unknown."""

N_EXACT = 20
"""Number of random sets where each takes a posterior of its own."""

MIN_CURVE = 4
"""Number of poses with which the curve begins."""

N_CURVE = 10
"""Number of points of the curve, about."""


@dataclass(frozen=True)
class Chosen(FrozenArrays):
    """Candidates that were chosen.

    Attributes:
        candidates: In the order in which they were taken, shape (n,).
        value: The criterion with all of them; smaller is better.
    """

    candidates: Integers
    value: float


@dataclass(frozen=True)
class CurvePoint:
    """Expected error of a number of poses.

    Attributes:
        n: The number.
        designed: RMS error over the task with as many designed poses, [m].
        random: Errors that 10 %, 50 % and 90 % of random sets of as many poses do not exceed, [m].
    """

    n: int
    designed: float
    random: tuple[float, float, float]


def choose_greedily(measure: Measure, n: int, start: Integers | None = None) -> Integers:
    """Choose candidates one after the other, each the best in addition to those before it."""
    system = measure.system
    chosen = [] if start is None else start.tolist()
    allowed = np.ones(system.n_candidates, dtype=np.bool_)
    allowed[chosen] = False
    information = system.information(np.array(chosen, dtype=np.int64))
    while len(chosen) < min(n, system.n_candidates):
        k, _ = measure.best(information, allowed)
        chosen.append(k)
        allowed[k] = False
        information = information + system.rows[k].T @ system.rows[k]
    return np.array(chosen[:n], dtype=np.int64)


def exchange(measure: Measure, chosen: Integers, *, quickly: bool = False) -> Chosen:
    """Exchange candidates for better ones, until none is better.

    Most exchanges are among the few candidates that would help most now: these are tried first, then all.

    Args:
        measure: The criterion.
        chosen: The first set.
        quickly: Whether only these few are tried.
    """
    system = measure.system
    now, value = chosen.copy(), measure.value(system.information(chosen))
    if len(chosen) >= system.n_candidates:
        return Chosen(now, value)
    for _ in range(MAX_SWEEPS):
        before = value
        if system.n_candidates > 2 * SHORTLIST:
            short = np.union1d(measure.most_helpful(system.information(now), SHORTLIST), now)
            some = Measure(measure.criterion, system.select(short))
            for _ in range(MAX_SWEEPS):
                last = value
                places, value = _sweep(some, np.searchsorted(short, now), value)
                now = short[places]
                if last - value <= MIN_GAIN * abs(last):
                    break
            if quickly:
                break
        now, value = _sweep(measure, now, value)
        if before - value <= MIN_GAIN * abs(before):
            break
    return Chosen(now, measure.value(system.information(now)))


def _sweep(measure: Measure, chosen: Integers, value: float) -> tuple[Integers, float]:
    """Exchange each of the chosen once for the best candidate in its place, where that is better."""
    system, now = measure.system, chosen.copy()
    allowed = np.ones(system.n_candidates, dtype=np.bool_)
    allowed[now] = False
    for place in range(len(now)):
        better = value - _ROUNDING * abs(value)
        k, found = measure.best(system.information(np.delete(now, place)), allowed, better)
        if k >= 0:
            allowed[now[place]], allowed[k] = True, False
            now[place], value = k, found
    return now, value


def draw_sets(
    measure: Measure, n: int, generator: np.random.Generator, count: int = N_RANDOM
) -> tuple[Floats, Integers]:
    """Draw random sets of n: the criterion, ascending, shape (count,), and the sets, shape (count, n)."""
    system = measure.system
    sets = np.array([generator.choice(system.n_candidates, size=n, replace=False) for _ in range(count)])
    values = np.array([measure.value(system.information(one)) for one in sets])
    order = np.argsort(values, kind="stable")
    return values[order], sets[order].astype(np.int64)


def improve_by_random_starts(measure: Measure, found: Chosen, generator: np.random.Generator) -> Chosen:
    """Take what exchange makes of random sets, where that is better.

    Of large pools exchange starts from the best random set alone, and only if that is better. Of small ones, where a
    set that no single exchange improves may be far from the best, it starts from several.
    """
    n, of = len(found.candidates), measure.system.n_candidates
    values, sets = draw_sets(measure, n, generator)
    starts = sets[: SMALL_PROBLEM // (n * of)]
    if not len(starts) and values[0] < found.value:
        starts = sets[:1]
    return min((found, *(exchange(measure, one) for one in starts)), key=lambda one: one.value)


class Chooser:
    """Choice of candidates from a system; the error is always the one over the task.

    Greedy choice does not see that some poses help only together, as the first lengths to an unknown anchor do. A
    second start therefore minimises the volume of all unknowns, landmarks too.

    Args:
        system: The candidates.
        criterion: What is minimised.
        error: Expected RMS error with some candidates, [m], where the system does not give it; inf if not determined.
    """

    def __init__(self, system: System, criterion: Criterion, error: Callable[[Integers], float] | None = None) -> None:
        self.system, self.criterion, self._exact = system, criterion, error
        self.measure = Measure(criterion, system)
        self._error = Measure("I", system)
        of_all = Measure("D", replace(system, core=np.eye(system.rows.shape[2])))
        self._orders = [(measure, np.zeros(0, dtype=np.int64)) for measure in (self.measure, of_all)]

    def error(self, chosen: Integers) -> float:
        """Expected RMS error with some candidates, [m]; inf where no candidates determine it."""
        if self.system.unknown > UNKNOWN_SHARE:
            return float("inf")
        if self._exact is not None:
            return self._exact(chosen)
        return float(np.sqrt(self._error.value(self.system.information(chosen))))

    def _value(self, candidates: Integers) -> float:
        return self.measure.value(self.system.information(candidates))

    def starts(self, n: int) -> list[Integers]:
        """First sets by greedy choice, the best one first."""
        self._orders = [(m, choose_greedily(m, n, order) if len(order) < n else order) for m, order in self._orders]
        return sorted((order[:n] for _, order in self._orders), key=self._value)

    def best(self, n: int) -> Chosen:
        """The best n that exchange finds."""
        return min((exchange(self.measure, one) for one in self.starts(n)), key=lambda chosen: chosen.value)

    def thoroughly(self, n: int, generator: np.random.Generator) -> Chosen:
        """The best n that exchange finds, never worse than the best of some random sets."""
        found = improve_by_random_starts(self.measure, self.best(n), generator)
        if self._exact is None or self.system.unknown > UNKNOWN_SHARE:
            return found
        sets = [self._draw(n, generator) for _ in range(N_EXACT)]
        best = min((found.candidates, *sets), key=self._exact)
        return Chosen(best, self._value(best))

    def quickly(self, n: int) -> Chosen:
        """Nearly as good a set, in a small part of the time."""
        return exchange(self.measure, self.starts(n)[0], quickly=True)

    def reaching(self, target: float, generator: np.random.Generator) -> Chosen:
        """As few as reach a target, [m]; as many as allowed where none do."""
        most = min(MAX_POSES, self.system.n_candidates)
        if self.system.unknown > UNKNOWN_SHARE:  # no number of poses would do
            return self.best(min(MIN_CURVE, most))
        enough = 1
        while min(map(self.error, self.starts(enough))) > target:
            if enough == most:
                return Chosen(self.starts(most)[0], np.inf)
            enough = min(most, enough + max(1, enough // 10))
        chosen = min(self.starts(enough), key=self.error)
        while len(chosen) > 1:
            fewer = self.quickly(len(chosen) - 1).candidates
            if self.error(fewer) > target:
                break
            chosen = fewer
        return Chosen(chosen, self._value(chosen))

    def _draw(self, n: int, generator: np.random.Generator) -> Integers:
        return generator.choice(self.system.n_candidates, size=n, replace=False).astype(np.int64)

    def curve(self, found: Chosen, generator: np.random.Generator, n_references: int) -> tuple[CurvePoint, ...]:
        """Expected errors of fewer poses, and of as many.

        Args:
            found: As many.
            generator: Draws random sets.
            n_references: Number of reference poses, which count too.
        """
        most = len(found.candidates)
        numbers = np.round(np.geomspace(MIN_CURVE, max(most + n_references, MIN_CURVE), N_CURVE)).astype(np.int64)
        points = []
        for k in sorted({n - n_references for n in numbers.tolist() if 0 < n - n_references < most} | {most}):
            chosen = found.candidates if k == most else self.quickly(k).candidates
            points.append(CurvePoint(k + n_references, self.error(chosen), self._band(k, generator)))
        return tuple(points)

    def _band(self, n: int, generator: np.random.Generator) -> tuple[float, float, float]:
        """Errors that a tenth, half and nine tenths of random sets of n do not exceed."""
        if self.system.unknown > UNKNOWN_SHARE:
            return (float("inf"),) * 3
        if self._exact is None:
            errors = np.sqrt(draw_sets(self._error, n, generator)[0])
        else:
            errors = np.array([self._exact(self._draw(n, generator)) for _ in range(N_EXACT)])
        low, middle, high = np.quantile(errors, [0.1, 0.5, 0.9], method="nearest").tolist()
        return low, middle, high


# --- the order in which to visit poses ---


def joint_travel(robot: Robot, readings: Floats) -> float:
    """Sum over all steps between configurations, shape (n, n_joints), of the largest joint motion, [rad].

    Motions of prismatic joints count as rotations that move the arm's reach by as much.
    """
    steps = np.abs(np.diff(readings * _weights(robot), axis=0))
    return float(np.sum(steps.max(axis=1, initial=0.0)))


def order_by_nearest(robot: Robot, readings: Floats) -> Integers:
    """Order configurations by nearest neighbour, from the one nearest to all others, shape (n,).

    Args:
        robot: The arm.
        readings: The configurations, shape (n, n_joints), [rad] (prismatic: [m]).
    """
    q = readings * _weights(robot)
    n = len(q)
    if n < 3:
        return np.arange(n)
    d = np.abs(q[:, None] - q[None]).max(axis=2)
    order = [int(np.argmin(d.sum(axis=1)))]
    while len(order) < n:
        step = d[order[-1]].copy()
        step[order] = np.inf
        order.append(int(np.argmin(step)))
    return np.array(order, dtype=np.int64)


def _weights(robot: Robot) -> Floats:
    return np.array([1.0 / robot.reach if joint.prismatic else 1.0 for joint in robot.joints])
