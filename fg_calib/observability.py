"""What data determine: rank, null space, the paper's three classes, and observability indices.

Everything is read from one matrix, the Jacobian of the whitened residuals with its columns scaled to changes of
ordinary size (tolerance, else 1 mm or 1 mrad), so that a singular value is a signal-to-noise ratio: how many sigma
a change of ordinary size along its direction moves the measurements.

References:
    Jia et al. (2019), section 4: independent, relative and ineffective parameters.
    O1: Menq & Borm (1988); O2: Driels & Pathre (1990); O3, O4: Nahvi & Hollerbach (1994, 1996); O5: Sun & Hollerbach
    (2008), Observability index selection for robot calibration, ICRA.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

IdentifiabilityClass = Literal["independent", "relative", "ineffective"]

RANK_TOLERANCE = 1e-10
"""Singular values below this part of the largest are those of directions that the data do not determine."""

SUPPORT_TOLERANCE = 1e-6
"""A parameter takes part in a direction if its unit-free share in it is above this."""

KEEP_ORDER = ("theta", "d", "a", "alpha", "beta", "x", "y", "z", "roll", "pitch", "yaw")
"""Of parameters that only act together the earlier kind is kept, and of one kind the later joint, as in the paper."""


@dataclass(frozen=True)
class RelativeGroup:
    """Parameters of which only combinations are determined.

    Attributes:
        parameters: Their names.
        relations: Directions in which they may move together with no effect on any measurement: the change of
            each, in [m] and [rad], the smallest being 1 or -1.
        keep: Those that the package would estimate; the others stay at nominal.
    """

    parameters: tuple[str, ...]
    relations: tuple[dict[str, float], ...]
    keep: tuple[str, ...]

    @property
    def lost(self) -> int:
        """Number of directions that are lost."""
        return len(self.relations)


@dataclass(frozen=True)
class Observability:
    """What a set of measurements determines of the parameters.

    Attributes:
        names: The parameters, shape (n,).
        singular_values: Signal-to-noise ratios, descending, shape (n,).
        rank: Number of determined directions.
        gap: The last singular value kept over the first dropped; inf where none is dropped.
        classes: Class of each parameter, shape (n,).
        relative: The relative groups.
        null_space: Orthonormal unit-free directions that are not determined, shape (n - rank, n).
        indices: O1 to O5.
        condition_number: Of the determined part.
    """

    names: tuple[str, ...]
    singular_values: Floats
    rank: int
    gap: float
    classes: tuple[IdentifiabilityClass, ...]
    relative: tuple[RelativeGroup, ...]
    null_space: Floats
    indices: dict[str, float]
    condition_number: float

    def named(self, wanted: IdentifiabilityClass) -> list[str]:
        """Names of the parameters of one class."""
        return [name for name, c in zip(self.names, self.classes, strict=True) if c == wanted]


def analyse(
    jacobian: Floats,
    names: Sequence[str],
    scales: Floats,
    kinds: Sequence[str],
    n_measurements: int,
    n_nuisance: int = 0,
) -> Observability:
    """Analyse a whitened Jacobian, or the triangular factor of one.

    Args:
        jacobian: Shape (m, n + n_nuisance), the nuisance columns (a measurement frame's) last.
        names: The n parameters' names.
        scales: A change of ordinary size of each, shape (n,), [m] or [rad].
        kinds: Kind of each (`a`, `theta`, `x`), for the order of `KEEP_ORDER`.
        n_measurements: Number of configurations or pairs, for O1.
        n_nuisance: Columns that are free and of no interest; they are projected out.
    """
    n = len(names)
    J = jacobian[:, :n] * scales
    reference = float(np.linalg.norm(J, axis=0).max(initial=0.0))
    if n_nuisance:
        U, s, _ = np.linalg.svd(jacobian[:, n:], full_matrices=False)
        Q = U[:, s > RANK_TOLERANCE * s.max(initial=0.0)]
        J = J - Q @ (Q.T @ J)
    _, s, Vt = np.linalg.svd(np.vstack([J, np.zeros((n, n))]), full_matrices=False)
    # What projecting the nuisance out leaves of a dead column is rounding of the column before.
    rank = int(np.sum(s > RANK_TOLERANCE * max(s[0], 1e-3 * reference)))
    null = Vt[rank:]
    share = np.linalg.norm(null, axis=0)
    dead = np.linalg.norm(J, axis=0) <= RANK_TOLERANCE * max(s[0], 1e-3 * reference)
    relative = (share > SUPPORT_TOLERANCE) & ~dead
    classes: list[IdentifiabilityClass] = [
        "ineffective" if d else "relative" if r else "independent" for d, r in zip(dead, relative, strict=True)
    ]
    kept = s[:rank]
    with np.errstate(divide="ignore", invalid="ignore"):
        gap = float(s[rank - 1] / s[rank]) if 0 < rank < n else np.inf
    return Observability(
        names=tuple(names),
        singular_values=s,
        rank=rank,
        gap=gap,
        classes=tuple(classes),
        relative=_groups(null, dead, scales, names, kinds),
        null_space=null,
        indices=observability_indices(kept, n_measurements),
        condition_number=float(kept[0] / kept[-1]) if rank else np.inf,
    )


def observability_indices(singular_values: Floats, n_measurements: int) -> dict[str, float]:
    """O1 to O5 of the nonzero singular values s_1 >= ... >= s_L of m measurements.

    O1 = (s_1 ... s_L)^(1/L) / sqrt(m); O2 = s_L / s_1; O3 = s_L; O4 = s_L^2 / s_1; O5 = 1 / (1/s_1 + ... + 1/s_L).
    """
    s = singular_values
    if not len(s):
        return dict.fromkeys(("O1", "O2", "O3", "O4", "O5"), 0.0)
    return {
        "O1": float(np.exp(np.mean(np.log(s))) / np.sqrt(n_measurements)),
        "O2": float(s[-1] / s[0]),
        "O3": float(s[-1]),
        "O4": float(s[-1] ** 2 / s[0]),
        "O5": float(1.0 / np.sum(1.0 / s)),
    }


def _groups(
    null: Floats, dead: NDArray[np.bool_], scales: Floats, names: Sequence[str], kinds: Sequence[str]
) -> tuple[RelativeGroup, ...]:
    """Connected relative groups with sparse relations, from an orthonormal basis of the null space."""
    alive: list[int] = np.flatnonzero(~dead).tolist()
    n_lost = len(null) - int(dead.sum())
    if n_lost <= 0:
        return ()
    # Eliminate the parameters one would rather give up: each relation then holds one of them and kept ones only.
    order = sorted(alive, key=lambda i: (-_preference(kinds[i]), i))
    N = null[:, order]
    dropped = _first_independent(N, n_lost)
    relations = np.linalg.lstsq(N[:, dropped].T, np.eye(n_lost), rcond=None)[0].T @ N  # (n_lost, n_alive)
    relations[np.abs(relations) < SUPPORT_TOLERANCE] = 0.0
    groups: list[tuple[set[int], list[int]]] = []
    for r in range(n_lost):
        support: set[int] = set(np.flatnonzero(relations[r]).tolist())
        touching = [g for g in groups if g[0] & support]
        groups = [g for g in groups if not g[0] & support]
        groups.append((support.union(*(g[0] for g in touching)), sorted([r, *(k for g in touching for k in g[1])])))
    found = []
    for support, rows in groups:
        members = sorted(order[i] for i in support)
        physical = [relations[r] * scales[order] for r in rows]
        found.append(
            RelativeGroup(
                parameters=tuple(names[i] for i in members),
                relations=tuple(_relation(v, order, names) for v in physical),
                keep=tuple(names[i] for i in members if i not in {order[dropped[r]] for r in rows}),
            )
        )
    return tuple(sorted(found, key=lambda g: names.index(g.parameters[0])))


def _preference(kind: str) -> int:
    """Rank of a kind in the order of keeping; unknown kinds come last."""
    return KEEP_ORDER.index(kind) if kind in KEEP_ORDER else len(KEEP_ORDER)


def _first_independent(N: Floats, count: int) -> list[int]:
    """The first columns of N, in order, that are linearly independent."""
    chosen: list[int] = []
    basis = np.zeros((len(N), 0))
    for i in range(N.shape[1]):
        rest = N[:, i] - basis @ (basis.T @ N[:, i])
        rest -= basis @ (basis.T @ rest)
        if np.linalg.norm(rest) > SUPPORT_TOLERANCE:
            chosen.append(i)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
        if len(chosen) == count:
            break
    return chosen


def _relation(direction: Floats, order: Sequence[int], names: Sequence[str]) -> dict[str, float]:
    """A direction as changes by name, the smallest of which is 1 in size and the first positive."""
    support = sorted((i for i in range(len(order)) if direction[i]), key=lambda i: order[i])
    smallest = min(abs(direction[i]) for i in support)
    sign = np.sign(direction[support[0]])
    return {names[order[i]]: float(sign * direction[i] / smallest) for i in support}
