"""Places said to be somewhere give or take a tolerance are judged as parameters are, and the wrong one named."""

import gtsam
import numpy as np
import pytest
from instruments import measured_by

from fg_calib.assessment import assess
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve


@pytest.mark.sampled(1)
@pytest.mark.parametrize("instrument", ["targets nearly", "anchors nearly"])
def test_sigmas_of_corrections_are_those_of_the_whole_graph(instrument):
    """Variance of the prior residual is 1 less that of the estimate over the tolerance squared, by a dense inverse."""
    robot, _, table = measured_by(instrument, np.random.default_rng(1), n=15)
    solution = solve(build_problem(robot, table))
    fit, variables = assess(solution).fit.priors, solution.problem.variables
    order = gtsam.Ordering()
    for key in variables.keys:
        order.push_back(key)
    H = solution.problem.graph.linearize(solution.values).hessian(order)[0]
    places = [v for v in variables.nuisance if v.prior is not None]
    variance = np.concatenate([np.diag(np.linalg.inv(H))[v.columns] / np.square(v.prior[1]) for v in places])
    assert fit.sigma[-9:] ** 2 == pytest.approx(1.0 - variance, abs=1e-6)
    assert variance.max() > 1e-3
