"""A target or a base that moved while a table was measured: from which row on is said, and outliers are none."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import measure, plus, true_robot
from sparing import diagonal
from test_structure import EFFECTS, PLACED, SIGMA, SIGMA_JOINT, arm, measured, problem_of

from fg_calib.assessment import assess
from fg_calib.diagnostics.changes import find_change
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.report.text import format_report
from fg_calib.statistics.goodness_of_fit import KindFit


def moved(what, first, rng, n=45):
    """A table from row `first` of which the target, or the tracker, is half a millimetre away from where it was."""
    robot = arm("6R")
    true = true_robot(robot, rng)
    q = rng.uniform(-2.0, 2.0, (n, 6))
    values, frame = true.nominal, PLACED
    if what == "tool":
        values[[true.index(f"tool.{k}") for k in "xyz"]] += [4e-4, -2e-4, 2e-4]
    elif what == "base":
        frame = (PLACED[0], PLACED[1] + [4e-4, -2e-4, 2e-4])
    parts = [
        measure(at, len(rows), rng, sigma=SIGMA, sigma_joint=SIGMA_JOINT, frame=place, readings=rows)
        for at, place, rows in ((true, PLACED, q[:first]), (true.with_values(values), frame, q[first:]))
    ]
    together = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("readings", "test", "position", "rotation", "sigma_position", "sigma_orientation")
    }
    return robot, replace(parts[0], ids=np.arange(n).astype(str), **together)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["tool", "base"])
@pytest.mark.parametrize("model", ["position", "pose"])
def test_what_moved_is_said_with_the_row(what, model):
    robot, m = moved(what, 22, np.random.default_rng(1))
    solution = solve(problem_of(robot, m, model))
    found = assess(solution)
    assert (found.change.what, found.change.configuration) == (what, 22)
    assert found.findings[0].startswith(f"from configuration 22 on the {what} is not where it was before (chi-square")
    assert not found.noise_may_be_estimated
    report = " ".join(format_report(solution, found).split())
    assert "too large: see what moved, on top" in report
    assert "robust loss" not in report
    assert "few rows" not in report
    assert "follow the arm" not in report


@pytest.mark.sampled(1)
@pytest.mark.parametrize("row", [2, 25, 43])
def test_outliers_are_no_change(row):
    robot, m = moved("nothing", 22, np.random.default_rng(1))
    for rows in (row, [row, 10]):
        spoilt = replace(m, position=plus(m.position, rows, 0.005))
        assert find_change(solve(problem_of(robot, spoilt, "position"))) is None


@pytest.mark.slow
def test_the_last_few_rows_alone_are_no_change():
    """Four rows after a bump are fewer than a change needs: they are outliers, and no other row is where it moved."""
    for seed in range(3):
        robot, m = moved("tool", 41, np.random.default_rng(seed))
        found = assess(solve(problem_of(robot, m, "pose")))
        assert found.change is None
        assert set(found.goodness.gross.names) <= {"41", "42", "43", "44"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "forgotten", "away"), diagonal(["6R", "scara"], ["frame", "tool"], [1.0, 0.03, 0.003])
)
def test_a_frame_or_tool_that_was_forgotten_is_no_change(name, forgotten, away):
    """From metres, where nothing is linear, down to millimetres."""
    robot, m = measured(name, np.random.default_rng(2), n=48)
    if forgotten == "frame":
        turn, shift = Rotation.from_rotvec(away * np.array([0.1, -0.2, 0.3])), away * np.array([1.0, 0.5, -0.5])
        position = turn.apply(PLACED[0].inv().apply(m.position - PLACED[1])) + shift
        problem = build_problem(robot, replace(m, position=position), model="position")
    else:
        values = robot.nominal
        values[[robot.index(f"tool.{k}") for k in "xyz"]] += away * np.array([0.1, -0.2, 0.1])
        known = [p.name for p in robot.parameters if p.estimated and not p.name.startswith("tool")]
        problem = build_problem(robot.with_values(values).with_estimated(known), m, model="position", frame="unknown")
    assert find_change(solve(problem)) is None


@pytest.mark.slow
@pytest.mark.parametrize("effect", EFFECTS)
def test_effects_that_are_not_modelled_are_no_change(effect):
    for seed in range(2):
        robot, m = measured("6R", np.random.default_rng(seed), effect=EFFECTS[effect], n=45)
        assert find_change(solve(problem_of(robot, m, "pose"))) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["6R", "scara"])
def test_noise_has_no_change(name):
    assert find_change(solve(problem_of(*measured(name, np.random.default_rng(1)), "pose"))) is None


def test_many_rows_are_not_called_few():
    given = {"kind": "position", "unit": "m", "n": 100, "stated_sigma_rms": 1e-3, "factor": 1.0, "degrees": 80.0}
    fit = KindFit(**given, seen_over_stated=3.0, chi2=720.0, expected=80.0, p_value=0.0, typical=1.2, largest=20.0)
    assert replace(fit, n_beyond=10).verdict == "outliers"
    assert replace(fit, n_beyond=30).verdict == "many"
