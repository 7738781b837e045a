"""The page of the paper's tables and figures, from the records of the experiments."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "experiments/results"

LARGEST_Z = 3.0
"""Sigmas from 0 that sums which a model determines are within."""

ROUNDED = 0.05
"""Share by which a rounded number of the paper may differ."""

PAGE = """Tables and figures of the paper
===============================

Jia, Wang, Chen, Sun (2019), *Error Modeling in Distance and Rotation for Self-Calibration of Space Robots on Orbit*.
This page is generated from the records in ``experiments/results``. The :doc:`ledger <../ledger>` has all answers.

.. list-table::
   :header-rows: 1

{table}

Tables 1, 2, 5 and 6 are inputs: ``fg-calib simulate space-robot`` has them. Figures 1 to 7 are sketches, Figure 8
shows its 52 configurations.

.. figure:: ../../experiments/results/paper_residuals.png
   :alt: Error that is left of each parameter, a panel a model

   Tables 7 to 9: ``{residuals}``

.. figure:: ../../experiments/results/paper_validation.png
   :alt: Tool error at 500 configurations and its distribution, a line a model

   Figures 9 and 10: ``{validation}``
"""


def rows(found: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Number, content, value here, verdict and command of each table."""
    yield "Paper", "Content", "Value here", "Verdict", "Command"
    for number, model in ((3, "pose"), (4, "distance-rotation")):
        one = found["identifiability"]["found"][model]
        differ = one["entries"] + one["pairs"]
        value = f"{differ} entries differ; rank {one['rank']} of 35"
        yield f"Table {number}", f"classes, {model}", value, "differs" if differ else "reproduced", "identifiability"
    for number, (model, one) in enumerate(found["residuals"]["found"].items(), 7):
        z = max(one["largest z least squares"], one["largest z graph"])
        value = f"determined sums of Eq. 57 and 58 are within {z:.2g} sigma of 0"
        yield f"Table {number}", f"residuals, {model}", value, "holds" if z < LARGEST_Z else "fails", "residuals"
    for model, one in found["validation"]["found"].items():
        stated, by_residuals = one["paper"][1], one["from paper"]["mean"] * 1e3
        agrees = abs(by_residuals / stated - 1.0) < ROUNDED
        value = f"mean error {by_residuals:.2f} mm by its Tables 7 to 9, {stated:g} mm stated"
        yield "Table 10", model, value, "reproduced" if agrees else "differs", "validation"
        draws = {key: 1e3 * x for key, x in found["claims"]["found"]["base"][f"{model} least squares mean"].items()}
        inside = draws["p5"] <= stated <= draws["p95"]
        value = (
            f"median of 200 draws {draws['median']:.2g} mm, 5 % below {draws['p5']:.2g}, 5 % above {draws['p95']:.2g}"
        )
        off = "in the lower tail" if stated < draws["median"] / 2 else "typical"
        yield "Table 10", f"{model}, by our draws", value, off if inside else "not reached", "claims"


def paper() -> str:
    """The page."""
    found = json.loads((RESULTS / "paper.json").read_text())
    table = ""
    for *cells, question in rows(found):
        command = f"``{found[question]['command']}``" if question in found else question
        table += "   * - " + "\n     - ".join([*cells, command]) + "\n"
    return PAGE.format(table=table, **{name: found[name]["command"] for name in ("residuals", "validation")})
