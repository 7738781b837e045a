"""Check of a job's set-up: mistakes that explain why residuals before calibration are far too large.

Each mistake is undone on some rows of a table: units, signs, orders of columns, inverted poses, a frame or a tool that
is not what the job says. A mistake explains the table if undoing it divides the excess (see `nominal_residuals`) by
`REDUCTION` at least and leaves no more than `EXPLAINED`. Where several do, the simplest comes first: a unit before the
meaning of columns, that before a single joint, and a frame or a tool, which bring unknowns of their own, last. Two
mistakes at once are not looked for.

Base and tool are one for all tables, so a mistake in one table shows in the residuals of all others. Each is therefore
judged by the base and tool that it determines alone. Only where all tables are right alone can they disagree on base
and tool, which is reported of all that are far off together.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.diagnostics.nominal_residuals import Setup, TypicalResidual, nominal_residuals, residuals_at, setup_of
from fg_calib.graph import Problem
from fg_calib.inputs import Booleans, Brief, Floats, FrameKnowledge, Model, Record, checked
from fg_calib.measurements import Measurements, Table
from fg_calib.parallel import one_blas_thread
from fg_calib.robot import CONVENTIONS, SCALES, Robot

FAR = 5.0
"""Excess above which residuals before a calibration are not what noise and prior sigmas predict."""

EXPLAINED = 4.0
"""Largest excess that may be left once a mistake is undone."""

REDUCTION = 5.0
"""Undoing a mistake divides the excess by this at least."""

NEGLIGIBLE_EXCESS = 1e-6
"""Excess below which there is nothing to explain: each unknown takes its own row up."""

OTHER_TOOL = "tool or base differ from those of the other tables (another target on the tool, another frame)"


class Explanation(Record):
    """A mistake in the set-up that explains a table.

    Attributes:
        mistake: The end of a sentence "residuals fall if ...".
        residuals: Residuals once it is undone, by kind.
    """

    mistake: str
    residuals: tuple[TypicalResidual, ...]

    @property
    def excess(self) -> float:
        """The largest excess of all kinds; infinite without residuals."""
        return max((residual.excess for residual in self.residuals), default=np.inf)


class SetupCheck(Brief):
    """Residuals before a calibration, and what they say of its set-up.

    Attributes:
        residuals: As the job says, by kind; empty where there are too few rows to tell.
        explanations: Mistakes that explain them where they are too large, the simplest first.
        table: Which of several tables they are of; empty of one alone.
        others: Checks of others of several tables that report something too.
    """

    residuals: tuple[TypicalResidual, ...] = ()
    explanations: tuple[Explanation, ...] = ()
    table: str = ""
    others: "tuple[SetupCheck, ...]" = ()

    @property
    def excess(self) -> float:
        """The largest excess of all kinds; 0 without residuals."""
        return max((residual.excess for residual in self.residuals), default=0.0)

    @property
    def far(self) -> bool:
        """Whether noise and prior sigmas do not predict these residuals."""
        return self.excess > FAR

    def __str__(self) -> str:
        worst = max(self.residuals, key=lambda residual: residual.excess)
        words = f"{self.table}: {worst.kind} residuals" if self.table else f"{worst.kind} residuals"
        if not self.explanations:
            times = f"{self.excess:.3g} times what noise and prior sigmas predict"
            words += f" before calibration are {shown(worst)} in the median, {times}"
            return f"{words}: no common mistake in a set-up explains it"
        first, *others = self.explanations
        after = next(r for r in first.residuals if r.kind == worst.kind)
        also = "".join(f", or if {other.mistake}" for other in others[:2])
        return f"{words} fall from {shown(worst)} to {shown(after)} in the median if {first.mistake}{also}"


def shown(residual: TypicalResidual) -> str:
    """A typical size with its unit, in mm, degrees or pixels: `812 mm`."""
    unit, factor, *_ = SCALES[residual.unit]
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
        measurements: The measured values; train rows are looked at.
        model: Which measurements take part.
        frame: Whether the measurement frame is known.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        table: Other knowledge of the table: targets and anchors, an offset, a camera.

    Note:
        Models with landmarks (anchors, planes, boards) and targets are looked at only where `doubtful`: these have to
        be located first, a hundred times in all.

    Raises:
        InputError: An option is not one of those possible.
    """
    given = Table(measurements, model, frame=frame) if table is None else table
    with one_blas_thread:
        setup = setup_of(robot, given)
        if setup is None or (setup.has_landmarks and not doubtful):
            return SetupCheck()
        return _check_alone(setup, doubtful, SetupCheck())


def check_problem(problem: Problem, before: Floats, *, doubtful: bool = False) -> SetupCheck:
    """The check of the table of a problem with the most to report; of others in its `others`.

    Args:
        problem: The problem.
        before: The parameter vector with base, tool and measurement frame fitted, the arm at nominal.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
    """
    checks = check_tables(problem, before, doubtful=doubtful, with_landmarks=doubtful)
    found = reporting(checks) or sorted(checks, key=lambda one: -one.excess)[:1]
    return replace(found[0], others=tuple(found[1:]))


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
    checks, together = list[SetupCheck](), [SetupCheck()] * len(labels)
    with one_blas_thread:
        for number, (label, table) in enumerate(zip(labels, problem.data.tables, strict=True)):
            setup, one = setup_of(whole.robot, table), SetupCheck()
            if setup is not None and not setup.has_landmarks:
                together[number] = SetupCheck(residuals_at(whole, before, whole.robot, number))
            if setup is not None and (with_landmarks or not setup.has_landmarks):
                one = _check_alone(setup, doubtful, together[number])
            checks.append(replace(one, table=label if len(labels) > 1 else ""))
    if not reporting(checks):
        for number, one in enumerate(together if len(labels) > 1 else ()):
            if one.far:  # and the table alone is not
                other = Explanation(OTHER_TOOL, checks[number].residuals)
                checks[number] = replace(one, table=labels[number], explanations=(other,))
    return checks


def _check_alone(setup: Setup, doubtful: bool, found: SetupCheck) -> SetupCheck:
    """The check of a table, and the mistakes that explain its residuals.

    Args:
        setup: The table.
        doubtful: Look for a mistake even where the residuals are not far from what is predicted.
        found: Its residuals with the base and the tool that all tables determine together; empty if not known.
    """
    far = found.far
    if not found.residuals or far or doubtful:
        alone = SetupCheck(nominal_residuals(setup))
        found = alone if not found.residuals or 0.0 < alone.excess < found.excess else found
    look = far or found.far or (doubtful and not setup.has_landmarks and found.excess >= NEGLIGIBLE_EXCESS)
    return replace(found, explanations=_explanations(setup, found)) if look else found


def _explanations(setup: Setup, given: SetupCheck) -> tuple[Explanation, ...]:
    """Mistakes that explain residuals, the simplest first: they leave little, and at most twice what the best does."""
    undone = (one for hypothesis in HYPOTHESES for one in hypothesis(setup))
    trials = [Explanation(mistake, nominal_residuals(without)) for mistake, without in undone]
    found = [trial for trial in trials if trial.excess <= min(given.excess / REDUCTION, EXPLAINED)]
    best = max(min((trial.excess for trial in found), default=0.0), 0.5)
    return tuple(trial for trial in found if trial.excess <= 2.0 * best)


# --- hypotheses, each undone ------------------------------------------------------------------------------------------

MAX_REACH, MIN_REACH = 50.0, 0.02
"""Reach of an arm beyond which its own lengths are taken for the mistake, [m]."""

MOTION_RAD, MOTION_M = 0.2, 0.01
"""Range of a joint's readings, below which another unit is no explanation but a joint that does not move."""

_UNITS = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "inches": 0.0254}
LENGTHS = {_UNITS[one] / _UNITS[other]: f"{one}, not {other}" for one, other in permutations(_UNITS, 2)}
ANGLES = {np.pi / 180.0: "deg, not rad", 180.0 / np.pi: "rad, not deg"}
"""Units that are meant by values in another, by the factor that converts them."""


_Found = Iterator[tuple[str, Setup]]
"""Mistakes, each as the end of a sentence "residuals fall if ...", and the set-up with it undone."""


def _robot_in_units(setup: Setup) -> _Found:
    """Lengths of the robot, where no arm has such a size, and angles."""
    robot = setup.robot
    in_m, in_rad = (np.array([p.unit == unit for p in robot.parameters]) for unit in ("m", "rad"))
    reach = float(np.sum(np.abs(robot.nominal[in_m])))
    for factor, unit in LENGTHS.items():
        if not MIN_REACH <= reach <= MAX_REACH and MIN_REACH <= factor * reach <= MAX_REACH:
            values = robot.nominal * np.where(in_m, factor, 1.0)
            yield f"the robot's lengths are in {unit}", replace(setup, robot=robot.with_values(values))
    for factor, unit in ANGLES.items() if robot.convention in CONVENTIONS and robot.nominal[in_rad].any() else ():
        values = robot.nominal * np.where(in_rad, factor, 1.0)
        yield f"the robot's angles are in {unit}", replace(setup, robot=robot.with_values(values))


def _measured_in_units(setup: Setup) -> _Found:
    """Lengths and angles of the measurements."""
    m = setup.table.measurements
    pairs, groups, image, angles = m.pairs, m.groups, m.image, m.roll_pitch_yaw
    for f, unit in LENGTHS.items():
        if setup.sees_lengths:
            of_groups = groups and replace(groups, pairs=replace(groups.pairs, distance=groups.pairs.distance * f))
            of_pairs = pairs and replace(pairs, distance=pairs.distance * f)
            position, columns = None if m.position is None else m.position * f, dict(m.columns)
            columns |= {name: v * f for name, v in columns.items() if name == "distance"}
            what = "distances" if pairs is not None or m.position is None else "x, y, z"
            without = setup.measuring(position=position, columns=columns, pairs=of_pairs, groups=of_groups)
            yield f"{what} are in {unit}", without
        if image is not None:
            yield f"corner_x, corner_y are in {unit}", setup.measuring(image=image * [1.0, 1.0, f, f])
    for f, unit in ANGLES.items():
        if pairs is not None and np.isfinite(pairs.angle).any():
            yield f"angles of pairs are in {unit}", setup.measuring(pairs=replace(pairs, angle=pairs.angle * f))
        if angles is not None:
            yield f"roll, pitch, yaw are in {unit}", _rotated(setup, Rotation.from_euler("xyz", angles * f), angles * f)
        elif m.rotation is not None and setup.instrument.sees_orientation and f > 1.0:
            vector = Rotation.from_matrix(m.rotation.copy()).as_rotvec()
            yield f"rx, ry, rz are in {unit}", _rotated(setup, Rotation.from_rotvec(vector * f))


def _readings_in_units(setup: Setup) -> _Found:
    """Readings of all joints of a kind."""
    prismatic = np.array([joint.prismatic for joint in setup.robot.joints])
    yield from _in_units(setup, "readings of prismatic joints", prismatic)
    yield from _in_units(setup, "joint readings", ~prismatic)


def _in_units(setup: Setup, what: str, joints: Booleans) -> _Found:
    """Readings of some joints, which would not hardly move then."""
    q, prismatic = setup.table.measurements.readings, [joint.prismatic for joint in setup.robot.joints]
    least = np.where(prismatic, MOTION_M, MOTION_RAD)
    for factor, unit in (LENGTHS if np.any(joints & prismatic) else ANGLES).items() if joints.any() else ():
        if factor >= 1.0 or np.any((np.ptp(q, axis=0) * factor > least)[joints]):
            yield f"{what} are in {unit}", setup.measuring(readings=np.where(joints, q * factor, q))


def _inverted(setup: Setup) -> _Found:
    """Poses of the world in the tool frame instead of the tool in the world; orientations alone."""
    m = setup.table.measurements
    if m.rotation is None or m.pairs is not None:
        return
    inverse = Rotation.from_matrix(m.rotation.copy()).inv()
    if m.position is not None and setup.sees_lengths:
        a, b, c = ("camera", "board", "") if setup.instrument.sees_landmarks else ("world", "tool", "; or model board")
        words = f"the poses are inverted ({b}_T_{a} instead of {a}_T_{b}{c})"
        yield words, _rotated(setup, inverse).measuring(position=-inverse.apply(m.position.copy()))
    if setup.instrument.sees_orientation:
        yield "the orientations are inverted", _rotated(setup, inverse)


def _columns(setup: Setup) -> _Found:
    """Columns in another order, or with the other sign."""
    m, image = setup.table.measurements, setup.table.measurements.image
    if m.position is not None and m.pairs is None and setup.sees_lengths:
        for order in list(permutations(range(3)))[1:]:  # column k holds coordinate order[k]
            words = f"columns x, y, z hold {', '.join('xyz'[i] for i in order)}"
            yield words, setup.measuring(position=m.position[:, np.argsort(order)])
        for k in range(3):
            yield f"{'xyz'[k]} has the wrong sign", setup.measuring(position=m.position * (1.0 - 2.0 * np.eye(3)[k]))
    if image is not None:
        yield "columns u, v hold v, u", setup.measuring(image=image[:, [1, 0, 2, 3]])


ORIENTATIONS: dict[str, Callable[[Floats], Rotation]] = {
    "roll, pitch, yaw are rotations about the moving axes x, y, z": lambda a: Rotation.from_euler("XYZ", a),
    "columns roll, pitch, yaw hold yaw, pitch, roll": lambda a: Rotation.from_euler("ZYX", a),
    "roll, pitch, yaw are angles about the moving axes z, y, z": lambda a: Rotation.from_euler("ZYZ", a),
    "roll, pitch, yaw are a rotation vector": Rotation.from_rotvec,
}
"""Meanings of three columns that are not roll, pitch, yaw about fixed axes."""


def _orientations(setup: Setup) -> _Found:
    """A quaternion with its scalar first; three angles of another meaning."""
    m = setup.table.measurements
    if m.rotation is None or m.pairs is not None:
        return
    if m.roll_pitch_yaw is None:
        wxyz = Rotation.from_matrix(m.rotation.copy()).as_quat()
        yield "columns qx, qy, qz, qw hold w, x, y, z", _rotated(setup, Rotation.from_quat(np.roll(wxyz, -1, axis=1)))
        return
    for words, rotation_of in ORIENTATIONS.items():
        yield words, _rotated(setup, rotation_of(m.roll_pitch_yaw.copy()), m.roll_pitch_yaw)


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


def _joint_columns(setup: Setup) -> _Found:
    """A joint that moves the other way, or is a quarter or half a turn away; columns of joints exchanged."""
    q, joints = setup.table.measurements.readings, setup.robot.joints
    n, others = len(joints), dict[str, Floats]()
    for i, only in enumerate(np.eye(n)):
        others[f"joint {i + 1} moves the other way (the sign of its readings)"] = q * (1.0 - 2.0 * only)
        for degrees in () if joints[i].prismatic else (90, -90, 180):
            others[f"the zero of joint {i + 1} is off by {degrees} deg"] = q + np.deg2rad(degrees) * only
    for i, j in combinations(range(n), 2):
        order = [j if k == i else i if k == j else k for k in range(n)]
        others[f"the readings of joints {i + 1} and {j + 1} are exchanged"] = q[:, order]
    for words, readings in others.items():
        yield words, setup.measuring(readings=readings)


def _frame(setup: Setup) -> _Found:
    """A measurement frame that is not the base."""
    if setup.instrument.is_pose and setup.table.frame == "known":
        words = "the measurement frame is not the base (frame: unknown)"
        yield words, replace(setup, table=replace(setup.table, frame="unknown"))


def _tool(setup: Setup) -> _Found:
    """A tool that is not where the robot's file says."""
    rotations, lengths = setup.instrument.sees_orientation, setup.sees_lengths
    estimated = frozenset(p.name for p in setup.robot.parameters if p.estimated)
    point, fitted = frozenset(setup.tool[:3]), estimated.intersection(setup.tool)
    if setup.tool and lengths and not point <= fitted:
        yield "the tool point is another one (estimate: [tool.x, tool.y, tool.z])", setup.with_tool(fitted | point)
    if setup.tool and rotations and setup.instrument.is_pose and not fitted & frozenset(setup.tool[3:]):
        words = "the tool frame is another one (estimate: all of tool.x ... tool.yaw)"
        yield words, setup.with_tool(frozenset(setup.tool if lengths else (*setup.tool[3:], *fitted)))


HYPOTHESES: tuple[Callable[[Setup], _Found], ...] = (
    *(_robot_in_units, _measured_in_units, _readings_in_units),
    *(_inverted, _columns, _orientations, _conventions, _joint_columns, _frame, _tool),
)
"""Hypotheses on units, on the meaning of columns, on joints, on the frame and on the tool: the simplest first."""


def _rotated(setup: Setup, rotation: Rotation, roll_pitch_yaw: Floats | None = None) -> Setup:
    """The set-up with other orientations."""
    return setup.measuring(rotation=rotation.as_matrix(), roll_pitch_yaw=roll_pitch_yaw)
