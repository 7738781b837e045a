"""Which configurations to measure next, so that changes that the rows leave open are distinguished.

Of random configurations those are taken, one after the other, that make the least difference of two changes largest.
With a_i d_i what change i makes of all rows, old and new, and what is known and free fitted, `D_ij` is what is left of
it when change j has been fitted. If i is true, chi-square with j is above that with i by about `D_ij + 1 +- 2
sqrt(D_ij)`; so D must reach `(sqrt(threshold) + MARGIN)^2`.

A row at a new configuration is a pose, position or orientation of the tool, with the noise of such rows that there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fg_calib.inputs import POSE_MODELS, Floats, FrozenArrays, Integers
from fg_calib.monitoring.hypotheses import HypothesisTest, motion, quantile
from fg_calib.monitoring.new_data import Linear
from fg_calib.monitoring.prior_information import Calibrated
from fg_calib.robot import forward, random_readings

N_CANDIDATES = 200
"""Configurations to choose from."""

MOST_ADVISED = 12
"""Configurations that are advised at most."""

LEAST = 0.1
"""Sigma by which the first configuration must distinguish changes; else more of them do not either."""

MARGIN = 2.5
"""Sigma by which the difference is to exceed the threshold: so a difference is missed less often than 1 in 100."""


@dataclass(frozen=True)
class Advice(FrozenArrays):
    """Configurations that would distinguish changes.

    Attributes:
        readings: The configurations in their order, shape (n, n_joints), [rad] (prismatic: [m]).
        between: The two changes that differ least with all of them.
        apart: Distance of the tool's positions there by these two, shape (n,), [m].
        sigma: The root of the least difference after each, in sigma, shape (n,).
        needed: What it must reach.
        enough: Whether it does.
    """

    readings: Floats
    between: tuple[tuple[str, ...], tuple[str, ...]]
    apart: Floats
    sigma: Floats
    needed: float
    enough: bool


def advise_configurations(
    calibrated: Calibrated, rows: Linear, likely: Sequence[HypothesisTest], probability: float
) -> Advice | None:
    """Configurations that distinguish the likely changes; None where no instrument can measure them or none helps.

    Args:
        calibrated: The arm.
        rows: The rows there are.
        likely: Changes that these leave open.
        probability: Probability of calling the true one distinguished, for one of them.
    """
    changes = [f for f in likely if f.hypothesis.kind != "row"]
    q = random_readings(calibrated.robot, N_CANDIDATES, np.random.default_rng(0))
    J = _candidate_rows(rows, q) if len(changes) > 1 else None
    if J is None:
        return None
    n, v = rows.system.shape[1], rows.placed.problem.variables
    spans = np.split(np.arange(sum(len(f.change) for f in changes)), np.cumsum([len(f.change) for f in changes])[:-1])
    moves = np.hstack([f.hypothesis.directions for f in changes])
    old = np.hstack([rows.system, rows.stacked(rows.of_arm @ moves)])
    wide = np.concatenate([J @ rows.directions[: v.n_columns], J[:, :, : v.n_robot_columns] @ moves], axis=2)
    grams = np.swapaxes(wide, 1, 2) @ wide
    needed = float(np.sqrt(quantile(probability, max(f.k for f in changes)))) + MARGIN
    total, pair = old.T @ old, (0, 1)
    chosen: list[int] = []
    sigma: list[float] = []
    while len(chosen) < MOST_ADVISED and (not sigma or sigma[-1] < needed):
        differences = [_least_difference(total + gram, n, spans, changes) for gram in grams]
        best = int(np.argmax([D for D, _ in differences]))
        D, pair = differences[best]
        total = total + grams[best]
        chosen.append(best)
        sigma.append(float(np.sqrt(max(D, 0.0))))
        if sigma[0] < LEAST:
            return None
    one, other = (changes[i] for i in pair)
    shift = (motion(calibrated, one, q[chosen]) - motion(calibrated, other, q[chosen]))[:, 1]
    between = one.hypothesis.names, other.hypothesis.names
    return Advice(q[chosen], between, np.linalg.norm(shift, axis=1), np.array(sigma), needed, sigma[-1] >= needed)


def _least_difference(
    gram: Floats, n: int, spans: Sequence[Integers], changes: Sequence[HypothesisTest]
) -> tuple[float, tuple[int, int]]:
    """The least part of a change that is left with another fitted, and the numbers of the two.

    Args:
        gram: Of the columns that are fitted, then of those of the changes.
        n: How many are fitted.
        spans: Columns of each change, after these.
        changes: The changes with their sizes.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram)[:n], 1e-300))
    fitted = np.linalg.pinv(gram[:n, :n] * np.outer(scale, scale), rcond=1e-13, hermitian=True) * np.outer(scale, scale)
    S = gram[n:, n:] - gram[n:, :n] @ fitted @ gram[:n, n:]
    found = {}
    for i, at in enumerate(spans):
        for j, other in enumerate(spans):
            if i != j:
                d = changes[i].change
                t = S[np.ix_(other, at)] @ d
                left = d @ S[np.ix_(at, at)] @ d - t @ np.linalg.pinv(S[np.ix_(other, other)], rcond=1e-12) @ t
                found[i, j] = float(left)
    pair = min(found, key=found.__getitem__)
    return found[pair], pair


def _candidate_rows(rows: Linear, q: Floats) -> Floats | None:
    """How poses that are measured like those of the first table of these depend on the core.

    Returns:
        In sigma of their noise, shape (n, residual_dim, n_columns); None where there is no such table.
    """
    problem = rows.placed.problem
    of_poses = [i for i, table in enumerate(problem.data.tables) if table.model in POSE_MODELS]
    if not of_poses:
        return None
    table = problem.data.tables[of_poses[0]]
    m, chain = table.measurements, problem.variables.at(problem.start).chains[of_poses[0]]
    J = forward(chain, problem.robot.trig(q)).jacobian
    of = zip(POSE_MODELS[str(table.model)], (m.sigma_position, m.sigma_orientation), (J[:, 3:], J[:, :3]), strict=True)
    found = [of_tool / np.sqrt(np.nanmean(sigma**2)) for uses, sigma, of_tool in of if uses and sigma is not None]
    return np.concatenate(found, axis=1)
