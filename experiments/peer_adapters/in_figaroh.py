"""figaroh: offsets of the joints of a URDF, absolute poses; distances by a cost of one's own."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import tempfile
from pathlib import Path

import chain
import numpy as np
import protocol
from figaroh.calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm
from figaroh.tools.load_robot import load_robot

MEASURED = ("x1", "y1", "z1", "phix1", "phiy1", "phiz1")


class Weighted(BaseCalibration):
    """Its log-map residuals over the sigmas of the work."""

    sigma = (1.0, 1.0)

    def cost_function(self, var: np.ndarray) -> np.ndarray:
        """Whitened residuals."""
        there = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        residuals = self._compute_logmap_residuals(self.PEE_measured, there)
        return self.apply_measurement_weighting(residuals, 1.0 / self.sigma[0], 1.0 / self.sigma[1])


class Distances(Weighted):
    """Signed distances instead: what a user would write who has only pairs."""

    work: dict

    def cost_function(self, var: np.ndarray) -> np.ndarray:
        """Whitened residuals of pairs."""
        there = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        p = there.reshape(6, -1)[:3].T
        length = np.linalg.norm(p[self.work["b"]] - p[self.work["a"]], axis=1)
        return (length - self.work["distance"]) / self.sigma[0]


class Figaroh(protocol.Peer):
    """A subclass with a weighted cost, as its documentation asks for."""

    compliance = True

    def __init__(self, work: dict) -> None:
        logging.disable(logging.CRITICAL)
        self.folder = tempfile.TemporaryDirectory()
        folder, n = Path(self.folder.name), len(work["q"])
        values = work["values"].copy()
        if not work["frames_known"]:
            values[:6] = values[-6:] = 0.0  # it finds both frames in closed form
        (folder / "arm.urdf").write_text(chain.urdf(values, work["masses"]))
        position, rotation = work.get("position"), work.get("rotation")
        if work["kind"] == "distance":  # it wants a table of poses all the same
            position, rotation = chain.forward(values, work["q"])
        joints = [f"q{i + 1}" for i in range(work["q"].shape[1])]
        table = np.concatenate([work["q"], position, chain.roll_pitch_yaw(rotation)], axis=1)
        header = ",".join((*joints, *MEASURED))
        np.savetxt(folder / "poses.csv", table, delimiter=",", header=header, comments="", fmt="%.17g")
        (folder / "calibration.yaml").write_text(json.dumps(self.configuration(folder, joints, n, work)))
        kind = Distances if work["kind"] == "distance" else Weighted
        with contextlib.redirect_stdout(io.StringIO()):
            self.calibration = kind(load_robot(str(folder / "arm.urdf")), str(folder / "calibration.yaml"))
            for frame in ("known_baseframe", "known_tipframe"):
                self.calibration.calib_config[frame] = work["frames_known"]
            self.calibration.sigma, self.calibration.work = work["sigma"], work
            self.calibration.initialize()

    def configuration(self, folder: Path, joints: list[str], n: int, work: dict) -> dict:
        """Its settings; JSON is YAML."""
        elastic = self.compliance and len(work["masses"]) > 0
        return {
            "robot": {"name": "arm", "properties": {"joints": {"active_joints": joints}}},
            "tasks": {
                "calibration": {
                    "enabled": True,
                    "type": "kinematic_calibration",
                    "parameters": {"calibration_level": "full_params", "include_non_geometric": elastic},
                    "kinematics": {"base_frame": "universe", "tool_frame": "tool"},
                    "measurements": {"markers": [{"measurable_dof": [True] * 6}], "poses": {}},
                    "data": {"source_file": str(folder / "poses.csv"), "number_of_samples": n},
                }
            },
        }

    def solve(self) -> None:
        """With its defaults."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.found = self.calibration.solve(enable_logging=False)

    def predict(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By its forward kinematics."""
        c = self.calibration
        there = calc_updated_fkm(c.model, c.data, self.found.x, q, dict(c.calib_config, NbSample=len(q)))
        x, y, z, roll, pitch, yaw = there.reshape(6, -1)
        zero = np.zeros_like(x)
        T = [chain.frame_matrix(np.array(frame)) for frame in zip(zero, zero, zero, yaw, pitch, roll, strict=True)]
        return np.stack([x, y, z], axis=1), np.array(T)[:, :3, :3]

    def says(self, q: np.ndarray) -> dict:
        """Sigma of each parameter that it selected."""
        names, sigma = self.calibration.calib_config["param_name"], np.array(self.calibration.std_dev, dtype=float)
        places = [names.index(name) for name in (f"k_RZ_q{i}" for i in range(2, 7)) if name in names]
        return {
            # its torque is what holds the arm, not what gravity does
            "compliance": np.stack([-np.array(self.found.x)[places], sigma[places]]),
            "states": "sigma of each parameter that it selected",
            "parameters": np.array(self.found.x),
            "sigma": sigma,
        }


class Geometry(Figaroh):
    """Without elasticity."""

    compliance = False


if __name__ == "__main__":
    protocol.main({"figaroh": Figaroh, "geometry": Geometry})
