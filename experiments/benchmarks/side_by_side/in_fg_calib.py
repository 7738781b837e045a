"""fg_calib: what a user calls, the solve alone, scipy with its derivatives, and GTSAM with a factor a measurement."""

from __future__ import annotations

import gtsam
import numpy as np
import protocol

import fg_calib

FRAME = ("x", "y", "z", "yaw", "pitch", "roll")
JOINT = ("a", "alpha", "d", "theta", "beta")


def robot_of(work: dict) -> fg_calib.Robot:
    """The nominal arm; where frames are unknown, nothing of them: the package finds them."""
    values, estimated = work["values"], work["estimated"]
    rows, free = values[6:-6].reshape(-1, 5), estimated[6:-6].reshape(-1, 5)
    fixed = [f"{JOINT[k]}{i + 1}" for i, k in np.argwhere(~free)]
    length, angle = work["off"].tolist()
    tolerance = {kind: length if kind in "ad" else angle for kind in JOINT}
    if not work["frames_known"]:
        free_tool = [f"tool.{kind}" for kind in FRAME]
        return fg_calib.Robot.from_dh(rows, "mdh-hayati", fixed=fixed, estimate=free_tool, tolerance=tolerance)
    tool = dict(zip(FRAME, values[-6:], strict=True))
    return fg_calib.Robot.from_dh(rows, "mdh-hayati", fixed=fixed, tool=tool, tolerance=tolerance)


class Prepared(protocol.Peer):
    """Robot and measurements in memory."""

    gauge = "none"

    def __init__(self, work: dict) -> None:
        self.robot = robot_of(work)
        q, sigma = work["q"], work["sigma"]
        if work["kind"] == "distance":
            pairs = {"a": work["a"], "b": work["b"], "distance": work["distance"], "sigma_distance": sigma[0]}
            self.data, self.model = fg_calib.Measurements.from_arrays(q, pairs=pairs), "distance"
        else:
            measured = {"position": work["position"], "rotation": work["rotation"]}
            sigmas = {"sigma_position": sigma[0], "sigma_orientation": sigma[1]}
            self.data, self.model = fg_calib.Measurements.from_arrays(q, **measured, **sigmas), "pose"
        self.choices = {"model": self.model, "frame": "known" if work["frames_known"] else "unknown"}
        self.choices["gauge"] = self.gauge


class Calibrate(Prepared):
    """`calibrate()`: built, solved, looked at from elsewhere, judged, with all covariances."""

    def solve(self) -> None:
        """One call."""
        self.result = fg_calib.calibrate(self.robot, self.data, **self.choices)

    def predict(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By the result, in the measurement frame."""
        there = self.result.predict(q, world=self.choices["frame"] == "unknown")
        return there.position, there.rotation

    def says(self, q: np.ndarray) -> dict:
        """Covariance of what it predicts, and sigmas of the parameters that are determined."""
        there = self.result.predict(q, world=self.choices["frame"] == "unknown")
        parameters = [p for p in self.result.parameters.values() if p.identifiability != "fixed"]
        return {
            "states": "covariance of any prediction; sigma of each parameter, none where it is not determined",
            "covariance": there.covariance[:, :3, :3],
            "parameters": np.array([p.estimate for p in parameters]),
            "sigma": np.array([np.nan if p.sigma is None else p.sigma for p in parameters], dtype=float),
        }


class Told(Calibrate):
    """The same with how far parameters may be off as priors: its ordinary use, and more than other peers are told."""

    gauge = "prior"


class Solve(Prepared):
    """`build_problem` and `solve`, without uncertainty."""

    def solve(self) -> None:
        """Two calls."""
        problem = fg_calib.build_problem(self.robot, self.data, **self.choices)
        self.at(fg_calib.solve(problem).parameters)

    def at(self, parameters: np.ndarray) -> None:
        """Keep the estimate."""
        n = len(self.robot.parameters)
        self.arm, self.frame = self.robot.with_values(parameters[:n]), parameters[n : n + 6]

    def predict(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By the robot's values."""
        import chain

        there, world = fg_calib.pose(self.arm, q), chain.frame_matrix(self.frame)
        return world[:3, 3] + there.position @ world[:3, :3].T, world[:3, :3] @ there.rotation


class Scipy(Solve):
    """scipy's `least_squares` with the package's derivatives, whitened."""

    @staticmethod
    def unable(work: dict) -> str | None:
        """It starts frames at the identity."""
        return None if work["frames_known"] else "starts frames at the identity"

    def solve(self) -> None:
        """One call."""
        found = fg_calib.fit_least_squares(self.robot, self.data, model=self.model, method="scipy", weighted=True)
        self.at(found.parameters)


class OneByOne(Solve):
    """GTSAM's Levenberg-Marquardt on a Python factor a pair, or a pose."""

    def solve(self) -> None:
        """The graph, one factor a measurement, and its optimum."""
        problem = fg_calib.build_problem(self.robot, self.data, **self.choices)
        graph, initial = fg_calib.expand(problem)
        values = gtsam.LevenbergMarquardtOptimizer(graph, initial, fg_calib.levenberg_marquardt_params()).optimize()
        self.at(problem.variables.parameters(values))


if __name__ == "__main__":
    protocol.main({"calibrate": Calibrate, "told": Told, "solve": Solve, "scipy": Scipy, "one by one": OneByOne})
