"""Every experiment runs, answers its questions, and gives the same rows again."""

import json
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"
sys.path.insert(0, str(EXPERIMENTS))

import common  # noqa: E402
import verify  # noqa: E402

QUICK = [
    ("paper", "identifiability"), ("paper", "claims"), ("real_data", "panda"), ("validation", "landmarks"),
    ("validation", "outliers"), ("validation", "monitoring"), ("design", "criteria"), ("speed", "steps"),
    ("effects", "ranks"), ("effects", "arm"),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("script", "question"), QUICK)
def test_an_experiment_answers_its_question(script, question, tmp_path, monkeypatch):
    module = __import__(script)
    words = ["--quick", "--only", question, "--out", str(tmp_path)]
    record = common.run(module.QUESTIONS, script, module.__doc__, words)
    assert json.loads((tmp_path / f"{script}.json").read_text()) == record
    assert len(record[question]["answer"]) > 20
    monkeypatch.setattr(verify, "RESULTS", tmp_path)
    assert verify.verify(script)


def test_a_changed_number_differs_from_its_record():
    then = {"rank": 23, "rms": 1.25, "names": ["a", "b"], "gap": 1e12}
    assert list(verify.differences(then, {**then, "gap": 3e12, "rms": 1.25 + 1e-8})) == []
    assert list(verify.differences(then, {**then, "rms": 1.2501})) == ["rms: recorded 1.25, now 1.2501"]
    assert list(verify.differences(then, {**then, "names": ["a", "c"]})) == ["names: recorded 'b', now 'c'"]
    assert len(list(verify.differences(then, {**then, "rank": 22}))) == 1


def test_the_ledger_is_generated_from_the_records():
    assert (EXPERIMENTS / "README.md").read_text() == verify.ledger()


def test_every_question_names_a_function_that_workers_can_load():
    for script in verify.SCRIPTS:
        module = __import__(script)
        for question in module.QUESTIONS:
            assert getattr(module, question.work.__name__) is question.work
            assert question.words.endswith("?")
