"""What instruments measure of a true arm: targets from stations, anchors, planes, boards, pixels."""

import numpy as np
from scipy.spatial.transform import Rotation
from simulated import LARGE, small_arm, true_robot

from fg_calib import KnownPoint, Measurements, Table
from fg_calib.initialization import Camera
from fg_calib.robot import pose

TOLERANCE = LARGE | {"tool": 5e-3}
CAMERA = Camera(fx=900, fy=905, cx=640, cy=480, k1=-0.1, k2=0.05)
TARGETS = np.array([[0.3, 0.1, -0.2], [-0.2, 0.3, 0.1], [0.05, -0.3, 0.4]])


def somewhere(rng, away=3.0):
    """A frame metres away, turned anyhow."""
    return Rotation.random(random_state=rng.integers(10_000)), away * rng.normal(size=3)


def measured_by(instrument, rng, n=40, sigma_joint=0.0, n_test=0):
    """A nominal arm, the true one, and a table of what an instrument measured at n configurations and some to test."""
    robot, (name, _, how) = small_arm(tolerance=TOLERANCE), instrument.partition(" ")
    true = true_robot(robot, rng)
    total = n + n_test
    reached = rng.uniform(-2, 2, (1500 if name in ("pixels", "room") else total, 4))
    at = pose(true, reached)
    q = reached + sigma_joint * rng.normal(size=reached.shape)
    more = {"sigma_joint": sigma_joint, "test": np.arange(len(q)) >= n}
    return robot, true, globals()[f"_{name}"](at, q, rng, how, **more)


def _targets(at, q, rng, how, **more):
    """Three targets at each stop, from one or two stations."""
    n, sigma = len(q), 1e-4
    k, which = np.repeat(np.arange(n), 3), np.tile(np.arange(3), n)
    station = np.arange(n)[k] % 2 if "stations" in how else np.zeros(3 * n, dtype=int)
    points = at.position[k] + np.einsum("nij,nj->ni", at.rotation[k], TARGETS[which])
    frames = [somewhere(rng, 5.0) for _ in range(2)]
    seen = np.array([frames[s][0].apply(p) + frames[s][1] for s, p in zip(station, points, strict=True)])
    more |= {"test": more["test"][k], "target": [f"t{i}" for i in which], "ids": [f"c{i}" for i in k]}
    more |= {"station": [f"s{s}" for s in station]} if "stations" in how else {}
    position = seen + sigma * rng.normal(size=seen.shape)
    data = Measurements.from_arrays(q[k], position=position, sigma_position=sigma, **more)
    known = {}
    if "known" in how:
        off = 1e-3 * rng.normal(size=3)
        known = {"t0": KnownPoint(TARGETS[0]), "t1": KnownPoint(TARGETS[1] + off, 1e-3)}
    if "nearly" in how:
        known = _nearly("t", TARGETS, how, rng)
    return Table(data, "position", frame="unknown", known=known)


def _nearly(letter, places, how, rng):
    """Places known within 1 mm on each axis; if one is wrong, the first by 12 mm more."""
    away = rng.normal(size=3)
    specified = places + 1e-3 * rng.normal(size=places.shape)
    specified[0] += ("wrong" in how) * 12e-3 * away / np.linalg.norm(away)
    return {f"{letter}{i}": KnownPoint(place, 1e-3) for i, place in enumerate(specified)}


def _anchors(at, q, rng, how, **more):
    """Lengths to three anchors in turn."""
    n, sigma, anchors = len(q), 1e-4, 2.0 * rng.normal(size=(3, 3))
    which, offset = np.arange(n) % 3, 0.3 if "offset" in how else 0.0
    length = np.linalg.norm(at.position - anchors[which], axis=1) + offset + sigma * rng.normal(size=n)
    names = [f"a{i}" for i in which]
    data = Measurements.from_arrays(q, anchor=names, distance=length, sigma_distance=sigma, **more)
    known = {"a0": KnownPoint(anchors[0])} if "known" in how else {}
    if "nearly" in how:
        known = _nearly("a", anchors, how, rng)
    return Table(data, "anchor", offset=offset > 0.0, known=known)


def _planes(at, q, rng, how, **more):
    """Distances from three planes in turn."""
    n, sigma = len(q), 1e-4
    which, normals = np.arange(n) % 3, np.linalg.qr(rng.normal(size=(3, 3)))[0]
    distance = np.einsum("ni,ni->n", normals[which], at.position) + 1.0 + sigma * rng.normal(size=n)
    names = [f"p{i}" for i in which]
    return Table(Measurements.from_arrays(q, plane=names, distance=distance, sigma_distance=sigma, **more), "plane")


def _camera_T_board(at, rng):
    board, place = somewhere(rng)
    R_T = np.swapaxes(at.rotation, 1, 2)
    return R_T @ board.as_matrix(), np.einsum("nij,nj->ni", R_T, place - at.position)


def _board(at, q, rng, how, **more):
    """Poses of a board in the camera's frame, with noise that differs along and about its axes."""
    R, t = _camera_T_board(at, rng)
    A = np.diag([3e-4, 3e-4, 1e-3, 2e-4, 2e-4, 1e-3]) + 1e-4 * np.tril(rng.normal(size=(6, 6)), -1)
    noise = rng.normal(size=(len(q), 6)) @ A.T
    more |= {"position": t + noise[:, 3:], "covariance": np.tile(A @ A.T, (len(q), 1, 1))}
    rotation = (Rotation.from_rotvec(noise[:, :3]) * Rotation.from_matrix(R)).as_matrix()
    return Table(Measurements.from_arrays(q, rotation=rotation, **more), "board")


def _corners(R, t, q, rows, step, sigma, rng, sigma_joint, gross=False):
    """Twelve corners of a board with axes R and origin t in the camera's frame, in some configurations."""
    corners = np.array([[step * i, step * j] for i in range(4) for j in range(3)])
    k, c = np.repeat(rows, len(corners)), np.tile(corners, (len(rows), 1))
    seen = CAMERA.image(t[k] + np.einsum("nij,nj->ni", R[k][:, :, :2], c))[0] + sigma * rng.normal(size=(len(k), 2))
    if gross:
        off = rng.random(len(seen)) < 0.06
        seen[off] += 30.0 * rng.normal(size=(int(np.sum(off)), 2))
    of, ids = {"sigma_pixel": sigma, "sigma_joint": sigma_joint}, [f"c{i}" for i in k]
    return Measurements.from_arrays(q[k], pixel=seen, corner=c, ids=ids, **of)


def _pixels(at, q, rng, how, sigma_joint, test):
    """Corners of a board, in the first 40 configurations that have it in sight."""
    R, t = _camera_T_board(at, rng)
    rows = np.flatnonzero((t[:, 2] > 0.8) & (np.abs(t[:, :2]) < 0.4 * t[:, 2:]).all(axis=1))[:40]
    return Table(_corners(R, t, q, rows, 0.1, 0.1, rng, sigma_joint), "pixels", camera=CAMERA)


def _room(at, q, rng, how, sigma_joint, test):
    """Corners of a board on the tool as a camera in the room sees it, nearly from its edge too."""
    turn, place = Rotation.from_euler("xyz", [2.7, 0.1, 1.0]), np.array([0.0, 0.0, 3.0])
    R, t = turn.as_matrix() @ at.rotation, turn.apply(at.position) + place
    facing = np.abs(np.einsum("ni,ni->n", R[:, :, 2], t)) > 0.1 * np.linalg.norm(t, axis=1)
    rows = np.flatnonzero((t[:, 2] > 1.0) & (np.abs(t[:, :2]) < 0.35 * t[:, 2:]).all(axis=1) & facing)[:25]
    data = _corners(R, t, q, rows, 0.08, 0.3, rng, sigma_joint, gross="gross" in how)
    return Table(data, "pixels", frame="unknown", camera=CAMERA, fixed_camera=True)
