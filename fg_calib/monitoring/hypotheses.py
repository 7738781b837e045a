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

Hypotheses that move the tool alike in all configurations are one: nothing distinguishes them, nor needs to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.errors import CalibrationError
from fg_calib.graph.error_states import WhitenedBlock
from fg_calib.graph.variables import build_variables
from fg_calib.monitoring.new_data import Calibrated, Linear, Placed, Rows, linear, placed
from fg_calib.robot.inverse import random_readings
from fg_calib.robot.kinematics import forward
from fg_calib.robot.model import Robot
from fg_calib.statistics.goodness_of_fit import FACTOR

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

WRONG = 0.01
"""Probability with which the true change is at most called distinguished from another."""

CERTAIN = 1e-3
"""Probability, times the number of hypotheses, below which what a hypothesis explains is no chance."""

SEEN = 1e-6
"""Share of a hypothesis's columns that must remain after the fit; else the rows do not see it. It is also the least
effect of an ordinary change on all rows together, in sigma (see `Robot.scale_of`)."""

SAME = 1e-6
"""Sine of the angle between what two hypotheses do to the tool everywhere, below which they are one."""

ROUNDS = 4
"""Times that rows are linearised anew at the change of a hypothesis."""

SETTLED = 1e-3
"""Change of the change, in its sigma, that needs no other round."""

MOST_REFINED = 6
"""Suspects that are linearised anew, the best ones."""

MOST_CONFIGURATIONS = 400
"""Configurations up to which each is a hypothesis."""

MOST_FIGURES = 10**8
"""Figures up to which the columns of all their rows together are made: they grow with the square of the rows."""

GROUPS = ("tool", "frame")
"""Suspects that are a pose: any turn and shift of it."""

Kind = Literal["zero", "parameter", "tool", "frame", "zeros", "row"]


@dataclass(frozen=True)
class ChangeHypothesis:
    """A change that is tried.

    Attributes:
        names: What changes.
        kind: What that is.
        units: `m` or `rad` of each.
        columns: Derivatives of the rows in it, shape (m, k).
        same: Names of hypotheses that move the tool alike everywhere.
        configuration: Of gross errors the configuration's number; else -1.
    """

    names: tuple[str, ...]
    kind: Kind
    units: tuple[str, ...]
    columns: Floats
    same: tuple[str, ...] = ()
    configuration: int = -1


@dataclass(frozen=True)
class HypothesisTest:
    """What a hypothesis explains.

    Attributes:
        hypothesis: It.
        change: Its best size, shape (k,), [m] and [rad].
        sigma: 1 sigma of each; nan where the rows do not see it.
        drop: By how much chi-square falls.
        left: Chi-square that is left.
        k: Degrees of freedom that it takes.
        p_value: Probability that chance explains as much, were noise as stated, the number of hypotheses counted.
        p_value_of_ratio: The same whatever the noise: of the drop beside what is left (F test).
    """

    hypothesis: ChangeHypothesis
    change: Floats
    sigma: Floats
    drop: float
    left: float
    k: int
    p_value: float
    p_value_of_ratio: float

    @property
    def certain(self) -> bool:
        """Whether what it explains is no chance, whatever the noise."""
        return max(self.p_value, self.p_value_of_ratio) < CERTAIN


def quantile(probability: float, k: int) -> float:
    """The value that chi-square with k degrees of freedom exceeds with a probability."""
    return float(special.chdtri(k, probability))


def tried(hypothesis: ChangeHypothesis, rows: Linear, n_hypotheses: int) -> HypothesisTest | None:
    """What a hypothesis explains of rows; None where they do not see it.

    Args:
        hypothesis: It.
        rows: The rows.
        n_hypotheses: How many are tried.
    """
    size = np.linalg.norm(hypothesis.columns, axis=0)
    robot = rows.placed.problem.robot
    ordinary = np.array([robot.scale_of(unit) if unit else 1.0 for unit in hypothesis.units])
    acts = size * ordinary > SEEN
    scale = np.where(acts, size, 1.0)
    new = rows.new(np.where(acts, hypothesis.columns / scale, 0.0))
    U, s, Vt = np.linalg.svd(new, full_matrices=False)
    k = int(np.sum(s > SEEN))
    if not k or rows.dof - k < 1:
        return None
    left, explained = rows.left, U[:, :k].T @ rows.left
    root = Vt[:k].T / s[:k] / scale[:, None]
    sigma = np.sqrt(np.sum(root**2, axis=1))
    sigma[np.linalg.norm(Vt[k:], axis=0) > SEEN] = np.nan
    drop, total = float(explained @ explained), float(left @ left)
    rest = max(total - drop, 1e-300)
    ratio = (drop / k) / (rest / (rows.dof - k))
    return HypothesisTest(
        hypothesis=hypothesis,
        change=-root @ explained,
        sigma=sigma,
        drop=drop,
        left=total - drop,
        k=k,
        p_value=min(1.0, n_hypotheses * float(special.chdtrc(k, drop))),
        p_value_of_ratio=min(1.0, n_hypotheses * float(special.fdtrc(k, rows.dof - k, ratio))),
    )


def all_hypotheses(calibrated: Calibrated, rows: Linear) -> list[ChangeHypothesis]:
    """Single changes: zeros of joints first, then the parameters that were estimated, the tool, then the frame.

    Those that move the tool alike everywhere are one, named by the first of them.
    """
    problem, robot = rows.placed.problem, calibrated.robot
    v = problem.variables
    E = v.tangent_derivative(problem.start)
    named = dict(zip(v.names, (rows.columns[:, : v.n_columns] @ E).T, strict=True))
    zeros = zero_names(robot)
    found = [
        ChangeHypothesis((zeros[j],), "zero", (joint.unit,), rows.joints[:, [j]])
        for j, joint in enumerate(robot.joints)
    ]
    tool = [p for p in robot.parameters if p.owner == robot.n_joints + 1]
    kept = [p for p in robot.parameters if p.estimated and p.name not in zeros and 1 <= p.owner <= robot.n_joints]
    for kind, parameters in (("parameter", kept), ("tool", tool)):
        found += [ChangeHypothesis((p.name,), kind, (p.unit,), named[p.name][:, None]) for p in parameters]  # type: ignore[arg-type]
    effects = _effects(robot.with_values(calibrated.values), [s.names[0] for s in found], _blind(problem.data.tables))
    single = _without_same(found, effects)
    poses = {i.kind: rows.columns[:, i.columns] for i in v.items if i.is_pose}
    units = ("rad",) * 3 + ("m",) * 3
    of_kind: tuple[tuple[Kind, str], ...] = (("tool", "tool"), ("frame", "base"))
    return single + [ChangeHypothesis((kind,), kind, units, poses[item]) for kind, item in of_kind if item in poses]


def zero_names(robot: Robot) -> tuple[str, ...]:
    """What the zero of each joint is called: theta3 or d3 where the convention has it, else `<joint>.zero`."""
    moving = {e.joint: robot.parameters[e.parameter].name for e in robot.elements
              if e.joint is not None and e.parameter is not None}  # fmt: skip
    return tuple(moving.get(j, f"{joint.name}.zero") for j, joint in enumerate(robot.joints))


def _blind(tables: Sequence[object]) -> bool:
    """Whether no table is of a known measurement frame: what moves the arm as one body is not seen anyway."""
    return not any(t.model in ("pose", "position", "orientation") and t.frame == "known" for t in tables)  # type: ignore[attr-defined]


def motions(robot: Robot, readings: Floats) -> tuple[dict[str, Floats], Floats, Floats]:
    """How the tool moves with each parameter, and with each joint's zero.

    Args:
        robot: The robot at its values.
        readings: Shape (n, n_joints).

    Returns:
        By name of parameters and zeros, by turn and shift of the base, and by those of the tool: shapes (n, 6),
        (n, 6, 6), (n, 6, 6); rotation first, about the base's axes.
    """
    everything = robot.with_estimated([p.name for p in robot.parameters])
    v = build_variables(everything, [False], False)
    x = np.append(robot.nominal, np.zeros(6))
    at = forward(v.chains[0].at(x).with_joint_columns(), robot.trig(readings))
    n = v.n_columns
    named = at.jacobian[:, :, :n] @ v.tangent_derivative(x)
    found = dict(zip(v.names, named.transpose(2, 0, 1), strict=True))
    found |= dict(zip(zero_names(robot), at.jacobian[:, :, n:].transpose(2, 0, 1), strict=True))
    p, base = at.position, np.zeros((len(readings), 6, 6))
    base[:, range(6), range(6)] = 1.0
    for axis in range(3):
        base[:, 3:, axis] = np.cross(np.eye(3)[axis], p)
    whole = {i.kind: at.jacobian[:, :, i.columns] for i in v.items if i.is_pose}
    return found, whole.get("base", base), whole.get("tool", base)


def _effects(robot: Robot, names: Sequence[str], blind: bool) -> Floats:
    """What each hypothesis does to the tool at random configurations, a column of length 1 each."""
    q = random_readings(robot, 200, np.random.default_rng(0))
    found, base, _ = motions(robot, q)
    weight = np.repeat([robot.reach, 1.0], 3)
    columns = np.array([(found[name] * weight).ravel() for name in names]).T
    if blind:
        Q, _ = np.linalg.qr((base * weight[:, None]).reshape(-1, 6))
        size = np.linalg.norm(columns, axis=0)
        columns = columns - Q @ (Q.T @ columns)
        columns[:, np.linalg.norm(columns, axis=0) < SEEN * size] = 0.0
    out: Floats = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return out


def _without_same(hypotheses: Sequence[ChangeHypothesis], effects: Floats) -> list[ChangeHypothesis]:
    """The first of those that move the tool alike, the others named in it; none that moves nothing."""
    found: list[tuple[ChangeHypothesis, int]] = []
    for i, hypothesis in enumerate(hypotheses):
        e = effects[:, i]
        if not e.any():
            continue
        for k, (other, j) in enumerate(found):
            f = effects[:, j]
            if np.linalg.norm(e - f * (e @ f)) < SAME:
                found[k] = (replace(other, same=(*other.same, *hypothesis.names)), j)
                break
        else:
            found.append((hypothesis, i))
    return [hypothesis for hypothesis, _ in found]


def pairs_of_zeros(hypotheses: Sequence[ChangeHypothesis]) -> list[ChangeHypothesis]:
    """Two zeros together, of those that are hypotheses."""
    zeros = [s for s in hypotheses if s.kind == "zero"]
    return [
        ChangeHypothesis(a.names + b.names, "zeros", a.units + b.units, np.hstack([a.columns, b.columns]))
        for a, b in combinations(zeros, 2)
    ]


def gross_rows(rows: Linear) -> list[ChangeHypothesis]:
    """The rows of each configuration that few others share measurements with; none of very many."""
    problem = rows.placed.problem
    places = problem.data.places
    of_configuration: dict[int, list[tuple[WhitenedBlock, int, Integers]]] = {}
    start, m, n_columns = 0, len(rows.columns), 0
    for row_set in problem.rows:
        first = 0
        for part in row_set.parts:
            ends = places[part.table][part.block.ends]
            h = part.block.residual_dim
            for k in np.unique(ends):
                measured = np.flatnonzero((ends == k).any(axis=1))
                if 4 * len(measured) > max(part.block.n, 4):
                    continue
                at = (first + measured[:, None] * h + np.arange(h)).ravel()
                of_configuration.setdefault(int(k), []).append((row_set, start, at))
                n_columns += len(at)
                if len(of_configuration) > MOST_CONFIGURATIONS or m * n_columns > MOST_FIGURES:
                    return []
            first += part.n_rows
        start += first if row_set.shared is None else row_set.shared.n
    names = problem.data.names
    found = []
    for k, blocks in of_configuration.items():
        columns = np.hstack([_of_errors(*block, m) for block in blocks])
        columns = columns[:, np.any(columns != 0.0, axis=0)]
        found.append(ChangeHypothesis((names[k],), "row", ("",) * columns.shape[1], columns, configuration=k))
    return found


def _of_errors(row_set: WhitenedBlock, start: int, at: Integers, m: int) -> Floats:
    """Columns of errors of some whitened rows of a set, shape (m, n).

    Args:
        row_set: The set.
        start: Its first row of all.
        at: Which of its rows, before what they share is taken out, shape (n,).
        m: Number of all rows.
    """
    unit = np.zeros((sum(part.n_rows for part in row_set.parts), len(at)))
    unit[at, np.arange(len(at))] = 1.0
    whitened = unit if row_set.shared is None else row_set.shared.whiten(unit)
    out = np.zeros((m, len(at)))
    out[start : start + len(whitened)] = whitened
    return out


def refined(
    found: HypothesisTest, calibrated: Calibrated, rows: Rows, n_hypotheses: int, columns: Callable[[Linear], Floats]
) -> HypothesisTest:
    """What a hypothesis explains with the rows linearised where it leads to: a large change is not linear.

    Args:
        found: What it explains where the arm was calibrated.
        calibrated: The arm.
        rows: The rows.
        n_hypotheses: How many are tried.
        columns: The hypothesis's columns, of rows linearised elsewhere.
    """
    best, total = found, np.zeros(len(found.change))
    for _ in range(ROUNDS):
        total = total + best.change
        try:
            at = _moved(found.hypothesis, total, calibrated, rows)
        except CalibrationError:
            return found
        there = linear(calibrated, at)
        step = tried(replace(found.hypothesis, columns=columns(there)), there, n_hypotheses)
        if step is None:
            return found
        left = step.left
        best = step
        if np.all(np.abs(step.change) <= SETTLED * np.nan_to_num(step.sigma, nan=np.inf)):
            break
    drop = max(found.drop + found.left - left, 0.0)
    ratio = (drop / found.k) / (max(left, 1e-300) / max(rows_dof(there, found.k), 1))
    return replace(
        found,
        change=total + best.change,
        sigma=best.sigma,
        drop=drop,
        left=left,
        p_value=min(1.0, n_hypotheses * float(special.chdtrc(found.k, drop))),
        p_value_of_ratio=min(1.0, n_hypotheses * float(special.fdtrc(found.k, rows_dof(there, found.k), ratio))),
    )


def rows_dof(rows: Linear, k: int) -> int:
    """Degrees of freedom that a hypothesis of k leaves."""
    return max(rows.dof - k, 1)


def _moved(hypothesis: ChangeHypothesis, change: Floats, calibrated: Calibrated, rows: Rows) -> Placed:
    """The rows at the arm as a hypothesis would have it."""
    robot, zeros = calibrated.robot, zero_names(calibrated.robot)
    values, offsets = calibrated.values.copy(), np.zeros(robot.n_joints)
    names = [p.name for p in robot.parameters]
    if hypothesis.names[0] in GROUPS:
        v = build_variables(robot.with_estimated(names), [False], False)
        item = next(i for i in v.items if i.kind == ("tool" if hypothesis.names == ("tool",) else "base"))
        step = np.zeros(v.n_columns)
        step[item.columns] = change
        values = v.stepped(np.append(values, np.zeros(6)), step)[: len(values)]
    else:
        for name, amount in zip(hypothesis.names, change, strict=True):
            if name in zeros:
                offsets[zeros.index(name)] += amount
            else:
                values[names.index(name)] += amount
    return placed(calibrated, rows.turned(offsets), values)


def columns_of(hypothesis: ChangeHypothesis, calibrated: Calibrated) -> Callable[[Linear], Floats]:
    """A hypothesis's columns, of rows linearised anywhere."""

    def columns(rows: Linear) -> Floats:
        zeros, v = zero_names(calibrated.robot), rows.placed.problem.variables
        if hypothesis.names[0] in GROUPS:
            kind = "tool" if hypothesis.names == ("tool",) else "base"
            out: Floats = rows.columns[:, next(i for i in v.items if i.kind == kind).columns]
            return out
        n = v.n_robot_columns
        E = v.tangent_derivative(rows.placed.problem.start)[:n, :n]
        found = [
            rows.joints[:, zeros.index(name)] if name in zeros else rows.columns[:, :n] @ E[:, v.names.index(name)]
            for name in hypothesis.names
        ]
        return np.array(found).T

    return columns


def check_hypotheses(calibrated: Calibrated, rows: Linear) -> list[HypothesisTest]:
    """What each hypothesis explains, pairs of zeros among them where no single change explains the rows."""
    hypotheses = [*all_hypotheses(calibrated, rows), *gross_rows(rows)]
    found = [f for s in hypotheses if (f := tried(s, rows, len(hypotheses))) is not None]
    if not found:
        return []
    best = min(found, key=lambda f: f.left)
    if special.chdtrc(max(rows.dof - best.k, 1), best.left) >= CERTAIN:
        return found
    pairs = pairs_of_zeros(hypotheses)
    n = len(hypotheses) + len(pairs)
    return [f for s in [*hypotheses, *pairs] if (f := tried(s, rows, n)) is not None]


def likely_changes(found: Sequence[HypothesisTest], rows: Linear) -> list[HypothesisTest]:
    """The hypotheses that no other excludes, without those that contain another likely one.

    Empty where the best explains nothing for certain.
    """
    if not found:
        return []
    best = min(found, key=lambda f: f.left)
    scale = max(1.0, best.left / max(rows.dof - best.k, 1))
    likely = [f for f in found if not any(excludes(g, f, scale, len(found)) for g in found)]
    if not any(f.certain for f in likely):
        return []
    return sorted((f for f in likely if not any(within(g, f) for g in likely)), key=lambda f: (f.left, f.k))


def excludes(other: HypothesisTest, found: HypothesisTest, scale: float, n: int) -> bool:
    """Whether the rows tell another hypothesis from one, were it that."""
    return (found.left - other.left) / scale > quantile(WRONG / n, other.k)


def within(smaller: HypothesisTest, larger: HypothesisTest) -> bool:
    """Whether a hypothesis has all that another has, and more."""
    if smaller is larger or smaller.k >= larger.k:
        return False
    a, b = smaller.hypothesis.columns, larger.hypothesis.columns
    Q, _ = np.linalg.qr(b / np.maximum(np.linalg.norm(b, axis=0), 1e-300))
    return bool(np.linalg.norm(a - Q @ (Q.T @ a)) < 1e-6 * np.linalg.norm(a))


def explains(found: HypothesisTest, rows: Linear) -> bool:
    """Whether a hypothesis leaves no more than noise does, or at most `FACTOR` times that."""
    dof = max(rows.dof - found.k, 1)
    return found.left <= FACTOR * dof or float(special.chdtrc(dof, found.left)) > CERTAIN


def best_refined(
    calibrated: Calibrated, rows: Rows, at: Linear, found: list[HypothesisTest], likely: list[HypothesisTest]
) -> list[HypothesisTest]:
    """The best hypotheses linearised where they lead to."""
    ranked = sorted((f for f in found if f.hypothesis.kind != "row"), key=lambda f: f.left)[:MOST_REFINED]
    chosen = {f.hypothesis.names for f in (*ranked, *likely[:MOST_REFINED]) if f.hypothesis.kind != "row"}
    return [
        refined(f, calibrated, rows, len(found), columns_of(f.hypothesis, calibrated))
        if f.hypothesis.names in chosen
        else f
        for f in found
    ]


def motion(calibrated: Calibrated, found: HypothesisTest, readings: Floats) -> Floats:
    """How a change moves the tool at configurations, shape (n, 2, 3), turn first.

    Args:
        calibrated: The arm.
        found: The change; no gross errors.
        readings: The configurations, shape (n, n_joints).
    """
    names = found.hypothesis.names
    of, base, tool = motions(calibrated.robot.with_values(calibrated.values), readings)
    whole = {"frame": base, "tool": tool}.get(found.hypothesis.kind if len(names) == 1 and names[0] in GROUPS else "")
    columns = np.stack([of[name] for name in names], axis=2) if whole is None else whole
    out: Floats = (columns @ found.change).reshape(-1, 2, 3)
    return out


def _motion(calibrated: Calibrated, found: HypothesisTest) -> Floats | None:
    """The same at random configurations; None of gross errors."""
    if found.hypothesis.kind == "row":
        return None
    return motion(calibrated, found, random_readings(calibrated.robot, 200, np.random.default_rng(0)))


def effect_elsewhere(calibrated: Calibrated, found: HypothesisTest) -> dict[str, float] | None:
    """RMS error of the tool that a change makes at random configurations; None where it is none of the arm."""
    motion = _motion(calibrated, found)
    if motion is None or found.hypothesis.kind == "frame":
        return None
    return dict(zip(("orientation", "position"), _size(motion).tolist(), strict=True))


def _size(motion: Floats) -> Floats:
    """RMS turn and shift, shape (2,)."""
    out: Floats = np.sqrt(np.mean(np.sum(motion**2, axis=2), axis=0))
    return out


def merged(calibrated: Calibrated, likely: Sequence[HypothesisTest], noise: dict[str, float]) -> list[HypothesisTest]:
    """Explanations by which the tool is the same everywhere but for less than the noise of one row, as one."""
    least = np.array([noise.get("orientation", np.inf), noise.get("position", noise.get("distance", 0.0))])
    kept: list[tuple[HypothesisTest, Floats | None]] = []
    for f in likely:
        motion = _motion(calibrated, f)
        for i, (other, theirs) in enumerate(kept):
            if motion is not None and theirs is not None and np.all(_size(motion - theirs) < least):
                same = tuple(dict.fromkeys((*other.hypothesis.same, *f.hypothesis.names, *f.hypothesis.same)))
                kept[i] = replace(other, hypothesis=replace(other.hypothesis, same=same)), theirs
                break
        else:
            kept.append((f, motion))
    return [f for f, _ in kept]
