"""What measurements depend on besides the arm: where touched points, targets, anchors, planes and boards are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib.arrays import FrozenArrays
from fg_calib.graph.information import eliminated
from fg_calib.graph.problem import at_parameters, by_columns_of
from fg_calib.graph.solver import Solution
from fg_calib.statistics.covariance import Spread

Floats = NDArray[np.float64]

KINDS = {"L": "point", "P": "target", "A": "anchor", "O": "offset", "F": "plane", "B": "board", "N": "unknown"}
"""What an unknown is, by the letter of its key."""

BEHIND = "C"
"""Letter of the points that the normals of planes come from: constants, and no unknowns."""


@dataclass(frozen=True)
class PointEstimate(FrozenArrays):
    """A physical point that a group of configurations touched, or another unknown of the measurements.

    Attributes:
        name: Its name.
        n: Train rows that it takes part in.
        xyz: Where it is: of a touched point or an anchor in the base frame, of a target in the tool frame, [m]; of a
            plane its unit normal in the base frame, then its distance from the base, [m]; of a board its rotation
            vector, [rad], and position in the base frame, [m]; of an offset what the instrument adds, [m]. Of a group
            without train rows the mean of the predicted tool points.
        sigma: 1 sigma of each, the same shape; 0 where it is known, nan where it is not determined, or not estimated.
        kind: One of `KINDS`.
        units: `m` or `rad` of each; empty of a figure without.
    """

    name: str
    n: int
    xyz: Floats
    sigma: Floats
    kind: str = "point"
    units: tuple[str, ...] = ("m", "m", "m")


def point_estimates(solution: Solution, spread: Spread) -> tuple[PointEstimate, ...]:
    """Where the measurements' unknowns are; sigma from the core, which they follow, and from their own rows.

    Args:
        solution: The solution.
        spread: The covariance of all parameters.
    """
    problem = solution.problem
    data, unknowns = problem.data, problem.data.unknowns
    if not unknowns.names:
        return ()
    at = at_parameters(problem, solution.parameters)
    left = eliminated(by_columns_of(problem, spread.variables), solution.parameters)
    counts = np.zeros(len(unknowns.names), dtype=np.int64)
    for s in data.series:
        owners = unknowns.owners[s.nuisances[s.train]]
        for k, column in enumerate(owners.T if s.kind.ends else ()):
            new = np.all(owners[:, :k] != column[:, None], axis=1)
            counts += np.bincount(column[new], minlength=len(counts))
    found, first = [], np.cumsum([0, *unknowns.sizes])
    names = list(zip(unknowns.letters, unknowns.names, strict=True))
    for i, letter in enumerate(unknowns.letters):
        if letter == BEHIND:
            continue
        span = slice(first[i], first[i + 1])
        columns = at.columns[span] - problem.variables.n_columns
        values, C = at.coordinates[span], np.zeros((unknowns.sizes[i],) * 2)
        if np.all(columns >= 0):
            F, S = left.follow[columns], left.inverse[columns]
            C = spread.covariance(F) + S @ S.T
            C[left.unknown[columns]] = np.nan
        elif not unknowns.known[i]:
            C[:] = np.nan
        units = unknowns.units[i]
        if letter == "F":
            k = names.index((BEHIND, unknowns.names[i]))
            values, C, units = _as_plane(at.coordinates[first[k] : first[k + 1]], values, C)
        sigma = np.sqrt(np.diag(C))
        found.append(PointEstimate(unknowns.names[i], int(counts[i]), values, sigma, KINDS[letter], units))
    return tuple(found)


def _as_plane(behind: Floats, through: Floats, C: Floats) -> tuple[Floats, Floats, tuple[str, ...]]:
    """Unit normal and distance of a plane (see `PlaneDistance`), and their covariance."""
    step = through - behind
    length = np.linalg.norm(step)
    n = step / length
    tilt = (np.eye(3) - np.outer(n, n)) / length
    J = np.vstack([tilt, n + through @ tilt])
    return np.append(n, n @ through), J @ C @ J.T, ("", "", "", "m")
