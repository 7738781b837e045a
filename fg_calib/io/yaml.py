"""YAML mappings, checked against pydantic schemas; whatever is wrong with them becomes one line."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from reprlib import Repr
from typing import Annotated, Any, NoReturn, TypeVar

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from fg_calib.errors import InputError
from fg_calib.io.atomic import read_text
from fg_calib.options import did_you_mean
from fg_calib.sizes import LEAST_SIZE, MOST_SIZE, ORDINARY


def _refuse_bool(value: object) -> object:
    """YAML's `yes` and `true` are no numbers, although Python's are."""
    if isinstance(value, bool):
        raise PydanticCustomError("float_type", "a bool")
    if isinstance(value, str) and "_" in value:  # Python's own way of writing digits
        raise PydanticCustomError("float_parsing", "a number")
    return value


def _refuse_no_path(value: object) -> object:
    if not isinstance(value, str) or not value:
        raise PydanticCustomError("path", "no path")
    return value


def _refuse_huge(value: float) -> float:
    if math.isfinite(value) and abs(value) > MOST_SIZE:
        raise PydanticCustomError("absurd", "absurd")
    return value


def _refuse_absurd(value: float) -> float:
    if 0.0 < value < LEAST_SIZE:
        raise PydanticCustomError("absurd", "absurd")
    return _refuse_huge(value)


Number = Annotated[float, BeforeValidator(_refuse_bool), AfterValidator(_refuse_huge)]
"""A finite number, or text that reads as one: PyYAML takes `1e-3` for text."""

Bound = Annotated[float, Field(allow_inf_nan=True), BeforeValidator(_refuse_bool), AfterValidator(_refuse_huge)]
"""A number, or infinity."""

Positive = Annotated[float, Field(gt=0), BeforeValidator(_refuse_bool), AfterValidator(_refuse_absurd)]
"""A finite number above 0."""

NotNegative = Annotated[float, Field(ge=0), BeforeValidator(_refuse_bool), AfterValidator(_refuse_absurd)]
"""A finite number, 0 or more."""

FilePath = Annotated[str, BeforeValidator(_refuse_no_path)]
"""The path of a file."""

MOST = 10_000_000
"""The most of anything that is drawn or formed: more fills disks and days."""

Count = Annotated[int, Field(ge=0, le=MOST, strict=True)]
"""A whole number, 0 or more."""

Seed = Annotated[int, Field(ge=0, lt=2**63, strict=True)]
"""What random numbers begin with."""


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

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: object) -> object:
        return refuse_unknown_keys(*cls.model_fields)(value)


def meaning(words: str, default: Any = ..., *, kind: str = "") -> Any:
    """A key of a schema with what it means: what the reader knows, `fg-calib help` and the reference say.

    Args:
        words: What it means, a sentence without its full stop.
        default: What it is where it is left out; ... where it must not be.
        kind: What it may be, where its type does not say.
    """
    return Field(default, description=words, json_schema_extra={"kind": kind})


@dataclass(frozen=True)
class Section:
    """A mapping of a file, as the reference shows it.

    Attributes:
        title: Where it stands.
        schema: Its keys.
        words: What there is to say before them.
        required: Keys that must be given although the schema alone does not say so.
    """

    title: str
    schema: type[BaseModel]
    words: str = ""
    required: tuple[str, ...] = ()


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
    """A validation error as one line: the first misfit is named, with all keys that are missing there; others count."""
    misfits = error.errors(include_url=False)
    first = misfits[0]
    context = first.get("ctx", {})
    more = f" (and {len(misfits) - 1} more)" if len(misfits) > 1 else ""
    match first["type"]:
        case "missing":
            *path, key = first["loc"]
            if isinstance(key, int):
                return InputError(_place(place, path), f"found {shown(first['input'])}", f"more than {key} in the list")
            missing = [m["loc"][-1] for m in misfits if m["type"] == "missing" and list(m["loc"][:-1]) == path]
            names = ", ".join(map(repr, missing))
            others = f" (and {len(misfits) - len(missing)} more)" if len(misfits) > len(missing) else ""
            return InputError(_place(place, path), f"missing key{'s' * (len(missing) > 1)} {names}{others}")
        case "unknown_key":
            hint = did_you_mean(context["key"], context["known"])
            known = f"one of {', '.join(context['known'])}"
            found = f"unknown key {context['key']!r}"
            return InputError(_place(place, first["loc"]), found, known + more * (not hint), hint + more * bool(hint))
    hint = did_you_mean(first["input"], _options(first)) if first["type"] == "literal_error" else ""
    if first["type"] == "string_type" and isinstance(first["input"], bool):
        hint = "text such as no, on or true stands in quotes"
    if first["type"] == "float_parsing":
        hint = number_hint(first["input"])
    found = f"found {shown(first['input'])}"
    return InputError(_place(place, first["loc"]), found, _expected(first) + more, hint)


def number_hint(found: object) -> str:
    """What to do about a text that is no number although people read it as one; else nothing."""
    text = str(found).strip()
    if re.fullmatch(r"[-+]?\d*,\d+", text):
        return _DECIMAL_COMMA
    return "its minus is another character, a dash; write -" if re.fullmatch(r"[\u2010-\u2015\u2212]\d.*", text) else ""


_DECIMAL_COMMA = "is it a decimal comma? numbers have a decimal point"


def _place(place: str, path: tuple[int | str, ...] | list[int | str]) -> str:
    """`robot.yaml: joint 3: alpha` for joints[2].alpha: items are counted from 1, like joints everywhere."""
    words: list[str] = []
    for part in path:
        if isinstance(part, int):
            words[-1] = f"{words[-1].removesuffix('s')} {part + 1}"
        elif part != "[key]":  # pydantic's word for the key itself
            words.append(part)
    return ": ".join([place, *words])


def _options(misfit: ErrorDetails) -> list[str]:
    return re.findall("'([^']*)'", misfit.get("ctx", {})["expected"])


def _expected(misfit: ErrorDetails) -> str:
    context = misfit.get("ctx", {})
    if misfit["type"] == "literal_error":
        return "one of " + ", ".join(_options(misfit))
    words = _EXPECTED.get(misfit["type"])
    return misfit["msg"] if words is None else words.format(**context)


_EXPECTED = {
    **dict.fromkeys(("float_type", "float_parsing", "finite_number"), "a finite number"),
    **dict.fromkeys(("list_type", "tuple_type"), "a list"),
    **dict.fromkeys(("model_type", "dict_type", "dataclass_type", "model_attributes_type"), "a mapping"),
    "absurd": ORDINARY,
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "a whole number"),
    "string_type": "text",
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    "string_pattern_mismatch": "a name of the pattern {pattern}",
    "greater_than": "a number above {gt:g}",
    "less_than": "a number below {lt:g}",
    "less_than_equal": "a number not above {le:g}",
    "greater_than_equal": "a number not below {ge:g}",
    "path": "a path",
    "too_short": "at least {min_length} in the list",
    "too_long": "at most {max_length} in the list",
}
"""What was expected, by pydantic's type of misfit."""


def shown(value: object) -> str:
    """A found value for a message: its repr, cut to 60 characters; of what is nested or long only the beginning."""
    if value is None:
        return "nothing"
    if isinstance(value, date):
        return str(value)
    try:
        text = repr(value[:100]) if isinstance(value, str) else _REPR.repr(value)
    except ValueError:  # Python shows no whole number of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= 60 else f"{text[:57]}..."


_REPR = Repr()
_REPR.maxstring = _REPR.maxlong = _REPR.maxother = 100
_REPR.maxlist = _REPR.maxdict = _REPR.maxtuple = 20


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises:
        InputError: There is no such file, it is not YAML or not a mapping, or a key stands there twice.
    """
    text = read_text(path)
    try:
        mapping = yaml.load(text, _Loader)
    except RecursionError:
        raise InputError(path.name, "nested too deeply", "a mapping, key: value") from None
    except yaml.MarkedYAMLError as error:
        raise _of_yaml(error, path.name) from None
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n") + 1
        raise InputError(f"{path.name}:{line}", f"character {error.character:#04x}", "printable text") from None
    if not isinstance(mapping, dict):
        found = "an empty file" if mapping is None else f"found {shown(mapping)}"
        hint = "is it a URDF? its name ends in .urdf" if text.lstrip().startswith("<") else ""
        raise InputError(path.name, found, "a mapping, key: value", hint)
    return mapping


def _of_yaml(error: yaml.MarkedYAMLError, name: str) -> InputError:
    """What the parser says, with the line, and the line where what it could not finish begins."""
    mark, start = error.problem_mark, error.context_mark
    found, hint = error.problem or "not YAML", ""
    if found.startswith("but ") and error.context:
        found = f"{error.context}, {found}"
    elif error.context and start and mark and start.line < mark.line:
        hint = f"{error.context} from line {start.line + 1} on"
    return InputError(f"{name}:{mark.line + 1}" if mark else name, found, hint=hint)


MOST_VALUES = 50_000
"""Values that a file may hold, what its aliases stand for counted each time: a second's work, and far above any robot's
or job's; what is long is a table."""


class _Loader(yaml.SafeLoader):
    """The safe loader, which by itself would let the later of two equal keys win, and take any scalar for a key."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._n_values = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """The next node, if there are not too many before it: a long file is given up where it becomes too long."""
        self._n_values += 1
        if self._n_values > MOST_VALUES:
            raise yaml.MarkedYAMLError(
                problem=f"more than {MOST_VALUES} values in one file",
                problem_mark=self.peek_event().start_mark,  # type: ignore[no-untyped-call]
            )
        node: yaml.Node | None = super().compose_node(parent, index)
        return node

    def get_single_node(self) -> yaml.Node | None:
        """The document's node, which is of a size that can be looked at."""
        node: yaml.Node | None = super().get_single_node()
        if node is not None:
            self._size(node, {})
        return node

    def _size(self, node: yaml.Node, known: dict[int, int]) -> int:
        """Number of values in a node, aliases expanded."""
        if id(node) in known:
            if not known[id(node)]:
                self._refuse(node, "an alias of what it stands in")
            return known[id(node)]
        known[id(node)] = 0  # within
        size = 1
        if not isinstance(node, yaml.ScalarNode):
            for child in node.value:
                size += sum(self._size(one, known) for one in (child if isinstance(child, tuple) else (child,)))
        if size > MOST_VALUES:
            self._refuse(node, f"aliases that stand for more than {MOST_VALUES} values")
        known[id(node)] = size
        return size

    @staticmethod
    def _refuse(node: yaml.Node, problem: str) -> NoReturn:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node.

        Raises:
            yaml.MarkedYAMLError: Python cannot make it: no such date, too many digits.
        """
        try:
            return super().construct_object(node, deep)
        except (ValueError, LookupError, AttributeError, TypeError, OverflowError):
            tag = node.tag.removeprefix("tag:yaml.org,2002:")
            self._refuse(node, f"{shown(getattr(node, 'value', None))} is no YAML of type {tag}")

    def construct_number(self, node: yaml.ScalarNode) -> float:
        """A number of base 10, or with a prefix that says another: YAML 1.1 reads 045 as 37, and 1:30 as 90."""
        other = re.fullmatch(r"[-+]?0(?P<base>[xb])?[0-9a-f_]+", node.value, re.IGNORECASE)
        if "_" in node.value:
            self._refuse(node, f"{shown_word(node.value)} has an underscore, expected a number without it")
        if ":" in node.value or other:
            base = "60" if other is None else {"x": "16", "b": "2"}.get((other["base"] or "").lower(), "8")
            self._refuse(node, f"{shown_word(node.value)} is a number of base {base} in YAML, expected one of base 10")
        return self.construct_yaml_int(node) if node.tag.endswith(":int") else self.construct_yaml_float(node)

    def construct_scalar(self, node: yaml.ScalarNode | yaml.MappingNode) -> Any:
        """The text of a scalar, which is one of Unicode: half of a pair of surrogates is none."""
        text = super().construct_scalar(node)
        if isinstance(text, str) and not text.isascii():
            try:
                text.encode()
            except UnicodeEncodeError:
                self._refuse(node, f"{shown(text)} is no text of Unicode")
        return text

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Construct a mapping of different words."""
        if not isinstance(node, yaml.MappingNode):
            self._refuse(node, "a tag of a mapping, expected a mapping behind it")
        seen = set()
        for key_node, value_node in node.value:
            key = key_node.value if isinstance(key_node, yaml.ScalarNode) else None
            if key is None or key_node.tag not in {"tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"}:
                found = f"key {shown_word(key) if key is not None else 'that is no word'}"
                self._refuse(key_node, f"{found}, expected a word{_of_comma(key, value_node)}")
            if hint := _of_comma(key, value_node):
                self._refuse(key_node, f"key {shown(key)}{hint}")
            if key in seen:
                self._refuse(key_node, f"key {shown(key)} stands here twice")
            seen.add(key)
        return super().construct_mapping(node, deep)


def _refuse_tag(loader: _Loader, node: yaml.Node) -> NoReturn:
    loader._refuse(node, f"tag {shown(node.tag)}, expected a value without it")


_Loader.add_constructor(None, _refuse_tag)
for _tag in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _Loader.construct_number)


def _of_comma(key: str | None, value: yaml.Node) -> str:
    """A hint where `{a: 0,5}` made the fraction a key: it is a number in a flow mapping, and nothing stands for it."""
    fraction = key is not None and re.fullmatch(r"\d+([eE][-+]?\d+)?", key) and value.value == ""
    return f"; {_DECIMAL_COMMA}" if fraction else ""


def shown_word(text: str) -> str:
    """A word as it stands, cut to 60 characters."""
    return text if len(text) <= 60 else f"{text[:57]}..."
