"""fg_calib: `calibrate` as a user calls it, and `solve` alone."""

from __future__ import annotations

import numpy as np
import protocol

import fg_calib
from fg_calib.robot import Compliance, Mass, pose

FRAME = ("x", "y", "z", "yaw", "pitch", "roll")
JOINT = ("a", "alpha", "d", "theta", "beta")


def robot_of(work: dict) -> fg_calib.Robot:
    """The nominal arm; where frames are unknown, nothing of them: the package finds them."""
    values, estimated = work["values"], work["estimated"]
    rows, free = values[6:-6].reshape(-1, 5), estimated[6:-6].reshape(-1, 5)
    fixed = [f"{JOINT[k]}{i + 1}" for i, k in np.argwhere(~free)]
    if not work["frames_known"]:
        free_tool = [f"tool.{kind}" for kind in FRAME]
        return fg_calib.Robot.from_dh(rows, "mdh-hayati", fixed=fixed, estimate=free_tool)
    tool = dict(zip(FRAME, values[-6:], strict=True))
    return fg_calib.Robot.from_dh(rows, "mdh-hayati", fixed=fixed, tool=tool)


class Prepared(protocol.Peer):
    """Robot and measurements in memory."""

    compliance = True

    def __init__(self, work: dict) -> None:
        self.robot = robot_of(work)
        if self.compliance and len(work["masses"]):
            masses = [Mass(int(joint), mass, tuple(at)) for joint, mass, *at in work["masses"].tolist()]
            self.robot = self.robot.with_effects(Compliance(masses, range(2, self.robot.n_joints + 1)))
        q, sigma = work["q"], work["sigma"]
        if work["kind"] == "distance":
            pairs = {"a": work["a"], "b": work["b"], "distance": work["distance"], "sigma_distance": sigma[0]}
            self.data, self.model = fg_calib.Measurements.from_arrays(q, pairs=pairs), "distance"
        else:
            measured = {"position": work["position"], "rotation": work["rotation"]}
            sigmas = {"sigma_position": sigma[0], "sigma_orientation": sigma[1]}
            self.data, self.model = fg_calib.Measurements.from_arrays(q, **measured, **sigmas), "pose"
        frame = "known" if work["frames_known"] else "unknown"
        self.choices = {"model": self.model, "frame": frame, "gauge": "none"}


class Calibrate(Prepared):
    """`calibrate()`: built, solved, started from other places, judged, with all covariances."""

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
        k = [(p.estimate, p.sigma) for p in parameters if p.name.endswith("compliance")]
        return {
            "compliance": np.array(k).T,
            "states": "covariance of any prediction; sigma of each parameter, none where it is not determined",
            "covariance": there.covariance[:, :3, :3],
            "parameters": np.array([p.estimate for p in parameters]),
            "sigma": np.array([np.nan if p.sigma is None else p.sigma for p in parameters], dtype=float),
        }


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

        there, world = pose(self.arm, q), chain.frame_matrix(self.frame)
        return world[:3, 3] + there.position @ world[:3, :3].T, world[:3, :3] @ there.rotation


class Geometry(Solve):
    """Without compliance."""

    compliance = False


if __name__ == "__main__":
    protocol.main({"calibrate": Calibrate, "solve": Solve, "geometry": Geometry})
