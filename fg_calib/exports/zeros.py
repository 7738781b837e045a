"""Zeros of the joints, and which of them the data of a calibration tell.

Fitted zeros follow what was calibrated by their derivative D: their covariance is D C D^T. The data tell them but for
the null-space directions K that zeros, base and tool make alone, which move them by `M = D K`. As many zeros l as M has
rank are left at 0. Of the others k the data determine `z_k + G z_l`, with `M_k + G M_l = 0`.
"""

from collections.abc import Callable

import numpy as np

from fg_calib.calibration import Calibration
from fg_calib.graph import first_independent
from fg_calib.inputs import Floats, Record
from fg_calib.monitoring import named_changes
from fg_calib.robot import Robot

TOLD = 1e-3
"""Part of a direction, in changes of ordinary size, below which it is none."""


class Zero(Record):
    """The zero of a joint, as far as the data tell it from others.

    Attributes:
        reading: What to add to the joint's reading, [rad] (prismatic: [m]); 0 where it is not determined.
        unit: `rad` or `m`.
        sigma: 1 sigma; None where it is not determined, or nothing is known of the errors.
        determined: Whether it is.
        note: What takes it up, or why it is not determined; or the joints whose zeros it takes up.
    """

    reading: float
    unit: str
    sigma: float | None = None
    determined: bool = True
    note: str = ""


def tell_zeros(calibration: Calibration, fit: Callable[[Robot], Floats]) -> dict[str, Zero]:
    """Zeros by joint, as far as the data tell them.

    Args:
        calibration: The calibration.
        fit: The zeros of a calibrated robot, shape (n_joints,), [rad] (prismatic: [m]).
    """
    robot, posterior, lost = calibration.robot, calibration.posterior, calibration.result.observability.lost
    v, joints, of_joint = posterior.variables, robot.joints, slice(0, posterior.variables.n_robot_columns)
    scales = np.array([robot.scale_of(joint.unit) for joint in joints])
    D, changes = posterior.derivative(fit) / scales[:, None], named_changes(v)
    E, names = v.tangent_derivative(posterior.parameters)[:, of_joint], v.names[of_joint]
    N = E @ np.array([[one.relation.get(name, 0.0) for one in lost] for name in names]) / v.scales[:, None]
    outer = [k for k, name in enumerate(names) if name.startswith(("base.", "tool."))]
    zeros = [changes[name] for name in robot.zero_names if name in changes]
    W, Q = np.hstack([*zeros, E[:, outer]]) / v.scales[:, None], np.linalg.qr(N)[0]
    W = W / np.linalg.norm(W, axis=0)
    _, s, V = np.linalg.svd(W - Q @ (Q.T @ W))
    K = V[s <= TOLD].T
    M = D @ (v.scales[:, None] * (W @ K))
    left = first_independent(M.T, int(np.sum(np.linalg.svd(M, compute_uv=False) > TOLD)))
    moved, G = np.linalg.pinv(M[left]), np.eye(len(joints))
    G[:, left] -= M @ moved
    values, sigma = scales * (G @ (fit(robot) / scales)), scales * np.sqrt(posterior.variance(G @ D))
    told, ends = {}, np.abs((K @ moved)[len(zeros) :])
    for j, joint in enumerate(joints):
        lacks, shares = j in left, G[:, j] if j in left else G[j]
        others = [one.name for one, g in zip(joints, shares, strict=True) if abs(g) > TOLD and one is not joint]
        if lacks:
            others += [names[outer[k]] for k in np.flatnonzero(ends[:, left.index(j)] > TOLD)]
        own = {robot.parameters[i].name for i in robot.owned_by(j + 1)}
        why = dict.fromkeys(one.reason for one in lost if lacks and not own.isdisjoint(one.relation))
        note = f"{'taken up by' if lacks else 'sum with'} {', '.join(others)}" if others else "; ".join(why)
        known = float(sigma[j]) if not lacks and np.isfinite(sigma[j]) else None
        told[joint.name] = Zero(0.0 if lacks else float(values[j]), joint.unit, known, not lacks, note)
    return told
