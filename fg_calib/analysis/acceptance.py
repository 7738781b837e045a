"""Whether the arm is as accurate as its user needs it: rows that were held out against the limits of a job.

What is judged is the RMS error of the calibrated arm at the test rows, which the estimate never saw. It contains the
noise of the measurements themselves: an error within the limit is within it all the more without that noise; one beyond
the limit, which would be within it without the noise stated, says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from fg_calib.analysis.residual_table import ResidualTable
from fg_calib.options import Limits

Verdict = Literal["pass", "fail", "not evaluated"]

LEAST = 5
"""Measurements that must have been held out for a limit to be judged by them."""


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
        reason: Why that was not evaluated; empty where it was.
    """

    kind: str
    limit: float
    error: float | None
    noise: float | None
    n: int
    verdict: Verdict
    reason: str = ""


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


def accept(limits: Limits, table: ResidualTable, findings: Sequence[str]) -> Acceptance | None:
    """Judge the limits of a job by its test rows; None without limits.

    Args:
        limits: The limits.
        table: Every residual.
        findings: Why the result is not to be trusted: it then passes nothing.
    """
    stated = {f.name: getattr(limits, f.name) for f in fields(limits)}
    judged = tuple(_judge(kind, limit, table, findings) for kind, limit in stated.items() if limit is not None)
    return Acceptance(judged) if judged else None


def _judge(kind: str, limit: float, table: ResidualTable, findings: Sequence[str]) -> Judgement:
    error = table.rms()["test"].get(kind, {}).get("after")
    if error is None:
        return Judgement(kind, limit, None, None, 0, "not evaluated", f"no test rows measure any {kind}")
    n, noise = table.noise_of_test(kind)

    def judgement(verdict: Verdict, reason: str = "") -> Judgement:
        return Judgement(kind, limit, error, noise, n, verdict, reason)

    if n < LEAST:
        return judgement("not evaluated", f"only {n} test measurement{'s' * (n > 1)}, fewer than {LEAST}")
    if error > limit:
        hidden = error**2 - noise**2 <= limit**2
        return judgement("not evaluated", "the noise of the measurements hides it") if hidden else judgement("fail")
    if findings or not np.isfinite(error):
        return judgement("not evaluated", "within the limit, but the result is not to be trusted")
    return judgement("pass")
