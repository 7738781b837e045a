"""What a job of an arm whose axes are nearly parallel leaves undetermined, with reasons and cures."""

import pytest
from test_cures_of_parallel_axes import SCARA, SCENARIO

from fg_calib import design, read_job, read_scenario, simulate, write_simulation
from fg_calib.report.plan import design_document


@pytest.mark.slow
def test_every_direction_of_a_solved_arm_has_a_reason_and_what_is_seen_a_cure(tmp_path):
    """Tilts of a tenth of a degree, as solved: what turns the whole arm is cured, what a tilt shows is not."""
    (tmp_path / "robot.yaml").write_text(SCARA)
    (tmp_path / "s.yaml").write_text(SCENARIO.replace("position}", "position, gauge: none}") + "frame: unknown\n")
    write_simulation(tmp_path / "sim", simulate(read_scenario(tmp_path / "s.yaml"), 0))
    found = design(read_job(tmp_path / "sim" / "calibration.yaml"), n=5, n_candidates=40)
    assert all(row["reason"] for row in design_document(found)["undetermined"])
    by = {name: one.by for one in found.cures for name in one.relation if len(one.relation) == 1}
    for name in ("a1", "alpha1", "theta1"):
        assert by[name][0] == "positions in the base frame"
    assert by["d1"] == ()


WRIST = """\
convention: dh
units: {length: mm, angle: deg}
joints:
  - {a: 0, alpha: -90, d: 360, theta: 0, limits: [-170, 170]}
  - {a: 300, alpha: 0, d: 0, theta: 0, limits: [-110, 110]}
  - {a: 30, alpha: 90, d: 0, theta: 0, limits: [-120, 120]}
  - {a: 0, alpha: 0.0005, d: 126, theta: 0, limits: [-350, 350]}
tool: {x: 20, z: 80}
estimate: [tool.x, tool.y, tool.z]
tolerance: {a: 0.5, d: 0.5, alpha: 0.05, theta: 0.1, tool: 2}
"""


@pytest.mark.slow
def test_a_turn_about_the_tools_own_point_is_known_where_hardly_anything_is_left_out_of_it(tmp_path):
    """A last axis that a calibration tilted by 9e-6 rad: tool.z's share in turning theta4 is below what is named."""
    (tmp_path / "robot.yaml").write_text(WRIST)
    (tmp_path / "s.yaml").write_text(SCENARIO.replace("errors: {normal: tolerance}\n", "") + "frame: unknown\n")
    found = {tuple(one.relation): one for one in design(read_scenario(tmp_path / "s.yaml"), n=9, n_candidates=40).cures}
    turn = next(one for names, one in found.items() if names[0] == "theta4")
    assert "tool.z" not in turn.relation
    assert turn.reason == "the tool only turns about its own point, unseen by position"
