"""Rank, classes and groups: the paper's tables, invariance, and hand-made matrices."""

import numpy as np
import pytest
from simulated import measure, paper_robot

from fg_calib import Pairing, build_problem
from fg_calib.observability.identifiability import observability_of
from fg_calib.observability.indices import RelativeGroup, _chained, observability_indices, observability_of_rows
from fg_calib.robot import Parameter

# Ranks and groups recomputed independently for Jia et al. (2019), Tables 3 and 4 and the other four measurements.
BASE_FREE = ["a1", "alpha1", "d1", "theta1", "beta6", "theta7", "beta7"]
BOTH = [["beta1", "theta2"], ["beta2", "theta3"], ["d3", "d4", "d5"]]
TURNS = [["beta1", "theta2"], ["beta2", "theta3", "theta4", "theta5"], ["beta5", "theta6"]]
POINTS = [["beta5", "theta6", "a7"], ["d6", "alpha7"]]
TABLE = {
    "pose": (29, [], [*BOTH, ["beta5", "theta6"], ["beta6", "theta7"]]),
    "distance-rotation": (23, BASE_FREE, [*BOTH, ["beta5", "theta6"]]),
    "distance": (21, BASE_FREE, [*BOTH, *POINTS]),
    "rotation": (11, None, TURNS),
    "position": (25, ["beta6", "theta7", "beta7"], [*BOTH, *POINTS]),
    "orientation": (15, None, [*TURNS, ["beta6", "theta7"]]),
}


def observed(robot, model, frame="known", n=300, seed=0):
    measurements = measure(robot, n, np.random.default_rng(seed))
    problem = build_problem(robot, measurements, model=model, pairing=Pairing("random", n), frame=frame, prior=False)
    return observability_of(problem, problem.variables.nominal())


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


def test_relations_are_chained_each_to_the_next():
    found = _chained(np.array([[1.0, 0.0, 0.0, -2.0], [0.0, 1.0, 0.0, -4.0], [0.0, 0.0, 1.0, -2.0]]))
    assert found.tolist() == [[1.0, -0.5, 0.0, 0.0], [0.0, 1.0, -2.0, 0.0], [0.0, 0.0, 1.0, -2.0]]


def test_indices_follow_their_formulas():
    s = np.array([9.0, 8.0, 3.0])
    expected = {"O1": 6.0 / 2, "O2": 1 / 3, "O3": 3.0, "O4": 1.0, "O5": 1 / (1 / 9 + 1 / 8 + 1 / 3)}
    assert observability_indices(s, 4) == pytest.approx(expected)
    assert observability_indices(np.array([]), 4)["O3"] == 0.0


def test_what_kept_members_stand_for_undoes_every_relation():
    """d3, d4 and d5 act by their sum; of p + q and q - 2 r two are kept."""
    sum_of_three = RelativeGroup(("d3", "d4", "d5"), ({"d3": 1.0, "d4": -1.0}, {"d4": 1.0, "d5": -1.0}), ("d5",))
    assert sum_of_three.combinations(["d5"]) == {"d5": {"d5": 1.0, "d3": 1.0, "d4": 1.0}}
    chain = RelativeGroup(("a1", "theta1", "alpha1"), ({"a1": 0.5, "theta1": -1.0, "alpha1": 0.25},), ())
    expected = {"a1": {"a1": 1.0, "theta1": 0.5}, "alpha1": {"alpha1": 1.0, "theta1": 0.25}}
    assert chain.combinations(["a1", "alpha1"]) == expected


@pytest.mark.parametrize("model", ["pose", "distance-rotation"])
def test_classes_do_not_depend_on_tolerances(model):
    """What is determined is a matter of the data: a tight tolerance loses none, a ratio of 1e6 groups none."""
    rng = np.random.default_rng(3)
    measurements = measure(paper_robot(), 80, rng)
    names = [f"{kind}{i}" for kind in ("a", "d", "theta", "beta") for i in range(1, 8)]
    wild = {name: 1e-3 * 10.0 ** rng.uniform(-4, 4) for name in names}
    found = []
    for tolerance in (None, wild):
        problem = build_problem(paper_robot(tolerance=tolerance), measurements, model=model)
        found.append(observability_of(problem, problem.start))
    for other in found[1:]:
        assert (other.rank, other.classes, other.relative) == (found[0].rank, found[0].classes, found[0].relative)
        assert np.array_equal(other.singular_values, found[0].singular_values)
        assert np.array_equal(other.null_space, found[0].null_space)
    assert found[0].rank == TABLE[model][0]


def test_a_tolerance_says_what_is_weak():
    """A sigma of 1 um is weak against a tolerance of 2 um, and not against one of 2 mm."""
    parameters = [Parameter("a1", "a", 1, 0.0), Parameter("a2", "a", 2, 0.0, 2e-6), Parameter("a3", "a", 3, 0.0, 2e-3)]
    found = observability_of_rows(np.eye(3) / 1e-6, parameters, scales=np.full(3, 1e-3), n_measurements=3)
    assert [weak.members for weak in found.weak] == [{"a2": 1.0}]
    assert found.weak[0].signal_to_noise == pytest.approx(2.0)
    assert found.sigma == pytest.approx(dict.fromkeys(("a1", "a2", "a3"), 1e-6))
    rows = np.array([[1e6, 1e6], [2e3, -2e3]])  # the sum is seen a thousand times as well as the difference
    faint = observability_of_rows(np.diag([1e6, 0.1]), parameters[:2], scales=np.full(2, 1e-3), n_measurements=2)
    assert faint.classes == ("independent", "ineffective")  # seen a thousandth as well as anything is
    (weak,) = observability_of_rows(rows, parameters[::2], scales=np.full(2, 1e-3), n_measurements=2).weak
    assert weak.members == pytest.approx({"a1": np.sqrt(0.8), "a3": -np.sqrt(0.2)}, rel=1e-3)  # in tolerances
