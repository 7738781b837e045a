"""YAML mappings, checked against pydantic schemas; whatever is wrong with them becomes one line."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from fg_calib.errors import InputError
from fg_calib.files.disk import read_text
from fg_calib.options import did_you_mean


def _refuse_bool(value: object) -> object:
    """YAML's `yes` and `true` are no numbers, although Python's are."""
    if isinstance(value, bool):
        raise PydanticCustomError("float_type", "a bool")
    return value


Number = Annotated[float, BeforeValidator(_refuse_bool)]
"""A finite number, or text that reads as one: PyYAML takes `1e-3` for text."""

Bound = Annotated[float, Field(allow_inf_nan=True), BeforeValidator(_refuse_bool)]
"""A number, or infinity."""

Positive = Annotated[float, Field(gt=0), BeforeValidator(_refuse_bool)]
"""A finite number above 0."""

NotNegative = Annotated[float, Field(ge=0), BeforeValidator(_refuse_bool)]
"""A finite number, 0 or more."""

Count = Annotated[int, Field(ge=0, strict=True)]
"""A whole number, 0 or more."""


def refuse_unknown_keys(*known: str) -> Callable[[object], object]:
    """A validator that refuses a mapping with other keys."""

    def refuse(value: object) -> object:
        for key in value if isinstance(value, Mapping) else ():
            if key not in known:
                raise PydanticCustomError("unknown_key", "unknown key", {"key": key, "known": list(known)})
        return value

    return refuse


class Schema(BaseModel):
    """A mapping with known keys and finite numbers; base of all schemas."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: object) -> object:
        return refuse_unknown_keys(*cls.model_fields)(value)


AnySchema = TypeVar("AnySchema", bound=Schema)


def validate(schema: type[AnySchema], value: object, place: str) -> AnySchema:
    """`value` as a `schema`.

    Args:
        schema: What it should be.
        value: What a YAML file holds.
        place: The file, and the key in it unless `value` is the whole file; names the place in messages.

    Raises:
        InputError: It does not fit; the first misfit is named, others are counted.
    """
    try:
        return schema.model_validate(value)
    except ValidationError as error:
        raise first_misfit(error, place) from None


def first_misfit(error: ValidationError, place: str) -> InputError:
    """A validation error as one line: the first misfit is named, others are counted."""
    misfits = error.errors(include_url=False)
    first = misfits[0]
    context = first.get("ctx", {})
    more = f" (and {len(misfits) - 1} more)" if len(misfits) > 1 else ""
    match first["type"]:
        case "missing":
            *path, key = first["loc"]
            return InputError(_place(place, path), f"missing key {key!r}{more}")
        case "unknown_key":
            hint = did_you_mean(context["key"], context["known"])
            known = f"one of {', '.join(context['known'])}"
            found = f"unknown key {context['key']!r}"
            return InputError(_place(place, first["loc"]), found, known + more * (not hint), hint + more * bool(hint))
    hint = did_you_mean(first["input"], _options(first)) if first["type"] == "literal_error" else ""
    found = f"found {shown(first['input'])}"
    return InputError(_place(place, first["loc"]), found, _expected(first) + more, hint)


def _place(place: str, path: tuple[int | str, ...] | list[int | str]) -> str:
    """`robot.yaml: joint 3: alpha` for joints[2].alpha: items are counted from 1, like joints everywhere."""
    words: list[str] = []
    for part in path:
        if isinstance(part, int):
            words[-1] = f"{words[-1].removesuffix('s')} {part + 1}"
        else:
            words.append(part)
    return ": ".join([place, *words])


def _options(misfit: ErrorDetails) -> list[str]:
    return re.findall("'([^']*)'", misfit.get("ctx", {})["expected"])


def _expected(misfit: ErrorDetails) -> str:
    context = misfit.get("ctx", {})
    if misfit["type"] == "literal_error":
        return "one of " + ", ".join(_options(misfit))
    return _EXPECTED.get(misfit["type"], misfit["msg"]).format(**context)


_EXPECTED = {
    **dict.fromkeys(("float_type", "float_parsing", "finite_number"), "a finite number"),
    **dict.fromkeys(("list_type", "tuple_type"), "a list"),
    **dict.fromkeys(("model_type", "dict_type", "dataclass_type"), "a mapping"),
    "int_type": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number not below {ge:g}",
    "too_short": "at least {min_length} in the list",
    "too_long": "at most {max_length} in the list",
}
"""What was expected, by pydantic's type of misfit."""


def shown(value: object) -> str:
    """A found value for a message: its repr, cut to 60 characters."""
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises:
        InputError: There is no such file, it is not YAML or not a mapping, or a key stands there twice.
    """
    text = read_text(path)
    try:
        mapping = yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        raise InputError(f"{path.name}:{mark.line + 1}" if mark else path.name, error.problem or "not YAML") from None
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n") + 1
        raise InputError(f"{path.name}:{line}", f"character {error.character:#04x}", "printable text") from None
    except (ValueError, RecursionError) as error:  # a date or number of YAML's that Python cannot make
        raise InputError(path.name, f"not YAML: {error}") from None
    if not isinstance(mapping, dict):
        found = "an empty file" if mapping is None else f"found {shown(mapping)}"
        raise InputError(path.name, found, "a mapping, key: value")
    return mapping


class _Loader(yaml.SafeLoader):
    """The safe loader, which by itself would let the later of two equal keys win, and take any scalar for a key."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Construct a mapping of different words."""
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value if isinstance(key_node, yaml.ScalarNode) else None
            if key is None or key_node.tag not in {"tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"}:
                found = f"key {key if key is not None else 'that is no word'}"
                raise yaml.MarkedYAMLError(problem=f"{found}, expected a word", problem_mark=key_node.start_mark)
            if key in seen:
                raise yaml.MarkedYAMLError(problem=f"key {key!r} stands here twice", problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)
