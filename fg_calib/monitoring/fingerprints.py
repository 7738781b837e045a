"""Fingerprints of rows: whether a table holds measurements that were counted before, whatever file they came in.

A fingerprint is a hash of one measurement's values, joint readings included, to 1e-12 m or rad, so that units and the
file's format make no difference: a sum of integers times odd numbers, modulo 2^64, of which the upper bits count.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from fg_calib.inputs import Floats
from fg_calib.measurements import LANDMARKS, Measurements, Table

Words = NDArray[np.uint64]

MAX_FINGERPRINTS = 1000
"""Fingerprints of a table that are kept: of more rows those with the smallest, in any two tables the same ones."""

SAME_SHARE = 0.5
"""Share of a table's rows from which it was counted before: coarse values repeat now and then."""

_RESOLUTION, _NOT_MEASURED = 1e-12, 9e6

_FACTORS: Words = np.frombuffer(hashlib.shake_128(b"fg_calib").digest(8 * 512), dtype="<u8").astype(
    np.uint64
) | np.uint64(1)


def fingerprints(tables: Sequence[Table]) -> tuple[str, ...]:
    """Fingerprints of the train rows of tables, 12 hexadecimal digits each, sorted; at most 1000 a table."""
    found: set[str] = set()
    for table in tables:
        smallest = np.unique(_of_rows(table.measurements) >> np.uint64(16))[:MAX_FINGERPRINTS]
        found |= {f"{one:012x}" for one in smallest.tolist()}
    return tuple(sorted(found))


def counted_before(table: Table, known: Collection[str]) -> bool:
    """Whether half of a table's rows are among fingerprints."""
    own = fingerprints([table])
    return bool(own) and sum(one in known for one in own) >= SAME_SHARE * len(own)


def _of_rows(m: Measurements) -> Words:
    """Hashes of what was measured at, and between, configurations."""
    n = len(m.readings)
    values = [
        v.reshape(n, -1) for v in (m.position, m.rotation, m.length, m.image, *m.columns.values()) if v is not None
    ]
    measured = np.any([np.isfinite(v).all(axis=1) for v in values], axis=0) & np.ones(n, dtype=np.bool_)
    labels = [m.labels[key] for key in (kind.name for kind in LANDMARKS.values()) if key in m.labels]
    names = [(label.names, label.index) for label in labels]
    if m.groups is not None:
        names.append((m.groups.names, m.groups.index))
        measured |= m.groups.index >= 0
    codes = [np.array([*(zlib.crc32(name.encode()) for name in of), 0], dtype=np.uint64)[index] for of, index in names]
    found = [_hash(*m.readings.T, *(c for v in values for c in v.T), *codes)[measured & ~m.test]]
    if m.pairs is not None:
        ends = _hash(*m.readings.T)
        found.append(_hash(ends[m.pairs.a], ends[m.pairs.b], m.pairs.distance, m.pairs.angle)[~m.pairs.test])
    return np.concatenate(found)


def _hash(*columns: Floats | Words) -> Words:
    """One hash a row of columns of values, or of hashes."""
    total: Words = np.zeros(len(columns[0]), dtype=np.uint64)
    for column, factor in zip(columns, _FACTORS, strict=False):
        total += factor * (column if column.dtype == np.uint64 else _as_integers(column))
    return total


def _as_integers(values: Floats | Words) -> Words:
    """Values in units of the resolution."""
    return np.round(np.nan_to_num(values, nan=_NOT_MEASURED) / _RESOLUTION).astype(np.int64).view(np.uint64)
