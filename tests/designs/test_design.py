"""What a design expects is what a calibration of its poses reports; what it chooses is what is asked for."""

from dataclasses import replace

import numpy as np
import pytest
from scenarios import INSTRUMENTS, SIGMA, WALL, scenario

from fg_calib import Pairing
from fg_calib.designs.design import design
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.inputs import InputError, Options
from fg_calib.job import Job
from fg_calib.measurements.dataset import Noise
from fg_calib.prediction.tool_pose import errors_at
from fg_calib.simulation.scenario import (
    Errors,
    GivenReadings,
    Instrument,
    RandomReadings,
    Spot,
)
from fg_calib.simulation.simulator import simulate
from fg_calib.statistics.covariance import spread_of

NOISE = replace(SIGMA, joint=2e-4)
STAR = Instrument(model="distance-rotation", name="it")
EXPECTED = {name: INSTRUMENTS[name] for name in
            ("pose", "targets", "anchors", "offset", "contact", "planes", "board", "sockets")} | {
    "formed star": STAR,
    "all formed pairs": replace(STAR, pairing=Pairing("all")),
    "pixels": INSTRUMENTS["pixels"],
}  # fmt: skip

SAME = 1e-6
"""Share by which expected errors may differ: so near is an estimate from exact values to the nominal arm."""


def error_of(robot, tables, task):
    """Expected errors at a task, by a calibration of the exact tables of the nominal arm."""
    solution = solve(build_problem(robot, list(tables), Options(tables[0].model, gauge="prior")))
    base, fitted = errors_at(spread_of(solution), task.readings)
    return fitted if task.fitted else base


def planned(instrument, n=12, n_candidates=40, **options):
    of = scenario(instrument, n=20, noise=NOISE)
    return design(of, n=n, n_candidates=n_candidates, **options)


# --- what is expected -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", EXPECTED)
def test_expected_errors_are_those_of_a_calibration_of_the_poses(kind):
    few = {"n": 6, "n_candidates": 80} if kind == "pixels" else {}  # few of them see the board
    plan = planned(EXPECTED[kind], **few, fitted=True)
    expected = error_of(plan.pool.robot, plan.tables, plan.task)
    assert plan.expected.position == pytest.approx(expected.position, rel=SAME)
    assert plan.expected.orientation == pytest.approx(expected.orientation, rel=SAME)
    assert plan.curve[-1].n == plan.n
    assert plan.curve[-1].designed == pytest.approx(plan.expected.position, rel=1e-3)


# --- given, targets, what is undetermined -----------------------------------------------------------------------------


def test_given_poses_count_and_are_not_to_be_measured_again():
    of = scenario(INSTRUMENTS["pose"], n=20, noise=NOISE)
    rng = np.random.default_rng(5)
    given = rng.uniform(-1.0, 1.0, (6, 4))
    plan = design(of, n=4, n_candidates=40, given=given)
    assert (plan.n, len(plan.pool.given)) == (4, 6)
    assert plan.pool.readings[plan.pool.given].tolist() == given.tolist()
    assert not (plan.readings[:, None] == given).all(axis=2).any()
    of_given, of_all = (
        simulate(replace(of, errors=Errors("values", {}), noise=Noise(0.0, 0.0, 0.0), stated_noise=NOISE,
                         configurations=GivenReadings(q))).tables
        for q in (given, np.vstack([given, plan.readings]))
    )  # fmt: skip
    for tables, found in ((of_given, plan.before), (of_all, plan.expected)):
        assert found.position == pytest.approx(error_of(of.robot, tables, plan.task).position, rel=SAME)
    assert plan.expected.position < plan.before.position


def test_a_target_is_reached_with_as_few_as_a_scan_of_all_numbers_finds():
    of = scenario(STAR, n=20)
    errors = {n: design(of, n=n, n_candidates=40).expected.position for n in range(5, 9)}
    target = errors[7] * 1.0001
    fewest = min(n for n, error in errors.items() if error <= target)
    plan = design(of, target=target, n_candidates=40)
    assert plan.reached
    assert plan.expected.position <= target * (1.0 + 1e-5)
    assert abs(plan.n - fewest) <= 1


@pytest.mark.slow
def test_what_no_candidate_determines_is_reported():
    """Lengths between configurations do not say where the base is."""
    lengths = scenario(Instrument(model="distance", name="it"), n=20, job={"gauge": "none"})
    plan = design(lengths, n=20, n_candidates=60)
    assert plan.task.fitted
    assert "theta1" in {name for relation in plan.observability.lost for name in relation}
    in_base = design(lengths, n=20, n_candidates=60, fitted=False)
    assert in_base.expected.position is None
    assert in_base.unknown > 0.1


# --- more of a job ----------------------------------------------------------------------------------------------------


def job_of(instrument, q, **changes):
    """A job of what the nominal arm shows at some configurations."""
    silent = Noise(position=0.0, orientation=0.0, distance=0.0, angle=0.0, point=0.0, pixel=0.0)
    of = scenario(instrument, errors=Errors("values", {}), noise=silent, stated_noise=NOISE,
                  configurations=GivenReadings(q), **changes)  # fmt: skip
    tables = simulate(of).tables
    return Job(None, of.robot, tables, Options(tables[0].model))


def selected(job, rows):
    table = job.tables[0]
    return [replace(table, measurements=table.measurements.select(rows))]


MORE = {
    "pose": Instrument(model="pose", name="it", frame="unknown"),
    "a target known nearly": Instrument(model="position", name="it", frame="base",
                                     targets={"a": Spot([0.1, 0.05, 0.2], 1e-4)}),
    "an anchor known nearly": Instrument(model="anchor", name="it", anchors={"a": Spot([1.0, -2.0, 0.5], 1e-4)}),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", MORE)
def test_more_of_a_job_counts_with_what_was_measured(kind):
    """As in a calibration of all rows in one table: what the first rows say of unknowns is neither lost nor doubled."""
    q = np.random.default_rng(4).uniform(-1.5, 1.5, (40, 4))
    every = job_of(MORE[kind], q)
    old = replace(every, measurements=tuple(selected(every, np.arange(15))))
    plan = design(old, n=5, candidates=GivenReadings(q[15:]))
    same = (
        1e-4 if "nearly" in kind else SAME
    )  # the known place is off by its tolerance, and the estimated arm by a little of that
    chosen = [int(np.flatnonzero((q == one).all(axis=1))[0]) for one in plan.readings]
    assert min(chosen) >= 15
    before = error_of(every.robot, selected(every, np.arange(15)), plan.task)
    assert plan.before.position == pytest.approx(before.position, rel=same)
    expected = error_of(every.robot, selected(every, np.array([*range(15), *chosen])), plan.task)
    assert plan.expected.position == pytest.approx(expected.position, rel=same)
    assert plan.curve[-1].designed == pytest.approx(plan.expected.position, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["planes", "faces", "board", "pixels", "sockets"])
def test_more_of_every_instrument_is_planned(kind):
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.5, 1.5, (80 if kind in ("board", "pixels") else 30, 4))
    # An arm of four joints cannot look at the middle of a board: it sees what it sees.
    plan = design(job_of(INSTRUMENTS[kind], q), n=4, n_candidates=80, candidates=RandomReadings(1))
    assert plan.n == 4
    assert 0.0 < plan.expected.position <= plan.before.position


@pytest.mark.slow
def test_a_board_seen_from_below_is_seen_from_below_again():
    q = np.random.default_rng(4).uniform(-1.5, 1.5, (80, 4))
    job = job_of(Instrument(model="board", name="it", boards=WALL), q)
    m = job.tables[0].measurements
    flip = np.diag([1.0, -1.0, -1.0])
    below = replace(job, measurements=(replace(job.tables[0], measurements=replace(m, rotation=m.rotation @ flip)),))
    above, under = (design(one, n=4, candidates=RandomReadings(1), n_candidates=60) for one in (job, below))
    assert np.allclose(under.readings, above.readings)
    assert under.expected.position == pytest.approx(above.expected.position, rel=1e-5)


@pytest.mark.slow
def test_rows_of_a_job_are_chosen_among_themselves():
    q = np.random.default_rng(4).uniform(-1.5, 1.5, (30, 4))
    job = job_of(MORE["pose"], q)
    plan = design(job, n=8, candidates="rows")
    names = job.tables[0].measurements.ids.tolist()
    rows = np.array([names.index(name) for name in plan.ids.tolist()])
    assert np.abs(plan.readings - q[rows]).max() == 0.0
    assert plan.before is None
    expected = error_of(job.robot, selected(job, np.sort(rows)), plan.task)
    assert plan.expected.position == pytest.approx(expected.position, rel=SAME)


# --- pairs ------------------------------------------------------------------------------------------------------------


def test_pairs_that_are_measured_directly_are_refused_in_one_line():
    gauge = Instrument(model="distance", name="it", pairs=Pairing())
    with pytest.raises(InputError, match=r"^instruments: it: pairs that are measured directly, expected model: pose"):
        planned(gauge)
    with pytest.raises(InputError, match="pairs that are measured directly, expected tables of poses"):
        design(job_of(gauge, np.zeros((4, 4)) + 0.1 * np.arange(4)[:, None]), n=4)


@pytest.mark.slow
def test_all_pairs_that_can_be_formed_hold_the_most():
    plan = planned(STAR, n=10)
    assert set(plan.pairings) == {"star", "chain", "all"}
    assert plan.pairings["all"] == min(plan.pairings.values())
    assert plan.pairings["star"] == pytest.approx(plan.expected.position, rel=1e-9)


# --- all of it --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_curve_falls_and_designed_poses_are_better_than_random_ones():
    plan = planned(INSTRUMENTS["targets"], n=20, n_candidates=60)
    designed = np.array([p.designed for p in plan.curve])
    low, middle, high = np.array([p.random for p in plan.curve]).T
    assert (np.diff(designed) < 0.0).all()
    assert (np.diff(middle) < 0.0).all()
    assert (designed <= low).all()
    assert (low <= middle).all()
    assert (middle <= high).all()
    assert plan.curve[0].n == 4
    assert plan.random == middle[-1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n": 3, "target": 1e-3}, "target"),
        ({"n": 501}, "n"),
        ({"target": 0.0}, "target"),
        ({"n_candidates": 1}, "n_candidates"),
        ({"candidates": "rows"}, "rows of a scenario"),
        ({"criterion": "G"}, "criterion"),
        ({"task": np.zeros((0, 4))}, "task"),
        ({"given": np.zeros((3, 5))}, "given"),
    ],
)
def test_values_that_make_no_sense_are_refused(options, message):
    of = scenario(INSTRUMENTS["pose"], n=20)
    with pytest.raises(InputError, match=message):
        design(of, **{"n_candidates": 5} | options)


@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["I", "D", "E"])
def test_what_prior_sigmas_alone_determine_is_not_lost_at_tiny_noise(criterion):
    """Unknown targets leave the last joint to its priors, whatever the noise; 1 um adds 1e-6 of 1 mm, in squares."""
    expected = []
    for sigma in (1e-8, 1e-6):
        of = scenario(Instrument(model="position", name="it", targets=2), n=5, noise=Noise(position=sigma, joint=0.0))
        plan = design(of, n=12, n_candidates=30, criterion=criterion)
        assert plan.unknown == 0.0
        expected.append(plan.expected.position)
    assert expected[0] == pytest.approx(expected[1], rel=1e-4)
