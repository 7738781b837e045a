"""Files as an enemy would write them: one line for each, and what was asked for is read, not what a name looks like."""

import numpy as np
import polars as pl
import pytest

from fg_calib import InputError, Robot
from fg_calib.inputs import ORDINARY
from fg_calib.io import read_measurements

ROWS_OF_DH = [[0.5, 0.1, 0.2, 0.0], [0.4, 0.2, 0.1, 0.0], [0.3, 0.0, 0.1, 0.0]]
ARM = Robot.from_dh(ROWS_OF_DH, convention="dh")
ROWS = "q1,q2,q3,x,y,z\n0.1,0.2,0.3,1,2,3\n0.4,0.5,0.6,4,5,6\n"
UTF_16 = "a null character, expected UTF-8 text; is it UTF-16, Latin-1 or Windows text? save it as UTF-8"


TABLES = {
    ROWS.encode("utf-16"): f"poses.csv:1: {UTF_16}",
    ROWS.replace("0.2", '"0.2'): "poses.csv:2: a quote that is not closed, expected whole cells in quotes, or none",
    "\n\n" + ROWS.replace("0.2", ""): "poses.csv:4: q2: found an empty cell, expected a finite number",
    ROWS.replace("0.2", "1e200"): f"poses.csv:2: q2: found '1e200', expected {ORDINARY}",
    ROWS + ",,,,,7\n": "poses.csv:4: q1: found an empty cell, expected a finite number",
    ROWS.replace("\n", "\r").replace("0.2", "?"): "poses.csv:2: q2: found '?', expected a finite number",
}


@pytest.mark.parametrize("text", TABLES, ids=lambda text: repr(text[:20]))
def test_no_table_hangs_or_ends_in_a_traceback(tmp_path, text):
    file = tmp_path / "poses.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as error:
        read_measurements(file, ARM)
    assert str(error.value) == TABLES[text]


@pytest.mark.parametrize("ending", ["csv", "parquet", "frame"])
def test_a_column_is_no_pattern(tmp_path, ending):
    """Polars takes * for all columns, and ^...$ for those that it matches."""
    arm = Robot.from_dh(ROWS_OF_DH[:2], convention="dh", names=["*", "^.*$"])
    frame = pl.DataFrame({"*": [0.1], "^.*$": [0.2], "^a$": [9.0], "row of the file": [3]})
    file = tmp_path / f"poses.{ending}"
    if ending != "frame":
        frame.write_csv(file) if ending == "csv" else frame.write_parquet(file)
    assert read_measurements(frame if ending == "frame" else file, arm).readings.tolist() == [[0.1, 0.2]]


def test_cells_of_several_types_are_all_read(tmp_path):
    """None becomes an empty cell in silence."""
    columns = {"q1": [1, 0.5], "q2": ["0.25", 1], "q3": [np.float32(0.5), 10**400], "id": [1, "b"]}
    with pytest.raises(InputError) as error:
        read_measurements(columns, ARM)
    assert str(error.value).startswith("frame: no table: ")
    found = read_measurements(columns | {"q3": [0.5, 0.75]}, ARM)
    assert found.readings.tolist() == [[1.0, 0.25, 0.5], [0.5, 1.0, 0.75]]
    assert found.ids.tolist() == ["1", "b"]
