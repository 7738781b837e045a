"""Criteria of designs, as each was published, and the candidate that is best by them.

With C the covariance of what can be determined, W the task's quadratic form, `S = (P C P^T)^-1` the information of the
core with the nuisances eliminated, in changes of ordinary size, and s_1 >= ... >= s_L the singular values whose squares
are the eigenvalues of S:

| name | smaller is better | |
|---|---|---|
| `I` | `tr(W C)` | mean square error of the tool over the task (Fedorov 1972) |
| `D`, `O1` | `-log det S` | volume of the ellipsoid; `O1 = (s_1 ... s_L)^(1/L) / sqrt(m)` (Borm and Menq 1991) |
| `A` | `tr S^-1` | mean variance |
| `E`, `O3` | `-s_L` | the worst direction (Nahvi et al. 1994) |
| `O2` | `-s_L / s_1` | inverse condition number (Driels and Pathre 1990) |
| `O4` | `-s_L^2 / s_1` | noise amplification (Nahvi and Hollerbach 1996) |
| `O5` | `sum 1 / s_i` | (Sun and Hollerbach 2008) |

Each is a function of `V = P C P^T`, the covariance of linear functions P of the parameters. For `I`, `P^T P = W`; for
all others P is the core and V is `S^-1`. A candidate's rows A change V by `-B^T (1 + A C A^T)^-1 B` with `B = A C P^T`
(Woodbury). This is computed for the candidates of the largest gain to first order, `|B U D^(1/2)|^2`, where U are the
eigenvectors of V and D the derivatives of the criterion in their variances; of O2 and O4 in the largest alone.

References:
    Fedorov (1972), Theory of Optimal Experiments. Academic Press.
    Borm, Menq (1991), Determination of optimal measurement configurations for robot calibration based on observability
    measure. International Journal of Robotics Research 10(1).
    Driels, Pathre (1990), Significance of observation strategy on the design of robot calibration experiments. Journal
    of Robotic Systems 7(2).
    Nahvi, Hollerbach, Hayward (1994), Calibration of a parallel robot using multiple kinematic closed loops. ICRA.
    Nahvi, Hollerbach (1996), The noise amplification index for optimal pose selection in robot calibration. ICRA.
    Sun, Hollerbach (2008), Observability index selection for robot calibration. ICRA.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
import scipy.linalg

from fg_calib.designs.information import System
from fg_calib.inputs import Booleans, Floats

Criterion = Literal["I", "D", "A", "E", "O1", "O2", "O3", "O4", "O5"]

N_TRIED = 128
"""Candidates whose criterion is computed at a step: those of the largest gain to first order."""

_TINY = 1e-300


def _of_variances(formula: Callable[[Floats], Floats]) -> Callable[[Floats], Floats]:
    """A criterion by its formula for the variances, ascending along the first axis."""
    return lambda V: formula(np.moveaxis(np.maximum(np.linalg.eigvalsh(V), _TINY), -1, 0))


def _worst(w: Floats) -> Floats:
    """Weights that count the worst direction alone."""
    return np.asarray(np.arange(len(w)) == len(w) - 1, dtype=np.float64)


_Formula = Callable[[Floats], Floats]

FORMULAS: dict[Criterion, tuple[_Formula, _Formula]] = {
    **dict.fromkeys(("I", "A"), (lambda V: np.asarray(np.trace(V, axis1=-2, axis2=-1)), np.ones_like)),
    **dict.fromkeys(("D", "O1"), (lambda V: np.asarray(np.linalg.slogdet(V)[1]), lambda w: w**-0.5)),
    **dict.fromkeys(("E", "O3"), (_of_variances(lambda w: -(w[-1] ** -0.5)), _worst)),
    "O2": (_of_variances(lambda w: -((w[0] / w[-1]) ** 0.5)), _worst),
    "O4": (_of_variances(lambda w: -(w[0] ** 0.5) / w[-1]), _worst),
    "O5": (_of_variances(lambda w: np.sum(w**0.5, axis=0)), lambda w: w**-0.25),
}
"""Each criterion by covariances V, shape (..., p, p), and the roots of its derivatives in the variances of V."""


class Measure:
    """A criterion on a system: smaller is better.

    Args:
        criterion: Which.
        system: The system.
    """

    def __init__(self, criterion: Criterion, system: System) -> None:
        self.system = system
        self._P = _root(system.task).T if criterion == "I" else system.core
        self._formula, self._weights = FORMULAS[criterion]

    def value(self, information: Floats) -> float:
        """The criterion for a matrix of information, shape (n, n)."""
        half = scipy.linalg.solve_triangular(np.linalg.cholesky(information), self._P.T, lower=True)
        return float(self._formula(half.T @ half))

    def best(self, information: Floats, allowed: Booleans) -> tuple[int, float]:
        """The candidate that makes the criterion smallest, and its value with that.

        Args:
            information: Information of what was chosen before, shape (n, n).
            allowed: Candidates that may be taken, shape (n_candidates,); at least one.
        """
        rows, (n, _, m) = self.system.rows, self.system.rows.shape
        half = scipy.linalg.solve_triangular(np.linalg.cholesky(information), np.eye(m), lower=True)
        C = half.T @ half
        K = C @ self._P.T
        V = self._P @ K
        w, U = np.linalg.eigh(V)
        X = K @ U * self._weights(np.maximum(w, _TINY))
        gain = np.sum(np.reshape(rows.reshape(-1, m) @ X, (n, -1)) ** 2, axis=1)
        tried = np.argsort(np.where(allowed, -gain, np.inf), kind="stable")[: min(N_TRIED, int(allowed.sum()))]
        A = rows[tried]
        B, G = A @ K, np.eye(A.shape[1]) + A @ C @ np.swapaxes(A, 1, 2)
        values = self._formula(V - np.swapaxes(B, 1, 2) @ np.linalg.solve(G, B))
        best = int(np.argmin(values))
        return int(tried[best]), float(values[best])


def _root(W: Floats) -> Floats:
    """X with `X X^T = W`, of as many columns as W has directions."""
    w, V = np.linalg.eigh(W)
    kept = w > 1e-15 * w[-1]
    return V[:, kept] * np.sqrt(w[kept])
