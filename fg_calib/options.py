"""Every choice of a calibration, and the checks of it; light enough for the command line's help."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, Literal, get_args

from fg_calib.arguments import LEAST_SIZE, MOST_SIZE, ORDINARY, as_hinted
from fg_calib.errors import InputError, shown

MODELS: dict[str, str] = {
    "pose": "pose",
    "position": "pose",
    "orientation": "pose",
    "distance": "pair",
    "rotation": "pair",
    "distance-rotation": "pair",
    "anchor": "anchor",
    "plane": "plane",
    "board": "board",
    "pixels": "pixel",
}
"""What a calibration compares with the measurements, each with the file of `measurements.kinds` that describes it."""

if TYPE_CHECKING:
    Model = str
else:
    Model = Literal[tuple(MODELS)]

FrameKnowledge = Literal["known", "unknown"]
"""Whether the measurement frame is the base, or world_T_base is estimated too."""

Gauge = Literal["prior", "keep", "none"]
"""What holds the directions that data do not determine: tolerances as priors; leaving parameters out; nothing."""

Strategy = Literal["star", "chain", "all", "random"]
"""How pairs are formed from poses."""

PairErrors = Literal["shared", "independent"]
"""Whether pairs of one configuration are taken to share its errors, or to be independent as in the paper."""

EncoderNoise = Literal["propagated", "estimated"]
"""Whether the noise of joint readings is added to that of the rows, or each true joint vector is estimated too."""

Loss = Literal["none", "huber", "cauchy", "geman-mcclure", "gnc"]
"""What becomes of large residuals: least squares, or a robust loss."""

SharedScale = Literal["kind", "joint"]
"""Whether the tolerances of a kind of parameters, or those of a joint, are off by the same factor."""

LengthUnit = Literal["m", "cm", "mm", "um", "in"]
AngleUnit = Literal["rad", "deg", "mrad"]


def check(key: str, value: object, possible: Any) -> Any:
    """The option that was given, one of those possible.

    Args:
        key: Its name, for the message.
        value: What was given.
        possible: A `Literal`, or the values themselves.

    Raises:
        InputError: It is none of them.
    """
    options = get_args(possible) or tuple(possible)
    for option in options:
        if value is option or (isinstance(value, type(option)) and value == option):  # numpy's text is text too
            return option
    words = ", ".join(map(str, options))
    raise InputError(key, f"found {shown(value)}", f"one of {words}", did_you_mean(value, options))


def set_checked(of: object, place: str = "", **possible: Any) -> None:
    """Check choices among the fields of a frozen dataclass, and set each to the option that it is.

    Args:
        of: The object.
        place: What stands before a field's name in messages.
        possible: A `Literal` for each field.

    Raises:
        InputError: One is none of those possible.
    """
    for key, options in possible.items():
        object.__setattr__(of, key, check(f"{place}{key}", getattr(of, key), options))


def check_flag(key: str, value: object) -> None:
    """Check that a switch is True or False, and no word that happens to count as True.

    Raises:
        InputError: It is neither.
    """
    if type(value).__name__ not in ("bool", "bool_"):  # Python's and numpy's
        raise InputError(key, f"found {shown(value)}", "True or False")


def check_number(
    key: str,
    value: object,
    *,
    least: float = 0.0,
    above: bool = False,
    whole: bool = False,
    finite: bool = True,
    most: int | None = None,
) -> None:
    """Check that an option is a number of the right kind and size.

    Args:
        key: Its name, for the message.
        value: What was given.
        least: The smallest number possible.
        above: Whether it must be above that.
        whole: Whether it must be a whole number.
        finite: Whether it must be finite.
        most: The largest number possible.

    Raises:
        InputError: It is no number, nan, or not of this kind and size.
    """
    good = isinstance(value, Real) and not isinstance(value, bool)
    if good:
        try:
            x = float(value)  # type: ignore[arg-type]
        except OverflowError:  # a whole number beyond any float
            x = math.inf
        good = (x > least if above else x >= least) and (math.isfinite(x) or not finite)
        good = good and not (whole and not isinstance(value, Integral))
        if good and math.isfinite(x) and (x > MOST_SIZE or (above and x < LEAST_SIZE)):
            raise InputError(key, f"found {shown(value)}", ORDINARY)
        if good and most is not None and x > most:
            raise InputError(key, f"found {shown(value)}", f"at most {most}")
    if not good:
        kind = "a whole number" if whole else "a finite number" if finite else "a number"
        raise InputError(key, f"found {shown(value)}", f"{kind} {'above' if above else 'not below'} {least:g}")


def check_names(key: str, names: Iterable[str], known: Sequence[str], what: str = "parameter") -> None:
    """Check that a list holds known names only.

    Args:
        key: The list's name, for the message.
        names: The names given.
        known: Those possible.
        what: What they are names of.

    Raises:
        InputError: It is one word instead of a list, or a name is not known.
    """
    if isinstance(names, str) or not isinstance(names, Iterable) or not getattr(names, "ndim", 1):
        raise InputError(key, f"found {shown(names)}", "a list of names")
    for name in names:
        if not isinstance(name, str) or name not in known:
            raise InputError(key, f"unknown {what} {shown(name)}", known_names(known), did_you_mean(name, known, NEAR))


NEAR = 0.87
"""Likeness of names (see `difflib`) that is a slip of the pen: tool.w is as like tool.x as it is like tool.z."""


def did_you_mean(value: object, options: Iterable[object], likeness: float = 0.6) -> str:
    """`did you mean shared?` where an option reads nearly like what was given, whatever its case; else nothing.

    The first letter must be the same: whoever writes grad does not mean rad.
    """
    if not isinstance(value, str) or not value:
        return ""
    given = value.lower()
    words = {option.lower(): option for option in options if isinstance(option, str)}
    close = difflib.get_close_matches(given, [w for w in words if w[:1] == given[0]], 1, likeness)
    return f"did you mean {words[close[0]]}?" if close else ""


def listed(key: str, names: Iterable[Any], expected: str = "a list of names") -> tuple[Any, ...]:
    """Names as a tuple: what can be gone through only once would be empty the second time.

    Raises:
        InputError: They are nothing to go through.
    """
    if isinstance(names, str):
        return (names,)
    try:
        return tuple(names)
    except TypeError:
        raise InputError(key, f"found {shown(names)}", expected) from None


def known_names(names: Iterable[str], limit: int = 12) -> str:
    """`one of a, b, c` for an error message, cut after `limit` names."""
    listed = list(names)
    shown = ", ".join(listed[:limit])
    return f"one of {shown}{', ...' if len(listed) > limit else ''}"


@dataclass(frozen=True)
class Pairing:
    """How pairs are formed from measured poses.

    Attributes:
        strategy: `star` (the first with each other), `chain` (each with the next), `all`, or `random`
            (different pairs, each configuration about equally often).
        count: Number of random pairs; of no other strategy.
        seed: Seed of the random pairs; of no other strategy.

    Raises:
        InputError: One of them is not possible, or has no effect.
    """

    strategy: Strategy = "star"
    count: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "strategy", check("pairing", self.strategy, Strategy))
        check_number("pairing: count", self.count, above=self.strategy == "random", whole=True)
        check_number("pairing: seed", self.seed, whole=True)
        for key in ("count", "seed"):
            if self.strategy != "random" and getattr(self, key):
                raise InputError(f"pairing: {key}", f"has no effect on {self.strategy}", "the strategy random")

    def __str__(self) -> str:
        return self.strategy if self.strategy != "random" else f"random ({self.count}, seed {self.seed})"


def as_pairing(pairing: Pairing | None) -> Pairing:
    """The pairing given, a star if None.

    Raises:
        InputError: It is something else, such as a strategy's bare name.
    """
    as_hinted("pairing", pairing, Pairing | None)
    return pairing or Pairing()


PAIR_MODELS: dict[Model, tuple[bool, bool]] = {
    "distance": (True, False),
    "rotation": (False, True),
    "distance-rotation": (True, True),
}
"""Whether a model uses distances and angles of pairs."""

POSE_MODELS: dict[Model, tuple[bool, bool]] = {
    "pose": (True, True),
    "position": (False, True),
    "orientation": (True, False),
}
"""Whether a model uses orientations and positions."""


LIMITED: dict[str, Literal["m", "rad"]] = {"position": "m", "orientation": "rad", "distance": "m", "angle": "rad"}
"""What `Limits` may limit, and its unit."""


@dataclass(frozen=True)
class Limits:
    """The largest RMS errors at test rows with which the arm is good enough; None where there is no limit.

    Attributes:
        position: Of the tool, [m].
        orientation: Of the tool, [rad].
        distance: Of distances and lengths, [m].
        angle: Of angles between configurations, [rad].

    Raises:
        InputError: A limit is no number above 0.
    """

    position: float | None = None
    orientation: float | None = None
    distance: float | None = None
    angle: float | None = None

    def __post_init__(self) -> None:
        for f in fields(self):
            if getattr(self, f.name) is not None:
                check_number(f"accept: {f.name}", getattr(self, f.name), above=True)

    @classmethod
    def given(cls, limits: Limits | Mapping[str, float] | None) -> Limits:
        """The limits given, as such or by name; none at all if None.

        Raises:
            InputError: A name is not known, or a limit is no number above 0.
        """
        if limits is None or isinstance(limits, Limits):
            return limits or cls()
        if not isinstance(limits, Mapping):
            raise InputError("accept", f"found {shown(limits)}", "limits by name")
        check_names("accept", limits, [f.name for f in fields(cls)], "limit")
        return cls(**limits)


@dataclass(frozen=True)
class Options:
    """Every choice of a calibration, checked.

    Attributes:
        model: Which measurements take part.
        pairing: How pairs are formed from poses where none were measured directly.
        frame: Whether the measurement frame is known to be the base, or world_T_base is estimated too; of no meaning
            for models of pairs.
        gauge: What holds the directions that the data do not determine. `prior`: the tolerances. `none`: nothing;
            everything is estimated by minimum-norm steps, and what is not determined has no sigma. `keep`: only
            the independent parameters and those kept of each relative group are estimated, without priors, the
            others stay at nominal (the paper's way); what is said of errors counts them with their tolerance.
        prefer: For `keep`: parameters to keep, first choice first.
        pair_errors: Whether pairs share the errors of their configurations or count as independent.
        encoder: `propagated`: the noise of joint readings is added to that of the rows, to first order. `estimated`:
            the true joint values of every configuration are estimated too, with the readings as their priors.
        loss: What becomes of large residuals: `none` or a robust loss (see `graph.robust`).
        estimate_noise: Whether the sigmas stated are only a start, and scaled to what is seen.
        estimate_tolerance: Whether the robot's tolerances are only a start, and scaled to the corrections seen: one
            scale for each kind of parameters, or each joint; None if they are taken as stated.
        max_iterations: Steps after which the solver gives up; None for its default.
        accept: How large errors may be where rows are held out; by name (`{"position": 5e-4}`) as well.
        folds: Into how many folds configurations are dealt for cross-validation; None for none.

    Raises:
        InputError: A choice is not one of those possible.
    """

    model: Model = "distance-rotation"
    pairing: Pairing = field(default_factory=Pairing)
    frame: FrameKnowledge = "known"
    gauge: Gauge = "prior"
    prefer: tuple[str, ...] = ()
    pair_errors: PairErrors = "shared"
    encoder: EncoderNoise = "propagated"
    loss: Loss = "none"
    estimate_noise: bool = False
    estimate_tolerance: SharedScale | None = None
    max_iterations: int | None = None
    accept: Limits = field(default_factory=Limits)
    folds: int | None = None

    def __post_init__(self) -> None:
        set_checked(self, model=Model, frame=FrameKnowledge, gauge=Gauge)
        set_checked(self, pair_errors=PairErrors, encoder=EncoderNoise, loss=Loss)
        as_hinted("pairing", self.pairing, Pairing)
        check_flag("estimate_noise", self.estimate_noise)
        if self.estimate_tolerance is not None:
            set_checked(self, estimate_tolerance=SharedScale)
            if self.gauge != "prior":
                found = f"to be estimated beside gauge: {self.gauge}"
                raise InputError("tolerance", found, "gauge: prior, the scale of which it is")
        if self.max_iterations is not None:
            check_number("max_iterations", self.max_iterations, above=True, whole=True)
        object.__setattr__(self, "accept", Limits.given(self.accept))
        if self.folds is not None:
            check_number("folds", self.folds, least=2, whole=True)

    @classmethod
    def given(cls, options: Options | None, choices: dict[str, Any]) -> Options:
        """The options given, as such or as keywords.

        Raises:
            InputError: Both were given, a keyword is not known, or its value is not one of those possible.
        """
        if options is not None and choices:
            raise InputError("options", f"both options and {next(iter(choices))}=...", "one of the two")
        return options or cls.of(**choices)

    @classmethod
    def of(cls, **choices: Any) -> Options:
        """Options from keywords; no pairing is a star, and `prior=False` is `gauge="none"`.

        Raises:
            InputError: A keyword is not known, or its value is not one of those possible.
        """
        prior = choices.pop("prior", None)
        check_names("options", choices, [f.name for f in fields(cls)], "option")
        choices["pairing"] = as_pairing(choices.get("pairing"))
        if not isinstance(choices.get("prefer", ()), str):
            choices["prefer"] = listed("prefer", choices.get("prefer", ()))
        options = cls(**choices)
        if prior is None:
            return options
        if "gauge" in choices and (options.with_prior(prior) != options or prior != options.has_priors):
            raise InputError("prior", f"found {prior} beside gauge: {options.gauge}", "gauge alone")
        return options.with_prior(prior)

    def with_prior(self, prior: bool) -> Options:
        """The same with or without the tolerances as priors, what `prior` once said.

        Raises:
            InputError: It is neither True nor False.
        """
        check_flag("prior", prior)
        return self if prior or self.gauge != "prior" else replace(self, gauge="none")

    @property
    def has_priors(self) -> bool:
        """Whether the robot's tolerances are priors."""
        return self.gauge == "prior"

    @property
    def uses_pairs(self) -> bool:
        """Whether the model is one of pairs."""
        return self.model in PAIR_MODELS

    @property
    def unknown_frame(self) -> bool:
        """Whether world_T_base is estimated."""
        return self.frame == "unknown" and not self.uses_pairs
