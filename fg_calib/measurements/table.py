"""Tables of measurements as a job has them, and blocks of one kind as estimation takes them."""

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from fg_calib import inputs
from fg_calib.initialization import Camera
from fg_calib.inputs import Booleans, Brief, Floats, InputError, Integers, Model, Pairing, as_floats, listed, shown
from fg_calib.measurements.dataset import Labels, Measurements, Pairs
from fg_calib.measurements.kind import Kind, check_kind
from fg_calib.measurements.landmarks import Landmark, LandmarkKind, Landmarks


class MeasurementBlock(Brief):
    """Measurements of one kind from one table.

    Attributes:
        kind: Kind of measurement.
        table: Which table they are from.
        ends: Configurations of each, rows of that table, shape (n, kind.ends).
        data: Measured values, shape (n, kind.width); any number where not measured.
        sigma: 1 sigma of each row's own noise, shape (n, kind.residual_dim); 0 where measured poses alone say it.
        measured: Which rows were measured, shape (n, kind.residual_dim).
        test: Which are predicted but never fitted, shape (n,).
        number: Number of each in its table, shape (n,).
        nuisances: Coordinates of nuisances that each depends on, in the problem's list, shape (n, kind.n_nuisances).
        formed: Whether they are pairs formed from measured poses, whose noise they have.
        covariance: Of each measurement's own noise, where more than `sigma` was specified, shape (n, kind.residual_dim,
            kind.residual_dim); its diagonal is that of sigma.
        excluded: Measured ones that take no part: masks by reason, shape (n,) each.
        source: File name, for messages.
        of: Name of each, such as its target, anchor or corner; None where the table says nothing of it.
    """

    kind: Kind
    table: int
    ends: Integers
    data: Floats
    sigma: Floats
    measured: Booleans
    test: Booleans
    number: Integers
    nuisances: Integers
    formed: bool = False
    covariance: Floats | None = None
    excluded: dict[str, Booleans] = field(default_factory=dict)
    source: str = "measurements"
    of: Labels | None = None

    @classmethod
    def of_rows(
        cls, kind: Kind, table: int, rows: Integers, data: Floats, sigma: Floats, **more: Any
    ) -> "MeasurementBlock":
        """Measurements all of whose components were measured.

        Args:
            kind: Kind of measurement.
            table: Which table they are from.
            rows: Number of each in the table, shape (n,): its configuration, unless `more` says the ends.
            data: Measured values, shape (n, kind.width).
            sigma: 1 sigma, which broadcasts to (n, kind.residual_dim).
            more: Other fields.
        """
        shape = len(rows), kind.residual_dim
        fields: dict[str, Any] = {"ends": rows[:, None], "measured": np.ones(shape, dtype=np.bool_)}
        fields |= {"nuisances": np.zeros((len(rows), 0), dtype=np.int64), "data": np.ascontiguousarray(data)}
        sigma = sigma if sigma.shape == shape else np.ascontiguousarray(np.broadcast_to(sigma, shape))
        return cls(kind=kind, table=table, sigma=sigma, number=rows, **fields | more)

    @property
    def n(self) -> int:
        """Number of measurements."""
        return len(self.test)

    @property
    def used(self) -> Booleans:
        """Rows that take part in fit or prediction, shape (n, residual_dim)."""
        used = self.measured.copy()
        for mask in self.excluded.values():
            used[mask] = False
        return used

    @property
    def train(self) -> Integers:
        """Measurements with a row to fit."""
        return np.flatnonzero(self.used.any(axis=1) & ~self.test)

    @property
    def fitted(self) -> "MeasurementBlock":
        """The train measurements alone."""
        train = self.train
        return self if len(train) == self.n else self.select(train)

    def select(self, rows: Integers) -> "MeasurementBlock":
        """Some of the measurements."""
        arrays: dict[str, Any] = {name: v[rows] for name, v in vars(self).items() if isinstance(v, np.ndarray)}
        excluded = {reason: mask[rows] for reason, mask in self.excluded.items()}
        return replace(self, **arrays, excluded=excluded, of=None if self.of is None else self.of.of(rows))


UNKNOWN = LandmarkKind(
    "N", "unknown", "Other unknowns, [m] and [rad]", "unknowns of kinds of your own", must_be_fitted=False
)


class CustomMeasurements(Brief):
    """Measurements of a custom kind, at the configurations of a table.

    Attributes:
        kind: Kind of measurement.
        data: Measured values, shape (n, kind.width).
        sigma: 1 sigma of each row, a number or an array that broadcasts to (n, kind.residual_dim).
        ends: Configurations of each, shape (n, kind.ends); the table's, one after the other, if None.
        unknowns: Start of each unknown that the kind depends on, shape (n_unknowns, dimension).
        which: Unknowns of each measurement, shape (n, kind.n_nuisances / dimension); the first for all if None.
        names: Names of the unknowns; their numbers if empty.
        test: Which are predicted but never fitted, shape (n,); none if None.
    """

    kind: Kind
    data: Floats
    sigma: Floats | float
    ends: Integers | None = None
    unknowns: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    which: Integers | None = None
    names: tuple[str, ...] = ()
    test: Booleans | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.kind, Kind):
            raise InputError("own: kind", f"found {shown(self.kind)}", "an object of a class derived from Kind")
        check_kind(self.kind)
        kind, data = self.kind, inputs.as_figures("own: data", self.data, "finite numbers")
        data = as_floats("own: data", data[:, None] if data.ndim == 1 else data, f"(n, {kind.width})")
        starts, names = as_floats("own: unknowns", self.unknowns, "(n, k)"), listed("own: names", self.names)
        if kind.n_nuisances and (not starts.size or kind.n_nuisances % starts.shape[1]):
            expected = f"a start for each unknown; {type(kind).__name__} has {kind.n_nuisances} coordinates of them"
            raise InputError("own: unknowns", f"shape {starts.shape}", expected)
        if names and (len(set(names)) != len(starts) or not all(isinstance(name, str) and name for name in names)):
            raise InputError("own: names", f"found {shown(self.names)}", f"{len(starts)} different words")
        found = {"data": data, "unknowns": starts, "names": names}
        found["sigma"] = inputs.as_sigmas("own: sigma", self.sigma, (len(data), kind.residual_dim))
        if self.test is not None:
            found["test"] = inputs.as_mask("own: test", self.test, len(data))
        for name, most in (("ends", None), ("which", len(starts) - 1)):
            if getattr(self, name) is not None:
                found[name] = inputs.as_indices(f"own: {name}", getattr(self, name), len(data), most)
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def at(self, n_configurations: int) -> Integers:
        """Configurations of each measurement, of so many that the table has, shape (n, ends).

        Raises:
            InputError: The measurements are at configurations that the table has not.
        """
        n = len(self.data)
        ends = np.arange(n_configurations)[:, None] if self.ends is None else self.ends.reshape(n, -1)
        if len(ends) != n or ends.max(initial=0) >= n_configurations:
            found = f"{n} measurements at {len(ends)} configurations" if len(ends) != n else f"found {ends.max()}"
            raise InputError("own: ends", found, f"one a measurement, 0 to {n_configurations - 1}")
        return ends

    def block(self, table: "Table", number: int, landmarks: Landmarks) -> MeasurementBlock:
        """The measurement block of a table.

        Their unknowns are in the frame of the table's measurements: one of the same name in another frame is another.

        Raises:
            InputError: The measurements are at configurations that the table has not.
        """
        m, n = table.measurements, len(self.data)
        fields: dict[str, Any] = {"ends": self.at(m.n_configurations), "source": m.source}
        fields["test"] = np.zeros(n, dtype=np.bool_) if self.test is None else self.test
        if self.kind.n_nuisances:
            names = self.names or tuple(map(str, range(len(self.unknowns))))
            new = [Landmark(UNKNOWN, name, start) for name, start in zip(names, self.unknowns, strict=True)]
            place = landmarks.add(new, m.source, number if table.unknown_frame else -1, named=bool(self.names))
            which = np.zeros((n, 1), dtype=np.int64) if self.which is None else self.which.reshape(n, -1)
            fields["nuisances"] = place[which].reshape(n, -1)
            if len(self.names) > 1 and which.shape[1] == 1:
                fields["of"] = Labels(self.names, which[:, 0])
        return MeasurementBlock.of_rows(self.kind, number, np.arange(n), self.data, np.asarray(self.sigma), **fields)


class KnownPoint(inputs.FrozenArrays):
    """Position of a target on the tool, or of an anchor in the base frame.

    Attributes:
        xyz: Its place, shape (3,), [m].
        tolerance: 1 sigma of that on each axis, [m]; None where it is exact.
    """

    xyz: Floats
    tolerance: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", as_floats("xyz", self.xyz, "(3)"))
        if self.tolerance is not None:
            inputs.check_number("tolerance", self.tolerance, above=True)
        super().__post_init__()


class Table(Brief):
    """A table of measurements, and how it is to be understood.

    Attributes:
        measurements: The measured values.
        model: Which of it takes part; None if only `own` does.
        pairing: How pairs are formed from poses where none were measured directly.
        frame: Whether its measurement frame is known to be the base, or world_T_base is estimated.
        own: Measurements of other kinds at its configurations.
        known: Where targets are on the tool, or anchors in the base frame, by name; the others are estimated.
        offset: Whether the instrument adds something unknown to every length to an anchor.
        camera: The camera that images of a board's points were taken with.
        fixed_camera: Whether that camera stands in the room, and the board is on the tool.
    """

    measurements: Measurements
    model: Model | None = "distance-rotation"
    pairing: Pairing = field(default_factory=Pairing)
    frame: inputs.FrameKnowledge = "known"
    own: tuple[CustomMeasurements, ...] = ()
    known: Mapping[str, KnownPoint] = field(default_factory=dict)
    offset: bool = False
    camera: Camera | None = None
    fixed_camera: bool = False

    def __post_init__(self) -> None:
        inputs.check_fields(self, "table: ")
        object.__setattr__(self, "own", tuple(self.own))
        if self.model is None and self.frame == "unknown":
            expected = "a kind with unknowns of its own for the frame"
            raise InputError("table: frame", "unknown, without a model", expected)

    @property
    def uses_pairs(self) -> bool:
        """Whether its model is one of pairs."""
        return self.model in inputs.PAIR_MODELS

    def by_itself(self) -> "Table":
        """Copy without known places that none of its own rows is of."""
        there = {name for labels in self.measurements.labels.values() for name in labels.names}
        return replace(self, known={name: place for name, place in self.known.items() if name in there})

    def all_train(self) -> "Table":
        """Copy with its test rows as train rows."""
        return self.tested_on(np.zeros(self.measurements.n_configurations, dtype=np.bool_))

    def tested_on(self, configurations: Booleans) -> "Table":
        """Copy with the measurements at some configurations as test rows, all others as train rows.

        Args:
            configurations: True for those, shape (n_configurations,).
        """
        m = self.measurements

        def split(pairs: Pairs, test: Booleans) -> Pairs:
            return replace(pairs, test=test[pairs.a] | test[pairs.b])

        n, changes = len(configurations), dict[str, Any](test=configurations)
        own = tuple(replace(one, test=np.any(configurations[one.at(n)], axis=1)) for one in self.own)
        if m.pairs is not None:
            changes["pairs"] = split(m.pairs, configurations)
        if (groups := m.groups) is not None:
            changes["groups"] = replace(groups, pairs=split(groups.pairs, groups.only_of(configurations)))
        return replace(self, measurements=replace(m, **changes), own=own)

    @property
    def unknown_frame(self) -> bool:
        """Whether its world_T_base is estimated."""
        return self.frame == "unknown" and (self.model in inputs.POSE_MODELS or self.fixed_camera)


Tables = Measurements | Table | Sequence[Measurements | Table]
"""A table, or several; those that are no `Table` are understood as options say."""


def by_station(table: Table) -> tuple[Table, ...]:
    """A table apart by the stations that its rows were measured from: each has a frame, or pairs, of its own.

    A station that rows might have been measured from, but none were, has none.
    """
    m, stations = table.measurements, table.measurements.labels.get("station")
    if stations is None or not (table.unknown_frame or (table.uses_pairs and m.pairs is None)):
        return (table,)
    rest = replace(m, labels={what: of for what, of in m.labels.items() if what != "station"})
    each = [(name, np.flatnonzero(stations.index == k)) for k, name in enumerate(stations.names)]
    parts = [replace(rest.select(r), source=f"{m.source}, station {name}", part=r) for name, r in each if len(r)]
    return tuple(replace(table, measurements=part) for part in parts) or (table,)
