"""Mistakes in the set-up of a job that explain why residuals before calibration are far too large.

Each usual mistake is undone on some rows of the table: units, signs, orders of columns, inverted poses, a frame or a
tool that is not what the job says; then two of them together. One explains the table if without it the excess (see
`setup`) is a `REDUCTION`th, and no more than `EXPLAINED`. Where several do, the simplest comes first: a unit before the
meaning of columns, that before a single joint, and what has unknowns of its own, a frame or a tool, last.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.analysis.setup import Setup, TypicalResidual, setup_of
from fg_calib.graph.factors import pose_of
from fg_calib.graph.frames import Frame
from fg_calib.graph.problem import Problem
from fg_calib.measurements.dataset import Measurements
from fg_calib.options import PAIR_MODELS, POSE_MODELS, FrameKnowledge, Model, check, check_flag
from fg_calib.robot.model import CONVENTIONS, Robot
from fg_calib.threads import one_blas_thread

Floats = NDArray[np.float64]

FAR = 5.0
"""Excess above which residuals before a calibration are not what noise and tolerances predict."""

EXPLAINED = 4.0
"""Excess that may be left without a mistake."""

REDUCTION = 5.0
"""Factor by which the excess falls at least without a mistake; without two, below that of either alone."""

_BEST = 4
"""Single mistakes that are combined with any other, beside those about the whole table with each other."""

_LARGEST, _SMALLEST = 50.0, 0.02
"""Reach of an arm beyond which its own lengths are taken for the mistake, [m]."""

_LENGTHS = {1e-3: "mm, not m", 1e3: "m, not mm", 1e-2: "cm, not m", 1e2: "m, not cm"}
_ANGLES = {np.pi / 180.0: "deg, not rad", 180.0 / np.pi: "rad, not deg"}


@dataclass(frozen=True)
class Explanation:
    """A mistake in the set-up that explains a table, or two together.

    Attributes:
        mistakes: Each as the end of a sentence "residuals fall if ...".
        residuals: Without it, by kind.
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
    """

    residuals: tuple[TypicalResidual, ...] = ()
    explanations: tuple[Explanation, ...] = ()

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
) -> SetupCheck:
    """Compare residuals before a calibration with what noise and tolerances predict, and look for a mistake.

    Args:
        robot: The nominal robot; what it estimates of base and tool is fitted.
        measurements: What was measured; train rows are looked at.
        model: Which measurements take part.
        frame: Whether the measurement frame is known.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        fitted: The robot with base and tool fitted, and world_T_base, where they are known already.

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
        found = SetupCheck(setup.fit() if fitted is None else setup.at(*fitted))
        if not found.residuals or not (doubtful or found.far):
            return found
        if fitted is not None:
            closed_form = SetupCheck(setup.fit())
            found = closed_form if closed_form.excess < found.excess and closed_form.residuals else found
        return replace(found, explanations=_explanations(setup, found))


def check_problem(problem: Problem, before: Floats, *, doubtful: bool = False) -> SetupCheck:
    """`check_setup` of a problem.

    Args:
        problem: The problem.
        before: The parameter vector with base, tool and measurement frame fitted, the arm at nominal.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
    """
    whole, s = problem.whole or problem, problem.options
    world_T_base = pose_of(before[problem.variables.frame_span])
    frame = Frame(world_T_base.rotation().matrix(), world_T_base.translation())
    robot = whole.robot.with_values(before[problem.variables.robot_span])
    given = (whole.robot, problem.measurements, s.model, s.frame)
    return check_setup(*given, doubtful=doubtful, fitted=(robot, frame))


def _excess(residuals: Sequence[TypicalResidual]) -> float:
    return max((residual.excess for residual in residuals), default=0.0)


class _About(IntEnum):
    """What a mistake is about, the simplest first."""

    UNIT = 0
    COLUMNS = 1
    JOINT = 2
    FRAME = 3
    TOOL = 4


@dataclass(frozen=True)
class _Mistake:
    """A usual mistake, and the set-up without it."""

    about: _About
    words: str
    without: Setup


@dataclass(frozen=True)
class _Trial:
    """Mistakes that were undone, and what is left then."""

    mistakes: tuple[_Mistake, ...]
    residuals: tuple[TypicalResidual, ...]

    @property
    def excess(self) -> float:
        return _excess(self.residuals) if self.residuals else np.inf

    @property
    def left(self) -> float:
        """All kinds together: a mistake may be half of the truth although one kind is as bad as before."""
        return float(np.sum(np.log([residual.excess for residual in self.residuals]))) if self.residuals else np.inf


def _explanations(setup: Setup, stated: SetupCheck) -> tuple[Explanation, ...]:
    """Mistakes that explain residuals, the simplest first; two together where no single one does."""
    # Where residuals are no larger than predicted only what has unknowns of its own can make them much smaller.
    least = _About.FRAME if stated.excess < 1.0 else _About.UNIT
    single = [_Trial((mistake,), mistake.without.fit()) for mistake in _mistakes(setup) if mistake.about >= least]
    found = _accepted(single, stated.excess / REDUCTION)
    if found or not stated.far:
        return found
    single.sort(key=lambda trial: trial.left)
    double: dict[frozenset[str], _Trial] = {}
    limit: dict[frozenset[str], float] = {}
    for i, first in enumerate(single):
        (one,) = first.mistakes
        if i >= _BEST and one.about == _About.JOINT:
            continue
        alone = {trial.mistakes[0].words: trial.excess for trial in single}
        for two in _mistakes(one.without):
            words = frozenset((one.words, two.words))
            if words in double or len(words) < 2 or (i >= _BEST and two.about == _About.JOINT):
                continue
            double[words] = _Trial((one, two), two.without.fit())
            limit[words] = min(stated.excess, *(alone.get(w, np.inf) for w in words)) / REDUCTION
    return _accepted([trial for words, trial in double.items() if trial.excess <= limit[words]], np.inf)


def _accepted(trials: Sequence[_Trial], most: float) -> tuple[Explanation, ...]:
    """Those that leave no more than they may and are about as good as the best, the simplest first."""
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


def _mistakes(setup: Setup) -> Iterator[_Mistake]:
    """The usual mistakes that a set-up may hold."""
    for about, mistakes in (
        (_About.UNIT, (_robot_units, _lengths, _angles)),
        (_About.COLUMNS, (_inverted, _axis_orders, _orientation_columns, _conventions)),
        (_About.JOINT, (_signs, _offsets, _swaps)),
        (_About.FRAME, (_frame,)),
        (_About.TOOL, (_tool,)),
    ):
        for mistake in mistakes:
            yield from (_Mistake(about, words, without) for words, without in mistake(setup))


_Found = Iterator[tuple[str, Setup]]
"""A mistake as the end of a sentence "residuals fall if ...", and the set-up without it."""


def _measured(setup: Setup, **changes: object) -> Setup:
    """The set-up with other measurements."""
    return replace(setup, measurements=replace(setup.measurements, **changes))  # type: ignore[arg-type]


def _sees(setup: Setup) -> tuple[bool, bool]:
    """Whether the model uses turns and lengths."""
    if setup.model in POSE_MODELS:
        return POSE_MODELS[setup.model]
    with_distance, with_angle = PAIR_MODELS[setup.model]
    return with_angle, with_distance


def _lengths(setup: Setup) -> _Found:
    """Lengths measured, and readings of slides, in another unit."""
    m = setup.measurements
    slides = np.array([joint.prismatic for joint in setup.robot.joints])
    for factor, unit in _LENGTHS.items():
        if _sees(setup)[1]:
            pairs = None if m.pairs is None else replace(m.pairs, distance=m.pairs.distance * factor)
            groups = m.groups
            if groups is not None:
                groups = replace(groups, pairs=replace(groups.pairs, distance=groups.pairs.distance * factor))
            what = "distances" if pairs is not None or m.position is None else "x, y, z"
            position = None if m.position is None else m.position * factor
            yield f"{what} are in {unit}", _measured(setup, position=position, pairs=pairs, groups=groups)
        if slides.any():
            readings = np.where(slides, m.readings * factor, m.readings)
            yield f"readings of slides are in {unit}", _measured(setup, readings=readings)


def _angles(setup: Setup) -> _Found:
    """Joint readings, measured angles and orientations in another unit."""
    m = setup.measurements
    slides = np.array([joint.prismatic for joint in setup.robot.joints])
    for factor, unit in _ANGLES.items():
        if not slides.all():
            readings = np.where(slides, m.readings, m.readings * factor)
            yield f"joint readings are in {unit}", _measured(setup, readings=readings)
        if m.pairs is not None and np.isfinite(m.pairs.angle).any():
            pairs = replace(m.pairs, angle=m.pairs.angle * factor)
            yield f"angles of pairs are in {unit}", _measured(setup, pairs=pairs)
        if m.roll_pitch_yaw is not None:
            yield f"roll, pitch, yaw are in {unit}", _turned(setup, m.roll_pitch_yaw * factor)


def _turned(setup: Setup, roll_pitch_yaw: Floats) -> Setup:
    rotation = Rotation.from_euler("xyz", roll_pitch_yaw).as_matrix()
    return _measured(setup, rotation=rotation, roll_pitch_yaw=roll_pitch_yaw)


def _robot_units(setup: Setup) -> _Found:
    """The robot's own lengths, where no arm has such a size, and angles."""
    robot = setup.robot
    lengths = np.array([parameter.unit == "m" for parameter in robot.parameters])
    reach = float(np.sum(np.abs(robot.nominal[lengths])))
    for factor, unit in _LENGTHS.items():
        if (reach > _LARGEST and factor < 1.0) or (0.0 < reach < _SMALLEST and factor > 1.0):
            values = np.where(lengths, robot.nominal * factor, robot.nominal)
            yield f"the robot's lengths are in {unit}", replace(setup, robot=robot.with_values(values))
    for factor, unit in _ANGLES.items():
        values = np.where(lengths, robot.nominal, robot.nominal * factor)
        if robot.convention in CONVENTIONS and np.any(values != robot.nominal):
            yield f"the robot's angles are in {unit}", replace(setup, robot=robot.with_values(values))


def _inverted(setup: Setup) -> _Found:
    """Poses of the world in the tool frame instead of the tool in the world; orientations alone."""
    m = setup.measurements
    if m.rotation is None or m.pairs is not None:
        return
    inverse = np.swapaxes(m.rotation, 1, 2)
    sees_turns, sees_lengths = _sees(setup)
    if m.position is not None and sees_lengths:
        position = -np.einsum("nij,nj->ni", inverse, m.position)
        words = "the poses are inverted (tool_T_world instead of world_T_tool)"
        yield words, _measured(setup, rotation=inverse, position=position)
    if sees_turns:
        yield "the orientations are inverted", _measured(setup, rotation=inverse)


def _axis_orders(setup: Setup) -> _Found:
    """Columns x, y, z in another order, or one of them with the other sign."""
    m = setup.measurements
    if m.position is None or m.pairs is not None or not _sees(setup)[1]:
        return
    for order in list(permutations(range(3)))[1:]:
        # Column k holds coordinate order[k].
        words = f"columns x, y, z hold {', '.join('xyz'[i] for i in order)}"
        yield words, _measured(setup, position=m.position[:, np.argsort(order)])
    for k in range(3):
        position = m.position * np.where(np.arange(3) == k, -1.0, 1.0)
        yield f"{'xyz'[k]} has the wrong sign", _measured(setup, position=position)


def _orientation_columns(setup: Setup) -> _Found:
    """A quaternion with its scalar first; three angles that are not roll, pitch, yaw about fixed axes."""
    m = setup.measurements
    if m.rotation is None or m.pairs is not None:
        return
    if m.roll_pitch_yaw is None:
        wxyz = Rotation.from_matrix(m.rotation).as_quat()
        rotation = Rotation.from_quat(np.roll(wxyz, -1, axis=1)).as_matrix()
        yield "columns qx, qy, qz, qw hold w, x, y, z", _measured(setup, rotation=rotation)
        return
    angles = m.roll_pitch_yaw
    for words, turned in (
        ("roll, pitch, yaw turn about the moving axes x, y, z", Rotation.from_euler("XYZ", angles)),
        ("columns roll, pitch, yaw hold yaw, pitch, roll", Rotation.from_euler("ZYX", angles)),
        ("roll, pitch, yaw are angles about the moving axes z, y, z", Rotation.from_euler("ZYZ", angles)),
        ("roll, pitch, yaw are a rotation vector", Rotation.from_rotvec(angles)),
    ):
        yield words, _measured(setup, rotation=turned.as_matrix())


def _conventions(setup: Setup) -> _Found:
    """Parameters of the other Denavit-Hartenberg convention."""
    robot = setup.robot
    if robot.convention not in CONVENTIONS:
        return
    other = robot.convention[1:] if robot.convention.startswith("m") else f"m{robot.convention}"
    order = {kind: place for place, kind in enumerate(CONVENTIONS[other])}
    owned = [robot.parameters[e.parameter] for e in robot.elements if e.parameter is not None]
    places = [(p.owner, order.get(p.kind, i)) for i, p in enumerate(owned)]  # frames stay as they are
    elements = tuple(robot.elements[i] for i in sorted(range(len(places)), key=lambda i: places[i]))
    words = f"the robot's convention is {other}, not {robot.convention}"
    yield words, replace(setup, robot=replace(robot, convention=other, elements=elements))


def _signs(setup: Setup) -> _Found:
    """A joint that turns or slides the other way."""
    m = setup.measurements
    for i, joint in enumerate(setup.robot.joints):
        readings = m.readings * np.where(np.arange(m.readings.shape[1]) == i, -1.0, 1.0)
        moves = "slides" if joint.prismatic else "turns"
        yield f"joint {i + 1} {moves} the other way (the sign of its readings)", _measured(setup, readings=readings)


def _offsets(setup: Setup) -> _Found:
    """A joint whose zero is a quarter or half a turn away."""
    m = setup.measurements
    for i, joint in enumerate(setup.robot.joints):
        for degrees in (90, -90, 180):
            if not joint.prismatic:
                readings = m.readings + np.where(np.arange(m.readings.shape[1]) == i, np.deg2rad(degrees), 0.0)
                yield f"the zero of joint {i + 1} is off by {degrees} deg", _measured(setup, readings=readings)


def _swaps(setup: Setup) -> _Found:
    """The readings of two joints exchanged, or of all in the opposite order."""
    m, joints = setup.measurements, setup.robot.joints
    for i, j in combinations(range(len(joints)), 2):
        order = np.arange(len(joints))
        order[[i, j]] = j, i
        words = f"the readings of joints {i + 1} and {j + 1} are exchanged"
        yield words, _measured(setup, readings=m.readings[:, order])
    if len(joints) > 3:
        yield "the joints are in the opposite order", _measured(setup, readings=m.readings[:, ::-1])


def _frame(setup: Setup) -> _Found:
    """A measurement frame that is not the base."""
    if setup.model in POSE_MODELS and not setup.frame:
        yield "the measurement frame is not the base (frame: unknown)", replace(setup, frame=True)


def _tool(setup: Setup) -> _Found:
    """A tool that is not where the robot's file says."""
    sees_turns, sees_lengths = _sees(setup)
    point = np.ones(3, dtype=np.bool_)
    if sees_lengths and not setup.tool_translation.all():
        words = "the tool point is another one (estimate: [tool.x, tool.y, tool.z])"
        yield words, replace(setup, tool_translation=point)
    if sees_turns and setup.model in POSE_MODELS and not setup.tool_rotation:
        words = "the tool frame is another one (estimate: all of tool.x ... tool.yaw)"
        free = point if sees_lengths else setup.tool_translation
        yield words, replace(setup, tool_rotation=True, tool_translation=free)
