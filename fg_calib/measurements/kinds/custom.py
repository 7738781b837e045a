"""Custom measurements: a kind of the user's, given from Python."""

from __future__ import annotations

import numpy as np

from fg_calib.inputs import InputError
from fg_calib.measurements.dataset import Labels
from fg_calib.measurements.landmarks import LandmarkKind, Landmarks
from fg_calib.measurements.table import CustomMeasurements, MeasurementBlock, Table

UNKNOWN = LandmarkKind(
    "N", "unknown", "unknowns of kinds of your own", "Other unknowns, [m] and [rad]", must_be_fitted=False
)


def custom_block(custom: CustomMeasurements, table: Table, number: int, landmarks: Landmarks) -> MeasurementBlock:
    """Measurements of a custom kind.

    Its unknowns are in the frame that the table's measurements are in: elsewhere one of the same name is another.

    Raises:
        InputError: It names configurations that the table has not.
    """
    m, frame = table.measurements, number if table.unknown_frame else -1
    kind, n = custom.kind, len(custom.data)
    ends = np.arange(m.n_configurations)[:, None] if custom.ends is None else np.asarray(custom.ends).reshape(n, -1)
    if len(ends) != n or ends.max(initial=0) >= m.n_configurations:
        found = f"{n} measurements at {len(ends)} configurations" if len(ends) != n else f"found {ends.max()}"
        raise InputError("own: ends", found, f"one a measurement, 0 to {m.n_configurations - 1}")
    nuisances, of = np.zeros((n, 0), dtype=np.int64), None
    if kind.n_nuisances:
        starts = np.atleast_2d(np.asarray(custom.unknowns, dtype=np.float64))
        place = landmarks.add(UNKNOWN, custom.names, starts, m.source, frame)
        which = np.zeros((n, 1), dtype=np.int64) if custom.which is None else np.asarray(custom.which).reshape(n, -1)
        nuisances = place[which].reshape(n, -1)
        of = Labels(custom.names, which[:, 0]) if len(custom.names) > 1 and which.shape[1] == 1 else None
    return MeasurementBlock.of_rows(
        kind,
        table,
        number,
        np.arange(n),
        custom.data,
        np.broadcast_to(custom.sigma, (n, kind.residual_dim)),
        ends=ends,
        test=np.zeros(n, dtype=np.bool_) if custom.test is None else np.asarray(custom.test, dtype=np.bool_),
        nuisances=nuisances,
        of=of,
    )
