"""robotkinecal: products of exponentials from a URDF, absolute poses."""

from __future__ import annotations

import tempfile
from pathlib import Path

import chain
import numpy as np
import protocol
import roboticstoolbox
from robotkinecal import SerialRobotKineCal
from spatialmath import SE3, Twist3


class Robotkinecal(protocol.Peer):
    """Its one way.

    Axes and the zero pose are free, so frames that are not known need no unknowns of their own. Poses are brought to
    where the base is at the start, as it wants them in the base frame: its residuals are twists about the origin.
    """

    @staticmethod
    def unable(work: dict) -> str | None:
        """It has no residual between two configurations."""
        return "absolute poses alone" if work["kind"] == "distance" else None

    def __init__(self, work: dict) -> None:
        np.random.seed(0)  # noqa: NPY002 - it draws the basis of its parameters from the global generator
        with tempfile.TemporaryDirectory() as folder:
            path, values = Path(folder) / "arm.urdf", work["values"].copy()
            self.base, values[:6] = chain.frame_matrix(values[:6]), 0.0
            path.write_text(chain.urdf(values))
            self.calibration = SerialRobotKineCal(roboticstoolbox.ERobot.URDF(str(path)), ee_name="tool")
        T = np.tile(np.eye(4), (len(work["q"]), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = work["rotation"], work["position"]
        self.calibration.set_observations(list(work["q"]), [SE3(t, check=False) for t in np.linalg.inv(self.base) @ T])

    def solve(self) -> None:
        """With its defaults; it takes no weights."""
        self.result = self.calibration.solve()

    def predict(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Products of exponentials of the axes found, times the zero pose."""
        axes, last = self.result.get_screw_axes(), self.result.get_zero_conf_EE_pose().A
        T = []
        for row in q:
            there = np.eye(4)
            for axis, angle in zip(axes, row, strict=True):
                there = there @ Twist3(axis).exp(angle).A
            T.append(there @ last)
        T = self.base @ np.array(T)
        return T[:, :3, 3], T[:, :3, :3]

    def says(self, q: np.ndarray) -> dict:
        """One figure a joint: the norm of four variances, lengths and angles together."""
        found = self.result.iteration_results[-1].get_statistics()["joints_uncertainty"]
        figures = np.asarray(found, dtype=float).ravel()
        return {"states": f"the norm of four variances a joint, lengths and angles in one ({len(figures)} figures)"}


if __name__ == "__main__":
    protocol.main({"robotkinecal": Robotkinecal})
