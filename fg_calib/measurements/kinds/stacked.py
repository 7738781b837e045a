"""Several kinds of the same ends, measured together."""

from __future__ import annotations

import numpy as np

from fg_calib.inputs import Floats, Integers
from fg_calib.measurements.kind import Frames, Kind, Rows


class Stacked(Kind):
    """Rows of several kinds of the same ends, one below the other: a pose is an orientation and a position.

    Data: those of the kinds, side by side. Nuisances: the same.
    """

    def __init__(self, *parts: Kind) -> None:
        self._parts = parts
        self.names = tuple(name for part in parts for name in part.names)
        self.units = tuple(unit for part in parts for unit in part.units)
        self.ends = parts[0].ends
        self.residual_dim = sum(part.residual_dim for part in parts)
        self.width = sum(part.width for part in parts)
        self.n_nuisances = sum(part.n_nuisances for part in parts)

    @property
    def parts(self) -> tuple[Kind, ...]:
        """See `Kind.parts`."""
        return self._parts

    def _split(self, data: Floats) -> list[Floats]:
        """Data of each part, a view of its columns."""
        return np.split(data, np.cumsum([part.width for part in self.parts])[:-1], axis=1)

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        ends = np.cumsum([part.n_nuisances for part in self.parts])
        rows = [
            part.rows(at, columns, nuisances[:, end - part.n_nuisances : end])
            for part, columns, end in zip(self.parts, self._split(data), ends, strict=True)
        ]
        N, first = np.zeros((len(data), self.residual_dim, self.n_nuisances)), 0
        for part, found, end in zip(self.parts, rows, ends, strict=True):
            if found.nuisances is not None:
                N[:, first : first + part.residual_dim, end - part.n_nuisances : end] = found.nuisances
            first += part.residual_dim
        residual = np.concatenate([r.residual for r in rows], axis=1)
        return Rows(residual, np.concatenate([r.wrenches for r in rows], axis=2), N)

    def figures(self, data: Floats) -> Floats:
        """See `Kind.figures`."""
        return np.hstack([part.figures(own) for part, own in zip(self.parts, self._split(data), strict=True)])

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """See `Kind.simulate`."""
        errors = np.split(noise, np.cumsum([part.residual_dim for part in self.parts])[:-1], axis=1)
        values = np.split(nuisances, np.cumsum([part.n_nuisances for part in self.parts])[:-1], axis=1)
        each = zip(self.parts, self._split(data), values, errors, strict=True)
        return np.hstack([part.simulate(at, *arguments) for part, *arguments in each])

    def twins(self) -> Integers:
        """See `Kind.twins`; none at all if a part has none."""
        twins, row, column = [], 0, 0
        for part in self.parts:
            twins.append(part.twins() + np.array([0, row, column]))
            row, column = row + part.residual_dim, column + part.width
        return np.concatenate(twins) if all(map(len, twins)) else np.zeros((0, 3), dtype=np.int64)


def stack(*parts: Kind) -> Kind:
    """The kinds measured together; one alone is itself."""
    return parts[0] if len(parts) == 1 else Stacked(*parts)
