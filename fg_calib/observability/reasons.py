"""Why directions are lost: each is moved at random configurations, and what it does to the tool tells the cause.

A cause is given only if it is checked: that the tool does not move, that everything moves as one body, that the tool
only turns about its own point, that landmarks take the direction up (`find_confounding`), and so on. Where no check
succeeds the reason is `NO_CAUSE`, never a guess.

A landmark is confounded with a direction where the direction is lost with the columns of its kind projected out, and
seen with the landmarks held where they are: both are computed from the whitened rows, leaving one kind out after the
other. Random configurations may show what the user's do not: the arm goes there, and each model measures what it
predicts.
"""

from collections.abc import Collection, Mapping, Sequence
from functools import cache

import numpy as np

from fg_calib.graph import SUPPORT_TOLERANCE, Problem, eliminate, named_triangle, square_root
from fg_calib.inputs import Booleans, Floats, FrameKnowledge, Integers, Model, Record
from fg_calib.measurements import INSTRUMENTS, LANDMARKS, Instrument
from fg_calib.observability.indices import Observability
from fg_calib.observability.predicted import random_problem
from fg_calib.parallel import single_threaded
from fg_calib.robot import EFFECT_KINDS, Axis, Compliance, build_chain, forward, random_readings
from fg_calib.robot.effects import GRAVITY


class ObservedQuantities(Record):
    """Quantities of the tool's motion that tables see; custom kinds may see anything, in any frame.

    Attributes:
        views: Models with the knowledge of their frames, each once.
        custom: Whether there are measurements of custom kinds.
    """

    views: tuple[tuple[Model, FrameKnowledge], ...]
    custom: bool

    @classmethod
    def of(cls, problem: Problem) -> "ObservedQuantities":
        """Quantities that a problem's tables see, and those of its prior information."""
        views: list[tuple[Model, FrameKnowledge]] = []
        for t in problem.data.tables:
            if t.model is not None:
                relative = t.unknown_frame or (INSTRUMENTS[t.model].sees_landmarks and not t.known)
                views.append((t.model, "unknown" if relative else "known"))
        views += () if problem.knowledge is None else problem.knowledge.views
        return cls(tuple(dict.fromkeys(views)), any(t.own for t in problem.data.tables))

    @property
    def position(self) -> bool:
        """Whether something depends on where the tool point is, or may."""
        return self.custom or any(one.sees_position for one in self.instruments)

    @property
    def orientation(self) -> bool:
        """Whether something depends on the tool's orientation, or may."""
        return self.custom or any(one.sees_orientation for one in self.instruments)

    @property
    def instruments(self) -> list[Instrument]:
        """The instrument of each view."""
        return [INSTRUMENTS[model] for model, _ in self.views]

    def is_relative(self, *, position: bool, orientation: bool) -> bool:
        """Whether what depends on position, or on orientation, says nothing of where the base is."""
        return all(
            one.uses_pairs or frame == "unknown"
            for one, (_, frame) in zip(self.instruments, self.views, strict=True)
            if self.custom or (position and one.sees_position) or (orientation and one.sees_orientation)
        )

    @property
    def blind_to_base(self) -> bool:
        """Whether nothing says where the base is: an error then counts after the best rigid fit alone."""
        return not self.custom and self.is_relative(position=True, orientation=True)

    def __str__(self) -> str:
        return " and ".join(dict.fromkeys(model for model, _ in self.views))


NOT_SEEN = 1e-6
"""Length of a direction's rows over that of what its members do one by one, up to which it is not seen."""

ROUNDING = 1e-8
"""The part of that which is rounding, as directions are rounded to nine digits."""

HARDLY_SEEN = 1e-3
"""Part of a direction's rows that landmarks leave, above which it is not lost to them, but hardly seen."""

OTHERS = {"X": "the unknown measurement frame", "": "variables added to the graph"}
"""Variables that are no landmarks, by the letter of their symbols."""


def find_confounding(problem: Problem, parameters: Floats, directions: Floats) -> list[tuple[str, ...] | None]:
    """Letters of what each of a problem's null-space directions is confounded with.

    Args:
        problem: The problem.
        parameters: The parameter vector that the directions were found at.
        directions: One a column, shape (n_robot_columns, n), [m] and [rad].

    Returns:
        None where nothing is confounded with a direction that is seen, empty where nothing shows it anyway.
    """
    variables, found = problem.variables, list[tuple[str, ...] | None]([()] * directions.shape[1])
    if variables.n_nuisance == variables.n_curves:
        return found  # measurement frames alone hide what moves the whole arm as one body, nothing else
    columns = dict[str, list[Integers]]()
    for v in (*variables.frames, *variables.nuisance):
        letter = "X" if v.kind == "frame" else v.letter if v.kind == "unknown" else ""
        columns.setdefault(letter, []).append(np.arange(v.columns.start, v.columns.stop))
    A = square_root(problem, parameters)[:, :-1]
    J = A[:, : variables.n_columns] @ variables.tangent_derivative(parameters)[:, : variables.n_robot_columns]
    rows, lengths, changes = J @ directions, np.linalg.norm(J, axis=0), np.abs(directions)
    size = np.linalg.norm(rows, axis=0)
    one_by_one = np.maximum(lengths @ changes, NOT_SEEN * lengths.max() * changes.max(axis=0))
    shown = np.flatnonzero(size > NOT_SEEN * one_by_one)

    def left(held: Collection[str] = ()) -> Floats:
        """Length of what landmarks do not explain of directions' rows, but for kinds that are held, shape (n,)."""
        free = [c for letter, of in columns.items() if letter not in held for c in of]
        wide = np.column_stack([rows[:, shown], *(A[:, c] for c in free)])
        return np.asarray(np.linalg.norm(eliminate(wide, np.zeros(len(wide)), len(shown)).A, axis=0))

    without = {letter: left((letter,)) for letter in columns}
    alone, every = {letter: left(set(columns) - {letter}) for letter in columns}, left()
    for i, k in enumerate(shown.tolist()):
        most = max(NOT_SEEN * size[k], ROUNDING * one_by_one[k], 10.0 * every[i])
        needed = tuple(letter for letter in columns if without[letter][i] > most)
        enough = [(letter,) for letter in columns if alone[letter][i] <= most]
        found[k] = (enough[0] if enough else needed or tuple(columns)) if every[i] <= HARDLY_SEEN * size[k] else None
    return found


def confounding_in_words(letters: Sequence[str]) -> str:
    """Name the confounding of a direction, and which additional knowledge would show it."""
    described = {letter: of.description or f"the unknown {of.name}s" for letter, of in LANDMARKS.items()} | OTHERS
    names = [described[letter] for letter in letters]
    kind = LANDMARKS.get(letters[0]) if len(letters) == 1 else None
    remedy = f": to see it, give places of {kind.name}s (key `{kind.key}`)" if kind is not None and kind.key else ""
    together = " together" if len(letters) > 1 else ""
    return f"confounded with {' and '.join(names)}{together}{remedy}"


N_RANDOM = 60
"""Random configurations at which directions are moved."""

NO_CAUSE = "no simple cause found"
NOT_EXCITED = "not excited by these configurations"
BASE = "the measurement is blind to the base: the whole arm moves as one body"

GIVEN = {"backlash": "the side of approach", "expansion": "the temperature", "drift": "the temperature"}
"""Kinds of effects that follow what the rows say besides readings, and what that is."""

NO_TORQUE = 1e-7
"""Torque, or moment, that is rounding, [N m] or of a unit first moment [m/s^2]."""

_NOTHING = 1e-7
"""A motion below this part of what its members do one by one is none: relations are rounded to nine digits, and what
`SUPPORT_TOLERANCE` left out of them may move as much as it could."""


class LostDirection(Record):
    """A direction that the measurements do not determine.

    Attributes:
        relation: The change of each parameter, [m] and [rad], the largest being 1 or -1.
        reason: Why, in words.
    """

    relation: dict[str, float]
    reason: str


@single_threaded
def explain(problem: Problem, parameters: Floats, observability: Observability) -> tuple[LostDirection, ...]:
    """The reason for every undetermined direction of an observability found for a problem at a parameter vector."""
    names, lost = observability.names, observability.lost
    if not lost:
        return ()
    observed = ObservedQuantities.of(problem)
    motion = _Motion(problem, parameters, observed)
    directions = np.array([[relation.get(name, 0.0) for name in names] for relation in lost]).T
    confounding = find_confounding(problem, parameters, directions)

    @cache
    def seen() -> Booleans:
        """Whether each direction is seen at random configurations; what custom kinds would show there is not known."""
        shown, robot = np.zeros(len(lost), dtype=np.bool_), motion.robot
        for model, frame in observed.views:
            known = frame if INSTRUMENTS[model].is_pose else "known"
            anywhere = random_problem(robot, model, known, n_configurations=N_RANDOM, seed=0)
            effect = named_triangle(anywhere, anywhere.start)
            least = 1e-6 * float(np.linalg.norm(effect, axis=0).max()) * np.abs(directions).max(axis=0)
            shown |= np.linalg.norm(effect @ directions, axis=0) > least
        return shown

    def reason(k: int, direction: Floats) -> str:
        by = confounding[k]
        if by:
            return BASE if motion.of_base(direction) else confounding_in_words(by)
        cause = NO_CAUSE if by is None else motion.reason(direction)
        return NOT_EXCITED if cause == NO_CAUSE and seen()[k] else cause

    return tuple(LostDirection(relation, reason(k, directions[:, k])) for k, relation in enumerate(lost))


class _Motion:
    """Motion of the tool by a problem's parameters at random configurations."""

    def __init__(self, problem: Problem, parameters: Floats, seen: ObservedQuantities) -> None:
        robot = problem.robot.with_values(parameters[problem.variables.robot_span])
        self.robot, self._parameters, self._seen = robot, problem.estimated, seen
        columns = {robot.index(p.name): k for k, p in enumerate(self._parameters)}
        chain = build_chain(robot, columns).with_joint_columns()
        trig = robot.trig(random_readings(robot, N_RANDOM, np.random.default_rng(0)))
        self._data, self._trig = problem.data, trig
        poses = forward(chain, trig)
        self._axes = poses.jacobian[:, :3, len(columns) :]
        self._R, self._p = poses.rotation, poses.position
        self._J = poses.jacobian[:, :, : len(columns)]
        self._scales = np.array([robot.scale_of(p.unit) for p in self._parameters])
        self._sizes = np.abs(self._J)
        self._most = [float((J * self._scales).max(initial=0.0)) for J in np.split(self._sizes, 2, axis=1)]
        moved = float(np.abs(poses.jacobian[:, 3:, -1]).max())
        self._on_last_axis = moved < _NOTHING and not robot.joints[-1].prismatic

    def reason(self, direction: Floats) -> str:
        """Why a direction, shape (n,), [m] and [rad], has no effect on the measurements."""
        w, _, turns, moves = self._of_tool(direction)
        seen, still = self._seen, not turns and not moves
        members = [p for p, v in zip(self._parameters, direction, strict=True) if v != 0.0]
        units, on_last_axis = {p.unit for p in members}, "the tool point lies on the last axis: " * self._on_last_axis
        about, axes = "it" if self._on_last_axis else "its own point", ", ".join(str(p.owner) for p in members)
        parallel = f"parallel axes {axes}" if {p.kind for p in members} <= {"d", "theta"} else "parallel directions"
        in_itself = _constant(np.einsum("nji,nj->ni", self._R, w)) and not (moves and seen.position)
        pairs_alone = not seen.custom and all(one.uses_pairs for one in seen.instruments)
        of_what = "" if all(p.name.startswith("tool.") for p in members) else on_last_axis
        of_effects = self._of_effects({p.name: p.kind for p in members if p.kind in EFFECT_KINDS})
        causes = (
            (bool(of_effects), of_effects),
            (still and units == {"m"}, f"{parallel}: only the sum of the shifts along them acts"),
            (still and units in ({"rad"}, {"rad/(N m)"}), "only their sum turns about the same axis"),
            (still, "together they do not move the tool"),
            (not (seen.orientation or moves), f"{on_last_axis}the tool only turns about {about}, unseen by {seen}"),
            (not (seen.position or turns) and units == {"rad"}, f"{parallel}: only the sum of their turns is seen"),
            (not (seen.position or turns), f"the tool only moves without turning, unseen by {seen}"),
            (self.of_base(direction), BASE),
            (pairs_alone and in_itself, f"{of_what}the tool frame turns by the same in itself everywhere"),
        )
        return next((words for applies, words in causes if applies), NO_CAUSE)

    def _of_effects(self, kinds: Mapping[str, str]) -> str:
        """Why effects are not seen, by kind, if what they are multiplied by is the same everywhere; else empty."""
        if not kinds:
            return ""
        given, terms = set(kinds.values()) <= set(GIVEN), [t for terms in self.robot.terms for t in terms]
        own, n = [t for t in terms if t.name in kinds], self.robot.n_joints
        places = zip(self._data.trigs(self.robot), self._data.places, strict=True)
        trig = np.concatenate([at[self._data.fitted[place]] for at, place in places]) if given else self._trig
        values = trig[:, [n + terms.index(t) for t in own], 0]
        down = [e.gravity for e in self.robot.effects if isinstance(e, Compliance)]
        gravity = [np.array(GRAVITY if g == "estimate" else g) for g in down]
        torques = [np.cross(self._axes[:, :, t.owner - 1], g) for t in own for g in gravity]
        causes = (
            (not _constant(values), ""),
            (given, f"{GIVEN.get(next(iter(kinds.values())))} does not vary, or is not given"),
            (float(np.abs(values).max()) > NO_TORQUE, "its load is the same everywhere"),
            ("tilt" in kinds.values(), "it acts through compliances, which are 0 here"),
            (any(t.axis != Axis.RZ for t in own), "no mass has a moment about its axis"),
            (float(np.abs(torques).max(initial=0.0)) < NO_TORQUE, "its axis is along gravity: no torque"),
            (True, "no mass beyond it is off its axis: no torque"),
        )
        return next(words for applies, words in causes if applies)

    def of_base(self, direction: Floats) -> bool:
        """Whether a direction moves the arm as if the base alone had moved, and nothing seen says where the base is."""
        w, dp, turns, _ = self._of_tool(direction)
        relative = self._seen.is_relative(position=True, orientation=turns) and _constant(w)
        return relative and (not self._seen.position or _constant(dp - np.cross(w, self._p)))

    def _of_tool(self, direction: Floats) -> tuple[Floats, Floats, bool, bool]:
        """Turns and shifts of the tool, shape (n_configurations, 3), and whether these are any."""
        w, dp = self._J[:, :3] @ direction, self._J[:, 3:] @ direction
        one_by_one = np.max(self._sizes @ np.abs(direction), axis=0)  # of the tool's six coordinates
        size_w, size_p = float(one_by_one[:3].max()), float(one_by_one[3:].max())
        share = SUPPORT_TOLERANCE * float(np.abs(direction / self._scales).max())
        turns = float(np.abs(w).max()) > max(_NOTHING * size_w, 1e-3 * _NOTHING * size_p, share * self._most[0])
        moves = float(np.abs(dp).max()) > max(_NOTHING * size_p, 1e-3 * _NOTHING * size_w, share * self._most[1])
        return w, dp, turns, moves


def _constant(values: Floats) -> bool:
    """Whether rows are all the same."""
    return float(np.abs(values - values[0]).max()) <= 1e-8 * max(1.0, float(np.abs(values).max()))
