"""The bundled examples: each is its scenario simulated, and its calibration finds the true arm."""

import re

import numpy as np
import pytest
from scipy.stats import chi2
from simulated import nees

from fg_calib import calibrate_job, cli, read_robot, simulate
from fg_calib.cli.init import EXAMPLES
from fg_calib.simulation import read_scenario, write_simulation

ROUNDED = 6e-5
"""Tables are stored with four decimals."""

NUMBER = r"(?<=,)-?\d+\.\d+(?:e-\d+)?"


def test_help_and_a_refusal_name_all_examples(fg_calib, tmp_path):
    assert EXAMPLES == ["camera", "sockets", "space-robot", "ur10-tracker"]
    assert ", ".join(EXAMPLES) in re.sub(r"[\s│]+", " ", fg_calib("example", "--help").out)
    refused = fg_calib("example", "scara", "--out", tmp_path / "demo")
    assert (refused.code, refused.err) == (1, f"error: example: found 'scara', expected one of {', '.join(EXAMPLES)}\n")


@pytest.mark.parametrize("name", sorted({*EXAMPLES} - {"space-robot"}))
def test_an_example_is_its_scenario_simulated(name, tmp_path):
    folder = cli.EXAMPLES / name
    (seed,) = re.findall(r"--seed (\d+)", (folder / "calibration.yaml").read_text())
    write_simulation(tmp_path, simulate(read_scenario(folder / "scenario.yaml"), int(seed)))
    for table in folder.glob("*.csv"):
        stored, again = (path.read_text() for path in (table, tmp_path / table.name))
        assert re.sub(NUMBER, "#", stored) == re.sub(NUMBER, "#", again)
        values = ([float(x) for x in re.findall(NUMBER, text)] for text in (stored, again))
        np.testing.assert_allclose(*values, atol=ROUNDED, rtol=0)
    true, again = (read_robot(at / "robot_true.yaml").nominal for at in (folder, tmp_path))
    np.testing.assert_allclose(true, again, atol=1e-9)


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_calibrates_to_the_true_arm(name):
    found = calibrate_job(cli.EXAMPLES / name / "calibration.yaml")
    squares, n = nees(found.assessment, read_robot(cli.EXAMPLES / name / "robot_true.yaml"))
    low, high = chi2.interval(0.999, n)
    assert not found.assessment.verdict.errors
    assert low < squares < high
