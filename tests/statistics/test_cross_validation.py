"""Cross-validation by configuration."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from refusals import refusal
from simulated import measure_drawn, small_arm
from touches import TOOL_POINT, corners, touch

from fg_calib import CustomMeasurements, InputError, Job, Measurements, Options, ProblemError, Table, calibrate
from fg_calib.assessment import solve_job
from fg_calib.measurements.kinds.pose import Position
from fg_calib.statistics.cross_validation import _train_tables, wide
from fg_calib.statistics.cross_validation import cross_validate as cross_validate_with

LARGE = {"a": 0.01, "d": 0.01, "alpha": 0.01, "theta": 0.01}


def cross_validate(job, *given, **more):
    return cross_validate_with(job, solve_job, *given, **more)


def poses(seed=0, n=40, n_test=0, tolerance=LARGE, **more):
    robot = small_arm(tolerance=tolerance, estimate=TOOL_POINT)
    return robot, measure_drawn(robot, n, seed, sigma=(1e-4, 1e-4), n_test=n_test, **more)


def job_of(robot, *tables, **options):
    options = Options.of(**{"model": "pose"} | options)
    how = (options.model, options.pairing, options.frame)
    return Job(None, robot, tuple(t if isinstance(t, Table) else Table(t, *how) for t in tables), options)


def test_every_configuration_is_predicted_once_by_the_others():
    """Against separate calibrations, fold by fold."""
    robot, m = poses(n_test=7)
    found = cross_validate(job_of(robot, m), 4)
    assert found.fold.shape == (40,)  # test rows take no part
    assert np.bincount(found.fold).tolist() == [10, 10, 10, 10]
    squares, arms = 0.0, []
    for k in range(4):
        held = m.select(np.arange(40))
        alone = calibrate(robot, replace(held, test=found.fold == k), model="pose")
        squares += 10 * alone.assessment.fit.residuals.rms()["test"]["position"]["after"] ** 2
        arms.append([p.estimate for p in alone.parameters.values()])
    assert found.kinds["position"].n == 40
    assert found.kinds["position"].after == pytest.approx(np.sqrt(squares / 40), rel=1e-6)  # both converged: 1e-6 sigma
    jackknife = np.sqrt(3 / 4 * np.sum((np.array(arms) - np.mean(arms, axis=0)) ** 2, axis=0))
    assert list(found.spread.values()) == pytest.approx(jackknife, rel=1e-4, abs=1e-12)
    assert found.beyond({"a2": 2e-4, "d3": None})[0] == {"a2": found.spread["a2"] / 2e-4}


@pytest.mark.slow
@pytest.mark.parametrize("instrument", ["anchors", "planes", "board"])
def test_what_few_configurations_know_of_is_spread_over_the_folds(instrument):
    robot, _, table = measured_by(instrument, np.random.default_rng(0), n=40)
    found = cross_validate(job_of(robot, table), 5)
    m = table.measurements
    for labels in m.labels.values():
        for i in range(len(labels.names)):
            mine = found.fold[labels.index == i]
            assert np.ptp(np.bincount(mine, minlength=5)) <= 2
    assert sum(held.n for held in found.kinds.values()) == 40 * len(found.kinds)
    assert all(held.after < 3.0 * held.noise for held in found.kinds.values())


def with_measured_pairs(ends, seed=0):
    robot, m = poses(seed)
    a, b = np.array(ends).T
    length = np.linalg.norm(m.position[b] - m.position[a], axis=1)
    pairs = {"a": m.ids[a], "b": m.ids[b], "distance": length, "sigma_distance": np.full(len(a), 2e-4)}
    return robot, Measurements.from_arrays(m.readings, ids=m.ids, pairs=pairs)


def test_a_measured_pair_is_held_out_once():
    chain = [(k, k + 1) for k in range(39)] + [(k, (k + 7) % 40) for k in range(33)] + [(k, k + 3) for k in range(37)]
    robot, m = with_measured_pairs(chain)
    found = cross_validate(job_of(robot, m, model="distance"), 5)
    fold = found.fold
    assert (fold >= 0).all()
    assert found.kinds["distance"].n == len(chain)  # each once, although it is fitted without neither of its ends


def test_the_hub_of_measured_pairs_is_never_held_out():
    robot, m = with_measured_pairs([(0, k) for k in range(1, 40)])
    found = cross_validate(job_of(robot, m, model="distance"), 5)
    assert found.fold[0] == -1
    assert found.kinds["distance"].n == 39
    assert found.of_pairs


@pytest.mark.parametrize("n", [1, 0, -3, 2.5, True])
def test_a_number_of_folds_that_cannot_be_is_one_line(n):
    assert "folds: found" in refusal(Options.of, folds=n)


def test_jobs_of_which_no_fold_can_be_held_out_are_refused():
    """Among them too many folds, and two poses without one of which no pair is left."""
    robot, m = poses(n=12)
    own = Table(m, "pose", own=(CustomMeasurements(Position(), data=m.position, sigma=1e-3),))
    for job, n, said in (
        (job_of(robot, m), 13, "found 13, expected at most 12"),
        (job_of(*poses(n=2), model="distance-rotation"), 2, "without fold 1 of 2: "),
        (job_of(robot, own), 5, "custom measurements"),
        (job_of(robot, replace(m, test=np.ones(12, dtype=bool))), 5, "test rows alone"),
    ):
        assert refusal(cross_validate, job, n, error=(InputError, ProblemError)).startswith(f"folds: {said}")


def test_only_what_chance_does_not_explain_is_wide():
    """With 4 degrees of freedom noise alone is 2.4 times its sigma once in 10 000."""
    assert wide({"a": 2.0, "b": 1.0}, 5) == []
    assert wide({"a": 3.0, "b": 4.0, "c": 1.0}, 5) == ["b", "a"]
    assert wide({"a": 2.0}, 30) == ["a"]


def test_an_anchor_that_few_lengths_go_to_is_never_held_out():
    robot, _, table = measured_by("anchors", np.random.default_rng(0), n=40)
    m = table.measurements
    labels = m.labels["anchor"]
    index = labels.index.copy()
    first = np.flatnonzero(index == 0)
    keep = np.sort(np.concatenate([first[:4], np.flatnonzero(index != 0)]))
    few = replace(table, measurements=m.select(keep))
    found = cross_validate(job_of(robot, few), 5)
    of_few = few.measurements.labels["anchor"].index == 0
    assert (found.fold[of_few] == -1).all()
    assert (found.fold[~of_few] >= 0).all()
    assert found.kinds["distance"].after < 3.0 * found.kinds["distance"].noise


def test_of_touches_the_train_rows_and_train_pairs_stay():
    robot, rng = small_arm(), np.random.default_rng(4)
    m = touch(robot, corners(robot, 3, rng), 4, rng, distances=[(0, 1, 1e-4), (1, 2, 1e-4)], test=(2,))
    m = replace(m, groups=replace(m.groups, pairs=replace(m.groups.pairs, test=np.array([False, True]))))
    (found,) = _train_tables([Table(m, "distance")])
    groups = found.measurements.groups
    assert groups.index.tolist() == m.groups.index[:8].tolist()
    assert (groups.pairs.a.tolist(), groups.pairs.b.tolist()) == ([0], [1])
