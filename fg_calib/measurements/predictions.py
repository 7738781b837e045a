"""What a robot itself predicts that a model would measure: for what can be determined before anything is measured."""

from __future__ import annotations

import numpy as np

from fg_calib.inputs import Floats
from fg_calib.measurements.dataset import Labels, Measurements
from fg_calib.measurements.kinds import INSTRUMENTS
from fg_calib.robot import Robot, build_chain, forward

ASSUMED_SIGMA = 1e-3
"""1 sigma of what none is specified for, [m] and [rad]."""


def predict_measurements(robot: Robot, m: Measurements, model: str) -> Measurements:
    """Measurements of a model at configurations, without noise, all of them train rows.

    Landmarks stand where they say something, at some distance from what the arm reaches.

    Args:
        robot: The robot.
        m: The configurations, the noise, and the names of landmarks; measured values are not looked at.
        model: Which measurements take part.
    """
    train = np.flatnonzero(~m.test)
    poses, n = forward(build_chain(robot), robot.trig(m.readings[train])), len(train)
    instrument = INSTRUMENTS[model]

    def specified(sigma: Floats | None, shape: tuple[int, ...]) -> Floats:
        return np.full(shape, ASSUMED_SIGMA) if sigma is None else sigma[train]

    labels = {}
    if instrument.sees_landmarks:
        for column in instrument.labels:
            names = tuple(f"{column} {i + 1}" for i in range(instrument.n_landmarks))
            found = m.labels.get(column)
            labels[column] = Labels(names, np.arange(n) % len(names)) if found is None else found.of(train)
    exact = Measurements(
        readings=m.readings[train],
        ids=np.arange(n).astype(str),
        test=np.zeros(n, dtype=np.bool_),
        position=poses.position,
        rotation=poses.rotation,
        sigma_position=specified(m.sigma_position, (n, 3)),
        sigma_orientation=specified(m.sigma_orientation, (n, 3)),
        sigma_joint=m.sigma_joint,
        source="predictions",
        labels=labels,
        sigma_length=specified(m.sigma_length, (n,)),
        sigmas={name: specified(m.sigmas.get(name), (n,)) for name in instrument.generic_columns},
    )
    if not n or not instrument.sees_landmarks:
        return instrument.predict(exact, poses, lambda kind, name: np.zeros(kind.size)) if n else exact
    middle = poses.position.mean(axis=0)
    reach = max(1e-3, float(np.linalg.norm(poses.position - middle, axis=1).max()))
    names = next(iter(labels.values())).names
    places = instrument.default_places(names, middle, reach)
    return instrument.predict(exact, poses, lambda kind, name: places.get((kind.letter, name), np.zeros(kind.size)))
