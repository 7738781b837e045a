"""What a design expects is what a calibration of its poses reports; what it chooses is what is asked for."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refusal
from scenarios import INSTRUMENTS, SIGMA, TOLERANCE, scenario
from simulated import small_arm
from sparing import as_case

from fg_calib import Job, Options, Pairing, build_problem, calibrate_job, simulate, solve
from fg_calib.designs.design import design
from fg_calib.designs.from_job import scenario_of, solve_for_design
from fg_calib.designs.information import Posterior
from fg_calib.graph import square_root
from fg_calib.io import Units
from fg_calib.measurements import Noise
from fg_calib.prediction import errors_at
from fg_calib.report.design import build_design_report
from fg_calib.report.tables import plain_text
from fg_calib.simulation import job_text
from fg_calib.simulation.obstacles import enters
from fg_calib.simulation.scenario import Box, Errors, GivenReadings, Instrument, Plane, RandomReadings, Spot
from fg_calib.statistics import spread_of

NOISE = replace(SIGMA, joint=2e-4)
SILENT = Noise(0.0, 0.0, 0.0, distance=0.0, angle=0.0, point=0.0, pixel=0.0)
GIVEN = np.random.default_rng(8).uniform(-1.0, 1.0, (5, 4))
STAR = Instrument(model="distance-rotation", name="it")
EXPECTED = {name: INSTRUMENTS[name] for name in
            ("pose", "targets", "anchors", "offset", "contact", "planes", "board", "sockets")} | {
    "formed star": STAR,
    "all formed pairs": replace(STAR, pairing=Pairing("all")),
    "pixels": INSTRUMENTS["pixels"],
}  # fmt: skip

Q = np.random.default_rng(4).uniform(-1.5, 1.5, (80, 4))
"""Configurations of jobs that are designed further."""

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


@pytest.mark.parametrize(("targets", "words"), [(3, "most of it is the tool: were it known, 2."), (None, "")])
def test_a_tool_that_no_pose_determines_is_named_with_the_error_were_it_known(targets, words):
    instrument, of_tool = Instrument(model="position", name="it", targets=targets), ["tool.x", "tool.y", "tool.z"]
    robot, without = small_arm(tolerance=TOLERANCE, estimate=of_tool), small_arm(tolerance=TOLERANCE)
    plan = design(scenario(instrument, n=20, noise=NOISE, robot=robot), n=12, n_candidates=40, fitted=True)
    known = error_of(without, plan.tables, plan.task)
    assert plan.known_tool.position == pytest.approx(known.position, rel=1e-4)
    said = plain_text(build_design_report(plan), 1000)
    assert words in said
    assert ("most of it is the tool" in said) == bool(words)


def test_given_poses_count_and_are_not_to_be_measured_again():
    of = scenario(INSTRUMENTS["pose"], n=20, noise=NOISE)
    plan = design(of, n=4, n_candidates=40, given=GIVEN)
    assert (plan.n, len(plan.pool.given)) == (4, 5)
    assert not (plan.readings[:, None] == GIVEN).all(axis=2).any()
    for q, found in ((GIVEN, plan.before), (np.vstack([GIVEN, plan.readings]), plan.expected)):
        tables = job_of(INSTRUMENTS["pose"], GivenReadings(q)).tables
        assert found.position == pytest.approx(error_of(of.robot, tables, plan.task).position, rel=SAME)
    assert plan.expected.position < plan.before.position


def test_a_target_is_reached():
    few, reached = (planned(STAR, n=n, n_candidates=20).expected.position for n in (5, 6))
    plan = design(scenario(STAR, n=20, noise=NOISE), target=1.0001 * reached, n_candidates=20)
    assert plan.reached
    assert plan.expected.position <= 1.001 * reached < few
    assert plan.n in (5, 6, 7)


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


def job_of(instrument, configurations, stated=NOISE, **changes):
    """A job of what the nominal arm shows at some configurations."""
    given = {"configurations": configurations, "errors": Errors("values", {}), "noise": SILENT}
    of = scenario(instrument, specified_noise=stated, **given | changes)
    tables = simulate(of).tables
    return Job(None, of.robot, tables, Options(tables[0].model))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["pixels", "planes", "faces", "board", "sockets"])
def test_more_of_every_instrument_is_planned(kind):
    job = job_of(INSTRUMENTS[kind], GivenReadings(Q[: 80 if kind in ("board", "pixels") else 30]))
    # An arm of four joints cannot look at the middle of a board: it sees what it sees.
    plan = design(job, n=4, n_candidates=80, candidates=RandomReadings(1))
    assert plan.n == 4
    assert 0.0 < plan.expected.position <= plan.before.position


def test_a_camera_is_to_see_the_whole_board_where_it_saw_corners_wherever_the_boards_origin_is():
    job = job_of(INSTRUMENTS["pixels"], GivenReadings(Q))
    table, m = job.tables[0], job.tables[0].measurements
    shifted = replace(m, image=m.image + np.array([0, 0, 0.1, 0.2]))
    moved = replace(job, measurements=(replace(table, measurements=shifted),))
    here, there = (scenario_of(solve_for_design(one)).instruments[0].configurations for one in (job, moved))
    assert np.allclose([*there.board.position, *there.board_size], [*here.board.position, *here.board_size], atol=1e-6)
    seen = np.abs(m.image[:, :2] - [table.camera.cx, table.camera.cy]) / [table.camera.fx, table.camera.fy]
    assert np.tan(there.field_of_view) == pytest.approx(seen.max(axis=0).min())


def test_a_board_seen_from_below_is_seen_from_below_again():
    job = job_of(INSTRUMENTS["board"], GivenReadings(Q))
    m = job.tables[0].measurements
    flip = np.diag([1.0, -1.0, -1.0])
    below = replace(job, measurements=(replace(job.tables[0], measurements=replace(m, rotation=m.rotation @ flip)),))
    above, under = (design(one, n=4, candidates=RandomReadings(1), n_candidates=60) for one in (job, below))
    assert np.allclose(under.readings, above.readings)
    assert under.expected.position == pytest.approx(above.expected.position, rel=1e-5)


def test_rows_of_a_job_are_chosen_among_themselves():
    job = job_of(Instrument(model="pose", name="it", frame="unknown"), GivenReadings(Q[:30]))
    plan = design(job, n=8, candidates="rows")
    names = job.tables[0].measurements.ids.tolist()
    rows = np.array([names.index(name) for name in plan.ids.tolist()])
    assert np.abs(plan.readings - Q[rows]).max() == 0.0
    assert plan.before is None
    table = replace(job.tables[0], measurements=job.tables[0].measurements.select(np.sort(rows)))
    expected = error_of(job.robot, [table], plan.task)
    assert plan.expected.position == pytest.approx(expected.position, rel=SAME)


def test_the_tool_is_planned_beside_targets_and_boxes_stay_free():
    tracker = Instrument(model="position", name="it", targets={"t": Spot([0.1, 0, 0.1])}, tool_too=True)
    job = job_of(tracker, RandomReadings(30))
    box = np.array([[0.3, -99.0, -99.0], [99.0, 99.0, 99.0]])
    plan = design(replace(job, keep_out=(box,)), n=4, n_candidates=40)
    assert plan.tables[0].measurements.labels["target"].index.tolist() == [-1, 0] * 4  # -1: the tool
    assert not enters(job.robot, plan.readings, [Box(*box)]).any()
    assert enters(job.robot, design(job, n=4, n_candidates=40).readings, [Box(*box)]).any()


# --- plans of a job, and what a job of all rows says of itself --------------------------------------------------------


def test_given_configurations_of_a_star_count():
    """The first of them is the reference pose."""
    plan = planned(STAR, n=6, given=GIVEN)
    assert plan.expected.position < plan.before.position
    assert (plan.readings[0] == GIVEN[0]).all()
    assert not (plan.readings[1:, None] == GIVEN).all(axis=2).any()


def test_given_configurations_that_are_not_used_are_refused():
    """What touches has configurations of its own: with those of others nothing is measured."""
    of = scenario(Instrument(model="distance", name="it", sockets=3), n=20, noise=NOISE)
    assert "given" in refusal(design, of, n=6, given=GIVEN, n_candidates=40)


LENGTHS = Instrument(model="anchor", name="it", anchors={"a": Spot([1.0, -2.0, 0.5]), "b": Spot([-1.5, 1.0, 1.0])})
TOUCHES = Instrument(model="distance", name="it", sockets=5)
FACES = Instrument(model="plane", name="it", planes={"floor": Plane([0, 0, 1], -1.0), "wall": Plane([1, 0.1, 0], 2.0)})


@pytest.mark.parametrize(("instrument", "n_given", "n"), [
    (LENGTHS, 30, 5), (FACES, 30, 3), (TOUCHES, 12, 5), as_case((TOUCHES, 12, 1), is_slow=True)
])  # fmt: skip
def test_a_plan_expects_what_a_job_of_all_rows_says_of_itself(instrument, n_given, n):
    """Of distances between sockets those count that the plan asks for, and no others."""
    job = job_of(instrument, RandomReadings(n_given))
    plan = design(job, n=n, n_candidates=40)
    every = solve_for_design(replace(job, measurements=(*job.tables, *plan.tables)))
    said = Posterior(every, square_root(every, every.start)[:, :-1]).error(plan.task).position
    assert plan.expected.position == pytest.approx(said, rel=1e-6)


def test_more_rows_are_as_noisy_as_those_of_the_job_were_found_to_be():
    noise = replace(SILENT, position=3.0 * SIGMA.position, orientation=3.0 * SIGMA.orientation)
    job = job_of(Instrument(model="pose", name="it"), RandomReadings(60), stated=SIGMA, noise=noise)
    job = replace(job, options=replace(job.options, estimate_noise=True))
    found = calibrate_job(job).result.noise_factors["position"] * SIGMA.position
    plan = design(job, n=4, n_candidates=20)
    assert plan.tables[0].measurements.sigma_position == pytest.approx(np.full((4, 3), found), rel=1e-6)


def test_one_more_pose_of_a_chain_can_be_planned():
    """It makes no pair by itself, and so adds nothing."""
    chain = Instrument(model="distance", name="it", pairing=Pairing("chain"))
    plan = design(job_of(chain, RandomReadings(30)), n=1, n_candidates=10)
    assert plan.expected.position == pytest.approx(plan.before.position, rel=1e-6)


# --- pairs ------------------------------------------------------------------------------------------------------------


def test_pairs_that_are_measured_directly_are_refused_in_one_line():
    gauge = Instrument(model="distance", name="it", pairs=Pairing())
    direct = "pairs that are measured directly, expected"
    assert refusal(planned, gauge).startswith(f"instruments: it: {direct} model: pose")
    assert f"{direct} tables of poses" in refusal(design, job_of(gauge, RandomReadings(4)), n=4)


# --- all of it --------------------------------------------------------------------------------------------------------


def test_the_curve_falls_and_designed_poses_are_better_than_random_ones():
    plan = planned(INSTRUMENTS["targets"], n=20, n_candidates=60)
    designed = np.array([p.designed for p in plan.curve])
    low, middle, high = np.array([p.random for p in plan.curve]).T
    assert (np.diff(designed) < 0.0).all()
    assert (np.diff(middle) < 0.0).all()
    assert (designed <= low).all()
    assert ((low <= middle) & (middle <= high)).all()
    assert plan.curve[0].n == 4
    assert plan.random == middle[-1]


@pytest.mark.parametrize(("options", "message"), [
    ({"n": 3, "target": 1e-3}, "target"),
    ({"n": 501}, "n"),
    ({"n_candidates": 1}, "n_candidates"),
    ({"candidates": "rows"}, "rows of a scenario"),
    ({"criterion": "G"}, "criterion"),
    ({"task": np.zeros((0, 4))}, "task"),
    ({"given": np.zeros((3, 5))}, "given"),
])  # fmt: skip
def test_values_that_make_no_sense_are_refused(options, message):
    of = scenario(INSTRUMENTS["pose"], n=20)
    assert message in refusal(design, of, **{"n_candidates": 5} | options)


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


def test_noise_is_written_with_the_digits_of_a_person():
    noise = Noise(2.9999999999999995e-05, 2e-4, 9.999999999999999e-05)
    made = simulate(scenario(INSTRUMENTS["pose"], n=3, noise=noise))
    text = job_text("", {}, made.tables, made.robot, Units("mm", "rad"))
    assert "joint: [0.0001, 0.0001, 0.1, 0.0001]\n" in text
    assert "noise: {position: 0.03, orientation: 0.0002}" in text
