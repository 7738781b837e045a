"""Dial indicators, tool tip on a flat face: distances of the tool point from planes in the room."""

from collections.abc import Sequence

import numpy as np

from fg_calib.initialization import plane_from_distances
from fg_calib.inputs import Floats
from fg_calib.measurements import Estimate, Frames, Kind, LandmarkKind, Landmarks, Rows, Table, directions
from fg_calib.measurements.kinds.instrument import LENGTH_COLUMNS, Blocks, Column, Instrument


def normal_and_distance(behind: Floats, through: Floats, covariance: Floats) -> Estimate:
    """Unit normal and distance from the base of a plane (see `PlaneDistance`), and their covariance."""
    step = through - behind
    length = np.linalg.norm(step)
    n = step / length
    tilt = (np.eye(3) - np.outer(n, n)) / length
    J = np.vstack([tilt, n + through @ tilt])
    return np.append(n, n @ through), J @ covariance @ J.T, ("", "", "", "m")


BEHIND = LandmarkKind("C", "point behind a plane", "", "", column="plane", away=-3.0, is_constant=True)
_PLANES = "Planes (unit normal in the base frame, distance from the base in mm)"
PLANE = LandmarkKind(
    "F", "plane", _PLANES, away=-2.0, n_configurations=4, reference=BEHIND, estimate=normal_and_distance
)


class PlaneDistance(Kind):
    """`n . (p - f) - measured`, [m]; its derivative is `n . dp` and, in f, `(p - f) . (1 - n n^T) / |f - c| - n`.

    The plane goes through its point f across the unit normal n, which points there from a point c away from the plane:
    three coordinates that may be any, where a normal and a distance would be four that may not.

    Data: the distance on the side that n points to, [m]. Nuisances: c and f in the frame that the chain starts in, 6
    coordinates, [m].
    """

    names, units = ("distance",), ("m",)
    ends, residual_dim, width, n_nuisances = 1, 1, 1, 6

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        length, n = directions(nuisances[:, 3:] - nuisances[:, :3])
        step = at.position[:, 0] - nuisances[:, 3:]
        height = np.einsum("ni,ni->n", n, step)
        D = np.zeros((len(n), 1, 1, 6))
        D[:, 0, 0, 3:] = n
        tilt = (step - height[:, None] * n) / length[:, None]
        N = np.concatenate([-tilt, tilt - n], axis=1)[:, None]
        return Rows(height[:, None] - data[:, :1], D, N)

    def mirrored(self, points: Floats, data: Floats, nuisances: Floats) -> Floats | None:
        """The plane with its normal the other way, shifted to where the readings are those from there, in the mean.

        None where all readings are the same, and tell no side. See `Kind.mirrored`.
        """
        if np.ptp(data) == 0.0:
            return None
        c, f = nuisances[:3], nuisances[3:]
        through = f + 2.0 * float(np.mean(data)) * (f - c) / np.linalg.norm(f - c)
        return np.concatenate([through + (f - c), through])


class PlaneGauge(Instrument):
    """Distances from planes."""

    model, words, kind = "plane", "distances from planes", PlaneDistance()
    columns = (Column(("plane",), "", "Which plane the tool point is on, or at a distance from"), *LENGTH_COLUMNS)
    labels = optional_labels = ("plane",)
    noise, landmarks = ("distance",), (BEHIND, PLANE)
    sees_landmarks = True

    def values(self, table: Table) -> Floats:
        """Distances from planes; 0, on the plane, where no column says them. See `Instrument.values`."""
        m = table.measurements
        return super().values(table) if "distance" in m.columns else np.zeros((m.n_configurations, 1))

    def start_landmarks(self, blocks: Blocks, points: Sequence[Floats], landmarks: Landmarks) -> None:
        """See `Instrument.start_landmarks`."""
        there, nuisances = np.concatenate(points), np.concatenate([block.nuisances for block in blocks])
        distance = np.concatenate([block.data[:, 0] for block in blocks])
        for behind, through in np.unique(nuisances[:, [0, 3]], axis=0).tolist():
            chosen = nuisances[:, 0] == behind
            c, f = plane_from_distances(there[chosen], distance[chosen])
            landmarks.start_at(behind, c)
            landmarks.start_at(through, f)


INSTRUMENTS = (PlaneGauge(),)
