"""Scenarios of a small arm and one instrument, of every kind, that several test files use."""

import numpy as np
from instruments import CAMERA, TOLERANCE
from scipy.spatial.transform import Rotation
from simulated import small_arm

from fg_calib import Noise, Pairing, Scenario
from fg_calib.simulation.scenario import Errors, Instrument, Placement, RandomReadings, Spot, board_corners

SIGMA = Noise(1e-4, 2e-4, 0.0, distance=1e-4, angle=2e-4, point=1e-4, pixel=0.1)
EXACT = Noise(0.0, 0.0, 0.0, distance=0.0, angle=0.0, point=0.0, pixel=0.0)
GRID = board_corners(5, 4, 0.1)
WALL = {"wall": Placement(Rotation.from_euler("y", -0.5 * np.pi).as_matrix(), np.array([2.5, 0.0, 0.0]))}
"""Across x, its front towards the arm."""


INSTRUMENTS = {
    "pose": Instrument(model="pose", name="it"),
    "orientations": Instrument(model="orientation", name="it", stations=2),
    "targets": Instrument(model="position", name="it", targets=3),
    "stations": Instrument(model="position", name="it", targets={"a": Spot([0.1, 0, 0]), "b": Spot([0, 0.2, 0.1])},
                        stations=2),
    "formed pairs": Instrument(model="distance-rotation", name="it", pairing=Pairing("chain")),
    "pairs": Instrument(model="distance-rotation", name="it", pairs=Pairing("random", 80)),
    "anchors": Instrument(model="anchor", name="it"),
    "offset": Instrument(model="anchor", name="it", offset=0.12,
                         anchors={"bolt": Spot([1.0, -2.0, 0.5], 0.0), "pin": Spot([2.0, 1.0, 0.5])}),
    "contact": Instrument(model="anchor", name="it", anchors=3, contact=True),
    "planes": Instrument(model="plane", name="it", planes=4),
    "faces": Instrument(model="plane", name="it", contact=True),
    "board": Instrument(model="board", name="it", boards=WALL),
    "pixels": Instrument(model="pixels", name="it", boards=WALL, camera=CAMERA, corners=GRID),
    "camera in the room": Instrument(model="pixels", name="it", camera=CAMERA, corners=GRID, fixed=True),
    "sockets": Instrument(model="distance", name="it", sockets=3),
}  # fmt: skip


def scenario(*instruments, n=60, **changes):
    """A small arm with one prismatic joint, measured with 1e-4 m, 2e-4 rad and 0.1 px."""
    errors = Errors("normal", {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3})
    given = {"robot": small_arm(tolerance=TOLERANCE), "errors": errors, "configurations": RandomReadings(n)}
    given |= {"noise": SIGMA, "instruments": instruments, "job": {}}
    return Scenario(**given | changes)
