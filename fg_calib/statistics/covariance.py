"""The covariance of the estimate, and what nothing determines.

Where parameters were left out to fix the gauge (`keep`) they stay at nominal, but are not known. With K what was
estimated and L what was left out, J_K and J_L the whitened derivatives of the rows in them, x true minus nominal values
and n the noise, the estimate of K is, to first order, `J_K^+ (J_K x_K + J_L x_L + n)`. So the errors, estimated minus
true, are

    e_K = G x_L + J_K^+ n,   e_L = -x_L,   G = J_K^+ J_L,

and with the left-out tolerances T and the covariance C_K of the noise's part

    cov(e_K, e_K) = C_K + G T^2 G^T,   cov(e_K, e_L) = -G T^2,   cov(e_L, e_L) = T^2.

Where one of L has no tolerance its error may be anything: the direction (G, -1) of it is not determined. What an
estimate is known to be, whatever x_L, is that of the combination `x_K + G x_L`, with the covariance C_K.
"""

from collections.abc import Callable
from dataclasses import field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fg_calib import graph
from fg_calib.inputs import Floats, FrozenArrays
from fg_calib.robot import Robot

NO_ANGLE = 1.0
"""An angle of a pose with a larger sigma is not known, [rad]: near a pitch of a quarter turn yaw and roll are none."""


class TangentCovariance(FrozenArrays):
    """The covariance in the tangent space of the variables, and the directions that nothing determines.

    Attributes:
        variables: The variables; the columns are theirs.
        parameters: The estimate (see `Variables`).
        tangent: Covariance of the determined part, by the noise that rows are weighted by, shape (n_columns,) * 2.
        undetermined: Undetermined directions at the estimate, orthonormal in changes of ordinary size, shape
            (n_undetermined, n_columns).
        undetermined_at_nominal: Such directions at the nominal parameters.
        curves: Errors of the coefficients of error curves: how they follow the columns, then a triangular root of what
            they vary by at given columns, shape (n_curves, n_columns + n_curves).

    Linear functions are given by rows: derivatives in the columns and, where a function depends on error curves with
    derivatives C, `C @ curves` added. Columns after the first `n_columns` are of independent errors of variance 1.
    """

    variables: graph.Variables
    parameters: Floats
    tangent: Floats
    undetermined: Floats
    undetermined_at_nominal: Floats
    curves: Floats = field(default_factory=lambda: np.zeros((0, 0)), kw_only=True)

    @property
    def curve_names(self) -> tuple[str, ...]:
        """Names of the coefficients of error curves that were estimated, shape (n_curves,)."""
        of_curves = (v for v in self.variables.nuisance if v.kind == "curve")
        return tuple(self.variables.robot.parameters[i].name for v in of_curves for i in v.parameters)

    def covariance(self, rows: Floats) -> Floats:
        """Covariance of linear functions, shape (m, n_columns + n_curves or none); nan where undetermined."""
        core, own = np.split(rows, [len(self.tangent)], axis=1)
        with np.errstate(invalid="ignore"):  # yaw and roll at a pitch of a quarter turn have no derivative
            out: Floats = core @ self.tangent @ core.T + own @ own.T
        unknown = self._unknown(rows) | ~np.isfinite(np.diag(out))
        out[unknown, :] = np.nan
        out[:, unknown] = np.nan
        return out

    def variance(self, rows: Floats) -> Floats:
        """The diagonal of `covariance`, shape (m,)."""
        core, own = np.split(rows, [len(self.tangent)], axis=1)
        with np.errstate(invalid="ignore"):
            out: Floats = np.einsum("ij,ij->i", core @ self.tangent, core) + np.einsum("ij,ij->i", own, own)
        out[self._unknown(rows) | ~np.isfinite(out)] = np.nan
        return out

    def _unknown(self, rows: Floats) -> NDArray[np.bool_]:
        """Which linear functions have a share in what nothing determines, at nominal and at the estimate."""
        scaled = rows[:, : len(self.tangent)] * self.variables.scales
        with np.errstate(invalid="ignore"):
            size = np.linalg.norm(scaled, axis=1)
            shares = [np.linalg.norm(scaled @ D.T, axis=1) for D in (self.undetermined, self.undetermined_at_nominal)]
            found: NDArray[np.bool_] = (shares[0] > graph.SUPPORT_TOLERANCE * size) & (
                shares[1] > graph.SUPPORT_TOLERANCE * size
            )
        return found

    def named(self) -> Floats:
        """Covariance of the robot's parameters among the columns, shape (n_robot_columns, n_robot_columns)."""
        out = self.covariance(self.variables.named_derivative(self.parameters)[: self.variables.n_robot_columns])
        for v in self.variables.items:
            if v.is_pose and v.kind != "frame":
                angles = np.arange(v.columns.start + 3, v.columns.stop)
                unknown = angles[np.diag(out)[angles] > NO_ANGLE**2]
                out[unknown, :] = np.nan
                out[:, unknown] = np.nan
        return out

    def derivative(self, function: Callable[[Robot], ArrayLike]) -> Floats:
        """Derivative of a function of the robot in the columns, by central differences, shape (m, n_columns)."""
        v, steps = self.variables, 1e-2 * np.diag(self.variables.scales)
        robot = v.robot.with_values(self.parameters[v.robot_span])

        def at(step: Floats) -> Floats:
            moved = robot.with_values(v.moved(self.parameters, step)[v.robot_span])
            return np.ravel(np.asarray(function(moved), dtype=np.float64))

        return np.array([(at(h) - at(-h)) / (2.0 * h.sum()) for h in steps]).T


class Spread(TangentCovariance):
    """The covariance of a solution, under the noise as it is taken to be and otherwise.

    Attributes:
        root: A square root R of `tangent`, R R^T, shape (n_columns, k); its first `rank`
            columns are the directions that data and priors determine, orthogonal in `prior_scales`.
        actual: `tangent` by the errors that rows share, also where they are asked to count as independent.
        rank: Number of directions that data and priors determine.
        excess: Shortfall of the mean of chi-square below its degrees of freedom, because rows that share errors are
            weighted as independent.
    """

    root: Floats
    actual: Floats
    rank: int
    excess: float

    def inflated(self, variance: float) -> "Spread":
        """The covariance of rows whose noise has so many times the variance; priors stay as they are."""
        half, held = self.root[:, : self.rank], self.root[:, self.rank :]
        priors = graph.prior_rows(self.variables, self.parameters)[1] @ half
        grown = np.eye(self.rank) + (variance - 1.0) * (np.eye(self.rank) - priors.T @ priors)
        root = np.hstack([half @ np.linalg.cholesky(grown), held])
        more = root @ root.T - self.tangent
        n = self.variables.n_columns
        follow, own = np.split(self.curves, [n], axis=1)
        sure = own / self.variables.all_scales[n : n + len(own), None]  # of their priors
        share, V = np.linalg.eigh(sure.T @ sure)  # in [0, 1] but for rounding
        grown = V * np.sqrt(1.0 + (variance - 1.0) * (1.0 - np.clip(share, 0.0, 1.0)))
        curves = np.hstack([follow, np.transpose(np.linalg.qr((own @ grown).T, mode="r"))])
        return replace(self, root=root, tangent=self.tangent + more, actual=self.actual + more, curves=curves)


def spread_of(solution: graph.Solution) -> Spread:
    """The covariance: that of the weighted least-squares estimate under the noise as it is taken to be.

    Parameters that were left out to fix the gauge count as known; see `with_left_out`. Where nothing determines frames,
    what follows them as they are held is in it: see `held_frames`.

    Where rows share errors but are asked to count as independent, with H = J^T J and C their covariance, the `actual`
    one is H^-1 (J^T C J) H^-1 (priors are rows of their own). The mean of chi-square, tr C - tr(H^-1 J^T C J), is then
    below the degrees of freedom by tr(H^-1 J^T (C - 1) J). A robust loss loses some of what clean data hold: see
    `robust.Effect`.
    """
    problem, variables = solution.problem, solution.problem.variables
    weighted = problem.state.weights is not None
    system = problem.linearize(solution.parameters, with_loss=True) if weighted else solution.system
    nominal = system
    if solution.before is not solution.parameters:
        nominal = problem.linearize(solution.before, with_loss=True)
    rank, half, scales = system.rank, system.root, variables.prior_scales
    undetermined, undetermined_at_nominal = system.directions[rank:], nominal.directions[nominal.rank :]
    held = held_frames(undetermined, undetermined_at_nominal, scales, variables.n_robot_columns)
    root = np.hstack([half, held])
    added = graph.correlation(problem, solution.parameters)
    middle = np.zeros((rank, rank)) if added is None else half.T @ added @ half
    return Spread(
        variables=variables,
        parameters=solution.parameters,
        root=root,
        tangent=root @ root.T,
        actual=half @ (np.eye(rank) + middle) @ half.T + held @ held.T,
        undetermined=_orthonormal(undetermined, variables.scales),
        undetermined_at_nominal=_orthonormal(undetermined_at_nominal, variables.scales),
        rank=rank,
        excess=float(np.trace(middle)),
        curves=_curves_of(system, variables.n_curves),
    )


def _curves_of(system: graph.NormalSystem, n: int) -> Floats:
    """`TangentCovariance.curves` of a system, whose first nuisance columns are those of the curves."""
    own = system.left.inverse[:n]
    return np.hstack([system.left.follow[:n], np.transpose(np.linalg.qr(own.T, mode="r"))])


def held_frames(undetermined: Floats, undetermined_at_nominal: Floats, scales: Floats, n_robot: int) -> Floats:
    """Errors of frames that nothing determines, with what follows them; shape (n_columns, k).

    No nominal value says where frames are: they stay where they were started. Where nothing at nominal determines one
    in some direction (the height of a SCARA's frame and targets, its axes being parallel), the angles that were
    corrected make other parameters depend on it. It may be off by what is the least that counts as undetermined.

    Args:
        undetermined: Undetermined directions at the estimate, shape (n, n_columns), orthonormal in units of `scales`.
        undetermined_at_nominal: Such directions at the nominal parameters.
        scales: Of the columns, shape (n_columns,).
        n_robot: How many columns, the first ones, are the robot's.
    """
    at_nominal, here = undetermined_at_nominal / scales, undetermined / scales
    U, s, _ = np.linalg.svd(at_nominal[:, :n_robot])
    of_frames = U[:, np.append(s, np.zeros(len(U) - len(s))) <= graph.SUPPORT_TOLERANCE].T @ at_nominal
    return (of_frames @ here.T @ here * scales).T / graph.SIGNAL_FLOOR


def covariance_of_rows(variables: graph.Variables, parameters: Floats, rows: Floats) -> TangentCovariance:
    """The covariance that whitened rows and the robot's tolerances make, both at one parameter vector.

    Args:
        variables: The variables.
        parameters: The parameter vector.
        rows: Derivatives in the core, nuisances eliminated, shape (m, n_columns).
    """
    priors = np.column_stack(graph.prior_rows(variables, parameters)[::-1])
    system = graph.NormalSystem(np.pad(rows, ((0, 0), (0, 1))), variables.n_columns, variables.prior_scales, priors)
    undetermined = _orthonormal(system.directions[system.rank :], variables.scales)
    return TangentCovariance(variables, parameters, system.covariance, undetermined, undetermined)


def with_left_out(solution: graph.Solution, spread: Spread) -> Spread:
    """The covariance of all parameters, those among them that were left out to fix the gauge: see the module's head.

    Args:
        solution: The solution.
        spread: Covariance of what was estimated.
    """
    problem = solution.problem
    if problem.whole is None:
        return spread
    variables, own_scales = problem.whole.variables, spread.variables.scales
    tolerances = [p.tolerance for p in problem.whole.estimated if p.name not in spread.variables.names]
    known = np.array([t is not None for t in tolerances], dtype=np.bool_)
    M, errors = _errors(problem, solution.parameters)
    M_nominal, errors_nominal = _errors(problem, solution.before)
    of_left_out = errors[:, known] * np.array([t for t in tolerances if t is not None])

    def moved(own: Floats, M: Floats, errors: Floats) -> Floats:
        return _orthonormal(np.vstack([(own * own_scales) @ M.T, errors[:, ~known].T]), variables.scales)

    curves = np.zeros((0, variables.n_columns))
    if n := len(spread.curves):  # as they follow all parameters
        weighted = problem.state.weights is not None
        left = replace(problem, variables=variables).linearize(solution.parameters, with_loss=weighted).left
        curves = np.hstack([left.follow[:n], spread.curves[:, len(own_scales) :]])
    return replace(
        spread,
        variables=variables,
        tangent=M @ spread.tangent @ M.T + of_left_out @ of_left_out.T,
        actual=M @ spread.actual @ M.T + of_left_out @ of_left_out.T,
        undetermined=moved(spread.undetermined, M, errors),
        undetermined_at_nominal=moved(spread.undetermined_at_nominal, M_nominal, errors_nominal),
        curves=curves,
    )


def _errors(problem: graph.Problem, parameters: Floats) -> tuple[Floats, Floats]:
    """How the error of the estimate comes about, in the columns of all parameters, left-out ones among them.

    Args:
        problem: The problem without the left-out parameters; `problem.whole` has them.
        parameters: The parameter vector.

    Returns:
        What each column of the problem is in them, and the error that each left-out parameter's own makes: (G, -1).
        Shapes (n_all, n_columns) and (n_all, n_left_out).
    """
    assert problem.whole is not None
    own, whole = problem.variables, problem.whole.variables
    M, derivative = whole.columns_of(own, parameters), whole.tangent_derivative(parameters)
    by_name = dict(zip(whole.names, derivative.T, strict=True))
    left_out = [by_name[p.name] for p in problem.whole.estimated if p.name not in own.names]
    N = np.array(left_out).reshape(-1, whole.n_columns).T
    J = replace(problem, variables=whole).linearize(parameters).left.A
    U, s, Vt = np.linalg.svd((J @ M) * own.scales, full_matrices=False)
    rank = graph.determined(s)
    G = own.scales[:, None] * ((Vt[:rank].T / s[:rank]) @ (U[:, :rank].T @ (J @ N)))
    return M, M @ G - N


def _orthonormal(directions: Floats, scales: Floats) -> Floats:
    """Orthonormal basis, in changes of ordinary size, of the span of directions, shape (n, n_columns)."""
    scaled = directions / scales
    scaled = scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1e-300)
    _, s, Vt = np.linalg.svd(scaled, full_matrices=False)
    return Vt[s > graph.RANK_TOLERANCE * s.max(initial=0.0)]
