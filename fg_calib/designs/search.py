"""Search for a good set of candidates: greedy choice, exchange, and the order in which to visit them.

Exchange takes out one of the chosen at a time and puts in the best candidate in its place (Fedorov 1972; Mitchell
1974). It ends where a sweep over all chosen gains less than `MIN_GAIN`. It starts from the best of sets that are chosen
greedily and of random ones.

References:
    Fedorov (1972), Theory of Optimal Experiments. Academic Press.
    Mitchell (1974), An algorithm for the construction of D-optimal experimental designs. Technometrics 16(2).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.information import System
from fg_calib.inputs import Floats, Integers, Record
from fg_calib.robot import Robot

MAX_SWEEPS = 10
"""Largest number of sweeps of an exchange."""

MIN_GAIN = 1e-3
"""Share of the criterion that a sweep must gain for another one."""

_ROUNDING = 1e-12
"""Share of the criterion that an exchange must gain: less may be rounding."""

N_RANDOM, N_RANDOM_EXACT = 100, 20
"""Number of random sets that a design is compared with; where the error of each takes a posterior of its own."""

N_STARTS, SMALL_PROBLEM = 2, 5_000
"""Sets that exchange starts from, and poses times candidates times starts up to which it starts from more."""

MAX_POSES = 500
"""Largest number of poses with which a target is sought."""

UNKNOWN_SHARE = 1e-9
"""Share of a task that no candidate determines from which its error is unknown."""

MIN_CURVE, N_CURVE = 4, 10
"""Number of poses with which the curve begins, and about the number of its points."""


class CurvePoint(Record):
    """Expected error of a number of poses.

    Attributes:
        n: The number.
        designed: RMS error over the task with as many designed poses, [m].
        random: Errors that 10 %, 50 % and 90 % of random sets of as many poses do not exceed, [m].
    """

    n: int
    designed: float
    random: tuple[float, float, float]


def choose_greedily(measure: Measure, n: int, start: Integers) -> Integers:
    """Choose candidates one after the other, each the best in addition to those before it, and to `start`."""
    system, chosen = measure.system, start.tolist()
    allowed = np.ones(system.n_candidates, dtype=np.bool_)
    allowed[chosen] = False
    while len(chosen) < n:
        k, _ = measure.best(system.information(np.array(chosen, dtype=np.int64)), allowed)
        chosen.append(k)
        allowed[k] = False
    return np.array(chosen[:n], dtype=np.int64)


def exchange(measure: Measure, chosen: Integers, sweeps: int = MAX_SWEEPS) -> Integers:
    """Exchange candidates for better ones, until none is better, in a number of sweeps at most."""
    system, now = measure.system, chosen.copy()
    value, allowed = measure.value(system.information(chosen)), np.ones(system.n_candidates, dtype=np.bool_)
    allowed[now] = False
    for _ in range(sweeps if allowed.any() else 0):
        before = value
        for place in range(len(now)):
            k, found = measure.best(system.information(np.delete(now, place)), allowed)
            if found < value - _ROUNDING * abs(value):
                allowed[now[place]], allowed[k] = True, False
                now[place], value = k, found
        if before - value <= MIN_GAIN * abs(before):
            break
    return now


class Chooser:
    """Choice of candidates from a system; the error is always the one over the task.

    Greedy choice does not see that some poses help only together, as the first lengths to an unknown anchor do. A
    second start therefore minimises the volume of all unknowns, landmarks too.

    Args:
        system: The candidates.
        criterion: Minimised value.
        error: Expected RMS error with some candidates, [m], where the system does not give it; inf if not determined.

    Attributes:
        of_curves: What error curves add to the error, [m].
    """

    of_curves = 0.0

    def __init__(self, system: System, criterion: Criterion, error: Callable[[Integers], float] | None = None) -> None:
        self.system, self._exact = system, error
        self.measure, self._error = Measure(criterion, system), Measure("I", system)
        of_all = Measure("D", replace(system, core=np.eye(system.rows.shape[2])))
        self._orders = [(measure, np.zeros(0, dtype=np.int64)) for measure in (self.measure, of_all)]

    def error(self, chosen: Integers) -> float:
        """Expected RMS error with some candidates, [m]; inf where no candidates determine it."""
        if self.system.unknown > UNKNOWN_SHARE:
            return float("inf")
        if self._exact is not None:
            return self._exact(chosen)
        return float(np.hypot(np.sqrt(self._error.value(self.system.information(chosen))), self.of_curves))

    def value(self, chosen: Integers) -> float:
        """The criterion with some candidates."""
        return self.measure.value(self.system.information(chosen))

    def starts(self, n: int) -> list[Integers]:
        """First sets by greedy choice, the best one first."""
        self._orders = [(m, choose_greedily(m, n, order) if len(order) < n else order) for m, order in self._orders]
        return sorted((order[:n] for _, order in self._orders), key=self.value)

    def best(self, n: int, generator: np.random.Generator) -> Integers:
        """The best n that exchange finds, never worse than the best of some random sets."""
        random = [self._draw(n, generator) for _ in range(N_RANDOM)]
        starts = sorted([*self.starts(n), *random], key=self.value)
        starts = starts[: max(N_STARTS, SMALL_PROBLEM // (n * self.system.n_candidates))]
        found = min((exchange(self.measure, one) for one in starts), key=self.value)
        return found if self._exact is None else min((found, *random[:N_RANDOM_EXACT]), key=self.error)

    def quickly(self, n: int) -> Integers:
        """Nearly as good a set, in a small part of the time."""
        return exchange(self.measure, self.starts(n)[0], sweeps=1)

    def reaching(self, target: float) -> Integers:
        """The fewest poses that reach a target, [m]; as many as allowed where none do."""
        most = min(MAX_POSES, self.system.n_candidates)
        if self.system.unknown > UNKNOWN_SHARE:  # no number of poses would do
            return self.quickly(min(MIN_CURVE, most))
        enough = 1
        while min(map(self.error, self.starts(enough))) > target:
            if enough == most:
                return self.starts(most)[0]
            enough = min(most, enough + max(1, enough // 10))
        chosen = min(self.starts(enough), key=self.error)
        while len(chosen) > 1 and self.error(fewer := self.quickly(len(chosen) - 1)) <= target:
            chosen = fewer
        return chosen

    def _draw(self, n: int, generator: np.random.Generator) -> Integers:
        return generator.choice(self.system.n_candidates, size=n, replace=False).astype(np.int64)

    def curve(self, found: Integers, generator: np.random.Generator, n_references: int) -> tuple[CurvePoint, ...]:
        """Expected errors of fewer poses, and of as many.

        Args:
            found: As many.
            generator: Draws random sets.
            n_references: Number of reference poses, which count too.
        """
        most, points = len(found), []
        numbers = np.round(np.geomspace(MIN_CURVE, max(most + n_references, MIN_CURVE), N_CURVE)).astype(np.int64)
        for k in sorted({n - n_references for n in numbers.tolist() if 0 < n - n_references < most} | {most}):
            n_random = N_RANDOM if self._exact is None else N_RANDOM_EXACT
            random = [self.error(self._draw(k, generator)) for _ in range(n_random)]
            low, middle, high = np.quantile(random, [0.1, 0.5, 0.9], method="nearest").tolist()
            designed = self.error(found if k == most else self.quickly(k))
            points.append(CurvePoint(k + n_references, designed, (low, middle, high)))
        return tuple(points)


# --- the order in which to visit poses ---


def joint_travel(robot: Robot, readings: Floats) -> float:
    """Sum over all steps between configurations, shape (n, n_joints), of the largest joint motion, [rad].

    Motions of prismatic joints count as rotations that move the arm's reach by as much.
    """
    return float(np.sum(np.abs(np.diff(readings * _weights(robot), axis=0)).max(axis=1, initial=0.0)))


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
