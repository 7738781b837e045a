"""Files as an enemy would write them: one line for each, and what was asked for is read, not what a name looks like."""

import numpy as np
import polars as pl
import pytest

from fg_calib import InputError, Robot
from fg_calib.io import read_measurements

ROWS_OF_DH = [[0.5, 0.1, 0.2, 0.0], [0.4, 0.2, 0.1, 0.0], [0.3, 0.0, 0.1, 0.0]]
ARM = Robot.from_dh(ROWS_OF_DH, convention="dh")


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
