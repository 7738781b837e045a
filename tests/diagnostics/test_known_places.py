"""Places said to be somewhere give or take a tolerance are judged as parameters are, and the wrong one named."""

import re

import gtsam
import numpy as np
import pytest
from instruments import measured_by

from fg_calib import calibrate
from fg_calib.assessment import assess
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve


@pytest.mark.slow
@pytest.mark.parametrize(("instrument", "name"), [("targets", "target t0"), ("anchors", "anchor a0")])
def test_a_place_that_is_twelve_tolerances_off_is_named_and_nothing_else(instrument, name):
    for seed in (0, 1):
        robot, _, table = measured_by(f"{instrument} nearly", np.random.default_rng(seed))
        assert not calibrate(robot, table).findings
        robot, _, table = measured_by(f"{instrument} nearly wrong", np.random.default_rng(seed))
        found = calibrate(robot, table)
        (finding,) = [text for text in found.findings if "prior sigmas" in text]
        match = re.match(rf"{name} lies (\S+) prior sigmas from where it was specified: prior", finding)
        assert 4.0 < float(match.group(1)) < 16.0  # what the arm takes up of it, and three sigma of its own
        (beyond,) = found.result.priors.beyond_tolerance
        assert beyond.parameter == name
        assert 0.0 < beyond.sigma <= 1.0


@pytest.mark.sampled(1)
@pytest.mark.parametrize("instrument", ["targets nearly", "anchors nearly"])
def test_sigmas_of_corrections_are_those_of_the_whole_graph(instrument):
    """Variance of the prior residual is 1 less that of the estimate over the tolerance squared, by a dense inverse."""
    robot, _, table = measured_by(instrument, np.random.default_rng(1), n=15)
    solution = solve(build_problem(robot, table))
    fit, variables = assess(solution).priors, solution.problem.variables
    order = gtsam.Ordering()
    for key in variables.keys:
        order.push_back(key)
    H = solution.problem.graph.linearize(solution.values).hessian(order)[0]
    places = [v for v in variables.nuisance if v.prior is not None]
    variance = np.concatenate([np.diag(np.linalg.inv(H))[v.columns] / np.square(v.prior[1]) for v in places])
    assert fit.sigma[-9:] ** 2 == pytest.approx(1.0 - variance, abs=1e-6)
    assert variance.max() > 1e-3
