"""Observability: rank, null space, the paper's three classes, and observability indices.

Everything is read from one matrix, the Jacobian of the whitened residuals with its columns scaled to changes of
ordinary size (1 mrad, or what that moves at the arm's reach), so that a singular value is a signal-to-noise ratio: how
many sigma a change of ordinary size along its direction moves the measurements. Rank, classes and groups are thus a
matter of geometry and noise. What the parameters may be off, their tolerances, says only which directions are weak.

References:
    Jia et al. (2019), section 4: independent, relative and ineffective parameters.
    O1: Menq & Borm (1988); O2: Driels & Pathre (1990); O3, O4: Nahvi & Hollerbach (1994, 1996); O5: Sun & Hollerbach
    (2008), Observability index selection for robot calibration, ICRA.
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import computed_field
from scipy.sparse.csgraph import connected_components

from fg_calib.graph import RANK_TOLERANCE, SIGNAL_FLOOR, SUPPORT_TOLERANCE, determined, first_independent
from fg_calib.inputs import Figure, Floats, FrozenArrays, Record
from fg_calib.robot import Parameter, names_of

IdentifiabilityClass = Literal["independent", "relative", "ineffective"]

WEAK = 10.0
"""A direction is weak if its sigma is above one over this of what it may be off: tolerance, else an ordinary change."""

CORRELATED = 0.9
"""Correlations above this are worth a line."""


class RelativeGroup(Record):
    """Parameters of which only combinations are determined.

    Attributes:
        parameters: Their names.
        relations: Directions in which they may move together with no effect on any measurement: the change of
            each, in [m] and [rad], the largest being 1 or -1.
        keep: Parameters that the package would estimate; the others stay at nominal.
    """

    parameters: tuple[str, ...]
    relations: tuple[dict[str, float], ...]
    keep: tuple[str, ...]

    @computed_field  # type: ignore[prop-decorator]
    @property
    def lost(self) -> int:
        """Number of undetermined directions."""
        return len(self.relations)

    def combinations(self, kept: Sequence[str]) -> dict[str, dict[str, float]]:
        """Combinations estimated by kept members where the others are left at nominal: factors by name, by kept member.

        With K the kept and L the others a relation moves `n_K + n_L` with no effect; the estimate of K stays the same
        in `x_K + G x_L` where G undoes every relation: `n_K + G n_L = 0`.
        """
        left_out = [name for name in self.parameters if name not in kept]
        of_kept = np.array([[relation.get(name, 0.0) for name in kept] for relation in self.relations])
        of_left_out = np.array([[relation.get(name, 0.0) for name in left_out] for relation in self.relations])
        G = -np.linalg.lstsq(of_left_out, of_kept, rcond=None)[0].T  # (n_kept, n_left_out)
        found = {}
        for name, row in zip(kept, G, strict=True):
            others = {n: float(f"{g:.9g}") for n, g in zip(left_out, row, strict=True) if abs(g) > SUPPORT_TOLERANCE}
            if others:
                found[name] = {name: 1.0} | others
        return found


class Correlated(Record):
    """Two parameters that are strongly correlated.

    Attributes:
        parameters: Their names.
        correlation: Between -1 and 1.
    """

    parameters: tuple[str, str]
    correlation: Figure


class WeakDirection(Record):
    """A direction that the data determine, but badly.

    Attributes:
        signal_to_noise: 1 over its sigma, in what the parameters may be off: tolerance, else a change of ordinary size.
        members: Its largest members, by name, as shares between -1 and 1.
    """

    signal_to_noise: Figure
    members: dict[str, float]


class Observability(FrozenArrays):
    """Observability of the parameters by a set of measurements.

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
        sigma: 1 sigma of the independent and the kept parameters, the others being held at nominal, [m] and [rad].
            That of a kept parameter is the sigma of the combination it stands for.
        correlations: Pairs of those that are correlated by more than `CORRELATED`, strongest first.
        weak: Directions among those with a signal-to-noise ratio below `WEAK`, weakest first.
    """

    names: tuple[str, ...]
    singular_values: Floats
    rank: int
    gap: Figure
    classes: tuple[IdentifiabilityClass, ...]
    relative: tuple[RelativeGroup, ...]
    null_space: Floats
    indices: dict[str, Figure]
    condition_number: Figure
    sigma: dict[str, Figure]
    correlations: tuple[Correlated, ...]
    weak: tuple[WeakDirection, ...]

    def named(self, wanted: IdentifiabilityClass) -> list[str]:
        """Names of the parameters of one class."""
        return [name for name, c in zip(self.names, self.classes, strict=True) if c == wanted]

    @property
    def kept(self) -> list[str]:
        """The parameters that can be estimated together: the independent ones and those kept of each group."""
        keep = {name for group in self.relative for name in group.keep}
        return [n for n, c in zip(self.names, self.classes, strict=True) if c == "independent" or n in keep]

    @property
    def lost(self) -> tuple[dict[str, float], ...]:
        """Every undetermined direction by name: ineffective parameters alone, then the relations of the groups."""
        alone = tuple({name: 1.0} for name in self.named("ineffective"))
        return alone + tuple(relation for group in self.relative for relation in group.relations)


def observability_of_rows(
    jacobian: Floats,
    parameters: Sequence[Parameter],
    *,
    scales: Floats,
    n_measurements: int,
    prefer: Sequence[str] = (),
    floor: float = SIGNAL_FLOOR,
) -> Observability:
    """Analyse a whitened Jacobian, or the triangular factor of one.

    Args:
        jacobian: Shape (m, n).
        parameters: The n parameters of the columns.
        scales: A change of ordinary size in each of them, shape (n,), [m] and [rad].
        n_measurements: Number of configurations or pairs, for O1.
        prefer: Parameters to keep, first choice first, where only combinations are determined; then those first in
            `PARAMETER_KINDS`.
        floor: Signal-to-noise ratio below which a direction counts as not determined.
    """
    n, names = len(parameters), names_of(parameters)
    J = jacobian * scales
    _, s, Vt = np.linalg.svd(np.vstack([J, np.zeros((n, n))]), full_matrices=False)
    rank = determined(s, floor)
    null = Vt[rank:]
    dead = np.linalg.norm(J, axis=0) <= max(RANK_TOLERANCE * s.max(initial=0.0), floor)
    relative = (np.linalg.norm(null, axis=0) > SUPPORT_TOLERANCE) & ~dead
    classes = np.select([dead, relative], ["ineffective", "relative"], "independent").tolist()
    groups = _groups(null, dead, scales, parameters, prefer)
    dropped = {name for g in groups for name in g.parameters if name not in g.keep}
    kept = [i for i in range(n) if not dead[i] and names[i] not in dropped]
    may_be_off = np.array([s if p.tolerance is None else p.tolerance for p, s in zip(parameters, scales, strict=True)])
    with np.errstate(divide="ignore", invalid="ignore"):
        gap = float(s[rank - 1] / s[rank]) if 0 < rank < n else np.inf
    accuracy = _accuracy(jacobian[:, kept] * may_be_off[kept], [names[i] for i in kept], may_be_off[kept])
    condition = float(s[0] / s[rank - 1]) if rank else np.inf
    found = (s, rank, gap, tuple(classes), groups, null)
    return Observability(tuple(names), *found, observability_indices(s[:rank], n_measurements), condition, **accuracy)


def observability_indices(singular_values: Floats, n_measurements: int) -> dict[str, float]:
    """O1 to O5 of the nonzero singular values s_1 >= ... >= s_L of m measurements.

    O1 = (s_1 ... s_L)^(1/L) / sqrt(m); O2 = s_L / s_1; O3 = s_L; O4 = s_L^2 / s_1; O5 = 1 / (1/s_1 + ... + 1/s_L).
    """
    s, names = singular_values, ("O1", "O2", "O3", "O4", "O5")
    if not len(s):
        return dict.fromkeys(names, 0.0)
    mean = np.exp(np.mean(np.log(s))) / np.sqrt(n_measurements)
    figures = mean, s[-1] / s[0], s[-1], s[-1] ** 2 / s[0], 1.0 / np.sum(1.0 / s)
    return dict(zip(names, map(float, figures), strict=True))


def _accuracy(J: Floats, names: Sequence[str], scales: Floats) -> dict[str, Any]:
    """Sigmas, strong correlations and weak directions of columns that are determined together."""
    _, s, Vt = np.linalg.svd(J, full_matrices=False)
    half = Vt.T / s
    spread = np.linalg.norm(half, axis=1)
    correlation = (half @ half.T) / np.outer(spread, spread)
    above = np.argwhere(np.triu(np.abs(correlation) > CORRELATED, 1))
    strongest = sorted(above.tolist(), key=lambda ij: -abs(correlation[ij[0], ij[1]]))
    weak = []
    for value, direction in zip(s[::-1], Vt[::-1], strict=True):
        if value >= WEAK:
            break
        size = np.round(np.abs(direction), 6)  # equal members keep their order, however they are rounded
        members = sorted(np.flatnonzero(size > 0.3 * size.max()).tolist(), key=lambda i: -size[i])
        sign = np.sign(direction[members[0]])
        weak.append(WeakDirection(float(value), {names[i]: float(sign * direction[i]) for i in members}))
    sigma = dict(zip(names, (spread * scales).tolist(), strict=True))
    correlations = tuple(Correlated((names[i], names[j]), float(correlation[i, j])) for i, j in strongest)
    return {"sigma": sigma, "correlations": correlations, "weak": tuple(weak)}


def _groups(
    null: Floats, dead: NDArray[np.bool_], scales: Floats, parameters: Sequence[Parameter], prefer: Sequence[str]
) -> tuple[RelativeGroup, ...]:
    """Connected relative groups with sparse relations, from an orthonormal basis of the null space."""
    alive: list[int] = np.flatnonzero(~dead).tolist()
    n_lost = len(null) - int(dead.sum())
    if n_lost <= 0:
        return ()
    # Eliminate the parameters that are kept last: each relation then holds one of them and kept ones alone.
    order = sorted(alive, key=lambda i: (-parameters[i].preference(prefer), i))
    N = null[:, order]
    dropped = first_independent(N, n_lost)
    relations = np.linalg.lstsq(N[:, dropped].T, np.eye(n_lost), rcond=None)[0].T @ N  # (n_lost, n_alive)
    relations[np.abs(relations) < SUPPORT_TOLERANCE] = 0.0
    names = names_of(parameters)
    found = []
    for support, rows in _connected(relations):
        members = sorted(order[i] for i in support)
        given_up = {order[dropped[r]] for r in rows}
        rows.sort(key=lambda r: order[dropped[r]])
        physical = _chained(relations[rows]) * scales[order]
        own, keep = (tuple(names[i] for i in members if i not in out) for out in ((), given_up))
        found.append(RelativeGroup(own, tuple(_relation(direction, order, names) for direction in physical), keep))
    return tuple(sorted(found, key=lambda g: names.index(g.parameters[0])))


def _connected(relations: Floats) -> list[tuple[list[int], list[int]]]:
    """Relations that share a parameter, together: (parameters, relations) of each group."""
    shares = relations != 0.0
    n, group = connected_components(shares.astype(np.int64) @ shares.T)
    of_group = [np.flatnonzero(group == k) for k in range(n)]
    return [(np.flatnonzero(shares[rows].any(axis=0)).tolist(), rows.tolist()) for rows in of_group]


def _chained(relations: Floats) -> Floats:
    """Relations minus multiples of the next one if that adds no parameter: d3 - d4, d4 - d5 for d3 - d5, d4 - d5."""
    chained = relations.copy()
    for r in range(len(relations) - 1):
        shared = np.flatnonzero((relations[r] != 0.0) & (relations[r + 1] != 0.0))
        if len(shared):
            against = relations[r] - relations[r, shared[-1]] / relations[r + 1, shared[-1]] * relations[r + 1]
            against[np.abs(against) < SUPPORT_TOLERANCE] = 0.0
            if np.count_nonzero(against) <= np.count_nonzero(relations[r]):
                chained[r] = against
    return chained


def _relation(direction: Floats, order: Sequence[int], names: Sequence[str]) -> dict[str, float]:
    """A direction as changes by name, the largest of which is 1 in size and the first positive."""
    support = sorted((i for i in range(len(order)) if direction[i]), key=lambda i: order[i])
    largest = max(abs(direction[i]) for i in support)
    sign = np.sign(direction[support[0]])
    return {names[order[i]]: float(f"{sign * direction[i] / largest:.9g}") for i in support}
