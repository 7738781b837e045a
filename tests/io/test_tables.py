"""Tables of configurations and pairs: what is read from CSV and Parquet, and one message a mistake."""

import math

import numpy as np
import polars as pl
import pytest
from oracle import frame
from refusals import refusal
from tolerances import rounding

from fg_calib import Noise
from fg_calib.io import Column, Units, read_measurements
from fg_calib.robot import Joint, RobotBuilder

LIMIT = 2.09


def arm(*joints):
    builder = RobotBuilder("arm", "dh")
    for joint in joints:
        builder.add_convention_joint(joint, dict.fromkeys(("theta", "d", "a", "alpha"), 0.0))
    return builder.build()


ARM = arm(Joint("q1", lower=-LIMIT, upper=LIMIT), Joint("q2"), Joint("lift", prismatic=True, lower=0.0, upper=0.5))

POSES = """\
q1,q2,q3,id,x,y,z,qx,qy,qz,qw,split,note
0.1,0.2,0.3,p1,1,2,3,0,0,0,1,train,first
1e-3,-0.2,0.1,p2,1.5,2,3,1,0,0,0,,
 0.5 ,0,0,p3,-1,2,3,0,0.6,0,0.8,test,
"""
PAIRS = """\
a,b,distance,angle,sigma_distance,split
p1,p2,0.5,,0.01,
p2,p1,,3.1,,
p1,p3,0.1,0.2,,train
p2,p1,0.1,,,test
"""


@pytest.fixture
def write(tmp_path):
    """Write a table: text as CSV, or columns as Parquet."""

    def write(content, name="poses.csv"):
        path = tmp_path / name
        if isinstance(content, dict):
            pl.DataFrame(content).write_parquet(path)
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def test_poses_and_configurations_are_read_in_order(write):
    m = read_measurements(write(POSES), ARM)
    assert m.readings.tolist() == [[0.1, 0.2, 0.3], [1e-3, -0.2, 0.1], [0.5, 0.0, 0.0]]
    assert m.ids.tolist() == ["p1", "p2", "p3"]
    assert m.test.tolist() == [False, False, True]
    assert m.position.tolist() == [[1, 2, 3], [1.5, 2, 3], [-1, 2, 3]]
    assert m.rotation[0] == pytest.approx(np.eye(3))
    assert m.rotation[1] == pytest.approx(np.diag([1, -1, -1]))
    assert m.rotation[2] == pytest.approx(frame(0, 0, 0, 0, 2 * math.atan2(0.6, 0.8), 0)[:3, :3])
    assert (m.sigma_position, m.sigma_orientation, m.pairs) == (None, None, None)
    assert m.sigma_joint.tolist() == [0.0, 0.0, 0.0]
    assert m.source == "poses.csv"


def test_units_are_converted_to_si(write):
    header = "q1,q2,q3,x,y,z,roll,pitch,yaw,sigma_position,sigma_rx,sigma_ry,sigma_rz"
    path = write(f"{header}\n90,-90,250,1,2,3,10,20,30,5,1,2,3\n")
    m = read_measurements(path, ARM, units=Units(length="mm", angle="deg"))
    assert m.readings[0] == pytest.approx([math.pi / 2, -math.pi / 2, 0.25])
    assert m.position[0] == pytest.approx([1e-3, 2e-3, 3e-3])
    assert m.rotation[0] == pytest.approx(frame(0, 0, 0, *np.radians([10, 20, 30]))[:3, :3])
    assert m.sigma_position[0] == pytest.approx([5e-3, 5e-3, 5e-3])
    assert m.sigma_orientation[0] == pytest.approx(np.radians([1, 2, 3]))


def test_noise_fills_what_the_table_does_not_state(write):
    noise = Noise(position=0.1, orientation=0.2, joint=(1e-3, 2e-3, 3e-3))
    m = read_measurements(write(POSES), ARM, noise=noise)
    assert m.sigma_position == pytest.approx(np.full((3, 3), 0.1))
    assert m.sigma_orientation == pytest.approx(np.full((3, 3), 0.2))
    assert m.sigma_joint.tolist() == [1e-3, 2e-3, 3e-3]
    table = "q1,q2,q3,x,y,z,sigma_x,sigma_y,sigma_z\n0,0,0,0,0,0,1,,3\n"
    m = read_measurements(write(table), ARM, noise=Noise(position=0.1, joint=0.5), units=Units(length="mm"))
    assert m.sigma_position.tolist() == [[0.001, 0.1, 0.003]]
    assert m.sigma_joint.tolist() == [0.5, 0.5, 0.5]
    assert (m.rotation, m.sigma_orientation) == (None, None)


def test_columns_may_bear_the_joints_names_in_any_order(write):
    robot = arm(Joint("base_yaw"), Joint("q1"))
    m = read_measurements(write("q1,base_yaw\n1,2\n"), robot)
    assert m.readings.tolist() == [[2, 1]]
    m = read_measurements(write("q2,q1\n1,2\n"), robot)
    assert m.readings.tolist() == [[2, 1]]
    said = "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are x, y"
    robot = arm(Joint("x"), Joint("y"))  # which are the tool's position
    assert refusal(read_measurements, write("x,y\n1,2\n"), robot) == said


@pytest.mark.parametrize("ends", ["\n\n\n", "\r\n\n", "\n\r\n", "\n\n\r", "\r\r\n", "\r\r\r"], ids=repr)
def test_no_row_is_lost_to_a_mixture_of_line_ends(write, ends):
    text = "".join(line + end for line, end in zip(("q1,q2,q3,note", "0.1,0,0,", "0.2,0,0,"), ends, strict=True))
    assert read_measurements(write(text), ARM).readings[:, 0].tolist() == [0.1, 0.2]
    assert read_measurements(write(text.replace("\r", "\r\r\n")), ARM).readings[:, 0].tolist() == [0.1, 0.2]


SPREADSHEET = """\
id;q1;q2;q3;x;y;z;roll;pitch;yaw
p1;0,1;-0,25;1e-1;1,5;2;3;0;0;0
"a;b";,5;1;0;1.5;2,;3;0;0;0
"""


@pytest.mark.parametrize("separator", [";", "\t"])
def test_cells_may_have_semicolons_or_tabs_between_and_numbers_decimal_commas(write, separator):
    """As spreadsheets write them where the comma is the decimal point."""
    text = SPREADSHEET.replace('"a;b"', "a,b").replace(";", separator)
    found = read_measurements(write(text), ARM)
    assert found.readings.tolist() == [[0.1, -0.25, 0.1], [0.5, 1.0, 0.0]]
    assert found.position.tolist() == [[1.5, 2.0, 3.0], [1.5, 2.0, 3.0]]
    assert found.ids.tolist() == ["p1", "a,b"]
    assert read_measurements(write(SPREADSHEET), ARM).ids.tolist() == ["p1", "a;b"]


OWN = {
    "q1": Column(name="J1 [counts]", scale=0.001, zero=32768),
    "q2": Column(name=" A2 "),
    "q3": Column(name="lift axis"),
}


def test_columns_have_names_of_their_own_and_figures_their_scale(write):
    """Counts of an encoder, whose zero and size the user knows; a column that a name would have meant is not used."""
    text = "J1 [counts],A2,lift axis,x,y,z,X\n33268,0.2,0.1,1,2,3,9\n32768,0.3,0.2,4,5,6,8\n"
    found = read_measurements(write(text), ARM, columns=OWN | {"x": Column(name="X", scale=-2.0)})
    exact = rounding(np.array([[0.5, 0.2, 0.1], [0.0, 0.3, 0.2]]))
    np.testing.assert_allclose(found.readings, [[0.5, 0.2, 0.1], [0.0, 0.3, 0.2]], rtol=0, atol=exact)
    assert found.position.tolist() == [[-18.0, 2.0, 3.0], [-16.0, 5.0, 6.0]]
    table = {"J1 [counts]": [33268, 32768], "A2": [0.2, 0.3], "lift axis": [0.1, 0.2]}
    for source in (write(table, "poses.parquet"), table):
        assert read_measurements(source, ARM, columns=OWN).readings.tolist() == found.readings.tolist()


def test_columns_of_no_use_and_rows_that_take_no_part_are_reported(write, caplog):
    path = write("q1,q2,q3,anchor,distance,station,board\n0.1,0,0,a,1,s,b\n0.2,0,0,a,,s,b\n")
    read_measurements(path, ARM, model="anchor")
    unused, missing = caplog.messages
    assert unused == "poses.csv: of no use to model anchor: column station, board"
    assert missing == "poses.csv: 1 of 2 rows have no distance and take no part"
    assert read_measurements(path, ARM, model="distance").labels["station"].names == ("s",)


def test_pairs_name_configurations_by_id(write):
    noise = Noise(distance=0.02, angle=0.03)
    pairs = read_measurements(write(POSES), ARM, pairs=write(PAIRS, "pairs.csv"), noise=noise).pairs
    nan = np.nan
    assert pairs.a.tolist() == [0, 1, 0, 1]
    assert pairs.b.tolist() == [1, 0, 2, 0]
    assert np.array_equal(pairs.distance, [0.5, nan, 0.1, 0.1], equal_nan=True)
    assert np.array_equal(pairs.angle, [nan, 3.1, 0.2, nan], equal_nan=True)
    assert pairs.sigma_distance.tolist() == [0.01, 0.02, 0.02, 0.02]
    assert pairs.sigma_angle.tolist() == [0.03] * 4
    assert pairs.test.tolist() == [False, False, True, True]  # p3 is a test row, the last says so itself
    assert pairs.source == "pairs.csv"


def test_pairs_name_configurations_by_row_where_there_are_no_ids(write):
    path = write("q1,q2,q3,split\n0,0,0,\n0.1,0,0,test\n0.2,0,0,\n")
    pairs = write("a,b,angle,sigma_angle\n2,0,180,1\n1,2,90,\n", "pairs.csv")
    m = read_measurements(path, ARM, pairs=pairs, units=Units(angle="deg", length="mm"))
    assert m.ids.tolist() == ["0", "1", "2"]
    assert (m.pairs.a.tolist(), m.pairs.b.tolist()) == ([2, 1], [0, 2])
    assert m.pairs.angle == pytest.approx([math.pi, math.pi / 2])
    assert m.pairs.sigma_angle == pytest.approx([math.radians(1), np.nan], nan_ok=True)
    assert np.isnan(m.pairs.distance).all()
    assert m.pairs.test.tolist() == [False, True]
    rounded = write("a,b,angle\n0,2,3.14160\n", "pairs.csv")
    assert read_measurements(path, ARM, pairs=rounded).pairs.angle.tolist() == [math.pi]


def changed(old, new, table=POSES):
    assert table.count(old) == 1
    return table.replace(old, new)


COLUMNS = "id, x, y, z, qx, qy, qz, qw, split, note"
JOINTS = "expected q1 to q3 for the robot's 3 joints, or their names q1, q2, lift; the columns are"

MISTAKES = [
    (changed("q3,id", "q3,q4"),
     f"poses.csv: 4 joint columns (q1, q2, q3, q4), {JOINTS} q1, q2, q3, q4, {COLUMNS[4:]}"),
    (changed("0,0.6,0,0.8", "0,0.6,0,0.802"), "poses.csv:4: quaternion of norm 1.0016, expected 1 within 0.001"),
    (changed("p2,", ""), "poses.csv:3: 12 cells, expected 13 as in the header"),
    (changed("0.2,0.3", "0.2,300"), "poses.csv:2: q3 = 300 m is outside [0, 0.5]; is it in mm?"),
    (changed("note\n", "note\n[deg],deg,m,,m,m,m,,,,,,\n"),
     "poses.csv:2: q1: found '[deg]', expected a finite number; is it a row of units? delete it: units are in the job"),
    (changed("1.5,2", '"1,001.5",2'), "poses.csv:3: x: found '1,001.5', expected a finite number; "
     "are its thousands separated? write digits and a decimal point alone"),
    (changed("q1", "date\nq1"), "poses.csv:2: 13 cells, expected 1 as in the header; "
     "are there lines before the header? skip_lines in the job leaves them out"),
]  # fmt: skip


@pytest.mark.parametrize(("table", "message"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_is_named_in_one_line(write, table, message):
    assert refusal(read_measurements, write(table), ARM) == message


def test_threads_of_polars_that_are_no_number_are_refused(write, monkeypatch):
    monkeypatch.setenv("POLARS_MAX_THREADS", "x")
    said = "POLARS_MAX_THREADS in the environment: found 'x', expected a number"
    assert refusal(read_measurements, write(POSES), ARM).startswith(said)


def test_an_unknown_file_is_named(write):
    caught = refusal(read_measurements, write("", "poses.xlsx"), ARM)
    assert caught == "poses.xlsx: ending '.xlsx', expected one of .csv, .parquet, .pq; save the sheet as CSV"


@pytest.mark.parametrize("ending", ["csv", "parquet", "frame"])
def test_a_column_is_no_pattern(tmp_path, ending):
    """Polars takes * for all columns, and ^...$ for those that it matches."""
    frame = pl.DataFrame({"*": [0.1], "^.*$": [0.2], "^a$": [9.0], "row of the file": [3]})
    file = tmp_path / f"poses.{ending}"
    if ending != "frame":
        frame.write_csv(file) if ending == "csv" else frame.write_parquet(file)
    given = frame if ending == "frame" else file
    assert read_measurements(given, arm(Joint("*"), Joint("^.*$"))).readings.tolist() == [[0.1, 0.2]]


def test_cells_of_several_types_are_all_read():
    """None becomes an empty cell in silence."""
    columns = {"q1": [1, 0.5], "q2": ["0.25", 1], "q3": [np.float32(0.5), 10**400], "id": [1, "b"]}
    assert refusal(read_measurements, columns, ARM).startswith("frame: no table: ")
    found = read_measurements(columns | {"q3": [0.5, 0.25]}, ARM)
    assert found.readings.tolist() == [[1.0, 0.25, 0.5], [0.5, 1.0, 0.25]]
    assert found.ids.tolist() == ["1", "b"]
