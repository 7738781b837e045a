"""Measurements from arrays: the same as from tables, and every mistake named with array and row."""

from datetime import date

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from fg_calib import InputError, Measurements, Noise, Options, Robot
from fg_calib.io import Units, read_measurements, write_csv
from fg_calib.measurements.dataset import _limit_hint, check_readings

RNG = np.random.default_rng(3)
N = 7
Q = RNG.uniform(-1, 1, (N, 2))
P = RNG.normal(size=(N, 3))
ROTATION = Rotation.from_quat(RNG.normal(size=(N, 4)))
SIDES = ["l"] * 3 + ["r"] * 4
ROBOT = Robot.from_dh([[0.5, 0, 0, 0], [0.3, 1.0, 0, 0]], limits=[[-3, 3], None])


def table():
    """The columns of a table, and the arrays that say the same."""
    roll_pitch_yaw = ROTATION.as_euler("xyz")
    columns = {"q1": Q[:, 0], "q2": Q[:, 1]} | dict(zip("xyz", P.T, strict=True))
    columns |= dict(zip(("roll", "pitch", "yaw"), roll_pitch_yaw.T, strict=True))
    columns |= {"id": [f"p{i}" for i in range(N)], "split": ["train"] * 5 + ["test"] * 2}
    columns |= {"group": ["left", "left", "right", "right", None, "bar", "bar"]}
    columns |= {"sigma_position": np.linspace(1e-4, 2e-4, N), "sigma_point": np.full(N, 1e-5)}
    pairs = {"a": ["p0", "p1", "left", "left"], "b": ["p2", "p6", "right", "bar"], "distance": [0.5, 0.25, 0.1, 0.2]}
    pairs |= {"angle": [1.0, np.nan, np.nan, np.nan], "sigma_distance": [1e-4, 2e-4, 3e-4, 4e-4]}
    arrays = {"position": P, "roll_pitch_yaw": roll_pitch_yaw, "ids": columns["id"], "group": columns["group"]}
    arrays |= {"test": np.arange(N) >= 5, "sigma_position": columns["sigma_position"], "sigma_point": 1e-5}
    arrays |= {"sigma_orientation": 2e-4, "sigma_joint": 1e-5, "pairs": pairs | {"sigma_angle": 3e-4}}
    return columns, pairs, arrays


def same(a, b):
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, tuple) or not hasattr(a, "__dataclass_fields__"):
        return a == b
    return all(same(getattr(a, f), getattr(b, f)) for f in a.__dataclass_fields__ if f != "source")


class Pandas:
    """What is used of a frame of pandas: nan and NaT-like marks for empty cells, `columns` and `to_dict`."""

    class NAType:
        pass

    def __init__(self, columns):
        empty = {"group": self.NAType(), "angle": float("nan")}
        cells = {name: np.asarray(column).tolist() for name, column in columns.items()}
        self._columns = {k: [empty.get(k) if v is None else v for v in column] for k, column in cells.items()}
        self.columns = list(columns)

    def to_dict(self, orient):
        assert orient == "list"
        return self._columns


@pytest.mark.parametrize("frame", ["polars", "lazy", "pandas", "mapping", "arrays", "parquet"])
def test_every_way_in_gives_what_a_csv_gives(tmp_path, frame):
    columns, pairs, arrays = table()
    noise = Noise(orientation=2e-4, joint=1e-5, angle=3e-4)
    empty = {"group": ["" if v is None else v for v in columns["group"]]}
    write_csv(tmp_path / "poses.csv", columns | empty)
    write_csv(tmp_path / "pairs.csv", pairs | {"angle": ["1.0", "", "", ""]})
    of_file = read_measurements(tmp_path / "poses.csv", ROBOT, pairs=tmp_path / "pairs.csv", noise=noise)
    if frame == "arrays":
        found = Measurements.from_arrays(Q, **arrays)
    elif frame == "parquet":
        pl.DataFrame(columns).write_parquet(tmp_path / "poses.parquet")
        pl.DataFrame(pairs).fill_nan(None).write_parquet(tmp_path / "pairs.pq")
        found = read_measurements(tmp_path / "poses.parquet", ROBOT, pairs=tmp_path / "pairs.pq", noise=noise)
    else:
        made = {"polars": pl.DataFrame, "lazy": pl.LazyFrame, "pandas": Pandas, "mapping": dict}[frame]
        found = Measurements.from_frame(made(columns), ROBOT, pairs=made(pairs), noise=noise)
    assert same(found, of_file)


def test_a_frame_has_units_and_its_cells_are_named():
    frame = {"q1": [10.0, 20.0], "q2": [1.0, 2.0], "x": [1.0, np.nan], "y": [1.0, 2.0], "z": [1.0, 2.0]}
    with pytest.raises(InputError, match=r"^frame: row 1: x: found an empty cell, expected .*; delete the row"):
        Measurements.from_frame(frame, ROBOT, units=Units(angle="deg"))
    with pytest.raises(InputError, match=r"^frame: row 0: q1 = 10 rad is outside .*; is it in deg\?$"):
        Measurements.from_frame(frame | {"x": [1.0, 2.0]}, ROBOT)
    found = Measurements.from_frame(frame | {"x": [1.0, 2.0]}, ROBOT, units=Units(angle="deg", length="mm"))
    assert found.readings[1, 0] == pytest.approx(np.deg2rad(20.0), rel=1e-15)
    assert found.position[1, 0] == pytest.approx(2e-3, rel=1e-15)
    for wrong, message in (
        (3, "found a int, expected a path, or a frame"),
        ({}, "a frame without columns"),
        ({"q1": [1.0], "q2": [1.0, 2.0]}, "no table"),
        ({"q1": [1.0]}, "1 joint columns"),
        ({"q1": [True, False], "q2": [0.0, 0.0]}, "q1: type Boolean, expected numbers$"),
        ({"q1": [date(2024, 1, 1)] * 2, "q2": [0.0, 0.0]}, "q1: type Date, expected numbers$"),
    ):
        with pytest.raises(InputError, match=f"^frame: {message}"):
            Measurements.from_frame(wrong, ROBOT)


def test_orientations_in_three_ways():
    ways = [{"rotation": ROTATION.as_matrix()}, {"quaternion": ROTATION.as_quat()}]
    ways.append({"roll_pitch_yaw": ROTATION.as_euler("xyz")})
    for way in ways:
        # Conversions round numbers of size 1 a few times.
        assert Measurements.from_arrays(Q, **way).rotation == pytest.approx(ROTATION.as_matrix(), abs=1e-15)
    rounded = Measurements.from_arrays(Q, rotation=ROTATION.as_matrix().round(5)).rotation
    assert np.swapaxes(rounded, 1, 2) @ rounded == pytest.approx(np.broadcast_to(np.eye(3), (N, 3, 3)), abs=1e-14)
    assert rounded == pytest.approx(ROTATION.as_matrix(), abs=1e-5)


def test_sigmas_are_spread_over_the_rows():
    axes, rows = [1e-3, 2e-3, 3e-3], np.linspace(1, 2, N)
    for given, spread in (
        (1e-3, np.full((N, 3), 1e-3)),
        (axes, np.tile(axes, (N, 1))),
        (rows, np.outer(rows, [1, 1, 1])),
    ):
        assert np.array_equal(Measurements.from_arrays(Q, position=P, sigma_position=given).sigma_position, spread)


@pytest.mark.parametrize(("given", "message"), [
    ({"readings": Q[:, 0]}, r"readings: shape \(7,\), expected \(n, n_joints\)"),
    ({"readings": [[1, 2], [3]]}, r"readings: found \[\[1, 2\], \[3\]\], expected numbers of shape"),
    ({"readings": Q[:0]}, r"readings: shape \(0, 2\), expected .* at least one row"),
    ({"position": P[:5]}, r"position: shape \(5, 3\), expected \(7, 3\)"),
    ({"position": np.where(P == P[4], np.inf, P)}, "position: row 4: found inf, expected a finite"),
    ({"quaternion": np.ones((N, 4))}, "measurements: row 0: quaternion of norm 2, expected 1 within"),
    ({"rotation": np.tile(np.diag([1.0, 1, -1]), (N, 1, 1))}, "rotation: row 0: found .*, expected a rotation"),
    ({"rotation": ROTATION.as_matrix(), "quaternion": ROTATION.as_quat()}, "rotation and quaternion: both"),
    ({"sigma_position": 0.0}, "sigma_position: found 0, expected a number above 0"),
    ({"sigma_position": [1, 2]}, r"sigma_position: shape \(2,\), expected one that broadcasts to \(7, 3\)"),
    ({"sigma_orientation": [1, -1, 1]}, "sigma_orientation: row 1: found -1, expected a number above 0"),
    ({"sigma_joint": -1.0}, "noise: joint: found -1.0, expected a finite number not below 0"),
    ({"sigma_joint": [1.0, 1.0, 1.0]}, "noise: joint: 3 sigmas, expected one value, or 2"),
    ({"test": np.arange(N)}, "test: found .*, expected True or False for each of 7 rows"),
    ({"pairs": {"a": [0], "distance": [1]}}, "pairs: no b, expected a and b"),
    ({"pairs": {"a": [0], "b": [1]}}, "pairs: neither distance nor angle"),
    ({"pairs": {"a": [0], "b": [1], "distanze": [1]}}, "pairs: unknown key 'distanze', .*did you mean distance?"),
    ({"pairs": {"a": [0], "b": [9], "distance": [1]}}, "pairs: row 0: b: found 9, expected an id"),
    ({"pairs": {"a": [0], "b": [1, 2], "distance": [1]}}, r"pairs: a: shape \(1,\), expected \(2,\), one a row"),
    ({"pairs": {"a": [0], "b": [1], "distance": [-1]}}, "pairs: row 0: distance: found -1.0, expected a number not"),
    ({"group": [0] * N, "pairs": {"a": [0], "b": [1], "distance": [1]}},
     "pairs: row 0: a: found 0, expected an id or a group; names of both"),
    ({"group": SIDES, "pairs": {"a": ["l"], "b": ["1"], "distance": [1]}}, "pairs: row 0: b: found '1', exp"),
])  # fmt: skip
def test_mistakes_are_named(given, message):
    with pytest.raises(InputError, match=f"^{message}"):
        Measurements.from_arrays(**{"readings": Q} | given)


def test_what_is_kept_is_read_only_and_nobody_elses():
    position, mask = P.copy(), np.zeros(N, dtype=bool)
    found = Measurements.from_arrays(Q, position=position, test=mask, sigma_position=1e-3)
    position[0], mask[0] = 99.0, True
    assert np.array_equal(found.position, P)
    assert not found.test.any()
    for array in (found.readings, found.position, found.test, found.sigma_position, found.sigma_joint):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_readings_are_those_of_the_robot():
    with pytest.raises(InputError, match=r"^m: readings of 3 joints, expected 2, as robot has$"):
        check_readings(np.zeros((4, 3)), ROBOT, "m")
    with pytest.raises(InputError, match=r"^m: row 1: q1 = 90 rad is outside \[-3, 3\]; is it in deg\?$"):
        check_readings(np.array([[0.0, 0.0], [90.0, 0.0]]), ROBOT, "m")


def test_readings_that_look_like_degrees_are_told(caplog):
    check_readings(np.array([[0.0, 90.0], [1.0, -120.0], [2.0, 45.0]]), ROBOT, "m")
    assert caplog.messages == ["m: most readings of q2 are more than two turns; are they in deg?"]


def test_what_can_be_gone_through_once_is_not_lost_in_a_check():
    rows = [[0.4, 0.3, 0.2, 0.0], [0.3, 0.1, 0.1, 0.0]]
    robot = Robot.from_dh(rows, "dh", fixed=(name for name in ["a1"]), estimate=(name for name in ["tool.x"]))
    estimated = [p.name for p in robot.parameters if p.estimated]
    assert "a1" not in estimated
    assert "tool.x" in estimated
    assert Options.of(prefer=(name for name in ["a1"])).prefer == ("a1",)


@pytest.mark.parametrize("name", ["position", "sigma_position"])
def test_a_masked_array_is_refused(name):
    """Its mask would be lost: what was said not to be measured would be fitted."""
    given = {"position": P, "sigma_position": 1e-3} | {name: np.ma.masked_array(np.ones((7, 3)), np.eye(7, 3))}
    with pytest.raises(InputError, match=f"{name}: found a masked array, expected .*; nan where something was not"):
        Measurements.from_arrays(Q, **given)


def test_three_sigmas_of_three_rows_may_mean_two_things():
    with pytest.raises(InputError, match=r"sigma_position: shape \(3,\) of 3 rows, expected \(3, 1\) for one a row"):
        Measurements.from_arrays(Q[:3], position=P[:3], sigma_position=[1e-3, 2e-3, 3e-3])
    for shape in ((3, 1), (1, 3)):
        sigma = np.reshape([1e-3, 2e-3, 3e-3], shape)
        found = Measurements.from_arrays(Q[:3], position=P[:3], sigma_position=sigma).sigma_position
        assert found.tolist() == np.broadcast_to(sigma, (3, 3)).tolist()


PAIRS = {"a": ["p0", "p1"], "b": ["p2", "p6"], "distance": [0.5, 0.25]}
IDS = [f"p{i}" for i in range(N)]


@pytest.mark.parametrize("make", [pl.DataFrame, pl.LazyFrame, dict])
def test_pairs_may_be_a_frame_and_numbers_in_them_ids_or_row_numbers(make):
    """The latter where ids are words."""
    found = Measurements.from_arrays(Q, ids=IDS, pairs=make(PAIRS)).pairs
    assert (found.a.tolist(), found.b.tolist(), found.distance.tolist()) == ([0, 1], [2, 6], [0.5, 0.25])
    for numbers in ([0, 1], np.array([0, 1]), pl.Series([0, 1])):
        pairs = Measurements.from_arrays(Q, ids=IDS, pairs={"a": numbers, "b": [2, 6], "angle": [0.1, 0.2]}).pairs
        assert (pairs.a.tolist(), pairs.b.tolist()) == ([0, 1], [2, 6])
    for five in (5, "5"):
        pairs = Measurements.from_arrays(Q, ids=np.arange(N) + 5, pairs={"a": [five], "b": [6], "angle": [0.1]}).pairs
        assert pairs.a.tolist() == [0]


COLUMNS = {"q1": Q[:, 0], "q2": Q[:, 1]} | dict(zip("xyz", P.T, strict=True))


def test_frames_of_pandas_with_two_columns_of_a_name_are_refused():
    frame = Pandas(COLUMNS)
    frame.columns.append("x")
    with pytest.raises(InputError, match=r"^frame: two columns called 'x', expected different names$"):
        Measurements.from_frame(frame, ROBOT)


def test_whole_numbers_that_pandas_has_as_floats_are_names():
    numbers = [None, *map(float, range(1, N))]
    frame = pl.DataFrame(COLUMNS | {"id": np.arange(N) * 1.0, "group": numbers})
    found = Measurements.from_frame(frame, ROBOT, noise=Noise(point=1e-4))
    assert found.ids.tolist() == [str(i) for i in range(N)]
    assert found.groups.names == tuple(str(i) for i in range(1, N))
    assert Measurements.from_arrays(Q, group=np.array(numbers, float)).groups.names == found.groups.names


WIDEN = "widen the joint's limits if the reading is right; are the columns in the joints' order?"
TWO = Robot.from_dh(np.zeros((2, 4)), types=["prismatic", "revolute"], limits=[(0.1, 0.9), (-1.2, 2.5)])


@pytest.mark.parametrize(("joint", "unit", "readings", "said"), [
    (0, "m", np.array([150.0, 850.0]), "is it in mm?"),
    (1, "rad", np.rad2deg([-1.1, 2.4]), "is it in deg?"),
    (1, "rad", np.rad2deg([-1.1, 2.6]), WIDEN),
    (1, "rad", np.array([-1.1, 2.63]), WIDEN),  # just past the limit, within it as degrees
    (1, "deg", np.rad2deg([-1.1, 2.4]), WIDEN),
])  # fmt: skip
def test_another_unit_is_suggested_only_where_it_explains_all_rows(joint, unit, readings, said):
    assert _limit_hint(readings, TWO, joint, unit) == said
