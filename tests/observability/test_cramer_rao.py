"""Bounds: closed form on a planar arm, a dense computation of another kind, and fits of drawn errors and noise."""

import numpy as np
import pytest
from oracle import central_differences
from simulated import TOOL, measure, planar_robot, small_arm
from tolerances import rounding

from fg_calib import Measurements, Pairing
from fg_calib.baseline.comparison import real_errors
from fg_calib.observability.cramer_rao import Bound, cramer_rao
from fg_calib.robot import pose

SIGMA, TOLERANCE = 1e-3, 5e-3
N = 9


def at(robot, readings, sigma_joint=0.0):
    """Measurements at given readings; only readings and sigmas matter."""
    readings = np.asarray(readings, dtype=float)
    rng = np.random.default_rng(0)
    return measure(robot, len(readings), rng, sigma=(SIGMA, 2e-4), sigma_joint=sigma_joint, readings=readings)


def planar(*names, tolerance=None):
    """Links of 2 m and 1 m, of which only `names` may be wrong."""
    return planar_robot(tolerance={"a": tolerance, "theta": 1e-3} if tolerance else None).with_estimated(names)


def spread_readings(n, n_joints=2, seed=1):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, n_joints))


def test_pairs_of_one_configuration_share_its_error():
    # From q2 = 0 to q2 = pi the tool moves by 2 a2 in a line; the n distances all have the error of the first point.
    robot = planar("a2")
    measurements = at(robot, [[0.0, 0.0], *([[0.0, np.pi]] * N)])
    exact = cramer_rao(robot, measurements, model="distance", prior=False)
    independent = cramer_rao(robot, measurements, model="distance", prior=False, pair_errors="independent")
    variance = SIGMA**2 / 4.0
    # 1e-3 of a formed pair's variance counts as its own (PRIVATE_SHARE).
    assert exact.covariance[0, 0] == pytest.approx(variance * (1.0 + 1.0 / N), rel=2e-3)
    assert exact.claimed[0, 0] == pytest.approx(exact.covariance[0, 0], rel=rounding(1, 10), abs=0)
    assert independent.covariance[0, 0] == pytest.approx(variance * (1.0 + 1.0 / N), rel=1e-6)
    assert independent.claimed[0, 0] == pytest.approx(variance * 2.0 / N, rel=1e-6)


def test_what_is_held_but_wrong_adds_what_the_kept_do_not_make_up_for():
    # Stretched out, the data see a1 + a2 alone. Kept a1 takes all of it, right where the arm is stretched; folded the
    # tool is at a1 - a2, and wrong by twice the error of a2.
    robot = planar("a1", "a2", tolerance=TOLERANCE)
    stretched = at(robot, [[q, 0.0] for q in np.linspace(-2.0, 2.0, N)])
    bound = cramer_rao(robot, stretched, model="position", prior=False, kept=["a1"])
    seen, folded = stretched.readings, stretched.readings + np.array([0.0, np.pi])
    assert bound.position(seen) == pytest.approx(SIGMA / np.sqrt(N), rel=rounding(1, 10), abs=0)
    expected = np.sqrt(SIGMA**2 / N + 4.0 * TOLERANCE**2)
    assert bound.position(folded) == pytest.approx(expected, rel=rounding(1, 10), abs=0)
    assert bound.position(folded, claimed=True) == pytest.approx(SIGMA / np.sqrt(N), rel=rounding(1, 10), abs=0)
    assert bound.rank == cramer_rao(robot, stretched, model="position", prior=False).rank == 1


def dense_bound(robot, readings, sigma_joint, pairs, pair_errors, step=1e-6):
    """The covariance of an estimate from distances, by central differences of the positions and a dense C."""
    i = [k for k, p in enumerate(robot.parameters) if p.estimated]
    a, b = np.array(pairs).T
    nominal = robot.nominal

    def distances(values, q):
        p = pose(robot.with_values(values), q).position
        return np.linalg.norm(p[b] - p[a], axis=1)

    J = central_differences(lambda values: distances(values, readings), nominal, step)[:, i]
    p = pose(robot, readings).position
    u = (p[b] - p[a]) / np.linalg.norm(p[b] - p[a], axis=1)[:, None]
    L = np.zeros((len(pairs), readings.size + p.size))
    for row, (first, second) in enumerate(pairs):
        L[row, 3 * second : 3 * second + 3] = SIGMA * u[row]
        L[row, 3 * first : 3 * first + 3] = -SIGMA * u[row]
    of_readings = central_differences(lambda q: distances(nominal, q.reshape(readings.shape)), readings.ravel(), step)
    L[:, p.size :] = sigma_joint * of_readings
    P = np.diag([1.0 / robot.parameters[k].tolerance ** 2 for k in i])
    C = L @ L.T
    weighted = np.linalg.inv(C if pair_errors == "shared" else np.diag(np.diag(C))) @ J
    K = np.linalg.inv(J.T @ weighted + P)
    return K @ (weighted.T @ C @ weighted + P) @ K


@pytest.mark.parametrize(("strategy", "pair_errors"), [("star", "shared"), ("all", "shared"), ("star", "independent")])
def test_the_bound_is_that_of_a_dense_computation(strategy, pair_errors):
    """The tool is estimated too, and is not along the last link: its columns are not its parameters."""
    robot = small_arm(tolerance=dict.fromkeys(("a", "alpha", "d", "theta", *TOOL), 3e-3), estimate=TOOL)
    robot = robot.with_values([*robot.nominal[:-6], 0.1, 0.0, 0.2, 0.3, -0.4, 0.5])
    readings = spread_readings(4, 4)  # six distances: as many as four points have, so that the dense C has an inverse
    options = {"pairing": Pairing(strategy), "pair_errors": pair_errors}
    bound = cramer_rao(robot, at(robot, readings, sigma_joint=1e-4), model="distance", **options)
    n = len(readings)
    pairs = [(a, b) for a in range(n) for b in range(a + 1, n) if strategy == "all" or a == 0]
    expected = dense_bound(robot, readings, 1e-4, pairs, pair_errors)
    # 1e-3 of a formed pair's variance counts as its own, which moves variances by as much.
    assert bound.covariance == pytest.approx(expected, rel=3e-3, abs=3e-3 * (3e-3) ** 2)


@pytest.mark.parametrize("model", ["pose", "position", "distance"])
def test_where_no_noise_is_stated_a_millimetre_and_a_milliradian_are_assumed(model):
    robot = small_arm(tolerance=dict.fromkeys(("a", "alpha", "d", "theta"), 3e-3))
    readings = spread_readings(30, 4)
    stated = measure(robot, 30, np.random.default_rng(0), sigma=(1e-3, 1e-3), readings=readings)
    bounds = [cramer_rao(robot, m, model=model) for m in (Measurements.from_arrays(readings), stated)]
    assert bounds[0].covariance == pytest.approx(bounds[1].covariance, rel=rounding(1, 10), abs=0)


def test_after_the_best_rigid_fit_the_bound_is_what_real_errors_are():
    robot = small_arm(tolerance=dict.fromkeys(("a", "alpha", "d", "theta"), 1e-4))
    readings = spread_readings(40, 4)
    names = tuple(p.name for p in robot.parameters if p.estimated)
    error = 1e-5 * np.random.default_rng(3).normal(size=len(names))
    values = robot.nominal
    values[[robot.index(name) for name in names]] += error
    real = real_errors(robot.with_values(values), robot, readings)
    bound = Bound(robot, names, np.outer(error, error), np.outer(error, error), len(names))
    # Errors of 1e-5: what is not linear is of that size.
    assert bound.position(readings) == pytest.approx(real.base_frame.rms, rel=1e-4)
    assert bound.position(readings, fitted=True) == pytest.approx(real.best_rigid_fit.rms, rel=1e-4)
    assert real.best_rigid_fit.rms < 0.95 * real.base_frame.rms
