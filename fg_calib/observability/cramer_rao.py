"""Attainable accuracy: the Cramér-Rao bound at true parameters, and the errors of an estimator of a kind.

With J the whitened derivatives of the rows in the parameters that may be wrong, x the parameters' errors (true minus
nominal), n the whitened noise and P the rows 1/sigma of the priors, the estimate of the kept parameters K is, to first
order,

    x_K = S+ [J x + n; 0],   S = [J_K; P_K],

and what is held stays at its nominal value: its estimated error is 0. So the error of the estimate is

    e = [S+_J J - 1] x + S+_J n,   S+_J the columns of S+ that belong to J,

whose covariance follows from that of n, which is 1, and that of x, the squared tolerances. With everything kept and
with priors this is the Bayesian Cramér-Rao bound (J^T J + P^T P)^-1 (Van Trees 1968, section 2.4.3). Without priors and
with what the rows determine kept it is the Cramér-Rao bound (J_K^T J_K)^-1, and in addition what the held parameters'
own errors do to the tool that the kept ones do not make up for; for the paper's gauges this is nothing in the tool's
position. Where rows share errors but are weighted as independent, n has the covariance C of the rows so weighted: the
estimator is then another, its error larger, and what it claims, (S^T S)^-1, is neither.

A covariance depends on second moments alone, so tolerances serve for uniform errors as well (bound / sqrt 3).

References:
    Van Trees (1968), Detection, Estimation, and Modulation Theory, Part I. Wiley.
"""

from collections.abc import Sequence

import numpy as np

from fg_calib import inputs
from fg_calib.graph import correlation, named_triangle
from fg_calib.inputs import Booleans, Brief, Floats, InputError, Model, Options, PairErrors, Pairing
from fg_calib.measurements import Measurements, Table
from fg_calib.observability.predicted import predicted_problem, true_problem
from fg_calib.parallel import single_threaded
from fg_calib.robot import Robot, build_chain, forward, without_rigid_motion

RCOND = 1e-10
"""Singular values below this share of the largest belong to directions that nothing determines."""

_ENTERS = 1e-6
"""Share of an error above which it counts as entering the estimate's error."""


class Bound(Brief):
    """The least error that some measurements allow, to first order.

    Attributes:
        robot: The true robot.
        names: The parameters that may be wrong.
        covariance: Of estimated minus true parameters, held ones included, shape (n_names, n_names), [m] and [rad].
        claimed: Covariance that the estimator itself reports: held parameters count as known, and rows that are
            weighted as independent as independent; shape (n_names, n_names), [m] and [rad].
        rank: Number of directions that data and priors determine.
    """

    robot: Robot
    names: tuple[str, ...]
    covariance: Floats
    claimed: Floats
    rank: int

    @single_threaded
    def position(self, readings: Floats, *, fitted: bool = False, claimed: bool = False) -> float:
        """The bound on the root mean square error of the tool point at joint readings, over errors and noise, [m].

        Args:
            readings: Shape (n, n_joints), [rad] (prismatic: [m]).
            fitted: Whether the rotation and shift are taken away that bring the estimated points nearest to the true
                ones (to first order: the six rigid motions of the set of points); else in the base frame.
            claimed: Whether to propagate what the estimator claims.
        """
        columns = {self.robot.index(name): k for k, name in enumerate(self.names)}
        at = forward(build_chain(self.robot, columns), self.robot.trig(readings))
        G = at.jacobian[:, 3:]
        if fitted:
            G, _ = without_rigid_motion(at.position, G)
        covariance = self.claimed if claimed else self.covariance
        return float(np.sqrt(np.einsum("nij,jk,nik->", G, covariance, G) / len(readings)))


@single_threaded
def cramer_rao(
    robot: Robot,
    measurements: Measurements | Table | Sequence[Table],
    *,
    model: Model | None = None,
    pairing: Pairing | None = None,
    frame: inputs.FrameKnowledge = "known",
    prior: bool = True,
    kept: Sequence[str] | None = None,
    pair_errors: PairErrors = "shared",
) -> Bound:
    """The Cramér-Rao bound of a robot's parameters from what could be measured at some configurations.

    Of measurements only the readings of train rows, their sigmas and names are used: what a model would measure there
    is predicted without noise, at the true parameters. Tables are used as they were measured or simulated: the arm is
    where the true parameters have it, and what else is unknown (frames, targets, anchors, planes, boards) is where
    their rows then put it.

    Args:
        robot: The true robot. The parameters that may be wrong are those it lets be estimated; their tolerances are
            the sigmas of true minus nominal values, and of the priors.
        measurements: Readings and sigmas; or tables, such as those of a simulation.
        model: Which measurements take part; each table has its own.
        pairing: How pairs are formed, a star if None; each table has its own.
        frame: `unknown` estimates world_T_base with the parameters; each table has its own.
        prior: Whether the tolerances are priors.
        kept: The parameters that are estimated, all if None; the others stay at nominal and keep their errors.
        pair_errors: `shared`: the exact noise of pairs; `independent`: pairs are weighted as if independent.

    Raises:
        InputError: An unknown parameter, one whose error enters without a tolerance, or no model.
        ProblemError: A table lacks what its model needs.
    """
    names = tuple(p.name for p in robot.parameters if p.estimated)
    inputs.check_names("kept", () if kept is None else kept, names, "or fixed parameter")
    k = np.array([kept is None or name in kept for name in names])
    if isinstance(measurements, Measurements):
        problem = predicted_problem(
            robot, measurements, str(model), frame=frame, pairing=pairing, pair_errors=pair_errors
        )
    else:
        problem = true_problem(robot, measurements, Options("pose", gauge="none", pair_errors=pair_errors))
    J = named_triangle(problem, problem.start)  # (m, n_names)
    sigma = np.array([np.inf if p.tolerance is None else p.tolerance for p in robot.parameters if p.estimated])
    gain, claimed, rank = _linear_estimate(J, np.diag(1.0 / sigma) if prior else np.zeros((0, len(names))), k)
    left = gain @ J - np.eye(len(names))
    # With priors every parameter that has one enters by it; the others are determined or not.
    for i in np.flatnonzero(np.isinf(sigma) & (np.abs(left).max(axis=0, initial=0.0) > _ENTERS)):
        raise InputError(f"robot {robot.name}", f"no tolerance for {names[i]}", "one: its own error stays in part")
    of_errors = left * np.where(np.isfinite(sigma), sigma, 0.0)
    covariance = gain @ gain.T + of_errors @ of_errors.T
    added = correlation(problem, problem.start) if pair_errors == "independent" else None
    if added is not None:
        back = problem.variables.tangent_derivative(problem.start)
        covariance = covariance + claimed @ (back.T @ added @ back) @ claimed
    return Bound(robot, names, covariance, claimed, rank)


def _linear_estimate(J: Floats, P: Floats, k: Booleans) -> tuple[Floats, Floats, int]:
    """Least squares with rows of data and of priors for some of the parameters, the others at nominal.

    Args:
        J: Whitened rows of the data, shape (m, n).
        P: Whitened rows of the priors, shape (n_priors, n).
        k: Which parameters are estimated, shape (n,).

    Returns:
        Estimate per residual of the data, shape (n, m); the covariance that it takes for its own, shape (n, n); rank.
    """
    U, s, Vt = np.linalg.svd(np.vstack([J[:, k], P[:, k]]), full_matrices=False)
    rank = int(np.sum(s > RCOND * s.max(initial=0.0)))
    half = Vt[:rank].T / s[:rank]  # (n_kept, rank)
    gain, claimed = np.zeros((len(k), len(J))), np.zeros((len(k), len(k)))
    gain[k] = half @ U[: len(J), :rank].T
    claimed[np.ix_(k, k)] = half @ half.T
    return gain, claimed, rank
