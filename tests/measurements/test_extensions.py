"""`docs/architecture.md` adds an instrument and an effect of joints: applied to a copy, they work from end to end."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import fg_calib

PAGE = Path(__file__).resolve().parents[2] / "docs/architecture.md"

ROBOT = """\
name: wrist
convention: dh
units: {length: m, angle: deg}
joints:
  - {a: 0.02, alpha: 90, d: 0.3, theta: 0, limits: [-170, 170]}
  - {a: 0.40, alpha: 20, d: 0.0, theta: 0, limits: [-170, 170]}
  - {a: 0.30, alpha: 70, d: 0.1, theta: 30, limits: [-170, 170]}
tolerance: {a: 0.001, d: 0.001, alpha: 0.5, theta: 0.5, gain: 0.002, square: 0.001}
effects: {gain: {joints: [2, 3]}, square: {joints: [2, 3]}, harmonics: {joints: [3]}}
"""

SCENARIO = """\
robot: robot.yaml
configurations: {random: {count: 80}}
validation: {random: {count: 20}}
units: {length: m, angle: deg}
errors: {normal: tolerance}
noise: {inclination: 0.01}
instruments:
  - {model: inclination, name: levels}
"""


def extend(root):
    """A package with what the page adds to it."""
    text = PAGE.read_text()
    name, module = re.search(r"^```python\n# (\S+)\n(.*?)^```$", text, flags=re.S | re.M).groups()
    (root / name).write_text(module)
    for block in re.findall(r"^```diff\n(.*?)^```$", text, flags=re.S | re.M):
        for name, before, more in re.findall(r"--- (\S+)\n (.*\n)((?:\+.*\n)+)", block):
            source = (root / name).read_text()
            assert source.count(before) == 1, f"{name}: {before}"
            added = re.sub(r"^\+", "", more, flags=re.M)
            (root / name).write_text(source.replace(before, before + added))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The command line of an extended copy of the package, in a folder with a scenario."""
    folder = tmp_path_factory.mktemp("copy")
    shutil.copytree(Path(fg_calib.__file__).parent, folder / "fg_calib", ignore=shutil.ignore_patterns("*.pyc"))
    extend(folder)
    (folder / "robot.yaml").write_text(ROBOT)
    (folder / "scenario.yaml").write_text(SCENARIO)

    def call(*arguments):
        command = [sys.executable, "-m", "fg_calib.cli", *arguments]
        settings = {"cwd": folder, "env": os.environ | {"PYTHONPATH": str(folder)}}
        done = subprocess.run(command, capture_output=True, text=True, check=False, **settings)
        assert done.returncode == 0, done.stderr
        return done.stdout, folder

    call("simulate", "scenario.yaml", "--seed", "1", "--out", "simulated")
    return call


@pytest.mark.slow
def test_a_new_instrument_and_a_new_effect_are_calibrated_and_reported(run):
    text, folder = run("calibrate", "simulated/calibration.yaml", "--out", "result", "--report")
    result = json.loads((folder / "result/result.json").read_text())
    assert 0.6 < result["reduced_chi2"] < 1.5
    assert result["residual_rms"]["test"]["inclination"]["after"] < 2.5e-4  # 0.01 deg are 1.75e-4 rad
    assert result["residual_rms"]["test"]["inclination"]["before"] > 1e-3
    found = {p["name"]: p for p in result["parameters"]}
    true, calibrated = (
        yaml.safe_load((folder / name).read_text())["effects"]["values"]
        for name in ("simulated/robot_true.yaml", "result/robot_calibrated.yaml")
    )
    for name, unit in ((f"theta{j}.{kind}", "1") for j in (2, 3) for kind in ("gain", "square")):
        one = found[name]
        assert one["unit"] == unit
        assert one["sigma"] < 0.3 * one["prior_sigma"]
        assert abs(one["estimate"] - true[name]) < 3.0 * one["sigma"]
        assert one["estimate"] == pytest.approx(calibrated[name], rel=0.0, abs=5.1e-9)
    assert found["theta3.sin1"]["unit"] == "rad"
    for words in (text, (folder / "result/report.html").read_text()):
        assert "inclination" in words
        assert "theta2.square" in words
        assert "ppm" in words


@pytest.mark.slow
def test_a_new_instrument_is_observed_and_its_job_designed_further(run):
    text, _ = run("observe", "robot.yaml", "--model", "inclination", "--json")
    found = json.loads(text)
    assert {"theta2.gain", "theta3.gain", "theta2.square", "theta3.square"} <= set(found["independent"])
    assert set(found["ineffective"]) >= {"a1", "d1", "a2", "d2", "a3", "d3", "theta1"}
    assert json.loads(run("design", "simulated/calibration.yaml", "--n", "4", "--json")[0])


@pytest.mark.slow
def test_a_new_instrument_is_simulated_into_a_table_with_its_column_and_drafted_with_its_sigmas(run):
    _, folder = run("inspect", "simulated/calibration.yaml")
    header, *rows = (folder / "simulated/levels.csv").read_text().splitlines()
    assert set(header.split(",")) == {"id", "q1", "q2", "q3", "inclination", "split"}
    (folder / "levels.csv").write_text("\n".join([f"{header},sigma_inclination", *(f"{row},0.02" for row in rows)]))
    run("init", "robot.yaml", "levels.csv", "--out", "drafted.yaml")
    job = yaml.safe_load((folder / "drafted.yaml").read_text())
    assert job["measurements"][0]["model"] == "inclination"
    assert "inclination" not in job["noise"]
    run("calibrate", "drafted.yaml", "--out", "drafted")
    (ratio,) = json.loads((folder / "drafted/result.json").read_text())["noise_factors"].values()
    assert 0.3 < ratio < 0.8
