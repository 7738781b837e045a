"""What noise does to lengths and angles beyond the first order, through the command line: chains and kinks."""

import json

import numpy as np
import pytest
from scipy import stats

ROBOT = """convention: dh
joints: [{a: 0.5, alpha: 0, d: 0, theta: 0}, {a: 0.5, alpha: 0, d: 0, theta: 0}]
fixed: [theta1, d1, alpha1, theta2, d2, alpha2]
tolerance: {a: 0.01}
"""


def tool(q):
    """Tool points of two links of 0.5 m."""
    angles = np.cumsum(q, axis=1)
    return 0.5 * np.stack([np.cos(angles).sum(axis=1), np.sin(angles).sum(axis=1), 0.0 * q[:, 0]], axis=1)


def path(step):
    """Readings along a smooth path, one each time the tool has moved by `step`, [m]."""
    t = np.linspace(0.0, 8.0, 1500)
    q = np.stack([0.9 * np.sin(t), 1.4 + 0.9 * np.sin(1.37 * t + 1.0)], axis=1)
    points, chosen = tool(q), [0]
    for i in range(len(q)):
        if np.linalg.norm(points[i] - points[chosen[-1]]) > step:
            chosen.append(i)
    return q[chosen]


def write(folder, columns, job, pairs=None):
    (folder / "robot.yaml").write_text(ROBOT)
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, map(float, row))) for row in rows)]
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    if pairs is not None:
        (folder / "pairs.csv").write_text(pairs)
    (folder / "job.yaml").write_text("robot: robot.yaml\nmeasurements: poses.csv\n" + job)
    return folder / "job.yaml"


@pytest.mark.slow
def test_lengths_from_a_chain_of_short_steps_are_as_good_as_their_sigmas(fg_calib, tmp_path):
    """Steps of 14 mm, points to 1 mm: as plain numbers, distances made both links 5 and 7 sigma too short or long."""
    q, squares = path(0.014), []
    for seed in range(8):
        measured = tool(q) + 1e-3 * np.random.default_rng(seed).normal(size=(len(q), 3))
        columns = dict(zip(("q1", "q2", "x", "y", "z"), np.column_stack([q, measured]).T, strict=True))
        job = write(tmp_path, columns, "model: distance\npairing: chain\nnoise: {position: 0.001}\n")
        ended = fg_calib("calibrate", job, "--json")
        result = json.loads(ended.out)
        assert ended.code == 0
        error = np.array([p["correction"] for p in result["parameters"] if p["name"] in ("a1", "a2")])
        squares.append(error @ np.linalg.solve(result["covariance"]["matrix"], error))
        assert result["chi2_p_value"] > 1e-4
    assert np.sum(squares) < stats.chi2.ppf(0.9999, 16)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("measured", "turn"), [(0.0, 1.0), (np.pi, 1.0), (1.0, 1e-3), (1.0, np.pi - 1e-3)])
def test_an_angle_at_a_kink_that_the_arm_contradicts_is_not_good(fg_calib, tmp_path, measured, turn):
    """It used to leave as `angle near zero`; chi-square was that of the others."""
    turns = np.array([0.5, 0.9, 1.3, 1.7, turn])
    q = np.array([[x, 0.3] for t in turns for x in (0.0, t)])
    angles = [*turns[:-1], measured]
    pairs = "a,b,angle\n" + "".join(f"{2 * i},{2 * i + 1},{a!r}\n" for i, a in enumerate(map(float, angles)))
    (job := write(tmp_path, {"q1": q[:, 0], "q2": q[:, 1]}, "", pairs)).write_text(
        "robot: robot.yaml\nmeasurements: poses.csv\npairs: pairs.csv\nmodel: rotation\nnoise: {angle: 0.001}\n"
    )
    (tmp_path / "robot.yaml").write_text(ROBOT.replace("theta2, ", "").replace("{a: 0.01}", "{a: 0.01, theta: 0.01}"))
    ended = fg_calib("calibrate", job, "--json")
    result = json.loads(ended.out)
    assert ended.code == 3
    assert result["n_residuals"] == 5
    assert result["chi2"] > 1e4
