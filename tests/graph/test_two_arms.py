"""Two arms in contact are one chain from flange to flange: the same as two arms composed explicitly."""

import numpy as np
import pytest
from tolerances import rounding

from fg_calib.io import read_urdf
from fg_calib.robot.kinematics import pose

TOLERANCE = {"x": 1e-3, "y": 1e-3, "z": 1e-3, "roll": 2e-3, "pitch": 2e-3, "yaw": 2e-3}
ORIGINS = [
    ("0 0 0.3", "0 0 0"), ("0.05 0 0.2", "1.5 0.1 0"), ("0.3 0.02 0", "0.1 -0.2 0.3"), ("0.25 0 0.05", "0.2 1.4 0"),
]  # fmt: skip


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """The chain from the left flange to the right one, and both arms alone, from one URDF."""
    links, joints = ['<link name="bench"/>'], []
    for side, y in (("left", 0.25), ("right", -0.3)):
        parent = "bench"
        for i, (xyz, rpy) in enumerate([(f"0 {y} 0", "0 0 0.1"), *ORIGINS]):
            link, kind = f"{side}_{i}", "fixed" if i == 0 else "continuous"
            links.append(f'<link name="{link}"/>')
            joints.append(
                f'<joint name="{side}_joint_{i}" type="{kind}"><parent link="{parent}"/><child link="{link}"/>'
                f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/></joint>'
            )
            parent = link
    path = tmp_path_factory.mktemp("arms") / "bench.urdf"
    path.write_text(f'<robot name="bench">{"".join([*links, *joints])}</robot>')
    whole = read_urdf(path, base_link="left_4", tip_link="right_4", tolerance=TOLERANCE)
    return whole, *(read_urdf(path, base_link="bench", tip_link=f"{s}_4") for s in ("left", "right"))


def values_of(arm, named):
    """The arm with the values of a chain that has its joints too."""
    return arm.with_values(np.array([named.get(p.name, p.nominal) for p in arm.parameters]))


def right_tip_in_left_flange(left, right, named, q):
    """T_left^-1 T_right of the two arms alone; the chain has the left one's joints from its tip on."""
    a = pose(values_of(left, named), q[:, 3::-1])
    b = pose(values_of(right, named), q[:, 4:])
    return np.einsum("nji,nj->ni", a.rotation, b.position - a.position)


def test_a_chain_from_flange_to_flange_is_two_arms_composed(arms):
    whole, left, right = arms
    assert [joint.name for joint in whole.joints] == [
        *(f"left_joint_{i}" for i in (4, 3, 2, 1)), *(f"right_joint_{i}" for i in (1, 2, 3, 4))
    ]  # fmt: skip
    rng = np.random.default_rng(0)
    values = whole.nominal + 0.01 * rng.normal(size=len(whole.nominal))
    values[[p.owner in (0, 9) for p in whole.parameters]] = 0.0  # base and tool frames of the chain alone
    q = rng.uniform(-3, 3, (20, 8))
    named = dict(zip((p.name for p in whole.parameters), values, strict=True))
    composed = right_tip_in_left_flange(left, right, named, q)
    assert pose(whole.with_values(values), q).position == pytest.approx(composed, abs=rounding(3.0, 10))
