"""Gauss-Newton and scipy's `least_squares` on the vectorised chain of `chain.py`: what one writes by hand."""

from __future__ import annotations

import chain
import numpy as np
import protocol

SMALL = 1e-3
"""Length of a step in sigmas of what was measured that is small enough."""

UNDETERMINED = 1e-4
"""Singular values below this part of the largest are not stepped along: an arm whose axes are nearly parallel has some
that are 1e-7, and else none below 0.01."""


class ByHand(protocol.Peer):
    """The values of the chain that are estimated, from the nominal ones."""

    def __init__(self, work: dict) -> None:
        self.work, self.values, self.wanted = work, work["values"].copy(), work["estimated"]

    def predict(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By the chain."""
        return chain.forward(self.values, q)


class GaussNewton(ByHand):
    """Minimum-norm steps by a singular value decomposition until one changes no residual any more."""

    def solve(self) -> None:
        """At most 30 steps."""
        for _ in range(30):
            r, J = self.linear()
            U, s, Vt = np.linalg.svd(J, full_matrices=False)
            kept = s > UNDETERMINED * s[0]
            along = -U[:, kept].T @ r
            self.root = Vt[kept].T / s[kept]  # its product with its transpose is the covariance
            self.move(self.root @ along)
            if np.linalg.norm(along) < SMALL:
                return
        raise RuntimeError("no convergence in 30 steps")

    def linear(self) -> tuple[np.ndarray, ...]:
        """Residuals and their derivatives."""
        return chain.residuals(self.values, self.work, self.wanted)

    def move(self, step: np.ndarray) -> None:
        """By a step of the values."""
        self.values[self.wanted] += step

    def says(self, q: np.ndarray) -> dict:
        """The covariance of minimum-norm least squares, a line by hand."""
        shift = chain.forward(self.values, q, self.wanted)[2] @ self.root
        return {
            "states": "by hand: pinv(J^T J)",
            "covariance": shift @ np.swapaxes(shift, 1, 2),
            "parameters": self.values[self.wanted],
            "sigma": np.linalg.norm(self.root, axis=1),
        }


class Compliant(GaussNewton):
    """With joints 2 to 6 that turn by k times the torque of gravity."""

    def __init__(self, work: dict) -> None:
        super().__init__(work)
        self.k = np.zeros(work["q"].shape[1])
        self.columns = np.flatnonzero([joint > 0 for _, _, joint in chain.elements(len(self.k))])

    def turned(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where joints turn to, and the torques there."""
        torques = np.zeros(q.shape)
        for _ in range(2):
            torques = chain.gravity_torques(self.values, q + self.k * torques, self.work["masses"])
        return q + self.k * torques, torques

    def linear(self) -> tuple[np.ndarray, ...]:
        """Columns of k are those of theta times the torque."""
        q, torques = self.turned(self.work["q"])
        r, J = chain.residuals(self.values, self.work | {"q": q}, self.wanted)
        rows = np.tile(np.repeat(torques[:, 1:], 3, axis=0), (2, 1))
        return r, np.hstack([J, J[:, np.searchsorted(np.flatnonzero(self.wanted), self.columns)] * rows])

    def move(self, step: np.ndarray) -> None:
        """By a step of the values and of k."""
        super().move(step[: 1 - len(self.k)])
        self.k[1:] += step[1 - len(self.k) :]

    def predict(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By the chain."""
        return chain.forward(self.values, self.turned(q)[0])

    def says(self, q: np.ndarray) -> dict:
        """Sigma of k."""
        sigma = np.linalg.norm(self.root[1 - len(self.k) :], axis=1)
        return {"states": "by hand: pinv(J^T J)", "compliance": np.stack([self.k[1:], sigma])}


class FiniteDifferences(ByHand):
    """scipy's `least_squares`, method lm, without derivatives."""

    def solve(self) -> None:
        """With its defaults."""
        from scipy.optimize import least_squares

        self.values[self.wanted] = least_squares(self.residuals, self.values[self.wanted], method="lm").x

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Of the estimated values."""
        self.values[self.wanted] = x
        return chain.residuals(self.values, self.work)[0]


if __name__ == "__main__":
    protocol.main({"gauss-newton": GaussNewton, "compliant": Compliant, "scipy": FiniteDifferences})
