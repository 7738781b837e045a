"""A problem linearised at some values: the Gauss-Newton step there, and how far the optimum still is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib.errors import CalibrationError, SolverError
from fg_calib.graph.factors import Variables, dense
from fg_calib.graph.normal_system import determined, eliminate
from fg_calib.graph.problem import Problem

Floats = NDArray[np.float64]

WEAKEST = 0.1
"""Signal-to-noise ratio below which a direction is not taken for weaker: rows are bent by no more than that."""


class Linearised:
    """A problem linearised at some values.

    Attributes:
        values: GTSAM's values.
        cost: Half the sum of squared whitened residuals.
        decrement: Length of the Gauss-Newton step along determined directions, [sigma].
        step: The step itself, shape (n_columns + n_nuisance,), of minimum norm in units of the arm's geometry.
        follow: What nuisance coordinates do as the core moves, shape (n_nuisance, n_columns).
        spread: A square root S of the core's covariance S S^T, weak directions cut short, shape (n_columns, rank).
        rounding: What rounding of the residuals makes of the decrement, [sigma].
        at_rounding: Whether rounding of the cost is above the decrease that the step promises.
    """

    def __init__(self, problem: Problem, values: gtsam.Values) -> None:
        variables = problem.variables
        with in_one_line(variables):
            A, b = dense(problem.graph.linearize(values), variables.keys)
            if not np.isfinite(A).all():
                raise SolverError("a derivative of a factor that somebody added is not finite")
            left = eliminate(A, b, variables.n_columns)
            self._sizes = variables.prior_scales
            scaled, n = left.A * self._sizes, len(self._sizes)
            tall = np.vstack([scaled, np.zeros((max(n - len(scaled), 0), n))])  # so that Vt is square
            U, s, Vt = np.linalg.svd(tall, full_matrices=False)
        rank = determined(s)
        along = U[: len(left.b), :rank].T @ left.b
        core = self._sizes * (Vt[:rank].T @ (along / s[:rank]))
        self.spread: Floats = self._sizes[:, None] * Vt[:rank].T / np.maximum(s[:rank], WEAKEST)
        self.values = values
        self.cost = 0.5 * float(b @ b)
        self.decrement = float(np.hypot(np.linalg.norm(left.own), np.linalg.norm(along)))
        self.step: Floats = np.concatenate([core, left.inverse @ left.own + left.follow @ core])
        self.rounding = 10.0 * float(np.finfo(float).eps) / variables.robot.scale_of("rad") * float(s.max(initial=0.0))
        self.at_rounding = 0.5 * self.decrement**2 <= 10.0 * self.rounding * np.sqrt(2.0 * self.cost)
        self._loose, self.follow = Vt[rank:], left.follow
        self._information = s[:rank, None] * Vt[:rank]
        self._variables = variables

    def product(self, a: Floats, b: Floats) -> float:
        """Scalar product of two steps of the core, in sigma."""
        n = len(self._sizes)
        a, b = (self._information @ (step[:n] / self._sizes) for step in (a, b))
        return float(a @ b)

    def decrement_to(self, values: gtsam.Values) -> float:
        """How far some other values are, in sigma as seen from here."""
        step = self._variables.step(self.values, values)[: len(self._sizes)]
        return float(np.linalg.norm(self._information @ (step / self._sizes)))

    def remove_gauge_drift(self, step: Floats) -> Floats:
        """A step with the same effect on every row, but none on the core's undetermined directions."""
        n = len(self._sizes)
        drift = self._sizes * (self._loose.T @ (self._loose @ (step[:n] / self._sizes)))
        held: Floats = step - np.concatenate([drift, self.follow @ drift])
        return held


@contextmanager
def in_one_line(variables: Variables) -> Iterator[None]:
    """What GTSAM, LAPACK or a factor that somebody added raises in the block becomes a `SolverError`."""
    try:
        yield
    except CalibrationError:
        raise
    except Exception as error:
        raise SolverError(_in_words(str(error) or type(error).__name__, variables)) from error


def _in_words(message: str, variables: Variables) -> str:
    """GTSAM's message in one line, with the key it names as our variable and its parameters."""
    found = re.search(r"Symbol:\s*(\w)(\d+)", message)
    if "ndetermin" in message and found:
        key = gtsam.symbol(found.group(1), int(found.group(2)))
        return f"the linear system has no unique solution near {variables.describe(key)}"
    return " ".join(message.split())
