"""The linear system that stops are chosen by: what any of them could determine, in as many coordinates.

Rows A of stops, information `M = M_0 + sum A^T A`. Directions that all candidates together leave undetermined are left
out: no choice among them changes anything there. In the coordinates of what is left all candidates together leave
variances of 1. There is a weak prior (1 rad, or the arm's reach, or what rounding can tell from all candidates), so
that a set which does not yet determine everything has a covariance too, a large one.

What counts is the arm's part: the task `W`, and of its parameters the functions that can be determined, P; where the
measurement frames are is unknown in both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.designs.rows import StopRows
from fg_calib.graph.normal_system import SIGNAL_FLOOR

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_ROUNDING = 1e-13
"""Singular values of all rows below this share of the largest are rounding, and so is information below this share."""

_SHARE = 1e-6
"""Share of a task, or of a function, in undetermined directions above which it is not determined."""


@dataclass(frozen=True)
class System(FrozenArrays):
    """What is chosen from, in coordinates that can be determined.

    Attributes:
        rows: Of each candidate, shape (n_candidates, h, n).
        known: Information that is there already, the weak prior in it, shape (n, n).
        task: W, of which `tr(W C)` is the mean square error of the task, C the covariance, shape (n, n).
        core: P, functions of the arm's parameters that can be determined, orthonormal in changes of ordinary size,
            shape (p, n).
        basis: What is determined, in the columns of rows, shape (n_columns, n).
        unknown: Share of the task's mean square that no candidate determines, in [0, 1].
    """

    rows: Floats
    known: Floats
    task: Floats
    core: Floats
    basis: Floats
    unknown: float

    @property
    def n_candidates(self) -> int:
        """Number of candidates."""
        return len(self.rows)

    def with_known(self, candidates: Integers) -> System:
        """The same with some candidates measured already."""
        return replace(self, known=self.information(candidates))

    def select(self, candidates: Integers) -> System:
        """The same with some of the candidates."""
        return replace(self, rows=self.rows[candidates])

    def information(self, chosen: Integers) -> Floats:
        """Information with some candidates measured, shape (n, n)."""
        A = self.rows[chosen].reshape(-1, self.rows.shape[2])
        out: Floats = self.known + A.T @ A
        return out


def system_of(stops: StopRows, given: Floats, task: Floats) -> System:
    """The system of stops.

    Args:
        stops: What they would add.
        given: Rows that were measured already, shape (m, n_columns).
        task: Mean square error of the task as a quadratic form of the core, shape (n_core, n_core).
    """
    scales, n, n_arm = stops.scales, stops.n_core, stops.n_arm
    rows, before = stops.rows * scales, np.vstack([stops.always, given]) * scales
    flat = rows.reshape(-1, len(scales))
    # By singular values: those of the information itself are lost in rounding where noise is tiny.
    _, s, Vt = np.linalg.svd(np.linalg.qr(np.vstack([before, flat]), mode="r"))
    values, vectors = np.append(s, np.zeros(len(scales) - len(s))), Vt.T
    there = values > max(SIGNAL_FLOOR, _ROUNDING * values[0])
    Q, lost = vectors[:, there] / values[there], vectors[:n, ~there]
    weak = np.maximum((SIGNAL_FLOOR / values[there]) ** 2, _ROUNDING)
    W = task * np.outer(scales[:n], scales[:n])
    total = float(np.trace(W))
    # Functions of the arm that no undetermined direction has a share in.
    U, s, _ = np.linalg.svd(lost[:n_arm], full_matrices=True) if lost.shape[1] else (np.eye(n_arm), np.zeros(0), None)
    able = U[:, int(np.sum(s > _SHARE)) :]
    return System(
        rows=rows @ Q,
        known=(before @ Q).T @ (before @ Q) + np.diag(weak),
        task=Q[:n].T @ W @ Q[:n],
        core=able.T @ Q[:n_arm],
        basis=scales[:, None] * Q,
        unknown=float(np.trace(lost.T @ W @ lost)) / total if total > 0.0 else 0.0,
    )
