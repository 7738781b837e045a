"""Ball bars, wires, contact with a point: lengths from the tool point to anchors in the room."""

from collections.abc import Sequence

import numpy as np

from fg_calib.initialization import anchors_from_lengths, offset_from_lengths
from fg_calib.inputs import Floats
from fg_calib.measurements import Coincidence, Landmark, LandmarkKind, Landmarks, Length, Table
from fg_calib.measurements.kinds.instrument import LENGTH_COLUMNS, Blocks, Column, Instrument, Kinds

ANCHOR = LandmarkKind(
    "A", "anchor", "Anchors (in the base frame), mm", key="anchors", away=2.0, n_configurations=4, stays=True
)
_OFFSETS = "Offsets of instruments on lengths, mm"
OFFSET = LandmarkKind("O", "offset", _OFFSETS, "what the instrument adds to every length", units=("m",), is_one=True)

LEAST_LENGTHS = 4
"""Lengths that distinguish an anchor from its mirror image."""


class AnchorDistance(Length):
    """The length from an anchor to the tool point.

    Data: the length, [m]. Nuisances: the anchor in the frame that the chain starts in, and what the instrument adds to
    every length, 4 coordinates, [m].
    """

    ends, n_nuisances = 1, 4

    def mirrored(self, points: Floats, data: Floats, nuisances: Floats) -> Floats | None:
        """The anchor mirrored in the plane that its tool points are nearest to; None of few. See `Kind.mirrored`."""
        if len(points) < LEAST_LENGTHS:
            return None
        middle, place = points.mean(axis=0), nuisances[:3]
        across = np.linalg.svd(points - middle)[2][2]
        return np.append(place - 2.0 * across * (across @ (place - middle)), nuisances[3:])


class AnchorContact(Coincidence):
    """The tool point minus an anchor, in the frame that the chain starts in. Nuisances: the anchor, [m]."""

    ends, n_nuisances = 1, 3


class AnchorGauge(Instrument):
    """Lengths to anchors; where one was measured as 0 the tool is at the anchor, unless the offset is unknown."""

    model, words = "anchor", "lengths to anchors"
    columns = (Column(("anchor",), "", "Which anchor the distance is to"), *LENGTH_COLUMNS)
    labels = optional_labels = ("anchor",)
    noise, landmarks, options = ("distance",), (ANCHOR, OFFSET), ("offset",)
    sees_landmarks = True

    def kinds(self, table: Table) -> Kinds:
        """See `Instrument.kinds`."""
        m, there = table.measurements, self.names(table.measurements, ANCHOR).index >= 0
        contact = np.zeros_like(there) if table.offset else m.columns.get("distance", np.ones(1)) == 0.0
        return [(AnchorDistance(), there & ~contact), (AnchorContact(), there & contact)]

    def landmark(self, table: Table, kind: LandmarkKind, name: str) -> Landmark:
        """See `Instrument.landmark`; the offset is 0 where it is not estimated."""
        if kind is OFFSET and not table.offset:
            return Landmark(kind, name, np.zeros(1), known=True)
        return super().landmark(table, kind, name)

    def start_landmarks(self, blocks: Blocks, points: Sequence[Floats], landmarks: Landmarks) -> None:
        """Offset of each table, from its rows alone; then anchors from all tables. See `Instrument.start_landmarks`."""
        at, lengths = landmarks.start, []
        for block, there in zip(blocks, points, strict=True):
            length = np.zeros(block.n)
            if block.kind.width:
                length, offset = block.data[:, 0], block.nuisances[0, 3]
                if np.isnan(at[offset]):
                    at[offset] = offset_from_lengths(there, length, block.nuisances[:, :3], at)
                    landmarks.start_at(offset, at[[offset]])
                length = length - at[offset]
            lengths.append(length)
        anchor = np.concatenate([block.nuisances[:, :3] for block in blocks])
        for coordinates, place in anchors_from_lengths(np.concatenate(points), np.concatenate(lengths), anchor, at):
            landmarks.start_at(coordinates[0], place)


INSTRUMENTS = (AnchorGauge(),)
