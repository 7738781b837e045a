"""Every scalar residual, train and test, before and after."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.graph import Solution, noises_at
from fg_calib.inputs import Booleans, Figure, Floats, FrozenArrays, Integers, Record
from fg_calib.measurements import Labels, MeasurementBlock

T = TypeVar("T")
Codes = NDArray[np.int16]
Indices = NDArray[np.int32]

ALARM = 0.01
"""Probability of calling any row of a clean table suspect; any configuration; any joint reading."""

CHANCE = 1e-4
"""Probability below which an outlier is not by chance."""

MAX_OUTLIER_SHARE = 0.2
"""Share of measurements above which they are not outliers."""

ROWS_PER_FITTED = 10
"""Rows by which an arm is evaluated, over what was fitted to them, from which on that hardly makes them smaller."""

READING_DECIMALS = 9
"""Decimals of readings, [rad] or [m], that distinguish configurations."""


def suspect_level(n: int, alarm: float = ALARM) -> float:
    """|studentised residual| that the largest of n clean rows exceeds with a probability (Sidak 1967)."""
    return float(special.ndtri(0.5 + 0.5 * (1.0 - alarm) ** (1.0 / max(1, n))))


class RowKind(Record):
    """The quantity that a scalar row is one component of.

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


class HeldOut(Record):
    """Measurements of one kind that were predicted and not fitted; RMS of the length of each one's rows.

    Attributes:
        table: Name of their table; empty where there is one alone.
        kind: Kind of noise.
        n: Number of measurements.
        before: With the nominal arm, in the kind's unit.
        after: With the calibrated arm.
        noise: Of the noise as specified.
        few: Whether they are few for the frame, base or tool that were fitted to them.
        by: Which arm predicted them if not the calibrated one, whose errors are at most as large.
        outliers: Names of those that are too large.
    """

    table: str
    kind: str
    n: int
    before: Figure
    after: Figure
    noise: Figure
    few: bool = False
    by: str = ""
    outliers: tuple[str, ...] = ()


def pooled(parts: Sequence[HeldOut], table: str = "") -> HeldOut:
    """Several groups of measurements of one kind together, under the name of one table."""
    n, names = np.array([part.n for part in parts]), ("before", "after", "noise")
    squares = n @ np.array([[getattr(part, name) ** 2 for name in names] for part in parts]) / n.sum()
    rms = dict(zip(names, np.sqrt(squares).tolist(), strict=True))
    outliers = tuple(name for part in parts for name in part.outliers)
    return replace(parts[0], table=table, n=int(n.sum()), few=any(part.few for part in parts), outliers=outliers, **rms)


class ResidualTable(FrozenArrays):
    """Every scalar residual, train and test, before and after, in its kind's unit. Words are codes: a table is long.

    Attributes:
        kinds: Kinds of rows, by code.
        kind_code: Of each row, shape (n,).
        block: Which of the problem's blocks each row is of, shape (n,).
        measurement: Number of each row's measurement in its block, shape (n,).
        row: Which of the measurement's rows it is, shape (n,).
        a: The (first) configuration, in `names`, or the (first) landmark where there is none, shape (n,).
        b: The second, -1 where there is none, shape (n,).
        names: Name of each configuration, then of each landmark.
        label_code: Label of each row, in `labels`; 0 where its table does not say, shape (n,).
        labels: Names of targets, anchors, planes, boards, corners and contact points by code; the first is empty.
        table_row: Row of its table that each row is from, counted from 0; -1 where it is of a pair, shape (n,).
        test: Predicted only, shape (n,).
        reason_code: Why a row takes no part, in `reasons`; 0 where it does, shape (n,).
        reasons: Reasons by code; the first is empty.
        measured: Measured value; nan where it is no figure of its own, as of orientations, shape (n,).
        before: Residual with the arm at nominal, shape (n,).
        after: Residual at the estimate, shape (n,).
        excess: Bias of the measured value by noise (see `moments`), at the estimate, shape (n,); the arm's
            own prediction is measured + after - excess.
        sigma: 1 sigma of the residual, shape (n,).
        seen: Which rows are at readings that are fitted too, shape (n,).
        evaluated: Whether these are test rows, all of them, by which the arm was evaluated as it is.
        n_fitted: Of an evaluation: number of coordinates of frame, base, tool and landmarks that were fitted to them.
    """

    kinds: tuple[RowKind, ...]
    kind_code: Codes
    block: Codes
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

    @cached_property
    def families(self) -> tuple[str, ...]:
        """Kinds of noise, in the order in which they first stand in the table."""
        return tuple(dict.fromkeys(kind.family for kind in self.kinds))

    @property
    def family(self) -> Codes:
        """Kind of noise of each row, in `families`, shape (n,)."""
        return self._coded([self.families.index(kind.family) for kind in self.kinds])

    @cached_property
    def groups(self) -> tuple[tuple[int, str], ...]:
        """Tables and kinds of noise, in the order in which they first stand in the table."""
        return tuple(dict.fromkeys((kind.table, kind.family) for kind in self.kinds))

    @property
    def group(self) -> Codes:
        """Table and kind of noise of each row, in `groups`, shape (n,)."""
        return self._coded([self.groups.index((kind.table, kind.family)) for kind in self.kinds])

    def _coded(self, of_kinds: list[int]) -> Codes:
        return np.array(of_kinds or [0], dtype=np.int16)[self.kind_code]

    @property
    def used(self) -> Booleans:
        """Whether each row was fitted, shape (n,)."""
        return (self.reason_code == 0) & ~self.test

    def unit(self, family: str) -> str:
        """The unit of a kind of noise, `m`, `rad` or `px`."""
        return next(kind.unit for kind in self.kinds if kind.family == family)

    @property
    def measurement_number(self) -> Integers:
        """A number for the measurement of each row, the same for all its rows, shape (n,)."""
        return self.block.astype(np.int64) * 2**32 + self.measurement

    @cached_property
    def begins(self) -> Booleans:
        """Rows that begin a measurement's rows of one kind of noise, shape (n,)."""
        begins = np.ones(self.n, dtype=np.bool_)
        begins[1:] = np.any([key[1:] != key[:-1] for key in (self.block, self.measurement, self.family)], axis=0)
        begins.flags.writeable = False
        return begins

    def sum_by_end(self, values: Floats | Booleans, rows: Integers | slice = slice(None)) -> Floats:
        """Sum of the values of the rows that each configuration or landmark, in `names`, takes part in.

        Args:
            values: Of some rows, shape (m,).
            rows: Which ones they are, shape (m,); all by default.
        """
        of_ends = [np.bincount(end[rows] + 1, values, len(self.names) + 1)[1:] for end in (self.a, self.b)]
        return np.asarray(np.sum(of_ends, axis=0), dtype=np.float64)

    def rms(self, table: int | None = None) -> dict[str, dict[str, dict[str, float]]]:
        """RMS by split and kind, before and after: see `by_kind`."""
        return self.by_kind(root_mean_square, table)

    def by_kind(self, figure: Callable[[Floats], T], table: int | None = None) -> dict[str, dict[str, dict[str, T]]]:
        """A figure of the lengths of the measurements' rows by split and kind, before and after.

        Args:
            figure: From lengths, shape (m,), in the kind's unit.
            table: Of which table; of all if None.
        """
        counted, found = self.reason_code == 0, dict[str, dict[str, dict[str, T]]](train={}, test={})
        if table is not None:
            counted = counted & (self._coded([kind.table for kind in self.kinds]) == table)
        for code, of_split in enumerate(found.values()):
            for k, name in enumerate(self.families):
                rows = np.flatnonzero(counted & (self.split == code) & (self.family == k))
                if len(rows):
                    both = {"before": self.before, "after": self.after}
                    of_split[name] = {when: figure(self._lengths(rows, v)) for when, v in both.items()}
        return found

    def _lengths(self, rows: Integers, values: Floats) -> Floats:
        """Length of the rows of each measurement of one kind, shape (m,)."""
        return np.sqrt(np.add.reduceat(values[rows] ** 2, np.flatnonzero(self.begins[rows])))

    def of_configurations(self, held_out: Booleans) -> tuple[Integers, Floats, dict[str, Floats]]:
        """How many rows that count each configuration takes part in, the sum of their squares, and RMS by kind.

        The rows are its train rows, or its test rows where it was held out.

        Args:
            held_out: Which configurations were, shape (n,).

        Returns:
            Rows, shape (n,); sum of squares in sigma, shape (n,); by kind of noise the RMS of the length of a
            measurement's rows at the estimate, shape (n,), nan where there are none.
        """
        mine = [(self.reason_code == 0) & (self.split == code) for code in (0, 1)]

        def total(values: Floats | Booleans) -> Floats:
            train, test = (self.sum_by_end(np.where(rows, values, 0.0))[: len(held_out)] for rows in mine)
            return np.where(held_out, test, train)

        with np.errstate(divide="ignore", invalid="ignore"):  # of rows that have no sigma
            rms = {
                name: np.sqrt(total((self.family == k) * self.after**2) / total((self.family == k) & self.begins))
                for k, name in enumerate(self.families)
            }
            return total(self.reason_code == 0).astype(np.int64), total((self.after / self.sigma) ** 2), rms

    def named(self, rows: Integers) -> tuple[str, ...]:
        """Names of measurements by what they are between: one that is an end of several is named in their place.

        Args:
            rows: Rows of theirs, shape (m,).
        """
        names, found = ("", *self.names), dict[str, None]()
        ends = dict.fromkeys((names[self.a[i] + 1], names[self.b[i] + 1]) for i in rows)
        count = Counter(name for both in ends for name in both if name)
        for both in ends:
            worst = max(filter(None, both), key=lambda name: count[name])
            found[worst if count[worst] > 1 else " and ".join(filter(None, both))] = None
        return tuple(found)

    def held_out(self, labels: Sequence[str], suspect: Booleans | None = None) -> tuple[HeldOut, ...]:
        """Test rows that count, by table and kind of noise; rows at readings that are fitted too are left out.

        Args:
            labels: Of the tables; a single one has none here.
            suspect: Rows that are too large, shape (n,), to be named.
        """
        found, counted = [], (self.reason_code == 0) & (self.split == 1) & ~self.seen
        for k, (number, family) in enumerate(self.groups):
            rows = np.flatnonzero(counted & (self.group == k))
            if len(rows):
                table, few = labels[number] if len(labels) > 1 else "", len(rows) < ROWS_PER_FITTED * self.n_fitted
                sizes = (self._lengths(rows, v) for v in (self.before, self.after, self.sigma))
                before, after, noise = map(root_mean_square, sizes)
                wrong = self.named(rows[:0] if suspect is None else rows[suspect[rows]])
                n = int(np.sum(self.begins[rows]))
                found.append(HeldOut(table, family, n, before, after, noise, few, outliers=wrong))
        return tuple(found)

    def rows_of(self, number: int) -> slice:
        """The rows of a block: those that were measured, one measurement's after the other."""
        first, last = np.searchsorted(self.block, np.array([number, number + 1], dtype=self.block.dtype)).tolist()
        return slice(first, last)

    def without(self, unknown: Booleans) -> "ResidualTable":
        """The table with some rows taking no part, for nothing determines what they depend on."""
        if not unknown.any():
            return self
        code = np.where(unknown, len(self.reasons), self.reason_code).astype(self.reason_code.dtype)
        return replace(self, reasons=(*self.reasons, "depends on what is not determined"), reason_code=code)


def root_mean_square(lengths: Floats) -> float:
    """Root mean square of lengths, shape (m,)."""
    return float(np.sqrt(np.mean(lengths**2)))


def residual_table(solution: Solution) -> ResidualTable:
    """Every scalar residual, train and test, with the arm at nominal and at the estimate."""
    problem, data = solution.problem, solution.problem.data
    before = [noise.residual() for noise in noises_at(problem, solution.before)]
    kinds: dict[RowKind, int] = {}
    reasons, labels = {"": 0}, {"": 0}
    columns = list[dict[str, Any]]()
    for number, (s, old, new) in enumerate(zip(data.blocks, before, solution.noises, strict=True)):
        names = zip(s.kind.names, s.kind.units, strict=True)
        codes = np.array([kinds.setdefault(RowKind(*name, s.table), len(kinds)) for name in names], dtype=np.int16)
        excluded = np.zeros(s.n, dtype=np.int16)
        for reason, mask in s.excluded.items():
            excluded[mask] = reasons.setdefault(reason, len(reasons))
        m, k = (index.astype(np.int32) for index in np.nonzero(s.measured))  # measurement and component of each row
        a, b = _ends(data.places[s.table][s.ends], data.landmarks.owners[s.nuisances], data.n_configurations)
        which = {"kind_code": codes[k], "block": np.full(len(m), number, dtype=np.int16), "measurement": m}
        labelled = {"a": a[m], "b": b[m], "label_code": _codes(s.of, labels, s.n)[m]}
        table_row = _table_rows(s, data.tables[s.table].measurements.part)[m]
        rows = {"row": k.astype(np.int16), "table_row": table_row, "test": s.test[m], "reason_code": excluded[m]}
        values = {"measured": s.kind.figures(s.data)[m, k], "before": old[m, k], "after": new.residual()[m, k]}
        noise = {"excess": new.excess[m, k], "sigma": new.sigma[m, k]}
        columns.append({**which, **labelled, **rows, **values, **noise})
    together = {name: np.concatenate([c.pop(name) for c in columns]) for name in list(columns[0])}  # never all twice
    seen = _at_fitted_readings(data.readings, together) & (not problem.evaluated)
    found: dict[str, Any] = {"kinds": tuple(kinds), "labels": tuple(labels), "reasons": tuple(reasons), **together}
    evaluated, n_fitted = problem.evaluated, len(problem.variables.all_scales) if problem.evaluated else 0
    return ResidualTable(names=data.names, seen=seen, evaluated=evaluated, n_fitted=n_fitted, **found)


def _at_fitted_readings(readings: Floats, rows: dict[str, NDArray[Any]]) -> Booleans:
    """Which rows are of readings, at both ends, at which rows are fitted, shape (n,)."""
    n, fitted = len(readings), (rows["reason_code"] == 0) & ~rows["test"]
    place = np.append(same_readings(readings), n).astype(np.int32)  # the last is of no configuration
    a, b = (place[np.minimum(rows[end], n)] for end in ("a", "b"))
    has_fitted = np.bincount(np.concatenate([a[fitted], b[fitted], [n]]), minlength=n + 1) > 0
    return np.asarray(has_fitted[a] & has_fitted[b] & (np.minimum(a, b) < n))


def same_readings(readings: Floats) -> Integers:
    """A number for each configuration, the same for equal readings, shape (n,)."""
    return np.unique(np.round(readings, READING_DECIMALS), axis=0, return_inverse=True)[1].ravel()


def _codes(of: Labels | None, codes: dict[str, int], n: int) -> Indices:
    """Name of each of n measurements as a code; names that have none yet get one."""
    if of is None:
        return np.zeros(n, dtype=np.int32)
    known = [codes.setdefault(name, len(codes)) for name in of.names]
    return np.array([*known, 0], dtype=np.int32)[of.index]  # -1, no name, is the last


def _table_rows(block: MeasurementBlock, part: Integers | None) -> Indices:
    """Row of its table that each measurement is from, -1 where it is from none or two.

    Args:
        block: The measurements.
        part: Which rows of a table theirs is made of; all if None.
    """
    if block.kind.ends != 1:
        return np.full(block.n, -1, dtype=np.int32)
    rows = block.ends[:, 0]
    return (rows if part is None else part[rows]).astype(np.int32)


def _ends(ends: Integers, landmarks: Integers, n: int) -> tuple[Indices, Indices]:
    """Ends of each measurement: configurations, or landmarks (counted on from n) where it has none.

    Args:
        ends: Configurations of each, shape (n_measurements, ends).
        landmarks: Landmark of each nuisance coordinate, shape (n_measurements, n_nuisances).
        n: Number of configurations.
    """
    first = np.flatnonzero(np.diff(landmarks[:1], prepend=-1)[0]) if len(landmarks) else np.zeros(0, dtype=np.int64)
    both = ends if ends.shape[1] else n + landmarks[:, first]
    a, b = np.hstack([both, np.full((len(both), 2), -1)])[:, :2].T.astype(np.int32)
    return a, b
