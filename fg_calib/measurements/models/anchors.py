"""Lengths from the tool point to anchors: ball bars, wires, contact with a point."""

from __future__ import annotations

import numpy as np

from fg_calib.errors import ProblemError
from fg_calib.measurements.kinds import AnchorContact, AnchorDistance
from fg_calib.measurements.models.common import labels_of, needed, places_of, stated
from fg_calib.measurements.series import Series, Table, Unknowns
from fg_calib.robot.model import Robot


def anchor_series(robot: Robot, table: Table, number: int, unknowns: Unknowns) -> list[Series]:
    """Lengths; where one was measured as 0 the tool is at the anchor, unless the instrument adds something unknown.

    Raises:
        ProblemError: A column or a sigma is missing.
    """
    m = table.measurements
    labels = labels_of(table, "anchor")
    length = needed(table, m.length, "distance", "lengths to the anchors")
    rows = np.flatnonzero((labels.index >= 0) & np.isfinite(length))
    sigma = stated(table, m.sigma_length, "distance", rows)
    index = labels.index[rows]
    fitted = rows[~m.test[rows]]
    if table.offset and len(fitted) and not length[fitted].any():
        raise ProblemError(m.source, "contacts alone: all distances are 0", "lengths, or no offset to be estimated")
    anchors = places_of(unknowns, "A", table, labels.names)
    offset = np.full((1, 1), np.nan if table.offset else 0.0)
    added = unknowns.add("O", (f"offset of {m.source}",), offset, m.source, number, known=[not table.offset])
    contact = (length[rows] == 0.0) & (not table.offset)
    nuisances = np.hstack([anchors[index], np.repeat(added, len(rows), axis=0)])
    found = []
    for kind, chosen in ((AnchorDistance(), ~contact), (AnchorContact(), contact)):
        if not chosen.any():
            continue
        n, measured = int(np.sum(chosen)), rows[chosen]
        found.append(
            Series(
                kind=kind,
                table=number,
                ends=measured[:, None],
                data=np.ascontiguousarray(length[measured, None][:, : kind.width]),
                sigma=np.repeat(sigma[chosen, None], kind.residual_dim, axis=1),
                measured=np.ones((n, kind.residual_dim), dtype=np.bool_),
                test=m.test[measured],
                number=measured,
                nuisances=np.ascontiguousarray(nuisances[chosen, : kind.n_nuisances]),
                source=m.source,
                of=labels.of(measured),
            )
        )
    return found
