"""Which of all suspects explain new rows: those that no other tells from itself, and what they do elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fg_calib.monitoring.hypotheses import (
    CERTAIN,
    GROUPS,
    MOST_REFINED,
    WRONG,
    Found,
    all_suspects,
    columns_of,
    gross_rows,
    motions,
    pairs_of_zeros,
    quantile,
    refined,
    tried,
)
from fg_calib.monitoring.new_data import Calibrated, Linear, Rows
from fg_calib.robot.inverse import random_readings
from fg_calib.statistics.goodness_of_fit import FACTOR

Floats = NDArray[np.float64]


def suspects_of(calibrated: Calibrated, rows: Linear) -> list[Found]:
    """What each suspect explains, pairs of zeros among them where no single change explains the rows."""
    suspects = [*all_suspects(calibrated, rows), *gross_rows(rows)]
    found = [f for s in suspects if (f := tried(s, rows, len(suspects))) is not None]
    if not found:
        return []
    best = min(found, key=lambda f: f.left)
    if special.chdtrc(max(rows.dof - best.k, 1), best.left) >= CERTAIN:
        return found
    pairs = pairs_of_zeros(suspects)
    n = len(suspects) + len(pairs)
    return [f for s in [*suspects, *pairs] if (f := tried(s, rows, n)) is not None]


def likely_changes(found: Sequence[Found], rows: Linear) -> list[Found]:
    """The suspects that no other tells from itself, those left out that have more in them than another that is likely.

    Empty where the best explains nothing for certain.
    """
    if not found:
        return []
    best = min(found, key=lambda f: f.left)
    scale = max(1.0, best.left / max(rows.dof - best.k, 1))
    likely = [f for f in found if not any(excludes(g, f, scale, len(found)) for g in found)]
    if not any(f.certain for f in likely):
        return []
    return sorted((f for f in likely if not any(within(g, f) for g in likely)), key=lambda f: (f.left, f.k))


def excludes(other: Found, found: Found, scale: float, n: int) -> bool:
    """Whether the rows tell another suspect from one, were it that."""
    return (found.left - other.left) / scale > quantile(WRONG / n, other.k)


def within(smaller: Found, larger: Found) -> bool:
    """Whether a suspect has all that another has, and more."""
    if smaller is larger or smaller.k >= larger.k:
        return False
    a, b = smaller.suspect.columns, larger.suspect.columns
    Q, _ = np.linalg.qr(b / np.maximum(np.linalg.norm(b, axis=0), 1e-300))
    return bool(np.linalg.norm(a - Q @ (Q.T @ a)) < 1e-6 * np.linalg.norm(a))


def explains(found: Found, rows: Linear) -> bool:
    """Whether a suspect leaves no more than noise does, or at most `FACTOR` times that."""
    dof = max(rows.dof - found.k, 1)
    return found.left <= FACTOR * dof or float(special.chdtrc(dof, found.left)) > CERTAIN


def best_refined(
    calibrated: Calibrated, rows: Rows, at: Linear, found: list[Found], likely: list[Found]
) -> list[Found]:
    """The best suspects linearised where they lead to."""
    ranked = sorted((f for f in found if f.suspect.kind != "row"), key=lambda f: f.left)[:MOST_REFINED]
    chosen = {f.suspect.names for f in (*ranked, *likely[:MOST_REFINED]) if f.suspect.kind != "row"}
    return [
        refined(f, calibrated, rows, len(found), columns_of(f.suspect, calibrated)) if f.suspect.names in chosen else f
        for f in found
    ]


def motion(calibrated: Calibrated, found: Found, readings: Floats) -> Floats:
    """How a change moves the tool at configurations, shape (n, 2, 3), turn first.

    Args:
        calibrated: The arm.
        found: The change; no gross errors.
        readings: The configurations, shape (n, n_joints).
    """
    names = found.suspect.names
    of, base, tool = motions(calibrated.robot.with_values(calibrated.values), readings)
    whole = {"frame": base, "tool": tool}.get(found.suspect.kind if len(names) == 1 and names[0] in GROUPS else "")
    columns = np.stack([of[name] for name in names], axis=2) if whole is None else whole
    out: Floats = (columns @ found.change).reshape(-1, 2, 3)
    return out


def _motion(calibrated: Calibrated, found: Found) -> Floats | None:
    """The same at random configurations; None of gross errors."""
    if found.suspect.kind == "row":
        return None
    return motion(calibrated, found, random_readings(calibrated.robot, 200, np.random.default_rng(0)))


def effect_elsewhere(calibrated: Calibrated, found: Found) -> dict[str, float] | None:
    """RMS error of the tool that a change makes at random configurations; None where it is none of the arm."""
    motion = _motion(calibrated, found)
    if motion is None or found.suspect.kind == "frame":
        return None
    return dict(zip(("orientation", "position"), _size(motion).tolist(), strict=True))


def _size(motion: Floats) -> Floats:
    """RMS turn and shift, shape (2,)."""
    out: Floats = np.sqrt(np.mean(np.sum(motion**2, axis=2), axis=0))
    return out


def merged(calibrated: Calibrated, likely: Sequence[Found], noise: dict[str, float]) -> list[Found]:
    """Explanations by which the tool is the same everywhere but for less than the noise of one row, as one."""
    least = np.array([noise.get("orientation", np.inf), noise.get("position", noise.get("distance", 0.0))])
    kept: list[tuple[Found, Floats | None]] = []
    for f in likely:
        motion = _motion(calibrated, f)
        for i, (other, theirs) in enumerate(kept):
            if motion is not None and theirs is not None and np.all(_size(motion - theirs) < least):
                same = tuple(dict.fromkeys((*other.suspect.same, *f.suspect.names, *f.suspect.same)))
                kept[i] = replace(other, suspect=replace(other.suspect, same=same)), theirs
                break
        else:
            kept.append((f, motion))
    return [f for f, _ in kept]
