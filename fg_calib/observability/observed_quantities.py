"""Which motions of the tool the measurements together depend on, by their instruments and what is known of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fg_calib.graph import Problem
from fg_calib.inputs import FrameKnowledge, Model
from fg_calib.measurements import INSTRUMENTS, Table


@dataclass(frozen=True)
class ObservedQuantities:
    """What tables together see of the tool's motion; custom kinds may see anything, in any frame.

    Attributes:
        views: Models with the knowledge of their frames, each once.
        custom: Whether there are measurements of custom kinds.
    """

    views: tuple[tuple[Model, FrameKnowledge], ...]
    custom: bool

    @classmethod
    def of_tables(cls, tables: Sequence[Table]) -> ObservedQuantities:
        """What tables see."""
        views: list[tuple[Model, FrameKnowledge]] = []
        for t in tables:
            if t.model is not None:
                relative = t.unknown_frame or (INSTRUMENTS[t.model].sees_landmarks and not t.known)
                views.append((t.model, "unknown" if relative else "known"))
        return cls(tuple(dict.fromkeys(views)), any(t.own for t in tables))

    @classmethod
    def of(cls, problem: Problem) -> ObservedQuantities:
        """What the tables of a problem see, and those that its prior information is from."""
        found = cls.of_tables(problem.data.tables)
        before = () if problem.knowledge is None else problem.knowledge.views
        return replace(found, views=tuple(dict.fromkeys((*found.views, *before))))

    @property
    def position(self) -> bool:
        """Whether something depends on where the tool point is, or may."""
        return self.custom or any(INSTRUMENTS[model].sees_position for model, _ in self.views)

    @property
    def orientation(self) -> bool:
        """Whether something depends on the tool's orientation, or may."""
        return self.custom or any(INSTRUMENTS[model].sees_orientation for model, _ in self.views)

    @property
    def pairs(self) -> bool:
        """Whether all that is measured is between configurations."""
        return not self.custom and all(INSTRUMENTS[model].uses_pairs for model, _ in self.views)

    def is_relative(self, *, position: bool, orientation: bool) -> bool:
        """Whether what depends on position, or on orientation, says nothing of where the base is."""
        return all(
            INSTRUMENTS[model].uses_pairs or frame == "unknown"
            for model, frame in self.views
            if self.custom
            or (position and INSTRUMENTS[model].sees_position)
            or (orientation and INSTRUMENTS[model].sees_orientation)
        )

    @property
    def blind_to_base(self) -> bool:
        """Whether nothing says where the base is: an error then counts after the best rigid fit alone."""
        return not self.custom and self.is_relative(position=True, orientation=True)

    def __str__(self) -> str:
        return " and ".join(dict.fromkeys(model for model, _ in self.views))
