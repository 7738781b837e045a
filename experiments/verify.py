"""Rerun a sample of every record, compare it with what is recorded, and write the ledger.

    python experiments/verify.py [--only SCRIPT ...] [--ledger]

Every record holds the rows of a few tasks. They are worked out again, and each number is compared: to 1e-6 relative,
or 1e-3 for counts and times of steps that rounding may change (iterations, p-values, gaps of singular values). Exit
status 1 if any differs. `--ledger` writes README.md from the records instead, and draws their figures.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from common import HERE, RESULTS, Question, Row, one, rounded

SCRIPTS = ("paper", "real_data", "validation", "effects", "real_effects", "ur10", "design", "peers", "speed")
TOLERANCE = 1e-6
LOOSE = {"gap", "seconds", "iterations", "p", "angle to the null space", "update"}
"""Keys whose values rounding may change by more: they are compared by order of magnitude."""

HEAD = """# Experiments: what is claimed and how it was measured

Each answer is generated from a record in [results](results), which holds the command, commit, versions and sample rows;
method and traps stand in the script's docstring. `python experiments/verify.py` reruns the samples and compares;
`python experiments/verify.py --ledger` writes this page. Every script has `--quick`. Times are of one machine with two
cores: read ratios.

"""


def differences(then: Any, now: Any, key: str = "") -> Iterator[str]:
    """Yield what differs between a recorded and a new value."""
    if isinstance(then, dict) and isinstance(now, dict):
        for name in sorted({*then, *now}):
            yield from differences(then.get(name), now.get(name), name)
    elif isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        for a, b in zip(then, now, strict=True):
            yield from differences(a, b, key)
    elif isinstance(then, (int, float)) and isinstance(now, (int, float)):
        off = abs(then - now)
        allowed = 10.0 * max(abs(then), abs(now)) if key in LOOSE else TOLERANCE * abs(then) + 1e-12
        if off > allowed:
            yield f"{key}: recorded {then:.8g}, now {now:.8g}"
    elif then != now:
        yield f"{key}: recorded {then!r}, now {now!r}"


def verify(script: str) -> bool:
    """Rerun the samples of one script's record; returns whether all agree."""
    record = json.loads((RESULTS / f"{script}.json").read_text())
    questions: Sequence[Question] = importlib.import_module(script).QUESTIONS
    good = True
    for question in questions:
        of = record.get(question.name)
        if of is None or question.timed:
            continue
        for task, row in of["samples"]:
            now = json.loads(json.dumps(rounded(one(question.work, tuple(task)), 10)))
            found = list(differences(row, now))
            good &= not found
            print(
                f"{'same' if not found else 'DIFFERS':8} {script} {question.name} {task}",
                *found[:5],
                sep="\n    "[: 5 * bool(found)],
            )
    return good


def draw_figures() -> None:
    """Draw every figure from its record."""
    for script in SCRIPTS:
        file = RESULTS / f"{script}.json"
        record: Row = json.loads(file.read_text()) if file.is_file() else {}
        for question in importlib.import_module(script).QUESTIONS:
            if question.figure is not None and question.name in record:
                question.figure(record[question.name]["found"], RESULTS / f"{script}_{question.name}.png")


def ledger() -> str:
    """README.md from the records: the question, its answer, the command and what made it."""
    lines = [HEAD]
    for script in SCRIPTS:
        file = RESULTS / f"{script}.json"
        record: Row = json.loads(file.read_text()) if file.is_file() else {}
        lines.append(f"## {script}\n\n| question | answer | command | made at |\n|---|---|---|---|\n")
        for of in record.values():
            made = f"{of['commit']}, {of['date']}"
            lines.append(f"| {of['question']} | {of['answer']} | `{of['command']}` | {made} |\n")
        names = ((png, png.stem.removeprefix(f"{script}_")) for png in sorted(RESULTS.glob(f"{script}_*.png")))
        lines += [f"\n![{record[name]['question']}](results/{png.name})\n" for png, name in names if name in record]
        lines.append("\n")
    notes = HERE / "notes.md"
    return "".join(lines) + (notes.read_text() if notes.is_file() else "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=SCRIPTS, default=SCRIPTS)
    parser.add_argument("--ledger", action="store_true", help="write README.md from the records")
    given = parser.parse_args(arguments)
    if given.ledger:
        draw_figures()
        (HERE / "README.md").write_text(ledger())
        return 0
    present = [script for script in given.only if (RESULTS / f"{script}.json").is_file()]
    return 0 if all(list(map(verify, present))) else 1


if __name__ == "__main__":
    sys.exit(main())
