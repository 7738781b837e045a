"""Rank, classes and groups: the paper's tables, invariance, and hand-made matrices."""

import numpy as np
import pytest
from simulated import measure, paper_robot, small_arm

from fg_calib import residuals
from fg_calib.measurements import Pairing
from fg_calib.observability import analyse, observability_indices
from fg_calib.problem import build_problem, observe
from fg_calib.robot import Parameter

# Ranks and groups recomputed independently for Jia et al. (2019), Tables 3 and 4 and the other four measurements.
BASE_FREE = ["a1", "alpha1", "d1", "theta1", "beta6", "theta7", "beta7"]
TABLE = {
    "pose": (
        29,
        [],
        [["beta1", "theta2"], ["beta2", "theta3"], ["d3", "d4", "d5"], ["beta5", "theta6"], ["beta6", "theta7"]],
    ),
    "distance-rotation": (
        23,
        BASE_FREE,
        [["beta1", "theta2"], ["beta2", "theta3"], ["d3", "d4", "d5"], ["beta5", "theta6"]],
    ),
    "distance": (
        21,
        BASE_FREE,
        [["beta1", "theta2"], ["beta2", "theta3"], ["d3", "d4", "d5"], ["beta5", "theta6", "a7"], ["d6", "alpha7"]],
    ),
    "rotation": (
        11,
        None,
        [["beta1", "theta2"], ["beta2", "theta3", "theta4", "theta5"], ["beta5", "theta6"]],
    ),
    "position": (
        25,
        ["beta6", "theta7", "beta7"],
        [["beta1", "theta2"], ["beta2", "theta3"], ["d3", "d4", "d5"], ["beta5", "theta6", "a7"], ["d6", "alpha7"]],
    ),
    "orientation": (
        15,
        None,
        [["beta1", "theta2"], ["beta2", "theta3", "theta4", "theta5"], ["beta5", "theta6"], ["beta6", "theta7"]],
    ),
}


def observed(robot, model, frame="known", n=300, seed=0):
    measurements = measure(robot, n, np.random.default_rng(seed))
    problem = build_problem(robot, measurements, model=model, pairing=Pairing("random", n), frame=frame, prior=False)
    return observe(problem, problem.variables.nominal())


@pytest.mark.parametrize("model", TABLE)
def test_the_papers_robot_has_the_ranks_and_groups_of_its_tables(model):
    rank, ineffective, groups = TABLE[model]
    found = observed(paper_robot(), model)
    assert found.rank == rank
    assert found.gap > 1e6  # exact, not a matter of a threshold
    assert [sorted(g.parameters) for g in found.relative] == [sorted(g) for g in groups]
    if ineffective is not None:
        assert found.named("ineffective") == ineffective
    lost = sum(g.lost for g in found.relative) + len(found.named("ineffective"))
    assert lost == 35 - rank


def test_the_package_keeps_what_the_paper_keeps():
    found = observed(paper_robot(), "pose")
    assert [g.keep for g in found.relative] == [("theta2",), ("theta3",), ("d5",), ("theta6",), ("theta7",)]


def test_relations_say_what_moves_together():
    found = observed(paper_robot(), "distance")
    relations = {g.parameters: g.relations for g in found.relative}
    assert relations[("beta1", "theta2")] == ({"beta1": 1.0, "theta2": -1.0},)
    assert relations[("d3", "d4", "d5")] == ({"d3": 1.0, "d4": -1.0}, {"d4": 1.0, "d5": -1.0})
    # d6 by 0.5 m acts like alpha7 by 1 rad
    assert relations[("d6", "alpha7")] == ({"d6": 0.5, "alpha7": 1.0},)


def test_every_relation_moves_no_measurement():
    robot = paper_robot()
    measurements = measure(robot, 60, np.random.default_rng(1))
    problem = build_problem(robot, measurements, model="distance", prior=False)
    found = observe(problem, problem.variables.nominal())
    J = residuals.linearise(problem.blocks[0], problem.variables.chain.at(problem.variables.nominal()))[1][:, 0]
    for group in found.relative:
        for relation in group.relations:
            direction = np.array([relation.get(name, 0.0) for name in problem.variables.names])
            assert np.abs(J @ direction).max() < 1e-9 * np.abs(J * direction).max()


def test_an_unknown_frame_makes_the_base_ineffective():
    found = observed(paper_robot(), "pose", frame="unknown")
    assert found.rank == 25
    assert found.named("ineffective") == ["a1", "alpha1", "d1", "theta1"]


def test_a_generic_arm_with_known_frame_determines_everything():
    found = observed(small_arm(), "pose")
    # 4 a revolute joint, 2 for the prismatic one, which only has a direction; 6 for the ends, less what mdh lacks
    assert found.rank == found.singular_values.size - len(found.null_space)
    assert set(found.classes) <= {"independent", "relative"}


def test_the_answer_does_not_depend_on_units():
    rng = np.random.default_rng(2)
    J = rng.normal(size=(20, 5))
    J[:, 4] = 2 * J[:, 3]
    kinds = ["a", "a", "d", "d", "theta"]
    metres = analyse(J, [Parameter(f"{k}{i}", k, i, 0.0, 1e-3) for i, k in enumerate(kinds)], n_measurements=10)
    unit = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1.0])  # columns per millimetre
    parameters = [Parameter(f"{k}{i}", k, i, 0.0, 1e-3 / unit[i]) for i, k in enumerate(kinds)]
    millimetres = analyse(J * unit, parameters, n_measurements=10)
    assert millimetres.singular_values == pytest.approx(metres.singular_values, rel=1e-12, abs=1e-15)
    assert millimetres.classes == metres.classes == ("independent",) * 3 + ("relative",) * 2
    assert millimetres.indices == pytest.approx(metres.indices)
    assert metres.relative[0].keep == millimetres.relative[0].keep == ("theta4",)
    assert metres.relative[0].relations == ({"d3": 1.0, "theta4": -0.5},)
    assert millimetres.relative[0].relations == ({"d3": 1.0, "theta4": -0.0005},)


def test_indices_follow_their_formulas():
    s = np.array([8.0, 4.0, 2.0])
    assert observability_indices(s, 4) == pytest.approx(
        {"O1": 4.0 / 2, "O2": 0.25, "O3": 2.0, "O4": 0.5, "O5": 1 / 0.875}
    )
    assert observability_indices(np.array([]), 4)["O3"] == 0.0
