"""A new instrument with a column of its own is one file of `kinds` and a line in `options.MODELS`."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import fg_calib

INCLINOMETER = '''"""Inclinometers: the angle between the tool's z axis and the vertical."""

from __future__ import annotations

import numpy as np

from fg_calib.inputs import Floats
from fg_calib.measurements import Frames, Kind, Rows
from fg_calib.measurements.kinds.instrument import Column, Instrument


class Inclination(Kind):
    """`acos(e_z . R e_z) - measured`, [rad]; with z = R e_z its derivative is `-(z x e_z) . w / |z x e_z|`."""

    names, units = ("inclination",), ("rad",)
    ends, residual_dim, width = 1, 1, 1

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        z = at.rotation[:, 0, :, 2]
        across = np.cross(z, [0.0, 0.0, 1.0])
        sine = np.linalg.norm(across, axis=1)
        D = np.zeros((len(z), 1, 1, 6))
        D[:, 0, 0, :3] = -across / sine[:, None]
        return Rows(np.arctan2(sine, z[:, 2])[:, None] - data[:, :1], D)


class Inclinometer(Instrument):
    """Inclinations of the tool's z axis."""

    model, words, kind = "inclination", "measured inclinations", Inclination()
    columns = (Column(("inclination",), "angle", "Angle between the tool's z axis and the vertical", generic=True),)
    noise, sees_position, sees_orientation = ("inclination",), False, True


INSTRUMENTS = (Inclinometer(),)
'''

ROBOT = """\
name: wrist
convention: dh
units: {length: m, angle: deg}
joints:
  - {a: 0.02, alpha: 90, d: 0.3, theta: 0, limits: [-170, 170]}
  - {a: 0.40, alpha: 20, d: 0.0, theta: 0, limits: [-170, 170]}
  - {a: 0.30, alpha: 70, d: 0.1, theta: 30, limits: [-170, 170]}
tolerance: {a: 0.001, d: 0.001, alpha: 0.5, theta: 0.5}
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


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The command line of a copy of the package with the new instrument, in a folder with a scenario."""
    folder = tmp_path_factory.mktemp("copy")
    source = Path(fg_calib.__file__).parent
    shutil.copytree(source, folder / "fg_calib", ignore=shutil.ignore_patterns("*.pyc"))
    (folder / "fg_calib/measurements/kinds/inclinometer.py").write_text(INCLINOMETER)
    options = folder / "fg_calib/inputs/options.py"
    plane = '    "plane": "plane",\n'
    options.write_text(options.read_text().replace(plane, plane + '    "inclination": "inclinometer",\n'))
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
def test_a_new_instrument_is_simulated_into_a_table_with_its_column(run):
    _, folder = run("inspect", "simulated/calibration.yaml")
    header = (folder / "simulated/levels.csv").read_text().splitlines()[0].split(",")
    assert "inclination" in header
    assert {"x", "qx", "distance"}.isdisjoint(header)


@pytest.mark.slow
def test_a_new_instrument_is_calibrated_to_its_noise_and_reported(run):
    text, folder = run("calibrate", "simulated/calibration.yaml", "--out", "result", "--report")
    result = json.loads((folder / "result/result.json").read_text())
    assert 0.6 < result["reduced_chi2"] < 1.5
    assert result["residual_rms"]["test"]["inclination"]["after"] < 2.5e-4  # 0.01 deg are 1.75e-4 rad
    assert result["residual_rms"]["test"]["inclination"]["before"] > 1e-3
    assert "inclination" in text
    assert "inclination" in (folder / "result/report.html").read_text()


@pytest.mark.slow
def test_what_a_new_instrument_can_identify_follows_from_its_kind(run):
    text, _ = run("observe", "robot.yaml", "--model", "inclination", "--json")
    found = json.loads(text)
    assert found["rank"] > 0
    assert set(found["ineffective"]) >= {"a1", "d1", "a2", "d2", "a3", "d3", "theta1"}
