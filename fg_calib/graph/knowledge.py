"""Information of earlier rows, without these rows: its square root, about where they were linearised.

Of rows r(x), whitened, all is kept that acts on the arm and on what stays with it (targets on the tool, anchors):
`|r|^2 = |z + R s|^2 + constant` to second order, s the step from where they were linearised in the tangent space of the
variables. What the rows depended on besides, such as measurement frames, is eliminated: it may be another by now.

Growth: where x may have wandered since by g with 1 sigma G, `|z + R (s - G h)|^2 + |h|^2` with h eliminated; where G is
unlimited h has no row of its own.

What rows determine at all is asked at the nominal arm: there undetermined directions are exact. So they are kept as
linearised there, too (`nominal`), without what tolerances say.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.factors import CheckedFactor
from fg_calib.graph.normal_system import determined, eliminate
from fg_calib.graph.variables import Variables, build_variables
from fg_calib.inputs import Floats, FrameKnowledge, FrozenArrays, Integers, Model
from fg_calib.measurements import LANDMARKS, Landmarks
from fg_calib.robot import Robot

STAYING = tuple(letter for letter, kind in LANDMARKS.items() if kind.stays)
"""Letters of the unknowns that may stay where they are: targets on the tool, anchors around the arm."""

SIZE = 3
"""Number of coordinates of each unknown."""

Name = tuple[str, str]
"""Letter and name of an unknown."""

View = tuple[Model, FrameKnowledge]
"""A model, and whether the measurement frame is known."""


class Knowledge(FrozenArrays):
    """Information of earlier rows about an arm and what stays with it.

    Attributes:
        robot: The arm with its values where the rows were linearised; what they are about is estimated.
        unknowns: Letter and name of what stays with it.
        at: Where these were, one after the other, shape (3 * len(unknowns),), [m].
        rows: R, shape (k, n_columns + len(at)): columns of the arm's variables, then of the unknowns.
        right: z, shape (k,).
        views: Models of the tables that they are of with the knowledge of their frames, each once.
        nominal: The same rows linearised at the nominal arm, z = 0: by them parameters are classed; None where that
            was not kept.
    """

    robot: Robot
    unknowns: tuple[Name, ...]
    at: Floats
    rows: Floats
    right: Floats
    views: tuple[View, ...] = ()
    nominal: "Knowledge | None" = None

    @cached_property
    def variables(self) -> Variables:
        """The arm's variables."""
        return build_variables(self.robot, [False], False)

    @property
    def n(self) -> int:
        """Number of rows: directions that are known."""
        return len(self.rows)

    @property
    def scales(self) -> Floats:
        """A change of ordinary size in each column."""
        return np.append(self.variables.scales, np.full(len(self.at), self.robot.scale_of("m")))

    @classmethod
    def of_rows(cls, robot: Robot, unknowns: Sequence[Name], at: Floats, A: Floats, b: Floats) -> "Knowledge":
        """Knowledge of whitened rows `A s + b`, of which as many are kept as there are directions known.

        Args:
            robot: The arm where they were linearised.
            unknowns: Landmarks that stay with it.
            at: Where that was.
            A: Derivatives, shape (m, n_columns + len(at)).
            b: Residuals, shape (m,).
        """
        bare = cls(robot, tuple(unknowns), at, np.zeros((0, A.shape[1])), np.zeros(0))
        _, R = np.linalg.qr(np.column_stack([A * bare.scales, b]))
        U, s, Vt = np.linalg.svd(R[:, :-1], full_matrices=False)
        rank = determined(s)
        return replace(bare, rows=s[:rank, None] * Vt[:rank] / bare.scales, right=U[:, :rank].T @ R[:, -1])

    def about(self, unknowns: Sequence[Name]) -> "Knowledge":
        """The information about some of the unknowns, the others eliminated."""
        kept = [name for name in unknowns if name in self.unknowns]
        n = self.variables.n_columns
        if list(self.unknowns) == kept:
            return self
        nominal = None if self.nominal is None else self.nominal.about(unknowns)
        columns = np.concatenate([np.arange(n), *(self.span(name) for name in kept)])
        order = np.concatenate([columns, np.setdiff1d(np.arange(n + len(self.at)), columns)])
        left = eliminate(self.rows[:, order], self.right, len(columns))
        return self._with(Knowledge.of_rows(self.robot, kept, self.at[columns[n:] - n], left.A, left.b), nominal)

    def grown(self, directions: Floats, free: NDArray[np.bool_]) -> "Knowledge":
        """The information after random parameter changes with given sigmas.

        Args:
            directions: Of independent changes of 1 sigma each in the columns, shape (n_columns + len(at), n).
            free: Which of them may be of any size, shape (n,).

        Returns:
            It, with `nominal` as it was: its columns are others.
        """
        if not directions.shape[1]:
            return self
        n, k = directions.shape
        own = np.hstack([np.zeros((k, n)), np.eye(k)])[~free]
        wide = np.vstack([np.hstack([self.rows, -self.rows @ directions]), own])
        left = eliminate(wide, np.append(self.right, np.zeros(len(own))), n)
        return self._with(Knowledge.of_rows(self.robot, self.unknowns, self.at, left.A, left.b), self.nominal)

    def with_rows(self, A: Floats, b: Floats) -> "Knowledge":
        """The information with more rows about the same point, none of them measured: `nominal` stays."""
        A, b = np.vstack([self.rows, A]), np.append(self.right, b)
        return self._with(Knowledge.of_rows(self.robot, self.unknowns, self.at, A, b), self.nominal)

    def _with(self, rows: "Knowledge", nominal: "Knowledge | None") -> "Knowledge":
        """Other rows of the same tables."""
        return replace(rows, views=self.views, nominal=nominal)

    def span(self, name: Name) -> Integers:
        """Columns of an unknown."""
        return self.variables.n_columns + SIZE * self.unknowns.index(name) + np.arange(SIZE)

    def place(self, name: Name) -> Floats:
        """Position of an unknown then, shape (3,), [m]."""
        return self.at[self.span(name) - self.variables.n_columns]

    def follow(self) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """How the unknowns follow the arm: derivatives, a root of their covariance at a given arm, which are not known.

        Returns:
            Shapes (len(at), n_columns), (len(at), rank) and (len(at),).
        """
        left = eliminate(self.rows, self.right, self.variables.n_columns)
        return left.follow, left.inverse, left.unknown

    def step_to(self, variables: Variables, unknowns: Landmarks, parameters: Floats) -> tuple[Floats, Floats]:
        """The step from where the rows were linearised to a parameter vector, and its derivative.

        Args:
            variables: Variables of a problem of the same arm.
            unknowns: The problem's unknowns; those of the knowledge's that are none of them stay where they were.
            parameters: The problem's parameter vector.

        Returns:
            Shapes (n_columns + len(at),) and (n_columns + len(at), n of all the problem's columns).
        """
        own, n = self.variables, self.variables.n_columns
        values, before = parameters[own.robot_span], self.robot.nominal
        s, turned = np.concatenate([own.step(before, values), np.zeros(len(self.at))]), np.eye(n)
        for v in own.items:
            if v.is_pose:
                turned[v.columns, v.columns] = gtsam.Pose3.LogmapDerivative(s[v.columns])
        D = np.zeros((len(s), variables.n_columns + variables.n_nuisance))
        D[:n, : variables.n_columns] = turned @ own.columns_of(variables, values)
        for i, name in enumerate(self.unknowns):
            place = coordinates_of(variables, unknowns, name)
            if place is not None:
                rows = n + SIZE * i + np.arange(SIZE)
                s[rows] = parameters[place] - self.at[SIZE * i + np.arange(SIZE)]
                D[rows, variables.columns_at(place)] = 1.0
        return s, D

    def seen_by(self, variables: Variables, unknowns: Landmarks) -> "Knowledge":
        """The information about a problem's unknowns, the others eliminated."""
        return self.about([n for n in self.unknowns if coordinates_of(variables, unknowns, n) is not None])

    def at_parameters(self, variables: Variables, unknowns: Landmarks, parameters: Floats) -> tuple[Floats, Floats]:
        """The rows at a parameter vector and their derivatives, shapes (k,), (k, n of all the problem's columns)."""
        s, D = self.step_to(variables, unknowns, parameters)
        return self.right + self.rows @ s, self.rows @ D

    def factor(self, variables: Variables, unknowns: Landmarks) -> CheckedFactor:
        """The rows as a factor on all variables of a problem."""
        every, vector = [*variables.items, *variables.nuisance], variables.parameters
        return CheckedFactor(every, self.n, lambda values: self.at_parameters(variables, unknowns, vector(values)))


def coordinates_of(variables: Variables, unknowns: Landmarks, name: Name) -> Integers | None:
    """Index of an unknown's coordinates in a parameter vector; None for one that is not there, or not estimated."""
    place = unknowns.by_key(variables.coordinates).get(name)
    return place if place is not None and np.all(place >= 0) else None
