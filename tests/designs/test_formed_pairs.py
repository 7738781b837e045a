"""What pairs formed from poses hold, against the poses with frames of their own."""

import numpy as np
import pytest
from simulated import small_arm

from fg_calib import Measurements, Pairing
from fg_calib.graph.build import true_problem
from fg_calib.graph.noise_models import PRIVATE_SHARE
from fg_calib.graph.problem import square_root
from fg_calib.inputs import Options
from fg_calib.measurements.table import Table
from fg_calib.robot.kinematics import forward, pose

ARM = small_arm()
SP, SO = 1e-4, 2e-4


def skew(v):
    return np.cross(np.eye(3), v)


def without(rows, nuisances):
    """The information of rows, shape (n, 3, n_parameters), with nuisances, shape (n, 3, m), eliminated."""
    J, N = (np.vstack(part) for part in (rows, nuisances))
    Q = np.linalg.qr(N)[0]
    left = J - Q @ (Q.T @ J)
    return left.T @ left


@pytest.mark.parametrize("model", ["distance", "rotation", "distance-rotation"])
def test_all_pairs_hold_what_poses_do_but_for_six_unknowns(model):
    """Positions but for one motion; orientations but for a rotation on the left and one on the right, of their own.

    With these unknowns as columns written out here, in the base frame: a turn u of the frame moves p by u x p and turns
    the tool by u, a turn v of the tool in its own frame turns it by R v.
    """
    n = 9
    q = np.random.default_rng(2).uniform(-2.0, 2.0, (n, 4))
    at = pose(ARM, q)
    data = Measurements.from_arrays(
        q, position=at.position, rotation=at.rotation, sigma_position=SP, sigma_orientation=SO
    )
    problem = true_problem(ARM, [Table(data, model, pairing=Pairing("all"))], Options(model, gauge="none"))
    pairs = square_root(problem, problem.start)[:, :-1]
    moved = forward(problem.variables.chains[0].at(problem.start), ARM.trig(q)).jacobian
    one, expected = np.tile(np.eye(3), (n, 1, 1)), np.zeros((pairs.shape[1],) * 2)
    if model != "rotation":
        turned = np.array([-skew(p) for p in at.position])
        expected += without(moved[:, 3:] / SP, np.concatenate([turned, one], axis=2))
    if model != "distance":
        expected += without(moved[:, :3] / SO, np.concatenate([one, at.rotation], axis=2))
    scale = np.sqrt(np.outer(*2 * [np.maximum(np.diag(expected), 1.0)]))
    away = np.abs(pairs.T @ pairs - expected) / scale
    assert (
        away.max() < 3.0 * PRIVATE_SHARE
    )  # of two ends' variance that a pair has for itself, so that it can be whitened
