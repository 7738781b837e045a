"""Whatever is done to a file, only the package's own errors leave its reader, within seconds and in one line.

`FG_CALIB_FUZZ_CASES=1000000 pytest -m slow tests/io/test_fuzz.py` draws more; `experiments/fuzz.py` is faster.
"""

import json
import os
import signal
import warnings

import fuzz
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from fg_calib import InputError

pytestmark = pytest.mark.filterwarnings("ignore::hypothesis.errors.HypothesisWarning")  # of random generators it meets

CASES = int(os.environ.get("FG_CALIB_FUZZ_CASES", "10000"))
SHARES = {
    **{"urdf": 0.2, "result": 0.1, "robot yaml": 0.2, "from_frame": 0.1, "poses csv": 0.1},
    **{"scenario": 0.12, "poses parquet": 0.05, "job": 0.08, "pairs csv": 0.05},
}
"""Of the cases; seldom read files are not seldom damaged."""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The folder in which damaged files lie, and their readers."""
    folder = tmp_path_factory.mktemp("fuzz")
    return folder, fuzz.readers(folder)


def damage_and_read(files, what, n):
    """Let a reader read n damaged files that hypothesis draws, the same ones every time."""
    folder, readers = files
    reader = readers[what]

    @settings(
        max_examples=n,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )
    @given(rng=st.randoms(use_true_random=False))
    def check(rng):
        damaged = reader.damaged(rng)
        if isinstance(damaged, bytes):
            (folder / reader.file).write_bytes(damaged)
            damaged = folder / reader.file
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            fuzz.check(lambda: reader.read(damaged))

    check()


def test_all_readers_take_part(files):
    assert set(SHARES) == set(files[1])
    assert sum(SHARES.values()) == pytest.approx(1.0)
    assert sum(reader.share for reader in files[1].values()) == pytest.approx(1.0)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("what", SHARES)
def test_some_damaged_files_end_in_errors_of_the_package_alone(files, what):
    damage_and_read(files, what, 8)


@pytest.mark.long
@pytest.mark.parametrize("what", SHARES)
def test_damaged_files_end_in_errors_of_the_package_alone(files, what):
    damage_and_read(files, what, round(CASES * SHARES[what]))


@pytest.mark.slow
def test_what_is_whole_is_accepted(files):
    """Else nothing but the first check of a reader would be tried."""
    folder, readers = files

    documents = {
        "robot yaml": (fuzz.ROBOT, fuzz.SHORT_ROBOT, fuzz.WRAPPED),
        "job": (fuzz.JOB, fuzz.JOB_OF_TABLES),
        "scenario": (fuzz.SCENARIO, fuzz.BOARD_SCENARIO),
    }
    for what, given_documents in documents.items():
        for document in given_documents:
            (folder / "whole.yaml").write_text(fuzz.yaml_text(document))
            assert fuzz.check(lambda what=what: readers[what].read(folder / "whole.yaml"))
    assert fuzz.check(lambda: readers["urdf"].read(folder / "arm.urdf"))
    assert fuzz.check(lambda: readers["pairs csv"].read(folder / "pairs.csv"))
    assert fuzz.check(lambda: readers["poses csv"].read(folder / "poses.csv"))
    for table in (fuzz.POSES, fuzz.TOUCHES):
        assert fuzz.check(lambda table=table: readers["from_frame"].read(table))
    (folder / "result.json").write_text(json.dumps(fuzz.result_document()))
    assert fuzz.check(lambda: readers["result"].read(folder / "result.json"))


@pytest.mark.parametrize(
    ("read", "error"),
    [
        (lambda: {}["name"], KeyError),
        (lambda: fuzz.time.sleep(9), fuzz._HangError),
    ],
)
def test_anything_else_is_found(monkeypatch, read, error):
    monkeypatch.setattr(fuzz, "SECONDS", 0.05)
    with pytest.raises(error):
        fuzz.check(read)
    assert signal.getsignal(signal.SIGALRM) != fuzz._hangs


def test_a_message_that_is_no_line_is_found(monkeypatch):
    monkeypatch.setattr(InputError, "__str__", lambda _: "two\nlines")

    def read():
        raise InputError("a", "b")

    with pytest.raises(ValueError, match="a message that is no line"):
        fuzz.check(read)
