"""Unmodelled effects: lack of fit, a change point, a missing convention parameter, a forgotten instrument offset.

Each is a score test: the rows are fitted again, linearly, with more columns than the model has (`regress`), and what
these gain is compared with chance,

    F = |Q^T r|^2 / m over |e|^2 / f

with r the residuals of the model's fit, J its columns, those of the priors too, Q a basis of what the columns add to J,
m its rank, e the residuals of rows that are left, and f the degrees of freedom of rows alone: those that noise can make
differ freely, less the trace of the rows' part of J and Q. Priors are guesses, and say nothing of the noise. F has an F
distribution whatever the size of the noise. The least p-value p of k tests has the p-value 1 - (1 - p)^k. Gross rows
get a column each.

*Lack of fit* adds effects that the model lacks, stage by stage (see `candidate_effects`); the statistics of the stages
are independent. Where rows are few and residuals large each effect is tried alone too.

A *change point* is a small motion of tool or base from one row of a table on, for every row tried. Other effects
explain a part of it, so it has to explain nearly all of the misfit, also next to constant small motions of all links
and slow drifts of joints.
A *missing convention parameter* is the same test of small motions between links. An *offset* is added to every length
of a table to anchors; it hides in the arm's parameters: 0.25 mm of a ball bar made residuals 1.1 times as large as
specified.

*Error curves* of the model are eliminated as random effects of their prior, y = A x + L z + e; noise specified too
large, and priors too wide, would make the ratio F too large, so both are made as small as rows and coefficients are:
MacKay's fixed point, with tr L S^-1 L^T the number of coefficients that the rows determine (see `error_states`).
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray
from scipy import special
from scipy.sparse import csr_array

from fg_calib.diagnostics.candidate_effects import DRIFT, LINK, MASSES, STAGES, causes_of, widened
from fg_calib.graph import Problem, SchurComplement, Solution, relinearized_at, subsampled
from fg_calib.graph.variables import prior_rows, unknown_prior_rows
from fg_calib.inputs import Booleans, Floats, Record
from fg_calib.observability import MissingMotion
from fg_calib.robot import FRAME_KINDS, PARAMETER_KINDS

MAX_ROWS = 10_000
"""Rows by which residuals are tested: more would take long, and are not needed."""

LEAST_LEFT = 10
"""Degrees of freedom that a test must leave: else what it does is left to chance."""

MAX_ROUNDS = 30
"""Rounds of the estimate of noise and of the size of error curves."""

LEAST_SIDE, MAX_TRIED = 6, 100
"""Configurations before and after a change, and rows at which one is tried, evenly spaced if there are more."""

P_VALUE = 1e-6
"""P-value below which a change, an offset, a missing parameter, and an effect alone are significant: others mimic."""

CHANGE_LEFT, MISSING_LEFT = 0.25, 0.8
"""Part of the excess of chi-square that a change, and a missing parameter of the convention, leave at most."""

_RANK = 1e-8
"""Part of a column that counts as nothing."""

_NOTHING = 1e-10
"""Size of a column over the largest below which it is rounding errors."""

MOST_UNEVEN, LEAST_NOISE = 1.2, 1e-3
"""Ratio of observed to specified noise of one kind over that of another up to which they are equal; least of them."""

OFFSET = "offset "
"""How names of the columns of offsets begin, before the number of the table."""

LIKE_NOISE = 1e-4
"""P-value below which residuals are systematic."""

SECOND_ORDER, OWN_SECOND_ORDER = 100.0, 10.0
"""Length of a column per 1 rad or 1 m, over that of the residuals, below which it is their own: points that are touched
turn by an angle times their residuals, by an effect times a multiple of them. The second is of the model's columns."""

LEAST_SHARE = 1e-3
"""Share of the information below which a region of joint space says nothing of a direction."""

MOST_TYPICAL, MOST_GROSS = 5.0, 20
"""Size in robust sigmas beyond which a residual is a gross error; and how many of these are looked for."""


class Systematic(Record):
    """How systematic residuals are.

    Attributes:
        p_value: P-value of residuals as systematic, were there noise alone.
        cause: The single effect that explains them best, in words; empty where they are like noise or none does.
        variance: Variance of differences between regions of joint space, over that by the noise alone.
    """

    p_value: float
    cause: str = ""
    variance: float = 1.0


class Change(Record):
    """Something that moved between two rows of a table.

    Attributes:
        what: `tool` or `base`.
        configuration: The first after it, by its number among all.
        left: Part of chi-square that is left with a tool or a base of its own from there on.
    """

    what: str
    configuration: int
    left: float


class Offset(Record):
    """An offset that an instrument seems to add to every length.

    Attributes:
        table: Number of its table.
        size: The offset, [m].
        sigma: Its 1 sigma by the noise as estimated, [m].
    """

    table: int
    size: float
    sigma: float


class LinearFit(Record):
    """The linearised fit of rows and priors, and its score tests, whose noise is that of the rows alone.

    Attributes:
        r: Residuals of the fit, rows first, then priors, shape (n,).
        fitted: Orthonormal basis of its columns, shape (n, rank).
        free: Variance of each residual by noise before the fit, shape (n,).
        n_rows: How many of them are of rows.
        n: How many of these noise can make differ freely.
        variance: Of the noise: what a fit with all columns leaves.
    """

    r: Floats
    fitted: Floats
    free: Floats
    n_rows: int
    n: int
    variance: float = 1.0

    @property
    def dof(self) -> float:
        """Degrees of freedom of the rows: what priors determine takes none."""
        return self.n - float(np.sum(self.fitted[: self.n_rows] ** 2))

    @property
    def square(self) -> float:
        """Sum of the squares of the rows' residuals."""
        return float(self.r[: self.n_rows] @ self.r[: self.n_rows])

    def padded(self, columns: Floats) -> Floats:
        """Columns of the rows, shape (n_rows, m), of the priors too."""
        return np.pad(columns, ((0, len(self.r) - len(columns)), (0, 0)))

    def with_basis(self, new: Floats) -> "LinearFit":
        """The fit with more columns, orthonormal and orthogonal to its own."""
        return replace(self, r=self.r - new @ (new.T @ self.r), fitted=np.hstack([self.fitted, new]))

    def test(self, columns: Floats) -> "tuple[float, float, LinearFit]":
        """A score test of more columns of the rows, shape (n_rows, m).

        Returns:
            The p-value of what they explain, the part of what is more than noise that they leave, and the fit with
            them; 1, 1 and this fit where they add nothing, or leave too few degrees of freedom.
        """
        new = basis_of(self.padded(columns), self.fitted, SECOND_ORDER * float(np.linalg.norm(self.r)))
        after, m = self.with_basis(new), new.shape[1]
        if not m or after.dof < LEAST_LEFT:
            return 1.0, 1.0, self
        gain, noise = float(np.sum((new.T @ self.r) ** 2)), max(after.square / after.dof, 1e-300)
        left = max(after.square - after.dof * self.variance, 0.0)
        part = left / max(self.square - self.dof * self.variance, 1e-300)
        return float(special.fdtrc(m, after.dof, gain / m / noise)), part, after

    def without_gross(self) -> "LinearFit":
        """The fit with a column for each row whose residual is gross, one after the other: these hide effects."""
        fit = self
        for _ in range(MOST_GROSS):
            free = (fit.free - np.sum(fit.fitted**2, axis=1))[: fit.n_rows]
            ratio = np.abs(fit.r[: fit.n_rows]) / np.sqrt(np.maximum(free, LEAST_SHARE))
            typical = 1.4826 * float(np.median(ratio[free > LEAST_SHARE])) if np.any(free > LEAST_SHARE) else np.inf
            worst = int(np.argmax(np.where(free > LEAST_SHARE, ratio, 0.0)))
            if ratio[worst] <= MOST_TYPICAL * typical:
                break
            unit = np.eye(len(fit.r), 1, -worst)
            new = unit - fit.fitted @ (fit.fitted.T @ unit)
            fit = fit.with_basis(new / np.linalg.norm(new))
        return fit

    @property
    def information(self) -> float:
        """Schwarz's criterion, whose least value chooses among models."""
        return float(self.n * np.log(self.square) + self.fitted.shape[1] * np.log(self.n))


class Regression(Record):
    """The fit of a solution, linearised, and columns that it does not have.

    These are the six small motions of each link (`LINK`, the number of the joint before it, the kind), the offsets of
    tables that were not estimated (`OFFSET`, the number of the table), and effects (see `candidate_effects`).

    Attributes:
        problem: The problem of the rows, which count as their noise says: at most `MAX_ROWS`, evenly drawn.
        fit: Their fit, whose noise is as specified.
        states: How rows follow from shared errors and error curves.
        columns: The columns of the rows before these are dealt with, shape (n_rows, m).
        names: Their names, shape (m,).
    """

    problem: Problem
    fit: LinearFit
    states: SchurComplement
    columns: Floats
    names: NDArray[np.str_]

    @cached_property
    def fit_with_noise(self) -> LinearFit:
        """The fit with the noise that one with all columns leaves, at most that specified."""
        variances = [after.square / after.dof for _, after in self.staged(self.fit)]
        return replace(self.fit, variance=min([1.0, *variances[-1:]]))

    def staged(self, fit: LinearFit) -> Iterator[tuple[float, LinearFit]]:
        """The p-value of each stage next to those before it, and the fit with all of these.

        Stages that add nothing, or leave too few degrees of freedom, are left out.
        """
        for stage in STAGES:
            p, _, after = fit.test(self.named(stage))
            if after is not fit:
                yield p, (fit := after)

    def named(self, *begin: str, rows: Booleans | None = None) -> Floats:
        """The whitened columns whose names begin so, zero but in some rows if these are given, shape (n, k)."""
        columns = self.columns[:, [name.startswith(begin) for name in self.names.tolist()]]
        return self.states.whiten(columns if rows is None else columns * rows[:, None])


def of_several(p: float, n: int) -> float:
    """The p-value of the least p-value of n tests."""
    return -float(np.expm1(n * np.log1p(-min(p, 1.0 - 1e-16))))


def find_systematic(
    regression: Regression, even: Regression | None = None, *, thorough: bool = True
) -> Systematic | None:
    """Systematic residuals, of all rows whatever their robust weights, and the single effect that explains them best.

    Args:
        regression: The rows.
        even: The same with equal noise of all kinds, which the tests take for granted: see `with_even_noise`.
        thorough: Whether all effects are tried alone too where those of a stage together explain nothing, and of few
            rows leave no degrees of freedom; else other masses than those of the model.

    Returns:
        None where it cannot be told: too few rows, or rows that share errors but are weighted as independent.
    """
    problem, whole = regression.problem, regression.fit
    if problem.rows.counted_as_private or whole.dof < 2 * LEAST_LEFT:
        return None
    regression = even or regression
    clean = regression.fit.without_gross()
    stages = list(regression.staged(clean))
    p = of_several(min((p for p, _ in stages), default=1.0), max(len(stages), 1))
    wanted = "" if thorough or p < LIKE_NOISE else MASSES
    causes = {words: name for words, name in causes_of(problem.robot).items() if name.startswith(wanted)}
    each = ((words, *clean.test(regression.named(name))) for words, name in causes.items())
    alone = [(fit.information, words, p) for words, p, _, fit in each if fit is not clean]
    of_one = of_several(min((p for *_, p in alone), default=1.0), max(len(alone), 1))
    if p >= LIKE_NOISE and of_one >= P_VALUE:
        return Systematic(p) if stages else None
    least, cause, _ = min([*alone, (clean.information, "", 1.0)])
    gain = clean.information - min([least, *(fit.information for _, fit in stages)])
    others = " and others" * (clean.information - least < 0.5 * gain)
    return Systematic(min(p, of_one), cause and cause + others, _regional_variance(problem, whole))


def _regional_variance(problem: Problem, fit: LinearFit) -> float:
    """Variance by which fits without one region of joint space differ from that of all rows, over that by the noise.

    The regions are quarters of each joint's range, by rows. In an orthonormal basis Q of the fit's columns all rows
    have the information 1 and those of a region H = Q_b^T Q_b. With h and u its eigenvalues and vectors, the estimate
    without them differs along u by u . Q_b^T r / (1 - h), which noise alone gives the variance h / (1 - h).
    """
    none, at = np.full((1, problem.robot.n_joints), np.nan), list[Floats]()
    for part in problem.rows.parts:
        s, ends = part.block, problem.data.places[part.table][part.block.ends[:, -1:]].ravel()
        readings = problem.data.readings[ends] if s.kind.ends else none.repeat(s.n, axis=0)
        at.append(np.repeat(readings, s.residual_dim, 0))
    squares = list[float]()
    for readings in np.concatenate(at).T:
        edges = np.nanquantile(readings, [0.25, 0.5, 0.75])
        for k in range(len(edges) + 1):
            rows = np.flatnonzero((np.searchsorted(edges, readings) == k) & np.isfinite(readings))
            Q = fit.fitted[rows]
            h, U = np.linalg.eigh(Q.T @ Q)
            seen = (h > LEAST_SHARE) & (h < 1.0 - LEAST_SHARE)
            squares += ((U.T @ (Q.T @ fit.r[rows]))[seen] ** 2 / (h * (1.0 - h))[seen]).tolist()
    return float(np.mean(squares)) if squares else 1.0


def find_change(regression: Regression) -> Change | None:
    """The change point of a table: what moved between two of its rows; None without, or where it cannot be told.

    Note:
        It is looked for in one table of poses, positions or orientations.
    """
    problem = regression.problem
    blocks = [part.block for part in problem.rows.parts]
    several = len(problem.data.tables) > 1 or problem.rows.states.n_states > 0
    if several or problem.data.landmarks.names or any(b.kind.ends != 1 for b in blocks):
        return None
    fit, links = regression.fit_with_noise, {"tool": f"{LINK}{problem.robot.n_joints}.", "base": f"{LINK}0."}
    at = np.concatenate([np.repeat(block.ends[:, 0], block.residual_dim) for block in blocks])
    first = np.unique(at)[LEAST_SIDE : 1 - LEAST_SIDE]
    first = first[np.unique(np.linspace(0, len(first) - 1, min(MAX_TRIED, len(first))).astype(np.int64))]
    found = [
        (*fit.test(regression.named(of, rows=at >= k))[:2], what, int(k)) for k in first for what, of in links.items()
    ]
    if not found:
        return None
    p, left, what, k = min(found)
    moved = regression.named(links[what], rows=at >= k)
    p_with, left_with, _ = fit.test(regression.named(LINK, DRIFT))[2].test(moved)
    if max(of_several(p, len(found)), p_with) >= P_VALUE or max(left, left_with) > CHANGE_LEFT:
        return None
    return Change(what, k, float(np.sum(fit.test(moved)[2].r ** 2) / np.sum(fit.r**2)))


def explains_misfit(regression: Regression, motion: MissingMotion) -> bool:
    """Whether a motion that the convention has no parameter for explains a part of the misfit."""
    kinds = {PARAMETER_KINDS[kind].axis: kind for kind in FRAME_KINDS}
    wanted = [f"{LINK}{axis}.{kinds[one]}" for axis in motion.axes[:-1] for one in motion.motions]
    p, left, _ = regression.fit_with_noise.test(regression.named(*wanted))
    return p < P_VALUE and left <= MISSING_LEFT


def forgotten_offsets(regression: Regression) -> tuple[Offset, ...]:
    """Offsets of instruments that were not estimated, are significant, and smaller than the lengths' own spread."""
    fit, found, blocks = regression.fit, list[Offset](), regression.problem.data.blocks
    for table in _offsets(regression.problem).values():
        spread = np.std(np.concatenate([s.data[s.train, 0] for s in blocks if s.table == table and s.data.shape[1]]))
        column = fit.padded(regression.named(f"{OFFSET}{table},"))[:, 0]
        p, _, after = fit.test(1e6 * column[:, None])  # kept however short: an offset is linear
        if p < P_VALUE:
            new = column - fit.fitted @ (fit.fitted.T @ column)
            sigma = np.sqrt(after.square / after.dof / float(new @ new))
            size = -float(new @ fit.r) / float(new @ new)
            found += [Offset(table, size, float(sigma))] * int(abs(size) < spread)
    return tuple(found)


def _offsets(problem: Problem) -> dict[int, int]:
    """Tables with an offset that is not estimated, by the offset's place among the nuisance coordinates."""
    unknowns, columns = problem.data.landmarks, problem.variables.coordinates
    numbers = [i for i, item in enumerate(unknowns.items) if item.kind.is_one]
    places = np.flatnonzero(np.isin(unknowns.owners, numbers) & (columns < 0)).tolist()
    each = ((place, s) for place in places for s in problem.data.blocks)
    return {place: s.table for place, s in each if np.any(s.nuisances[s.train] == place)}


def with_even_noise(solution: Solution, regression: Regression) -> Solution:
    """A solution with the noise that the residuals of each kind have, where their ratios to what is specified differ.

    Else what is specified too large for one kind, or too small, makes residuals of noise systematic.
    """
    problem, fit = solution.problem, regression.fit.without_gross()
    each = ((part.table, part.block) for part in regression.problem.rows.parts)
    names = [(k, name.partition(".")[0]) for k, block in each for _ in range(block.n) for name in block.kind.names]
    n = len(names)
    free, squares = (fit.free - np.sum(fit.fitted**2, axis=1))[:n], fit.r[:n] ** 2
    of = {name: np.array([other == name for other in names]) for name in dict.fromkeys(names)}
    known = {name: rows for name, rows in of.items() if np.sum(free[rows]) >= LEAST_LEFT}
    sizes = {name: max(np.sqrt(np.sum(squares[k]) / np.sum(free[k])), LEAST_NOISE) for name, k in known.items()}
    if max(sizes.values(), default=1.0) < MOST_UNEVEN * min(sizes.values(), default=1.0):
        return solution
    given = problem.state.factors
    factors = {**given, **{name: float(size) * given.get(name, 1.0) for name, size in sizes.items()}}
    state = replace(problem.state, factors=factors)
    return replace(solution, problem=relinearized_at(problem, solution.parameters, state))


def regress(solution: Solution) -> Regression:
    """Linearise the fit of a solution, and what it does not have."""
    problem, parameters = solution.problem, solution.parameters
    if problem.state.weights is not None or problem.n_residuals > MAX_ROWS:
        problem = subsampled(problem, min(1.0, MAX_ROWS / problem.n_residuals), parameters)
    rows, at, offsets = problem.rows, problem.variables.at(parameters), _offsets(problem)
    variables, values, trigs = widened(problem, parameters)
    plain, n_core, n_curves = at.without_curves(), variables.n_columns, problem.variables.n_curves
    columns = np.where(plain.columns >= 0, plain.columns + n_core - plain.n_columns, -1)
    columns[list(offsets)] = n_core + plain.n_nuisance + np.arange(len(offsets))
    wide = replace(plain, chains=variables.at(values).chains, n_columns=n_core, columns=columns)
    wide = replace(wide, n_nuisance=plain.n_nuisance + len(offsets))
    private, known = rows.with_readings(trigs).private(wide), np.isin(variables.names, problem.variables.names)
    all_names = np.where(known, "", variables.names).tolist()
    all_names += [""] * plain.n_nuisance + [f"{OFFSET}{table}," for table in offsets.values()]
    more, J, r = np.array(all_names) != "", private[:, :-1], private[:, -1]
    if solution.problem.state.weights is not None:
        most = MOST_TYPICAL * 1.4826 * float(np.median(np.abs(r)))
        r = np.clip(r, -most, most)  # before outliers spread over all rows
    L = rows.curve_loadings(at)
    r = r if at.curves is None else r - L @ (at.curves.values / at.curves.sigma)
    own = np.column_stack([J[:, ~more], r])
    states, free, scale = _eliminate(rows.states, L, own, problem.n_independent)
    own = states.whiten(own) / scale
    r_prior, J_prior = prior_rows(variables, values)
    r_unknown, J_unknown = (each[n_curves:] for each in unknown_prior_rows(problem.variables, parameters))
    J_prior = np.pad(J_prior[:, known], ((0, 0), (0, plain.n_nuisance)))
    J_unknown = np.delete(J_unknown, np.s_[at.n_columns : at.n_columns + n_curves], axis=1)
    basis = basis_of(np.concatenate([own[:, :-1], J_prior, J_unknown]))
    r, ones = np.concatenate([own[:, -1], r_prior, r_unknown]), np.ones(len(r_prior) + len(r_unknown))
    fit = LinearFit(r - basis @ (basis.T @ r), basis, np.append(free, ones), len(own), problem.n_independent)
    return Regression(problem, fit, states, J[:, more] / scale, np.array(all_names)[more])


def _eliminate(
    shared: SchurComplement, loadings: csr_array, rows: Floats, n: int
) -> tuple[SchurComplement, Floats, float]:
    """Eliminate error curves, at most as wide as their coefficients are: see the module's head.

    Args:
        shared: How rows follow from errors that they share.
        loadings: L, change of each row per 1 sigma of each coefficient, shape (n_rows, n_curves).
        rows: Rows [J r] by what is estimated, shape (n_rows, k + 1).
        n: How many of them noise can make differ freely.

    Returns:
        The elimination; the variance of each residual by noise, shape (n_rows + n_states,); and the noise over that
        specified, 1 at most: else columns take up the pull of the priors.
    """
    m, white = loadings.shape[1], shared.whiten(rows)
    least = OWN_SECOND_ORDER * float(np.linalg.norm(white[:, -1]))  # else zeros alone seem to determine a size
    own = basis_of(white[:, :-1], least=least)
    rows = np.column_stack([own, white[:, -1] - own @ (own.T @ white[:, -1])])
    L = csr_array(shared.whiten(loadings.toarray())) if shared.n_states else loadings
    g, V = np.linalg.eigh((L.T @ L).toarray())
    B, N, kept = V.T @ (L.T @ rows), rows.T @ rows, np.ones(m)
    scale = factor = 1.0
    for _ in range(MAX_ROUNDS if m else 1):
        kept = 1.0 / (1.0 + (factor / scale) ** 2 * g)
        M = N - (factor / scale) ** 2 * (B.T * kept) @ B
        x = np.append(-np.linalg.solve(M[:-1, :-1], M[:-1, -1]), 1.0)
        of_curves = float(np.sum((factor / scale * kept * (B @ x)) ** 2))
        taken, n_own = float(np.sum(1.0 - kept)), own.shape[1]
        if n - n_own - taken < LEAST_LEFT:
            break
        scale = float(np.clip(np.sqrt(max(x @ M @ x - of_curves, 0.0) / (n - n_own - taken)), 0.1, 1.0))
        factor = min(factor * np.sqrt(of_curves / max(taken, 1e-300)) / scale, 1.0)
    if not m:
        return shared, np.ones(len(white)), scale
    root = V * np.sqrt(kept)
    free = 1.0 - np.concatenate([np.sum(np.asarray(L @ (factor / scale * root)) ** 2, axis=1), np.sum(root**2, axis=1)])
    return SchurComplement(csr_array(scipy.sparse.hstack([shared.loadings, loadings * (factor / scale)]))), free, scale


def basis_of(columns: Floats, fitted: Floats | None = None, least: float = 0.0) -> Floats:
    """An orthonormal basis of what columns add to an orthonormal one; what is left of nothing is nothing.

    Args:
        columns: The columns, shape (n, m).
        fitted: The basis that they add to, shape (n, k); none if None.
        least: Length below which a part of a column is none.
    """
    fitted = np.zeros((len(columns), 0)) if fitted is None else fitted
    size = np.linalg.norm(columns, axis=0)
    scale = np.maximum(size, max(_NOTHING * float(np.max(size, initial=0.0)), 1e-300))
    Q, R, order = scipy.linalg.qr((columns - fitted @ (fitted.T @ columns)) / scale, mode="economic", pivoting=True)
    left = np.abs(np.diag(R))
    return np.asarray(Q[:, (left > _RANK * np.sqrt(len(size))) & (left * scale[order[: len(left)]] > least)])
