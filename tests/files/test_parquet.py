"""Parquet is read by another process: what ends, stops or misleads that one is a line here."""

import sys

import polars as pl
import pytest
from sparing import most_slow

from fg_calib import InputError
from fg_calib.files import parquet

NAMES = ["a", "b c", "*"]


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


@pytest.mark.parametrize(
    "program", most_slow(["import os; os.abort()", "import os; os.read(0, 9); os._exit(0)", "print('[')"], every=3)
)
def test_a_process_that_ends_is_a_line_and_the_next_file_is_read(content, reader, monkeypatch, program):
    with monkeypatch.context() as patch:
        patch.setattr(parquet, "_READ", program)
        with pytest.raises(InputError) as caught:
            parquet.parquet_columns(content, "table.parquet")
    assert str(caught.value) == "table.parquet: not a Parquet file: polars ends on it; write it anew"
    assert parquet.parquet_columns(content, "table.parquet") == NAMES


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
