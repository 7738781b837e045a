"""Check of a job's set-up: mistakes that explain why residuals before calibration are far too large.

Each mistake is undone on some rows of a table: units, signs, orders of columns, inverted poses, a frame or a tool that
is not what the job says; then two of them together. A mistake explains the table if undoing it divides the excess (see
`nominal_residuals`) by `REDUCTION` at least and leaves no more than `EXPLAINED`. Where several do, the simplest comes
first: a unit before the meaning of columns, that before a single joint, and a frame or a tool, which bring unknowns of
their own, last.

Base and tool are one for all tables, so a table that is wrong spoils the residuals of all others; each is therefore
judged by the base and tool that it determines alone. Only where all tables are right alone can they disagree on base
and tool, and it is reported of those that are farthest off: both, where there are two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fg_calib.diagnostics.nominal_residuals import Setup, TypicalResidual, nominal_residuals, residuals_at, setup_of
from fg_calib.diagnostics.setup_hypotheses import About, Mistake, setup_hypotheses, still_joints
from fg_calib.graph import Problem
from fg_calib.inputs import Brief, Floats, FrameKnowledge, Model, checked
from fg_calib.measurements import Measurements, Table
from fg_calib.parallel import one_blas_thread
from fg_calib.robot import Robot

FAR = 5.0
"""Excess above which residuals before a calibration are not what noise and prior sigmas predict."""

EXPLAINED = 4.0
"""Largest excess that may be left once a mistake is undone."""

REDUCTION = 5.0
"""Undoing a mistake divides the excess by this at least; undoing two, the excess that either alone leaves."""

N_COMBINED = 6
"""The best single mistakes, each of which is combined with any other."""

NEGLIGIBLE_EXCESS = 1e-6
"""Excess below which there is nothing to explain: each unknown takes its own row up."""

FARTHEST_SHARE = 0.7
"""Excess of a table over that of the one that is farthest off, from which it is named too: two tables are both."""

OTHER_TOOL = "tool or base differ from those of the other tables (another target on the tool, another frame)"


@dataclass(frozen=True)
class Explanation:
    """A mistake in the set-up that explains a table, or two together.

    Attributes:
        mistakes: Each as the end of a sentence "residuals fall if ...".
        residuals: Residuals once they are undone, by kind.
    """

    mistakes: tuple[str, ...]
    residuals: tuple[TypicalResidual, ...]

    @property
    def excess(self) -> float:
        """The largest excess of all kinds; infinite without residuals."""
        return max((residual.excess for residual in self.residuals), default=np.inf)

    def __str__(self) -> str:
        return " and ".join(self.mistakes)


@dataclass(frozen=True)
class SetupCheck(Brief):
    """Residuals before a calibration, and what they say of its set-up.

    Attributes:
        residuals: As the job says, by kind; empty where there are too few rows to tell.
        explanations: Mistakes that explain them where they are too large, the simplest first.
        table: Which of several tables they are of; empty of one alone.
        others: Checks of others of several tables that report something too.
        unchecked: Tables that could not be checked: too few rows, or custom kinds.
    """

    residuals: tuple[TypicalResidual, ...] = ()
    explanations: tuple[Explanation, ...] = ()
    table: str = ""
    others: tuple[SetupCheck, ...] = ()
    unchecked: tuple[str, ...] = ()

    @property
    def excess(self) -> float:
        """The largest excess of all kinds; 0 without residuals."""
        return max((residual.excess for residual in self.residuals), default=0.0)

    @property
    def worst(self) -> TypicalResidual:
        """The kind with the largest excess."""
        return max(self.residuals, key=lambda residual: residual.excess)

    @property
    def far(self) -> bool:
        """Whether noise and prior sigmas do not predict these residuals."""
        return self.excess > FAR

    def __str__(self) -> str:
        of_table = f"{self.table}: " if self.table else ""
        if not self.explanations:
            times = f"{self.excess:.3g} times what noise and prior sigmas predict"
            found = f"{self.worst.kind} residuals before calibration are {shown(self.worst)} in the median, {times}"
            return f"{of_table}{found}: no common mistake in a set-up explains it"
        first, *others = self.explanations
        after = next(r for r in first.residuals if r.kind == self.worst.kind)
        also = "".join(f", or if {other}" for other in others[:2])
        also += f", or {len(others) - 2} more (--json has all)" if len(others) > 2 else ""
        fall = f"{self.worst.kind} residuals fall from {shown(self.worst)} to {shown(after)} in the median"
        return f"{of_table}{fall} if {first}{also}"


def shown(residual: TypicalResidual) -> str:
    """A typical size with its unit, in mm, degrees or pixels: `812 mm`."""
    factor, unit = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "deg"), "px": (1.0, "px")}[residual.unit]
    size = residual.size * factor
    return f"{size:.0f} {unit}" if 1e3 <= size < 1e9 else f"{size:.3g} {unit}"


@checked
def check_setup(
    robot: Robot,
    measurements: Measurements,
    model: Model,
    frame: FrameKnowledge = "known",
    *,
    doubtful: bool = False,
    table: Table | None = None,
) -> SetupCheck:
    """Compare residuals before a calibration with what noise and prior sigmas predict, and look for a mistake.

    Args:
        robot: The nominal robot; the estimated parameters of its base and tool are fitted.
        measurements: What was measured; train rows are looked at.
        model: Which measurements take part.
        frame: Whether the measurement frame is known.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        table: What else is known of the table: targets and anchors, an offset, a camera.

    Note:
        Models with landmarks (anchors, planes, boards) and targets are looked at only where `doubtful`: these have to
        be located first, a hundred times in all, and two mistakes at once are not looked for there.

    Raises:
        InputError: An option is not one of those possible.
    """
    given = Table(measurements, model, frame=frame) if table is None else table
    with one_blas_thread:
        setup = setup_of(robot, given)
        if setup is None or (setup.has_landmarks and not doubtful):
            return SetupCheck()
        return _check_alone(setup, doubtful)


def check_problem(problem: Problem, before: Floats, *, doubtful: bool = False) -> SetupCheck:
    """The check of the table of a problem with the most to report; of others in its `others`.

    Args:
        problem: The problem.
        before: The parameter vector with base, tool and measurement frame fitted, the arm at nominal.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
    """
    checks = check_tables(problem, before, doubtful=doubtful, with_landmarks=doubtful)
    found = reporting(checks) or sorted(checks, key=lambda one: -one.excess)[:1]
    unchecked = [label for label, one in zip(problem.data.labels, checks, strict=True) if not one.residuals]
    return replace(found[0], others=tuple(found[1:]), unchecked=tuple(unchecked) if doubtful else ())


def reporting(checks: Sequence[SetupCheck]) -> list[SetupCheck]:
    """The checks that report something, those that explain it first, then the worst."""
    far = [one for one in checks if one.far] or [one for one in checks if one.explanations]
    return sorted(far, key=lambda one: (not one.explanations, -one.excess))


def check_tables(
    problem: Problem, before: Floats, *, doubtful: bool = False, with_landmarks: bool = False
) -> list[SetupCheck]:
    """The check of each table.

    Args:
        problem: The problem.
        before: The parameter vector with base, tool and measurement frame fitted, the arm at nominal.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        with_landmarks: Look at tables whose targets, anchors, planes or boards have to be located first.
    """
    whole, labels = problem.whole or problem, problem.data.labels
    checks, joint = list[SetupCheck](), dict[int, tuple[Setup, SetupCheck]]()
    with one_blas_thread:
        for number, (label, table) in enumerate(zip(labels, problem.data.tables, strict=True)):
            setup, one = setup_of(whole.robot, table), SetupCheck()
            if setup is not None and setup.has_landmarks and with_landmarks:
                one = _check_alone(setup, True)
            elif setup is not None and not setup.has_landmarks and _enough(setup):
                together = residuals_at(whole, before, whole.robot, number)
                one = _check_alone(setup, doubtful, together)
                joint[number] = setup, SetupCheck(together, table=label)
            checks.append(replace(one, table=label if len(labels) > 1 else ""))
        if len(checks) > 1 and not reporting(checks):
            for number, one in _disagreeing(joint):
                checks[number] = one
    return checks


def _enough(setup: Setup) -> bool:
    """Whether a table has enough rows to tell residuals from what is fitted to them."""
    m, pairs = setup.table.measurements, setup.table.measurements.pairs
    n_free = 6 * (setup.table.frame == "unknown") + len(setup.fitted_tool)
    n_rows = pairs.n_pairs if pairs is not None and m.groups is None else 3 * m.n_configurations
    return n_rows >= 2 * n_free + 6


def _check_alone(setup: Setup, doubtful: bool, together: tuple[TypicalResidual, ...] = ()) -> SetupCheck:
    """The check of a table, and the mistakes that explain its residuals.

    Args:
        setup: The table.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        together: Its residuals with the base and the tool that all tables determine together.
    """
    found = SetupCheck(together)
    if not together or found.far or doubtful:
        alone = SetupCheck(nominal_residuals(setup))
        found = alone if not together or 0.0 < alone.excess < found.excess else found
    look = found.far or (doubtful and not setup.has_landmarks and found.excess >= NEGLIGIBLE_EXCESS)
    return replace(found, explanations=_explanations(setup, found)) if look else found


def _disagreeing(joint: dict[int, tuple[Setup, SetupCheck]]) -> list[tuple[int, SetupCheck]]:
    """Tables that only a tool and a base of their own fit, by their numbers; those that are farthest off.

    Args:
        joint: Each table alone, and its residuals with the base and the tool that all tables determine together.
    """
    found = []
    for number, (setup, one) in joint.items():
        alone = Explanation((OTHER_TOOL,), nominal_residuals(setup))
        if one.far and alone.excess <= min(EXPLAINED, one.excess / REDUCTION):
            found.append((number, replace(one, explanations=(alone,))))
    farthest = max((one.excess for _, one in found), default=0.0)
    return [(number, one) for number, one in found if one.excess > FARTHEST_SHARE * farthest]


def _explanations(setup: Setup, given: SetupCheck) -> tuple[Explanation, ...]:
    """Mistakes that explain residuals, the simplest first; two together where no single one does."""
    # Where residuals are no larger than predicted only what has unknowns of its own can make them much smaller.
    least = About.FRAME if given.excess < 1.0 else About.UNIT
    single, most = [_trial(m) for m in setup_hypotheses(setup) if m.about >= least], given.excess / REDUCTION
    found = _accepted(single, most)
    if given.far and (not found or any("readings" in str(one) for one in found)):
        found = _accepted([*single, *map(_trial, still_joints(setup))], most)
    return found if found or not given.far or setup.has_landmarks else _accepted(_doubles(single, given.excess), np.inf)


_Trial = tuple[tuple[Mistake, ...], Explanation]
"""Mistakes that were undone, and the residuals that are left then."""


def _trial(*mistakes: Mistake) -> _Trial:
    """Mistakes with the residuals that are left once they are undone, the last of which has the others undone too."""
    words = tuple(m.words for m in sorted(mistakes, key=lambda m: m.about))
    return mistakes, Explanation(words, nominal_residuals(mistakes[-1].without))


def _doubles(single: Sequence[_Trial], given: float) -> list[_Trial]:
    """Two mistakes undone together, where that reduces the excess far below `given` and below either alone."""
    alone, found = {one.words: trial.excess for (one,), trial in single}, dict[frozenset[str], _Trial]()

    def left(trial: Explanation) -> float:  # of all kinds: undoing one of two may leave one kind as bad as before
        return float(np.sum(np.log([r.excess for r in trial.residuals]))) if trial.residuals else np.inf

    for (one,), _ in sorted(single, key=lambda pair: left(pair[1]))[:N_COMBINED]:
        for two in setup_hypotheses(one.without):
            words, what = frozenset((one.words, two.words)), [m.words.partition(" are in ")[0] for m in (one, two)]
            if words not in found and what[0] != what[1]:
                found[words] = _trial(one, two)
    return [
        pair
        for words, pair in found.items()
        if pair[1].excess <= min(given, *(alone.get(word, np.inf) for word in words)) / REDUCTION
    ]


def _accepted(trials: Sequence[_Trial], most: float) -> tuple[Explanation, ...]:
    """Trials that leave a small enough excess, at most twice that of the best; the simplest first."""
    good = [one for one in trials if one[1].excess <= min(most, EXPLAINED)]
    best = max(min((trial.excess for _, trial in good), default=0.0), 0.5)
    chosen = [one for one in good if one[1].excess <= 2.0 * best]
    return tuple(trial for _, trial in sorted(chosen, key=lambda one: sum(mistake.about for mistake in one[0])))
