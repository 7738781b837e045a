"""The same answer, bit by bit, on any number of threads and processors."""

import json
import os
import re
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Barrier

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from fg_calib.parallel import THREADS, one_blas_thread, single_threaded

LIMITS = ("OPENBLAS", "OMP", "MKL", "NUMBA")
RUN = """
import os, sys
from fg_calib import cli
if sys.argv.pop(1) == "1" and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
cli.main()
"""


def documents(jobs, threads, processors, seed="0"):
    """The results of jobs, each by the command in a process of its own."""
    limits = {f"{library}_NUM_THREADS": threads for library in LIMITS}
    env = os.environ | limits | {"POLARS_MAX_THREADS": threads, "PYTHONHASHSEED": seed}
    for job in jobs:
        command = [sys.executable, "-c", RUN, processors, "calibrate", job, "--json"]
        document = json.loads(subprocess.run(command, capture_output=True, text=True, env=env, check=False).stdout)
        document["solver"].pop("seconds")
        document.pop("date")
        yield document


@pytest.mark.slow
def test_every_bit_is_the_same_on_one_thread_and_on_several(whole_example):
    """With joint noise, so that all pairs share errors: the dense algebra that BLAS would spread over its threads."""
    job, table = whole_example / "calibration.yaml", whole_example / "poses.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:163]))
    text = re.sub("joint: [0-9.]+", "joint: 0.005", job.read_text())
    poses = "model: pose\nencoder: estimated"
    jobs = [whole_example / name for name in ("star.yaml", "poses.yaml", "gnc.yaml")]
    changes = (text, re.sub("model: .*", poses, text).replace("pairing: star\n", ""), f"{text}\nloss: gnc\n")
    for path, changed in zip(jobs, changes, strict=True):
        path.write_text(changed)
    one = list(documents(jobs, "1", "1"))
    for other in (("2", "all", "1"), ("7", "all", "random")):  # more threads, other hashes
        assert list(documents(jobs, *other)) == one


def blas_threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture
def before():
    """BLAS on several threads, so that a limit is one: a worker of xdist has set one thread from the start."""
    with threadpool_limits(3, user_api="blas"):
        assert blas_threads() == {3}
        yield {3}


def test_the_last_to_leave_lifts_the_limit(before):
    with one_blas_thread:
        with one_blas_thread:
            assert blas_threads() == {1}
        assert blas_threads() == {1}
    assert blas_threads() == before


def test_one_thread_of_python_does_not_lift_the_limit_of_another(before):
    both_are_in, one_has_left = Barrier(2), Barrier(2)

    def first():
        with one_blas_thread:
            both_are_in.wait(10)
        one_has_left.wait(10)
        return {1}

    def second():
        with one_blas_thread:
            both_are_in.wait(10)
            one_has_left.wait(10)
            return blas_threads()

    with ThreadPoolExecutor(2) as pool:
        assert [run.result() for run in (pool.submit(first), pool.submit(second))] == [{1}, {1}]
    assert blas_threads() == before


def test_the_limit_is_lifted_after_an_error(before):
    @single_threaded
    def fails():
        assert blas_threads() == {1}
        raise ValueError

    with pytest.raises(ValueError, match=r"^$"):
        fails()
    assert blas_threads() == before


FORK = """
import os
from fg_calib.robot.kinematics import over_processors
print(sum(over_processors(abs, 8)), flush=True)
if os.fork() == 0:
    print(sum(over_processors(abs, 8)), flush=True)
    os._exit(0)
os.wait()
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks on this system")
def test_a_fork_has_threads_of_its_own():
    command = [sys.executable, "-c", FORK]
    with subprocess.Popen(
        command, env=os.environ | {THREADS: "2"}, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            shown, _ = process.communicate(timeout=60)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    assert shown == "28\n28\n"
