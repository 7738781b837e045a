"""Parquet is read by another process: what ends, stops or misleads that one is a line here."""

import subprocess
import sys

import numpy as np
import polars as pl
import pytest
from simulated import planar_robot

from fg_calib import InputError
from fg_calib.io import columns, parquet
from fg_calib.io.tables import read_measurements
from fg_calib.measurements.dataset import Noise

NAMES = ["a", "b c", "*"]
_READ = parquet._READ


@pytest.fixture
def content(tmp_path):
    file = tmp_path / "table.parquet"
    pl.DataFrame({name: [float(i), None] for i, name in enumerate(NAMES)}).write_parquet(file)
    return file.read_bytes()


@pytest.fixture
def reader(monkeypatch):
    """A process of this test alone."""
    found = parquet._Reader()
    monkeypatch.setattr(parquet, "_READER", found)
    yield found
    found.stop()


def test_columns_are_read_by_their_numbers(content):
    assert parquet.parquet_columns(content, "table.parquet") == NAMES
    assert parquet.read_parquet(content, [0, 2], "table.parquet").to_dict(as_series=False) == {
        "a": [0.0, None],
        "*": [2.0, None],
    }


@pytest.mark.sampled(1)
@pytest.mark.parametrize("program", ["import os; os.abort()", "import os; os.read(0, 9); os._exit(0)", "print('[')"])
def test_a_process_that_ends_is_a_line_and_the_next_file_is_read(content, reader, monkeypatch, program):
    with monkeypatch.context() as patch:
        patch.setattr(parquet, "_READ", program)
        with pytest.raises(InputError) as caught:
            parquet.parquet_columns(content, "table.parquet")
    assert str(caught.value) == "table.parquet: not a Parquet file: polars ends on it; write it anew"
    assert parquet.parquet_columns(content, "table.parquet") == NAMES


@pytest.mark.parametrize(
    "program",
    [
        "import os, sys; sys.stderr.write('memory allocation of 8 bytes failed'); sys.stderr.flush(); os.abort()",
        "raise MemoryError",
        "import os; os.kill(os.getpid(), 9)",
    ],
)
def test_a_process_that_gets_no_memory_is_a_line_that_says_so(content, reader, monkeypatch, program):
    """Rust aborts, Python raises, and the system ends who uses most."""
    monkeypatch.setattr(parquet, "_READ", program)
    with pytest.raises(InputError) as caught:
        parquet.parquet_columns(content, "table.parquet")
    expected = "table.parquet: there is not enough memory for it; if it is damaged, write it anew"
    assert str(caught.value) == expected


@pytest.mark.slow
def test_columns_that_memory_does_not_suffice_for_are_a_line_and_the_process_goes_on(content, reader, monkeypatch):
    """polars hands a MemoryError on as an OSError without words."""
    for error in ("MemoryError()", "OSError()"):
        failing = f"pl.DataFrame.write_ipc = lambda self, file: (_ for _ in ()).throw({error})"
        reader.stop()
        monkeypatch.setattr(parquet, "_READ", _READ.replace("source, sink", f"{failing}\nsource, sink", 1))
        with pytest.raises(InputError) as caught:
            parquet.read_parquet(content, [0], "table.parquet")
        assert str(caught.value) == "table.parquet: there is not enough memory for it"
        assert parquet.parquet_columns(content, "table.parquet") == NAMES


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_AS")
@pytest.mark.slow
@pytest.mark.parametrize("ending", ["csv", "parquet"])
@pytest.mark.parametrize("room", [1.0, 1.5, 2.5])
def test_with_hardly_any_memory_left_a_large_table_is_named(tmp_path, ending, room):
    """polars would end the process at a small piece that it does not get: so much is asked for before it is called."""
    table, n = tmp_path / f"poses.{ending}", 3_000_000
    frame = pl.DataFrame({name: np.zeros(n, dtype=int) for name in ("q1", "q2", "x", "y", "z")})
    frame.write_csv(table) if ending == "csv" else frame.write_parquet(table)
    size = int(room * (8 * 5 * n if ending == "parquet" else 16 * 5 * n))
    code = f"""
import resource, sys, polars
sys.path[:0] = {sys.path!r}
from simulated import planar_robot
from fg_calib import InputError, read_measurements
read_measurements(polars.DataFrame({{name: [0.0, 1.0] for name in ("q1", "q2", "x", "y", "z")}}), planar_robot())
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + {size}, used + {size}))
try:
    read_measurements({str(table)!r}, planar_robot())
except InputError as error:
    print(error)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout.count("\n")) == (0, 1), ended.stderr
    assert ended.stdout.startswith(f"poses.{ending}: there is not enough memory for it")


def test_a_process_that_never_ends_is_a_line(content, reader, monkeypatch):
    monkeypatch.setattr(parquet, "_READ", "import time; time.sleep(99)")
    monkeypatch.setattr(parquet, "_SECONDS", 0.1)
    with pytest.raises(InputError) as caught:
        parquet.parquet_columns(content, "table.parquet")
    assert str(caught.value) == (
        "table.parquet: polars took more than 0.101 s to read it; try again; if it is damaged, write it anew"
    )


def test_without_another_process_there_is_a_line(content, reader, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nowhere")
    with pytest.raises(InputError) as caught:
        parquet.parquet_columns(content, "table.parquet")
    assert str(caught.value) == (
        "table.parquet: cannot be read: no process can be started for it: No such file or directory; a CSV needs none"
    )


def test_no_code_beside_the_files_runs(content, reader, tmp_path, monkeypatch):
    for module in ("polars", "json", "io"):
        (tmp_path / f"{module}.py").write_text("raise SystemExit(7)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    assert parquet.parquet_columns(content, "table.parquet") == NAMES


def test_pairs_are_the_same_read_by_pieces_and_at_once(tmp_path, monkeypatch):
    rng, file = np.random.default_rng(0), tmp_path / "pairs.parquet"
    robot, n = planar_robot(), 10
    q = pl.DataFrame(rng.uniform(-1.0, 1.0, (20, robot.n_joints)), schema=[f"q{k + 1}" for k in range(robot.n_joints)])
    a = rng.integers(0, 20, n)
    pairs_of_rows = {"a": a, "b": (a + 1) % 20, "distance": rng.uniform(0.1, 1.0, n)}
    pl.DataFrame(pairs_of_rows).write_parquet(file, row_group_size=3)
    noise = Noise(distance=1e-3)
    whole = read_measurements(q, robot, pairs=file, noise=noise).pairs
    for piece in (4, 5, n):  # with a rest, and without one
        monkeypatch.setattr(columns, "PIECE", piece)
        found = read_measurements(q, robot, pairs=file, noise=noise).pairs
        assert found.source == whole.source
        for name in ("a", "b", "distance", "angle", "sigma_distance", "sigma_angle", "test"):
            assert np.array_equal(getattr(found, name), getattr(whole, name), equal_nan=name.endswith("angle"))
    assert parquet._READER._kept is None  # the file is let go of with its last rows


def test_a_mistake_in_a_later_piece_is_named_by_its_row(tmp_path, monkeypatch):
    monkeypatch.setattr(columns, "PIECE", 2)
    file, robot = tmp_path / "pairs.parquet", planar_robot()
    pl.DataFrame({"a": [0, 1, 2, 0], "b": [1, 2, 0, 2], "distance": [0.1, 0.2, 0.3, -1.0]}).write_parquet(file)
    q = pl.DataFrame({f"q{k + 1}": [0.0, 0.1, 0.2] for k in range(robot.n_joints)})
    with pytest.raises(InputError) as caught:
        read_measurements(q, robot, pairs=file, noise=Noise(distance=1e-3))
    assert str(caught.value) == "pairs.parquet: row 3: distance: found -1.0, expected a number not below 0"


def test_two_files_read_by_pieces_in_turn_are_not_mistaken_for_each_other(tmp_path, reader):
    contents = []
    for k in range(2):
        pl.DataFrame({"a": [10.0 * k + i for i in range(4)]}).write_parquet(tmp_path / f"{k}.parquet")
        contents.append((tmp_path / f"{k}.parquet").read_bytes())
    found = [
        parquet.read_parquet(contents[k], [0], "table.parquet", (first, 2))["a"].to_list()
        for first in (0, 2)
        for k in range(2)
    ]
    assert found == [[0.0, 1.0], [10.0, 11.0], [2.0, 3.0], [12.0, 13.0]]
