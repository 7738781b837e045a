"""Many jobs on any executor: outcomes in order; a job that fails or kills its worker does not affect the others."""

import json
import pickle
from concurrent.futures import Future, ThreadPoolExecutor
from typing import get_args
from unittest.mock import Mock

import numpy as np
import pytest
from deadly import die_once, work

from fg_calib import InputError, ProblemError, calibrate_jobs
from fg_calib.batch import JobSummary, Verdict, exit_code, job_names
from fg_calib.parallel import DIED, Failure, listener, local_processes, map_jobs

JOBS = [1, "refused", 2, "a bug", "too large", 3]


@pytest.mark.parametrize("executor", [None, ThreadPoolExecutor(3)])
def test_a_job_that_fails_does_not_affect_the_others(executor):
    found = map_jobs(work, JOBS, executor)
    assert [found[k] for k in (0, 2, 5)] == [2, 4, 6]
    assert found[1] == Failure("job 2", "job.yaml: found nonsense, expected sense; look at it")
    assert (found[3].job, found[3].reason) == ("job 4", "KeyError: 'of\\nmine'")
    assert "deadly.py" in found[3].trace
    assert found[4] == Failure("job 5", "there is not enough memory for it")


def test_progress_is_reported_to_the_listener():
    told, token = [], None
    token = listener.set(lambda *what: told.append(what))
    try:
        map_jobs(work, [1, 2])
    finally:
        listener.reset(token)
    assert told == [("calibrating", 0, 2), ("calibrating", 1, 2)]


def test_an_executor_that_refuses_a_job_fails_that_job_alone():
    class Refusing(ThreadPoolExecutor):
        def submit(self, function, *arguments):
            if arguments[1] == 2:
                refused = Future()
                refused.set_exception(TypeError("cannot pickle it"))
                return refused
            return super().submit(function, *arguments)

    with Refusing(1) as executor:
        assert map_jobs(work, [1, 2, 3], executor) == [2, Failure("job 2", "TypeError: cannot pickle it"), 6]


@pytest.mark.parametrize("n", [0, 1001, 1.5, True])
def test_the_number_of_processes_is_checked(n):
    with pytest.raises(InputError, match="workers: found"):
        local_processes(n)


@pytest.mark.parametrize("kind", [InputError, ProblemError])
def test_an_error_is_the_same_after_a_pickle(kind):
    error = kind("poses.csv:17", "found 4", "less", "is it in deg?")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_folders_get_different_names():
    assert job_names(["a.yaml", "x/b.yaml"]) == ["a", "b"]
    assert job_names(["a/job.yaml", "b/job.yaml"]) == ["a", "b"]
    assert job_names(["a/cold.yaml", "b/cold.yaml", "a/warm.yaml"]) == ["a-cold", "b-cold", "a-warm"]
    with pytest.raises(InputError, match=r"JOB: .* would be written to the folder 'a-job', expected different names"):
        job_names(["a/job.yaml", "x/a/job.yaml"])


@pytest.mark.slow
def test_workers_that_cannot_start_are_one_line(monkeypatch):
    monkeypatch.setattr("fg_calib.parallel.ProcessPoolExecutor", Mock(side_effect=BrokenPipeError(32, "Broken pipe")))
    with pytest.raises(InputError, match=r"workers: no process starts: .*Broken pipe"):
        local_processes(2)


def test_a_job_that_kills_its_process_is_a_failure_of_its_own_and_once_costs_nothing(tmp_path):
    with local_processes(2) as executor:
        assert map_jobs(work, [1, "deadly", 2, 3], executor) == [2, Failure("job 2", DIED), 4, 6]
    with local_processes(1) as executor:  # a second job may be lost before it has died once
        assert map_jobs(die_once, [tmp_path / "1"], executor) == [None]


@pytest.mark.slow
def test_workers_import_no_file_of_the_folder_that_they_start_in(example, fg_calib, monkeypatch):
    (example / "multiprocessing.py").write_text("raise SystemExit('mine')")
    monkeypatch.chdir(example)
    monkeypatch.delenv("PYTHONSAFEPATH")
    ended = fg_calib("calibrate", "calibration.yaml", "missing.yaml", "--workers", 1)
    assert "1 good, 1 failed" in ended.out


@pytest.mark.slow
def test_many_jobs_are_the_same_here_and_on_other_processes(example):
    job = example / "calibration.yaml"
    (here,) = calibrate_jobs([job])
    with local_processes(2) as executor:
        there = calibrate_jobs([job, job], executor)
    for found in there:
        assert np.array_equal(found.solution.parameters, here.solution.parameters)
        assert np.array_equal(found.covariance(), here.covariance(), equal_nan=True)


def test_many_jobs_are_written_to_a_folder_each_with_one_table(example, tmp_path, fg_calib):
    bad = tmp_path / "bad.yaml"
    bad.write_text("robot: nowhere.yaml\nmeasurements: poses.csv\nmodel: pose\n")
    ended = fg_calib("calibrate", example / "calibration.yaml", bad, "--out", tmp_path / "out")
    assert ended.code == 1
    assert ended.err.startswith("bad: error: ")
    assert "nowhere.yaml: no such file" in ended.err
    document = json.loads((tmp_path / "out" / "jobs.json").read_text())
    assert [job["verdict"] for job in document["jobs"]] == ["good", "failed"]
    assert document["exit_code"] == 1
    assert (tmp_path / "out" / "calibration" / "result.json").exists()
    lines = (tmp_path / "out" / "jobs.csv").read_text().splitlines()
    assert lines[0].startswith("name,job,verdict,robot,n_configurations,reduced_chi2,seconds,rms ")
    assert lines[2].startswith(f"bad,{bad},failed,")


def test_the_worst_job_decides_the_exit_code():
    good, refused, doubtful, failed = (JobSummary("a", "a.yaml", verdict) for verdict in get_args(Verdict))
    cases = ([], [good], [good, refused], [good, doubtful], [doubtful, failed])
    assert [exit_code(jobs) for jobs in cases] == [0, 0, 3, 3, 1]
