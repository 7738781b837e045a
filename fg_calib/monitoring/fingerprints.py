"""Fingerprints of rows: whether a table holds measurements that were counted before, whatever file they came in.

A fingerprint is a hash of the figures of one measurement, joint readings included, to 1e-12 m or rad, so that units and
a file's format make no difference. Of more than `MOST` rows those with the smallest hashes are kept: of any two tables
the same ones.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from fg_calib.measurements.dataset import Labels, Measurements, Pairs
from fg_calib.measurements.table import Table
from fg_calib.robot.kinematics import over_spans

Floats = NDArray[np.float64]
Words = NDArray[np.uint64]

MOST = 1000
"""Fingerprints of a table that are kept."""

SAME = 0.5
"""Part of a table's rows from which it has been counted before: coarse figures repeat now and then."""

_DECIMALS = 12

_BITS = 48


def fingerprints(tables: Sequence[Table]) -> tuple[str, ...]:
    """Of the train rows of tables, 12 hexadecimal digits each, sorted; at most `MOST` a table."""
    found: set[str] = set()
    for table in tables:
        marks = _smallest(_hashes(table.measurements))
        found |= {f"{mark:012x}" for mark in marks.tolist()}
    return tuple(sorted(found))


def counted_before(table: Table, known: Collection[str]) -> bool:
    """Whether half of a table's rows are among fingerprints."""
    mine = fingerprints([table])
    return bool(mine) and sum(mark in known for mark in mine) >= SAME * len(mine)


def _smallest(hashes: Words) -> Words:
    """The `MOST` smallest different ones."""
    some = hashes
    for n in (2 * MOST, 16 * MOST):
        if len(hashes) > n:
            some = np.unique(np.partition(hashes, n)[:n])
            if len(some) >= MOST:
                return some[:MOST]
    return np.unique(hashes)[:MOST]


def _hashes(m: Measurements) -> Words:
    """Of what was measured at, and between, configurations."""
    figures = [part for part in (m.position, m.length, m.image) if part is not None]
    if m.rotation is not None:
        figures.append(m.rotation.reshape(len(m.rotation), 9))
    n = len(m.readings)
    columns = np.column_stack([m.readings, *figures])
    there = ~m.test & np.any([np.isfinite(part.reshape(n, -1)).all(axis=1) for part in figures], axis=0)
    touched = m.groups is not None
    if m.groups is not None:
        there = ~m.test & (there | (m.groups.index >= 0))
    hashes = _mixed(_rounded(columns).T, n)
    for column in ("target", "anchor", "plane", "board"):
        if column in m.labels:
            hashes = _with_names(hashes, m.labels[column])
    if touched and m.groups is not None:
        hashes = _with_names(hashes, Labels(m.groups.names, m.groups.index))
    found = [hashes[there] if figures or touched else hashes[:0]]
    if m.pairs is not None:
        found.append(_of_pairs(m.readings, m.pairs))
    every: Words = np.concatenate(found) >> np.uint64(64 - _BITS)
    return every


def _of_pairs(readings: Floats, pairs: Pairs) -> Words:
    found, bits = np.zeros(pairs.n_pairs, dtype=np.uint64), _rounded(readings)
    figures = [_rounded(values) for values in (pairs.distance, pairs.angle)]

    def run(start: int, stop: int) -> None:
        rows = slice(start, stop)
        ends = [bits[end[rows]].T for end in (pairs.a, pairs.b)]
        found[rows] = _mixed([*ends[0], *ends[1], *(values[rows] for values in figures)], stop - start)

    for _ in over_spans(run, pairs.n_pairs):
        pass
    return found[~pairs.test]


def _with_names(hashes: Words, labels: Labels) -> Words:
    """Hashes that depend on names too."""
    codes = np.array(
        [int.from_bytes(name.encode()[:8].ljust(8), "big") for name in labels.names] + [0], dtype=np.uint64
    )
    return _stirred(hashes ^ codes[labels.index])


def _rounded(figures: Floats) -> Words:
    """The bits of figures that count, of the same shape."""
    bits: Words = (np.round(figures, _DECIMALS) + 0.0).view(np.uint64)  # + 0.0: no negative zeros
    return bits


def _mixed(columns: Iterable[Words], n: int) -> Words:
    """One hash a row of columns of n rows, shape (n,)."""
    found = np.zeros(n, dtype=np.uint64)
    for column in columns:
        found = _stirred(found ^ column)
    return found


def _stirred(x: Words) -> Words:
    """The finaliser of splitmix64 (Steele, Lea, Flood 2014): every bit of the input acts on every bit of the output."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
