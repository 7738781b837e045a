"""Fixtures of several test files: the real data, the bundled example, and the command line as a function."""

import gc
import os
import shutil
import signal
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:  # one worker a processor: threads of BLAS would only wait for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, when numpy is loaded
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in a shell's background, and so in what tests interrupt
    signal.signal(signal.SIGINT, signal.default_int_handler)
os.environ["PYTHONSAFEPATH"] = "1"  # subprocesses have the package that is tested, compiled once, wherever they run

from fg_calib import calibrate_job, cli
from fg_calib.diagnostics import setup_check as mistakes
from fg_calib.observability import identifiability


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items):
    """Long tests are slow ones, and of a `sampled` test all cases but some."""
    cases = {}
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker("slow")
        if item.get_closest_marker("sampled") and not item.get_closest_marker("slow"):
            cases.setdefault((item.parent, item.function), []).append(item)
    for (_, function), quick in cases.items():
        n = next(mark.args[0] for mark in function.pytestmark if mark.name == "sampled")
        kept = {i * len(quick) // n for i in range(n)}
        for i, item in enumerate(quick):
            if i not in kept:
                item.add_marker("slow")


def pytest_collection_finish():
    """Spare garbage collections what imports and the tests themselves keep, which is most of all objects."""
    gc.collect()
    gc.freeze()


REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def data_folder():
    """The folder of real data; tests that need it are skipped without it."""
    folder = Path(os.environ.get("FG_CALIB_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data: FG_CALIB_DATA names the folder, {folder} is none")
    return folder


@pytest.fixture
def whole_example(tmp_path):
    """A copy of the bundled example's folder, to be changed at will."""
    return Path(shutil.copytree(cli.EXAMPLES / "space-robot", tmp_path / "space-robot"))


def with_few_rows(folder):
    """Leave 50 of the example's 500 test rows: half of what it takes is judging these."""
    poses = folder / "poses.csv"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:-450]))
    return folder


@pytest.fixture
def example(whole_example):
    """The same with few test rows."""
    return with_few_rows(whole_example)


@pytest.fixture(scope="session")
def calibrated_example(tmp_path_factory):
    """The example with few test rows, and its result; nobody changes it."""
    folder = shutil.copytree(cli.EXAMPLES / "space-robot", tmp_path_factory.mktemp("example") / "job")
    calibrate_job(with_few_rows(folder) / "calibration.yaml").save(folder / "result")
    return folder


@pytest.fixture
def without_reasons(monkeypatch):
    """Leave out why directions are lost: two fifths of `assess`, and no part of what repeated calibrations look at."""
    monkeypatch.setattr(identifiability, "explain", lambda *_: ())


@pytest.fixture
def without_mistakes(monkeypatch):
    """Leave out the search for a mistake in the set-up: most of what an arm that does not fit costs."""
    monkeypatch.setattr(mistakes, "_explanations", lambda *_: ())


class Ended(NamedTuple):
    """How a command ended: exit code, stdout, stderr."""

    code: int
    out: str
    err: str


@pytest.fixture
def fg_calib(monkeypatch, capsys):
    """`fg_calib("calibrate", job)`: the command in this process, through the one door for errors."""

    def run(*arguments):
        capsys.readouterr()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["fg-calib", *map(str, arguments)])
            try:
                cli.main()
                code = 0
            except SystemExit as end:
                code = int(end.code or 0)
        return Ended(code, *capsys.readouterr())

    return run
