"""Ball bars, wires, contact with a point: lengths from the tool point to anchors in the room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fg_calib.initialization import anchors_from_lengths, offset_from_lengths
from fg_calib.inputs import Floats, ProblemError
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.kind import Frames, Kind, Rows, between
from fg_calib.measurements.kinds.contact import Contact
from fg_calib.measurements.kinds.instrument import Blocks, Column, Instrument, Places, add_points, places_of_rows
from fg_calib.measurements.landmarks import LandmarkKind, Landmarks
from fg_calib.measurements.table import MeasurementBlock, Table
from fg_calib.robot import Poses

ANCHOR = LandmarkKind(
    "A",
    "anchor",
    "the unknown anchors",
    "Anchors (in the base frame), mm",
    key="anchors",
    n_configurations=4,
    stays=True,
)
OFFSET = LandmarkKind(
    "O",
    "offset",
    "what the instrument adds to every length",
    "Offsets of instruments on lengths, mm",
    units=("m",),
    is_one=True,
)

LEAST_LENGTHS = 4
"""Lengths that tell an anchor from its mirror image."""


class AnchorDistance(Kind):
    """`|p - a| + offset - measured`, [m]; its derivative is `u . (dp - da) + doffset`, u from the anchor a to p.

    Data: the length, [m]. Nuisances: the anchor in the frame that the chain starts in, and what the instrument adds to
    every length, 4 coordinates, [m].
    """

    names, units = ("distance",), ("m",)
    ends, residual_dim, width, n_nuisances = 1, 1, 1, 4

    def rows(self, at: Frames, data: Floats, nuisances: Floats) -> Rows:
        """See `Kind.rows`."""
        length, u = between(nuisances[:, :3], at.position[:, 0])
        D = np.zeros((len(u), 1, 1, 6))
        D[:, 0, 0, 3:] = u
        N = np.concatenate([-u, np.ones((len(u), 1))], axis=1)[:, None]
        return Rows((length + nuisances[:, 3])[:, None] - data[:, :1], D, N)

    def simulate(self, at: Frames, data: Floats, nuisances: Floats, noise: Floats) -> Floats:
        """See `Kind.simulate`."""
        return np.abs(super().simulate(at, data, nuisances, noise))

    def mirrored(self, points: Floats, data: Floats, nuisances: Floats) -> Floats | None:
        """The anchor mirrored in the plane that its tool points are nearest to; None of few. See `Kind.mirrored`."""
        if len(points) < LEAST_LENGTHS:
            return None
        middle, place = points.mean(axis=0), nuisances[:3]
        across = np.linalg.svd(points - middle)[2][2]
        return np.append(place - 2.0 * across * (across @ (place - middle)), nuisances[3:])


class AnchorContact(Contact):
    """`p - a` in the frame that the chain starts in, [m]: a distance of zero, which has no direction.

    Data: none. Nuisances: the anchor a, 3 coordinates, [m].
    """

    names = ("distance.x", "distance.y", "distance.z")


class AnchorGauge(Instrument):
    """Lengths to anchors."""

    model, words = "anchor", "lengths to anchors"
    columns = (
        Column(("anchor",), "", "Which anchor the distance is to"),
        Column(("distance",), "length", "To the anchor (0: contact), or from the plane (0 without)"),
        Column(("sigma_distance",), "length", "1 sigma of that"),
    )
    labels = optional_labels = ("anchor",)
    noise, landmarks, options = ("distance",), (ANCHOR, OFFSET), ("offset",)
    sees_landmarks = True

    def blocks(self, table: Table, number: int, landmarks: Landmarks) -> list[MeasurementBlock]:
        """Lengths; where one was measured as 0 the tool is at the anchor, unless the instrument adds something unknown.

        Raises:
            ProblemError: A column or a sigma is missing.
        """
        m = table.measurements
        labels = self.require_labels(table, "anchor")
        length = self.require(table, m.length, "distance", "lengths to the anchors")
        rows = np.flatnonzero((labels.index >= 0) & np.isfinite(length))
        sigma = self.require_sigma(table, m.sigma_length, "distance", rows)
        fitted = rows[~m.test[rows]]
        if table.offset and len(fitted) and not length[fitted].any():
            raise ProblemError(m.source, "contacts alone: all distances are 0", "lengths, or no offset to be estimated")
        anchors = add_points(landmarks, ANCHOR, table, labels.names)
        start = np.full((1, 1), np.nan if table.offset else 0.0)
        added = landmarks.add(OFFSET, (OFFSET.of(m.source),), start, m.source, number, known=[not table.offset])
        contact = (length[rows] == 0.0) & (not table.offset)
        nuisances = np.hstack([anchors[labels.index[rows]], np.repeat(added, len(rows), axis=0)])
        return [
            MeasurementBlock.of_rows(
                kind,
                table,
                number,
                rows[chosen],
                length[rows[chosen], None][:, : kind.width],
                np.repeat(sigma[chosen, None], kind.residual_dim, axis=1),
                nuisances=np.ascontiguousarray(nuisances[chosen, : kind.n_nuisances]),
                of=labels.of(rows[chosen]),
            )
            for kind, chosen in ((AnchorDistance(), ~contact), (AnchorContact(), contact))
            if chosen.any()
        ]

    def start_landmarks(self, blocks: Blocks, points: Sequence[Floats], landmarks: Landmarks) -> None:
        """What each table adds, from its rows alone; then anchors from all tables. See `Instrument.start_landmarks`."""
        at = np.concatenate(landmarks.starts)
        lengths = []
        for block, there in zip(blocks, points, strict=True):
            length = np.zeros(block.n) if block.kind.is_contact else block.data[:, 0]
            if not block.kind.is_contact:
                offset = block.nuisances[0, 3]
                if np.isnan(at[offset]):
                    places, anchor = np.unique(block.nuisances[:, 0], return_inverse=True)
                    known = at[places[:, None] + np.arange(3)]
                    at[offset] = offset_from_lengths(there, length, anchor.ravel(), known)
                    landmarks.start(offset, at[[offset]])
                length = length - at[offset]
            lengths.append(length)
        places, anchor = np.unique(np.concatenate([block.nuisances[:, 0] for block in blocks]), return_inverse=True)
        known = at[places[:, None] + np.arange(3)]
        found = anchors_from_lengths(np.concatenate(points), np.concatenate(lengths), anchor.ravel(), known)
        for coordinate, place in zip(places.tolist(), found, strict=True):
            landmarks.start(coordinate, place)

    def predict(self, m: Measurements, poses: Poses, places: Places) -> Measurements:
        """See `Instrument.predict`."""
        there = places_of_rows(places, ANCHOR, m.labels["anchor"])
        offset = float(places(OFFSET, OFFSET.of(m.source))[0])
        return replace(m, length=np.linalg.norm(poses.position - there, axis=1) + offset)

    def default_places(self, names: Sequence[str], middle: Floats, reach: float) -> dict[tuple[str, str], Floats]:
        """See `Instrument.default_places`."""
        away = 2.0 * reach * Rotation.random(len(names), random_state=0).as_matrix()[:, :, 2]
        return {(ANCHOR.letter, name): middle + step for name, step in zip(names, away, strict=True)}


INSTRUMENTS = (AnchorGauge(),)
