"""How every peer is run: a work file in, a result file out, each draw solved once warm and timed.

    python in_PEER.py VARIANT WORK.npz RESULT.npz DRAWS CAP

A peer's script has a class a variant, with

- `unable(work)`: why it cannot do this kind of work, or None;
- `__init__(work)`: everything before the solve (files, objects), timed as setup;
- `solve()`: from the nominal start to the estimate, timed by the clock and in processor time of all its threads;
- `predict(q)`: tool positions (n, 3) [m], and rotations (n, 3, 3) or None, by what was estimated;
- `says(q)`: its own uncertainty: `states` in words and, where it has them, `covariance` of the positions at `q`,
  shape (n, 3, 3), [m^2], and `parameters` with the `sigma` that it claims, shape (n_parameters,); of an arm that gives
  way `compliance` and its sigma, shape (2, n_joints - 1), [rad/(N m)].

The first draw is solved twice where that takes less than `AGAIN` seconds, and the first time kept apart: it imports,
compiles and fills caches. A solve that takes more than `CAP` seconds by the clock is ended, and once all together have
taken so many of processors no further draw is begun. A draw that fails is counted and the others are done.

Trap: Linux counts the processor time of a process to the nearest tick only while a timer of processor time runs. With
one as the limit every peer seemed to take 2 ms less than it did, half the time of the fastest.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

AGAIN = 5.0
SHARED = ("q_val", "values", "estimated", "sigma", "masses")
"""Arrays of a work file that do not have one row a draw."""


class Peer:
    """What most peers have in common."""

    @staticmethod
    def unable(work: dict) -> str | None:
        """Why it cannot do this work, or None."""
        return None

    def says(self, q: np.ndarray) -> dict:
        """What it claims of its uncertainty."""
        return {"states": "nothing"}


def write_work(path: Path, kind: str, frames_known: bool, **arrays: np.ndarray) -> None:
    """A work file: `SHARED` arrays, and those with one row a draw (q, position, rotation or a, b, distance)."""
    np.savez(path, kind=kind, frames_known=frames_known, **arrays)


def read_draw(path: Path, draw: int) -> dict:
    """One draw of a work file."""
    with np.load(path) as given:
        work = {"kind": str(given["kind"]), "frames_known": bool(given["frames_known"])}
        for name in given.files:
            if name not in work:
                work[name] = given[name] if name in SHARED else given[name][draw]
    return work


class TooLong(BaseException):
    """A solve is ended; no peer's `except Exception` takes it for its own."""


def _too_long(*_: object) -> None:
    raise TooLong


def main(variants: dict[str, type[Peer]]) -> None:
    """Run from the command line."""
    variant, path, out, draws, cap = sys.argv[1:]
    cls, path, cap = variants[variant], Path(path), float(cap)
    signal.signal(signal.SIGALRM, _too_long)
    begun = time.process_time()
    found: dict[str, list] = {}
    notes: dict = {"python": sys.version.split()[0], "versions": {}}
    for name in ("numpy", "scipy"):
        if name in sys.modules:
            notes["versions"][name] = sys.modules[name].__version__
    if reason := cls.unable(read_draw(path, 0)):
        notes["reason"] = reason
    for draw in range(0 if reason else int(draws)):
        try:
            row = _timed(cls, read_draw(path, draw), cap)
            if draw == 0:
                notes["first"] = row["seconds"]
                if row["seconds"] < AGAIN:
                    row = _timed(cls, read_draw(path, draw), cap)
            notes["states"] = row.pop("states")
        except TooLong:
            notes["reason"] = f"ended after {cap:g} s"
            break
        except Exception as error:  # a peer's failure is its result
            notes["reason"] = f"{type(error).__name__}: {error}".splitlines()[0][:200]
            notes["failed"] = notes.get("failed", 0) + 1
            continue
        for name, value in (row | {"draw": draw}).items():
            found.setdefault(name, []).append(value)
        _write(out, found, notes)
        if time.process_time() - begun > cap:
            break
    _write(out, found, notes)


def _timed(cls: type[Peer], work: dict, cap: float) -> dict:
    begun = time.perf_counter()
    peer = cls(work)
    clock, processors = time.perf_counter(), time.process_time()
    signal.setitimer(signal.ITIMER_REAL, cap)
    try:
        peer.solve()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    seconds, used = time.perf_counter() - clock, time.process_time() - processors
    q = work["q_val"]
    position, rotation = peer.predict(q)
    rotation = np.full((len(q), 3, 3), np.nan) if rotation is None else rotation
    row = {"setup": clock - begun, "seconds": seconds, "processors": used, "position": position, "rotation": rotation}
    return row | peer.says(q)


def _write(out: str, found: dict[str, list], notes: dict[str, object]) -> None:
    whole = {name: np.array(rows) for name, rows in found.items() if len({np.shape(row) for row in rows}) == 1}
    np.savez(f"{out}.part.npz", notes=json.dumps(notes), **whole)
    os.replace(f"{out}.part.npz", out)
