"""Which cases of a test the default run has, where the others take the same way: these are for the slow run."""

from itertools import product

import pytest


def diagonal(*arguments, every=None):
    """All combinations of the values of arguments; the default run has a diagonal of them, and so each value.

    Args:
        arguments: The values of each.
        every: How many combinations there are for one of the diagonal; as many as the argument with most values but
            one has if None.
    """
    n = sorted(map(len, arguments))[-2] if every is None else every
    cases = (zip(*each, strict=True) for each in product(*map(enumerate, arguments)))
    return [as_case(values, is_slow=sum(places) % n > 0) for places, values in cases]


def as_case(case, *, is_slow):
    """A `pytest.param`, in the slow run alone or in the default one."""
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=[pytest.mark.slow] * is_slow)
