"""What a check says, for the terminal and for programs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Group, RenderableType

from fg_calib.diagnostics.verdict import probability
from fg_calib.monitoring.check import Check, Explanation
from fg_calib.options import LIMITED
from fg_calib.report.shown import SHOWN
from fg_calib.report.tables import indented, line, plain_table, section

SCHEMA = "fg-calib/check/1"

_WORDS = {"pass": "PASS", "fail": "FAIL", "not_evaluated": "NOT EVALUATED"}
_STYLES = {"pass": "bold green", "fail": "bold red", "not_evaluated": "bold yellow"}

_KINDS = {
    "zero": "zero of a joint",
    "zeros": "zeros of two joints",
    "tool": "the tool",
    "frame": "the measurement frame, or the base",
    "row": "gross errors of one configuration",
    "parameter": "",
}

_NO_ADVICE = (
    "no configurations are advised: of random ones none can be measured like these rows (contacts, fixed lengths), or"
    " none tells these changes apart; another instrument may"
)


def named(parameters: Sequence[str]) -> str:
    """A change by its name: of several parameters together `theta2 + theta3`."""
    return " + ".join(parameters)


def check_document(found: Check) -> dict[str, Any]:
    """A check for programs, in [m] and [rad]."""
    advice = found.advice
    return {
        "schema": SCHEMA,
        "verdict": found.verdict,
        "reasons": list(found.reasons),
        "cautions": list(found.cautions),
        "n": found.n,
        "chi2": found.chi2,
        "dof": found.dof,
        "p_value": found.p_value,
        "rms": found.rms,
        "noise": found.noise,
        "limits": found.limits,
        "deploy": found.deploy,
        "detectable": found.detectable,
        "gross_rows": list(found.gross_rows),
        "explanations": [
            {
                "parameters": list(e.parameters),
                "kind": e.kind,
                "change": list(e.change),
                "sigma": list(e.sigma),
                "units": list(e.units),
                "chi2_drop": e.chi2_drop,
                "p_value": e.p_value,
                "likely": e.likely,
                "told_apart_from": [named(names) for names in e.told_apart_from],
                "not_told_apart_from": [named(names) for names in e.not_told_apart_from],
                "same": list(e.same),
            }
            for e in found.explanations
        ],
        "advice": None
        if advice is None
        else {
            "readings": advice.readings.tolist(),
            "between": [named(names) for names in advice.between],
            "apart": advice.apart.tolist(),
            "sigma": advice.sigma.tolist(),
            "needed": advice.needed,
            "enough": advice.enough,
        },
    }


def build_check_report(found: Check, joint_units: Sequence[str]) -> RenderableType:
    """A check for the terminal.

    Args:
        found: It.
        joint_units: `rad` or `m` of each joint.
    """
    parts: list[RenderableType] = [line(_WORDS[found.verdict], _STYLES[found.verdict])]
    parts += indented([*found.reasons, *found.cautions])
    p = "" if found.p_value is None else f", p-value {probability(found.p_value)}"
    parts += indented([f"chi-square {found.chi2:.5g} with {found.dof} degrees of freedom{p}, {found.n} measurements"])
    parts += section("Errors with the calibrated arm (RMS)", _errors(found))
    if found.verdict != "not_evaluated":
        parts += section(
            "Slips that these rows would show in 9 of 10 cases", *indented([_detectable(found, joint_units)])
        )
    if found.explanations:
        parts += section("What changed", _changes(found.explanations), *indented(_words(found)))
    if found.advice is not None:
        parts += section("What to measure", *_advice(found, joint_units))
    return Group(*parts)


def _detectable(found: Check, joint_units: Sequence[str]) -> str:
    words = []
    for (name, size), unit in zip(found.detectable.items(), joint_units, strict=True):
        factor, shown, _ = SHOWN[unit]
        words.append(f"{name} none" if size is None else f"{name} {size * factor:.2g} {shown}")
    return ", ".join(words)


def _errors(found: Check) -> RenderableType:
    table = plain_table(("", "left"), ("", "left"), ("error", "right"), ("noise stated", "right"), ("limit", "right"))
    for kind, rms in found.rms.items():
        unit = LIMITED.get(kind) or ("px" if kind == "pixel" else "m")
        factor, shown, decimals = SHOWN[unit]
        limit = found.limits.get(kind)
        figures = (rms, found.noise[kind], limit)
        table.add_row(kind, shown, *("" if x is None else f"{x * factor:.{decimals}f}" for x in figures))
    return table


def _amounts(e: Explanation) -> tuple[str, str]:
    """The change and its sigma as text."""
    changes, sigmas = [], []
    for change, sigma, unit in zip(e.change, e.sigma, e.units, strict=True):
        factor, shown, decimals = SHOWN[unit]
        changes.append(f"{change * factor:+.{decimals}f} {shown}")
        sigmas.append("unknown" if sigma is None else f"{sigma * factor:.{decimals}f}")
    return ("", "") if len(changes) > 2 else (", ".join(changes), ", ".join(sigmas))


def _changes(explanations: Sequence[Explanation]) -> RenderableType:
    headings = (("", "left"), ("", "left"), ("change", "right"), ("sigma", "right"), ("chi-square falls by", "right"))
    table = plain_table(*headings, ("p-value", "right"), ("", "left"), wrap=True)
    for e in explanations:
        word = "may be" if e.likely and e.not_told_apart_from else "is" if e.likely else "is not: told apart"
        table.add_row(
            named(e.parameters), _KINDS[e.kind], *_amounts(e), f"{e.chi2_drop:.4g}", probability(e.p_value), word
        )
    return table


def _words(found: Check) -> list[str]:
    likely = [e for e in found.explanations if e.likely]
    best = likely[0]
    lines = []
    if best.same:
        others = ", ".join(best.same)
        lines.append(f"{best.parameters[0]} stands for {others} too: they move the tool alike everywhere")
    if len(likely) > 1:
        names = ", ".join(named(e.parameters) for e in likely)
        lines += [f"these rows do not tell apart: {names}", "do not deploy any of these changes yet"]
        if found.advice is None:
            lines.append(_NO_ADVICE)
    elif found.verdict == "fail" and found.deploy:
        lines.append(
            f"no other single change explains the rows: update with --changed {best.parameters[0]}, check again"
        )
    elif found.verdict == "fail":
        lines.append("do not deploy: the change that explains most leaves more than noise does")
    return lines


def _advice(found: Check, joint_units: Sequence[str]) -> list[RenderableType]:
    advice = found.advice
    assert advice is not None
    a, b = (named(names) for names in advice.between)
    columns = [(f"q{i + 1} [{SHOWN[unit][1]}]", "right") for i, unit in enumerate(joint_units)]
    table = plain_table(*columns, ("apart [mm]", "right"), ("together [sigma]", "right"))
    factors = np.array([SHOWN[unit][0] for unit in joint_units])
    for q, apart, sigma in zip(advice.readings, advice.apart, advice.sigma, strict=True):
        table.add_row(*(f"{x:.2f}" for x in q * factors), f"{apart * 1e3:.3f}", f"{sigma:.1f}")
    said = (
        "measured like the rest, in the same table, these tell the changes apart"
        if advice.enough
        else "not even these tell all of them apart: measure more, spread over the whole workspace"
    )
    return [table, *indented([f"{said} ({advice.needed:.1f} sigma are needed; least apart are {a} and {b})"])]
