"""From images of a simulated arm to its parameters: rendered, searched, joined with readings, calibrated."""

from dataclasses import asdict

import numpy as np
import pytest
import yaml
from boards import BOARD, CAMERA, render, views
from jobs import ur5e
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from simulated import TOOL, nees, true_robot

from fg_calib.calibration import calibrate_job
from fg_calib.io.tables import write_csv
from fg_calib.robot.inverse import solve_inverse

cv2 = pytest.importorskip("cv2", reason="no OpenCV: pip install 'fg_calib[camera]'")

TOLERANCE = {"a": 0.0005, "d": 0.0005, "alpha": 0.05, "theta": 0.1, "beta": 0.05, "tool": 0.005}


def photographed(folder, rng, n=28):
    """Robot and job files, images of a board and the readings at which the true arm took them; nominal and true arm."""
    robot = ur5e(folder, estimate=TOOL, tolerance=TOLERANCE, tool={"z": 0.08, "yaw": 30})
    true = true_robot(robot, rng)
    board_R, board_p = Rotation.from_euler("xyz", [170, 8, 20], degrees=True).as_matrix(), np.array([0.4, 0.15, 0.0])
    R, t = views(BOARD, n, rng, tilt=35.0, roll=60.0, off=0.08)
    camera_R = board_R @ np.swapaxes(R, 1, 2)  # base_T_camera = base_T_board camera_T_board^-1
    camera_p = board_p - np.einsum("nij,nj->ni", camera_R, t)
    inverse = solve_inverse(true, camera_p, camera_R, n_starts=10)
    reached = np.flatnonzero(inverse.reached)
    assert len(reached) >= 20
    (folder / "images").mkdir()
    for k in reached:
        cv2.imwrite(str(folder / "images" / f"c{k}.png"), render(BOARD, R[k], t[k], rng))
    readings = {f"q{i + 1}": np.rad2deg(q) for i, q in enumerate(inverse.readings[reached].T)}
    write_csv(folder / "readings.csv", {"id": [f"c{k}" for k in reached]} | readings)
    (folder / "board.yaml").write_text("{type: checkerboard, columns: 9, rows: 6, square: 20, units: {length: mm}}")
    (folder / "camera.yaml").write_text(yaml.safe_dump(asdict(CAMERA)))
    return robot, true


@pytest.mark.slow
def test_parameters_are_found_within_their_sigmas_from_images(tmp_path, fg_calib):
    """By corners and by poses: chi-square and errors within 99.9 %, both estimates within a sigma of each other."""
    _, true = photographed(tmp_path, np.random.default_rng(0))
    ended = fg_calib(
        *("board", tmp_path / "images", "--board", tmp_path / "board.yaml", "--camera", tmp_path / "camera.yaml"),
        *("--configurations", tmp_path / "readings.csv", "--length", "mm", "--angle", "deg", "--out", tmp_path / "out"),
    )
    assert ended.code == 0, ended.err
    tables = {"pixels": {"table": "out/pixels.csv", "camera": "out/camera.yaml"}, "board": {"table": "out/board.csv"}}
    found = {}
    for model, table in tables.items():
        units = {"length": "mm", "angle": "deg"}
        job = {"robot": "robot.yaml", "units": units, "model": model, "measurements": [table]}
        (tmp_path / "job.yaml").write_text(yaml.safe_dump(job))
        result = calibrate_job(tmp_path / "job.yaml")
        assert result.trustworthy, result.findings
        found[model] = u = result.assessment
        assert chi2.cdf(u.fit.chi_square.value, u.fit.chi_square.dof) < 0.999
        assert chi2.cdf(*nees(u, true)) < 0.999
    apart = found["board"].robot.nominal - found["pixels"].robot.nominal
    apart = apart[[true.index(name) for name in found["pixels"].names]]
    assert np.abs(apart / np.sqrt(np.diag(found["pixels"].covariance))).max() < 1.0  # the same corners, summed up
