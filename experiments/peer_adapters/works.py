"""The works that every peer is given: what was measured, and how its answer is judged.

| work | what | judged by |
|---|---|---|
| poses | 60 poses in the base frame, noise 0.1 mm and 0.1 mrad | mean norm, 200 configurations without noise |
| pairs | 300 of the 1770 distances between these 60, noise 0.1 mm | RMS over all pairs of the 200 |
| many | 5000 poses | as poses |
| compliance | as poses, of an arm whose joints 2 to 6 give way to gravity | as poses |
| real | 1046 poses of a real UR10, frame and tool unknown | RMS, 449 poses never fitted |

The simulated arm is a UR10 in modified DH, its a, alpha, d and theta off by 1 mm and 2 mrad (1 sigma), with a tool at
(50, 30, 100) mm that is known. Where joints give way, links weigh what the maker says and 5 kg are at the tool, which
peers are told; a joint turns by k times the torque of gravity about it, in the pose where all have turned. The real arm
has Hayati's angles too, as parallel axes need them. No peer is told how far parameters may be off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import chain
import numpy as np
import protocol
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

UR10 = [(0, 0, 0.1273), (90, 0, 0), (0, -0.612, 0), (0, -0.5723, 0.163941), (90, 0, 0.1157), (-90, 0, 0.0922)]
"""alpha [deg], a, d [m] of each joint, modified DH: the maker's figures."""

TOOL = (0.05, 0.03, 0.1)
OFF = (1e-3, 2e-3)
"""1 sigma of true minus nominal, [m] and [rad]."""

SIGMA = (1e-4, 1e-4)
SIGMA_REAL = (3e-4, 6e-4)
"""1 sigma an axis, [m] and [rad]; of the real arm what a geometric model leaves (see `real_data.py`)."""

MASSES = np.array([
    (1, 7.778, 0.021, -0.027, 0.0), (2, 12.93, -0.232, 0.0, 0.158), (3, 3.87, -0.3323, 0.0, 0.068),
    (4, 1.96, 0.0, -0.018, 0.007), (5, 1.96, 0.0, 0.018, -0.007), (6, 1.202, 0.0, 0.0, -0.026), (6, 5.0, *TOOL),
])  # fmt: skip
"""Joint that moves it, [kg], and place in that joint's frame, [m]."""

COMPLIANCE = np.array([0.0, 1e-5, 1e-5, 3e-5, 5e-5, 5e-5])
"""Of each joint, [rad/(N m)]; without a model of it 0.86 mm are left."""

N_VALIDATION = 200
N_PAIRS = 300


@dataclass(frozen=True)
class Work:
    """A work file's content with the truth that peers are not given.

    Attributes:
        kind: `pose` or `distance`.
        frames_known: Whether the measurement frame is the base, and the tool known.
        arrays: See `protocol.write_work`.
        position: True or measured positions at the validation configurations, shape (n_draws, n, 3), [m].
        rotation: The same of rotations, shape (n_draws, n, 3, 3).
    """

    kind: str
    frames_known: bool
    arrays: dict[str, Floats]
    position: Floats
    rotation: Floats

    @property
    def n_draws(self) -> int:
        """Number of draws."""
        return len(self.arrays["q"])

    def write(self, path: Path) -> None:
        """Write what peers are given."""
        protocol.write_work(path, self.kind, self.frames_known, **self.arrays)


def nominal() -> Floats:
    """Values of the nominal arm's transforms (see `chain`), shape (42,), [m] and [rad]."""
    rows = [(a, np.deg2rad(alpha), d, 0.0, 0.0) for alpha, a, d in UR10]
    return np.concatenate([np.zeros(6), np.ravel(rows), TOOL, np.zeros(3)])


def of_joints(kinds: str) -> NDArray[np.bool_]:
    """Which values are of the joints and of these kinds, of a (a) l (alpha) d t (theta) b (beta), shape (42,)."""
    return np.array([False] * 6 + [kind in kinds for _ in UR10 for kind in "aldtb"] + [False] * 6)


def turned_by_gravity(values: Floats, q: Floats) -> Floats:
    """Where joints of `COMPLIANCE` turn to, shape (n, n_joints), [rad]."""
    turned = q
    for _ in range(6):  # each step leaves less than 1e-2 of the error
        turned = q + COMPLIANCE * chain.gravity_torques(values, turned, MASSES)
    return turned


def simulated(n: int, draws: int, seed: int, pairs: bool = False, compliance: bool = False) -> Work:
    """Draws of an arm measured at `n` configurations."""
    values, estimated = nominal(), of_joints("aldt")
    sigma = np.where([turns for turns, _, _ in chain.elements(len(UR10))], OFF[1], OFF[0])
    validation = np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi, (N_VALIDATION, len(UR10)))
    rows: dict[str, list[Any]] = {}
    for draw in range(draws):
        rng, noise = (np.random.default_rng([seed, 2, draw]), np.random.default_rng([seed, 3, draw]))
        true = values + estimated * sigma * rng.normal(size=values.shape)
        q = rng.uniform(-np.pi, np.pi, (n, len(UR10)))
        at, at_validation = (turned_by_gravity(true, x) if compliance else x for x in (q, validation))
        p, R = chain.forward(true, at)
        row = dict(zip(("true_position", "true_rotation"), chain.forward(true, at_validation), strict=True))
        if pairs:
            every = np.transpose(np.triu_indices(n, 1))
            a, b = every[rng.permutation(len(every))[:N_PAIRS]].T
            length = np.linalg.norm(p[b] - p[a], axis=1)
            row |= {"a": a, "b": b, "distance": length + SIGMA[0] * noise.normal(size=len(a))}
        else:
            turned = Rotation.from_rotvec(SIGMA[1] * noise.normal(size=(n, 3))).as_matrix()
            row |= {"position": p + SIGMA[0] * noise.normal(size=p.shape), "rotation": R @ turned}
        for name, value in (row | {"q": q}).items():
            rows.setdefault(name, []).append(value)
    arrays = {name: np.array(value) for name, value in rows.items()}
    truth = arrays.pop("true_position"), arrays.pop("true_rotation")
    arrays |= {"q_val": validation, "values": values, "estimated": estimated, "sigma": np.array(SIGMA)}
    arrays["masses"] = MASSES if compliance else MASSES[:0]
    return Work("distance" if pairs else "pose", True, arrays, *truth)


def real(folder: Path, repeats: int) -> Work:
    """The train rows of series B, as often as it is to be timed, and its test rows to judge on.

    Frame and tool start where they fit the train rows best with the arm at nominal: peers that cannot find them
    are given that.
    """
    table = np.genfromtxt(folder / "series_b.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    test = table["split"] == "test"
    q = np.stack([table[f"q{i + 1}"] for i in range(len(UR10))], axis=1)
    p = np.stack([table[k] for k in "xyz"], axis=1)
    R = Rotation.from_quat(np.stack([table[f"q{k}"] for k in "xyzw"], axis=1)).as_matrix()
    train = {"q": q[~test], "position": p[~test], "rotation": R[~test]}
    sigma, joints = np.array(SIGMA_REAL), of_joints("aldtb")
    start = start_of_frames(nominal(), ~joints, train | {"sigma": sigma, "kind": "pose"})
    arrays = {name: np.repeat(value[None], repeats, axis=0) for name, value in train.items()}
    arrays |= {"q_val": q[test], "values": start, "estimated": np.ones_like(joints), "sigma": sigma}
    arrays["masses"] = MASSES[:0]
    there = (np.repeat(x[None, test], repeats, axis=0) for x in (p, R))
    return Work("pose", False, arrays, *there)


def start_of_frames(values: Floats, frames: NDArray[np.bool_], work: dict[str, Any]) -> Floats:
    """Base and tool that fit best with the arm as it is.

    Turns first: with Y the measured and A the predicted rotations of the flange, Y_i = X A_i Z is linear in X^T and Z
    (9 numbers each, up to a common factor); places are linear then; some Gauss-Newton steps finish.
    """
    values = values.copy()
    values[frames] = 0.0
    p, A = chain.forward(values, work["q"])
    Y = work["rotation"]
    eye = np.eye(3)
    # X^T Y_i - A_i Z = 0, rows flattened: (I kron Y_i^T) vec(X^T) - (A_i kron I) vec(Z)
    M = np.concatenate([np.hstack([np.kron(eye, y.T), -np.kron(a, eye)]) for y, a in zip(Y, A, strict=True)])
    null = np.linalg.svd(M.T @ M)[2][-1]
    X, Z = null[:9].reshape(3, 3).T, null[9:].reshape(3, 3)
    X, Z = (_nearest_rotation(np.sign(np.linalg.det(K)) * K) for K in (X, Z))
    # position = x + X (p_i + A_i z)
    n = len(p)
    design = np.concatenate([np.tile(eye, (n, 1)), (X @ A).reshape(-1, 3)], axis=1)
    x, z = np.split(np.linalg.lstsq(design, (work["position"] - p @ X.T).ravel(), rcond=None)[0], 2)
    for place, shift, turn in ((slice(0, 6), x, X), (slice(-6, None), z, Z)):
        values[place] = np.concatenate([shift, chain.roll_pitch_yaw(turn[None])[0][::-1]])
    for _ in range(5):
        r, J = chain.residuals(values, work, frames)
        values[frames] -= np.linalg.lstsq(J, r, rcond=1e-12)[0]
    return values


def _nearest_rotation(M: Floats) -> Floats:
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def judge(work: Work, draw: int, position: Floats, rotation: Floats) -> dict[str, float]:
    """Errors of one draw's prediction: mean and RMS, [m] and [rad]; of pairs in distance and angle."""
    p, R = work.position[draw], work.rotation[draw]
    if work.kind == "distance":
        a, b = np.triu_indices(len(p), 1)
        length = np.linalg.norm(position[b] - position[a], axis=1) - np.linalg.norm(p[b] - p[a], axis=1)
        turn = _angle(rotation[a], rotation[b]) - _angle(R[a], R[b])
    else:
        length, turn = np.linalg.norm(position - p, axis=1), _angle(R, rotation)
    return {
        **{f"position {how}": of(length) for how, of in SUMMARIES.items()},
        **{f"rotation {how}": of(turn) for how, of in SUMMARIES.items()},
    }


def _angle(R: Floats, S: Floats) -> Floats:
    return np.asarray(np.linalg.norm(chain.rotation_vector(np.swapaxes(R, 1, 2) @ S), axis=1))


SUMMARIES: dict[str, Callable[[Floats], float]] = {
    "mean": lambda x: float(np.mean(np.abs(x))),
    "rms": lambda x: float(np.sqrt(np.mean(x**2))),
}
