"""What a reader may want to look up of the files: the keys that their schemas know, and the columns of tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from fg_calib.io import job
from fg_calib.io import robot_file as robot_yaml
from fg_calib.io.table_columns import COLUMNS, ColumnMeaning
from fg_calib.io.yaml import Bound, Count, FilePath, NotNegative, Number, Positive, Section, Seed

Topic = Literal["job", "robot", "tables"]

SECTIONS: Mapping[Topic, tuple[Section, ...]] = {"job": job.SECTIONS, "robot": robot_yaml.SECTIONS}
"""The mappings of each file."""

WORDS: Mapping[Topic, str] = {
    "job": "A calibration job: which robot, which measurements, and every choice (calibration.yaml).",
    "robot": "The nominal robot: robot.yaml, or a URDF.",
    "tables": "Tables: CSV or Parquet. Any other column is ignored; `columns` in a job maps names of your own.",
}
"""What each topic is of."""

TABLE_COLUMNS: tuple[tuple[str, tuple[ColumnMeaning, ...]], ...] = COLUMNS
"""The columns of tables, by what they are of."""


@dataclass(frozen=True)
class Key:
    """A key of a file.

    Attributes:
        name: The key.
        kind: What it may be.
        default: What it is where it is left out: as YAML, `required`, or empty where it is then nothing.
        meaning: What it means.
    """

    name: str
    kind: str
    default: str
    meaning: str


def keys_of(section: Section) -> tuple[Key, ...]:
    """The keys that the reader of a section knows."""
    hints = get_type_hints(section.schema, include_extras=True)
    found = []
    for name, field in section.schema.model_fields.items():
        extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
        required = field.is_required() or name in section.required
        default = "required" if required else _default(field.default)
        found.append(Key(name, str(extra.get("kind") or "") or kind_of(hints[name]), default, field.description or ""))
    return tuple(found)


_KINDS: tuple[tuple[Any, str], ...] = (
    (FilePath, "path"),
    (Number, "number"),
    (Bound, "number"),
    (Positive, "number above 0"),
    (NotNegative, "number not below 0"),
    (Count, "whole number"),
    (Seed, "whole number"),
    (str, "text"),
    (bool, "true | false"),
)
"""Types of keys in words."""


def kind_of(hint: Any) -> str:
    """What a key of a type may be, in words; empty where its type says nothing."""
    for known, words in _KINDS:
        if hint == known:
            return words
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " | ".join(map(str, args))
    if origin in (Union, UnionType):
        return " | ".join(filter(None, (kind_of(one) for one in args if one is not NoneType)))
    if origin is Annotated:
        return kind_of(args[0]) if args[0] is not int else "whole number above 0"
    if origin in (list, tuple):
        return "list of names" if args[0] is str else f"list of {kind_of(args[0])}s"
    return ""


def _default(value: Any) -> str:
    """A default as a file would state it; empty for nothing."""
    if value is None or value is PydanticUndefined or value in ((), {}):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if is_dataclass(value) or isinstance(value, BaseModel):
        parts = {k: v for k, v in vars(value).items() if v != 0.0}
        return "{" + ", ".join(f"{k}: {v}" for k, v in parts.items()) + "}" if parts else ""
    return f"{value:g}" if isinstance(value, float) else str(value)
