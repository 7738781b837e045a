"""Hypotheses of a single change since an arm was calibrated: which explain new rows, and which the rows distinguish.

A *hypothesis* is a change of a few numbers of unknown size: the zero of a joint, another parameter, the tool, the
measurement frame, two zeros together; or gross errors in the rows of one configuration. Each is fitted with the errors
that the posterior allows, by linear algebra (a generalised likelihood ratio): with c its columns, minus what is fitted
already, and r the remaining residuals, the change is `-c^+ r`, and chi-square falls by `|c c^+ r|^2`.

The rows distinguish hypotheses i and j where chi-square with i exceeds that with j by more than chance if i is true.
Were j fitted as well, chi-square would fall below that of j alone by at most a chi-square with j's degrees of freedom.
So under i `chi2_i - chi2_j <= chi2_i - chi2_ij ~ chi2(k_j)`, whatever the two have in common. With m hypotheses the
true one is excluded with a probability of at most `WRONG` if the threshold is the quantile `1 - WRONG / m` of
chi-square with k_j degrees of freedom.

Noise that is specified too small scales all of that: differences are divided by the reduced chi-square of the best
hypothesis, where that is above 1, and an F test judges what a hypothesis explains too.

Hypotheses that move the tool alike everywhere, but for less than the noise of one row, are one: nothing distinguishes
them, nor needs to.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy import special

from fg_calib import graph, statistics
from fg_calib.inputs import CalibrationError, Floats, Record
from fg_calib.monitoring.new_data import Linear, Rows, ends_of_rows, linearise_new_data, place_new_data
from fg_calib.monitoring.prior_information import Calibrated
from fg_calib.robot import Robot, forward, names_of, random_readings

WRONG = 0.01
"""Probability with which the true change is at most called distinguished from another."""

CERTAIN = 1e-3
"""Probability, times the number of hypotheses, below which what a hypothesis explains is no chance."""

SEEN = 1e-6
"""Share of a hypothesis's columns that must remain after the fit; else the rows do not see it. It is also the least
effect of an ordinary change on all rows together, in sigma (see `Robot.scale_of`)."""

ROUNDS = 4
"""Times that rows are linearised anew at the change of a hypothesis."""

SETTLED = 1e-3
"""Change of the change, in its sigma, that needs no other round."""

MOST_REFINED = 6
"""Hypotheses that are linearised anew, the best ones."""

MOST_ROWS = 2400
"""Rows up to which gross errors are tested, 400 poses: their columns grow with the square of the rows."""

N_RANDOM = 200
"""Random configurations at which changes are compared."""

POSES = {"tool": "tool", "base": "frame"}
"""Variables that are a pose, and the hypothesis that it made any turn and shift."""


class ChangeHypothesis(Record):
    """A change that is tested.

    Attributes:
        names: Parameters that change.
        kind: `zero`, `parameter`, `tool`, `frame`, `zeros`, or `row` of gross errors.
        units: `m` or `rad` of each.
        columns: Derivatives of the rows in it, shape (m, k).
        directions: How it moves the arm's columns, shape (n_robot_columns, k); not at all of gross errors.
        same: Names of hypotheses that move the tool alike everywhere.
    """

    names: tuple[str, ...]
    kind: str
    units: tuple[str, ...]
    columns: Floats
    directions: Floats
    same: tuple[str, ...] = ()


class HypothesisTest(Record):
    """Test of a hypothesis.

    Attributes:
        hypothesis: The change.
        change: Its best size, shape (k,), [m] and [rad].
        sigma: 1 sigma of each; nan where the rows do not see it.
        drop: Drop of chi-square.
        left: Chi-square that is left.
        k: Degrees of freedom that it takes.
        dof: Degrees of freedom that are left.
        n: Number of hypotheses that are tested.
    """

    hypothesis: ChangeHypothesis
    change: Floats
    sigma: Floats
    drop: float
    left: float
    k: int
    dof: int
    n: int

    @property
    def p_value(self) -> float:
        """Probability that chance explains as much with the noise as specified, the number of hypotheses counted."""
        return min(1.0, self.n * float(special.chdtrc(self.k, self.drop)))

    @property
    def certain(self) -> bool:
        """Whether what it explains is no chance, whatever the noise (F test of the drop over what is left)."""
        ratio = (self.drop / self.k) / (max(self.left, 1e-300) / self.dof)
        return max(self.p_value, self.n * float(special.fdtrc(self.k, self.dof, ratio))) < CERTAIN

    @property
    def explains(self) -> bool:
        """Whether it leaves no more than noise does, or at most `FACTOR` times that."""
        return self.left <= statistics.FACTOR * self.dof or float(special.chdtrc(self.dof, self.left)) > CERTAIN

    @property
    def scale(self) -> float:
        """Reduced chi-square of what is left, at least 1."""
        return max(1.0, self.left / self.dof)


def quantile(probability: float, k: int) -> float:
    """The value that chi-square with k degrees of freedom exceeds with a probability."""
    return float(special.chdtri(k, probability))


def fit_change(hypothesis: ChangeHypothesis, rows: Linear, n: int) -> HypothesisTest | None:
    """Fit a hypothesis to rows; None where they do not see it.

    Args:
        hypothesis: The change.
        rows: The rows.
        n: Number of hypotheses that are tested.
    """
    size = np.linalg.norm(hypothesis.columns, axis=0)
    acts = size * np.array([rows.robot.scale_of(unit) if unit else 1.0 for unit in hypothesis.units]) > SEEN
    scale = np.where(acts, size, 1.0)
    U, s, Vt = np.linalg.svd(rows.new(np.where(acts, hypothesis.columns / scale, 0.0)), full_matrices=False)
    k = int(np.sum(s > SEEN))
    if not k or rows.dof - k < 1:
        return None
    left, explained = rows.left, U[:, :k].T @ rows.left
    root = Vt[:k].T / s[:k] / scale[:, None]
    sigma = np.sqrt(np.sum(root**2, axis=1))
    sigma[np.linalg.norm(Vt[k:], axis=0) > SEEN] = np.nan
    drop = float(explained @ explained)
    return HypothesisTest(hypothesis, -root @ explained, sigma, drop, float(left @ left) - drop, k, rows.dof - k, n)


def single_changes(rows: Linear) -> list[ChangeHypothesis]:
    """Zeros of joints first, then the other parameters that were estimated, those of the tool, the tool, the frame."""
    robot, six = rows.robot, ("rad",) * 3 + ("m",) * 3
    directions, zeros = named_changes(all_variables(robot)), robot.zero_names
    others = [p for p in robot.parameters if p.name not in zeros]
    tool = robot.n_joints + 1
    kinds: dict[str, tuple[str, tuple[str, ...]]] = {
        **{name: ("zero", (joint.unit,)) for name, joint in zip(zeros, robot.joints, strict=True)},
        **{p.name: ("parameter", (p.unit,)) for p in others if p.estimated and 1 <= p.owner < tool},
        **{p.name: ("tool", (p.unit,)) for p in others if p.owner == tool},
        **{name: (name, six) for name in POSES.values()},
    }
    known = [(name, kind, units, directions[name]) for name, (kind, units) in kinds.items() if name in directions]
    return [ChangeHypothesis((name,), kind, units, rows.of_arm @ D, D) for name, kind, units, D in known]


def named_changes(v: graph.Variables) -> dict[str, Floats]:
    """Changes of a robot by name, each as directions in its columns, shape (n_columns, k).

    Parameters, the zeros of joints that the joint's own parameters can express, any turn and shift of `tool` and
    `frame`.
    """
    robot, x = v.robot, v.nominal()
    E, chain = v.tangent_derivative(x), v.chains[0].at(x).with_joint_columns()
    q = random_readings(robot, 20, np.random.default_rng(0))
    J, joints = np.split(forward(chain, robot.trig(q)).jacobian, [v.n_columns], axis=2)
    found: dict[str, Floats] = dict(zip(v.names, E.T[:, :, None], strict=True))
    for j, name in enumerate(robot.zero_names):
        own = [v.names.index(p.name) for p in robot.parameters if p.owner == j + 1 and p.name in v.names]
        A, b = np.concatenate(J @ E[:, own]), joints[:, :, j].ravel()
        amounts = np.linalg.lstsq(A, b, rcond=None)[0] if own else np.zeros(0)
        if np.linalg.norm(A @ amounts - b) <= 1e-6 * np.linalg.norm(b):
            found.setdefault(name, E[:, own] @ amounts[:, None])
    return found | {POSES[i.kind]: np.eye(v.n_columns)[:, i.columns] for i in v.items if i.kind in POSES}


def pairs_of_zeros(hypotheses: Sequence[ChangeHypothesis]) -> Iterator[ChangeHypothesis]:
    """Two zeros together."""
    for a, b in combinations([one for one in hypotheses if one.kind == "zero"], 2):
        columns, directions = (np.hstack(of) for of in ((a.columns, b.columns), (a.directions, b.directions)))
        yield ChangeHypothesis(a.names + b.names, "zeros", a.units + b.units, columns, directions)


def gross_errors(rows: Linear) -> Iterator[ChangeHypothesis]:
    """Errors of any size in the rows of each configuration that at most a third of the rows are of.

    None where there are more than `MOST_ROWS`.
    """
    problem = rows.placed.problem
    if len(rows.of_arm) > MOST_ROWS:
        return
    ends = ends_of_rows(problem)
    unit = np.eye(len(ends))
    for k in np.unique(ends[ends >= 0]).tolist():
        mine = np.flatnonzero((ends == k).any(axis=1))
        if 3 * len(mine) <= len(ends):
            columns = problem.rows.states.whiten(unit[:, mine])
            columns, none = columns[:, columns.any(axis=0)], np.zeros((rows.of_arm.shape[1], 0))
            yield ChangeHypothesis((problem.data.names[k],), "row", ("",) * columns.shape[1], columns, none)


def fit_changes(rows: Linear) -> list[HypothesisTest]:
    """Fit each hypothesis, pairs of zeros among them where no single change explains the rows."""
    hypotheses = [*single_changes(rows), *gross_errors(rows)]
    found = [f for one in hypotheses if (f := fit_change(one, rows, len(hypotheses))) is not None]
    if not found or max(special.chdtrc(f.dof, f.left) for f in found) >= CERTAIN:
        return found
    hypotheses = [*hypotheses, *pairs_of_zeros(hypotheses)]
    return [f for one in hypotheses if (f := fit_change(one, rows, len(hypotheses))) is not None]


def likely_changes(found: Sequence[HypothesisTest]) -> list[HypothesisTest]:
    """The hypotheses that no other excludes, without those that contain another likely one, the best first.

    Of single parameters, which the rows do not distinguish, zeros of joints come first: a joint slips sooner than its
    other figures change. Empty where the best explains nothing for certain.
    """
    if not found:
        return []
    scale = min(found, key=lambda f: f.left).scale
    likely = [f for f in found if not any(excludes(g, f, scale) for g in found)]
    if not any(f.certain for f in likely):
        return []
    likely = [f for f in likely if not any(is_part_of(g, f) for g in likely)]
    zero = min((f.left for f in likely if f.hypothesis.kind == "zero"), default=0.0)
    best = [(max(f.left, zero * (len(f.change) == 1)), f.hypothesis.kind != "zero", f.left) for f in likely]
    return [f for _, f in sorted(zip(best, likely, strict=True), key=lambda one: (*np.round(one[0], 6), one[1].k))]


def excludes(other: HypothesisTest, found: HypothesisTest, scale: float) -> bool:
    """Whether another hypothesis explains the rows better than chance would have it, were this one true."""
    return (found.left - other.left) / scale > quantile(WRONG / found.n, other.k)


def is_part_of(smaller: HypothesisTest, larger: HypothesisTest) -> bool:
    """Whether a hypothesis has all that another has, and more."""
    if smaller is larger or smaller.k >= larger.k:
        return False
    a, b = smaller.hypothesis.columns, larger.hypothesis.columns
    Q, _ = np.linalg.qr(b / np.maximum(np.linalg.norm(b, axis=0), 1e-300))
    return bool(np.linalg.norm(a - Q @ (Q.T @ a)) < 1e-6 * np.linalg.norm(a))


def refine_best(calibrated: Calibrated, rows: Rows, found: Sequence[HypothesisTest]) -> list[HypothesisTest]:
    """The tests, those of the best hypotheses with the rows linearised where these lead to."""
    of_arm = sorted((f for f in found if f.hypothesis.kind != "row"), key=lambda f: f.left)
    chosen = {f.hypothesis.names for f in of_arm[:MOST_REFINED]}
    return [_refined(f, calibrated, rows) if f.hypothesis.names in chosen else f for f in found]


def _refined(found: HypothesisTest, calibrated: Calibrated, rows: Rows) -> HypothesisTest:
    """A test with the rows linearised where its change leads to: a large change is not linear."""
    step, total, D, v = found, np.zeros(len(found.change)), found.hypothesis.directions, all_variables(calibrated.arm)
    for _ in range(ROUNDS):
        total = total + step.change
        values = v.moved(v.nominal(), D @ total)[v.robot_span]
        try:
            there = linearise_new_data(place_new_data(calibrated, rows, values))
        except CalibrationError:
            return found
        if (again := fit_change(replace(found.hypothesis, columns=there.of_arm @ D), there, found.n)) is None:
            return found
        step = again
        if np.all(np.abs(step.change) <= SETTLED * np.nan_to_num(step.sigma, nan=np.inf)):
            break
    drop = max(found.drop + found.left - step.left, 0.0)
    return replace(found, change=total + step.change, sigma=step.sigma, drop=drop, left=step.left)


def all_variables(robot: Robot) -> graph.Variables:
    """The variables of all parameters of a robot."""
    return graph.build_variables(robot.with_estimated(names_of(robot.parameters)), [False], False)


def motion(rows: Linear, found: HypothesisTest) -> Floats:
    """How a change moves the tool at random configurations, shape (n, 2, 3), rotation first, [rad] and [m].

    Args:
        rows: The rows at the calibrated arm.
        found: The change; no gross errors.
    """
    v, q = all_variables(rows.robot), random_readings(rows.robot, N_RANDOM, np.random.default_rng(0))
    J = forward(v.chains[0].at(v.nominal()), v.robot.trig(q)).jacobian
    return (J @ (found.hypothesis.directions @ found.change)).reshape(-1, 2, 3)


def rms_motion(motion: Floats) -> Floats:
    """RMS turn and shift of the tool, shape (2,), [rad] and [m]."""
    return np.sqrt(np.mean(np.sum(motion**2, axis=2), axis=0))


def merge_alike(rows: Linear, likely: Sequence[HypothesisTest], noise: Mapping[str, float]) -> list[HypothesisTest]:
    """Changes that move the tool alike everywhere but for less than the noise of one row, as one."""
    least = np.array([noise.get("orientation", np.inf), noise.get("position", noise.get("distance", 0.0))])
    kept: list[HypothesisTest] = []
    for f in likely:
        for i, other in enumerate(kept):
            if "row" in (f.hypothesis.kind, other.hypothesis.kind):
                continue
            if np.all(rms_motion(motion(rows, f) - motion(rows, other)) < least):
                same = tuple(dict.fromkeys((*other.hypothesis.same, *f.hypothesis.names)))
                kept[i] = replace(other, hypothesis=replace(other.hypothesis, same=same))
                break
        else:
            kept.append(f)
    return kept
