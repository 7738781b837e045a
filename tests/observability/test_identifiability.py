"""Structural and practical identifiability of arms whose answer is known, with the reason for every lost direction."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import measure, paper_robot, small_arm
from sparing import diagonal

from fg_calib.assessment import assess
from fg_calib.graph.build import STRUCTURAL_FLOOR, build_problem, random_problem
from fg_calib.graph.problem import named_triangle
from fg_calib.graph.solver import solve
from fg_calib.measurements.kinds.pair import SamePoint
from fg_calib.observability.identifiability import observability_of, observe_configurations, observe_structure
from fg_calib.observability.reasons import NO_CAUSE, NOT_EXCITED
from fg_calib.options import Pairing
from fg_calib.robot.model import Joint, RobotBuilder

MODELS = ("distance", "rotation", "distance-rotation", "position", "pose")
OFF_AXIS = {"x": 0.1, "y": 0.05, "z": 0.2, "roll": 0.3}
H = np.pi / 2


def mdh_robot(name, a, alpha, d, tool=None, prismatic=(), theta=None):
    builder = RobotBuilder(name, "mdh")
    builder.add_frame("base", {}, 0, False)
    for i in range(len(a)):
        values = {"a": a[i], "alpha": alpha[i], "d": d[i], "theta": 0.0 if theta is None else theta[i]}
        builder.add_convention_joint(Joint(f"q{i + 1}", prismatic=i + 1 in prismatic), values)
    builder.add_frame("tool", tool or {}, len(a) + 1, False)
    return builder.build()


def generic(tool=None):
    rng = np.random.default_rng(0)
    alpha = rng.uniform(0.3, 1.2, 7) * rng.choice([-1, 1], 7)
    return mdh_robot(
        "generic", rng.uniform(0.2, 0.8, 7), alpha, rng.uniform(0.2, 0.8, 7), tool, theta=rng.uniform(-2, 2, 7)
    )


def ur10(tool=None):
    d = [0.1273, 0, 0, 0.163941, 0.1157, 0.0922]
    return mdh_robot("ur10", [0, 0, -0.612, -0.5723, 0, 0], [0, H, 0, 0, H, -H], d, tool)


def scara(tool=None):
    return mdh_robot("scara", [0, 0.4, 0.3, 0], [0, 0, 0, np.pi], [0.3, 0, 0, 0.1], tool, prismatic=(3,))


def stanford():
    return mdh_robot("stanford", [0] * 6, [0, -H, H, 0, -H, H], [0.4, 0.15, 0.5, 0, 0, 0.2], prismatic=(3,))


def planar(tool=None):
    return mdh_robot("planar", [0, 2, 1], [0, 0, 0], [0, 0, 0], tool or {"x": 0.5})


# Ranks of the generic and UR10 arms: computed independently (4 n less base, tool and parallel axes).
# SCARA, Stanford and planar by hand: the reasons asserted below account for every lost direction.
RANKS = [
    (generic(), (21, 11, 23, 25, 28), 28),
    (generic(OFF_AXIS), (24, 11, 24, 28, 28), 28),
    (ur10(), (15, 7, 17, 19, 22), 24),
    (ur10(OFF_AXIS), (18, 7, 18, 22, 22), 24),
    (scara(), (5, 0, 5, 9, 11), 16),
    (stanford(), (14, 7, 16, 18, 21), 24),
    (planar(), (4, 0, 4, 10, 10), 12),
]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("robot", "ranks", "n"), RANKS, ids=[f"{r.name}-{i}" for i, (r, _, _) in enumerate(RANKS)])
def test_ranks_of_known_arms(robot, ranks, n):
    for model, rank in zip(MODELS, ranks, strict=True):
        found = observe_structure(robot, model)
        assert (found.observability.rank, len(found.observability.names)) == (rank, n), model
        assert len(found.lost) == n - rank
        assert found.observability.gap > 1e6


RANDOM_11 = RobotBuilder("random-11", "dh-hayati")
"""An arm whose random configurations often bring the tool near where it was."""
for _i, (_d, _alpha) in enumerate(((0.0, 90.0), (0.3, 0.0), (0.0, 0.0))):
    RANDOM_11.add_convention_joint(
        Joint(f"q{_i + 1}", prismatic=_i == 0),
        {"a": 0.1, "alpha": np.deg2rad(_alpha), "d": _d, "theta": 0.0, "beta": 0.0},
    )

DRAWN = [(robot, ranks) for robot, ranks, _ in RANKS] + [
    (RANDOM_11.build(), (4, 0, 4, 11, 13)),
    (paper_robot(), (21, 11, 23, 25, 29)),
]


def rank_at(robot, model, seed):
    problem = random_problem(robot, model, seed=seed)
    assert not problem.data.n_train(lambda kind: isinstance(kind, SamePoint))
    return observability_of(problem, problem.start, (), STRUCTURAL_FLOOR).rank


@pytest.mark.sampled(9)
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("robot", "ranks"), DRAWN, ids=[f"{r.name}-{i}" for i, (r, _) in enumerate(DRAWN)])
def test_structural_rank_does_not_depend_on_the_draw(robot, ranks, model):
    assert {rank_at(robot, model, seed) for seed in range(2)} == {ranks[MODELS.index(model)]}


def reasons(robot, model, **options):
    found = observe_structure(robot, model, **options)
    return {tuple(sorted(lost.relation)): lost.reason for lost in found.lost}


def test_reasons_of_the_papers_robot():
    base = "the measurement is blind to the base: the whole arm moves as one body"
    on_axis = "the tool point lies on the last axis: "
    found = reasons(paper_robot(), "distance-rotation")
    assert {name: found[(name,)] for name in ("a1", "alpha1", "d1", "theta1")} == dict.fromkeys(
        ("a1", "alpha1", "d1", "theta1"), base
    )
    assert all(found[(name,)].startswith(on_axis) for name in ("beta6", "theta7", "beta7"))
    assert found[("beta1", "theta2")] == found[("beta5", "theta6")] == "only their sum turns about the same axis"
    assert found[("d3", "d4")] == "parallel axes 3, 4: only the sum of the shifts along them acts"
    distance = reasons(paper_robot(), "distance")
    assert distance[("alpha7", "d6")] == on_axis + "the tool only turns about it, unseen by distance"
    rotation = reasons(paper_robot(), "rotation")
    assert rotation[("theta3", "theta4")] == (
        "parallel axes 3, 4: only the sum of their turns is seen, and no lengths are"
    )
    assert rotation[("a4",)] == "the tool only moves without turning, unseen by rotation"


def test_an_off_axis_tool_leaves_only_the_base():
    assert set(reasons(generic(OFF_AXIS), "distance").values()) == {
        "the measurement is blind to the base: the whole arm moves as one body"
    }
    assert "last axis" not in " ".join(reasons(ur10(OFF_AXIS), "distance").values())


def test_a_planar_arm_cannot_see_its_tilts_in_distances():
    found = reasons(planar(), "distance")
    tilt = "parallel axes, all of them: it only tilts the arm out of its plane, unseen to first order"
    assert found[("alpha2",)] == found[("alpha3",)] == tilt


def test_an_unknown_frame_hides_the_base_from_poses():
    found = reasons(paper_robot(), "pose", frame="unknown")
    assert found[("d1",)] == "the measurement is blind to the base: the whole arm moves as one body"
    assert ("beta6", "theta7") in found  # the tool's own frame is seen


def test_no_reason_is_given_where_no_check_succeeds():
    found = reasons(scara(), "distance-rotation")
    assert list(found.values()).count(NO_CAUSE) == 1


def test_the_kept_set_follows_the_users_order():
    kept = observe_structure(paper_robot(), "pose", prefer=["d3", "beta2"]).observability.kept
    assert {"d3", "beta2"} <= set(kept)
    assert not {"d4", "d5", "theta3"} & set(kept)


def test_configurations_that_do_not_move_a_joint_are_named_as_the_reason():
    rng = np.random.default_rng(2)
    robot = generic(OFF_AXIS)
    q = rng.uniform(-2, 2, (60, 7))
    # The eight parameters of joints 6 and 7 make one fixed pose of six coordinates, two of which are d5 and theta5's.
    q[:, 5:] = 0.3
    found = observe_configurations(robot, measure(robot, 60, rng, readings=q), "pose")
    assert found.observability.rank == 24
    assert {lost.reason for lost in found.lost} == {NOT_EXCITED}


@pytest.mark.slow
def test_practical_sigmas_are_those_of_the_kept_set():
    rng = np.random.default_rng(3)
    robot = paper_robot()
    measurements = measure(robot, 100, rng)
    found = observe_configurations(robot, measurements, "distance-rotation", pairing=Pairing("chain"))
    o = found.observability
    problem = build_problem(robot, measurements, model="distance-rotation", pairing=Pairing("chain"), gauge="keep")
    R = named_triangle(problem, problem.start)
    sigma = np.sqrt(np.diag(np.linalg.inv(R.T @ R)))
    assert list(o.sigma) == list(problem.variables.names) == o.kept
    # the same rows but for noise in the measured values, which decides on pairs near a kink only
    assert list(o.sigma.values()) == pytest.approx(sigma, rel=1e-3)
    assert o.indices["O3"] == pytest.approx(o.singular_values[o.rank - 1])


def test_weak_directions_and_correlations_are_named():
    rng = np.random.default_rng(4)
    robot = small_arm()
    q = rng.uniform(-2, 2, (60, 4))
    q[:, 3] = 1e-3 * rng.normal(size=60)  # joint 4 hardly moves: theta4 and the tool's turn act alike
    found = observe_configurations(robot, measure(robot, 60, rng, readings=q), "pose").observability
    assert found.rank == len(found.names) - len(found.null_space)
    assert found.weak
    assert found.weak[0].signal_to_noise < 10
    assert all(abs(rho) > 0.9 for _, _, rho in found.correlations)
    assert found.weak[0].members


def in_other_units(robot, k):
    """The same robot with lengths times k, those of its tolerances and of its sliding joints' limits among them."""

    def scaled(p):
        length = k if p.unit == "m" else 1.0
        return replace(p, nominal=p.nominal * length, tolerance=None if p.tolerance is None else p.tolerance * length)

    joints = tuple(replace(j, lower=j.lower * k, upper=j.upper * k) if j.prismatic else j for j in robot.joints)
    elements = tuple(replace(e, constant=e.constant * (k if e.axis < 3 else 1.0)) for e in robot.elements)
    return replace(robot, parameters=tuple(map(scaled, robot.parameters)), joints=joints, elements=elements)


TOLERANCES = [None, {"a": 1e-3, "d": 1e-4, "theta": 2e-3}]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "model", "tolerance"), diagonal(["paper", "small", "scara"], ["pose", "distance-rotation"], TOLERANCES)
)
def test_the_answer_does_not_depend_on_the_unit_of_length(arm, model, tolerance):
    """At the user's configurations and at random ones; the small arm and the scara have sliding joints."""
    robot = {"paper": paper_robot(tolerance), "small": small_arm(tolerance), "scara": scara(OFF_AXIS)}[arm]
    robot = replace(robot, joints=tuple(replace(j, lower=-0.5, upper=1.0) for j in robot.joints))
    rng = np.random.default_rng(5)
    q = rng.uniform(-0.5, 1.0, (80, robot.n_joints))
    found = {}
    for k in (1.0, 1e-3, 1e3):
        one = in_other_units(robot, k)
        readings = q * [k if j.prismatic else 1.0 for j in robot.joints]
        measurements = measure(one, 80, np.random.default_rng(6), readings=readings, sigma=(1e-3 * k, 1e-3))
        found[k] = [
            observe_configurations(one, measurements, model).observability,
            observe_structure(one, model).observability,
        ]
    for k in (1e-3, 1e3):
        for here, metres in zip(found[k], found[1.0], strict=True):
            assert (here.rank, here.classes) == (metres.rank, metres.classes)
            assert here.singular_values[: here.rank] == pytest.approx(metres.singular_values[: here.rank], rel=1e-6)
            both = here.null_space @ metres.null_space.T  # the same space: unit-free directions
            assert both @ both.T == pytest.approx(np.eye(len(both)), abs=1e-6)
            assert [g.keep for g in here.relative] == [g.keep for g in metres.relative]
            assert [w.signal_to_noise for w in here.weak] == pytest.approx(
                [w.signal_to_noise for w in metres.weak], rel=1e-6
            )


@pytest.mark.sampled(1)
@pytest.mark.parametrize("model", ["pose", "distance-rotation", "position"])
def test_reasons_are_found_where_the_tool_turned_out_to_be(model):
    """The tool is estimated and far from nominal: directions and reasons are those at the fitted tool."""
    rng = np.random.default_rng(7)
    robot = paper_robot(estimate=[f"tool.{k}" for k in ("x", "y", "z", "roll", "pitch", "yaw")])
    values = robot.nominal
    values[-6:] = [0.05, -0.03, 0.2, 0.1, 0.2, 0.3]
    measurements = measure(robot.with_values(values), 150, rng)
    found = assess(solve(build_problem(robot, measurements, model=model))).identifiability
    assert found.lost
    assert NOT_EXCITED not in {lost.reason for lost in found.lost}
    assert not any("last axis" in lost.reason for lost in found.lost)
