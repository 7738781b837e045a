"""Every scalar residual, train and test, before and after."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.arrays import FrozenArrays, is_one, once
from fg_calib.graph.problem import noises_at
from fg_calib.graph.solver import Solution
from fg_calib.measurements.dataset import Labels
from fg_calib.measurements.kinds import checked_figures
from fg_calib.measurements.series import Series
from fg_calib.statistics.gross_errors import CHANCE, MOST_FEW

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Codes = NDArray[np.int16]
Indices = NDArray[np.int32]


@dataclass(frozen=True)
class RowKind:
    """What a scalar row is of.

    Attributes:
        name: `distance`, `angle`, `position.x`, `orientation.z`, `point.y`, ...
        unit: `m`, `rad` or `px`.
        table: Number of its table.
    """

    name: str
    unit: str
    table: int = 0

    @property
    def family(self) -> str:
        """The kind of noise that it has: `position` of `position.x`."""
        return self.name.partition(".")[0]


@dataclass(frozen=True)
class HeldOut:
    """Measurements of one kind that were predicted and not fitted; RMS of the length of each one's rows.

    Attributes:
        n: Number of measurements.
        before: With the nominal arm, in the kind's unit.
        after: With the calibrated arm.
        noise: Of the noise stated.
        few: Whether they are few for the frame, base or tool that were fitted to them.
        far: Names of the few that are far off beside the others, the farthest first; empty if none is.
        rest: With the calibrated arm, without those.
        by: What arm it was if not the calibrated one: errors of that one say no more than that it was good enough.
    """

    n: int
    before: float
    after: float
    noise: float
    few: bool = False
    far: tuple[str, ...] = ()
    rest: float = np.nan
    by: str = ""


_ROWS_PER_UNKNOWN = 10
"""Rows by which an arm is evaluated, over what was fitted to them, from which on that hardly makes them smaller."""


def pooled(parts: Sequence[HeldOut]) -> HeldOut:
    """Several together."""
    n = np.array([part.n for part in parts])
    near = n - [len(part.far) for part in parts]

    def rms(of: str, n: NDArray[np.int64] = n) -> float:
        return float(np.sqrt(n @ np.array([getattr(part, of) for part in parts]) ** 2 / n.sum()))

    far = tuple(dict.fromkeys(name for part in parts for name in part.far))
    few = any(part.few for part in parts)
    return HeldOut(int(n.sum()), rms("before"), rms("after"), rms("noise"), few, far, rms("rest", near), parts[0].by)


@dataclass(frozen=True)
class ResidualTable(FrozenArrays):
    """Every scalar residual, train and test, before and after, in its kind's unit. Words are codes: a table is long.

    Attributes:
        kinds: What rows are of, by code.
        kind_code: Of each row, shape (n,).
        series: Which of the problem's series each row is of, shape (n,).
        measurement: Number of each row's measurement in its series, shape (n,).
        row: Which of the measurement's rows it is, shape (n,).
        a: The (first) configuration, in `names`, or the (first) unknown where there is none, shape (n,).
        b: The second, -1 where there is none, shape (n,).
        names: Name of each configuration, then of each unknown.
        label_code: What each row is of by name, in `labels`; 0 where its table says nothing of it, shape (n,).
        labels: Names of targets, anchors, planes, boards, corners and touched points by code; the first is empty.
        table_row: Row of its table that each row is from, counted from 0; -1 where it is of a pair, shape (n,).
        test: Predicted only, shape (n,).
        reason_code: Why a row takes no part, in `reasons`; 0 where it does, shape (n,).
        reasons: Reasons by code; the first is empty.
        measured: Measured value; nan where it is no figure of its own, as of orientations, shape (n,).
        before: Residual with the arm at nominal, shape (n,).
        after: Residual at the estimate, shape (n,).
        excess: What noise adds to the measured value on average (see `moments`), at the estimate, shape (n,); the arm's
            own prediction is measured + after - excess.
        sigma: 1 sigma of the residual, shape (n,).
        seen: Which rows are of readings that are fitted too, shape (n,).
        evaluated: Whether these are test rows, all of them, by which the arm was evaluated as it is.
        n_fitted: Of an evaluation: unknowns of frame, base, tool and places that were fitted to them.
    """

    kinds: tuple[RowKind, ...]
    kind_code: Codes
    series: Codes
    measurement: Indices
    row: Codes
    a: Indices
    b: Indices
    names: tuple[str, ...]
    label_code: Indices
    labels: tuple[str, ...]
    table_row: Indices
    test: Booleans
    reason_code: Codes
    reasons: tuple[str, ...]
    measured: Floats
    before: Floats
    after: Floats
    excess: Floats
    sigma: Floats
    seen: Booleans
    evaluated: bool = False
    n_fitted: int = 0

    @property
    def split(self) -> Codes:
        """0 for train, 1 for test, shape (n,)."""
        return (self.test | self.evaluated).astype(np.int16)

    @property
    def n(self) -> int:
        """Number of rows."""
        return len(self.kind_code)

    @property
    def kind(self) -> NDArray[np.str_]:
        """`distance`, `angle`, `position.x`, ... of each row, shape (n,)."""
        return np.array([kind.name for kind in self.kinds] or [""])[self.kind_code]

    @cached_property
    def families(self) -> tuple[str, ...]:
        """Kinds of noise, in the order in which they first stand in the table."""
        return tuple(dict.fromkeys(kind.family for kind in self.kinds))

    @property
    def family(self) -> Codes:
        """Kind of noise of each row, in `families`, shape (n,)."""
        place = {family: i for i, family in enumerate(self.families)}
        codes = [place[kind.family] for kind in self.kinds]
        return np.array(codes or [0], dtype=np.int16)[self.kind_code]

    @cached_property
    def groups(self) -> tuple[tuple[int, str], ...]:
        """Tables and kinds of noise, in the order in which they first stand in the table."""
        return tuple(dict.fromkeys((kind.table, kind.family) for kind in self.kinds))

    @property
    def group(self) -> Codes:
        """Table and kind of noise of each row, in `groups`, shape (n,)."""
        place = {group: i for i, group in enumerate(self.groups)}
        codes = [place[kind.table, kind.family] for kind in self.kinds]
        return np.array(codes or [0], dtype=np.int16)[self.kind_code]

    @property
    def of(self) -> NDArray[np.str_]:
        """What each row is of by name, such as its target, anchor or corner; empty where nothing says, shape (n,)."""
        return np.array(self.labels)[self.label_code]

    @property
    def reason(self) -> NDArray[np.str_]:
        """Why a row takes no part, empty where it does, shape (n,)."""
        return np.array(self.reasons)[self.reason_code]

    @property
    def used(self) -> Booleans:
        """Whether each row was fitted, shape (n,)."""
        used: Booleans = (self.reason_code == 0) & ~self.test
        return used

    def unit(self, family: str) -> str:
        """The unit of a kind of noise, `m`, `rad` or `px`."""
        return next(kind.unit for kind in self.kinds if kind.family == family)

    def rms(self, table: int | None = None) -> dict[str, dict[str, dict[str, float]]]:
        """RMS by split and kind, before and after: of the length of a measurement's rows of that kind.

        Args:
            table: Of which table; of all if None.
        """
        found: dict[str, dict[str, dict[str, float]]] = {"train": {}, "test": {}}
        family, counted = self.family, self.reason_code == 0
        if table is not None:
            counted = counted & np.isin(self.group, [k for k, (number, _) in enumerate(self.groups) if number == table])
        first = self.is_first_of_family()
        for code, split in enumerate(("train", "test")):
            of_split = counted & (self.split == code)
            for k, name in enumerate(self.families):
                rows = of_split & (family == k)
                if rows.any():
                    n = int(np.sum(rows & first))
                    found[split][name] = {
                        when: float(np.sqrt(np.sum(values[rows] ** 2) / n))
                        for when, values in (("before", self.before), ("after", self.after))
                    }
        return found

    def of_configurations(self, held_out: Booleans) -> tuple[NDArray[np.int64], Floats, dict[str, Floats]]:
        """How many rows that count each configuration takes part in, the sum of their squares, and RMS by kind.

        The rows are its train rows, or its test rows where it was held out.

        Args:
            held_out: Which configurations were, shape (n,).

        Returns:
            Rows, shape (n,); sum of squares in sigma, shape (n,); by kind of noise the RMS of the length of a
            measurement's rows at the estimate, shape (n,), nan where there are none.
        """
        counted, first, of_family = self.reason_code == 0, self.is_first_of_family(), self.family

        def summed(values: Callable[[slice], Floats], mine: Booleans = counted) -> Floats:
            def ends(some: slice) -> tuple[Indices, Indices]:
                return self.a[some], self.b[some]

            def of(split: int) -> Floats:
                chosen = mine & (self.split == split)
                return sum_by_end(ends, self.n, len(held_out), lambda some: np.where(chosen[some], values(some), 0.0))

            return np.where(held_out, of(1), of(0)) if held_out.any() else of(0)

        rms = {}
        for k, family in enumerate(self.families):
            mine = counted & (of_family == k)
            squares = summed(lambda some: self.after[some] ** 2, mine)
            with np.errstate(invalid="ignore"):
                rms[family] = np.sqrt(squares / summed(lambda some: first[some].astype(np.float64), mine))
        rows = summed(lambda some: np.ones(len(counted[some]))).astype(np.int64)
        with np.errstate(divide="ignore", invalid="ignore"):  # of rows that have no sigma
            chi2 = summed(lambda some: (self.after[some] / self.sigma[some]) ** 2)
        return rows, chi2, rms

    def held_out(self, labels: Sequence[str]) -> dict[tuple[str, str], HeldOut]:
        """Test rows that count, by table and kind of noise; where there are none there is nothing.

        Rows at readings that are fitted too are none of them: the estimate has seen the arm there.

        Args:
            labels: Of the tables; a single one has none here.
        """
        found, first = {}, self.is_first_of_family()
        for k, (number, family) in enumerate(self.groups):
            rows = (self.reason_code == 0) & (self.split == 1) & ~self.seen & (self.group == k)
            n = int(np.sum(rows & first))
            if n:
                rms = [float(np.sqrt(np.sum(v[rows] ** 2) / n)) for v in (self.before, self.after, self.sigma)]
                few = bool(np.sum(rows) < _ROWS_PER_UNKNOWN * self.n_fitted)
                table = labels[number] if len(labels) > 1 else ""
                far, rest = self._far(np.flatnonzero(rows), first)
                found[table, family] = HeldOut(n, rms[0], rms[1], rms[2], few, far, rest)
        return found

    def _far(self, rows: NDArray[np.int64], first: Booleans) -> tuple[tuple[str, ...], float]:
        """Names of the few measurements that no chance puts as far beyond the median, and RMS of the others.

        Args:
            rows: Of the measurements, all of one kind.
            first: Which rows of the table begin a measurement's.
        """
        begins = np.flatnonzero(first[rows])
        squares, in_sigma = (np.add.reduceat(v[rows] ** 2, begins) for v in (self.after, self.after / self.sigma))
        d = np.diff(np.append(begins, len(rows)))
        n, (degrees, of) = len(d), np.unique(d, return_inverse=True)  # of very many measurements few
        typical = max(float(np.median(in_sigma / special.chdtri(degrees, 0.5)[of])), 1.0)
        far = in_sigma > typical * special.chdtri(degrees, CHANCE / n)[of]
        if not far.any() or np.sum(far) > MOST_FEW * n:
            return (), float(np.sqrt(squares.sum() / n))
        worst = np.flatnonzero(far)[np.argsort(-in_sigma[far], kind="stable")]
        ends = [(self.a[i], self.b[i]) for i in rows[begins[worst]].tolist()]
        names = tuple("-".join(self.names[end] for end in pair if end >= 0) for pair in ends)
        return names, float(np.sqrt(squares[~far].sum() / (n - np.sum(far))))

    def rows_of(self, number: int) -> slice:
        """The rows of a series: those that were measured, one measurement's after the other."""
        first, last = np.searchsorted(self.series, np.array([number, number + 1], dtype=self.series.dtype)).tolist()
        return slice(first, last)

    def without(self, unknown: Booleans) -> ResidualTable:
        """The same where some rows take no part, for nothing determines what they depend on."""
        if not unknown.any():
            return self
        code = np.where(unknown, len(self.reasons), self.reason_code).astype(self.reason_code.dtype)
        return replace(self, reasons=(*self.reasons, "depends on what is not determined"), reason_code=code)

    def is_first_of_family(self) -> Booleans:
        """Rows that begin a measurement's rows of one kind of noise, shape (n,)."""
        change = np.ones(self.n, dtype=np.bool_)
        for code in (self.series, self.measurement, self.family):
            change[1:] &= code[1:] == code[:-1]
        first: Booleans = ~change
        first[:1] = True
        return first


ALARM = 0.01
"""Probability of calling any row of a clean table suspect; any configuration; any joint reading."""


def suspect_level(n: int) -> float:
    """|studentised residual| that the largest of n clean rows exceeds with a probability of `ALARM` (Sidak 1967)."""
    return float(special.ndtri(0.5 + 0.5 * (1.0 - ALARM) ** (1.0 / max(1, n))))


def sum_by_end(
    ends: Callable[[slice], tuple[Indices, Indices]], n_rows: int, n: int, values: Callable[[slice], Floats | None]
) -> Floats:
    """Sum of rows over those that each configuration takes part in, some rows at a time, shape (n,).

    Args:
        ends: The configuration at either end of some rows; below 0, or n and more, for none.
        n_rows: Number of rows.
        n: Number of configurations.
        values: Figures of some rows; None for 1 each.
    """
    total = np.zeros(n)
    for start in range(0, n_rows, _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        figures = values(some)
        for end in ends(some):
            there = (end >= 0) & (end < n)
            total += np.bincount(end[there], None if figures is None else figures[there], n)
    return total


_AT_ONCE = 2**18


def residual_table(solution: Solution) -> ResidualTable:
    """Every scalar residual, train and test, with the arm at nominal and at the estimate."""
    problem = solution.problem
    before = noises_at(problem, solution.before, at_readings=True)
    kinds: dict[RowKind, int] = {}
    reasons, labels = [""], {"": 0}
    columns: list[dict[str, NDArray[Any]]] = []
    for number, (s, old, new) in enumerate(zip(problem.data.series, before, solution.noises, strict=True)):
        names = zip(s.kind.names, s.kind.units, strict=True)
        codes = np.array([kinds.setdefault(RowKind(*name, s.table), len(kinds)) for name in names], dtype=np.int16)
        excluded = np.zeros(s.n, dtype=np.int16)
        for reason, mask in s.excluded.items():
            reasons += [] if reason in reasons else [reason]
            excluded[mask] = reasons.index(reason)
        rows = _MeasuredRows(s.measured)
        place = problem.data.places[s.table]
        a, b = _ends(place[s.ends], problem.data.unknowns.owners[s.nuisances], problem.data.n_configurations)
        after, excess, sigma = new.figures()
        columns.append(
            {
                "kind_code": rows.of_each(codes),
                "series": np.full(rows.n, number, dtype=np.int16),
                "measurement": rows.of_measurements(np.arange(s.n, dtype=np.int32)),
                "row": rows.of_each(np.arange(s.kind.residual_dim, dtype=np.int16)),
                "a": rows.of_measurements(a),
                "b": rows.of_measurements(b),
                "label_code": rows.of_measurements(_codes(s.of, labels, s.n)),
                "table_row": rows.of_measurements(
                    _table_rows(s, problem.data.tables[s.table].measurements.part),
                ),
                "test": rows.of_measurements(s.test),
                "reason_code": rows.of_measurements(excluded),
                "measured": rows.of(checked_figures(s.kind, s.data, s.source)),
                "before": rows.of(old.residual()),
                "after": rows.of(after),
                "excess": rows.of(excess),
                "sigma": rows.of(sigma),
            }
        )
    called = list(columns[0])
    together = {name: _joined([c.pop(name) for c in columns]) for name in called}  # never all twice
    return ResidualTable(
        kinds=tuple(kinds),
        names=problem.data.names,
        labels=tuple(labels),
        reasons=tuple(reasons),
        seen=_seen(problem.data.readings, together) & (not problem.evaluated),
        evaluated=problem.evaluated,
        n_fitted=len(problem.variables.all_scales) if problem.evaluated else 0,
        **together,
    )


class _MeasuredRows:
    """The scalar rows of a series that were measured, one measurement's after the other.

    Args:
        measured: Which were, shape (n_measurements, residual_dim).
    """

    def __init__(self, measured: Booleans) -> None:
        self._measured = None if measured.all() else measured
        self._shape = measured.shape
        self._counts = self._shape[1] if self._measured is None else np.sum(measured, axis=1)
        self.n = measured.size if self._measured is None else int(np.sum(measured))

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """Those of figures of all rows, shape (n_measurements, residual_dim)."""
        return values.reshape(-1) if self._measured is None else values[self._measured]

    def of_each(self, values: NDArray[Any]) -> NDArray[Any]:
        """Figures that are the same of every measurement, shape (residual_dim,)."""
        return self.of(np.broadcast_to(values, self._shape))

    def of_measurements(self, values: NDArray[Any]) -> NDArray[Any]:
        """Figures that all rows of a measurement share, shape (n_measurements,)."""
        values = once(values)
        return np.broadcast_to(values[:1], self.n) if is_one(values) else np.repeat(values, self._counts)


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Values of all series, one figure in memory where all are the same."""
    return once(parts[0] if len(parts) == 1 else np.concatenate(parts))


def _seen(readings: Floats, rows: dict[str, NDArray[Any]]) -> Booleans:
    """Which rows are of readings, at both ends, at which rows are fitted, shape (n,)."""
    n, place = len(readings), same_readings(readings)
    counts = (rows["reason_code"] == 0) & ~rows["test"]
    ends = [np.where((end >= 0) & (end < n), end, n) for end in (rows["a"], rows["b"])]
    place = np.append(place, n)
    at = np.zeros(n + 1, dtype=np.bool_)
    for end in ends:
        at[place[end[counts]]] = True
    at[n] = False
    fitted = at[place]
    there = [end < n for end in ends]
    known = [~is_there | fitted[end] for end, is_there in zip(ends, there, strict=True)]
    return known[0] & known[1] & (there[0] | there[1])


DIGITS = 9
"""Decimals of readings, [rad] or [m], that tell configurations apart."""


def same_readings(readings: Floats) -> NDArray[np.int64]:
    """A number for each configuration, the same for equal readings, shape (n,)."""
    place: NDArray[np.int64] = np.unique(np.round(readings, DIGITS), axis=0, return_inverse=True)[1]
    return place.ravel()


def _codes(of: Labels | None, codes: dict[str, int], n: int) -> Indices:
    """What each of n measurements is of, as codes; names that have none yet get one."""
    if of is None:
        return np.zeros(n, dtype=np.int32)
    known = [codes.setdefault(name, len(codes)) for name in of.names]
    return np.array([*known, 0], dtype=np.int32)[of.index]  # -1, no name, is the last


def _table_rows(series: Series, part: NDArray[np.int64] | None) -> Indices:
    """Row of its table that each measurement is from, -1 where it is from none or two.

    Args:
        series: The measurements.
        part: Which rows of a table theirs is made of; all if None.
    """
    if series.kind.ends != 1:
        return np.full(series.n, -1, dtype=np.int32)
    rows = series.ends[:, 0]
    return (rows if part is None else part[rows]).astype(np.int32)


def _ends(ends: NDArray[np.int64], unknowns: NDArray[np.int64], n: int) -> tuple[Indices, Indices]:
    """What each measurement is between: configurations, or unknowns (counted on from n) where it has none.

    Args:
        ends: Configurations of each, shape (n_measurements, ends).
        unknowns: Unknown of each nuisance coordinate, shape (n_measurements, n_nuisances).
        n: Number of configurations.
    """
    first = np.flatnonzero(np.diff(unknowns[:1], prepend=-1)[0]) if len(unknowns) else np.zeros(0, dtype=np.int64)
    who = ends if ends.shape[1] else n + unknowns[:, first]
    nothing = np.full(len(who), -1, dtype=np.int32)
    a = who[:, 0].astype(np.int32) if who.shape[1] > 0 else nothing
    b = who[:, 1].astype(np.int32) if who.shape[1] > 1 else nothing
    return a, b
