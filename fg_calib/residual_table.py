"""Every scalar residual, train and test, before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fg_calib import residuals
from fg_calib.problem import PAIR_KINDS, POSE_KINDS, Problem, all_rows
from fg_calib.solver import Solution

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class ResidualTable:
    """Every scalar residual, train and test, before and after; [m] and [rad].

    Attributes:
        kind: `distance`, `angle`, `position.x`, ..., `orientation.z` of each row, shape (n,).
        a: Row of the (first) configuration, shape (n,).
        b: Row of the second configuration, -1 for poses, shape (n,).
        test: Predicted only, shape (n,).
        reason: Why a row takes no part, empty where it does, shape (n,).
        measured: Measured value; nan for orientations, shape (n,).
        before: Residual with the arm at nominal, shape (n,).
        after: Residual at the estimate, shape (n,).
        sigma: 1 sigma of the residual, shape (n,).
    """

    kind: NDArray[np.str_]
    a: Integers
    b: Integers
    test: Booleans
    reason: NDArray[np.str_]
    measured: Floats
    before: Floats
    after: Floats
    sigma: Floats

    def rms(self) -> dict[str, dict[str, dict[str, float]]]:
        """RMS by split, kind (the norm of a position's or orientation's three components), before and after."""
        table: dict[str, dict[str, dict[str, float]]] = {"train": {}, "test": {}}
        used = self.reason == ""
        family = np.char.partition(self.kind, ".")[:, 0] if len(self.kind) else self.kind
        for split, of_split in (("train", ~self.test), ("test", self.test)):
            for name in ("position", "orientation", "distance", "angle"):
                rows = used & of_split & (family == name)
                if rows.any():
                    per_row = 3.0 if name in ("position", "orientation") else 1.0
                    table[split][name] = {
                        when: float(np.sqrt(per_row * np.mean(values[rows] ** 2)))
                        for when, values in (("before", self.before), ("after", self.after))
                    }
        return table


def residual_table(solution: Solution) -> ResidualTable:
    """Every scalar residual, train and test, with the arm at nominal and at the estimate."""
    problem = solution.problem
    block = all_rows(problem)
    chain = problem.variables.chain
    before, after = (residuals.residual(block, chain.at(p)) for p in (solution.before, solution.parameters))
    if problem.pairs is not None:
        return _pair_table(problem, before, after)
    return _pose_table(problem, before, after)


def _pair_table(problem: Problem, before: Floats, after: Floats) -> ResidualTable:
    pairs, judgement = problem.pairs, problem.judgement
    assert pairs is not None
    assert judgement is not None
    kinds = PAIR_KINDS[problem.settings.model]
    reasons = np.full((pairs.n_pairs, 2), "", dtype="<U20")
    for reason, mask in judgement.reasons.items():
        named = [kind in reason for kind in ("distance", "angle")]
        reasons[np.outer(mask, named if any(named) else (True, True))] = reason
    measured = np.stack([pairs.distance, pairs.angle], axis=1)
    wide_before, wide_after = np.full_like(measured, np.nan), np.full_like(measured, np.nan)
    wide_before[:, kinds], wide_after[:, kinds] = before, after
    rows, columns = np.nonzero(np.isfinite(measured))
    return ResidualTable(
        kind=np.array(["distance", "angle"])[columns],
        a=pairs.a[rows],
        b=pairs.b[rows],
        test=pairs.test[rows],
        reason=reasons[rows, columns],
        measured=measured[rows, columns],
        before=wide_before[rows, columns],
        after=wide_after[rows, columns],
        sigma=problem.sigma[rows, columns],
    )


def _pose_table(problem: Problem, before: Floats, after: Floats) -> ResidualTable:
    m, n = problem.measurements, problem.measurements.n_configurations
    kinds = POSE_KINDS[problem.settings.model]
    labels = [
        f"{what}.{axis}"
        for what, wanted in zip(("orientation", "position"), kinds, strict=True)
        if wanted
        for axis in "xyz"
    ]
    measured = np.full((n, 6), np.nan)
    if m.position is not None:
        measured[:, 3:] = m.position
    wanted = np.repeat(kinds, 3)
    return ResidualTable(
        kind=np.tile(labels, n),
        a=np.repeat(np.arange(n), len(labels)),
        b=np.full(n * len(labels), -1),
        test=np.repeat(m.test, len(labels)),
        reason=np.full(n * len(labels), "", dtype="<U20"),
        measured=measured[:, wanted].ravel(),
        before=before.ravel(),
        after=after.ravel(),
        sigma=problem.sigma[:, wanted].ravel(),
    )
