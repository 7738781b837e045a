"""Every format has the forward kinematics of the arm: by yourdfpy and products of matrices."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from exported import ARMS, TREE, UR10, matrix, off, seven, ur10, yourdfpy_poses
from oracle import frame
from refusals import refusal
from scipy.spatial.transform import Rotation
from simulated import measure, with_changes
from sparing import as_case

from fg_calib import Robot, calibrate, export, read_robot
from fg_calib.exports.dh import drawn, in_table, poses
from fg_calib.io import read_urdf

EXACT = 1e-9  # [m] and [rad], as the issue states


def ours(robot, q):
    at = poses(robot, q)
    return np.array([matrix(R, p) for R, p in zip(at.rotation, at.position, strict=True)])


def names(robot):
    return [joint.name for joint in robot.joints]


def frames(robot, owner):
    values = {p.kind: p.nominal for p in robot.parameters if p.owner == owner}
    return frame(*(values[kind] for kind in ("x", "y", "z", "roll", "pitch", "yaw")))


@pytest.fixture(params=ARMS)
def arm(request, tmp_path):
    """An arm that is a little off, its base and tool as well."""
    return off(ARMS[request.param](tmp_path), frames=True)


def ends(robot):
    """Links of its URDF at both ends, and what is before and behind them."""
    if robot.urdf is None:
        return "base_link", "tool", np.eye(4), np.eye(4)
    return robot.urdf.base_link, robot.urdf.tip_link, frames(robot, 0), frames(robot, robot.n_joints + 1)


@pytest.mark.parametrize("n", [20, as_case(1000, is_slow=True)])
def test_yourdfpy_computes_the_tool_poses_of_the_urdf(arm, n, tmp_path):
    q = drawn(arm, n, 3)
    base, tip, before, behind = ends(arm)
    export(arm, "urdf").write(tmp_path / "out.urdf")
    found = before @ yourdfpy_poses(tmp_path / "out.urdf", base, tip, names(arm), q) @ behind
    assert np.abs(found - ours(arm, q)).max() < EXACT


def test_a_new_urdf_reads_back_as_the_same_arm_with_its_names_and_limits(arm, tmp_path):
    if arm.urdf is not None:
        pytest.skip("this arm has a URDF already")
    export(arm, "urdf").write(tmp_path / "out.urdf")
    back = read_urdf(tmp_path / "out.urdf")
    assert (back.name, back.joints) == (arm.name, arm.joints)
    q = drawn(arm, 1000, 3)
    assert np.abs(ours(back, q) - ours(arm, q)).max() < EXACT


@pytest.mark.sampled(6)
@pytest.mark.parametrize("to", ["hayati", "mdh-hayati", "poe", "cpc", "yaml"])
def test_what_holds_every_arm_holds_it_exactly(arm, to, tmp_path):
    made = export(arm, to)
    assert (made.details.get("exact", True), made.details.get("reasons", [])) == (True, [])
    made.write(tmp_path / "out.yaml")
    back = read_robot(tmp_path / "out.yaml")
    assert back.joints == pytest.approx(arm.joints) if to == "yaml" else names(back) == names(arm)
    q = drawn(arm, 1000, 3)
    assert np.abs(ours(back, q) - ours(arm, q)).max() < EXACT


@pytest.mark.sampled(1)
@pytest.mark.parametrize("to", ["dh", "mdh"])
@pytest.mark.parametrize("name", [as_case(name, is_slow="scara" in name) for name in ARMS])
def test_tables_of_four_figures_say_what_they_miss_and_by_how_much(name, to, tmp_path):
    arm = off(ARMS[name](tmp_path), frames=True)
    made = export(arm, to)
    made.write(tmp_path / "out.yaml")
    back = read_robot(tmp_path / "out.yaml")
    q = drawn(arm, 1000, 3)
    miss = np.linalg.norm((ours(back, q) - ours(arm, q))[:, :3, 3], axis=1)
    if made.details["exact"]:
        assert miss.max() < EXACT
        return
    assert all("parallel within" in reason for reason in made.details["reasons"])
    error = made.details["error"]
    # Other configurations of the same kind: RMS of 1000 of some 10 independent figures is known to 5 %.
    assert np.sqrt(np.mean(miss**2)) == pytest.approx(error["position_rms"], rel=0.1)
    assert miss.max() < 1.5 * error["position_max"]
    assert f"{1e3 * error['position_rms']:.4g} mm RMS" in made.text


# --- ur_description ---------------------------------------------------------------------------------------------------

UR_JOINTS = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]


def ur_macro(kinematics):
    """The chain of ur_macro.xacro with these kinematics, as its xacro expands it."""
    pi = repr(np.pi)
    fixed = [
        ("base_link-base_link_inertia", "base_link", "base_link_inertia", f"0 0 {pi}"),
        ("base_link-base_fixed_joint", "base_link", "base", f"0 0 {pi}"),
        ("wrist_3-flange", "wrist_3_link", "flange", f"0 {-np.pi / 2} {-np.pi / 2}"),
        ("flange-tool0", "flange", "tool0", f"{np.pi / 2} 0 {np.pi / 2}"),
    ]
    parts = ['<link name="base_link"/>']
    for name, parent, child, rpy in fixed:
        parts.append(f'<link name="{child}"/><joint name="{name}" type="fixed"><origin xyz="0 0 0" rpy="{rpy}"/>'
                     f'<parent link="{parent}"/><child link="{child}"/></joint>')  # fmt: skip
    links = [f"{link}_link" for link in UR10_DEFAULT]
    for name, parent, child, link in zip(UR_JOINTS, ["base_link_inertia", *links], links, UR10_DEFAULT, strict=False):
        o = kinematics[link]
        parts.append(
            f'<link name="{child}"/><joint name="{name}" type="revolute">'
            f'<parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{o["x"]} {o["y"]} {o["z"]}" rpy="{o["roll"]} {o["pitch"]} {o["yaw"]}"/><axis xyz="0 0 1"/>'
            '<limit lower="-6.3" upper="6.3" effort="1" velocity="1"/></joint>'
        )
    return f'<robot name="ur">{"".join(parts)}</robot>'


UR10_DEFAULT = {
    "shoulder": (0, 0, 0.1273, 0, 0, 0),
    "upper_arm": (0, 0, 0, 1.570796327, 0, 0),
    "forearm": (-0.612, 0, 0, 0, 0, 0),
    "wrist_1": (-0.5723, 0, 0.163941, 0, 0, 0),
    "wrist_2": (0, -0.1157, -2.373046667922381e-11, 1.570796327, 0, 0),
    "wrist_3": (0, 0.0922, -1.891053610911353e-11, 1.570796326589793, 3.141592653589793, 3.141592653589793),
}
"""ur_description/config/ur10/default_kinematics.yaml of ros-industrial/universal_robot, e30bc2e."""


def test_a_ur10_as_drawn_has_the_frames_of_ur_descriptions_own_file():
    made = yaml.safe_load(export(Robot.from_dh([row[:4] for row in UR10], "dh"), "ur").text)["kinematics"]
    assert list(made) == [*UR10_DEFAULT, "hash"]
    for link, default in UR10_DEFAULT.items():
        found = [made[link][kind] for kind in ("x", "y", "z", "roll", "pitch", "yaw")]
        assert frame(*found) == pytest.approx(frame(*default), abs=1e-9)  # its figures have nine digits


@pytest.fixture
def ur_urdf(tmp_path):
    """ur_description's own URDF with joints that are a little off, in the frames that its xacro makes."""
    kinds = ("x", "y", "z", "roll", "pitch", "yaw")
    kinematics = {link: dict(zip(kinds, values, strict=True)) for link, values in UR10_DEFAULT.items()}
    (tmp_path / "ur.urdf").write_text(ur_macro(kinematics))
    return off(read_urdf(tmp_path / "ur.urdf", base_link="base_link", tip_link="tool0"))


@pytest.mark.parametrize("convention", ["dh", "mdh", "dh-hayati", "mdh-hayati", "urdf", "other axes"])
def test_ur_descriptions_urdf_has_the_tool_poses_with_the_file(convention, ur_urdf, tmp_path):
    if convention == "urdf":
        robot, base = ur_urdf, "base_link"
    elif convention == "other axes":  # the same joints about other axes of turned frames, and none of a UR
        text = TREE.replace('"prismatic"', '"continuous"')
        (tmp_path / "six.urdf").write_text(text.replace('"flange_fixed" type="fixed"', '"extra" type="continuous"'))
        robot, base = read_urdf(tmp_path / "six.urdf", base_link="floor", tip_link="tip"), "base"
    elif convention.startswith("mdh"):
        robot, base = off(in_table(ur10(), "mdh").robot), "base"
        if convention == "mdh-hayati":
            rows = [[*(p.nominal for p in robot.parameters if p.owner == i + 1)] for i in range(6)]
            robot = off(Robot.from_dh([[a, al, d, th, 1e-3] for a, al, d, th in rows], convention, tool=[0, 0, 0.1]))
    else:
        robot, base = off(ur10(convention)), "base"
    made = export(robot, "ur")
    document = yaml.safe_load(made.text)
    assert list(document) == ["kinematics"]
    q = drawn(robot, 20, 4)
    (tmp_path / "made.urdf").write_text(ur_macro(document["kinematics"]))
    found = yourdfpy_poses(tmp_path / "made.urdf", base, "tool0", UR_JOINTS, q)
    assert np.abs(found @ np.array(made.details["tool0_T_tool"]) - ours(robot, q)).max() < EXACT
    assert made.details["base"] == base


# --- Tesseract --------------------------------------------------------------------------------------------------------


def test_tesseracts_origins_put_into_the_urdf_give_the_tool_poses(arm, tmp_path):
    joints = yaml.safe_load(export(arm, "tesseract").text)["calibration"]["joints"]
    origins = {}
    for name, of in joints.items():
        R = Rotation.from_quat([of["orientation"][k] for k in "xyzw"]).as_matrix()
        origins[name] = matrix(R, [of["position"][k] for k in "xyz"])
    nominal = off(arm, 0.1, frames=True) if arm.urdf is None else arm.with_values(0 * arm.nominal)
    export(nominal, "urdf").write(tmp_path / "nominal.urdf")
    q = drawn(arm, 10, 5)
    base, tip, before, behind = ends(arm)
    found = before @ yourdfpy_poses(tmp_path / "nominal.urdf", base, tip, names(arm), q, origins) @ behind
    assert np.abs(found - ours(arm, q)).max() < EXACT


# --- joint zeros ------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ARMS)
def test_zeros_that_are_all_that_is_off_are_found(name, tmp_path):
    nominal = ARMS[name](tmp_path)
    wanted = np.linspace(-0.02, 0.03, nominal.n_joints)
    made = export(shifted(nominal, wanted), "zeros", nominal=nominal)
    found = [zero["reading"] for zero in made.details["zeros"].values()]
    assert found == pytest.approx(wanted, abs=1e-10)
    assert made.details["before"]["workspace"]["position_rms"] > 1e-3
    assert made.details["after"]["workspace"]["position_max"] < EXACT
    rows = yaml.safe_load(made.text)["zeros"]
    for joint, zero in zip(nominal.joints, wanted, strict=True):
        unit, figure = ("mm", 1e3 * zero) if joint.prismatic else ("deg", np.rad2deg(zero))
        assert rows[joint.name] == {"zero": pytest.approx(figure, abs=1e-7), "unit": unit}


def shifted(robot, zeros):
    """The robot whose joints stand at other angles by their zeros: each moved in its own sense."""
    moved = [0.0 if e.joint is None else e.sign * zeros[e.joint] for e in robot.elements]
    elements = (replace(e, constant=e.constant + more) for e, more in zip(robot.elements, moved, strict=True))
    return replace(robot, elements=tuple(elements))


def test_zeros_are_the_best_there_are():
    """No other zeros bring the tool nearer, at the configurations that they were fitted at."""
    nominal, robot = ur10(), off(ur10())
    q = drawn(robot, 40, 7)
    made = export(robot, "zeros", nominal=nominal, configurations=q)
    assert "with the tool" not in made.text  # it is the same
    best = np.array([zero["reading"] for zero in made.details["zeros"].values()])

    def cost(zeros):
        found, wanted = ours(nominal, q + zeros), ours(robot, q)
        turn = Rotation.from_matrix(found[:, :3, :3] @ np.swapaxes(wanted[:, :3, :3], 1, 2)).as_rotvec()
        return np.sum((found - wanted)[:, :3, 3] ** 2) + robot.reach**2 * np.sum(turn**2)

    assert cost(best) < min(cost(zeros) for zeros in (np.zeros(6), *(best + 1e-5 * np.vstack([np.eye(6), -np.eye(6)]))))
    assert set(made.details["after"]) == {"measured", "workspace"}
    assert made.details["after"]["measured"]["n"] == 40


@pytest.mark.parametrize("tolerance", [None, {"theta": 0.05}])
def test_a_joint_takes_up_the_zeros_that_angles_do_not_tell_from_its_own(tolerance):
    """Of parallel axes only the sum of their turns is seen, whatever priors make of its parts."""
    nominal = Robot.from_dh([row[:4] for row in UR10], "dh", estimate=["zeros"], tolerance=tolerance)
    true = with_changes(nominal, theta2=0.01, theta3=0.02, theta4=-0.05)
    data = measure(true, 30, np.random.default_rng(0), sigma=(1e-4, 1e-4))
    zeros = export(calibrate(nominal, data, model="rotation"), "zeros").details["zeros"]
    assert zeros["q4"]["note"] == "sum with q2, q3"
    assert abs(zeros["q4"]["reading"] + 0.02) < 4.0 * zeros["q4"]["sigma"] < 1e-3
    assert zeros["q2"] == zeros["q3"] == zeros["q2"] | {"reading": 0.0, "determined": False, "note": "taken up by q4"}


# --- what cannot be ---------------------------------------------------------------------------------------------------

UR = ur10()
MISTAKES = {
    "ur of seven joints": [seven(), {}, "seven: 7 joints, 0 of which slide, expected six joints that turn"],
    "zeros of no drawing": [UR, {}, "zeros: an arm without its nominal robot, expected a RESULT of calibrate"],
    "zeros of another drawing": [UR, {"nominal": seven()}, "nominal: seven has other joints, expected q1, q2"],
    "urdf of a name that XML cannot hold": [Robot.from_dh([[0, 0, 0, 0]], names=["a\x1b"]), {},
                                            "robot: a name with letters that XML cannot hold"],
    "dh with an idle option": [UR, {"tool": "nominal"}, "tool: means nothing for dh, expected the format zeros"],
}  # fmt: skip
"""Of a format and what is wrong: the arm, the options, and how the message begins."""


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_cannot_be_exported_is_a_line(mistake):
    arm, options, message = MISTAKES[mistake]
    assert refusal(export, arm, mistake.partition(" ")[0], **options).startswith(message)
