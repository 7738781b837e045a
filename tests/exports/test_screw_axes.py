"""Arms by their screw axes: exported with sigmas, an axis report, and effects that are those of a table."""

import re

import numpy as np
import pytest
import yaml
from exported import ARMS, off, scara, seven
from oracle import dh_joint, frame, rotation, tool_pose, translation
from simulated import TOOL, measure
from tolerances import rounding

from fg_calib import calibrate, export, observe_structure, read_robot
from fg_calib.exports.dh import drawn, errors, in_table, poses
from fg_calib.exports.poe import axis_changes, axis_frames, in_screws
from fg_calib.robot import Compliance, Gain, Harmonics, Joint, Mass


def test_effects_are_those_of_the_same_arm_in_a_table():
    """The com of a mass on an arm of axes is that in the base frame at zero readings."""
    table, values = seven(), {p.name: p.nominal for p in seven().parameters}
    T, masses, moved = frame(**{k: values[f"base.{k}"] for k in ("x", "y", "z", "roll", "pitch", "yaw")}), [], []
    for i in range(1, 8):
        row = {kind: values[f"{kind}{i}"] for kind in ("a", "alpha", "d", "theta")}
        T, com = T @ dh_joint("mdh", row, 0.0, False), np.array([0.1, -0.2, 0.3 * i])
        masses.append(Mass(i, 1.0 + i, tuple(com)))
        moved.append(Mass(i, 1.0 + i, tuple(T[:3, :3] @ com + T[:3, 3])))
    both = (table, masses), (in_screws(table), moved)
    arms = [arm.with_effects(Compliance(its), Harmonics(), Gain()) for arm, its in both]
    q, coefficients = drawn(table, 20, 0), 1e-2 * np.random.default_rng(0).normal(size=7 * 6)
    coefficients[:7] *= 1e-2  # compliances
    at = [poses(arm.with_values([*arm.nominal[:-42], *coefficients]), q) for arm in arms]
    assert at[1].position == pytest.approx(at[0].position, abs=rounding(10.0))
    assert at[1].rotation == pytest.approx(at[0].rotation, abs=rounding(10.0))
    assert errors(table, arms[0].with_values([*table.nominal, *coefficients]), q).position_max > 1e-3


def test_changes_of_axes_are_the_parameters_that_make_them():
    arm, changes = in_screws(seven()), np.random.default_rng(0).uniform(-0.3, 0.3, 28)
    moved = arm.with_values([*arm.nominal[:6], *changes, *arm.nominal[-6:]])
    found = axis_changes(in_table(moved, "dh-hayati").robot, axis_frames(arm))
    assert found.ravel() == pytest.approx(changes, abs=1e-9)


def calibrated(model):
    nominal = in_screws(scara())
    nominal = nominal.with_estimated([p.name for p in nominal.parameters if 1 <= p.owner <= 4 or p.name in TOOL])
    true, rng = off(nominal, frames=False), np.random.default_rng(0)
    return calibrate(nominal, measure(true, 40, rng, readings=drawn(true, 40, 1), sigma=(1e-5, 1e-5)), model=model)


def test_axes_are_reported_with_their_sigmas_and_read_back(tmp_path):
    found = calibrated("pose")
    made, own = export(found, "poe"), found.parameters
    made.write(tmp_path / "arm.yaml")
    assert errors(read_robot(tmp_path / "arm.yaml"), found.robot, drawn(found.robot, 100, 0)).position_max < 1e-12
    for (name, axis), row in zip(made.details["axes"].items(), yaml.safe_load(made.text)["joints"], strict=True):
        for size, kinds in (("tilt", ("pitch", "roll")), ("offset", ("x", "y"))):
            assert abs(np.dot(row["axis"], row["point"])) < 1e-12
            both = [own[f"{name}.{kind}"] for kind in kinds if f"{name}.{kind}" in own]  # none of how a slide is offset
            sigmas = [row["sigma"][kind] for kind in kinds]
            # The point is the nearest one of the calibrated axis: others by offsets along it times tilts, some 1e-3.
            assert axis[size] == pytest.approx(np.linalg.norm([p.estimate for p in both]), rel=1e-2, abs=1e-9)
            assert np.linalg.norm(sigmas) == pytest.approx(np.linalg.norm([p.sigma for p in both]), rel=2e-2)
            assert 0.99 * min(sigmas) <= axis["sigma"][size] <= 1.01 * max(sigmas)
        form = rf"# {name}: offset (\S+) mm \(sigma (\S+)\), tilt (\S+) deg \(sigma (\S+)\)"
        said = re.search(form, made.text).groups()
        sizes = [(axis[size], axis["sigma"][size]) for size in ("offset", "tilt")]
        in_mm_and_deg = np.concatenate(sizes) * [1e3, 1e3, np.rad2deg(1.0), np.rad2deg(1.0)]
        assert [float(one) for one in said] == pytest.approx(in_mm_and_deg, rel=0.06)  # two digits of sigmas


def test_what_no_row_tells_of_an_axis_is_unknown():
    made = export(calibrated("distance"), "poe")
    assert made.details["axes"]["q1"]["sigma"] == {}
    assert any(note.startswith("q1: offset") and "mm (sigma unknown), tilt" in note for note in made.notes)


def link(b, l, beta=0.0, **_):  # noqa: E741 - the figures of CPC
    u, v = np.arctan2(b[1], b[0]), np.arctan2(np.hypot(*b[:2]), b[2])
    return rotation(2, u) @ rotation(1, v) @ rotation(2, np.deg2rad(beta) - u) @ frame(*np.multiply(1e-3, l), 0, 0, 0)


def product(file, q):
    """B0 B1 ... Bn of Zhuang, Roth and Hamano with Bi = Qi Vi, then the tool; in mm and deg."""
    T = link(**file["link0"])
    for row, one in zip(file["joints"], q, strict=True):
        move, unit = (translation, 1e-3) if row.get("type") == "prismatic" else (rotation, np.deg2rad(1.0))
        T = T @ move(2, row.get("sign", 1) * one + row.get("offset", 0.0) * unit) @ link(**row)
    return T @ rotation(0, np.deg2rad(file.get("tool", {}).get("roll", 0.0)))


@pytest.mark.parametrize("name", ARMS)
def test_an_arm_in_links_is_the_same_and_reads_back_by_its_axes(name, tmp_path):
    """Of URDFs, parallel axes, slides, and axes that are drawn against their readings; with 4R + 2P + 6 parameters."""
    for arm in (ARMS[name](tmp_path), off(ARMS[name](tmp_path), size=1e-2, frames=True)):
        made = export(arm, "cpc")
        (tmp_path / "arm.yaml").write_text(made.text)
        file, back = yaml.safe_load(made.text), read_robot(tmp_path / "arm.yaml")
        links = [file["link0"], *file["joints"]]
        assert min(one["b"][2] for one in links) >= 0.0
        assert {(one["l"][2], one.get("beta", 0.0)) for one in links[:-1]} == {(0.0, 0.0)}
        assert all(one["l"] == [0.0] * 3 for one, j in zip(links, arm.joints, strict=False) if j.prismatic)
        for q in drawn(arm, 20, 0):
            assert product(file, q) == pytest.approx(tool_pose(arm, q), abs=1e-12)
            assert tool_pose(back, q) == pytest.approx(tool_pose(arm, q), abs=1e-12)
        assert (back.convention, made.details["error"]["position_max"] < 1e-12) == ("poe", True)
        for one in (back, arm) if name in ("ur10", "seven", "scara") else (back,):  # those in complete tables
            rank = observe_structure(one.with_estimated([p.name for p in one.parameters]), "pose").observability.rank
            assert rank == sum(2 if joint.prismatic else 4 for joint in arm.joints) + 6


FILE = """\
units: {length: mm, angle: deg}
convention: cpc
link0: {b: [0.6, 0, 0.8], l: [1, 2, 3], beta: 40}
joints:
- {b: [0, 0.28, -0.96], l: [400, -20, 30], beta: -20, sign: -1, offset: 30, name: shoulder, limits: [-90, 45]}
- {b: [0, -1, 0], l: [0, 300, 5], type: prismatic, offset: -70}
- {b: [0.48, -0.6, 0.64], l: [10, 20, 30], beta: 110}
tool: {roll: 25}
tolerance: {x: 2, pitch: 0.1}
"""


def test_links_of_six_figures_signs_and_offsets_are_read(tmp_path):
    (tmp_path / "arm.yaml").write_text(FILE)
    robot = read_robot(tmp_path / "arm.yaml")
    for q in np.random.default_rng(0).uniform(-1.0, 1.0, (5, 3)):
        assert tool_pose(robot, q) == pytest.approx(product(yaml.safe_load(FILE), q), abs=1e-14)
    assert robot.joints[0] == Joint("shoulder", False, -np.pi / 2, np.pi / 4)
    assert [p.tolerance for p in robot.parameters if p.kind == "x" and 1 <= p.owner <= 3] == [2e-3, 2e-3]
