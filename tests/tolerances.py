"""Tolerances in units of a quantity's own rounding or of its sigma, so that no processor decides whether a test passes.

A processor that fuses multiplication and addition, or a library that sums in another order, rounds other figures: never
by more than half a unit in the last place each time, but as often as there are operations.
"""

import numpy as np

NEGLIGIBLE = 1e-6
"""What two ways to one optimum may differ by, in sigma: far below what matters, far above what rounding does."""


def rounding(size=1.0, condition=1.0):
    """What rounding may do to a figure: a thousand operations, all one way.

    A thousand are the products along an arm, or a sum over some hundred rows.

    Args:
        size: Of the figures that enter, an array by its largest; 1 for a relative tolerance.
        condition: How much what follows enlarges it: an inverse, a triangle, a small difference, longer sums.
    """
    return 1000 * np.finfo(np.float64).eps * condition * float(np.max(np.abs(size)))


def sigmas_apart(found, expected, sigma):
    """The largest difference in sigma; what has no sigma (0: held) must be equal to rounding."""
    found, expected, sigma = (np.asarray(v, dtype=np.float64) for v in (found, expected, sigma))
    held = sigma == 0.0
    assert np.all(np.abs(found - expected)[held] <= rounding(np.append(expected, 1.0)))
    return float(np.max(np.abs(found - expected)[~held] / sigma[~held], initial=0.0))
