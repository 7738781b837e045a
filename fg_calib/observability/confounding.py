"""Which unknowns of the measurements take up a lost direction: without them the measurements would show it.

With the columns of an unknown projected out the direction is lost, with the unknown held where it is (its columns left
out) it is seen: both are computed from the whitened rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, combinations

import numpy as np
from numpy.typing import NDArray

from fg_calib.graph.information import whitened_jacobian
from fg_calib.graph.normal_system import eliminate
from fg_calib.graph.problem import Problem

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_NOTHING = 1e-6
"""A direction is not seen if its rows are below this part of what its members do one by one, or of what they were."""

_ROUNDING = 1e-8
"""The same of what its members do, as directions are rounded to nine digits."""

_WEAK = 1e-3
"""Above this part of its rows a direction is not lost to unknowns, but hardly seen."""

_WORDS = {
    "P": "the unknown places of the targets on the tool",
    "A": "the unknown anchors",
    "O": "what the instrument adds to every length",
    "F": "the unknown planes",
    "B": "the unknown boards",
    "L": "the unknown touched points",
    "N": "unknowns of kinds of your own",
    "X": "the unknown measurement frame",
    "": "variables added to the graph",
}
"""What takes a direction up, by the letter of its variables."""

_GIVEN = {"P": ("target", "targets"), "A": ("anchor", "anchors")}
"""Unknowns whose place may be given, and the key of a job that gives it."""


class Absorbed:
    """What takes each of a problem's lost directions up.

    Args:
        problem: The problem.
        parameters: The parameter vector that the directions were found at.
        directions: One a column, shape (n_robot_columns, n), [m] and [rad].
    """

    def __init__(self, problem: Problem, parameters: Floats, directions: Floats) -> None:
        variables, n = problem.variables, problem.variables.n_robot_columns
        self._columns: dict[str, list[Integers]] = {}
        for v in (*variables.frames, *variables.nuisance):
            letter = "X" if v.kind == "frame" else v.symbol[0] if v.kind == "unknown" else ""
            self._columns.setdefault(letter, []).append(np.arange(v.columns.start, v.columns.stop))
        self._by: list[tuple[str, ...] | None] = [()] * directions.shape[1]
        if not variables.nuisance:
            return  # measurement frames alone: they take up what moves the whole arm as one body, nothing else
        self._A = whitened_jacobian(problem, parameters)
        named = self._A[:, : variables.n_columns] @ variables.tangent_derivative(parameters)[:, :n]
        self._rows = named @ directions
        columns, changes = np.linalg.norm(named, axis=0), np.abs(directions)
        one_by_one = np.maximum(columns @ changes, _NOTHING * columns.max() * changes.max(axis=0))
        self._find(np.linalg.norm(self._rows, axis=0), one_by_one)

    def by(self, k: int) -> tuple[str, ...] | None:
        """Letters of what takes direction k up; none where nothing shows it anyway, None where nothing takes it up."""
        return self._by[k]

    def words(self, k: int) -> str:
        """What takes direction k up, and what would help, in words."""
        letters = self._by[k] or ()
        one = letters in {("O",), ("X",)}
        verb = "takes it up" if one else "take it up together" if len(letters) > 1 else "take it up"
        return f"{' and '.join(_WORDS[letter] for letter in letters)} {verb}{self._help(letters)}"

    def _find(self, size: Floats, one_by_one: Floats) -> None:
        """The fewest kinds of unknowns that each direction is lost by.

        Args:
            size: Length of each direction's rows, shape (n,).
            one_by_one: The same, did its members not cancel each other.
        """
        shown = np.flatnonzero(size > _NOTHING * one_by_one).tolist()
        if not shown:
            return
        lost: dict[tuple[str, ...], Floats] = {}  # what each set of kinds leaves of the directions shown
        every = tuple(self._columns)
        for letters in (every, *chain.from_iterable(combinations(every, r) for r in range(1, len(every)))):
            columns = [c for letter in letters for c in self._columns[letter]]
            lost[letters] = np.linalg.norm(self._left(shown, columns), axis=0)
        for i, k in enumerate(shown):
            most = max(_NOTHING * size[k], _ROUNDING * one_by_one[k], 10.0 * lost[every][i])
            takers = [letters for letters, left in lost.items() if left[i] <= most]
            self._by[k] = min(takers, key=len) if lost[every][i] <= _WEAK * size[k] else None

    def _left(self, directions: Sequence[int], columns: Sequence[Integers]) -> Floats:
        """Rows of directions that unknowns with these columns do not explain, shape (m, n)."""
        A = np.column_stack([self._rows[:, list(directions)], *(self._A[:, c] for c in columns)])
        return eliminate(A, np.zeros(len(A)), len(directions)).A

    def _help(self, letters: tuple[str, ...]) -> str:
        """How many places must be given to see every direction that the same unknowns take up, as well as all would."""
        if len(letters) != 1 or letters[0] not in _GIVEN:
            return ""
        what, key = _GIVEN[letters[0]]
        mine = [k for k, by in enumerate(self._by) if by == letters]
        others = [c for letter, of in self._columns.items() if letter != letters[0] for c in of]
        unknowns = self._columns[letters[0]]

        def seen(n: int) -> tuple[bool, int]:
            """With n places given: whether each direction is seen, and how many of their combinations."""
            left = self._left(mine, others + unknowns[n:]) / np.linalg.norm(self._rows[:, mine], axis=0)
            alone = bool(np.all(np.linalg.norm(left, axis=0) > _NOTHING))
            return alone, int(np.sum(np.linalg.svd(left, compute_uv=False) > _NOTHING))

        best = seen(len(unknowns))
        n = next(n for n in range(1, len(unknowns) + 1) if seen(n) == best)
        which = f"the place of one {what}" if n == 1 else f"the places of {n} {what}s"
        return f": to see it, give {which} (key {key})" if best[0] else ""
