"""Chooses stops from a system: so many, or as few as reach a target; and what to expect of how many."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.search import Chosen, exchanged, greedy, not_worse_than_random, random_values
from fg_calib.designs.system import System

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_STOPS = 500
"""Stops up to which a design is sought that reaches a target."""

UNKNOWN = 1e-9
"""Share of a task that no candidate determines from which its error is unknown."""

N_EXACT = 20
"""Random sets where each takes a posterior of its own."""

LEAST_CURVE = 4
"""Stops with which the curve begins."""

MOST_FEWER = 4
"""How many stops less than were found quickly are tried for a target at most, each time that less will do."""

N_CURVE = 10
"""Numbers of stops at which the curve is worked out, about."""


@dataclass(frozen=True)
class CurvePoint:
    """What is to be expected of a number of stops.

    Attributes:
        n: How many.
        designed: RMS error over the task with as many designed ones, [m].
        random: The same of random ones: a tenth of them is better than the first, half than the second, a tenth worse
            than the third, [m].
    """

    n: int
    designed: float
    random: tuple[float, float, float]


class Chooser:
    """Chooses from a system; the error is always that over the task.

    Greedy choice does not see that some stops help only together, as the first lengths to an anchor that is unknown do:
    that by the volume of everything unknown, what is beside the arm too, is another start.

    Args:
        system: What is chosen from.
        criterion: By which criterion.
        error: Expected RMS error with some candidates, [m], where the system does not say it; inf if not determined.
    """

    def __init__(self, system: System, criterion: Criterion, error: Callable[[Integers], float] | None = None) -> None:
        self.system, self.criterion, self._exact = system, criterion, error
        self.measure = Measure(criterion, system)
        self._error = Measure("I", system)
        of_all = Measure("D", replace(system, core=np.eye(system.rows.shape[2])))
        self._orders = [(measure, np.zeros(0, dtype=np.int64)) for measure in (self.measure, of_all)]

    def error(self, chosen: Integers) -> float:
        """Expected RMS error with some candidates, [m]; inf where no candidates determine it."""
        if self.system.unknown > UNKNOWN:
            return float("inf")
        if self._exact is not None:
            return self._exact(chosen)
        return float(np.sqrt(self._error.value(self.system.information(chosen))))

    def starts(self, n: int) -> list[Integers]:
        """What greedy choice takes first, the best start first."""
        self._orders = [(m, greedy(m, n, order) if len(order) < n else order) for m, order in self._orders]
        found = [order[:n] for _, order in self._orders]
        return sorted(found, key=lambda one: self.measure.value(self.system.information(one)))

    def best(self, n: int) -> Chosen:
        """The best n that exchange finds."""
        return min((exchanged(self.measure, one) for one in self.starts(n)), key=lambda chosen: chosen.value)

    def thoroughly(self, n: int, generator: np.random.Generator) -> Chosen:
        """The best n that exchange finds, never worse than the best of the random sets that they are held to."""
        return self.held(not_worse_than_random(self.measure, self.best(n), generator), generator)

    def quickly(self, n: int) -> Chosen:
        """Nearly as good ones, in a small part of the time."""
        return exchanged(self.measure, self.starts(n)[0], quickly=True)

    def reaching(self, target: float, generator: np.random.Generator) -> Chosen:
        """As few as reach a target, [m]; as many as may be where none do."""
        most = min(MOST_STOPS, self.system.n_candidates)
        if self.system.unknown > UNKNOWN:  # no number of stops would do
            return self.best(min(LEAST_CURVE, most))
        enough = 1
        while min(map(self.error, self.starts(enough))) > target:
            if enough == most:
                return Chosen(self.starts(most)[0], np.inf)
            enough = min(most, enough + max(1, enough // 10))
        low, high, found = 0, enough, min(self.starts(enough), key=self.error)
        while high - low > 1:
            middle = max(low + 1, high - max(1, (high - low) // 4))
            better = self.quickly(middle).candidates
            if self.error(better) <= target:
                high, found = middle, better
            else:
                low = middle
        last = exchanged(self.measure, found)  # by another criterion it may miss the target again
        reached = self.error(last.candidates) <= target
        last = last if reached else Chosen(found, self.measure.value(self.system.information(found)))
        return self._still_fewer(last, generator, lambda candidates: self.error(candidates) <= target)

    def _still_fewer(
        self, found: Chosen, generator: np.random.Generator, reaches: Callable[[Integers], bool]
    ) -> Chosen:
        """A few less than were found quickly, where the best of so few reach a target too."""
        for n in range(len(found.candidates) - 1, max(0, len(found.candidates) - 1 - MOST_FEWER), -1):
            fewer = self.thoroughly(n, generator)
            if reaches(fewer.candidates):
                return self._still_fewer(fewer, generator, reaches)
        return found

    def held(self, found: Chosen, generator: np.random.Generator) -> Chosen:
        """The same, or the best of some random sets where that is better by an error that the system does not say."""
        if self._exact is None or self.system.unknown > UNKNOWN:
            return found
        sets = [self._drawn(len(found.candidates), generator) for _ in range(N_EXACT)]
        best = min((found.candidates, *sets), key=self._exact)
        return Chosen(best, self.measure.value(self.system.information(best)))

    def _drawn(self, n: int, generator: np.random.Generator) -> Integers:
        return generator.choice(self.system.n_candidates, size=n, replace=False).astype(np.int64)

    def curve(
        self,
        found: Chosen,
        generator: np.random.Generator,
        hubs: int,
        other: Callable[[Integers], float],
    ) -> tuple[CurvePoint, ...]:
        """What to expect of fewer stops, and of as many.

        Args:
            found: As many.
            generator: Draws random sets.
            hubs: How many there are beside, which count.
            other: Expected error of other pairs beside those of a star of some candidates, [m].
        """
        most = len(found.candidates)
        numbers = np.round(np.geomspace(LEAST_CURVE, max(most + hubs, LEAST_CURVE), N_CURVE)).astype(np.int64)
        points = []
        for k in sorted({n - hubs for n in numbers.tolist() if 0 < n - hubs < most} | {most}):
            chosen = found.candidates if k == most else self.quickly(k).candidates
            error = min(self.error(chosen), other(chosen))
            points.append(CurvePoint(k + hubs, error, self._band(k, generator)))
        return tuple(points)

    def fewer(
        self, found: Chosen, target: float, other: Callable[[Integers], float], generator: np.random.Generator
    ) -> Chosen:
        """As few as reach a target, [m], by other pairs beside those of a star; as many as were found if none do.

        Args:
            found: Those that a star reaches it with.
            target: It.
            other: Expected error of other pairs of some candidates, [m].
            generator: Draws random sets.
        """
        low, high = 0, len(found.candidates)
        while high - low > 1:
            middle = (low + high) // 2
            some = self.quickly(middle)
            if min(self.error(some.candidates), other(some.candidates)) <= target:
                high, found = middle, some
            else:
                low = middle
        return self._still_fewer(found, generator, lambda some: min(self.error(some), other(some)) <= target)

    def _band(self, n: int, generator: np.random.Generator) -> tuple[float, float, float]:
        """Error that a tenth, half and nine tenths of random sets of n do not exceed."""
        if self.system.unknown > UNKNOWN:
            return (float("inf"),) * 3
        if self._exact is None:
            errors = np.sqrt(random_values(self._error, n, generator)[0])
        else:
            errors = np.array([self._exact(self._drawn(n, generator)) for _ in range(N_EXACT)])
        low, middle, high = np.quantile(errors, [0.1, 0.5, 0.9], method="nearest").tolist()
        return low, middle, high
