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

from fg_calib.arguments import checked
from fg_calib.arrays import Brief
from fg_calib.diagnostics.nominal_residuals import residuals_of
from fg_calib.diagnostics.setup import Setup, has_places, setup_of, setup_of_table
from fg_calib.diagnostics.setup_hypotheses import About, Mistake, still_joints, usual_mistakes
from fg_calib.diagnostics.typical_residuals import TypicalResidual, fitted_residuals, residuals_at
from fg_calib.initialization.hand_eye import Frame
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.table import Table
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

REST = 1.5
"""Excess left by a joint that stands still, over that left by another unit of its readings, from which it is the unit.
"""

_BEST = 4
"""The best single mistakes are combined with any other; those after them not with mistakes about one joint."""


NOTHING = 1e-6
"""Residuals over what is predicted below which there is nothing to explain: each unknown takes its own row up."""


_OTHER_TOOL = "the tool is another one, farther off than its tolerance lets it be"
_OTHER_BASE = (
    "the measurement frame is not the base (frame: unknown), which is farther off than its tolerance lets it be"
)


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
class SetupCheck(Brief):
    """What residuals before a calibration say of its set-up.

    Attributes:
        residuals: As the job says, by kind; empty where there are too few rows to tell.
        explanations: Mistakes that explain them where they are too large, the simplest first.
        table: Which of several tables they are of; empty of one alone.
        others: The same of others of several tables that have something to say too.
        unchecked: Tables of which it could not be asked: too few rows, or kinds of somebody else.
    """

    residuals: tuple[TypicalResidual, ...] = ()
    explanations: tuple[Explanation, ...] = ()
    table: str = ""
    others: tuple[SetupCheck, ...] = ()
    unchecked: tuple[str, ...] = ()

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
            found = f"{self.worst.kind} residuals before calibration are {shown(self.worst)} in the median, {times}"
            return f"{found}: none of the usual mistakes in a set-up explains it"
        first, *others = self.explanations
        after = next(r for r in first.residuals if r.kind == self.worst.kind)
        also = "".join(f", or if {other}" for other in others[:2])
        also += f", or {len(others) - 2} more (--json has all)" if len(others) > 2 else ""
        fall = f"{self.worst.kind} residuals fall from {shown(self.worst)} to {shown(after)} in the median"
        return f"{fall} if {first}{also}"


def shown(residual: TypicalResidual) -> str:
    """A typical size with its unit, in mm, degrees or pixels: `812 mm`."""
    factor, unit = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "deg"), "px": (1.0, "px")}[residual.unit]
    figure = f"{residual.size * factor:.3g}"
    plain = "e" in figure and 1.0 < residual.size * factor < 1e9
    return f"{float(figure):.0f} {unit}" if plain else f"{figure} {unit}"


@checked
def check_setup(
    robot: Robot,
    measurements: Measurements,
    model: Model,
    frame: FrameKnowledge = "known",
    *,
    doubtful: bool = False,
    fitted: tuple[Robot, Frame] | None = None,
    table: Table | None = None,
) -> SetupCheck:
    """Compare residuals before a calibration with what noise and tolerances predict, and look for a mistake.

    Args:
        robot: The nominal robot; what it estimates of base and tool is fitted.
        measurements: What was measured; train rows are looked at.
        model: Which measurements take part.
        frame: Whether the measurement frame is known.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        fitted: The robot with base and tool fitted, and world_T_base, where they are known already; where the table
            alone says better ones, these are taken.
        table: What else is said of the table: known targets and anchors, an offset, a camera.

    Note:
        Pairs are formed anew from some of the rows, whatever the job's pairing. Models of places (anchors, planes,
        boards) and targets are looked at only where `doubtful`: these have to be placed first, a hundred times in all,
        and two mistakes at once are not looked for there.

    Raises:
        InputError: An option is not one of those possible.
    """
    check("model", model, Model)
    check("frame", frame, FrameKnowledge)
    check_flag("doubtful", doubtful)
    if has_places(measurements, model):
        given = Table(measurements, model, frame=frame) if table is None else table
        return _check_placed(robot, given) if doubtful else SetupCheck()
    with one_blas_thread:
        setup = setup_of(robot, measurements, model, frame)
        if setup is None:
            return SetupCheck()
        found = SetupCheck(fitted_residuals(setup) if fitted is None else residuals_at(setup, *fitted))
        if not found.residuals or not (doubtful or found.far) or found.excess < NOTHING:
            return found
        if fitted is not None:
            closed_form = SetupCheck(fitted_residuals(setup))
            found = min((found, closed_form), key=lambda check: check.excess) if closed_form.residuals else found
        explanations = _explanations(setup, found)
        return replace(found, explanations=explanations) if explanations else _held(setup, found) or found


def _held(setup: Setup, found: SetupCheck) -> SetupCheck | None:
    """The check with tool or base where the robot says, if one far beyond its tolerance is what explains the table."""
    if found.far:
        return None
    robot, still = setup.robot, np.zeros(3, dtype=np.bool_)
    checks = [
        _beyond(found, replace(setup, tool_rotation=False, tool_translation=still), robot.n_joints + 1, _OTHER_TOOL),
        _beyond(found, replace(setup, frame=False), 0, _OTHER_BASE) if setup.frame and setup.of_base else None,
    ]
    return max((check for check in checks if check is not None), key=lambda check: check.excess, default=None)


def _beyond(found: SetupCheck, held: Setup, owner: int, words: str) -> SetupCheck | None:
    """The check with a frame held within its tolerances, if residuals are far beyond what these let them be.

    Args:
        found: With the frame fitted freely.
        held: The set-up with the frame where the robot says.
        owner: Whose frame it is (see `Robot.owned_by`).
        words: The mistake that this is.
    """
    estimated = [p for p in map(held.robot.parameters.__getitem__, held.robot.owned_by(owner)) if p.estimated]
    tolerances = np.array([np.nan if p.tolerance is None else p.tolerance for p in estimated])
    if not tolerances.size or not np.isfinite(tolerances).all():
        return None
    lengths = np.array([p.unit == "m" for p in estimated])
    slack = {"m": float(np.linalg.norm(tolerances[lengths])), "rad": float(np.linalg.norm(tolerances[~lengths]))}
    if owner == 0:  # what turns the base moves the tool by that times the reach
        slack["m"] = float(np.hypot(slack["m"], held.robot.reach * slack["rad"]))
    residuals = fitted_residuals(held)
    stated = SetupCheck(tuple(replace(r, expected=float(np.hypot(r.expected, slack[r.unit]))) for r in residuals))
    if not stated.far or found.excess > min(EXPLAINED, stated.excess / REDUCTION):
        return None
    return replace(stated, explanations=(Explanation((words,), found.residuals),))


def _check_placed(robot: Robot, table: Table) -> SetupCheck:
    """The check of a table with targets, anchors, planes or boards."""
    with one_blas_thread:
        setup = setup_of_table(robot, table)
        found = SetupCheck() if setup is None else SetupCheck(residuals_of(setup))
        if setup is None or not found.far:
            return found
        return replace(found, explanations=_explanations(setup, found))


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
    single = [_Trial((m,), residuals_of(m.without)) for m in usual_mistakes(setup) if m.about >= least]
    most = stated.excess / REDUCTION
    found = _accepted(single, most)
    if stated.far and (not found or any(_is_of_readings_unit(e) for e in found)):
        still = _accepted([_Trial((m,), residuals_of(m.without)) for m in still_joints(setup)], most)
        found = _unless_still(found, still)
    return (
        found
        if found or not stated.far or setup.table is not None
        else _accepted(_doubles(single, stated.excess), np.inf)
    )


def _is_of_readings_unit(explanation: Explanation) -> bool:
    """Whether it is that joints' readings are in another unit."""
    return any("readings" in words and " are in " in words for words in explanation.mistakes)


def _unless_still(found: tuple[Explanation, ...], still: tuple[Explanation, ...]) -> tuple[Explanation, ...]:
    """Explanations beside those of a joint that does not move: another unit may but null its readings."""
    least = min((e.excess for e in still), default=np.inf)
    others = tuple(e for e in found if not _is_of_readings_unit(e) or REST * e.excess < least)
    return (*others, *still) if still and least <= 2.0 * min((e.excess for e in others), default=np.inf) else others


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
            twice = one.figures == two.figures != ""
            if words in tried or len(words) < 2 or twice or (i >= _BEST and two.about == About.JOINT):
                continue
            tried.add(words)
            trial = _Trial((one, two), residuals_of(two.without))
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
