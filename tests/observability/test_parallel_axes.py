"""Small motions that a convention has no parameter for: named, and errors only where they explain the misfit."""

import numpy as np
import pytest
from jobs import UR5E, ur5e
from simulated import measure, small_arm, specified, true_robot, with_changes

from fg_calib import Robot, assess, build_problem, read_robot, solve
from fg_calib.observability import missing_motions
from fg_calib.robot import Axis

QUARTER, SIGMA = np.pi / 2, (5e-5, 1e-4)
TILT, SHIFT = (Axis.RY,), (Axis.TY,)
BOTH, TURNS = (Axis.TY, Axis.RY), (Axis.RX, Axis.RY, Axis.RZ)


def arm(convention, *joints, tool=(0.1, 0.2)):
    """An arm of (a, alpha in degrees, d) a joint, a fourth figure makes it slide; x and z of its tool."""
    rows = [[a, np.deg2rad(alpha), d, 0.0] for a, alpha, d, *_ in joints]
    types = ["prismatic" if slides else "revolute" for *_, slides in ((*joint, "")[:4] for joint in joints)]
    return Robot.from_dh(rows, convention, types=types, tool=[tool[0], 0.0, tool[1]])


UR = ((0, 90, 0.16), (-0.43, 0, 0), (-0.39, 0, 0), (0, 90, 0.13), (0, -90, 0.1), (0, 0, 0.1))
UR_CRAIG = ((0, 0, 0.16), (0, 90, 0), (-0.43, 0, 0), (-0.39, 0, 0.13), (0, 90, 0.1), (0, -90, 0.1))
SCARA = ((0.3, 0, 0.4), (0.25, 0, 0), (0, 0, 0, "slide"), (0, 0, 0.1))
COAXIAL = ((0, 90, 0.1), (0, 0, 0.3), (0, 90, 0), (0, 90, 0), (0, 90, 0.1))
GANTRY = ((0, 90, 0, "slide"), (0, 90, 0, "slide"), (0, 0, 0, "slide"), (0, 90, 0), (0, 90, 0.1))
SKEW = ((0, 90, 0.1), (0.3, 80, 0), (0.2, -70, 0.1), (0, 90, 0.2))
LACKS = "axes 2, 3 and 4 are parallel and convention dh has no parameter for a tilt about y between them: use dh-hayati"


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("convention", "joints", "expected"), [
    ("dh", UR, [((2, 3, 4), TILT, "dh-hayati")]),
    ("mdh", UR_CRAIG, [((2, 3, 4), TILT, "mdh-hayati")]),
    ("dh-hayati", UR, []),
    ("mdh-hayati", UR_CRAIG, []),
    ("dh", SCARA, [((1, 2, 3, 4), TILT, "dh-hayati")]),
    ("dh-hayati", SCARA, []),
    # On one line there is no common normal that a could be measured along.
    ("dh", COAXIAL, [((2, 3), BOTH, "a URDF")]),
    ("dh-hayati", COAXIAL, [((2, 3), SHIFT, "a URDF")]),
    # Where a slide is does not matter, only its direction.
    ("dh", GANTRY, [((3, 4), TILT, "dh-hayati")]),
    ("dh", SKEW, []),
    ("dh", ((0, 90, 0.1), (0.4, 0.5, 0), (0, 90, 0.1), (0, 0, 0.1)), [((2, 3), TILT, "dh-hayati")]),
    ("dh", ((0, 90, 0.1), (0.4, 10.0, 0), (0, 90, 0.1), (0, 0, 0.1)), []),
    ("mdh", SKEW, []),
])  # fmt: skip
def test_parallel_neighbours_lack_a_tilt(convention, joints, expected):
    found = missing_motions(arm(convention, *joints))
    assert [(m.axes, m.motions, m.use) for m in found] == expected
    assert all(m.convention == convention for m in found)


def test_the_words_name_axes_convention_and_remedy():
    (parallel,) = missing_motions(arm("dh", *UR))
    assert str(parallel) == LACKS
    (nearly,) = missing_motions(arm("dh", (0, 90, 0.1), (0.4, 0.5, 0), (0, 90, 0.1), (0, 0, 0.1)))
    assert str(nearly).startswith("axes 2 and 3 are parallel within 0.5 deg and convention dh has no")


DH = {
    **{"convention": "dh", "tolerance": {k: v for k, v in UR5E["tolerance"].items() if k != "beta"}},
    "joints": [{k: v for k, v in joint.items() if k != "beta"} for joint in UR5E["joints"]],
}


@pytest.mark.parametrize("model", ["pose", "position", "distance-rotation"])
@pytest.mark.parametrize("tilted", [True, False])
def test_what_the_convention_lacks_is_an_error_only_where_it_explains_the_misfit(tmp_path, model, tilted):
    """A true arm with small tilts, or one without, whose noise is specified a fifth of what it is."""
    rng = np.random.default_rng(0)
    true = true_robot(ur5e(tmp_path), rng)
    if not tilted:
        true = true.with_values([0.0 if p.kind == "beta" else p.nominal for p in true.parameters])
    m = measure(true, 60, rng, sigma=SIGMA)
    if not tilted:
        m = specified(m, 1 / 5)
    verdict = assess(solve(build_problem(ur5e(tmp_path, **DH), m, model=model))).verdict
    assert verdict.errors[0].startswith("reduced chi-square")
    assert (LACKS in verdict.errors, LACKS in verdict.notes) == (tilted, not tilted)


def test_a_base_whose_turn_alone_is_estimated_is_named_where_it_is_pitched_by_a_quarter_turn():
    robot = small_arm(estimate=[f"base.{angle}" for angle in ("roll", "pitch", "yaw")])
    pitch = QUARTER - robot.nominal[robot.index("base.pitch")]
    (found,) = missing_motions(with_changes(robot, **{"base.pitch": pitch}))
    assert (found.axes, found.frame) == ((0, 1), "the frame base")


@pytest.mark.parametrize(("pitch", "told"), [(90.0, True), (-84.0, True), (60.0, False)])
def test_a_joint_origin_pitched_by_a_quarter_turn_hardly_holds_a_tilt(pitch, told, fg_calib, tmp_path):
    """Roll and yaw of a URDF origin turn about one axis there: a truly tilted joint made `noise too small`."""
    joint = '<joint name="{0}" type="revolute"><parent link="l{1}"/><child link="l{2}"/><axis xyz="0 1 0"/>{3}</joint>'
    origins = ['<origin xyz="0 0 0.2"/>', f'<origin xyz="0 0.1 0.3" rpy="0 {float(np.deg2rad(pitch))!r} 0"/>']
    joints = "".join(joint.format(f"j{i}", i, i + 1, origin) for i, origin in enumerate(origins))
    links = "".join(f'<link name="l{i}"/>' for i in range(3))
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    found = missing_motions(read_robot(tmp_path / "arm.urdf"))
    assert [(m.axes, m.motions, m.frame) for m in found] == [((1, 2), TURNS, "the origin of joint j1")] * told
    ended = fg_calib("observe", tmp_path / "arm.urdf", "--model", "pose")
    assert ended.code == 0
    assert ("the origin of joint j1 is pitched by about 90 deg" in " ".join(ended.out.split())) == told
