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
