"""Whether the arm is as accurate as its user needs it: rows that were held out against the limits of a job.

What is judged is the RMS error of the calibrated arm at the test rows, which the estimate never saw, or else at those
that cross-validation held out. It contains the noise of the measurements themselves: an error within the limit is
within it all the more without that noise; an error beyond the limit that would be within it without the specified noise
says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from fg_calib.inputs import Limits
from fg_calib.statistics.residual_table import HeldOut, pooled

Verdict = Literal["pass", "fail", "not evaluated"]

LEAST = 5
"""Measurements that must have been held out for a limit to be judged by them."""


@dataclass(frozen=True)
class Judgement:
    """One limit, and what the held-out rows say of it.

    Attributes:
        kind: What it limits: `position`, `orientation`, `distance` or `angle`.
        limit: Its value, [m] or [rad].
        error: RMS error of the calibrated arm at the held-out rows; None without any.
        noise: RMS of the specified noise of these rows.
        n: Number of measurements held out.
        verdict: Whether the arm keeps to it.
        reason: Why that was not evaluated, or which arm it was that passed, where it was not the calibrated one.
        table: Name of the table; empty where there is one alone.
    """

    kind: str
    limit: float
    error: float | None
    noise: float | None
    n: int
    verdict: Verdict
    reason: str = ""
    table: str = ""


@dataclass(frozen=True)
class Acceptance:
    """What became of all limits.

    Attributes:
        judgements: Limit by limit.
    """

    judgements: tuple[Judgement, ...]

    @property
    def verdict(self) -> Verdict:
        """`pass` where all limits are kept, `fail` where one is not."""
        found = [one.verdict for one in self.judgements]
        return "fail" if "fail" in found else "not evaluated" if "not evaluated" in found else "pass"


def accept(limits: Limits, held_out: Sequence[HeldOut], findings: Sequence[str]) -> Acceptance | None:
    """Judge the limits of a job by what was held out; None without limits.

    Tables are judged one by one: many rows of one do not make up for those of another.

    Args:
        limits: The limits.
        held_out: Measurements held out, by table and kind: test rows, or those of cross-validation.
        findings: Why the result is not to be trusted: it then passes nothing.
    """
    judged = []
    for kind in (f.name for f in fields(limits)):
        limit = getattr(limits, kind)
        if limit is not None:
            parts = _judged_alone([held for held in held_out if held.kind == kind])
            judged += [_judge(kind, limit, held, findings) for held in parts or (None,)]
    return Acceptance(tuple(judged)) if judged else None


def _judged_alone(held_out: Sequence[HeldOut]) -> list[HeldOut]:
    """What is judged by itself: each table with rows enough, the others together where these are enough."""
    alone = [held for held in held_out if held.n >= LEAST]
    others = [held for held in held_out if held.n < LEAST]
    if others and (not alone or sum(held.n for held in others) >= LEAST):
        alone.append(pooled(others, "other tables" if alone else ""))
    return alone


def _judge(kind: str, limit: float, held: HeldOut | None, findings: Sequence[str]) -> Judgement:
    if held is None:
        return Judgement(kind, limit, None, None, 0, "not evaluated", f"no measurement of any {kind} was held out")

    exceeds = held.after > limit
    reasons = {
        f"fewer than {LEAST} were held out": held.n < LEAST,
        "frame, base or tool were fitted to these rows, which are too few for that": held.few,
        "the noise of the measurements hides it": exceeds and held.after**2 - held.noise**2 <= limit**2,
        f"{held.by} misses it: mark some rows as test": exceeds and bool(held.by),
        "within the limit, but the result is not to be trusted": not exceeds and bool(findings),
        "the error is not known": not np.isfinite(held.after),
    }
    verdict: Verdict = "fail" if exceeds else "pass"
    reason = f"new rows, by {held.by}" * (bool(held.by) and not exceeds)
    for doubt, applies in reasons.items():
        if applies:
            verdict, reason = "not evaluated", doubt
            break
    return Judgement(kind, limit, held.after, held.noise, held.n, verdict, reason, held.table)
