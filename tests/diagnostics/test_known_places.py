"""Places said to be somewhere give or take a tolerance are judged as parameters are, and the wrong one named."""

import re

import gtsam
import numpy as np
import pytest
from instruments import measured_by
from scipy.stats import kstest

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


@pytest.mark.long
@pytest.mark.parametrize("instrument", ["targets nearly", "anchors nearly"])
def test_corrections_of_healthy_places_are_as_large_as_they_should_be(instrument):
    """Sums of squares over their mean, and p-values, of 60 draws; none beyond its tolerance but 1 (0.7 %)."""
    fits = []
    for seed in range(60):
        robot, _, table = measured_by(instrument, np.random.default_rng(500 + seed))
        fits.append(assess(solve(build_problem(robot, table))).priors)
    assert sum(bool(fit.beyond) for fit in fits) <= 1
    assert kstest([fit.p_value for fit in fits], "uniform").pvalue > 1e-3
    sums = np.array([(fit.chi2, fit.expected) for fit in fits])
    assert sums[:, 0].sum() / sums[:, 1].sum() == pytest.approx(1.0, abs=4 * np.sqrt(2 / sums[:, 1].sum()))
    places = np.array([(fit.z[-9:] / fit.sigma[-9:]) for fit in fits])
    assert np.mean(places**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 60))  # of one draw the nine are correlated
