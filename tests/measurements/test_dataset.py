"""Pairs formed from poses: which, and with what sigma."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import measure, small_arm

from fg_calib.inputs import InputError, Pairing
from fg_calib.measurements import Table, find_copies, form_pairs, no_pairs


@pytest.fixture
def measurements():
    rng = np.random.default_rng(0)
    return measure(small_arm(), 6, rng, n_test=4)


STRATEGIES = {
    "star": lambda first, last: [(first, i) for i in range(first + 1, last)],
    "chain": lambda first, last: [(i, i + 1) for i in range(first, last - 1)],
    "all": lambda first, last: [(i, j) for i in range(first, last) for j in range(i + 1, last)],
}


@pytest.mark.parametrize("name", STRATEGIES)
def test_strategies_pair_within_train_and_within_test(measurements, name):
    pairs = form_pairs(measurements, Pairing(name))
    formed = list(zip(pairs.a.tolist(), pairs.b.tolist(), pairs.test.tolist(), strict=True))
    train, test = STRATEGIES[name](0, 6), STRATEGIES[name](6, 10)
    assert formed == [(a, b, False) for a, b in train] + [(a, b, True) for a, b in test]


def test_distance_and_angle_are_those_of_the_measured_poses(measurements):
    pairs = form_pairs(measurements, Pairing("all"))
    for a, b, distance, angle in zip(pairs.a, pairs.b, pairs.distance, pairs.angle, strict=True):
        assert distance == pytest.approx(np.linalg.norm(measurements.position[b] - measurements.position[a]))
        turn = Rotation.from_matrix(measurements.rotation[a].T @ measurements.rotation[b])
        assert angle == pytest.approx(turn.magnitude())


@pytest.mark.parametrize(("n", "count"), [(50, 40), (50, 600), (51, 500), (50, 1224), (50, 5000), (3, 2)])
def test_random_pairs_differ_and_use_every_configuration_about_equally(n, count):
    pairs = form_pairs(measure(small_arm(), n, np.random.default_rng(1)), Pairing("random", count, seed=3))
    assert pairs.n_pairs == min(count, n * (n - 1) // 2)
    assert np.all(pairs.a < pairs.b)
    assert len({*zip(pairs.a.tolist(), pairs.b.tolist(), strict=True)}) == pairs.n_pairs
    uses = np.bincount(np.concatenate([pairs.a, pairs.b]), minlength=n)
    assert uses.max() - uses.min() <= 2  # the last round may be cut, and an odd row sits out


def test_random_pairs_repeat_with_their_seed_and_change_with_it(measurements):
    first, again, other = (form_pairs(measurements, Pairing("random", 4, seed=s)) for s in (1, 1, 2))
    assert np.array_equal(first.b, again.b)
    assert not (np.array_equal(first.a, other.a) and np.array_equal(first.b, other.b))


def test_sigmas_of_formed_pairs_are_what_monte_carlo_finds():
    rng = np.random.default_rng(4)
    measured = measure(small_arm(), 2, rng, sigma=(0.0, 0.0))
    sigma_p, sigma_o = np.array([[1e-3, 3e-3, 2e-3], [4e-3, 1e-3, 1e-3]]), np.array([[3e-4, 1e-4, 2e-4]] * 2)
    stated = replace(measured, sigma_position=sigma_p, sigma_orientation=sigma_o)
    pairs = form_pairs(stated, Pairing("star"))
    n = 20_000
    p = measured.position[:, None] + sigma_p[:, None] * rng.normal(size=(2, n, 3))
    noise = [Rotation.from_rotvec(s * rng.normal(size=(n, 3))) for s in sigma_o]
    R = [Rotation.from_matrix(measured.rotation[i].copy()) * noise[i] for i in range(2)]
    # standard error of a standard deviation from n draws: 1 / sqrt(2 n) = 0.5 %; bound at 4 of them
    assert np.std(np.linalg.norm(p[1] - p[0], axis=1)) == pytest.approx(pairs.sigma_distance[0], rel=0.02)
    assert np.std((R[0].inv() * R[1]).magnitude()) == pytest.approx(pairs.sigma_angle[0], rel=0.02)


def test_pairs_need_measured_poses(measurements):
    bare = replace(measurements, position=None, rotation=None, source="poses.csv")
    with pytest.raises(InputError, match="neither positions nor orientations, expected measured"):
        form_pairs(bare, Pairing())


def test_a_table_without_pairs_has_no_copies(measurements):
    assert find_copies(Table(replace(measurements, pairs=no_pairs("pairs.csv")), "distance")) == (0, "", 0)
