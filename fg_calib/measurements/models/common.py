"""What the models of instruments have in common: named rows, and the unknowns that the names stand for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import ProblemError
from fg_calib.measurements.dataset import Labels
from fg_calib.measurements.series import Table, Unknowns

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def labels_of(table: Table, column: str) -> Labels:
    """What each row is of, by the column of that name.

    Raises:
        ProblemError: There is no such column, or a row of it is empty.
    """
    m = table.measurements
    labels = m.labels.get(column)
    if labels is None:
        raise ProblemError(m.source, f"no column {column}", f"the name of a {column} for model {table.model}")
    return labels


def needed(table: Table, values: Floats | None, column: str, what: str) -> Floats:
    """What was measured.

    Raises:
        ProblemError: It was not.
    """
    if values is None:
        raise ProblemError(table.measurements.source, f"no column {column}", f"{what} for model {table.model}")
    return values


def stated(table: Table, sigma: Floats | None, noise: str, rows: Integers) -> Floats:
    """1 sigma of some rows.

    Raises:
        ProblemError: It is not stated.
    """
    if sigma is None or not np.isfinite(sigma[rows]).all():
        expected = f"noise.{noise} or a column sigma_{noise}"
        raise ProblemError(table.measurements.source, f"no sigma for {noise}", expected)
    return sigma[rows]


def places_of(unknowns: Unknowns, letter: str, table: Table, names: tuple[str, ...]) -> Integers:
    """Add points, those that the table knows where they are known to be.

    Args:
        unknowns: What the series depend on is added here.
        letter: Letter of the points' keys.
        table: The table.
        names: What they are called.

    Returns:
        Their coordinates' places, shape (n, 3).
    """
    known, nowhere = [table.known.get(name) for name in names], np.full(3, np.nan)
    return unknowns.add(
        letter,
        names,
        np.array([nowhere if k is None else k.xyz for k in known]).reshape(-1, 3),
        table.measurements.source,
        tolerances=[None if k is None else k.tolerance for k in known],
        known=[k is not None and k.tolerance is None for k in known],
    )
