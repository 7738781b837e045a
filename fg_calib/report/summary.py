"""A saved result in words: a few lines for a screen, a table of parameters as text and for a notebook."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from textwrap import wrap

from fg_calib.errors import escaped
from fg_calib.io.result import Judgement as JudgementDocument
from fg_calib.io.result import Lost, Parameter, Result, Rms
from fg_calib.options import LIMITED
from fg_calib.report.identifiability import format_relation
from fg_calib.report.shown import FAMILY_UNIT, SHOWN
from fg_calib.report.tolerances import TITLE, tolerance_rows
from fg_calib.statistics.acceptance import Judgement

WIDTH = 100

_HEADINGS = ("", "estimate", "± sigma", "", "correction", "nominal", "prior", "class")


def good(reservations: Sequence[str]) -> str:
    """The word for a result that may be trusted, although perhaps not without reservations."""
    return "GOOD, with reservations" if reservations else "GOOD"


def verdict_word(result: Result) -> str:
    """The word for a result that nothing speaks against; where single rows were not judged it is none of praise."""
    return "NOT JUDGED ROW BY ROW" if result.in_parts else good(result.reservations)


def judged(found: Iterable[Judgement | JudgementDocument]) -> list[str]:
    """A line a limit: `PASS: position 0.31 mm (RMS of 30 held-out measurements), limit 0.5 mm`."""
    lines = []
    for one in found:
        factor, unit, _ = SHOWN[LIMITED[one.kind]]
        error = "" if one.error is None else f" {one.error * factor:.3g} {unit} (RMS of {one.n} held-out measurements)"
        reason = f": {one.reason}" if one.reason else ""
        of = f" of {one.table}" if one.table else ""
        lines.append(f"{one.verdict.upper()}: {one.kind}{of}{error}, limit {one.limit * factor:.3g} {unit}{reason}")
    return lines


def summary(result: Result) -> list[str]:
    """What was calibrated from what, whether it is to be trusted, and how large residuals are: at most 10 lines."""
    lines = _summary(result, 3)
    return [escaped(line if len(line) <= WIDTH else f"{line[: WIDTH - 4]} ...") for line in lines]


def _summary(result: Result, most: int | None = None) -> list[str]:
    """The lines of a summary as long as they are, of findings or reservations so many at most."""
    head = f"{result.robot}: {result.model}"
    head += "" if result.pairing is None else f", pairs: {result.pairing}"
    head += ", measurement frame unknown" if result.frame_estimate is not None else ""
    chi2 = "" if result.reduced_chi2 is None else f", reduced chi-square {result.reduced_chi2:.3g}"
    verdicts = [f"DOUBTFUL: {finding}" for finding in result.findings]
    verdicts = verdicts or [f"{verdict_word(result)}: {result.solver.message}", *result.reservations]
    shown = verdicts[:most]
    more = [f"... and {len(verdicts) - len(shown)} more findings"] if len(verdicts) > len(shown) else []
    estimated = [p for p in result.parameters if p.identifiability != "fixed"]
    known = sum(p.sigma is not None for p in estimated)
    return [
        head,
        *([] if result.acceptance is None else judged(result.acceptance.judgements)),
        *shown,
        *more,
        f"{result.n_configurations} configurations, {result.n_residuals} residuals{chi2}",
        f"{len(estimated)} of {len(result.parameters)} parameters estimated, {known} of them with a known sigma",
        *(f"{split} residuals, RMS: {text}" for split, text in _rms(result)),
    ]


def _rms(result: Result) -> Iterator[tuple[str, str]]:
    for split, kinds in result.residual_rms.items():
        found = [_before_and_after(kind, rms) for kind, rms in kinds.items() if rms is not None]
        if found:
            yield split, ", ".join(found)


def _before_and_after(kind: str, rms: Rms) -> str:
    factor, unit, _ = SHOWN[rms.unit or FAMILY_UNIT.get(kind.partition(",")[0], "m")]
    before, after = ("unknown" if v is None else f"{v * factor:.3g}" for v in (rms.before, rms.after))
    return f"{kind} {before} -> {after} {unit}"


def parameter_rows(parameters: Iterable[Parameter]) -> list[tuple[str, ...]]:
    """The cells of a table of parameters, lengths in mm and angles in degrees, headings first."""
    rows: list[tuple[str, ...]] = [_HEADINGS]
    for p in parameters:
        factor, unit, decimals = SHOWN[p.unit]

        def figure(value: float | None, none: str = "", sign: str = "", f: float = factor, d: int = decimals) -> str:
            return none if value is None else f"{round(value * f, d) + 0.0:{sign}.{d}f}"  # no -0.0

        if p.identifiability == "fixed":
            if p.nominal != 0.0 or not p.name.startswith(("base.", "tool.")):
                rows.append((p.name, figure(p.estimate), "", unit, "", "", "", "fixed"))
            continue
        sigma, prior = figure(p.sigma, "unknown"), figure(p.prior_sigma)
        correction, nominal = figure(p.correction, sign="+"), figure(p.nominal)
        rows.append((p.name, figure(p.estimate), sigma, unit, correction, nominal, prior, p.identifiability))
    return [tuple(map(escaped, row)) for row in rows]


def format_result(result: Result) -> str:
    """A result as plain text: the summary, the parameters, the measurement frame, and what to know of it."""
    rows = parameter_rows(result.parameters)
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADINGS))]
    left = {0, 3, 7}
    cells = (
        (cell.ljust(w) if i in left else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True)))
        for row in rows
    )
    head = [part for line in _summary(result) for part in wrap(escaped(line), WIDTH, subsequent_indent="  ")]
    parts = [*head, "", "Parameters", *("  ".join(row).rstrip() for row in cells)]
    if result.tolerance_scales:
        parts += ["", TITLE, *_scales(result)]
    if result.frame_estimate is not None:
        xyz = "  ".join("unknown" if v is None else f"{v * 1e3:.4f}" for v in result.frame_estimate.xyz)
        quaternion = "  ".join("unknown" if v is None else f"{v:.8f}" for v in result.frame_estimate.quaternion_xyzw)
        parts += ["", "Measurement frame (world_T_base)", f"xyz {xyz} mm", f"quaternion xyzw {quaternion}"]
    if lost := result.observability.lost:
        parts += ["", "What the data do not determine", *_lost(lost)]
    if notes := [text for text in result.cautions if result.findings or text not in result.reservations]:
        parts += ["", "Notes", *map(escaped, notes)]
    return "\n".join(parts)


def _lost(found: Iterable[Lost]) -> Iterator[str]:
    """A line for each reason, with the directions that have it."""
    by_reason: dict[str, list[str]] = {}
    for one in found:
        by_reason.setdefault(one.reason, []).append(format_relation(one.relation))
    for reason, relations in by_reason.items():
        yield escaped(f"{', '.join(relations)}: {reason}")


def _scales(result: Result) -> Iterator[str]:
    """A line for each scale: `a: 2.9 (1.8 to 6.5), 5.0 of 6 corrections seen`."""
    for group, *_, ratio, low, high, seen in tolerance_rows(result.tolerance_scales or (), result.parameters):
        yield escaped(f"{group}: {ratio} ({low} to {high}), {seen} corrections seen")


def html(result: Result) -> str:
    """The summary and the parameters as HTML, for a notebook."""
    head, *rows = parameter_rows(result.parameters)
    headings = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    lines = "<br>".join(map(escape, summary(result)))
    return f"<p>{lines}</p><table><thead><tr>{headings}</tr></thead><tbody>{body}</tbody></table>"
