"""`fg-calib inspect`: exit codes, the report, and what `--json` promises."""

import json

import pytest
import yaml

from fg_calib.report import inspection_document

JOB = "calibration.yaml"


@pytest.fixture(autouse=True)
def width(monkeypatch):
    """As wide as a pipe: where tests run in parallel, COLUMNS is that of the terminal or 80."""
    monkeypatch.setenv("COLUMNS", "100")


@pytest.mark.slow
def test_a_healthy_job_ends_with_0_and_its_verdict_stands_first(fg_calib, whole_example):
    ended = fg_calib("inspect", whole_example / JOB)
    assert (ended.code, ended.err) == (0, "")
    lines = [line.rstrip() for line in ended.out.splitlines()]
    assert lines[:2] == [
        "space-robot: distance-rotation, pairs: star",
        "READY: nothing speaks against calibrating this job",
    ]
    words = ["rows configurations test rows train pairs test pairs residuals to fit"]
    words += ["poses.csv 552 552 500 51 499 51 distance, 51 angle"]
    assert [" ".join(line.split()) for line in lines[4:6]] == words
    assert "What these rows can determine: 23 of 30 parameters" in lines
    assert " 102 degrees of freedom" in ended.out
    assert "position mm 5.6799 5.6780" in [" ".join(line.split()) for line in lines]
    assert not any(line.startswith("Notes") for line in lines)
    assert max(map(len, lines)) <= 100


@pytest.mark.slow
def test_a_mistake_in_units_ends_with_3_and_one_line(fg_calib, example):
    changes = {"units": {"length": "mm", "angle": "deg"}, "noise": {"position": 1, "orientation": 0.01}}
    (example / JOB).write_text(yaml.safe_dump(yaml.safe_load((example / JOB).read_text()) | changes))
    ended = fg_calib("inspect", example / JOB)
    assert ended.code == 3
    assert ended.err.startswith("look at this first: distance residuals fall from")
    assert ended.err.count("\n") == 1
    assert "are in m, not mm" in ended.err
    assert ended.out.splitlines()[1].startswith("LOOK AT THIS FIRST: distance residuals fall from")
    assert "far too large" in ended.out


def _refuse(constant):
    raise AssertionError(f"{constant} is no JSON")


def test_json_has_every_key_and_nothing_else_is_on_stdout(fg_calib, example):
    ended = fg_calib("inspect", example / JOB, "--json")
    assert (ended.code, ended.err) == (0, "")
    found = json.loads(ended.out, parse_constant=_refuse)
    shape = {
        "schema": str, "version": str, "robot": str, "ready": bool, "findings": list, "cautions": list,
        "evaluated": bool, "tables": list, "joints": list, "residuals": list, "explanations": list,
        "disagreements": list, "n_residuals": int, "n_priors": int, "n_unknowns": int, "dof": int,
        "n_excluded": dict, "observability": dict, "expected_error": dict, "inputs": dict,
    }  # fmt: skip
    assert {key: type(value) for key, value in found.items()} == shape
    assert found["schema"] == "fg-calib/inspection/1"
    assert found["observability"]["schema"].startswith("fg-calib/observability/")
    assert found["tables"][0]["n_rows"] == 102
    assert set(found["residuals"][0]) == {"table", "kind", "unit", "size", "expected", "excess", "n"}
    assert set(found["joints"][0]) == {"name", "unit", "least", "most", "limits", "share", "still", "n_outside"}
    assert isinstance(found["expected_error"]["base"]["position"], int | float)
    assert set(found["inputs"]) == {JOB, "poses.csv", "robot_nominal.yaml", "robot_true.yaml"}
    assert all(f'"{key}"' in (inspection_document.__doc__ or "") for key in found)
