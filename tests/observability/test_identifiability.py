"""Structural and practical identifiability of arms whose answer is known, with the reason for every lost direction."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import measure, paper_robot

from fg_calib import Robot, observe_configurations, observe_structure
from fg_calib.observability.reasons import NO_CAUSE, NOT_EXCITED
from fg_calib.robot import Backlash, Bending, Compliance, Mass, Thermal

MODELS = ("distance", "rotation", "distance-rotation", "position", "pose")
OFF_AXIS = {"x": 0.1, "y": 0.05, "z": 0.2, "roll": 0.3}
H = np.pi / 2


def mdh_robot(name, a, alpha, d, tool=None, prismatic=(), theta=None):
    rows = np.column_stack([a, alpha, d, np.zeros(len(a)) if theta is None else theta])
    types = ["prismatic" if i + 1 in prismatic else "revolute" for i in range(len(a))]
    return Robot.from_dh(rows, "mdh", name=name, types=types, tool=tool)


def generic(tool=None):
    rng = np.random.default_rng(0)
    alpha = rng.uniform(0.3, 1.2, 7) * rng.choice([-1, 1], 7)
    a, d = rng.uniform(0.2, 0.8, (2, 7))
    return mdh_robot("generic", a, alpha, d, tool, theta=rng.uniform(-2, 2, 7))


def ur10(tool=None):
    d = [0.1273, 0, 0, 0.163941, 0.1157, 0.0922]
    return mdh_robot("ur10", [0, 0, -0.612, -0.5723, 0, 0], [0, H, 0, 0, H, -H], d, tool)


def scara(tool=None):
    return mdh_robot("scara", [0, 0.4, 0.3, 0], [0, 0, 0, np.pi], [0.3, 0, 0, 0.1], tool, prismatic=(3,))


def planar(tool=None):
    return mdh_robot("planar", [0, 2, 1], [0, 0, 0], [0, 0, 0], tool or {"x": 0.5})


# Ranks of the generic and UR10 arms: computed independently (4 n less base, tool and parallel axes).
# SCARA and planar by hand: the reasons asserted below account for every lost direction.
RANKS = [
    (generic(), (21, 11, 23, 25, 28), 28),
    (generic(OFF_AXIS), (24, 11, 24, 28, 28), 28),
    (ur10(), (15, 7, 17, 19, 22), 24),
    (ur10(OFF_AXIS), (18, 7, 18, 22, 22), 24),
    (scara(), (5, 0, 5, 9, 11), 16),
    (planar(), (4, 0, 4, 10, 10), 12),
]


@pytest.mark.parametrize(("robot", "ranks", "n"), RANKS, ids=[f"{r.name}-{i}" for i, (r, _, _) in enumerate(RANKS)])
def test_ranks_of_known_arms(robot, ranks, n):
    for model, rank in zip(MODELS, ranks, strict=True):
        found = observe_structure(robot, model)
        assert (found.observability.rank, len(found.observability.names)) == (rank, n), model
        assert len(found.lost) == n - rank
        assert found.observability.gap > 1e6


def reasons(robot, model, **options):
    found = observe_structure(robot, model, **options)
    return {tuple(sorted(lost.relation)): lost.reason for lost in found.lost}


BLIND = "the measurement is blind to the base: the whole arm moves as one body"


def test_reasons_of_the_papers_robot():
    on_axis = "the tool point lies on the last axis: "
    found = reasons(paper_robot(), "distance-rotation")
    assert {found[(name,)] for name in ("a1", "alpha1", "d1", "theta1")} == {BLIND}
    assert all(found[(name,)].startswith(on_axis) for name in ("beta6", "theta7", "beta7"))
    assert found[("beta1", "theta2")] == found[("beta5", "theta6")] == "only their sum turns about the same axis"
    assert found[("d3", "d4")] == "parallel axes 3, 4: only the sum of the shifts along them acts"
    distance = reasons(paper_robot(), "distance")
    assert distance[("alpha7", "d6")] == on_axis + "the tool only turns about it, unseen by distance"
    rotation = reasons(paper_robot(), "rotation")
    assert rotation[("theta3", "theta4")] == "parallel axes 3, 4: only the sum of their turns is seen"
    assert rotation[("a4",)] == "the tool only moves without turning, unseen by rotation"


def test_an_off_axis_tool_leaves_only_the_base():
    assert set(reasons(generic(OFF_AXIS), "distance").values()) == {BLIND}
    assert "last axis" not in " ".join(reasons(ur10(OFF_AXIS), "distance").values())


def test_an_unknown_frame_hides_the_base_from_poses():
    found = reasons(paper_robot(), "pose", frame="unknown")
    assert found[("d1",)] == BLIND
    assert ("beta6", "theta7") in found  # the tool's own frame is seen


def test_no_reason_is_given_where_no_check_succeeds():
    found = reasons(scara(), "distance-rotation")
    assert list(found.values()).count(NO_CAUSE) == 1


def test_configurations_that_do_not_move_a_joint_are_named_as_the_reason():
    rng = np.random.default_rng(2)
    robot = generic(OFF_AXIS)
    q = rng.uniform(-2, 2, (60, 7))
    # The eight parameters of joints 6 and 7 make one fixed pose of six coordinates, two of which are d5 and theta5's.
    q[:, 5:] = 0.3
    found = observe_configurations(robot, measure(robot, 60, rng, readings=q), "pose")
    assert found.observability.rank == 24
    assert {lost.reason for lost in found.lost} == {NOT_EXCITED}


LATERAL = Compliance([Mass(2, 10.0, (0.2, 0.0, 0.1)), Mass(6, 2.0, (0.0, 0.0, 0.05))], lateral=True)


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        (LATERAL, {"theta1.compliance": "its axis is along gravity: no torque",
                   "theta6.compliance": "no mass beyond it is off its axis: no torque",
                   "theta1.compliance_x": None}),
        (Compliance(None, [1, 2]), {"theta1.load3x": "its axis is along gravity: no torque", "theta2.load3x": None}),
        (Compliance(None, [1], gravity=(0, 9.81, 0)), {"theta1.load1x": None}),
        (replace(LATERAL, gravity="estimate"), {"base.tilt_x": "it acts through compliances, which are 0 here"}),
        (Bending([Mass(0, 5.0, (0.1, 0.0, 0.1))]), {"base.bending": "no mass has a moment about its axis"}),
        (Thermal(zeros=True), {"theta3.drift": "the temperature does not vary, or is not given"}),
        (Backlash([2]), {"theta2.backlash": "the side of approach does not vary, or is not given"}),
    ],
)  # fmt: skip
def test_effects_that_nothing_excites_are_explained_by_what_they_follow(effect, expected):
    found = reasons(ur10(OFF_AXIS).with_effects(effect), "pose", frame="unknown")
    assert {name: found.get((name,)) for name in expected} == expected


@pytest.mark.parametrize("spread", [0.0, 5.0])
def test_a_temperature_that_does_not_vary_is_the_reason_for_drift(spread):
    rng = np.random.default_rng(2)
    m = measure(ur10(OFF_AXIS), 60, rng)
    m = replace(m, context={"temperature": 25.0 + spread * rng.normal(size=60)})
    found = observe_configurations(ur10(OFF_AXIS).with_effects(Thermal(lengths=False, zeros=True)), m, "pose")
    drifts = {lost.reason for lost in found.lost if any(name.endswith(".drift") for name in lost.relation)}
    assert drifts == (set() if spread else {"the temperature does not vary, or is not given"})
