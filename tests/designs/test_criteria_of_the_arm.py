"""Criteria of the literature are of the arm's parameters: where the measurement frame is counts as unknown."""

import numpy as np
import pytest
from three_joints import ROBOT

from fg_calib import GivenReadings, design, read_scenario
from fg_calib.designs.criteria import Measure
from fg_calib.designs.information import build_system

SCENARIO = """\
robot: robot.yaml
units: {length: m, angle: deg}
errors: {normal: tolerance}
configurations: {random: {count: 5}}
noise: {position: 0.00005, orientation: 0.01}
frame: unknown
job: {model: pose}
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """Eight poses in an unknown frame of twelve."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "robot.yaml").write_text(ROBOT)
    (folder / "scenario.yaml").write_text(SCENARIO)
    readings = np.random.default_rng(0).uniform(-2.0, 2.0, (12, 3))
    scenario = read_scenario(folder / "scenario.yaml")
    return design(scenario, n=8, criterion="D", candidates=GivenReadings(readings), task=readings)


def singular_values(stops, chosen, n_arm):
    """Those of the arm's information with all else eliminated, by a Schur complement."""
    A = np.vstack([stops.always, stops.rows[chosen].reshape(-1, len(stops.scales))]) * stops.scales
    M = A.T @ A + 1e-6 * np.eye(A.shape[1])  # the weak prior: 1 rad, or the arm's reach, in changes of 1 mrad
    S = M[:n_arm, :n_arm] - M[:n_arm, n_arm:] @ np.linalg.solve(M[n_arm:, n_arm:], M[n_arm:, :n_arm])
    return np.sqrt(np.linalg.eigvalsh(S))[::-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("criterion", "formula"),
    [
        ("D", lambda s: -2.0 * np.sum(np.log(s))),
        ("A", lambda s: np.sum(s**-2.0)),
        ("E", lambda s: -s[-1]),
        ("O2", lambda s: -s[-1] / s[0]),
        ("O4", lambda s: -(s[-1] ** 2) / s[0]),
        ("O5", lambda s: np.sum(1.0 / s)),
    ],
)
def test_criteria_are_of_the_arm_alone(plan, criterion, formula):
    stops, chosen = plan.pool.rows, np.arange(8)
    system = build_system(stops, plan.pool.known, plan.task.quadratic_form(plan.pool.problem))
    assert len(system.core) == 12  # of 12 parameters; the frame has 6 more
    # Both invert an information of condition 1e6: 1e-9 of it is left of 1e-16.
    expected = formula(singular_values(stops, chosen, 12))
    assert Measure(criterion, system).value(system.information(chosen)) == pytest.approx(expected, rel=1e-8)
