"""A plan knows what its job knows, expects what a job of all rows says of itself, and asks for what can be measured."""

from dataclasses import replace

import numpy as np
import pytest
from scenarios import SIGMA, scenario

from fg_calib import calibrate_job
from fg_calib.designs.design import design
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.job import Job
from fg_calib.measurements.dataset import Noise
from fg_calib.options import Options, Pairing
from fg_calib.prediction.tool_pose import errors_at
from fg_calib.simulation.scenario import (
    Errors,
    GivenReadings,
    Indicator,
    LengthGauge,
    PairGauge,
    Plane,
    Spot,
    Tracker,
)
from fg_calib.simulation.simulator import simulate
from fg_calib.statistics.covariance import spread_of

NOISE = replace(SIGMA, joint=2e-4)
SILENT = Noise(0.0, 0.0, 0.0, distance=0.0, angle=0.0, point=0.0, pixel=0.0)

SAME = 1e-6
"""Share by which expected errors may differ: an estimate from figures without noise is so near to the arm as drawn."""

LENGTHS = LengthGauge(name="it", anchors={"a": Spot([1.0, -2.0, 0.5]), "b": Spot([-1.5, 1.0, 1.0])})
FACES = Indicator(name="it", planes={"floor": Plane([0, 0, 1], -1.0), "wall": Plane([1, 0.1, 0], 2.0)})
PAIRS = PairGauge(model="distance-rotation", name="it")


def job_of(instrument, n, noise=SILENT, stated=NOISE, **options):
    """A job of what the small arm as drawn shows at random configurations."""
    q = np.random.default_rng(n).uniform(-1.5, 1.5, (n, 4))
    of = scenario(instrument, errors=Errors("values", {}), noise=noise, stated_noise=stated,
                  configurations=GivenReadings(q))  # fmt: skip
    tables = simulate(of).tables
    return Job(None, of.robot, tables, Options(tables[0].model, **options))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("instrument", "n", "options"),
    [
        pytest.param(LENGTHS, 5, {}, id="two anchors"),
        pytest.param(FACES, 3, {}, id="planes"),
        pytest.param(PAIRS, 5, {"pair_errors": "independent"}, id="pairs whose errors count as independent"),
    ],
)
def test_a_plan_expects_what_a_job_of_all_rows_says_of_itself(instrument, n, options):
    old = job_of(instrument, 30, **options)
    plan = design(old, n=n, n_candidates=40)
    every = solve(build_problem(old.robot, [*old.tables, *plan.tables], old.options))
    base, fitted = errors_at(spread_of(every), plan.task.readings)
    assert plan.expected.position == pytest.approx((fitted if plan.task.fitted else base).position, rel=SAME)


def test_more_rows_are_as_noisy_as_those_of_the_job_were_found_to_be():
    noise = replace(SILENT, position=3.0 * SIGMA.position, orientation=3.0 * SIGMA.orientation)
    job = job_of(Tracker(model="pose", name="it"), 60, noise=noise, stated=SIGMA, estimate_noise=True)
    found = calibrate_job(job).result.noise_factors["position"] * SIGMA.position
    plan = design(job, n=4, n_candidates=20)
    assert plan.tables[0].measurements.sigma_position == pytest.approx(np.full((4, 3), found), rel=SAME)


def test_one_more_pose_of_a_chain_can_be_planned():
    """It makes no pair by itself, and so adds nothing."""
    plan = design(job_of(Tracker(model="distance", name="it", pairing=Pairing("chain")), 30), n=1, n_candidates=10)
    assert plan.expected.position == pytest.approx(plan.before.position, rel=SAME)
