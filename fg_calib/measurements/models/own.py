"""Measurements of a kind of one's own."""

from __future__ import annotations

import numpy as np

from fg_calib.errors import InputError
from fg_calib.measurements.dataset import Labels
from fg_calib.measurements.series import Own, Series, Table, Unknowns


def own_series(own: Own, table: Table, number: int, unknowns: Unknowns) -> Series:
    """Measurements of a kind of one's own.

    Its unknowns are in the frame that the table's measurements are in: elsewhere one of the same name is another.

    Raises:
        InputError: It names configurations that the table has not.
    """
    m, frame = table.measurements, number if table.unknown_frame else -1
    kind, data = own.kind, own.data
    n = len(data)
    ends = np.arange(m.n_configurations)[:, None] if own.ends is None else np.asarray(own.ends).reshape(n, -1)
    if len(ends) != n or ends.max(initial=0) >= m.n_configurations:
        found = f"{n} measurements at {len(ends)} configurations" if len(ends) != n else f"found {ends.max()}"
        raise InputError("own: ends", found, f"one a measurement, 0 to {m.n_configurations - 1}")
    nuisances, of = np.zeros((n, 0), dtype=np.int64), None
    if kind.n_nuisances:
        starts = np.atleast_2d(np.asarray(own.unknowns, dtype=np.float64))
        place = unknowns.add("N", own.names, starts, m.source, frame)
        which = np.zeros((n, 1), dtype=np.int64) if own.which is None else np.asarray(own.which).reshape(n, -1)
        nuisances = place[which].reshape(n, -1)
        of = Labels(own.names, which[:, 0]) if len(own.names) > 1 and which.shape[1] == 1 else None
    return Series(
        kind=kind,
        table=number,
        ends=ends,
        data=np.ascontiguousarray(data),
        sigma=np.broadcast_to(own.sigma, (n, kind.residual_dim)),
        measured=np.ones((n, kind.residual_dim), dtype=np.bool_),
        test=np.zeros(n, dtype=np.bool_) if own.test is None else np.asarray(own.test, dtype=np.bool_),
        number=np.arange(n),
        nuisances=nuisances,
        source=m.source,
        of=of,
    )
