"""YAML mappings, checked against pydantic schemas, with their units; whatever is wrong with them becomes one line."""

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from fg_calib import inputs
from fg_calib.inputs import LEAST_SIZE, MOST_SIZE, AngleUnit, InputError, LengthUnit, check_fields, did_you_mean, within
from fg_calib.io.atomic import read_text
from fg_calib.robot import SCALES

Number = Annotated[float, Field(strict=True, ge=-MOST_SIZE, le=MOST_SIZE)]
"""A finite number."""

Positive = Annotated[float, Field(strict=True, gt=0, le=MOST_SIZE)]
"""A finite number above 0."""

NotNegative = Annotated[float, Field(strict=True, ge=0, le=MOST_SIZE)]
"""A finite number, 0 or more."""

FilePath = Annotated[str, Field(min_length=1)]
"""The path of a file."""

MOST = 10_000_000
"""The most of anything that is drawn or formed: more fills disks and days."""

Count = Annotated[int, Field(ge=0, le=MOST, strict=True)]
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

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: object) -> object:
        return refuse_unknown_keys(*cls.model_fields)(value)


AnySchema = TypeVar("AnySchema", bound=Schema)


def validate(schema: type[AnySchema], value: object, place: str) -> AnySchema:
    """`value` as a `schema`.

    Args:
        schema: Expected type.
        value: Value in a YAML file.
        place: The file, and the key in it unless `value` is the whole file; names the place in messages.

    Raises:
        InputError: The value does not fit; the first misfit is named, others are counted.
    """
    try:
        with within(place):  # of types that check themselves
            return schema.model_validate(value)
    except ValidationError as error:
        raise first_misfit(error, place) from None


def first_misfit(error: ValidationError, place: str) -> InputError:
    """A validation error as one line: the first misfit is named, with all keys that are missing there; others count."""
    misfits = error.errors(include_url=False)
    first, context = misfits[0], misfits[0].get("ctx", {})
    at, found, expected, hint, n = list(first["loc"]), f"found {shown(first['input'])}", _expected(first), "", 1
    match first["type"]:
        case "missing":
            at = at[:-1]
            missing = [m["loc"][-1] for m in misfits if m["type"] == "missing" and list(m["loc"][:-1]) == at]
            n, names = len(missing), ", ".join(map(repr, missing))
            found, expected = f"missing key{'s' * (n > 1)} {names}", ""
        case "unknown_key":
            found, expected = f"unknown key {context['key']!r}", f"one of {', '.join(context['known'])}"
            hint = did_you_mean(key := context["key"], context["known"]) or "a robot file has it" * (key == "effects")
        case "literal_error":
            hint = did_you_mean(first["input"], _options(first))
        case "string_type" if isinstance(first["input"], bool | float):
            hint = "text such as no, on, true or 0012 stands in quotes"
        case "float_type":
            hint = number_hint(first["input"])
    more = f" (and {len(misfits) - n} more)" * (len(misfits) > n)
    return InputError(_place(place, at), found + more * (not expected), expected + more * bool(expected), hint)


def number_hint(found: object) -> str:
    """Advice on a text that is no number although people read it as one; else nothing."""
    text = str(found).strip()
    if re.fullmatch(r"[-+]?\d*,\d+", text):
        return _DECIMAL_COMMA
    if re.fullmatch(r"[-+]?\d{1,3}([,.' \u00a0\u202f]\d{3})+([.,]\d*)?", text):
        return "are its thousands separated? write digits and a decimal point alone"
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
    return re.split(", | or ", misfit.get("ctx", {})["expected"].replace("'", ""))


def _expected(misfit: ErrorDetails) -> str:
    if misfit["type"] == "literal_error":
        return "one of " + ", ".join(_options(misfit))
    words = _EXPECTED.get(misfit["type"])
    return misfit["msg"] if words is None else words.format(**misfit.get("ctx", {}))


_EXPECTED = {
    **dict.fromkeys(("float_type", "finite_number"), "a finite number"),
    **dict.fromkeys(("list_type", "tuple_type"), "a list"),
    **dict.fromkeys(("model_type", "dict_type", "dataclass_type", "model_attributes_type"), "a mapping"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "a whole number"),
    "string_type": "text",
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    "string_pattern_mismatch": "a name of the pattern {pattern}",
    "greater_than": "a number above {gt:g}",
    "less_than": "a number below {lt:g}",
    "less_than_equal": "a number not above {le:g}",
    "greater_than_equal": "a number not below {ge:g}",
    "string_too_short": "a path",
    "too_short": "at least {min_length} in the list",
    "too_long": "at most {max_length} in the list",
}
"""Expected values, by pydantic's type of misfit."""


def shown(value: object) -> str:
    """A found value for a message: its repr, cut to 60 characters."""
    return "nothing" if value is None else inputs.shown(value)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises:
        InputError: There is no such file, it is not YAML or not a mapping, or a key stands there twice.
    """
    text = read_text(path)
    if half := re.search(r"\\[uU]0*[dD][89a-fA-F][0-9a-fA-F]{2}", text):
        line = text[: half.start()].count("\n") + 1
        raise InputError(f"{path.name}:{line}", f"half a character, {half[0]}", "the character itself")
    try:
        mapping = yaml.load(text, Loader)
    except yaml.MarkedYAMLError as error:
        place = path.name if error.problem_mark is None else f"{path.name}:{error.problem_mark.line + 1}"
        raise InputError(place, error.problem or "not YAML", hint=error.context or "") from None
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(path.name, f"not YAML: {error}") from None
    found = "an empty file" if mapping is None else f"found {shown(mapping)}"
    hint = "is it a URDF? its name ends in .urdf" if text.lstrip().startswith("<") else ""
    inputs.expect(isinstance(mapping, dict), path.name, found, "a mapping, key: value", hint)
    return mapping


class Loader(yaml.SafeLoader):
    """The safe loader with different keys that are words, and numbers of base 10.

    YAML 1.1 reads 045 as 37 and 1:30 as 90; dates and merge keys have no meaning in our files.
    """

    yaml_implicit_resolvers: ClassVar = {  # type: ignore[misc]
        first: [(tag, pattern) for tag, pattern in known if tag.rpartition(":")[2] in ("bool", "null")]
        for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping; its keys are words.

        Raises:
            yaml.MarkedYAMLError: A key is no word, or stands there twice.
        """
        found: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key, problem = key_node.value, ""
            if not isinstance(key_node, yaml.ScalarNode):
                problem = "a key that is no word, expected a word"
            elif re.fullmatch(r"\d+([eE][-+]?\d+)?", key) and value_node.value == "":  # of `{a: 0,5}`
                problem = f"key {shown(key)}, expected a word; {_DECIMAL_COMMA}"
            elif key in found:
                problem = f"key {shown(key)} stands here twice"
            if problem:
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key_node.start_mark)
            found[key] = self.construct_object(value_node, deep=True)
        return found


_INT = r"[-+]?(0|[1-9][0-9]*)"
_FLOAT = r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
for _tag, _pattern, _first in (("int", _INT, "-+0123456789"), ("float", _FLOAT, "-+.0123456789")):
    Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^({_pattern})$"), list(_first))


# --- units ------------------------------------------------------------------------------------------------------------


LENGTHS: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
"""Metres in one unit of length."""

ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": math.pi / 180.0, "mrad": 1e-3}
"""Radians in one unit of angle."""


class Units(inputs.Record):
    """The units in which a file states lengths and angles.

    Attributes:
        length: Unit of length.
        angle: Unit of angle.
    """

    length: LengthUnit = "m"
    angle: AngleUnit = "rad"

    def __post_init__(self) -> None:
        check_fields(self, "units: ")

    def name(self, unit: str) -> str:
        """The file's unit for what is in `m` or `rad` inside the program; of others that unit itself."""
        return {"m": self.length, "rad": self.angle}.get(unit, unit)

    def factor(self, unit: str) -> float:
        """Factor from a value of the file to `unit`: `m`, `rad`, or one that no file has another of."""
        return {"m": LENGTHS[self.length], "rad": ANGLES[self.angle]}.get(unit, 1.0)

    def sigma(self, figure: float, unit: str, place: str) -> float:
        """A sigma or tolerance of the file, 0 or above, in `unit`, `m` or `rad`.

        Args:
            figure: As the file has it.
            unit: Its unit inside the program.
            place: File and key, for messages.

        Raises:
            InputError: The sigma is so small that nothing can be weighted by it.
        """
        value = figure * self.factor(unit)
        if 0.0 < value < LEAST_SIZE:
            raise InputError(place, f"found {figure:g} {self.name(unit)}", f"{LEAST_SIZE:g} {unit} or more")
        return value

    def from_si(self, value: float, unit: str) -> float:
        """The figure for the file of a value in `unit`: the shorter one where that reads back the same."""
        factor = self.factor(unit)
        figure = float(value) / factor
        short = float(f"{figure:.15g}")
        return short if short * factor == value else figure


def quantity(given: object, unit: str, units: Units | None, place: str) -> float:
    """A positive figure in [m] or [rad] from a number in the file's units, or from text with its own: `0.5 mm`.

    Args:
        given: Value in the file.
        unit: `m`, `rad`, or another of `SCALES`.
        units: Of the file; None where a figure must have its own.
        place: File and key, for messages.

    Raises:
        InputError: The value is neither a positive number nor one with a unit.
    """
    known = {"m": LENGTHS, "rad": ANGLES}.get(unit, {SCALES[unit].unit: 1.0 / SCALES[unit].factor})
    number, name = given, "" if units is None else units.name(unit)
    if isinstance(given, str) and (read := _QUANTITY.fullmatch(given)):
        number, name = read["number"], read["unit"] or name
        inputs.expect(name, place, number, hint=f"give a unit, such as {number}{SCALES[unit].unit}")
    expected = f"a number with one of {', '.join(known)}"
    inputs.expect(name in known, place, f"found {shown(given)}", expected, did_you_mean(name, known))
    try:
        figure = float(number) if isinstance(number, str) and "_" not in number else number
        return validate(_Figure, {"figure": figure}, "").figure * known[name]
    except (InputError, ValueError) as error:
        expected = getattr(error, "expected", "a number")
        expected += f", with its unit{'' if units is None else ' or without'}"
        raise InputError(place, f"found {shown(given)}", expected, number_hint(number)) from None


class _Figure(Schema):
    figure: Positive


_QUANTITY = re.compile(r"\s*(?P<number>[^\s]*[0-9.])\s*(?P<unit>[A-Za-z]*)\s*")


UnitsOfFile = Annotated[Units, BeforeValidator(refuse_unknown_keys("length", "angle"))]
"""Units under a file's key `units`."""
