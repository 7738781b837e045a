"""Tables of simulated instruments, what a job says of them, and where things truly are, in a file's units."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fg_calib.io.units import Units
from fg_calib.measurements.dataset import Measurements, Pairs
from fg_calib.measurements.table import KnownPoint, Table
from fg_calib.options import PAIR_MODELS, POSE_MODELS, Pairing
from fg_calib.robot.model import Robot
from fg_calib.simulation.configurations import Placement
from fg_calib.simulation.instruments import Plane, Spot
from fg_calib.simulation.scenario import Simulation

Columns = Mapping[str, Any]
Floats = NDArray[np.float64]


def table_files(table: Table) -> tuple[str, ...]:
    """The names of a table's files: its own, and that of its pairs."""
    m, pairs = table.measurements, _pairs(table.measurements)
    return (m.source,) if pairs is None else (m.source, pairs[0].source)


def _pairs(m: Measurements) -> tuple[Pairs, tuple[str, ...]] | None:
    """The pairs of a table and the names of what they are between: configurations, or touched points."""
    if m.pairs is not None:
        return m.pairs, tuple(m.ids.tolist())
    if m.groups is not None and m.groups.pairs.n_pairs:
        return m.groups.pairs, m.groups.names
    return None


def table_columns(table: Table, robot: Robot, units: Units) -> dict[str, Columns]:
    """The columns of each of a table's files.

    Args:
        table: The table.
        robot: The nominal robot.
        units: Of the files.
    """
    m, length = table.measurements, units.factor("m")
    columns: dict[str, Any] = {
        "id": m.ids,
        **{f"q{i + 1}": m.readings[:, i] / units.factor(joint.unit) for i, joint in enumerate(robot.joints)},
    }
    for name, labels in m.labels.items():
        columns[name] = np.array(["", *labels.names])[labels.index + 1]
    if m.groups is not None:
        columns["group"] = np.array(["", *m.groups.names])[m.groups.index + 1]
    if m.position is not None:
        columns |= {axis: m.position[:, k] / length for k, axis in enumerate("xyz")}
    if m.rotation is not None:
        from scipy.spatial.transform import Rotation

        quaternion = Rotation.from_matrix(m.rotation.copy()).as_quat(canonical=True)
        columns |= {f"q{axis}": quaternion[:, k] for k, axis in enumerate("xyzw")}
    if m.length is not None:
        columns["distance"] = m.length / length
    if m.image is not None:
        columns |= {axis: m.image[:, k] for k, axis in enumerate("uv")}
        columns |= {f"corner_{axis}": m.image[:, 2 + k] / length for k, axis in enumerate("xy")}
    for along, sigma, unit in ((SIGMAS, m.sigma_position, "m"), (SIGMAS_OF_TURNS, m.sigma_orientation, "rad")):
        if sigma is not None and _differs(sigma):
            columns |= {name: sigma[:, k] / units.factor(unit) for k, name in enumerate(along)}
    columns["split"] = np.where(m.test, "test", "train")
    found: dict[str, Columns] = {m.source: columns}
    between = _pairs(m)
    if between is not None:
        pairs, names = between
        ends = {end: np.array(names)[getattr(pairs, end)] for end in "ab"}
        measured = {"distance": pairs.distance / length, "angle": pairs.angle / units.factor("rad")}
        found[pairs.source] = ends | {name: v for name, v in measured.items() if np.isfinite(v).any()}
    return found


SIGMAS, SIGMAS_OF_TURNS = ("sigma_x", "sigma_y", "sigma_z"), ("sigma_rx", "sigma_ry", "sigma_rz")
"""Columns of sigmas along axes and about them, where these differ."""

MEASURED = (*"xyz", "qx", "qy", "qz", "qw", "distance", "angle", *"uv")
"""Columns of what is measured."""


def to_fill_in(columns: Columns, *, touched: bool = False) -> Columns:
    """The columns of a table with nothing measured yet.

    Args:
        columns: They.
        touched: Whether something is touched: what is measured are the joint readings then.
    """
    measured = {name: None for name, v in columns.items() if name in MEASURED and np.any(np.asarray(v) != 0.0)}
    joints = {name: None for name in columns if touched and re.fullmatch(r"q\d+", name)}
    return dict(columns) | measured | joints


def is_filled_in(path: Path) -> bool:
    """Whether something was written into a table that was to be filled in; a file that is no such table counts.

    Args:
        path: The file, which need not exist.
    """
    import polars as pl

    if not path.exists():
        return False
    try:
        table = pl.read_csv(path, infer_schema=False)
    except (pl.exceptions.PolarsError, OSError):
        return True
    for of_table in (r"q\d+", "|".join(MEASURED)):
        columns = [c for c in table.columns if re.fullmatch(of_table, c)]
        if columns and all((table[c].is_null() | (table[c] == "")).all() for c in columns):
            return False
    return True


def instrument_keys(tables: Sequence[Table], units: Units) -> dict[str, Any]:
    """What a job says of its tables, and of the points that it knows."""
    found: dict[str, Any] = {"measurements": [_entry(table, units) for table in tables]}
    for table in tables:
        if table.known:
            key = "anchors" if table.model == "anchor" else "targets"
            found[key] = {name: _told(point, units) for name, point in table.known.items()}
    return found


def _entry(table: Table, units: Units) -> dict[str, Any]:
    """A table in the list of a job."""
    m, files = table.measurements, table_files(table)
    entry: dict[str, Any] = {"table": files[0], "model": table.model}
    if len(files) > 1:
        entry["pairs"] = files[1]
    elif table.model in PAIR_MODELS and m.groups is None:
        entry["pairing"] = _pairing(table.pairing)
    if table.model in POSE_MODELS or table.fixed_camera:
        entry["frame"] = table.frame
    if table.offset:
        entry["offset"] = "estimate"
    if table.camera is not None:
        entry["camera"] = asdict(table.camera) | ({"fixed": True} if table.fixed_camera else {})
    entry["noise"] = _noise(m, units)
    return entry


def _noise(m: Measurements, units: Units) -> dict[str, float]:
    """The sigmas of a table: one a kind."""
    between = _pairs(m)
    pairs = None if between is None else between[0]
    stated: dict[str, tuple[Any, str]] = {
        "position": (m.sigma_position, "m"),
        "orientation": (m.sigma_orientation, "rad"),
        "distance": (m.sigma_length if pairs is None else pairs.sigma_distance, "m"),
        "angle": (None if pairs is None else pairs.sigma_angle, "rad"),
        "point": (m.sigma_point, "m"),
    }
    figures = {
        name: units.from_si(float(sigma.flat[0]), unit)
        for name, (sigma, unit) in stated.items()
        if sigma is not None and np.isfinite(sigma).any() and not _differs(sigma)
    }
    return figures if m.sigma_pixel is None else figures | {"pixel": float(m.sigma_pixel[0, 0])}


def _differs(sigma: Floats) -> bool:
    """Whether sigmas are not the same along all axes."""
    return sigma.ndim == 2 and bool(np.any(sigma != sigma[:, :1]))


def _pairing(pairing: Pairing) -> Any:
    random = {"random": pairing.count, "seed": pairing.seed}
    return random if pairing.strategy == "random" else pairing.strategy


def _xyz(point: Floats, units: Units) -> dict[str, float]:
    return {axis: units.from_si(float(v), "m") for axis, v in zip("xyz", point, strict=True)}


def _told(point: KnownPoint, units: Units) -> dict[str, float]:
    tolerance = {} if point.tolerance is None else {"tolerance": units.from_si(point.tolerance, "m")}
    return _xyz(point.xyz, units) | tolerance


def truth_in(simulation: Simulation, units: Units) -> dict[str, Any]:
    """Where things truly are, by kind and name, as a scenario would state them, in a file's units."""
    places = {kind: {name: _place(thing, units) for name, thing in things.items()}
              for kind, things in simulation.truth.items()}  # fmt: skip
    return {"units": asdict(units), **places}


def _place(thing: Any, units: Units) -> Any:
    if isinstance(thing, Placement):
        from scipy.spatial.transform import Rotation

        with warnings.catch_warnings():  # at a pitch of a quarter turn yaw is 0: as good as any
            warnings.simplefilter("ignore")
            angles = Rotation.from_matrix(thing.rotation.copy()).as_euler("xyz")
        turned = {k: units.from_si(float(v), "rad") for k, v in zip(("roll", "pitch", "yaw"), angles, strict=True)}
        return _xyz(thing.position, units) | turned
    if isinstance(thing, Spot):
        return _xyz(thing.xyz, units)
    if isinstance(thing, Plane):
        return {"normal": [float(v) for v in thing.normal], "distance": units.from_si(thing.distance, "m")}
    return units.from_si(float(thing), "m")
