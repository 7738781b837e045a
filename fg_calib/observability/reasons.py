"""Why directions are lost: each is moved at random configurations, and what it does to the tool tells the cause.

A cause is stated only if it is checked: that the tool does not move, that everything moves as one body, that the tool
only turns about its own point, that unknowns of the measurements take the direction up (see `absorbed`), and so on.
Where no check succeeds the reason is `NO_CAUSE`, never a guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from fg_calib.graph import SUPPORT_TOLERANCE, Problem, named_triangle
from fg_calib.inputs import Booleans, Floats
from fg_calib.observability.confounding import Confounding
from fg_calib.observability.indices import Observability
from fg_calib.observability.observed_quantities import ObservedQuantities
from fg_calib.observability.random_configurations import at_random_configurations
from fg_calib.parallel import single_threaded
from fg_calib.robot import build_chain, forward, random_readings

NO_CAUSE = "no simple cause found"
NOT_EXCITED = "not excited by these configurations"
BASE = "the measurement is blind to the base: the whole arm moves as one body"

_NOTHING = 1e-7
"""A motion below this part of what its members do one by one is none: relations are rounded to nine digits, and what
`SUPPORT_TOLERANCE` left out of them may move as much as it could."""


@dataclass(frozen=True)
class LostDirection:
    """A direction that the measurements do not determine.

    Attributes:
        relation: The change of each parameter, [m] and [rad], the largest being 1 or -1.
        reason: Why, in words.
    """

    relation: dict[str, float]
    reason: str


@single_threaded
def explain(problem: Problem, parameters: Floats, observability: Observability) -> tuple[LostDirection, ...]:
    """The reason for every lost direction of an observability found for a problem at a parameter vector."""
    return explain_relations(problem, observability.names, observability.lost, parameters)


def explain_relations(
    problem: Problem, names: Sequence[str], lost: Sequence[dict[str, float]], parameters: Floats
) -> tuple[LostDirection, ...]:
    """The reason for every one of some relations of a problem's parameters, by these names, at a parameter vector."""
    if not lost:
        return ()
    motion = _Motion(problem, parameters, ObservedQuantities.of(problem))
    directions = np.array([[relation.get(name, 0.0) for name in names] for relation in lost]).T
    confounding = Confounding(problem, parameters, directions)
    touched = any(table.measurements.groups is not None for table in problem.data.tables)

    @cache
    def seen() -> Booleans:
        """Whether each direction is seen at random configurations; what custom kinds would show there is not known."""
        anywhere = at_random_configurations(problem, parameters)
        effect = np.zeros((1, len(directions))) if anywhere is None else named_triangle(anywhere, anywhere.start)
        largest = float(np.linalg.norm(effect, axis=0).max())
        shown: Booleans = np.linalg.norm(effect @ directions, axis=0) > 1e-6 * largest * np.abs(directions).max(axis=0)
        return shown

    def reason(k: int, direction: Floats) -> str:
        by = confounding.by(k)
        cause = motion.reason(direction) if by == () else NO_CAUSE
        if cause != NO_CAUSE:
            return cause
        if not (by and touched) and seen()[k]:  # nor is it known what touches of the same points would show
            return NOT_EXCITED
        return NO_CAUSE if not by else BASE if motion.of_base(direction) else confounding.words(k)

    return tuple(LostDirection(relation, reason(k, directions[:, k])) for k, relation in enumerate(lost))


class _Motion:
    """What a problem's parameters do to the tool at random configurations."""

    def __init__(self, problem: Problem, parameters: Floats, seen: ObservedQuantities) -> None:
        robot = problem.robot.with_values(parameters[problem.variables.robot_span])
        self._parameters = problem.estimated
        self._seen = seen
        number = {p.name: i for i, p in enumerate(robot.parameters)}
        columns = {number[p.name]: k for k, p in enumerate(self._parameters)}
        chain = build_chain(robot, columns).with_joint_columns()
        poses = forward(chain, robot.trig(random_readings(robot, 60, np.random.default_rng(0))))
        n = len(self._parameters)
        self._R, self._p = poses.rotation, poses.position
        self._J = poses.jacobian[:, :, :n]
        scale = {unit: robot.scale_of(unit) for unit in ("m", "rad")}
        self._scales = np.array([scale[p.unit] for p in self._parameters])
        self._sizes = np.abs(self._J)
        self._most = [float((J * self._scales).max(initial=0.0)) for J in np.split(self._sizes, 2, axis=1)]
        axes = np.moveaxis(poses.jacobian[:, :3, n:], 2, 1)[:, [not j.prismatic for j in robot.joints]]
        axes = axes * np.where(np.sum(axes * axes[:1, :1], axis=2, keepdims=True) < 0.0, -1.0, 1.0)
        self._common_axis = axes[:, 0] if axes.size and self._constant(axes.reshape(-1, 3)) else None
        last = poses.jacobian[:, 3:, -1]
        self._on_last_axis = not robot.joints[-1].prismatic and float(np.abs(last).max()) < _NOTHING

    def reason(self, direction: Floats) -> str:  # noqa: PLR0911 - one return a cause
        """Why a direction, shape (n,), [m] and [rad], has no effect on the measurements."""
        w, dp, turns, moves = self._of_tool(direction)
        sees_orientation, sees_position, pairs = self._seen.orientation, self._seen.position, self._seen.pairs
        members = [p for p, v in zip(self._parameters, direction, strict=True) if v != 0.0]
        units, on_last_axis = {p.unit for p in members}, "the tool point lies on the last axis: " * self._on_last_axis
        parallel = "parallel directions"
        if all(p.kind in ("d", "theta") for p in members):
            parallel = f"parallel axes {', '.join(str(p.owner) for p in members)}"
        if not turns and not moves and units == {"m"}:
            return f"{parallel}: only the sum of the shifts along them acts"
        if not turns and not moves:
            return (
                "only their sum turns about the same axis" if units == {"rad"} else "together they do not move the tool"
            )
        if not sees_orientation and not moves:
            about = "it" if self._on_last_axis else "its own point"
            return f"{on_last_axis}the tool only turns about {about}, unseen by {self._seen}"
        if not sees_position and not turns and units == {"rad"}:
            return f"{parallel}: only the sum of their turns is seen, and no lengths are"
        if not sees_position and not turns:
            return f"the tool only moves without turning, unseen by {self._seen}"
        if self._is_of_base(w, dp, turns):
            return BASE
        if pairs and not (moves and sees_position) and self._constant(np.einsum("nji,nj->ni", self._R, w)):
            of_the_tool = all(p.name.startswith("tool.") for p in members)
            what = "the tool frame turns by the same in itself everywhere, which no angle between two poses shows"
            return what if of_the_tool else f"{on_last_axis}{what}"
        if pairs and self._common_axis is not None and self._tilts(w, dp, self._common_axis):
            return "parallel axes, all of them: it only tilts the arm out of its plane, unseen to first order"
        return NO_CAUSE

    def of_base(self, direction: Floats) -> bool:
        """Whether a direction moves the arm as if the base alone had moved, and nothing seen says where the base is."""
        w, dp, turns, _ = self._of_tool(direction)
        return self._is_of_base(w, dp, turns)

    def _is_of_base(self, w: Floats, dp: Floats, turns: bool) -> bool:
        if not self._seen.is_relative(position=True, orientation=turns):
            return False
        return self._constant(w) and (not self._seen.position or self._constant(dp - np.cross(w, self._p)))

    def _of_tool(self, direction: Floats) -> tuple[Floats, Floats, bool, bool]:
        """Turns and shifts of the tool, shape (n_configurations, 3), and whether these are any."""
        w, dp = self._J[:, :3] @ direction, self._J[:, 3:] @ direction
        one_by_one = np.max(self._sizes @ np.abs(direction), axis=0)  # of the tool's six coordinates
        size_w, size_p = float(one_by_one[:3].max()), float(one_by_one[3:].max())
        share = SUPPORT_TOLERANCE * float(np.abs(direction / self._scales).max())
        turns = float(np.abs(w).max()) > max(_NOTHING * size_w, 1e-3 * _NOTHING * size_p, share * self._most[0])
        moves = float(np.abs(dp).max()) > max(_NOTHING * size_p, 1e-3 * _NOTHING * size_w, share * self._most[1])
        return w, dp, turns, moves

    def _tilts(self, w: Floats, dp: Floats, axis: Floats) -> bool:
        """Whether the tool moves along the common axis of the joints only, and turns across it only."""
        along = np.sum(w * axis, axis=1)
        in_plane = dp - np.sum(dp * axis, axis=1, keepdims=True) * axis
        return bool(np.abs(along).max() < 1e-8 and np.abs(in_plane).max() < 1e-8)

    @staticmethod
    def _constant(values: Floats) -> bool:
        """Whether rows are all the same."""
        return float(np.abs(values - values[0]).max()) <= 1e-8 * max(1.0, float(np.abs(values).max()))
