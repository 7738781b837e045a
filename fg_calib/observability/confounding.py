"""Which landmarks and frames are confounded with a null-space direction: with these known the measurements show it.

With the columns of a kind of landmark projected out the direction is lost, with the landmarks held where they are (its
columns left out) it is seen: both are computed from the whitened rows, leaving one kind out after the other.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from fg_calib.graph import Problem, eliminate, square_root
from fg_calib.inputs import Floats, Integers
from fg_calib.measurements import LANDMARKS

NOT_SEEN = 1e-6
"""Length of a direction's rows over that of what its members do one by one, up to which it is not seen."""

ROUNDING = 1e-8
"""The part of that which is rounding, as directions are rounded to nine digits."""

HARDLY_SEEN = 1e-3
"""Part of a direction's rows that landmarks leave, above which it is not lost to them, but hardly seen."""

OTHERS = {"X": "the unknown measurement frame", "": "variables added to the graph"}
"""Variables that are no landmarks, by the letter of their symbols."""


class Confounding:
    """What each of a problem's null-space directions is confounded with.

    Args:
        problem: The problem.
        parameters: The parameter vector that the directions were found at.
        directions: One a column, shape (n_robot_columns, n), [m] and [rad].
    """

    def __init__(self, problem: Problem, parameters: Floats, directions: Floats) -> None:
        variables, n = problem.variables, problem.variables.n_robot_columns
        self._columns: dict[str, list[Integers]] = {}
        for v in (*variables.frames, *variables.nuisance):
            letter = "X" if v.kind == "frame" else v.letter if v.kind == "unknown" else ""
            self._columns.setdefault(letter, []).append(np.arange(v.columns.start, v.columns.stop))
        self._by: list[tuple[str, ...] | None] = [()] * directions.shape[1]
        if not variables.nuisance:
            return  # measurement frames alone hide what moves the whole arm as one body, nothing else
        self._A = square_root(problem, parameters)[:, :-1]
        named = self._A[:, : variables.n_columns] @ variables.tangent_derivative(parameters)[:, :n]
        self._rows = named @ directions
        columns, changes = np.linalg.norm(named, axis=0), np.abs(directions)
        one_by_one = np.maximum(columns @ changes, NOT_SEEN * columns.max() * changes.max(axis=0))
        size = np.linalg.norm(self._rows, axis=0)
        shown = np.flatnonzero(size > NOT_SEEN * one_by_one).tolist()
        left = {letter: self._left(shown, held=(letter,)) for letter in self._columns}
        alone = {letter: self._left(shown, held=set(self._columns) - {letter}) for letter in self._columns}
        every = self._left(shown)
        for i, k in enumerate(shown):
            most = max(NOT_SEEN * size[k], ROUNDING * one_by_one[k], 10.0 * every[i])
            needed = tuple(letter for letter in self._columns if left[letter][i] > most)
            enough = [(letter,) for letter in self._columns if alone[letter][i] <= most]
            by = enough[0] if enough else needed or tuple(self._columns)
            self._by[k] = by if every[i] <= HARDLY_SEEN * size[k] else None

    def by(self, k: int) -> tuple[str, ...] | None:
        """Letters of what direction k is confounded with; none where nothing shows it anyway, None where by nothing."""
        return self._by[k]

    def words(self, k: int) -> str:
        """What direction k is confounded with, and which additional knowledge would show it."""
        letters = self._by[k] or ()
        names = [OTHERS.get(letter) or LANDMARKS[letter].description for letter in letters]
        one = letters in {("O",), ("X",)}
        verb = "takes it up" if one else "take it up together" if len(letters) > 1 else "take it up"
        kind = LANDMARKS.get(letters[0]) if len(letters) == 1 else None
        remedy = f": to see it, give places of {kind.name}s (key {kind.key})" if kind is not None and kind.key else ""
        return f"{' and '.join(names)} {verb}{remedy}"

    def _left(self, directions: Sequence[int], held: Collection[str] = ()) -> Floats:
        """Length of what landmarks do not explain of directions' rows, but for kinds that are held, shape (n,)."""
        columns = [c for letter, of in self._columns.items() if letter not in held for c in of]
        A = np.column_stack([self._rows[:, list(directions)], *(self._A[:, c] for c in columns)])
        return np.asarray(np.linalg.norm(eliminate(A, np.zeros(len(A)), len(directions)).A, axis=0))
