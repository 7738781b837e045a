"""What a robot itself predicts that a model would measure: for what can be determined before anything is measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fg_calib.measurements.dataset import Labels, Measurements
from fg_calib.options import Model
from fg_calib.robot.kinematics import Poses, build_chain, forward
from fg_calib.robot.model import Robot

Floats = NDArray[np.float64]

N_PLACES = 3
"""Anchors, or planes, where no column names them."""

UNSTATED = 1e-3
"""Sigma of what none is stated for, [m] and [rad]."""


def predictions(robot: Robot, m: Measurements, model: Model) -> Measurements:
    """What a model would measure at some configurations, all of them train rows.

    Anchors, planes and boards stand where they say something, at some distance from what the arm reaches.

    Args:
        robot: The robot.
        m: The configurations, the noise, and the names of anchors, planes or boards; measured values are not looked at.
        model: Which measurements take part.
    """
    train = np.flatnonzero(~m.test)
    poses = forward(build_chain(robot), robot.trig(m.readings[train]))
    n = len(train)

    def stated(sigma: Floats | None, shape: tuple[int, ...]) -> Floats:
        return np.full(shape, UNSTATED) if sigma is None else sigma[train]

    labels: dict[str, Labels] = {name: of.of(train) for name, of in m.labels.items() if name == model}
    if model in ("anchor", "plane", "board") and model not in labels:
        k = 1 if model == "board" else N_PLACES
        labels[model] = Labels(tuple(f"{model} {i + 1}" for i in range(k)), np.arange(n) % k)
    empty = Measurements(
        readings=m.readings[train],
        ids=np.arange(n).astype(str),
        test=np.zeros(n, dtype=np.bool_),
        position=poses.position,
        rotation=poses.rotation,
        sigma_position=stated(m.sigma_position, (n, 3)),
        sigma_orientation=stated(m.sigma_orientation, (n, 3)),
        sigma_joint=m.sigma_joint,
        source="predictions",
        labels=labels,
        sigma_length=stated(m.sigma_length, (n,)),
    )
    return _of_instrument(empty, model, poses) if n and model in labels else empty


def _of_instrument(m: Measurements, column: str, poses: Poses) -> Measurements:
    """Lengths, distances or board's poses in the place of the tool's."""
    reach = max(1e-3, float(np.linalg.norm(poses.position - poses.position.mean(axis=0), axis=1).max()))
    labels, rng, middle = m.labels[column], np.random.default_rng(0), poses.position.mean(axis=0)
    k, index = len(labels.names), np.maximum(labels.index, 0)
    turn = Rotation.random(k, random_state=0)
    away = middle + 2.0 * reach * turn.as_matrix()[:, :, 2]
    if column == "anchor":
        return replace(m, length=np.linalg.norm(poses.position - away[index], axis=1))
    if column == "plane":
        normal = turn.as_matrix()[:, :, 2]
        return replace(m, length=np.einsum("ni,ni->n", normal[index], poses.position - middle) + 2.0 * reach)
    boards = Rotation.random(k, random_state=rng.integers(1000)).as_matrix()
    R_T = np.swapaxes(poses.rotation, 1, 2)
    position = np.einsum("nij,nj->ni", R_T, away[index] - poses.position)
    return replace(m, rotation=R_T @ boards[index], position=position)
