"""A design of measurements that are 1e5 times better than the tolerances."""

import pytest

from fg_calib import design, read_scenario

ROBOT = """\
convention: dh
units: {length: m, angle: deg}
joints:
  - {a: 0.1, alpha: -90, d: 0.4, theta: 0, limits: [-150, 150]}
  - {a: 0.4, alpha: 30, d: 0.1, theta: 0, limits: [-150, 150]}
  - {a: 0.3, alpha: 80, d: 0.2, theta: 0, limits: [-150, 150]}
tool: {x: 0.05, y: 0.02, z: 0.1}
tolerance: {a: 0.001, d: 0.001, alpha: 0.05, theta: 0.1}
"""
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
