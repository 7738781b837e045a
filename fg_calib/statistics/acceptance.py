"""Whether the arm is as accurate as its user needs it: rows that were held out against the limits of a job.

What is judged is the RMS error of the calibrated arm at the test rows, which the estimate never saw, or else at those
that cross-validation held out (see `folds`). It contains the noise of the measurements themselves: an error within the
limit is within it all the more without that noise; one beyond the limit, which would be within it without the noise
stated, says nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from fg_calib.options import Limits
from fg_calib.statistics.residual_table import HeldOut, pooled

Verdict = Literal["pass", "fail", "not evaluated"]

LEAST = 5
"""Measurements that must have been held out for a limit to be judged by them."""


_NAMED = 3
"""Measurements that a reason names."""


@dataclass(frozen=True)
class Judgement:
    """One limit, and what the held-out rows say of it.

    Attributes:
        kind: What it limits: `position`, `orientation`, `distance` or `angle`.
        limit: It, [m] or [rad].
        error: RMS error of the calibrated arm at the held-out rows; None without any.
        noise: RMS noise stated of these rows.
        n: Number of measurements held out.
        verdict: Whether the arm keeps to it.
        reason: Why that was not evaluated, which few measurements alone are why it failed, or which arm it was that
            passed, where it was not the calibrated one; empty otherwise.
        table: Which table it is of; empty where there is one alone.
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


Kinds = Mapping[tuple[str, str], HeldOut]
"""What was held out, by table (empty where there is one alone) and kind of noise."""


def accept(limits: Limits, held_out: Kinds, findings: Sequence[str]) -> Acceptance | None:
    """Judge the limits of a job by what was held out; None without limits.

    Tables are judged one by one: many rows of one do not make up for those of another.

    Args:
        limits: The limits.
        held_out: Test rows, or those of cross-validation.
        findings: Why the result is not to be trusted: it then passes nothing.
    """
    stated = {f.name: getattr(limits, f.name) for f in fields(limits)}
    judged = []
    for kind, limit in stated.items():
        if limit is not None:
            parts = _parts({table: held for (table, of), held in held_out.items() if of == kind})
            judged += [_judge(kind, table, limit, held, findings) for table, held in parts.items()]
    return Acceptance(tuple(judged)) if judged else None


def _parts(held_out: Mapping[str, HeldOut]) -> dict[str, HeldOut | None]:
    """What is judged by itself: each table with rows enough, the others together where these are enough."""
    alone: dict[str, HeldOut | None] = {table: held for table, held in held_out.items() if held.n >= LEAST}
    others = [held for held in held_out.values() if held.n < LEAST]
    if others and (not alone or pooled(others).n >= LEAST):
        alone["" if not alone else "other tables"] = pooled(others)
    return alone or {"": None}


def _judge(kind: str, table: str, limit: float, held: HeldOut | None, findings: Sequence[str]) -> Judgement:
    if held is None:
        return Judgement(kind, limit, None, None, 0, "not evaluated", f"no measurement of any {kind} was held out")

    def judgement(verdict: Verdict, reason: str = "") -> Judgement:
        return Judgement(kind, limit, held.after, held.noise, held.n, verdict, reason, table)

    few = "frame, base or tool were fitted to these rows, which are too few for that" if held.few else ""
    few = few if held.n >= LEAST else f"fewer than {LEAST} were held out"
    if few:
        return judgement("not evaluated", few)
    if held.after > limit and held.after**2 - held.noise**2 <= limit**2:
        return judgement("not evaluated", "the noise of the measurements hides it")
    if held.after > limit:
        missed = judgement("fail", _because_of(held) if held.rest <= limit else "")
        return judgement("not evaluated", f"{held.by} misses it: mark some rows as test") if held.by else missed
    if findings or not np.isfinite(held.after):
        return judgement("not evaluated", "within the limit, but the result is not to be trusted")
    return judgement("pass", f"new rows, by {held.by}" if held.by else "")


def _because_of(held: HeldOut) -> str:
    """That few measurements alone are why a limit is not kept."""
    several = len(held.far) > 1
    them, are = ("them", "are") if several else ("it", "is")
    more = len(held.far) - _NAMED
    names = ", ".join(held.far[:_NAMED]) + (f" and {more} more" if more > 0 else "")
    return f"within the limit without {names}, which {are} far off beside the others: look at {them}"
