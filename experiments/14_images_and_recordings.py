"""Are the sigmas honest of what `fg-calib board` makes of images, and `fg-calib bag` of a recording?

Command: python experiments/14_images_and_recordings.py [--quick] [--seed N] [--draws N] [--out FOLDER]
Takes a minute on one free core.

*Images* are rendered (640 x 480, focal length 620 px, distortion, blur, noise; `tests/boards.py`) from known places,
their corners searched, and poses fitted with the camera given: errors of corners beside their sigma, and NEES of the
poses over 6, which is 1 if covariances are right. Without noise what is left is what searching costs.

*Recordings* are simulated (12 stops of 1.5 s, poses at 60 Hz, clocks 0.137 s apart; `tests/recordings.py`) with white
noise of 0.05 mm, and beneath it 0.2 mm that is correlated over a time: NEES of the stops' positions over 3, and the
squared error of the clocks' offset over its variance (of Student's t with 10 degrees of freedom 1.13).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from space_robot import arguments_of, write_json

from fg_calib.importers.board import CalibrationBoard
from fg_calib.importers.opencv import find_corners
from fg_calib.importers.standstill import average_stops
from fg_calib.importers.views import Corners, fit_board

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import boards
import recordings

NAME = "14_images_and_recordings"
CHECKERBOARD = CalibrationBoard("checkerboard", 9, 6, 0.02)
CHARUCO = CalibrationBoard("charuco", 9, 7, 0.02, 0.014, "DICT_5X5_100")


class Look(NamedTuple):
    """How a board is seen: point spread, [px], noise, [grey levels], and distance, [m]."""

    board: CalibrationBoard
    blur: float = 0.7
    noise: float = 2.0
    distance: tuple[float, float] = (0.35, 0.6)


LOOKS = {
    "checkerboard, no noise": Look(CHECKERBOARD, noise=0.0),
    "checkerboard": Look(CHECKERBOARD),
    "checkerboard, sharp": Look(CHECKERBOARD, blur=0.4),
    "checkerboard, 0.8 to 1.3 m": Look(CHECKERBOARD, distance=(0.8, 1.3)),
    "ChArUco, no noise": Look(CHARUCO, noise=0.0),
    "ChArUco": Look(CHARUCO),
}
SLOW = {"white alone": None, "0.1 s": 0.1, "0.3 s": 0.3, "1 s": 1.0, "3 s": 3.0, "20 s": 20.0}
"""Time constant of the slow noise, [s]."""
N_RECORDINGS = 3
"""To one draw of images."""


def seen(look: Look, n: int, seed: int) -> dict[str, Any]:
    """Corners and poses of n images beside the truth."""
    rng = np.random.default_rng(seed)
    truth, found, off = {}, [], []
    places = zip(*boards.views(look.board, n, rng, off=0.1, distance=look.distance), strict=True)
    for k, (R, t) in enumerate(places):
        image = boards.render(look.board, R, t, rng, noise=look.noise, blur=look.blur)
        corners = find_corners(image, look.board)
        if not isinstance(corners, str):
            found.append(Corners(f"i{k}", *corners))
            truth[f"i{k}"] = R, t
            at = t + look.board.corners[corners[0]] @ R[:, :2].T
            off.append(corners[1] - boards.CAMERA.image(at)[0])
    fit = fit_board(look.board, found, boards.SIZE, boards.CAMERA)
    nees = []
    for view in fit.views:
        R, t = truth[view.name]
        turn = Rotation.from_matrix(R @ view.rotation.T).as_rotvec()
        e = np.concatenate([turn, t - view.position])
        nees.append(float(e @ np.linalg.solve(view.covariance, e)) / 6.0)
    means = np.array([len(o) ** 0.5 * o.mean(axis=0) for o in off])
    rms = float(np.sqrt(np.mean(np.concatenate(off) ** 2)))
    return {
        "n_images": len(found),
        "corner_rms_px": rms,
        "sigma_px": fit.sigma,
        "common": float(np.sqrt(np.mean(means**2))) / rms,
        "nees": float(np.mean(nees)),
        "nees_error": float(np.std(nees) / np.sqrt(len(nees))),
    }


def recorded(seconds: float | None, n: int, seed: int) -> dict[str, Any]:
    """Positions of stops and offsets of clocks of n recordings beside the truth."""
    nees, offset, sigma = [], [], []
    for k in range(n):
        motion = recordings.record(seed + k, sigma_position=5e-5)
        if seconds is not None:
            rng = np.random.default_rng([seed + k, 1])
            motion.position += 2e-4 * recordings.correlated(rng, motion.position.shape, np.exp(-1.0 / (60.0 * seconds)))
        stops = average_stops(*motion.streams(), recordings.arm(1e-3))
        row = [int(name[4:]) - 1 for name in stops.ids]
        nees.append(np.mean(((stops.position - motion.true_position[row]) / stops.sigma_position) ** 2))
        assert stops.offset is not None
        offset.append(((stops.offset.seconds - motion.offset) / stops.offset.sigma) ** 2)
        sigma.append(np.median(stops.sigma_position))
    return {
        "n_recordings": n,
        "nees": float(np.mean(nees)),
        "nees_error": float(np.std(nees) / np.sqrt(n)),
        "sigma_mm": 1e3 * float(np.mean(sigma)),
        "offset": float(np.mean(offset)),
    }


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run from the command line."""
    given = arguments_of(__doc__, NAME, arguments, 40, 6)
    found: dict[str, Any] = {"seed": given.seed, "images": {}, "recordings": {}}
    print(f"{'images':28} n  corner error  sigma [px]  in common  NEES")
    for name, look in LOOKS.items():
        row = found["images"][name] = seen(look, given.draws, given.seed)
        print(
            f"{name:28} {row['n_images']:3d} {row['corner_rms_px']:8.4f} {row['sigma_px']:10.4f} {row['common']:8.2f}"
            f" {row['nees']:8.2f} ± {row['nees_error']:.2f}",
            flush=True,
        )
    print(f"{'recordings, slow noise':28} n  sigma [mm]  NEES  offset")
    for name, seconds in SLOW.items():
        row = found["recordings"][name] = recorded(seconds, max(given.draws // N_RECORDINGS, 2), given.seed)
        print(
            f"{name:28} {row['n_recordings']:3d} {row['sigma_mm']:8.4f} {row['nees']:8.2f} ± {row['nees_error']:.2f}"
            f" {row['offset']:6.2f}",
            flush=True,
        )
    write_json(given.file, found)
    return found


if __name__ == "__main__":
    main()
