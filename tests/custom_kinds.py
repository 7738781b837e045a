"""A kind of measurement of a user's own: distances from the tool to fixed points of unknown place."""

import numpy as np
from simulated import LARGE, small_arm, true_robot

from fg_calib.measurements import CustomMeasurements, Kind, Measurements, Rows, Table
from fg_calib.robot.kinematics import pose

ANCHORS = np.array([[1.5, -0.8, 0.6], [-1.2, 1.4, 0.3], [0.2, 0.5, -1.8]])
SIGMA = 2e-4


class AnchorDistance(Kind):
    """`|p - anchor| - measured`."""

    names, units = ("anchor",), ("m",)
    ends, residual_dim, width, n_nuisances = 1, 1, 1, 3

    def rows(self, at, data, nuisances):
        """See `Kind.rows`."""
        step = at.position[:, 0] - nuisances
        length = np.linalg.norm(step, axis=1)
        D = np.zeros((len(step), 1, 1, 6))
        D[:, 0, 0, 3:] = u = step / length[:, None]
        return Rows(length[:, None] - data, D, -u[:, None])


def lengths_to_anchors(seed, *, n=60, sigma_joint=0.0, n_test=0):
    """An arm, the true one, and a table of lengths to three anchors in turn."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=LARGE)
    true = true_robot(robot, rng)
    q = rng.uniform(-np.pi, np.pi, (n + n_test, 4))
    which = np.arange(len(q)) % len(ANCHORS)
    lengths = np.linalg.norm(pose(true, q).position - ANCHORS[which], axis=1) + SIGMA * rng.normal(size=len(q))
    m = Measurements(
        q + sigma_joint * rng.normal(size=q.shape), np.arange(len(q)).astype(str), np.zeros(len(q), bool),
        *4 * (None,), np.full(4, sigma_joint), source="lengths",
    )  # fmt: skip
    starts = ANCHORS + 0.05 * rng.normal(size=ANCHORS.shape)
    test = np.arange(len(q)) >= n
    own = CustomMeasurements(
        AnchorDistance(), lengths, SIGMA, unknowns=starts, which=which[:, None], names=("A", "B", "C"), test=test
    )
    return robot, true, Table(m, model=None, own=(own,))
