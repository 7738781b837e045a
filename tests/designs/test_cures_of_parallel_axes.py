"""A kind of measurement that is named as a cure of several directions cures them together."""

import pytest

from fg_calib import design, read_scenario

SCARA = """\
convention: mdh
units: {length: m, angle: deg}
joints:
  - {a: 0, alpha: 0, d: 0.4, theta: 0, limits: [-130, 130]}
  - {a: 0.35, alpha: 0, d: 0, theta: 0, limits: [-140, 140]}
  - {type: prismatic, a: 0.25, alpha: 180, d: 0.05, theta: 0, limits: [0, 0.2]}
  - {a: 0, alpha: 0, d: 0.1, theta: 0, limits: [-180, 180]}
tool: {x: 0.05, z: 0.1}
tolerance: {a: 0.001, alpha: 0.1, d: 0.001, theta: 0.1}
"""
SCENARIO = """\
robot: robot.yaml
units: {length: mm, angle: deg}
errors: {normal: tolerance}
configurations: {random: {count: 20}}
noise: {position: 0.05, orientation: 0.01}
job: {model: position}
"""


def cures(folder, frame):
    (folder / "robot.yaml").write_text(SCARA)
    (folder / "scenario.yaml").write_text(f"{SCENARIO}frame: {frame}\n")
    return design(read_scenario(folder / "scenario.yaml"), n=12, n_candidates=30).cures


@pytest.mark.slow
def test_what_positions_in_the_base_frame_cure_is_no_longer_lost_with_them(tmp_path):
    unknown, known = cures(tmp_path, "unknown"), cures(tmp_path, "base")
    cured = [one.relation for one in unknown if "positions in the base frame" in one.by]
    assert [list(one) for one in cured] == [["a1"], ["alpha1"], ["d1"], ["theta1"]]
    assert len(unknown) - len(cured) == len(known)  # what is left is as many as are lost with the cure
    for one in known:
        assert not one.by
        assert one in unknown  # of the arm's d1 to d4 only the sum acts, wherever positions are measured
