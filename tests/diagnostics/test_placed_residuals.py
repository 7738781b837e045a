"""Mistakes in the set-up of instruments' tables: targets, anchors, planes, boards, pixels; healthy ones have none."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from scipy.spatial.transform import Rotation

from fg_calib.diagnostics.setup_check import check_setup


def check(robot, table, **changes):
    table = replace(table, measurements=replace(table.measurements, **changes))
    return check_setup(robot, table.measurements, table.model, table.frame, doubtful=True, table=table)


def turned(rotation, factor):
    vector = Rotation.from_matrix(rotation.copy()).as_rotvec()
    return Rotation.from_rotvec(vector * factor).as_matrix()


def sign(m, joint):
    return m.readings * np.where(np.arange(m.readings.shape[1]) == joint, -1.0, 1.0)


def in_rad(m):
    return {"readings": m.readings * np.where(np.arange(4) == 2, 1.0, np.pi / 180)}


def inverted(m):
    R = np.swapaxes(m.rotation, 1, 2)
    return {"rotation": R, "position": -np.einsum("nij,nj->ni", R, m.position)}


CASES = [
    ("targets", "x, y, z are in m, not mm", lambda m: {"position": m.position / 1e3}),
    ("targets stations", "joint 2 moves the other way", lambda m: {"readings": sign(m, 1)}),
    ("targets known", "readings of joints 1 and 2 are exchanged", lambda m: {"readings": m.readings[:, [1, 0, 2, 3]]}),
    ("anchors", "distances are in mm, not m", lambda m: {"columns": {"distance": m.value("distance") * 1e3}}),
    ("anchors offset", "joint 2 moves the other way", lambda m: {"readings": sign(m, 1)}),
    ("anchors known", "joint readings are in rad, not deg", in_rad),
    ("planes", "distances are in m, not mm", lambda m: {"columns": {"distance": m.value("distance") / 1e3}}),
    ("board", "the poses are inverted (board_T_camera instead of camera_T_board)", inverted),
    ("board", "rx, ry, rz are in rad, not deg", lambda m: {"rotation": turned(m.rotation, np.pi / 180)}),
    ("pixels", "columns u, v hold v, u", lambda m: {"image": m.image[:, [1, 0, 2, 3]]}),
    ("pixels", "corner_x, corner_y are in mm, not m", lambda m: {"image": m.image * [1, 1, 1e3, 1e3]}),
    ("pixels", "joint 2 moves the other way", lambda m: {"readings": sign(m, 1)}),
]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("instrument", "mistake", "spoil"), CASES, ids=[f"{of}: {what[:20]}" for of, what, _ in CASES])
def test_a_mistake_in_an_instruments_table_is_named(instrument, mistake, spoil):
    robot, _, table = measured_by(instrument, np.random.default_rng(1))
    assert mistake in str(check(robot, table, **spoil(table.measurements)))
