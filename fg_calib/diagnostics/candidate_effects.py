"""Candidates for what a model lacks: effects, and small motions of links, as parameters of a wider robot.

A test of residuals adds them stage by stage (see `unmodelled_effects`):

1. compliance of joints that turn: gravity along z of the base, masses of the model or else at the tool and on links;
2. every small motion of every link, harmonics of one and two periods a turn (eccentric encoders and gears), gains; a
   constant load of joints that slide is their zero;
3. the same masses of an arm that is mounted otherwise, gravity along x and y;
4. joints that tilt, and a base that gives way, under these masses;
5. harmonics of three to eight periods a turn;
6. backlash by the last move in the order of rows, and joints that move with one near them;
7. other masses than those of the model: free first moments;
8. zeros of joints that drift in the order of rows, as heat makes them do.

The name of a column begins with its stage and what it is, then has the number of its joint: `4 tilt 2.compliance5_7`.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fg_calib.graph import Problem, Variables
from fg_calib.graph.variables import build_variables
from fg_calib.inputs import Floats, Record
from fg_calib.robot import FRAME_KINDS, PARAMETER_KINDS, Effect, Robot
from fg_calib.robot.effects import (
    GRAVITY,
    Backlash,
    Bending,
    Compliance,
    Coupling,
    Gain,
    Harmonics,
    Mass,
    Thermal,
    last_moves,
)
from fg_calib.robot.model import Context, Term, kind_of, names_of

STAGES = tuple(f"{k} " for k in range(1, 9))
"""How names of the columns of each stage begin."""

LINK = "2 small motion of link "
"""How those of small motions of links begin, before the number of the joint that moves the link."""

NEXT = 2
"""How far apart in their order joints are that gears couple."""

MASSES, DRIFT = "7 masses", "8 drift"
"""How those of other masses than the model's, and of drifts of joints, begin."""

_WORDS = {
    "1 gravity": "yields to gravity (`compliance`)",
    "2 gain": "errs in proportion to its position (`gain`)",
    "2 position": "errs once or twice a turn (gear, encoder: `harmonics`)",
    "3 side load": "yields to loads along x and y of the base (is gravity there? key `gravity`)",
    "4 tilt": "tilts under gravity (`compliance: lateral`)",
    "5 position": "errs several times a turn (gear, encoder: `error_curve`)",
    "6 backlash": "errs with the direction of its last move (`backlash`)",
    MASSES: "bears another load than its masses make (`masses`)",
    DRIFT: "drifts in the order of rows (heat: `thermal`)",
}
"""Effects of single joints, by how the names of their columns begin, before the number of the joint."""

_BENDING, _COUPLING = "4 bending", "6 coupling"
"""The same of the base, and of joints that turn with another one, before the numbers of both."""


class CandidateEffect(Effect, Record):
    """Terms of an effect that a robot lacks, by names of their own.

    Attributes:
        number: Its number among others.
        name: How they begin, before the number of the joint: see `_WORDS`.
        effect: The effect.
        n_terms: How many terms it has.
        which: Numbers of those that the robot lacks.
    """

    number: int
    name: str
    effect: Effect
    n_terms: int
    which: tuple[int, ...]

    def terms(self, robot: Robot) -> list[Term]:
        every = self.effect.terms(robot)
        first, owners = [t.name for t in every], [t.owner for t in every]
        kinds = [f"{kind_of(name)}{self.number}_{first.index(name)}" for name in first]
        return [every[k]._replace(name=f"{self.name} {owners[k]}.{kinds[k]}") for k in self.which]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        return self.effect.values(robot, readings, context, np.zeros(self.n_terms))[:, self.which]


class SmallMotions(Effect, Record):
    """The six small motions of each link: constant terms at its end."""

    def terms(self, robot: Robot) -> list[Term]:
        each = [(link, kind) for link in range(robot.n_joints + 1) for kind in FRAME_KINDS]
        names = [f"{LINK}{link}.{kind}" for link, kind in each]
        places = [(link, robot.end_of(link) - 1, PARAMETER_KINDS[kind].axis) for link, kind in each]
        return [Term(name, 1.0, *place) for name, place in zip(names, places, strict=True)]

    def values(self, robot: Robot, readings: Floats, context: Context, at: Floats) -> Floats:
        return np.broadcast_to([1.0, 0.0], (len(readings), len(at), 2))


def _near(n: int) -> list[tuple[int, int]]:
    """Numbers of joints that gears may couple, the driving one first."""
    return [(i, j) for i in range(1, n + 1) for j in range(1, n + 1) if 0 < abs(i - j) <= NEXT]


def candidates_for(robot: Robot) -> list[CandidateEffect]:
    """Effects that a robot lacks.

    It has the loads in a direction at joints that are compliant under a gravity that is not across it. An error curve
    holds harmonics and gain of its joint.
    """
    arm, n, has = robot.geometry, robot.n_joints, {p.name for p in robot.parameters}
    slides = [k for k, joint in enumerate(robot.joints, 1) if joint.prismatic]
    own = [e for e in robot.effects if isinstance(e, Compliance)]
    compliant = [(e.terms(arm), e.gravity) for e in own]
    masses = [e.masses for e in own if e.masses] or [[Mass(n + 1, 1.0)], [Mass(k, 1.0) for k in range(1, max(n, 2))]]
    down = next((e.gravity for e in own if e.gravity != "estimate"), GRAVITY)
    candidates: list[tuple[str, Effect]] = [("2 gain", Gain())]
    candidates += [(f"{_COUPLING} {i} on", Coupling([(i, j)])) for i, j in _near(n)]
    if len(slides) < n:
        candidates += [(DRIFT, Thermal(0.0, lengths=False, zeros=True, column="order of rows"))]
        candidates += [("2 position", Harmonics()), ("5 position", Harmonics(range(3, 9))), ("6 backlash", Backlash())]
        for some in masses:
            sides = zip(("3 side load", "3 side load", "1 gravity"), np.eye(3).tolist(), strict=True)
            candidates += [(name, Compliance(some, gravity=g)) for name, g in sides]
            candidates += [("4 tilt", Compliance(some, lateral=True, gravity=down)), (_BENDING, Bending(some, down))]
        candidates += [(MASSES, Compliance(None, e.joints, gravity=down)) for e in own if e.masses]
    found = list[CandidateEffect]()
    for number, (name, effect) in enumerate(candidates):
        terms = effect.terms(arm)
        new = [k for k, t in enumerate(terms) if t.name not in has]
        if name[0] in "25":
            new = [k for k in new if f"{terms[k].name.rpartition('.')[0]}.curve[0]" not in has]
        elif name == "4 tilt":
            new = [k for k in new if not terms[k].name.endswith(".compliance")]
        elif isinstance(effect, Compliance) and effect.masses:
            axis = int(np.argmax(effect.gravity))
            loaded = {t.owner for terms, g in compliant for t in terms if g == "estimate" or g[axis]}
            new = [k for k, t in enumerate(terms) if t.owner not in loaded]
        found.append(CandidateEffect(number, name, effect, len(terms), tuple(new)))
    return found


@lru_cache(maxsize=4)
def widened_robot(robot: Robot) -> Robot:
    """A robot with its links' small motions and the effects that it lacks.

    Six parameters are called `LINK` and the number of their joint: those of the base 0, those of the tool as many as
    there are joints.
    """
    own = {p.name: p for p in robot.parameters}
    wide = robot.geometry.with_effects(SmallMotions(), *robot.effects, *candidates_for(robot))
    return replace(wide, parameters=tuple(own.get(p.name, replace(p, tolerance=None)) for p in wide.parameters))


def widened(problem: Problem, at: Floats) -> tuple[Variables, Floats, list[Floats]]:
    """The problem with a `widened_robot`, at a parameter vector.

    Returns:
        The core's variables, their parameter vector, and readings of each table for the kernels.
    """
    wide, tables = widened_robot(problem.robot), problem.data.tables
    own = dict(zip(names_of(problem.robot.parameters), at.tolist(), strict=False))
    values = np.append([own.get(p.name, 0.0) for p in wide.parameters], at[problem.variables.frame_span])
    trigs = list[Floats]()
    for m in (table.measurements for table in tables):
        context = {"moves": last_moves(m.readings), "order of rows": np.linspace(-1.0, 1.0, len(m.ids))}
        trigs.append(wide.trig(m.readings, context | dict(m.context), values))
    return build_variables(wide, [table.unknown_frame for table in tables], problem.variables.priors), values, trigs


def causes_of(robot: Robot) -> dict[str, str]:
    """How the names of the columns of each single effect begin, by what it is in words."""
    found = {f"{joint.name} {_WORDS[e]}": f"{e} {k}." for k, joint in enumerate(robot.joints, 1) for e in _WORDS}
    found["the base gives way to the arm's weight (`base_bending`)"] = _BENDING
    for i, j in _near(robot.n_joints):
        words = f"{robot.joints[j - 1].name} moves with {robot.joints[i - 1].name} (`coupling: [[{i}, {j}]]`)"
        found[words] = f"{_COUPLING} {i} on {j}."
    for link in range(robot.n_joints + 1):
        where = {0: "the base", robot.n_joints: "the tool"}.get(link, f"the link after {robot.joints[link - 1].name}")
        found[f"{where} has an error that no estimated parameter describes"] = f"{LINK}{link}."
    return found
