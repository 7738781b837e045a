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

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from scipy import special

from fg_calib.graph import WhitenedBlock, build_variables
from fg_calib.inputs import CalibrationError, Floats, Integers
from fg_calib.monitoring.new_data import Calibrated, Linear, Placed, Rows, linearise_new_data, place_new_data
from fg_calib.robot import Robot, forward, random_readings
from fg_calib.statistics import FACTOR

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

POSES = {"tool": "tool", "frame": "base"}
"""Hypotheses that are a pose, any turn and shift of it, and the variable that it is."""

Kind = Literal["zero", "parameter", "tool", "frame", "zeros", "row"]


@dataclass(frozen=True)
class ChangeHypothesis:
    """A change that is tested.

    Attributes:
        names: What changes.
        kind: What that is.
        units: `m` or `rad` of each.
        columns: Derivatives of the rows in it, shape (m, k).
        same: Names of hypotheses that move the tool alike everywhere.
    """

    names: tuple[str, ...]
    kind: Kind
    units: tuple[str, ...]
    columns: Floats
    same: tuple[str, ...] = ()


@dataclass(frozen=True)
class HypothesisTest:
    """What a hypothesis explains.

    Attributes:
        hypothesis: The change.
        change: Its best size, shape (k,), [m] and [rad].
        sigma: 1 sigma of each; nan where the rows do not see it.
        drop: By how much chi-square falls.
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
        return self.left <= FACTOR * self.dof or float(special.chdtrc(self.dof, self.left)) > CERTAIN

    @property
    def scale(self) -> float:
        """Reduced chi-square of what is left, at least 1."""
        return max(1.0, self.left / self.dof)


def quantile(probability: float, k: int) -> float:
    """The value that chi-square with k degrees of freedom exceeds with a probability."""
    return float(special.chdtri(k, probability))


def fit_change(hypothesis: ChangeHypothesis, rows: Linear, n: int) -> HypothesisTest | None:
    """What a hypothesis explains of rows; None where they do not see it.

    Args:
        hypothesis: The change.
        rows: The rows.
        n: Number of hypotheses that are tested.
    """
    size = np.linalg.norm(hypothesis.columns, axis=0)
    robot = rows.placed.problem.robot
    ordinary = np.array([robot.scale_of(unit) if unit else 1.0 for unit in hypothesis.units])
    acts = size * ordinary > SEEN
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


def columns_of(hypothesis: ChangeHypothesis, calibrated: Calibrated, rows: Linear) -> Floats:
    """Derivatives of rows in a hypothesis that is no gross error, shape (m, k)."""
    v = rows.placed.problem.variables
    if hypothesis.names[0] in POSES:
        item = next(i for i in v.items if i.kind == POSES[hypothesis.names[0]])
        out: Floats = rows.columns[:, item.columns]
        return out
    zeros, n = zero_names(calibrated.robot), v.n_robot_columns
    E = v.tangent_derivative(rows.placed.problem.start)[:n, :n]
    found = [
        rows.joints[:, zeros.index(name)] if name in zeros else rows.columns[:, :n] @ E[:, v.names.index(name)]
        for name in hypothesis.names
    ]
    return np.array(found).T


def single_changes(calibrated: Calibrated, rows: Linear) -> list[ChangeHypothesis]:
    """Zeros of joints first, then the other parameters that were estimated, those of the tool, the tool, the frame."""
    robot, zeros = calibrated.robot, zero_names(calibrated.robot)
    changes: list[tuple[str, Kind, tuple[str, ...]]] = [
        (name, "zero", (joint.unit,)) for name, joint in zip(zeros, robot.joints, strict=True)
    ]
    others = [p for p in robot.parameters if p.name not in zeros]
    kept = [p for p in others if p.estimated and 1 <= p.owner <= robot.n_joints]
    changes += [(p.name, "parameter", (p.unit,)) for p in kept]
    changes += [(p.name, "tool", (p.unit,)) for p in others if p.owner == robot.n_joints + 1]
    poses = {item.kind for item in rows.placed.problem.variables.items if item.is_pose}
    six = ("rad",) * 3 + ("m",) * 3
    changes += [(name, name, six) for name, item in POSES.items() if item in poses]  # type: ignore[misc]
    bare = [ChangeHypothesis((name,), kind, units, np.zeros((0, 0))) for name, kind, units in changes]
    return [replace(one, columns=columns_of(one, calibrated, rows)) for one in bare]


def zero_names(robot: Robot) -> tuple[str, ...]:
    """What the zero of each joint is called: theta3 or d3 where the convention has it, else `<joint>.zero`."""
    moving = {e.joint: robot.parameters[e.parameter].name for e in robot.elements
              if e.joint is not None and e.parameter is not None}  # fmt: skip
    return tuple(moving.get(j, f"{joint.name}.zero") for j, joint in enumerate(robot.joints))


def pairs_of_zeros(hypotheses: Sequence[ChangeHypothesis]) -> list[ChangeHypothesis]:
    """Two zeros together."""
    zeros = [one for one in hypotheses if one.kind == "zero"]
    return [
        ChangeHypothesis(a.names + b.names, "zeros", a.units + b.units, np.hstack([a.columns, b.columns]))
        for a, b in combinations(zeros, 2)
    ]


def gross_errors(rows: Linear) -> list[ChangeHypothesis]:
    """Errors of any size in the rows of each configuration that is in at most a quarter of a table's measurements.

    None where there are more than `MOST_ROWS`.
    """
    problem, m = rows.placed.problem, len(rows.columns)
    if m > MOST_ROWS:
        return []
    columns: dict[int, list[Floats]] = {}
    start = 0
    for row_set in problem.rows:
        first = 0
        for part in row_set.parts:
            ends, h = problem.data.places[part.table][part.block.ends], part.block.residual_dim
            for k in np.unique(ends):
                measured = np.flatnonzero((ends == k).any(axis=1))
                if 4 * len(measured) <= max(part.block.n, 4):
                    at = (first + measured[:, None] * h + np.arange(h)).ravel()
                    columns.setdefault(int(k), []).append(_columns_of_errors(row_set, start, at, m))
            first += part.n_rows
        start += first if row_set.states is None else row_set.states.n
    found = []
    for k, several in columns.items():
        wide = np.hstack(several)
        wide = wide[:, np.any(wide != 0.0, axis=0)]
        found.append(ChangeHypothesis((problem.data.names[k],), "row", ("",) * wide.shape[1], wide))
    return found


def _columns_of_errors(row_set: WhitenedBlock, start: int, at: Integers, m: int) -> Floats:
    """Derivatives of all rows in errors of some rows of a set, shape (m, n).

    Args:
        row_set: The set.
        start: Its first row of all.
        at: Which of its rows, before what they share is taken out, shape (n,).
        m: Number of all rows.
    """
    unit = np.zeros((sum(part.n_rows for part in row_set.parts), len(at)))
    unit[at, np.arange(len(at))] = 1.0
    whitened = unit if row_set.states is None else row_set.states.whiten(unit)
    out = np.zeros((m, len(at)))
    out[start : start + len(whitened)] = whitened
    return out


def fit_changes(calibrated: Calibrated, rows: Linear) -> list[HypothesisTest]:
    """What each hypothesis explains, pairs of zeros among them where no single change explains the rows."""
    hypotheses = [*single_changes(calibrated, rows), *gross_errors(rows)]
    found = [f for one in hypotheses if (f := fit_change(one, rows, len(hypotheses))) is not None]
    if not found or max(special.chdtrc(f.dof, f.left) for f in found) >= CERTAIN:
        return found
    hypotheses += pairs_of_zeros(hypotheses)
    return [f for one in hypotheses if (f := fit_change(one, rows, len(hypotheses))) is not None]


def likely_changes(found: Sequence[HypothesisTest]) -> list[HypothesisTest]:
    """The hypotheses that no other excludes, without those that contain another likely one.

    Empty where the best explains nothing for certain.
    """
    if not found:
        return []
    scale = min(found, key=lambda f: f.left).scale
    likely = [f for f in found if not any(excludes(g, f, scale) for g in found)]
    if not any(f.certain for f in likely):
        return []
    likely = [f for f in likely if not any(is_part_of(g, f) for g in likely)]
    return sorted(likely, key=lambda f: (round(f.left, 6), f.k))


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


def refine_best(
    calibrated: Calibrated, rows: Rows, found: Sequence[HypothesisTest], likely: Sequence[HypothesisTest]
) -> list[HypothesisTest]:
    """The tests, those of the best hypotheses with the rows linearised where these lead to."""
    of_arm = sorted((f for f in found if f.hypothesis.kind != "row"), key=lambda f: f.left)[:MOST_REFINED]
    chosen = {f.hypothesis.names for f in (*of_arm, *likely[:MOST_REFINED]) if f.hypothesis.kind != "row"}
    return [_refined(f, calibrated, rows) if f.hypothesis.names in chosen else f for f in found]


def _refined(found: HypothesisTest, calibrated: Calibrated, rows: Rows) -> HypothesisTest:
    """A test with the rows linearised where its change leads to: a large change is not linear."""
    step, total = found, np.zeros(len(found.change))
    for _ in range(ROUNDS):
        total = total + step.change
        try:
            there = linearise_new_data(calibrated, _place_changed(found.hypothesis, total, calibrated, rows))
        except CalibrationError:
            return found
        hypothesis = replace(found.hypothesis, columns=columns_of(found.hypothesis, calibrated, there))
        again = fit_change(hypothesis, there, found.n)
        if again is None:
            return found
        step = again
        if np.all(np.abs(step.change) <= SETTLED * np.nan_to_num(step.sigma, nan=np.inf)):
            break
    drop = max(found.drop + found.left - step.left, 0.0)
    return replace(found, change=total + step.change, sigma=step.sigma, drop=drop, left=step.left)


def _place_changed(hypothesis: ChangeHypothesis, change: Floats, calibrated: Calibrated, rows: Rows) -> Placed:
    """The rows at the arm as a hypothesis would have it."""
    robot, zeros = calibrated.robot, zero_names(calibrated.robot)
    values, offsets = calibrated.values.copy(), np.zeros(robot.n_joints)
    names = [p.name for p in robot.parameters]
    if hypothesis.names[0] in POSES:
        v = build_variables(robot.with_estimated(names), [False], False)
        step = np.zeros(v.n_columns)
        step[next(i for i in v.items if i.kind == POSES[hypothesis.names[0]]).columns] = change
        values = v.moved(np.append(values, np.zeros(6)), step)[: len(values)]
    else:
        for name, amount in zip(hypothesis.names, change, strict=True):
            if name in zeros:
                offsets[zeros.index(name)] += amount
            else:
                values[names.index(name)] += amount
    return place_new_data(calibrated, rows.turned(offsets), values)


def motions(robot: Robot, readings: Floats) -> dict[str, Floats]:
    """How the tool moves with each parameter and each joint's zero, with any turn and shift of tool and frame.

    Args:
        robot: The robot at its values.
        readings: Shape (n, n_joints).

    Returns:
        By name, shape (n, 6, 1), of `tool` and `frame` (n, 6, 6); rotation first, about the base's axes.
    """
    v = build_variables(robot.with_estimated([p.name for p in robot.parameters]), [False], False)
    x = np.append(robot.nominal, np.zeros(6))
    at = forward(v.chains[0].at(x).with_joint_columns(), robot.trig(readings))
    named = at.jacobian[:, :, : v.n_columns] @ v.tangent_derivative(x)
    columns = np.concatenate([named, at.jacobian[:, :, v.n_columns :]], axis=2)
    names = [*v.names, *zero_names(robot)]
    found = {name: columns[:, :, [i]] for i, name in enumerate(names)}
    poses = {item.kind: at.jacobian[:, :, item.columns] for item in v.items if item.is_pose}
    return found | {name: poses[item] for name, item in POSES.items() if item in poses}


def motion(calibrated: Calibrated, found: HypothesisTest, readings: Floats | None = None) -> Floats:
    """How a change moves the tool, shape (n, 2, 3), turn first, [rad] and [m].

    Args:
        calibrated: The arm.
        found: The change; no gross errors.
        readings: The configurations, shape (n, n_joints); None for 200 random ones.
    """
    q = random_readings(calibrated.robot, 200, np.random.default_rng(0)) if readings is None else readings
    of = motions(calibrated.robot.with_values(calibrated.values), q)
    columns = np.concatenate([of[name] for name in found.hypothesis.names], axis=2)
    out: Floats = (columns @ found.change).reshape(-1, 2, 3)
    return out


def rms_motion(motion: Floats) -> Floats:
    """RMS turn and shift of the tool, shape (2,), [rad] and [m]."""
    out: Floats = np.sqrt(np.mean(np.sum(motion**2, axis=2), axis=0))
    return out


def merge_alike(
    calibrated: Calibrated, likely: Sequence[HypothesisTest], noise: Mapping[str, float]
) -> list[HypothesisTest]:
    """Changes that move the tool alike everywhere but for less than the noise of one row, as one."""
    least = np.array([noise.get("orientation", np.inf), noise.get("position", noise.get("distance", 0.0))])
    kept: list[HypothesisTest] = []
    for f in likely:
        for i, other in enumerate(kept):
            if "row" in (f.hypothesis.kind, other.hypothesis.kind):
                continue
            if np.all(rms_motion(motion(calibrated, f) - motion(calibrated, other)) < least):
                same = tuple(dict.fromkeys((*other.hypothesis.same, *f.hypothesis.names)))
                kept[i] = replace(other, hypothesis=replace(other.hypothesis, same=same))
                break
        else:
            kept.append(f)
    return kept
