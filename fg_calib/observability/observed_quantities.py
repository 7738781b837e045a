"""What tables together see of the tool's motion, by their models and the knowledge of their frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fg_calib.graph.problem import Problem
from fg_calib.measurements.table import Table
from fg_calib.options import PAIR_MODELS, FrameKnowledge, Model

PLACES: tuple[Model, ...] = ("anchor", "plane", "board", "pixels")
SEES_POSITION: tuple[Model, ...] = ("pose", "position", "distance", "distance-rotation", *PLACES)
SEES_ORIENTATION: tuple[Model, ...] = ("pose", "orientation", "rotation", "distance-rotation", "board", "pixels")


@dataclass(frozen=True)
class Seen:
    """What tables together see of the tool's motion; other kinds may see anything, in any frame.

    Attributes:
        views: Models with the knowledge of their frames, each once.
        own: Whether there are measurements of other kinds.
    """

    views: tuple[tuple[Model, FrameKnowledge], ...]
    own: bool

    @classmethod
    def by(cls, tables: Sequence[Table]) -> Seen:
        """By tables."""
        views = [
            (t.model, "unknown" if t.unknown_frame or (t.model in PLACES and not t.known) else "known")
            for t in tables
            if t.model is not None
        ]
        return cls(tuple(dict.fromkeys(views)), any(t.own for t in tables))  # type: ignore[arg-type]

    @classmethod
    def of(cls, problem: Problem) -> Seen:
        """By the tables of a problem, and those that what is known before is of."""
        found = cls.by(problem.data.tables)
        before = () if problem.knowledge is None else problem.knowledge.views
        return replace(found, views=tuple(dict.fromkeys((*found.views, *before))))

    def any_of(self, models: Sequence[Model]) -> bool:
        """Whether a model is among these, or might be."""
        return self.own or any(model in models for model, _ in self.views)

    @property
    def pairs(self) -> bool:
        """Whether all that is measured is between configurations."""
        return not self.own and all(model in PAIR_MODELS for model, _ in self.views)

    def relative(self, models: Sequence[Model]) -> bool:
        """Whether what tables of these models see does not say where the base is."""
        return all(
            model in PAIR_MODELS or frame == "unknown" for model, frame in self.views if self.own or model in models
        )

    @property
    def blind_to_base(self) -> bool:
        """Whether nothing at all says where the base is: an error then counts after the best rigid fit alone."""
        return not self.own and self.relative((*SEES_POSITION, *SEES_ORIENTATION))

    def __str__(self) -> str:
        return " and ".join(dict.fromkeys(model for model, _ in self.views))
