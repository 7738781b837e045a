"""Arms by their screw axes, against matrix exponentials and the number of parameters that theory gives them."""

import numpy as np
import pytest
from oracle import frame, rotation
from scipy.linalg import expm
from tolerances import rounding

from fg_calib import observe_structure
from fg_calib.robot import FRAME_KINDS, Joint, RobotBuilder, pose

MISSING = {"pose": 0, "position": 3, "distance-rotation": 9}
"""How many parameters of base and tool a model does not see."""


def screw_arm(axes, points, slides=(), tool=None):
    builder = RobotBuilder("arm", "poe")
    builder.add_frame("base", {}, 0, False)
    for i, (axis, point) in enumerate(zip(axes, points, strict=True), start=1):
        slide, limits = i in slides, (-0.3, 0.3) if i in slides else (-np.inf, np.inf)
        builder.add_screw_joint(Joint(f"j{i}", slide, *limits), axis, point)
    builder.add_frame("tool", tool or {"x": 0.4, "y": 0.3, "z": 0.7, "roll": 0.3, "yaw": 1.0}, len(axes) + 1, False)
    return builder.build(estimate=[f"{frame}.{kind}" for frame in ("base", "tool") for kind in FRAME_KINDS])


def skew(axis, point, prismatic):
    """A unit screw as a matrix: of a joint that turns [w]x and -w x p, of one that slides its direction alone."""
    out = np.zeros((4, 4))
    if prismatic:
        out[:3, 3] = axis
    else:
        out[:3, :3] = np.cross(axis, np.eye(3)).T
        out[:3, 3] = np.cross(point, axis)
    return out


def test_an_arm_is_a_product_of_exponentials_and_its_tool_is_that_at_zero_readings():
    rng = np.random.default_rng(0)
    axes, points = rng.normal(size=(5, 3)), rng.uniform(-1, 1, (5, 3))
    axes[3], axes[4] = [0, 0, -2], [0, 0, 3]
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    arm = screw_arm(axes, points, slides=[2])
    by_name = {p.name: i for i, p in enumerate(arm.parameters)}
    values = arm.nominal
    for name, i in by_name.items():
        values[i] += 0.2 * rng.normal() * name.startswith("j")
    T, q = np.eye(4), rng.uniform(-3, 3, 5)
    for i, (axis, point) in enumerate(zip(axes, points, strict=True)):
        x, y, pitch, roll = (values[by_name[f"j{i + 1}.{k}"]] if f"j{i + 1}.{k}" in by_name else 0.0
                             for k in ("x", "y", "pitch", "roll"))  # fmt: skip
        tilt = np.arctan2(np.hypot(*axis[:2]), axis[2])
        R = (rotation(2, np.arctan2(axis[1], axis[0]) if tilt else 0.0) @ rotation(1, tilt))[:3, :3]
        moved = (rotation(1, pitch) @ rotation(0, roll))[:3, 2]
        T = T @ expm(q[i] * skew(R @ moved, point + R @ [x, y, 0.0], i == 1))
    M = frame(**{kind: values[by_name[f"tool.{kind}"]] for kind in FRAME_KINDS})
    at = pose(arm.with_values(values), [q, np.zeros(5)])
    assert at.rotation[0] == pytest.approx((T @ M)[:3, :3], abs=rounding(1.0))
    assert at.position[0] == pytest.approx((T @ M)[:3, 3], abs=rounding(10.0))
    assert at.position[1] == pytest.approx(M[:3, 3], abs=rounding(1.0))


RNG = np.random.default_rng(1)
DRAWN = RNG.normal(size=(7, 3)), RNG.uniform(-0.5, 0.5, (7, 3))
SCARA = [[0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, 1]], [[0, 0, 0.3], [0.4, 0, 0.3], [0.7, 0, 0.3], [0.7, 0, 0.3]]
COUNTED = {
    "6R": screw_arm(DRAWN[0][:6], DRAWN[1][:6]),
    "7R": screw_arm(*DRAWN),
    "2P4R": screw_arm(DRAWN[0][:6], DRAWN[1][:6], slides=(1, 4)),
    "SCARA": screw_arm(*SCARA, slides=(3,)),
}


@pytest.mark.parametrize("name", COUNTED)
def test_an_arm_has_as_many_parameters_as_theory_says(name):
    """4 a joint that turns, also of parallel ones, 2 a slide and 6 of base and tool: none twice."""
    arm = COUNTED[name]
    slides = sum(joint.prismatic for joint in arm.joints)
    n = 4 * (arm.n_joints - slides) + 2 * slides + 6
    assert len(arm.parameters) == n + 6
    for model, missing in MISSING.items():
        found = observe_structure(arm, model).observability
        assert (found.rank, found.gap > 1e6) == (n - missing, True), model


def test_an_arm_reaches_from_axis_to_axis():
    """From the base up 0.3 m, 0.4 and 0.3 m across, 0.3 m down the slide, and from the last axis to the tool."""
    assert COUNTED["SCARA"].reach == pytest.approx(0.3 + 0.4 + 0.3 + 0.3 + (0.3 + 0.3 + 0.4))
