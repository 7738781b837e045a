"""Tables with one usual mistake are named by it; healthy ones by none."""

from dataclasses import replace

import numpy as np
import pytest
from jobs import PLACED, SIGMA, measured, only, ur5e
from oracle import random_robot
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, paper_robot, small_arm, true_robot

from fg_calib import Job, Measurements, Noise, Options, SolverError, assess, build_problem, solve
from fg_calib.assessment import solve_job
from fg_calib.diagnostics import setup_check as mistakes
from fg_calib.diagnostics.setup_check import EXPLAINED, FAR, REDUCTION, check_setup
from fg_calib.graph import solver
from fg_calib.inputs import PAIR_MODELS, POSE_MODELS


def exchanged(m, i, j):
    order = np.arange(6)
    order[[i - 1, j - 1]] = j - 1, i - 1
    return replace(m, readings=m.readings[:, order])


def inverted(m):
    R = np.swapaxes(m.rotation, 1, 2)
    return replace(m, rotation=R, position=-np.einsum("nij,nj->ni", R, m.position))


def wxyz(m):
    """The scalar first, in the columns of the vector."""
    quaternion = np.roll(Rotation.from_matrix(m.rotation.copy()).as_quat(), 1, axis=1)
    return replace(m, rotation=Rotation.from_quat(quaternion).as_matrix())


SPOILT = {
    "x, y, z are in mm, not m": lambda m: replace(m, position=m.position * 1e3),
    "x, y, z are in m, not mm": lambda m: replace(m, position=m.position * 1e-3),
    "joint readings are in deg, not rad": lambda m: replace(m, readings=np.rad2deg(m.readings)),
    "joint readings are in rad, not deg": lambda m: replace(m, readings=np.deg2rad(m.readings)),
    "the poses are inverted": inverted,
    "the orientations are inverted": lambda m: replace(m, rotation=np.swapaxes(m.rotation, 1, 2)),
    "columns qx, qy, qz, qw hold w, x, y, z": wxyz,
    "columns x, y, z hold y, z, x": lambda m: replace(m, position=m.position[:, [1, 2, 0]]),
    "z has the wrong sign": lambda m: replace(m, position=m.position * [1, 1, -1]),
    "joint 2 moves the other way": lambda m: replace(m, readings=m.readings * only(2, -1, 1)),
    "the readings of joints 2 and 3 are exchanged": lambda m: exchanged(m, 2, 3),
    "the zero of joint 2 is off by 90 deg": lambda m: replace(m, readings=m.readings - only(2, np.pi / 2)),
}
"""Mistakes in a table: how they are named, and how they are made."""

ROTATIONS = ["the orientations are inverted", "columns qx, qy, qz, qw hold w, x, y, z"]
SHOWN = {
    ("pose", "unknown"): list(SPOILT),
    ("position", "known"): [key for key in SPOILT if key not in ROTATIONS],
    ("orientation", "known"): ROTATIONS,
    ("distance-rotation", "known"): [key for key in SPOILT if "joint" in key or "x, y, z are in mm" in key],
}
"""Mistakes that a model shows, the measurement frame known or not."""

CASES = [(*model, mistake) for model, mistakes in SHOWN.items() for mistake in mistakes]


def named(check):
    """What the first explanation says."""
    return check.explanations[0].mistake if check.explanations else ""


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("model", "frame", "mistake"), CASES)
def test_a_mistake_in_the_table_is_named(tmp_path, model, frame, mistake):
    robot = ur5e(tmp_path)
    m = measured(robot, placed=PLACED if frame == "unknown" else None)
    healthy = check_setup(robot, m, model, frame, doubtful=True)
    assert healthy.excess < 2.0
    assert healthy.explanations == ()
    check = check_setup(robot, SPOILT[mistake](m), model, frame)
    assert mistake in named(check)
    assert check.explanations[0].excess <= min(EXPLAINED, check.excess / REDUCTION)


def test_a_quaternion_in_another_order_is_named_where_prior_sigmas_predict_as_much(tmp_path):
    """It inverts rotations, which other frames make up for where all are about one axis: here all but 0.6 degrees."""
    tolerance, rng = {"a": 0.003, "d": 0.003, "alpha": 1, "theta": 1, "beta": 1}, np.random.default_rng(0)
    robot = ur5e(tmp_path, tolerance=tolerance, estimate=TOOL)
    q = rng.uniform(-1, 1, (50, 6)) * [0.01, 1, 1, 1, 0.01, 0.01]
    m = wxyz(measure(robot, 50, rng, sigma=SIGMA, frame=PLACED, readings=q))
    check = check_setup(robot, m, "orientation", "unknown", doubtful=True)
    assert check.excess < 1.0
    assert "if columns qx, qy, qz, qw hold w, x, y, z" in str(check)  # or the orientations are inverted: the same


ANGLES = {
    "roll, pitch, yaw are in deg, not rad": lambda R: R.as_euler("xyz", degrees=True),
    "roll, pitch, yaw are rotations about the moving axes x, y, z": lambda R: R.as_euler("XYZ"),
    "columns roll, pitch, yaw hold yaw, pitch, roll": lambda R: R.as_euler("ZYX"),
    "roll, pitch, yaw are angles about the moving axes z, y, z": lambda R: R.as_euler("ZYZ"),
    "roll, pitch, yaw are a rotation vector": lambda R: R.as_rotvec(),
}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", ANGLES)
def test_other_angles_than_roll_pitch_yaw_are_named(tmp_path, mistake):
    robot = ur5e(tmp_path)
    m, names = measured(robot), (*(f"q{i}" for i in range(1, 7)), "x", "y", "z", "roll", "pitch", "yaw")
    angles = ANGLES[mistake](Rotation.from_matrix(m.rotation.copy()))
    columns = dict(zip(names, np.hstack([m.readings, m.position, angles]).T, strict=True))
    table = Measurements.from_frame(columns, robot, noise=Noise(*SIGMA))
    assert f"if {mistake}" in str(check_setup(robot, table, "pose"))


def scaled(robot, unit, factor):
    return robot.with_values(np.array([p.nominal * (factor if p.unit == unit else 1.0) for p in robot.parameters]))


ROBOTS = {
    "the tool point is another one (estimate: [tool.x": lambda folder: (ur5e(folder), ur5e(folder, tool={"roll": 20})),
    "the tool frame is another one (estimate: all of": lambda folder: (ur5e(folder), ur5e(folder, tool={})),
    "the robot's convention is mdh-hayati": lambda folder: (ur5e(folder, convention="mdh-hayati"), ur5e(folder)),
    "the robot's angles are in deg": lambda folder: (ur5e(folder), scaled(ur5e(folder), "rad", 180.0 / np.pi)),
    "the robot's lengths are in mm": lambda folder: (ur5e(folder), scaled(ur5e(folder), "m", 1e3)),
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("mistake", ROBOTS)
def test_a_mistake_in_the_robot_is_named(tmp_path, mistake):
    right, nominal = ROBOTS[mistake](tmp_path)
    assert named(check_setup(nominal, measured(right), "pose")).startswith(mistake)


def test_the_mistake_stands_first_in_the_verdict(tmp_path):
    m, robot = measured(ur5e(tmp_path), placed=PLACED), ur5e(tmp_path)
    wrong = replace(m, position=m.position * 1e3)
    verdict = assess(solve(build_problem(robot, wrong, model="pose", frame="unknown"))).verdict
    assert verdict.errors[0].startswith("position residuals fall from")
    assert verdict.errors[0].endswith("mm in the median if x, y, z are in mm, not m")
    assert not any("systematic" in text for text in (*verdict.errors, *verdict.warnings))


def test_a_solver_that_gives_up_names_the_mistake_too(tmp_path, monkeypatch):
    def gives_up(*_, **__):
        raise SolverError("no step can be solved")

    robot = ur5e(tmp_path)
    m = measured(robot)
    job = Job(None, robot, replace(m, position=m.position * 1e3), Options("pose"))
    monkeypatch.setattr(solver, "_fit", gives_up)
    with pytest.raises(SolverError, match=r"^no step can be solved; position .* if x, y, z are in mm, not m"):
        solve_job(job)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", range(24))
def test_a_healthy_job_raises_no_alarm(seed):
    """With large but specified tolerances; also where it is looked at although its residuals are as predicted."""
    rng = np.random.default_rng(seed)
    large = {"a": 0.02, "d": 0.02, "alpha": 0.03, "theta": 0.05}
    robot = (
        paper_robot(tolerance={"a": 0.01, "alpha": 1e-3, "d": 0.01, "theta": 1e-3, "beta": 1e-3}),
        small_arm(tolerance=large, estimate=TOOL),
        small_arm(),
        random_robot("urdf", 6, rng),
        random_robot("dh", 5, rng),
    )[seed % 5]
    models = (*POSE_MODELS, *PAIR_MODELS)
    model = models[seed % len(models)]
    unknown = bool(rng.random() < 0.5) and model in ("pose", "position", "orientation")
    m = measure(true_robot(robot, rng), 40 + 10 * seed, rng, sigma=(1e-3, 1e-3), frame=PLACED if unknown else None)
    check = check_setup(robot, m, model, "unknown" if unknown else "known", doubtful=True)
    assert check.excess < FAR / 2
    assert check.explanations == ()


def test_a_healthy_job_is_looked_at_once(monkeypatch, tmp_path):
    """What it costs: the hypotheses are not even made."""
    robot = ur5e(tmp_path)
    monkeypatch.setattr(mistakes, "_explanations", lambda *_: pytest.fail("looked for mistakes"))
    assert check_setup(robot, measured(robot), "pose").excess < 2.0


def test_rows_that_are_not_there_say_nothing(tmp_path):
    """Test rows alone, and a table without what the model uses."""
    robot = ur5e(tmp_path)
    m = measured(robot)
    assert check_setup(robot, replace(m, test=np.ones(50, dtype=bool)), "pose").residuals == ()
    bare = replace(m, position=None, rotation=None, sigma_position=None, sigma_orientation=None)
    assert check_setup(robot, bare, "distance", doubtful=True).residuals == ()
