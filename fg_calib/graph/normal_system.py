r"""The one linear Gaussian system of a calibration: step, covariance, rank, error states and residual statistics.

Linearised and whitened by private noise, measurements, priors and other factors read

    r + A s = L z + e,   e ~ N(0, 1),   z ~ N(0, 1),

s a step of the parameters: those of the *core* (robot and measurement frames) and *landmarks*, nuisance parameters
with or without priors. Error states z are eliminated first (see `error_states`), then the landmarks by QR. A singular
value decomposition of what is left gives rank, null space, step and covariance of the core. Everything else is the
posterior of linear functions of (s, z): with R R^T the covariance of the parameters and Z = S^-1 L^T A,

    var(A_i s - L_i z) = L_i S^-1 L_i^T + |(A_i - L_i Z) R|^2.

References:
    Baarda (1968), A testing procedure for use in geodetic networks. Cook, Weisberg (1982), Residuals and influence.
    Foerstner (1979), Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten. AVN 86.
    Gilmour, Thompson, Cullis (1995), Average information REML. Biometrics 51.
"""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import scipy.sparse

from fg_calib.graph.error_states import Eliminated, SchurComplement
from fg_calib.inputs import Booleans, Floats

Sparse = scipy.sparse.csr_array

RANK_TOLERANCE = 1e-10
"""Singular values below this share of the largest are those of directions that the data do not determine."""

SIGNAL_FLOOR = 1e-3
"""Nor are directions with a smaller signal-to-noise ratio: sigma above 1000 ordinary changes, 1 rad or the reach."""

SUPPORT_TOLERANCE = 1e-6
"""A parameter takes part in a direction if its unit-free share in it is above this."""

BATCH = 512
"""Measurements whose covariance is worked out at once."""


def determined(singular_values: Floats, floor: float = SIGNAL_FLOOR) -> int:
    """Number of determined directions: singular values above `RANK_TOLERANCE` of the largest, and above the floor."""
    return int(np.sum(singular_values > max(RANK_TOLERANCE * singular_values.max(initial=0.0), floor)))


def identifiable_subset(rows: Floats, scales: Floats, ranks: Sequence[int]) -> list[int]:
    """Columns that can be estimated together, the others held: of those that only act together some are given up.

    Args:
        rows: Whitened derivatives, shape (m, n).
        scales: A change of ordinary size in each column, shape (n,).
        ranks: Rank of each column in the order of keeping, 0 first.
    """
    n, J = len(scales), rows * scales
    _, s, Vt = np.linalg.svd(np.vstack([J, np.zeros((n, n))]), full_matrices=False)
    null = Vt[determined(s) :]
    dead = np.linalg.norm(J, axis=0) <= max(RANK_TOLERANCE * s.max(initial=0.0), SIGNAL_FLOOR)
    order = sorted(np.flatnonzero(~dead).tolist(), key=lambda i: (-ranks[i], i))
    given_up = first_independent(null[:, order], max(len(null) - int(dead.sum()), 0))
    return sorted(set(order).difference(order[i] for i in given_up))


def first_independent(N: Floats, count: int) -> list[int]:
    """The first columns of N, in order, that are clearly linearly independent."""
    chosen, basis = list[int](), np.zeros((len(N), 0))
    for clearly in (1e-2, SUPPORT_TOLERANCE, 0.0):
        for i in range(N.shape[1]):
            if len(chosen) == count:
                return chosen
            rest = N[:, i] - basis @ (basis.T @ N[:, i])
            rest -= basis @ (basis.T @ rest)
            if i not in chosen and np.linalg.norm(rest) > clearly:
                chosen.append(i)
                basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return chosen


def eliminate(A: Floats, b: Floats, n_core: int) -> Eliminated:
    """Eliminate all but the first `n_core` columns of a linear system |A x - b|^2.

    What is left of a core column that the landmark columns explain altogether is rounding, and set to zero. Directions
    of the landmark columns that nothing determines stay where they are.
    """
    core, landmarks = A[:, :n_core], A[:, n_core:]
    if not landmarks.size:
        return Eliminated(np.zeros(0), core, b, np.zeros((0, n_core)), lambda y: y, np.zeros(0, dtype=np.bool_))
    Q, inverse, unknown = _basis_of(landmarks)
    explained = Q.T @ core
    left = core - Q @ explained
    left = left - Q @ (Q.T @ left)  # once more: rounding of the first time
    left[:, np.linalg.norm(left, axis=0) <= RANK_TOLERANCE * np.linalg.norm(core, axis=0)] = 0.0
    own = Q.T @ b
    return Eliminated(own, left, b - Q @ own, -inverse @ explained, lambda y: inverse @ y, unknown)


def eliminate_more(first: Eliminated, rows: Floats, n_core: int) -> Eliminated:
    """Eliminate all but the first `n_core` of the columns that an elimination left.

    Args:
        first: The elimination.
        rows: More rows [A r] in the columns that it left.
        n_core: Number of columns of the core.
    """
    A, b = np.vstack([rows[:, :-1], first.A]), np.concatenate([-rows[:, -1], first.b])
    then, (of_core, of_others) = eliminate(A, b, n_core), np.split(first.follow, [n_core], axis=1)

    def spread(y: Floats) -> Floats:
        others = then.spread(y[first.rank :])
        return np.concatenate([first.spread(y[: first.rank]) + of_others @ others, others])

    return Eliminated(
        np.concatenate([first.own, then.own]),
        then.A,
        then.b,
        np.vstack([of_core + of_others @ then.follow, then.follow]),
        spread,
        np.concatenate([first.unknown, then.unknown]),
    )


def _basis_of(A: Floats) -> tuple[Floats, Floats, Booleans]:
    """An orthonormal basis Q of columns, S with `A S = Q`, and which columns nothing determines by themselves."""
    size = np.linalg.norm(A, axis=0)
    size[size == 0.0] = 1.0
    Q, R = np.linalg.qr(A / size)
    pivots = np.abs(np.diag(R))
    if len(Q) >= A.shape[1] and pivots.min(initial=np.inf) > RANK_TOLERANCE * pivots.max(initial=0.0):
        return Q, np.linalg.inv(R) / size[:, None], np.zeros(A.shape[1], dtype=np.bool_)
    U, s, Vt = np.linalg.svd(A / size, full_matrices=True)
    kept = np.zeros(len(Vt), dtype=np.bool_)
    kept[: len(s)] = s > RANK_TOLERANCE * s.max(initial=0.0)
    S = (Vt[kept].T / s[kept[: len(s)]]) / size[:, None]
    return U[:, : len(s)][:, kept[: len(s)]], S, np.any(np.abs(Vt[~kept]) > SUPPORT_TOLERANCE, axis=0)


class NormalSystem:
    """Linearised measurements and priors, error states and landmarks eliminated.

    Args:
        square_root: Rows [A r] of which only the Gram matrix matters, shape (k, n_all + 1): those of measurements,
            error states eliminated, and of all that is known of landmarks; or these with landmarks eliminated.
        n_core: Number of columns of the core, the first ones.
        scales: By how much each of them may be off, shape (n_core,): rank is judged in these.
        priors: Rows [K k] of priors on the core alone, shape (q, n_core + 1); none if None.
        states: How measurements follow from error states; they share none if None.
        rows: Returns [A r] of the measurements, whitened by their private noise, for statistics of residuals.

    Attributes:
        left: The rows with the landmarks eliminated, priors on the core not counted.
        singular_values: Of rows and priors, columns in `scales`, shape (n_core,).
        directions: The singular directions as rows, in the columns' own units, shape (n_core, n_core).
        rank: Number of directions of the core that rows and priors determine.
        root: R with R R^T the covariance of the core's determined directions, shape (n_core, rank).
        coordinates: Gauss-Newton step in the columns of `full_root`, shape (rank + landmarks' rank,), [sigma].
        weights: Singular value of each of these over the largest; 1 for landmarks.
        step: Gauss-Newton step of core and landmarks, of least norm in `scales`, shape (n_all,).
        decrement: Length of the step, [sigma].
        cost: Half the sum of squares of rows and priors before the step.
    """

    def __init__(
        self,
        square_root: Floats | Eliminated,
        n_core: int,
        scales: Floats,
        priors: Floats | None = None,
        states: SchurComplement | None = None,
        rows: Callable[[], Floats] | None = None,
    ) -> None:
        if isinstance(square_root, np.ndarray):
            square_root = eliminate(square_root[:, :-1], -square_root[:, -1], n_core)
        self.left = left = square_root
        k = np.zeros((0, n_core + 1)) if priors is None else priors
        A, b = np.vstack([left.A, k[:, :-1]]) * scales, np.concatenate([left.b, -k[:, -1]])
        tall = np.vstack([A, np.zeros((max(n_core - len(A), 0), n_core))])  # so that all directions are found
        U, s, Vt = np.linalg.svd(tall, full_matrices=False)
        self.singular_values: Floats = s
        self.directions: Floats = Vt * scales
        self.rank = rank = determined(s)
        self.root: Floats = self.directions[:rank].T / s[:rank]
        self.coordinates: Floats = np.concatenate([U[: len(b), :rank].T @ b, left.own])
        self.weights: Floats = np.concatenate([s[:rank] / s.max(initial=1e-300), np.ones(left.rank)])
        self.step: Floats = self.spread(self.coordinates)
        self.decrement = float(np.linalg.norm(self.coordinates))
        self.cost = 0.5 * float(sum(np.sum(part**2) for part in (left.own, left.b, k[:, -1])))
        self._gather, self._states = rows, states

    @property
    def covariance(self) -> Floats:
        """Covariance of the core, shape (n_core, n_core)."""
        return self.root @ self.root.T

    @property
    def chi_square(self) -> float:
        """Sum of squares of rows and priors after the step."""
        return 2.0 * self.cost - self.decrement**2

    def spread(self, y: Floats) -> Floats:
        """Multiply by `full_root`."""
        core = self.root @ y[: self.rank]
        return np.concatenate([core, self.left.follow @ core + self.left.spread(y[self.rank :])])

    @cached_property
    def full_root(self) -> Floats:
        """R with R R^T the covariance of core and landmarks, shape (n_all, rank + landmarks' rank)."""
        return self.spread(np.eye(self.rank + self.left.rank))

    @cached_property
    def full_covariance(self) -> Floats:
        """Covariance of core and landmarks, shape (n_all, n_all)."""
        return self.full_root @ self.full_root.T

    # Statistics of single rows and of error states.

    @cached_property
    def A(self) -> Floats:  # noqa: N802 -- the matrix of the module's head
        """Derivatives of the measurements in core and landmarks, whitened by private noise, shape (n, n_all)."""
        return self._rows[:, :-1]

    @cached_property
    def residual(self) -> Floats:
        """Marginal residuals after the step, e = r + A s, in sigma of the private noise, shape (n,)."""
        return self._rows[:, -1] + self.A @ self.step

    @cached_property
    def weighted_residual(self) -> Floats:
        """Private errors u = C^-1 e = e - L z, shape (n,)."""
        return self.states.weigh(self.residual[:, None])[:, 0]

    @cached_property
    def z(self) -> Floats:
        """Posterior mean of the error states, shape (m,), [sigma]."""
        return self.states.posterior_mean(self.residual[:, None])[:, 0]

    @cached_property
    def z_variance(self) -> Floats:
        """Posterior variance of the error states, shape (m,); their prior variance is 1."""
        return np.asarray(self.states.variances + np.sum((self._follow @ self.full_root) ** 2, axis=1))

    @cached_property
    def states(self) -> SchurComplement:
        """How the measurements follow from the error states."""
        return SchurComplement(Sparse((len(self._rows), 0))) if self._states is None else self._states

    @cached_property
    def _rows(self) -> Floats:
        assert self._gather is not None
        return self._gather()

    @cached_property
    def _follow(self) -> Floats:
        """Z = S^-1 L^T A, how error states follow the parameters, shape (m, n_all)."""
        return self.states.posterior_mean(self.A)

    # Variance components.

    def project(self, f: Floats) -> Floats:
        """Data f, shape (n, k), times P = C^-1 - C^-1 A cov A^T C^-1; P r is `weighted_residual`."""
        weighed = self.states.weigh(f)
        return np.asarray(weighed - self._weighed @ (self.full_covariance @ (self.A.T @ weighed)))

    @cached_property
    def _weighed(self) -> Sparse:
        """C^-1 A, shape (n, n_all): of error curves few columns a row."""
        return Sparse(self.A - self.states.loadings @ self._follow)

    def trace(self, E: Sparse) -> float:
        """Trace of E^T P E, E sparse, shape (n, k); of large systems an estimate (see `error_states.N_PROBES`)."""
        of_rows = E.T @ self._weighed
        return self.states.trace(E) - float(np.vdot((of_rows.T @ of_rows).toarray(), self.full_covariance))
