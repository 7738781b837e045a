"""Whether something moved while a table was measured: a target that was bumped, a tracker or a base that was shifted.

The tool, or the base, gets a small motion of its own from one row of the table on, whichever makes chi-square smallest;
that as much is gained by chance is judged by an F test (see `structure`) for each row that was tried (Bonferroni).

Whatever else is wrong with a table, a motion from some row on takes up part of it: a frame or a tool that was
forgotten, effects that are not modelled, outliers near an end. So nearly all of the misfit has to go with the change,
and the change has to explain most of what constant small motions of all links leave, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.diagnostics.unmodelled_effects import LINK, MAX_ROWS, basis_of, with_link_motions
from fg_calib.graph.factors import prior_rows
from fg_calib.graph.solver import Solution
from fg_calib.measurements import residuals

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

LEAST_SIDE = 6
"""Configurations before and after a change."""

MOST_TRIED = 100
"""Rows at which a change is tried, evenly spaced if there are more."""

CERTAIN = 1e-6
"""Probability below which a change is no chance."""

LEFT = 0.5
"""Part of chi-square that a change leaves at most: what is not modelled may follow the order of a table a little."""

EXCESS_LEFT = 0.25
"""Part of the excess of chi-square over its degrees of freedom that it leaves at most."""

LOUD = 25.0
"""Reduced chi-square that it leaves at most: noise is not stated too small by more than a factor of five."""

TYPICAL = 0.8
"""Part of the median residual that it leaves at most: an outlier near an end of the table does not move it."""


@dataclass(frozen=True)
class Change:
    """Something that moved between two rows of a table.

    Attributes:
        what: `tool` or `base`.
        configuration: The first after it, by its number among all.
        left: Part of chi-square that is left with a tool or a base of its own from there on.
    """

    what: str
    configuration: int
    left: float


def find_change(solution: Solution) -> Change | None:
    """What moved while a table was measured; None if nothing did, or where it cannot be told.

    Note:
        It is looked for in one table of poses, positions or orientations, without robust losses.
    """
    problem, state = solution.problem, solution.problem.state
    other = (
        problem.data.unknowns.names or problem.has_more or state.weights is not None or state.joint_errors is not None
    )
    pairs = any(part.block.kind.ends != 1 for rows in problem.rows for part in rows.parts)
    several = len(problem.data.tables) > 1 or any(rows.shared is not None for rows in problem.rows)
    if other or pairs or several or problem.n_residuals > MAX_ROWS:
        return None
    (chain,), names = with_link_motions(problem, solution.parameters)
    of_model = np.array([not name.startswith(LINK) for name in names])
    linear, configurations = [], []
    for rows in problem.rows:
        for part in rows.parts:
            r, J = residuals.linearise(part.block, chain)
            linear.append(np.concatenate([J, r[:, :, None]], axis=2).reshape(r.size, -1))
            configurations.append(np.repeat(part.block.ends[:, 0], part.block.residual_dim))
    r_prior, J_prior = prior_rows(problem.variables, solution.parameters)
    data, at = np.concatenate(linear), np.concatenate(configurations)
    fitted = basis_of(np.concatenate([data[:, :-1][:, of_model], J_prior]), np.zeros((len(data) + len(r_prior), 0)))
    r = np.concatenate([data[:, -1], r_prior])
    n = problem.n_independent + len(r_prior)
    steps = _Steps(fitted, r - fitted @ (fitted.T @ r), n - fitted.shape[1])
    fitted = np.hstack([fitted, steps.new(data[:, :-1][:, ~of_model])])
    beside = _Steps(fitted, r - fitted @ (fitted.T @ r), n - fitted.shape[1])
    links = {"tool": f"{LINK}{problem.robot.n_joints}:", "base": f"{LINK}0:"}
    motions = {what: data[:, [i for i, n in enumerate(names) if n.startswith(s)]] for what, s in links.items()}
    found = steps.best(motions, at)
    return found if found is not None and beside.explains(motions[found.what], at, found.configuration) else None


@dataclass(frozen=True)
class _Steps:
    """A fit, and what motions from some row on would gain.

    Attributes:
        fitted: Basis of the model's columns, shape (n, rank).
        r: Residuals, shape (n,).
        n_left: Their degrees of freedom.
    """

    fitted: Floats
    r: Floats
    n_left: int

    def best(self, motions: dict[str, Floats], at: Integers) -> Change | None:
        """The change that explains most, if it is no chance.

        Args:
            motions: Derivatives in small motions by what moves, shape (n_data, 6).
            at: Configuration of each row, shape (n_data,).
        """
        there = np.unique(at)
        first = there[LEAST_SIDE : len(there) - LEAST_SIDE + 1]
        first = first[np.unique(np.linspace(0, len(first) - 1, min(MOST_TRIED, len(first))).astype(np.int64))]
        found = [(*self._gain(J * (at >= k)[:, None]), what, int(k)) for k in first for what, J in motions.items()]
        if not found:
            return None
        p, left, what, k = min(found)
        new = self.new(motions[what] * (at >= k)[:, None])
        before, after = (np.median(np.abs(r[: len(at)])) for r in (self.r, self.r - new @ (new.T @ self.r)))
        total, n_left = float(self.r @ self.r), self.n_left - new.shape[1]
        excess = max(total - self.n_left, 0.0)
        enough = left * total - n_left <= EXCESS_LEFT * excess and left * total <= LOUD * n_left
        sure = p * len(found) < CERTAIN and left <= LEFT and after <= TYPICAL * before
        return Change(what, k, left) if sure and enough else None

    def explains(self, motion: Floats, at: Integers, first: int) -> bool:
        """Whether a change explains most of what this fit leaves, and is no chance.

        Args:
            motion: Derivatives in the motion of what moves, shape (n_data, 6).
            at: Configuration of each row, shape (n_data,).
            first: The first configuration after it.
        """
        p, left = self._gain(motion * (at >= first)[:, None])
        return p < CERTAIN and left <= LEFT

    def new(self, columns: Floats) -> Floats:
        """A basis of what columns of the data add to the fit."""
        return basis_of(
            np.concatenate([columns, np.zeros((len(self.r) - len(columns), columns.shape[1]))]), self.fitted
        )

    def _gain(self, columns: Floats) -> tuple[float, float]:
        """P-value of what columns explain, and the part of chi-square that they leave."""
        new = self.new(columns)
        total, m = float(self.r @ self.r), new.shape[1]
        drop, n_left = float(np.sum((new.T @ self.r) ** 2)), self.n_left - m
        if not m or n_left < 1:
            return 1.0, 1.0
        ratio = (drop / m) / max((total - drop) / n_left, 1e-300)
        return float(special.fdtrc(m, n_left, ratio)), (total - drop) / max(total, 1e-300)
