"""Mistakes in the set-up of a job that explain why residuals before calibration are far too large.

Each usual mistake is undone on some rows of the table: units, signs, orders of columns, inverted poses, a frame or a
tool that is not what the job says; then two of them together. A mistake explains the table if undoing it divides the
excess (see `typical_residuals`) by `REDUCTION` at least and leaves no more than `EXPLAINED`. Where several do, the
simplest comes first: a unit before the meaning of columns, that before a single joint, and a frame or a tool, which
bring unknowns of their own, last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fg_calib.analysis.setup import Setup, setup_of
from fg_calib.analysis.typical_residuals import TypicalResidual, fitted_residuals, residuals_at
from fg_calib.analysis.usual_mistakes import About, Mistake, usual_mistakes
from fg_calib.graph.factors import pose_of
from fg_calib.graph.frames import Frame
from fg_calib.graph.problem import Problem
from fg_calib.measurements.dataset import Measurements
from fg_calib.options import FrameKnowledge, Model, check, check_flag
from fg_calib.robot.model import Robot
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]

FAR = 5.0
"""Excess above which residuals before a calibration are not what noise and tolerances predict."""

EXPLAINED = 4.0
"""Largest excess that may be left once a mistake is undone."""

REDUCTION = 5.0
"""Undoing a mistake divides the excess by this at least; undoing two, the excess that either alone leaves."""

_BEST = 4
"""The best single mistakes are combined with any other; those after them not with mistakes about one joint."""


NOTHING = 1e-6
"""Residuals over what is predicted below which there is nothing to explain: each unknown takes its own row up."""

OTHER_TOOL = "tool or base are others here than in the other tables (another target on the tool, another frame)"
"""What a table of several may say that fits with a tool and a base of its own alone."""


@dataclass(frozen=True)
class Explanation:
    """A mistake in the set-up that explains a table, or two together.

    Attributes:
        mistakes: Each as the end of a sentence "residuals fall if ...".
        residuals: Once they are undone, by kind.
    """

    mistakes: tuple[str, ...]
    residuals: tuple[TypicalResidual, ...]

    @property
    def excess(self) -> float:
        """The largest excess of all kinds."""
        return _excess(self.residuals)

    def __str__(self) -> str:
        return " and ".join(self.mistakes)


@dataclass(frozen=True)
class SetupCheck:
    """What residuals before a calibration say of its set-up.

    Attributes:
        residuals: As the job says, by kind; empty where there are too few rows to tell.
        explanations: Mistakes that explain them where they are too large, the simplest first.
        table: Which of several tables they are of; empty of one alone.
    """

    residuals: tuple[TypicalResidual, ...] = ()
    explanations: tuple[Explanation, ...] = ()
    table: str = ""

    @property
    def excess(self) -> float:
        """The largest excess of all kinds."""
        return _excess(self.residuals)

    @property
    def worst(self) -> TypicalResidual:
        """The kind with the largest excess."""
        return max(self.residuals, key=lambda residual: residual.excess)

    @property
    def far(self) -> bool:
        """Whether noise and tolerances do not predict these residuals."""
        return self.excess > FAR

    def __str__(self) -> str:
        return f"{self.table}: {self._words()}" if self.table else self._words()

    def _words(self) -> str:
        if not self.explanations:
            times = f"{self.excess:.3g} times what noise and tolerances predict"
            found = f"{self.worst.kind} residuals before calibration are {shown(self.worst)}, {times}"
            return f"{found}: none of the usual mistakes in a set-up explains it"
        first, *others = self.explanations
        after = next(r for r in first.residuals if r.kind == self.worst.kind)
        also = "".join(f", or if {other}" for other in others[:2])
        also += f", or {len(others) - 2} more (--json has all)" if len(others) > 2 else ""
        return f"{self.worst.kind} residuals fall from {shown(self.worst)} to {shown(after)} if {first}{also}"


def shown(residual: TypicalResidual) -> str:
    """A typical size with its unit, in mm or degrees: `812 mm`."""
    factor, unit = (1e3, "mm") if residual.unit == "m" else (180.0 / np.pi, "deg")
    figure = f"{residual.size * factor:.3g}"
    return f"{float(figure):.0f} {unit}" if "e" in figure and residual.size * factor > 1.0 else f"{figure} {unit}"


def check_setup(
    robot: Robot,
    measurements: Measurements,
    model: Model,
    frame: FrameKnowledge = "known",
    *,
    doubtful: bool = False,
    fitted: tuple[Robot, Frame] | None = None,
    alone: bool = True,
) -> SetupCheck:
    """Compare residuals before a calibration with what noise and tolerances predict, and look for a mistake.

    Args:
        robot: The nominal robot; what it estimates of base and tool is fitted.
        measurements: What was measured; train rows are looked at.
        model: Which measurements take part.
        frame: Whether the measurement frame is known.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        fitted: The robot with base and tool fitted, and world_T_base, where they are known already.
        alone: Whether base and tool are for this table to say; where others say too, its own are none.

    Note:
        Pairs are formed anew from some of the rows, whatever the job's pairing.

    Raises:
        InputError: An option is not one of those possible.
    """
    check("model", model, Model)
    check("frame", frame, FrameKnowledge)
    check_flag("doubtful", doubtful)
    with one_blas_thread:
        setup = setup_of(robot, measurements, model, frame)
        if setup is None:
            return SetupCheck()
        found = SetupCheck(fitted_residuals(setup) if fitted is None else residuals_at(setup, *fitted))
        if not found.residuals or not (doubtful or found.far) or found.excess < NOTHING:
            return found
        if fitted is not None:
            closed_form = SetupCheck(fitted_residuals(setup))
            better = bool(closed_form.residuals) and closed_form.excess < found.excess
            if better and not alone and found.far and closed_form.excess <= min(EXPLAINED, found.excess / REDUCTION):
                return replace(found, explanations=(Explanation((OTHER_TOOL,), closed_form.residuals),))
            found = closed_form if better else found
        return replace(found, explanations=_explanations(setup, found))


def check_problem(problem: Problem, before: Floats, *, doubtful: bool = False) -> SetupCheck:
    """`check_setup` of a problem.

    Args:
        problem: The problem.
        before: The parameter vector with base, tool and measurement frame fitted, the arm at nominal.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
    """
    whole, variables = problem.whole or problem, problem.variables
    robot = whole.robot.with_values(before[variables.robot_span])
    found, names = SetupCheck(), problem.data.labels
    for number, table in enumerate(problem.data.tables):
        if table.model is None:
            continue
        frame = Frame(np.eye(3), np.zeros(3))
        for v in variables.frames:
            if v.symbol == f"X({number})":
                world_T_base = pose_of(before[list(v.parameters)])
                frame = Frame(world_T_base.rotation().matrix(), world_T_base.translation())
        given = (whole.robot, table.measurements, table.model, table.frame)
        of_table = check_setup(*given, doubtful=doubtful, fitted=(robot, frame), alone=len(names) == 1)
        of_table = replace(of_table, table=names[number] if len(names) > 1 else "")
        if number == 0 or of_table.explanations or of_table.excess > found.excess:
            found = of_table
        if of_table.explanations:
            return found
    return found


def _excess(residuals: Sequence[TypicalResidual]) -> float:
    return max((residual.excess for residual in residuals), default=0.0)


@dataclass(frozen=True)
class _Trial:
    """Mistakes that were undone, and what is left then."""

    mistakes: tuple[Mistake, ...]
    residuals: tuple[TypicalResidual, ...]

    @property
    def excess(self) -> float:
        return _excess(self.residuals) if self.residuals else np.inf

    @property
    def left(self) -> float:
        """Excess of all kinds together: undoing one of two mistakes may leave one kind as bad as before."""
        return float(np.sum(np.log([residual.excess for residual in self.residuals]))) if self.residuals else np.inf


def _explanations(setup: Setup, stated: SetupCheck) -> tuple[Explanation, ...]:
    """Mistakes that explain residuals, the simplest first; two together where no single one does."""
    # Where residuals are no larger than predicted only what has unknowns of its own can make them much smaller.
    least = About.FRAME if stated.excess < 1.0 else About.UNIT
    single = [_Trial((m,), fitted_residuals(m.without)) for m in usual_mistakes(setup) if m.about >= least]
    found = _accepted(single, stated.excess / REDUCTION)
    return found if found or not stated.far else _accepted(_doubles(single, stated.excess), np.inf)


def _doubles(single: Sequence[_Trial], stated: float) -> list[_Trial]:
    """Two mistakes undone together, where that reduces the excess far below `stated` and below either alone."""
    alone = {trial.mistakes[0].words: trial.excess for trial in single}
    tried: set[frozenset[str]] = set()
    good = []
    for i, first in enumerate(sorted(single, key=lambda trial: trial.left)):
        (one,) = first.mistakes
        if i >= _BEST and one.about == About.JOINT:
            continue
        for two in usual_mistakes(one.without):
            words = frozenset((one.words, two.words))
            if words in tried or len(words) < 2 or (i >= _BEST and two.about == About.JOINT):
                continue
            tried.add(words)
            trial = _Trial((one, two), fitted_residuals(two.without))
            if trial.excess <= min(stated, *(alone.get(w, np.inf) for w in words)) / REDUCTION:
                good.append(trial)
    return good


def _accepted(trials: Sequence[_Trial], most: float) -> tuple[Explanation, ...]:
    """Trials that leave a small enough excess, at most twice that of the best; the simplest first."""
    good = [
        trial
        for trial in trials
        if trial.excess <= min(most, EXPLAINED) and all(REDUCTION * r.size <= r.motion for r in trial.residuals)
    ]
    best = max(min((trial.excess for trial in good), default=0.0), 0.5)
    chosen = [trial for trial in good if trial.excess <= 2.0 * best]
    chosen.sort(key=lambda trial: sum(mistake.about for mistake in trial.mistakes))
    return tuple(
        Explanation(tuple(m.words for m in sorted(trial.mistakes, key=lambda m: m.about)), trial.residuals)
        for trial in chosen
    )
