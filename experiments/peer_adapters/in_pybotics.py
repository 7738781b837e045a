"""pybotics: modified DH, tool and world by scipy's `least_squares`, positions or distances of pairs."""

from __future__ import annotations

import numpy as np
import protocol
from pybotics.geometry import vector_2_matrix
from pybotics.optimization import OptimizationHandler, compute_relative_errors, optimize_accuracy
from pybotics.robot import Robot
from scipy.optimize import least_squares

ALPHA_A_THETA_D = (1, 0, 3, 2)
"""Columns of a row of `chain` in its order."""


class Pybotics(protocol.Peer):
    """Its own residuals: norms of position errors, absolute errors of distances."""

    def __init__(self, work: dict) -> None:
        self.work, values = work, work["values"]
        rows = values[6:-6].reshape(-1, 5)
        robot = Robot.from_parameters(rows[:, ALPHA_A_THETA_D].ravel())
        # its frames are x y z and then Rz Ry Rx, which is yaw pitch roll
        robot.world_frame, robot.tool.vector = vector_2_matrix(values[:6]), values[-6:]
        free = not work["frames_known"]
        self.handler = OptimizationHandler(robot, True, [free] * 3 + [False] * 3, free)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Its own."""
        work = self.work
        if work["kind"] == "pose":
            return optimize_accuracy(x, self.handler, work["q"], work["position"])
        self.handler.apply_optimization_vector(x)
        a, b = work["a"], work["b"]
        return compute_relative_errors(work["q"][a], work["q"][b], work["distance"], self.handler.robot)

    def solve(self) -> None:
        """By scipy with its defaults, as its documentation does."""
        found = least_squares(self.residuals, self.handler.generate_optimization_vector())
        self.handler.apply_optimization_vector(found.x)  # it keeps the vector that was tried last

    def poses(self, q: np.ndarray) -> np.ndarray:
        """Of the tool, shape (n, 4, 4)."""
        return np.array([self.handler.robot.fk(row) for row in q])

    def predict(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By its forward kinematics."""
        T = self.poses(q)
        return T[:, :3, 3], T[:, :3, :3]


if __name__ == "__main__":
    protocol.main({"own": Pybotics})
