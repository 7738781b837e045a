"""Prior information for the next calibration: that of this one's rows, and fingerprints of these, without the rows.

A fingerprint is a hash of one measurement's values, joint readings included, to 1e-12 m or rad, so that units and the
file's format make no difference: integers multiplied and added modulo 2^64, of which the upper bits count.
"""

import math
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib import graph, inputs, measurements, observability, parallel
from fg_calib.robot import Robot

Words = NDArray[np.uint64]

MAX_FINGERPRINTS = 1000
"""Fingerprints of a table that are kept: of more rows those with the smallest, in any two tables the same ones."""

SAME_SHARE = 0.5
"""Share of a table's rows from which it was counted before: coarse values repeat now and then."""

_RESOLUTION, _NOT_MEASURED, _FACTOR = 1e-12, 9e6, np.uint64(0x9E3779B97F4A7C15)


class Calibrated(inputs.Record):
    """An arm that was calibrated before.

    Attributes:
        robot: The nominal robot, with its tolerances; what the calibration is of is estimated.
        values: Its parameters as calibrated, shape (n_parameters,).
        knowledge: Information of the calibration's rows; None where the arm was evaluated only.
        options: Its options.
        noise: Factors on the specified sigmas, by table and kind, where noise was estimated.
        noise_degrees: Degrees of freedom that it was estimated by; None where it was specified, or is not known.
    """

    robot: Robot
    values: inputs.Floats
    knowledge: graph.Knowledge | None
    options: inputs.Options
    noise: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    noise_degrees: float | None = None

    @cached_property
    def information(self) -> graph.Knowledge | None:
        """Information of the rows, and tolerances about the nominal values as rows of their own."""
        if (known := self.knowledge) is None or not self.options.has_priors:
            return known
        of = {p.name: p.tolerance for p in self.robot.parameters if p.estimated}
        parameters = tuple(replace(p, tolerance=of.get(p.name)) for p in known.robot.parameters)
        robot = replace(known.robot, parameters=parameters).with_values(self.robot.nominal)
        variables = replace(known.variables, robot=robot, priors=True)
        r, J = graph.prior_rows(variables, np.append(known.robot.nominal, np.zeros(6)))
        return known.with_rows(np.hstack([J, np.zeros((len(J), len(known.at)))]), r)

    @property
    def arm(self) -> Robot:
        """The calibrated robot."""
        return self.robot.with_values(self.values)

    @property
    def fixed_options(self) -> inputs.Options:
        """Options with noise and prior sigmas as estimated."""
        return replace(self.options, estimate_noise=False)

    def noise_of(self, like: Sequence[str]) -> graph.NoiseState:
        """The noise of new tables: as it was found, of the only table if there was one.

        Args:
            like: Of each table the name of the calibration's table that it is like.
        """
        of_tables = {name: kinds for name, kinds in self.noise.items() if name}
        factors = {(graph.JOINT_NOISE[0], kind): factor for kind, factor in self.noise.get("", {}).items()}
        for number, name in enumerate(like):
            kinds = of_tables.get(name) or (next(iter(of_tables.values())) if len(of_tables) == 1 else {})
            factors |= {(number, kind): factor for kind, factor in kinds.items()}
        return graph.NoiseState(factors=factors)


@parallel.single_threaded
def knowledge_of(solution: graph.Solution) -> graph.Knowledge | None:
    """Information of a solution's rows about the arm, targets and anchors, with earlier information.

    Tolerances of the arm are not counted among it, said places of targets and anchors are. Parameters that were left
    out to fix the gauge have their columns. Rows that share errors but were to count as independent do so here, as in
    the posterior that is saved.

    Returns:
        None where the arm was evaluated only, or added factors take part.
    """
    problem = solution.problem
    if problem.evaluated or problem.added or not problem.variables.n_robot_columns:
        return None
    if problem.whole is not None:  # all parameters, those left out among them
        problem = replace(problem, variables=problem.whole.variables)
    as_drawn, x = at_nominal(problem, solution.before)
    nominal = _known_at(as_drawn, x, with_loss=False)
    views = observability.ObservedQuantities.of(problem).views
    nominal = replace(nominal, right=np.zeros(nominal.n), views=views)
    return replace(_known_at(problem, solution.parameters, with_loss=True), views=views, nominal=nominal)


def at_nominal(problem: graph.Problem, before: inputs.Floats) -> tuple[graph.Problem, inputs.Floats]:
    """A problem and the parameter vector at which one asks what its rows, and those before, determine.

    Args:
        problem: The problem.
        before: The parameter vector with frame, base and tool fitted, the arm at nominal; of an update where that
            started, which is as calibrated.
    """
    if problem.knowledge is None or problem.knowledge.nominal is None:
        return problem, before
    known, v, x = problem.knowledge.nominal, problem.variables, before.copy()
    x[v.robot_span] = known.robot.nominal
    for name in known.unknowns:
        if (place := _place(problem, name)) is not None:
            x[place] = known.place(name)
    return replace(problem, knowledge=known), x


def _known_at(problem: graph.Problem, x: inputs.Floats, *, with_loss: bool) -> graph.Knowledge:
    """Information of a problem's rows, and of those before, at a parameter vector; without the arm's tolerances."""
    v, known, unknowns = problem.variables, problem.knowledge, problem.data.landmarks
    staying = {name: _place(problem, name) for name in unknowns.keys if name[0] in graph.STAYING}
    places = {name: place for name, place in staying.items() if place is not None}
    unseen = [name for name in (() if known is None else known.unknowns) if name not in places]
    B = graph.square_root(problem, x, with_loss=with_loss, with_known=False)
    rows = [np.column_stack([B[:, :-1], np.zeros((len(B), graph.SIZE * len(unseen))), B[:, -1]])]
    at = [np.zeros(0), *(x[place] for place in places.values())]
    if known is not None:
        s, D = known.step_to(v, unknowns, x)
        own = [known.rows[:, known.span(name)] for name in unseen]
        rows.append(np.column_stack([known.rows @ D, *own, known.right + known.rows @ s]))
        at += [known.place(name) for name in unseen]
    A, b = np.split(np.vstack(rows), [-1], axis=1)
    columns = [v.columns_at(place) for place in places.values()]
    wide = np.arange(A.shape[1])
    kept = np.concatenate([wide[: v.n_robot_columns], *columns, wide[v.n_columns + v.n_nuisance :]])
    left = graph.eliminate(A[:, np.concatenate([kept, np.setdiff1d(wide, kept)])], b[:, 0], len(kept))
    robot = v.robot.with_values(x[v.robot_span])
    return graph.Knowledge.of_rows(robot, [*places, *unseen], np.concatenate(at), left.A, left.b)


def _place(problem: graph.Problem, name: graph.Name) -> inputs.Integers | None:
    return graph.coordinates_of(problem.variables, problem.data.landmarks, name)


def fingerprints(tables: Sequence[measurements.Table]) -> tuple[str, ...]:
    """Fingerprints of the train rows of tables, 12 hexadecimal digits each, sorted; at most 1000 a table."""
    smallest = [np.sort(_of_rows(table.measurements) >> np.uint64(16))[:MAX_FINGERPRINTS] for table in tables]
    return tuple(sorted({f"{one:012x}" for some in smallest for one in some.tolist()}))


def counted_before(table: measurements.Table, known: Collection[str]) -> bool:
    """Whether half of a table's rows are among fingerprints."""
    own = fingerprints([table])
    return bool(own) and sum(one in known for one in own) >= SAME_SHARE * len(own)


def _of_rows(m: measurements.Measurements) -> Words:
    """Hashes of what was measured at, and between, configurations."""
    given = [v for v in (m.position, m.rotation, m.image, *m.columns.values()) if v is not None]
    values = [v.reshape(len(m.readings), -1) for v in given]
    labels = [*(m.labels.get(kind.name) for kind in measurements.LANDMARKS.values()), m.groups]
    named = [one for one in labels if one is not None]
    codes = [np.array([*(zlib.crc32(n.encode()) for n in of.names), 0], dtype=np.uint64)[of.index] for of in named]
    touched = np.zeros(len(m.readings), dtype=np.bool_) if m.groups is None else m.groups.index >= 0
    measured = np.any([touched, *(np.isfinite(v).all(axis=1) for v in values)], axis=0)
    found = [_hash(m.readings, *values, *codes)[measured & ~m.test]]
    if m.pairs is not None:
        ends, pairs = _hash(m.readings), m.pairs
        found.append(_hash(ends[pairs.a], ends[pairs.b], pairs.distance, pairs.angle)[~pairs.test])
    return np.concatenate(found)


def _hash(*values: NDArray[Any]) -> Words:
    """One hash a row of values, in units of the resolution, or of hashes."""
    total: Words = np.zeros(len(values[0]), dtype=np.uint64)
    for column in (column for v in values for column in np.reshape(v, (len(total), math.prod(v.shape[1:]))).T):
        whole = np.round(np.nan_to_num(column.astype(np.float64), nan=_NOT_MEASURED) / _RESOLUTION)
        words = column if column.dtype == np.uint64 else whole.astype(np.int64).view(np.uint64)
        total = (total ^ words) * _FACTOR
        total ^= total >> np.uint64(32)
    return total
