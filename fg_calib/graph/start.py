"""Where a problem starts: the nominal parameters, with frames, tool and the measurements' unknowns from closed form."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from fg_calib.graph import frames
from fg_calib.graph.factors import Variable, Variables, frame_of, pose_of
from fg_calib.graph.frames import Frame, Unknown
from fg_calib.graph.problem import contact_points
from fg_calib.measurements.kinds import TouchedPoint
from fg_calib.measurements.series import Dataset, Table
from fg_calib.options import POSE_MODELS
from fg_calib.robot.kinematics import build_chain, forward, precompute_trig
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]


def start_of(robot: Robot, data: Dataset, variables: Variables) -> Floats:
    """The nominal parameters with the unknown frames and the measurements' unknowns, as a parameter vector."""
    start = variables.nominal()
    tool = robot.owned_by(robot.n_joints + 1)  # in the order of FRAME_KINDS
    free = np.array([robot.parameters[i].estimated for i in tool])
    trigs = [precompute_trig(robot, t.measurements.readings) for t in data.tables]
    if free[3:].all() or free[:3].any() or variables.frames:
        _start_frames(robot, data, variables, trigs, start, free)
    if variables.nuisance:
        at = variables.at(start)
        means = contact_points(data, at.chains, trigs)
        there = variables.coordinates >= 0
        start[variables.coordinates[there]] = means[there]
    return start


def _start_frames(
    robot: Robot, data: Dataset, variables: Variables, trigs: list[Floats], start: Floats, free: Booleans
) -> None:
    """Put frames and tool in a parameter vector: table by table, poses first; who says where the tool is says it once.

    Args:
        robot: The robot.
        data: What was measured.
        variables: The variables.
        trigs: Readings of each table.
        start: The parameter vector, which is filled.
        free: Which of the tool's parameters are estimated.
    """
    tool = robot.owned_by(robot.n_joints + 1)
    bare = robot.nominal
    bare[tool] = 0.0
    chain = build_chain(robot.with_values(bare))
    T = Frame(_rotation(start[tool]), start[tool][:3])
    turn, shift = bool(free[3:].all()), free[:3].copy()
    found = np.zeros(6, dtype=np.bool_)
    by_table = {int(v.symbol[2:-1]): v for v in variables.frames}
    order = sorted(range(len(data.tables)), key=lambda t: -sum(POSE_MODELS.get(data.tables[t].model, (0, 0))))  # type: ignore[arg-type]
    for number in order:
        table = data.tables[number]
        flange = forward(chain, trigs[number])
        poses = (flange.rotation, flange.position)
        if table.model in POSE_MODELS:
            unknown = Unknown(number in by_table, turn and POSE_MODELS[table.model][0], shift)
            if not (unknown.frame or unknown.tool_rotation or shift.any()):
                continue
            X, T = _from_poses(table, poses, T, unknown)
            _put(start, by_table.get(number), X)
            found |= np.append(
                shift if POSE_MODELS[table.model][1] else np.zeros(3, np.bool_), [unknown.tool_rotation] * 3
            )
        elif shift.any():
            T = _from_lengths(data, number, poses, T, shift)
            found[:3] |= shift
        turn, shift = turn and not found[3], shift & ~found[:3]
    start[np.array(tool)[found]] = _coordinates(T, start[tool])[found]


def _from_poses(table: Table, poses: tuple[Floats, Floats], T: Frame, unknown: Unknown) -> tuple[Frame, Frame]:
    m, (turned, placed) = table.measurements, POSE_MODELS[table.model]  # type: ignore[index]
    train = np.flatnonzero(~m.test)
    measured = (
        m.rotation[train] if turned and m.rotation is not None else None,
        m.position[train] if placed and m.position is not None else None,
    )
    flange = (poses[0][train], poses[1][train])
    return frames.start_from_poses(flange, measured, (Frame(np.eye(3), np.zeros(3)), T), unknown)


def _from_lengths(data: Dataset, number: int, poses: tuple[Floats, Floats], T: Frame, shift: Booleans) -> Frame:
    """The tool point from distances of pairs, or from touches of the same points where no distance was measured."""
    for s in data.series:
        if s.table == number and s.kind.ends == 2 and s.kind.names[0] == "distance":
            rows = np.flatnonzero(s.measured[:, 0] & ~s.test)
            a, b = s.ends[rows].T
            return frames.start_from_distances(poses, a, b, s.data[rows, 0], T, shift)
    for s in data.series:
        if s.table == number and isinstance(s.kind, TouchedPoint):
            train = np.flatnonzero(~s.test)
            rows = s.ends[train, 0]
            point = frames.start_from_touches(
                (poses[0][rows], poses[1][rows]), s.nuisances[train, 0], T.translation, shift
            )
            return Frame(T.rotation, point)
    return T


def _put(start: Floats, frame: Variable | None, X: Frame) -> None:
    if frame is not None:
        start[list(frame.parameters)] = _coordinates(X)


def _rotation(frame: Floats) -> Floats:
    """Rotation matrix of x, y, z, yaw, pitch, roll."""
    return pose_of(frame).rotation().matrix()


def _coordinates(frame: Frame, near: Floats | None = None) -> Floats:
    """x, y, z, yaw, pitch, roll of a frame (see `frame_of`)."""
    return frame_of(gtsam.Pose3(gtsam.Rot3(frame.rotation), frame.translation), near)
