"""Plans that do not say what a job of all rows says of itself, or that do not do what was asked."""

from dataclasses import replace

import numpy as np
import pytest
from scenarios import SIGMA, TOLERANCE, scenario
from simulated import small_arm

from fg_calib import InputError, Job, Measurements, Options, calibrate_job
from fg_calib.designs.design import design
from fg_calib.designs.from_job import solve_for_design
from fg_calib.designs.information import Posterior
from fg_calib.graph.problem import square_root
from fg_calib.inputs import Pairing
from fg_calib.measurements.dataset import Noise
from fg_calib.prediction.tool_pose import errors_at
from fg_calib.robot.kinematics import pose
from fg_calib.simulation.scenario import (
    Errors,
    Instrument,
    Plane,
    RandomReadings,
    Spot,
)
from fg_calib.simulation.simulator import simulate

NOISE = replace(SIGMA, joint=2e-4)
SILENT = Noise(0.0, 0.0, 0.0, distance=0.0, angle=0.0, point=0.0, pixel=0.0)
GIVEN = np.random.default_rng(8).uniform(-1.0, 1.0, (5, 4))


def test_given_configurations_of_a_star_count():
    """The first of them is the reference pose."""
    star = Instrument(model="distance-rotation", name="it", pairing=Pairing("star"))
    plan = design(scenario(star, n=20, noise=NOISE), n=6, given=GIVEN, n_candidates=40)
    assert plan.expected.position < plan.before.position
    assert (plan.readings[0] == GIVEN[0]).all()
    assert not (plan.readings[1:, None] == GIVEN).all(axis=2).any()


def test_given_configurations_that_are_not_used_are_refused():
    """What touches has configurations of its own: with those of others nothing is measured."""
    with pytest.raises(InputError, match="given"):
        design(
            scenario(Instrument(model="distance", name="it", sockets=3), n=20, noise=NOISE),
            n=6,
            given=GIVEN,
            n_candidates=40,
        )


def job_of(instrument, n, stated=NOISE, **changes):
    """A job of what the nominal arm shows at random configurations."""
    given = {"configurations": RandomReadings(n), "errors": Errors("values", {}), "noise": SILENT}
    of = scenario(instrument, stated_noise=stated, **given | changes)
    tables = simulate(of).tables
    return Job(None, of.robot, tables, Options(tables[0].model))


def said_by_all_rows(job, plan):
    """Expected error over the plan's task of one job of all rows."""
    every = solve_for_design(replace(job, measurements=(*job.tables, *plan.tables)))
    return Posterior(every, square_root(every, every.start)[:, :-1]).error(plan.task).position


@pytest.mark.parametrize("n", [1, 5])
def test_a_plan_of_touches_expects_what_a_job_of_all_rows_says_of_itself(n):
    """Distances between sockets that the plan asks for count, and no others."""
    job = job_of(Instrument(model="distance", name="it", sockets=5), 12)
    plan = design(job, n=n, n_candidates=40)
    assert plan.expected.position == pytest.approx(said_by_all_rows(job, plan), rel=1e-6)


def test_tolerances_of_a_plan_are_those_that_its_job_found():
    """The arm is ten times better than its tolerances say."""
    rng, arm = np.random.default_rng(1), small_arm(tolerance=TOLERANCE)
    q = rng.uniform(-1.5, 1.5, (60, 4))
    off = [0.1 * p.tolerance * rng.normal() if p.estimated else 0.0 for p in arm.parameters]
    position = pose(arm.with_values(arm.nominal + off), q).position + 1e-4 * rng.normal(size=(60, 3))
    data = Measurements.from_arrays(q, position=position, sigma_position=1e-4)
    job = Job(None, arm, data, Options("position", estimate_tolerance="kind"))
    found, plan = calibrate_job(job), design(job, n=4, n_candidates=20)
    said = errors_at(found.posterior, plan.task.readings)[plan.task.fitted].position
    assert plan.before.position == pytest.approx(said, rel=0.02)


LENGTHS = Instrument(model="anchor", name="it", anchors={"a": Spot([1.0, -2.0, 0.5]), "b": Spot([-1.5, 1.0, 1.0])})
FACES = Instrument(model="plane", name="it", planes={"floor": Plane([0, 0, 1], -1.0), "wall": Plane([1, 0.1, 0], 2.0)})


@pytest.mark.slow
@pytest.mark.parametrize(("instrument", "n"), [(LENGTHS, 5), (FACES, 3)], ids=["two anchors", "planes"])
def test_a_plan_expects_what_a_job_of_all_rows_says_of_itself(instrument, n):
    job = job_of(instrument, 30)
    plan = design(job, n=n, n_candidates=40)
    assert plan.expected.position == pytest.approx(said_by_all_rows(job, plan), rel=1e-6)


def test_more_rows_are_as_noisy_as_those_of_the_job_were_found_to_be():
    noise = replace(SILENT, position=3.0 * SIGMA.position, orientation=3.0 * SIGMA.orientation)
    job = job_of(Instrument(model="pose", name="it"), 60, stated=SIGMA, noise=noise)
    job = replace(job, options=replace(job.options, estimate_noise=True))
    found = calibrate_job(job).result.noise_factors["position"] * SIGMA.position
    plan = design(job, n=4, n_candidates=20)
    assert plan.tables[0].measurements.sigma_position == pytest.approx(np.full((4, 3), found), rel=1e-6)


def test_one_more_pose_of_a_chain_can_be_planned():
    """It makes no pair by itself, and so adds nothing."""
    chain = Instrument(model="distance", name="it", pairing=Pairing("chain"))
    plan = design(job_of(chain, 30), n=1, n_candidates=10)
    assert plan.expected.position == pytest.approx(plan.before.position, rel=1e-6)
