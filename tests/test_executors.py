"""Many jobs on any executor: outcomes in order, one that fails or kills its worker is no matter to the others."""

import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import pytest
from deadly import deadly_calibration, die_once, every_bit, work
from rich.console import Console

from fg_calib import (
    CalibrationError,
    Failure,
    InputError,
    ProblemError,
    calibrate_jobs,
    dask_executor,
    local_processes,
    map_jobs,
    read_job,
    read_scenario,
    simulate,
)
from fg_calib.assessment import solve_job
from fg_calib.batch import EARLIER, Order, calibrate_into, job_names
from fg_calib.cli.calibrate import _written
from fg_calib.io.atomic import fill_folder, write_text
from fg_calib.progress import listening
from fg_calib.report.batch import JobSummary, build_jobs_table
from fg_calib.statistics.cross_validation import cross_validate
from fg_calib.threads import THREADS, processors

JOBS = [1, "refused", 2, "a bug", "too large", 3]
REFUSED = Failure("job 2", "job.yaml: found nonsense, expected sense; look at it")
HINT = "is there enough memory for it, and can other processes read the job?"
KILLED = f"the process that it ran on died, 3 times of 3; {HINT}"


def check_outcomes(found):
    """What becomes of `JOBS`."""
    assert [found[k] for k in (0, 2, 5)] == [2, 4, 6]
    assert found[1] == REFUSED
    bug, large = found[3], found[4]
    assert (bug.job, bug.reason) == ("job 4", "KeyError: 'of\\nmine'")
    assert "deadly.py" in bug.trace
    assert large == Failure("job 5", "there is not enough memory for it")


def test_a_job_that_fails_is_no_matter_to_the_others():
    check_outcomes(map_jobs(work, JOBS))
    with ThreadPoolExecutor(3) as executor:
        check_outcomes(map_jobs(work, JOBS, executor))


def test_a_failure_can_be_raised_with_its_trace():
    refused, bug = (one.error() for one in map_jobs(work, ["refused", "a bug"], names=["arm 1", "arm 2"]))
    assert isinstance(refused, CalibrationError)
    assert str(refused) == "arm 1: job.yaml: found nonsense, expected sense; look at it"
    assert isinstance(bug, RuntimeError)
    assert "KeyError" in bug.__notes__[0]


def test_who_listens_is_told_how_many_jobs_are_done():
    told = []
    with listening(lambda *what: told.append(what)), ThreadPoolExecutor(1) as executor:
        map_jobs(work, [1, 2], executor, what="doubling")
    assert told == [("doubling", 0, 2), ("doubling", 1, 2), ("doubling", 2, 2)]


def test_an_executor_has_some_jobs_at_a_time_only():
    class Counting(ThreadPoolExecutor):
        under_way, now, most = 3, 0, 0

        def submit(self, *args, **kwargs):
            self.now += 1
            self.most = max(self.most, self.now)
            future = super().submit(*args, **kwargs)
            future.add_done_callback(lambda _: setattr(self, "now", self.now - 1))
            return future

    with Counting(8) as executor:
        assert map_jobs(work, range(40), executor) == [2 * k for k in range(40)]
    assert executor.most == 3


def test_jobs_that_an_executor_does_not_take_or_gives_up_are_no_matter_to_the_others():
    class Ending(ThreadPoolExecutor):
        n = 0

        def submit(self, *args, **kwargs):
            self.n += 1
            if self.n == 3:
                self.shutdown()
            if self.n == 2:
                given_up = Future()
                given_up.cancel()
                given_up.set_running_or_notify_cancel()
                return given_up
            return super().submit(*args, **kwargs)

    first, second, *others = map_jobs(work, range(5), Ending(2))
    assert first == 0
    assert second == Failure("job 2", "the executor gave it up, as where a scheduler ends")
    reason = "RuntimeError: cannot schedule new futures after shutdown"
    assert others == [Failure(f"job {k}", reason) for k in (3, 4, 5)]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ([1], "four"),
            "executor: found 'four', expected an executor of concurrent.futures, such as local_processes(4)",
        ),
        (([1, 2], None, ["one"]), "names: found 1, expected 2, one for each job"),
        (([1, 2], None, 5), "names: found 5, expected a list of text"),
        ((3, None), "jobs: found 3, expected a list of them, or whatever hands out one after the other"),
    ],
)
def test_what_is_no_executor_is_refused(arguments, expected):
    jobs, executor, *names = arguments
    with pytest.raises(InputError) as refused:
        map_jobs(work, jobs, executor, names=names[0] if names else None)
    assert str(refused.value) == expected


class Silent(Exception):
    def __str__(self):
        raise ValueError


def raise_silently(_):
    raise Silent


@pytest.mark.parametrize("submitted", [None, "the same"])
def test_an_executor_that_returns_no_future_of_its_own_fails_its_jobs_alone(submitted):
    class Wrong(ThreadPoolExecutor):
        first = None

        def submit(self, *args, **kwargs):
            self.first = self.first or super().submit(*args, **kwargs)
            return self.first if submitted else None

    with Wrong(1) as executor:
        found = map_jobs(work, [1, 2, 3], executor)
    reason = "TypeError: submit of the executor returned no future of its own for each job"
    assert found[1:] == [Failure(f"job {k}", reason) for k in (2, 3)]
    assert found[0] == (2 if submitted else Failure("job 1", reason))


def test_an_error_that_cannot_be_printed_is_a_failure_by_its_kind():
    (found,) = map_jobs(raise_silently, [1])
    assert found.reason == "Silent: it cannot say why"


@pytest.mark.parametrize("n", [0, -1, 1.5, "2", 1001, 2**31])
def test_processes_are_counted(n):
    with pytest.raises(InputError, match=r"^workers: found "):
        local_processes(n)


@pytest.mark.parametrize("kind", [InputError, ProblemError])
def test_an_error_is_the_same_after_a_pickle(kind):
    error = kind("poses.csv:17", "nothing", "something", "look again")
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), vars(again)) == (kind, str(error), vars(error))


def test_jobs_are_a_list_of_jobs():
    for jobs, place in (("job.yaml", "jobs"), (Path("job.yaml"), "jobs"), ([3], r"jobs\[0\]"), (None, "jobs")):
        with pytest.raises(InputError, match=f"^{place}: found "):
            calibrate_jobs(jobs)


def test_kernels_have_as_many_threads_as_the_environment_says(monkeypatch):
    try:
        for given, expected in (("3", 3), ("", None)):
            monkeypatch.setenv(THREADS, given)
            processors.cache_clear()
            assert processors() == (expected or len(os.sched_getaffinity(0)))
        for given in ("0", "many", "-1", "1001", "99999999999"):
            monkeypatch.setenv(THREADS, given)
            processors.cache_clear()
            with pytest.raises(InputError, match=f"^{THREADS} in the environment: found '{given}', expected a number"):
                processors()
    finally:
        processors.cache_clear()


def test_folders_are_called_by_what_tells_jobs_apart():
    def names(*jobs):
        return job_names([Path(job) for job in jobs])

    assert names("a/one.yaml", "b/two.yaml") == ["one", "two"]
    assert names("a/job.yaml", "b/job.yaml") == ["a", "b"]
    assert names("a/cold.yaml", "a/warm.yaml", "b/cold.yaml") == ["a-cold", "a-warm", "b-cold"]
    assert names("x/jobs.json.yaml", "y/other.yaml") == ["x", "y"]  # where a file of all jobs would be


def test_no_folder_of_a_job_is_outside_that_of_all(tmp_path, monkeypatch):
    (tmp_path / "arm" / "sub").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "arm" / "sub")

    def names(*jobs):
        return job_names([Path(job) for job in jobs])

    assert names("../job.yaml", "job.yaml") == ["arm", "sub"]
    assert names("../../x/../job.yaml", "../job.yaml", "job.yaml") == [tmp_path.name, "arm", "sub"]
    for hidden in ("...yaml", "..yaml"):
        assert names(f"../{hidden}", "cold.yaml") == ["arm", "sub"]
        assert names(hidden, "cold.yaml") == [f"sub-{Path(hidden).stem}", "sub-cold"]


@pytest.mark.parametrize(
    "jobs", [("a/job.yaml", "a/job.yaml"), ("x/a/job.yaml", "y/a/job.yaml"), ("A/job.yaml", "a/job.yaml")]
)
def test_jobs_that_would_be_written_to_one_folder_are_refused(jobs):
    found = f"JOB: {jobs[0]}, {jobs[1]} would be written to the same folder {Path(jobs[0]).parent.name}-job"
    with pytest.raises(InputError) as refused:
        job_names([Path(job) for job in jobs])
    assert str(refused.value) == f"{found}, expected files, or folders, of different names"


# --- processes that are killed ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_job_that_kills_its_process_takes_no_other_with_it(capfd):
    """And what is left afterwards works."""
    jobs = [*range(6), "deadly", *range(7, 12), "refused", "cannot be sent", "deadly", *range(15, 24)]
    with local_processes(2) as executor:
        found = map_jobs(work, jobs, executor)
        assert map_jobs(work, [5], executor) == [10]
    for k, (job, one) in enumerate(zip(jobs, found, strict=True)):
        if job == "deadly":
            assert one == Failure(f"job {k + 1}", KILLED)
        elif job == "cannot be sent":
            assert "pickle" in one.reason
        elif job == "refused":
            assert one == Failure(f"job {k + 1}", REFUSED.reason)
        else:
            assert one == 2 * job
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_a_process_that_is_killed_once_costs_nothing(tmp_path):
    with local_processes(2) as executor:
        assert map_jobs(die_once, [tmp_path / f"{k % 2}" for k in range(8)], executor) == [None] * 8


@pytest.mark.slow
def test_a_pool_that_cannot_be_mended_is_said_to_be_broken():
    with ProcessPoolExecutor(1, get_context("spawn")) as executor:
        *_, last = map_jobs(work, [1, "deadly", 3], executor)
    assert last == Failure(
        "job 3",
        "worker processes died, and no others can be started; local_processes has fresh ones;"
        ' a script must be a file, as they import it, with `if __name__ == "__main__":`',
    )


def other_jobs(example, n):
    """Jobs on the bundled example that differ in their noise."""
    text = (example / "calibration.yaml").read_text()
    paths = [example / f"arm{k}.yaml" for k in range(n)]
    for k, path in enumerate(paths):
        path.write_text(text.replace("noise: {position: 0.001", f"noise: {{position: 0.00{k + 1}"))
    assert len({path.read_text() for path in paths}) == n
    return paths


@pytest.mark.long
def test_every_bit_is_the_same_here_on_local_processes_and_on_dask_although_a_worker_is_killed(example, tmp_path):
    jobs = other_jobs(example, 4)
    here = [every_bit(found) for found in calibrate_jobs(jobs)]
    assert len({json.dumps(one) for one in here}) == 4
    with local_processes(2) as executor:
        there = map_jobs(deadly_calibration(tmp_path / "local", jobs[1]), jobs, executor)
    assert (tmp_path / "local").exists()
    assert [every_bit(found) for found in there] == here

    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'fg-calib[distributed]'")
    ended = subprocess.run(
        [sys.executable, "-c", ON_DASK, str(tmp_path / "dask"), *map(str, jobs)],
        capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "error"},
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "dask").exists()
    assert json.loads(ended.stdout) == here


ON_DASK = """
import json, sys
from pathlib import Path
from deadly import deadly_calibration, every_bit
from distributed import LocalCluster
from fg_calib import dask_executor, map_jobs
if __name__ == "__main__":
    marker, *jobs = sys.argv[1:]
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with dask_executor(cluster.scheduler_address) as executor:
            found = map_jobs(deadly_calibration(Path(marker), jobs[1]), jobs, executor)
    print(json.dumps([every_bit(one) for one in found]))
"""


@pytest.mark.slow
def test_folds_are_the_same_to_the_last_bit_on_other_processes(example):
    job = read_job(example / "calibration.yaml")
    here = cross_validate(job, solve_job, 3)
    with local_processes(2) as executor:
        there = cross_validate(job, solve_job, 3, executor=executor)
    assert there.spread == here.spread
    assert {k: (v.n, v.before, v.after) for k, v in there.kinds.items()} == {
        k: (v.n, v.before, v.after) for k, v in here.kinds.items()
    }


@pytest.mark.slow
def test_draws_of_a_simulation_are_the_same_to_the_last_bit_on_other_processes():
    draw = partial(simulate, read_scenario("space-robot"))
    here = map_jobs(draw, range(3))
    with local_processes(2) as executor:
        there = map_jobs(draw, range(3), executor)
    for one, other in zip(here, there, strict=True):
        assert one.measurements.position.tobytes() == other.measurements.position.tobytes()
        assert one.true_robot.nominal.tobytes() == other.true_robot.nominal.tobytes()


@pytest.mark.slow
def test_a_scheduler_without_workers_is_warned_of():
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'fg-calib[distributed]'")
    ended = subprocess.run(
        [sys.executable, "-c", WITHOUT_WORKERS], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "error"},
    )  # fmt: skip
    assert (ended.returncode, ended.stdout) == (0, "")
    assert re.fullmatch(r"scheduler tcp://\S+ has no workers yet: jobs wait for some\n", ended.stderr)


WITHOUT_WORKERS = """
import logging
from distributed import LocalCluster
from fg_calib import dask_executor
if __name__ == "__main__":
    logging.basicConfig(format="%(message)s")
    with LocalCluster(n_workers=0, dashboard_address=None) as cluster, dask_executor(cluster.scheduler_address):
        pass
"""


@pytest.mark.slow
def test_no_scheduler_is_one_line(monkeypatch):
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'fg-calib[distributed]'")
    monkeypatch.setattr("fg_calib.executors.PATIENCE", 0.5)
    with pytest.raises(InputError, match=r"^scheduler tcp://127\.0\.0\.1:1: .*, expected a Dask scheduler, such as "):
        dask_executor("tcp://127.0.0.1:1").__enter__()
    with pytest.raises(InputError, match=r"^scheduler nonsense://: .*, expected a Dask scheduler"):
        dask_executor("nonsense://").__enter__()


def test_without_dask_one_line_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError) as refused:
        dask_executor("tcp://127.0.0.1:1").__enter__()
    assert str(refused.value) == (
        "scheduler: Dask is not installed, expected the package distributed; pip install 'fg-calib[distributed]'"
    )


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def two_arms(example, tmp_path):
    """A good job and a nonsensical one, in folders of their own."""
    for name in ("arm1", "arm2"):
        shutil.copytree(example, tmp_path / name)
    other = tmp_path / "arm2" / "calibration.yaml"
    other.write_text(other.read_text().replace("model: distance-rotation", "model: nonsense"))
    return [tmp_path / name / "calibration.yaml" for name in ("arm1", "arm2")]


def test_many_jobs_are_written_to_a_folder_each_and_the_worst_is_the_exit_code(fg_calib, two_arms, tmp_path):
    out = tmp_path / "out"
    ended = fg_calib("calibrate", *two_arms, "--out", out, "--json")
    assert ended.code == 1
    *_, said = ended.err.splitlines()  # kernels may have been compiled before
    assert said.startswith("arm2: error: calibration.yaml: model: found 'nonsense', expected one of pose, ")
    found = json.loads(ended.out)
    assert found == json.loads((out / "jobs.json").read_text())
    assert found["schema"] == "fg-calib/jobs/1"
    assert found["n"] == {"good": 1, "not accepted": 0, "doubtful": 0, "failed": 1}
    good, failed = found["jobs"]
    assert (good["name"], good["verdict"], good["robot"], good["of_test"]) == ("arm1", "good", "space-robot", True)
    assert (failed["name"], failed["verdict"], failed["rms"]) == ("arm2", "failed", None)
    assert failed["error"].startswith("calibration.yaml: model: found 'nonsense'")
    assert {path.name for path in out.iterdir()} == {"arm1", "jobs.csv", "jobs.json"}
    saved = json.loads((out / "arm1" / "result.json").read_text())
    assert good["reduced_chi2"] == saved["reduced_chi2"]
    assert good["rms"] == {kind: rms["after"] for kind, rms in saved["residual_rms"]["test"].items() if rms}
    heads, first, second = (out / "jobs.csv").read_text().splitlines()
    rms = "rms distance [m],rms angle [rad]"
    assert heads == f"name,job,verdict,robot,n_configurations,reduced_chi2,seconds,{rms},rows,reason,warnings"
    assert first.startswith(f"arm1,{two_arms[0]},good,space-robot,52,")
    assert first.endswith(",test,,")
    assert second.startswith(f"arm2,{two_arms[1]},failed,,,,,,,")


def test_a_result_of_an_earlier_run_stays_where_a_job_fails_and_is_called_so(fg_calib, two_arms, tmp_path):
    """But not one that the job itself has written before it failed, nor where there is none."""
    out = tmp_path / "out"
    earlier = out / "arm2" / "result.json"
    earlier.parent.mkdir(parents=True)
    earlier.write_text("{}")
    ended = fg_calib("calibrate", *two_arms, "--out", out)
    assert ended.code == 1
    assert earlier.read_text() == "{}"
    reason = json.loads((out / "jobs.json").read_text())["jobs"][1]["error"]
    assert reason.startswith("calibration.yaml: model: found 'nonsense'")
    assert reason.endswith("; the result in its folder is of an earlier run")
    assert (reason in ended.err, f'"{reason}"' in (out / "jobs.csv").read_text()) == (True, True)

    class WritesAndFails(Executor):
        def submit(self, *_):
            earlier.unlink()
            earlier.write_text("another")
            raise RuntimeError("no space left")

    orders = [Order("arm2", two_arms[1], earlier.parent), Order("arm3", two_arms[1], out / "arm3")]
    assert [one.error for one in calibrate_into(orders[:1], WritesAndFails())] == ["RuntimeError: no space left"]
    assert [EARLIER in (one.error or "") for one in calibrate_into(orders)] == [True, False]


def test_lines_say_of_which_rows_they_are_where_that_is_not_the_same_for_all():
    def printed(*of_test):
        jobs = [JobSummary(f"arm{k}", "a.yaml", "good", of_test=of) for k, of in enumerate(of_test)]
        with console.capture() as text:
            console.print(build_jobs_table([*jobs, JobSummary("none", "b.yaml", "failed", "no file")], 1.0))
        return [" ".join(line.split()) for line in text.get().splitlines()]

    console = Console(width=100)
    assert printed(True, False)[:-1] == [
        "job verdict rows chi2/dof s reason",
        "arm0 good test",
        "arm1 good train",
        "none failed no file",
        "RMS after the calibration, of test or train rows",
    ]
    heads, first, *_, note, _ = printed(False, False)
    assert "rows" not in heads
    assert (first, note) == ("arm0 good", "RMS after the calibration, of train rows")
    assert len(printed(None)) == 4  # heads, lines, and how many failed: no note


@pytest.mark.slow
def test_an_arm_that_is_not_to_be_trusted_is_the_worst_where_all_have_a_result(fg_calib, two_arms, tmp_path):
    other = two_arms[1]
    other.write_text(re.sub("noise: .*", "noise: {position: 0.00001, orientation: 0.00001}", two_arms[0].read_text()))
    ended = fg_calib("calibrate", *two_arms)
    assert ended.code == 3
    assert ended.out.splitlines()[-1].endswith(": 1 good, 1 doubtful")
    assert ended.out.splitlines()[0].split()[:6] == ["job", "verdict", "distance", "mm", "angle", "deg"]
    assert ended.err.startswith("arm2: not to be trusted: ")
    other.write_text(two_arms[0].read_text() + "accept: {distance: 1 mm}\n")
    ended = fg_calib("calibrate", *two_arms, "--report", "--out", tmp_path / "out")
    assert ended.code == 3
    assert ended.err.startswith("arm2: not accepted: FAIL: distance")
    assert (tmp_path / "out" / "arm2" / "report.html").is_file()
    assert fg_calib("calibrate", two_arms[0], two_arms[0].with_name("twin.yaml"), "--json").code == 1


def test_two_jobs_of_one_name_and_two_places_to_run_are_refused(fg_calib, two_arms):
    ended = fg_calib("calibrate", two_arms[0], two_arms[0])
    assert (ended.code, ended.out) == (1, "")
    assert re.fullmatch(
        r"error: JOB: .* would be written to the same folder arm1-calibration, expected .*\n", ended.err
    )
    ended = fg_calib("calibrate", *two_arms, "--workers", "2", "--scheduler", "tcp://127.0.0.1:1")
    assert (ended.code, ended.out) == (2, "")
    assert "either this or --scheduler" in ended.err


def test_a_folder_with_jobs_of_somebody_else_is_left_alone(fg_calib, two_arms, tmp_path):
    (tmp_path / "jobs.csv").write_text("my own\n")
    ended = fg_calib("calibrate", *two_arms, "--out", tmp_path)
    assert (ended.code, ended.out) == (1, "")
    assert ended.err.endswith("jobs.csv: is there already, not written by this command, expected another folder\n")
    assert (tmp_path / "jobs.csv").read_text() == "my own\n"


WRITE_AND_DIE = """
import os, signal, sys
from pathlib import Path
from fg_calib.io.atomic import fill_folder
def write(into):
    (into / "result.json").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
fill_folder(Path(sys.argv[1]), write)
"""


@pytest.mark.slow
def test_a_job_whose_process_is_killed_while_it_writes_leaves_nothing(tmp_path):
    class Deadly(Executor):
        def submit(self, *_):
            subprocess.run([sys.executable, "-c", WRITE_AND_DIE, str(tmp_path)], check=False)
            raise BrokenExecutor

    (found,) = calibrate_into([Order("arm", Path("arm.yaml"), tmp_path)], Deadly())
    assert found.verdict == "failed"
    assert list(tmp_path.iterdir()) == []


def started(jobs, out):
    """`calibrate` of many jobs on two processes, in a group of its own, once one of them is done."""
    command = [sys.executable, "-m", "fg_calib.cli", "calibrate", *map(str, jobs), "--workers", "2", "--out", str(out)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    until(lambda: list(out.glob("*/result.json")))
    return process


def until(fact):
    """Wait for it, a minute at most."""
    end = time.monotonic() + 60.0
    while not fact():
        assert time.monotonic() < end
        time.sleep(0.02)


def nobody_left(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("all_of_them", [False, True])  # as kill does, and as the terminal does
def test_what_ends_the_command_ends_the_workers_too_in_one_line(example, tmp_path, number, all_of_them):
    process = started(other_jobs(example, 9), tmp_path / "out")
    (os.killpg if all_of_them else os.kill)(process.pid, number)
    shown, said = process.communicate(timeout=60)
    assert (process.returncode, shown) == (128 + number, "")
    until(lambda: nobody_left(process.pid))
    n = len(list((tmp_path / "out").glob("*/result.json")))
    assert 0 < n < 9
    assert said == f"interrupted; results of {n} of 9 jobs have been written\n"
    assert not (tmp_path / "out" / "jobs.json").exists()


def test_results_are_said_to_be_written_that_were_written_since(tmp_path):
    orders = [Order(name, Path("job.yaml"), tmp_path / name) for name in ("earlier", "now", "later")]
    fill_folder(tmp_path / "earlier", lambda into: write_text(into / "result.json", "{}"))
    said = _written([*orders, Order("nowhere", Path("job.yaml"), None)])
    assert said() == "nothing has been written"
    fill_folder(tmp_path / "now", lambda into: write_text(into / "result.json", "{}"))
    assert said() == "results of 1 of 4 jobs have been written"


@pytest.mark.slow
def test_processes_that_start_do_not_hear_of_an_interrupt(capfd):
    with local_processes(1) as executor:
        future = executor.submit(os.getpid)
        for _ in range(20):
            for process in list(executor._pool._processes):
                os.kill(process, signal.SIGINT)
            time.sleep(0.01)
        assert future.result() in executor._pool._processes
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_workers_end_with_the_process_that_started_them_however_that_ends(example, tmp_path):
    process = started(other_jobs(example, 9), tmp_path / "out")
    process.kill()
    process.communicate(timeout=60)
    until(lambda: nobody_left(process.pid))
    assert len(list((tmp_path / "out").glob("*/result.json"))) < 9


def leave(k):
    if k == 1:
        raise SystemExit(0)
    if k == 2 and threading.current_thread() is not threading.main_thread():
        raise KeyboardInterrupt
    return k


@pytest.mark.parametrize("executor", [None, "threads"])
def test_a_job_that_ends_its_process_is_a_failure_of_its_own(executor):
    with ThreadPoolExecutor(1) as threads:
        found = map_jobs(leave, range(4), None if executor is None else threads)
    assert found[1].reason == "SystemExit: 0"
    assert found[2] == 2 if executor is None else found[2].reason == "KeyboardInterrupt"
    assert [found[0], found[3]] == [0, 3]


def test_jobs_that_somebody_else_gives_up_are_not_waited_for():
    begun = threading.Event()

    def work(k):
        begun.set()
        time.sleep(0.2)
        return k

    with ThreadPoolExecutor(1) as threads:
        give_up = threading.Thread(
            target=lambda: begun.wait() and threads.shutdown(wait=False, cancel_futures=True), daemon=True
        )
        give_up.start()
        found = map_jobs(work, range(4), threads)
    assert found[0] == 0
    assert all(isinstance(one, Failure) for one in found[2:])
