"""`fg-calib observe`: tables, files, options, and what it refuses."""

import json

import pytest
from exported import TREE

from fg_calib import read_robot


def test_structure_prints_the_papers_table(fg_calib, example):
    ended = fg_calib("observe", example / "robot_nominal.yaml")
    assert (ended.code, ended.err) == (0, "")
    assert "rank 23 of 35" in ended.out
    text = " ".join(ended.out.split())
    assert "[beta1 theta2], [beta2 theta3], [d3 d4], [d4 d5], [beta5 theta6]" in text
    assert "Ineffective a1, alpha1, d1, theta1, beta6, theta7, beta7" in text
    assert "With a1, alpha1, d1, theta1, beta1 known" in ended.out
    assert "rank 23 of 30" in ended.out


@pytest.mark.parametrize(("words", "rank"), [("pose", 29), ("pose --frame unknown", 25), ("rotation", 11)])
def test_json_has_every_key_of_its_schema(fg_calib, example, words, rank):
    model, *frame = words.split()
    ended = fg_calib("observe", example / "robot_nominal.yaml", "--model", model, *frame, "--json")
    found = json.loads(ended.out)
    assert found["schema"] == "fg-calib/observability/1"
    assert (found["model"], found["kind"], found["rank"], found["n_parameters"]) == (model, "structural", rank, 35)
    assert len(found["names"]) == len(found["singular_values"]) == 35
    assert len(found["null_space"]) == 35 - rank == len(found["lost"])
    assert found["gap"] > 1e6
    assert set(found["indices"]) == {"O1", "O2", "O3", "O4", "O5"}
    lost = len(found["ineffective"]) + sum(group["lost"] for group in found["relative"])
    assert lost == 35 - rank
    members = [name for group in found["relative"] for name in group["parameters"]]
    assert sorted([*found["independent"], *found["ineffective"], *members]) == sorted(found["names"])
    for group in found["relative"]:
        assert len(group["relations"]) == group["lost"] == len(group["parameters"]) - len(group["keep"])
    assert all(direction["reason"] for direction in found["lost"])


@pytest.mark.slow
def test_configurations_give_sigmas_and_files(fg_calib, example, tmp_path):
    folder = tmp_path / "seen"
    words = "observe", example / "robot_nominal.yaml", "--configurations", example / "poses.csv", "--angle", "deg"
    ended = fg_calib(*words, "--orientation-noise", 0.01, "--joint-noise", 0.005, "--out", folder, "--json")
    assert ended.code == 0
    found = json.loads(ended.out)
    assert json.loads((folder / "observability.json").read_text()) == found
    assert (found["kind"], found["n_configurations"], found["rank"]) == ("practical", 52, 23)
    assert set(found["sigma"]) == set(found["kept"])
    assert found["weak"][0]["signal_to_noise"] < 10
    assert all(abs(pair["correlation"]) > 0.9 for pair in found["correlations"])
    noise = "--orientation-noise", 0.005, "--position-noise", 0.0005, "--joint-noise", 0.0025
    finer = fg_calib(*words, *noise, "--json")
    halved = json.loads(finer.out)["sigma"]
    assert halved["a2"] == pytest.approx(found["sigma"]["a2"] / 2, rel=1e-3)


def test_links_of_a_urdf_are_named(fg_calib, tmp_path):
    (tmp_path / "arm.urdf").write_text(TREE)
    found = json.loads(fg_calib("observe", tmp_path / "arm.urdf", "--model", "pose", "--tip-link", "tip", "--json").out)
    of_tip = read_robot(tmp_path / "arm.urdf", tip_link="tip")
    assert found["names"] == [p.name for p in of_tip.parameters if p.estimated]
