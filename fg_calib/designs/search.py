"""Which candidates: one after the other (greedy), then one for another as long as that is better (exchange).

Both look at all candidates at every step, by updates of rank h (see `criteria`): a candidate is never factorised anew.
Exchange takes out one of the chosen at a time and puts in what is best in its place (Fedorov 1972; Mitchell 1974), so
its end is a set that single exchanges make hardly better: a round of them gains less than `LEAST_GAIN`.

References:
    Fedorov (1972), Theory of Optimal Experiments. Academic Press.
    Mitchell (1974), An algorithm for the construction of D-optimal experimental designs. Technometrics 16(2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.designs.criteria import Criterion, Measure
from fg_calib.designs.system import System

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_SWEEPS = 10
"""How often exchange goes through all that were chosen, at most."""

LEAST_GAIN = 1e-3
"""Share of the criterion that a sweep must gain for another one."""

SHORT = 500
"""Candidates that exchange looks at first: those that would help most beside what was chosen."""

_ROUNDING = 1e-12
"""Share of the criterion that an exchange must gain: less may be rounding."""

N_RANDOM = 100
"""Random sets that a design is held to: if one were better, exchange would start from it."""

SMALL = 40_000
"""Stops times candidates up to which exchange starts from random sets too: from all of them with a hundredth."""


@dataclass(frozen=True)
class Chosen(FrozenArrays):
    """Candidates that were chosen.

    Attributes:
        candidates: In the order in which they were taken, shape (n,).
        value: The criterion with all of them; smaller is better.
    """

    candidates: Integers
    value: float


def choose(system: System, n: int, criterion: Criterion = "I") -> Chosen:
    """The best n candidates that greedy choice and exchange find.

    Args:
        system: What is chosen from.
        n: How many, each at most once.
        criterion: What is made small.
    """
    measure = Measure(criterion, system)
    return exchanged(measure, greedy(measure, n))


def greedy(measure: Measure, n: int, start: Integers | None = None) -> Integers:
    """Candidates one after the other, each the best beside those before it."""
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


def exchanged(measure: Measure, chosen: Integers, *, quickly: bool = False) -> Chosen:
    """Candidates with each exchanged for a better one, until none is.

    Most exchanges are among the few candidates that would help most now: these are tried first, then all.

    Args:
        measure: The criterion.
        chosen: What to start from.
        quickly: Whether these few are all that is tried.
    """
    system = measure.system
    now, value = chosen.copy(), measure.value(system.information(chosen))
    if len(chosen) >= system.n_candidates:
        return Chosen(now, value)
    for _ in range(MOST_SWEEPS):
        before = value
        if system.n_candidates > 2 * SHORT:
            short = np.union1d(measure.most_helpful(system.information(now), SHORT), now)
            some = Measure(measure.criterion, system.select(short))
            for _ in range(MOST_SWEEPS):
                last = value
                places, value = _sweep(some, np.searchsorted(short, now), value)
                now = short[places]
                if last - value <= LEAST_GAIN * abs(last):
                    break
            if quickly:
                break
        now, value = _sweep(measure, now, value)
        if before - value <= LEAST_GAIN * abs(before):
            break
    return Chosen(now, measure.value(system.information(now)))


def _sweep(measure: Measure, chosen: Integers, value: float) -> tuple[Integers, float]:
    """Each of the chosen exchanged once for what is best in its place, where that is better."""
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


def random_values(
    measure: Measure, n: int, generator: np.random.Generator, count: int = N_RANDOM
) -> tuple[Floats, Integers]:
    """The criterion of random sets of n, ascending, shape (count,), and the sets, shape (count, n)."""
    system = measure.system
    sets = np.array([generator.choice(system.n_candidates, size=n, replace=False) for _ in range(count)])
    values = np.array([measure.value(system.information(one)) for one in sets])
    order = np.argsort(values, kind="stable")
    return values[order], sets[order].astype(np.int64)


def not_worse_than_random(measure: Measure, found: Chosen, generator: np.random.Generator) -> Chosen:
    """The same, or what exchange makes of random sets where that is better.

    Of large pools exchange starts from the best of them alone, and only if that is better. Of small ones, where a set
    that no single exchange makes better may yet be far from the best, from several.
    """
    n, of = len(found.candidates), measure.system.n_candidates
    values, sets = random_values(measure, n, generator)
    starts = sets[: SMALL // (n * of)]
    if not len(starts) and values[0] < found.value:
        starts = sets[:1]
    return min((found, *(exchanged(measure, one) for one in starts)), key=lambda one: one.value)
