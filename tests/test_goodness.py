"""Goodness of fit: by kind, by row, by configuration, under repetition; and noise estimated from the residuals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest
from simulated import measure, small_arm, true_robot

from fg_calib.kinematics import pose
from fg_calib.measurements import Pairing, Pairs, rotation_angle
from fg_calib.problem import build_problem
from fg_calib.solver import solve
from fg_calib.uncertainty import assess

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}


def measured_directly(m, robot, rng, a, b, sigma=(1e-3, 5e-4), sigma_joint=0.0):
    """Pairs of the true robot measured directly, with noise; the joint errors are those of each configuration."""
    q = m.readings + sigma_joint * rng.normal(size=m.readings.shape)
    at, n = pose(robot, q), len(a)
    distance = np.linalg.norm(at.position[b] - at.position[a], axis=1) + sigma[0] * rng.normal(size=n)
    angle = rotation_angle(np.swapaxes(at.rotation[a], 1, 2) @ at.rotation[b])[0] + sigma[1] * rng.normal(size=n)
    pairs = Pairs(a, b, distance, angle, np.full(n, sigma[0]), np.full(n, sigma[1]), np.zeros(n, dtype=bool))
    return replace(m, position=None, rotation=None, pairs=pairs, sigma_joint=np.full(robot.n_joints, sigma_joint))


def case(name, robot, rng, n=16, stated=1.0):
    """A problem of a drawn true robot; noise stated is `stated` times the noise there is."""
    true = true_robot(robot, rng)
    if name.startswith("direct"):
        sigma_joint = 3e-4 if "joint" in name else 0.0
        a = np.concatenate([np.arange(n), np.arange(n)])
        b = np.concatenate([np.roll(np.arange(n), 1), np.roll(np.arange(n), 3)])
        m = measured_directly(measure(true, n, rng), true, rng, a, b, sigma_joint=sigma_joint)
        m = replace(
            m,
            pairs=replace(
                m.pairs, sigma_distance=m.pairs.sigma_distance * stated, sigma_angle=m.pairs.sigma_angle * stated
            ),
        )
        return build_problem(robot, m, model="distance-rotation")
    sigma_joint = 3e-4 if "joint" in name else 0.0
    m = measure(true, n, rng, sigma=(1e-3, 5e-4), sigma_joint=sigma_joint)
    m = replace(m, sigma_position=m.sigma_position * stated, sigma_orientation=m.sigma_orientation * stated)
    if name.startswith("pose"):
        return build_problem(robot, m, model="pose")
    pairing, *rest = name.split()
    errors = "independent" if "independent" in rest else "shared"
    return build_problem(robot, m, model="distance-rotation", pairing=Pairing(pairing), pair_errors=errors)


RUNS = {"pose": 200, "star": 200, "all": 200, "direct": 200, "direct joint": 200}
RUNS |= {"pose joint": 60, "star joint": 60, "star independent": 60}


@pytest.mark.parametrize(("name", "n_runs"), RUNS.items())
def test_p_values_are_uniform_and_the_noise_seen_is_the_noise_there_is(name, n_runs):
    """Over calibrations of an arm drawn from its tolerances, at a fixed seed.

    Kolmogorov-Smirnov at 0.1 %: by Satterthwaite's approximation a kind's p-value is uniform only nearly. The sum of
    at least 6 n_runs squares has a relative sigma of sqrt(2 / 6 / n_runs); the root half of it.
    """
    rng = np.random.default_rng(7)
    robot = small_arm(tolerance=TOLERANCE)
    by_kind, squares, overall = {}, {}, []
    for _ in range(n_runs):
        uncertainty = assess(solve(case(name, robot, rng)))
        overall.append(uncertainty.p_value)
        for fit in uncertainty.goodness.kinds:
            by_kind.setdefault(fit.kind, []).append(fit.p_value)
            squares.setdefault(fit.kind, []).append((fit.chi2, fit.expected))
    if "independent" not in name:
        assert kstest(overall, "uniform").pvalue > 1e-3
    for kind, p in by_kind.items():
        assert kstest(p, "uniform").pvalue > 1e-3
        chi2, expected = np.sum(squares[kind], axis=0)
        assert np.sqrt(chi2 / expected) == pytest.approx(1.0, abs=4 * np.sqrt(1 / 12 / n_runs))
