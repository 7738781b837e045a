"""Which configurations to measure next, so that changes that the rows leave open are distinguished.

Of random configurations those are taken, one after the other, that make the least difference of two changes largest.
With a_i d_i what change i makes of all rows, old and new, and what is known and free fitted, `D_ij` is what is left of
it when change j has been fitted. If i is true, chi-square with j is above that with i by about `D_ij + 1 +- 2
sqrt(D_ij)`; so D must reach `(sqrt(threshold) + MARGIN)^2`.

A row at a new configuration is like one there is: of the same table, noise and target. Instruments that measure at a
configuration of one's choice have such rows: poses, positions, orientations, and pairs of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fg_calib.graph import Problem, problem_at
from fg_calib.inputs import Floats, FrozenArrays, Integers
from fg_calib.measurements import Measurements, build_dataset
from fg_calib.monitoring.hypotheses import HypothesisTest, columns_of, motion, quantile
from fg_calib.monitoring.new_data import Calibrated, Linear, linearised
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Pairing
from fg_calib.robot import random_readings

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
    new = _linearised_candidates(rows, q) if len(changes) > 1 else None
    if new is None:
        return None
    whole, of = new
    n = rows.system.shape[1]
    spans = np.split(np.arange(sum(len(f.change) for f in changes)), np.cumsum([len(f.change) for f in changes])[:-1])
    old = np.hstack([rows.system, *(rows.stacked(columns_of(f.hypothesis, calibrated, rows)) for f in changes)])
    wide = np.hstack([whole.columns @ rows.directions, *(columns_of(f.hypothesis, calibrated, whole) for f in changes)])
    grams = np.array([wide[of == k].T @ wide[of == k] for k in range(len(q))])
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


def _linearised_candidates(rows: Linear, q: Floats) -> tuple[Linear, Integers] | None:
    """Rows at configurations like those of the first table that is measured where one likes, and which is of which."""
    problem = rows.placed.problem
    tables = list(problem.data.tables)
    free = [i for i, t in enumerate(tables) if t.model in (*POSE_MODELS, *PAIR_MODELS)]
    if not free:
        return None
    table, m = tables[free[0]], tables[free[0]].measurements
    if m.pairs is None:
        like = m.select(np.arange(len(q)) % m.n_configurations)  # the noise and target of rows there are
        made = replace(like, readings=q, ids=np.arange(len(q)).astype(str))
    else:
        made = _pairs_like(m, q)
    tables[free[0]] = replace(table, measurements=made, pairing=Pairing("star"))
    data = build_dataset(problem.robot, tables)
    if data.unknowns.keys != problem.data.unknowns.keys:  # too many targets for so few configurations
        return None
    options = replace(problem.options, encoder="propagated", pair_errors="independent", loss="none")
    at = problem_at(problem.robot, data, options, problem.variables, problem.start)
    columns, joints, r = linearised(at)
    whole = replace(rows, columns=columns, joints=joints, r=r, placed=replace(rows.placed, problem=at))
    return whole, _configuration_of_rows(at, free[0])


def _pairs_like(m: Measurements, q: Floats) -> Measurements:
    """Each configuration as a pair with the first one, with figures and noise of pairs there are."""
    assert m.pairs is not None
    n = len(q)
    pairs = m.pairs.select(np.arange(n - 1) % len(m.pairs.a))
    columns = {name: getattr(pairs, name) for name in ("distance", "angle", "sigma_distance", "sigma_angle")}
    columns = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    ends = {"a": np.zeros(n - 1, dtype=np.int64), "b": np.arange(1, n)}
    return Measurements.from_arrays(q, pairs={**ends, **columns}, sigma_joint=m.sigma_joint, source=m.source)


def _configuration_of_rows(problem: Problem, table: int) -> Integers:
    """The configuration of each whitened row within a table, of a pair the second; -1 for rows of other tables."""
    found = []
    for row_set in problem.rows:
        for part in row_set.parts:
            k = part.block.ends.max(axis=1) if part.table == table else np.full(part.block.n, -1)
            found.append(np.repeat(k, part.block.residual_dim))
    return np.concatenate(found)
