"""A design of measurements that are 1e5 times better than the tolerances."""

import pytest
from three_joints import ROBOT

from fg_calib import design, read_scenario

SCENARIO = """\
robot: robot.yaml
units: {length: m, angle: deg}
errors: {normal: tolerance}
configurations: {random: {count: 5}}
frame: unknown
instruments:
  - {model: position, targets: 2}
"""


@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["I", "D", "E"])
def test_what_tolerances_alone_determine_is_not_lost_beside_tiny_noise(tmp_path, criterion):
    (tmp_path / "robot.yaml").write_text(ROBOT)

    def expected(noise):
        (tmp_path / "scenario.yaml").write_text(f"{SCENARIO}noise: {{position: {noise}}}\n")
        plan = design(read_scenario(tmp_path / "scenario.yaml"), n=12, n_candidates=30, criterion=criterion)
        assert plan.unknown == 0.0
        return plan.expected.position

    # Where the targets are on the tool is unknown: what the last joint is off by stays as its tolerances say, whatever
    # the noise. What 1 um adds to 1 mm, in squares, is 1e-6 of it, times ten for the geometry.
    assert expected(1e-8) == pytest.approx(expected(1e-6), rel=1e-5)
