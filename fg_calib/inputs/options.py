"""Every choice of a calibration; light enough for the command line's help."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields
from typing import TYPE_CHECKING, Any, Literal

from fg_calib.inputs.arguments import check, check_fields, check_names, check_number, check_type, listed
from fg_calib.inputs.arrays import Record
from fg_calib.inputs.errors import InputError, expect

POSE_MODELS = {"pose": (True, True), "position": (False, True), "orientation": (True, False)}
"""Whether a model uses orientations and positions."""

PAIR_MODELS = {"distance": (True, False), "rotation": (False, True), "distance-rotation": (True, True)}
"""Whether a model uses distances and angles of pairs."""

MODELS = {
    **dict.fromkeys(POSE_MODELS, "pose"),
    **dict.fromkeys(PAIR_MODELS, "pair"),
    "anchor": "anchor",
    "plane": "plane",
    "board": "board",
    "pixels": "pixel",
}
"""Models of measurements, each with the file of `measurements.kinds` that describes it."""

if TYPE_CHECKING:
    Model = str
else:
    Model = Literal[tuple(MODELS)]

FrameKnowledge = Literal["known", "unknown"]
"""Whether the measurement frame is the base, or world_T_base is estimated too."""

Gauge = Literal["prior", "keep", "none"]
"""How to fix the directions that data do not determine: tolerances as priors; leaving parameters out; nothing."""

Strategy = Literal["star", "chain", "all", "random"]
"""How pairs are formed from poses."""

PairErrors = Literal["shared", "independent"]
"""Whether pairs of one configuration are taken to share its errors, or to be independent as in the paper."""

EncoderNoise = Literal["propagated", "estimated"]
"""Whether the noise of joint readings is added to that of the rows, or each true joint vector is estimated too."""

Loss = Literal["none", "huber", "cauchy", "geman-mcclure", "gnc"]
"""Treatment of large residuals: least squares, or a robust loss."""

ExportFormat = Literal["urdf", "ur", "tesseract", "dh", "mdh", "mdh-hayati", "hayati", "poe", "cpc", "zeros", "yaml"]
"""What may read an exported arm: see `exports.export`."""

ToolOfZeros = Literal["nominal", "calibrated"]
"""The tool that a controller works with whose joint zeros are set."""

UrBase = Literal["base", "base_link"]
"""Frame of ur_description that the base of an arm is."""

LengthUnit = Literal["m", "cm", "mm", "um", "in"]
AngleUnit = Literal["rad", "deg", "mrad"]


class Pairing(Record):
    """How pairs are formed from measured poses.

    Attributes:
        strategy: `star` (the first with each other), `chain` (each with the next), `all`, or `random`
            (different pairs, each configuration about equally often).
        count: Number of random pairs; of no other strategy.
        seed: Seed of the random pairs; of no other strategy.

    Raises:
        InputError: One of them is not possible.
    """

    strategy: Strategy = "star"
    count: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        check("pairing", self.strategy, Strategy)
        check_number("pairing: count", self.count, above=self.strategy == "random", whole=True)
        check_number("pairing: seed", self.seed, whole=True)

    def __str__(self) -> str:
        return self.strategy if self.strategy != "random" else f"random ({self.count}, seed {self.seed})"


LIMITED: dict[str, Literal["m", "rad"]] = {"position": "m", "orientation": "rad", "distance": "m", "angle": "rad"}
"""Quantities that `Limits` limits; units."""


class Limits(Record):
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
        for name, limit in vars(self).items():
            if limit is not None:
                check_number(f"accept: {name}", limit, above=True)


class Options(Record):
    """Every choice of a calibration, checked.

    Attributes:
        model: Which measurements take part.
        pairing: How pairs are formed from poses where none were measured directly.
        frame: Whether the measurement frame is known to be the base, or world_T_base is estimated too; of no meaning
            for models of pairs.
        gauge: How to fix the directions that the data do not determine. `prior`: the tolerances. `none`: nothing;
            everything is estimated by minimum-norm steps, and what is not determined has no sigma. `keep`: only
            the independent parameters and those kept of each relative group are estimated, without priors, the
            others stay at nominal (the paper's way); what is said of errors counts them with their tolerance.
        prefer: For `keep`: parameters to keep, first choice first.
        pair_errors: Whether pairs share the errors of their configurations or count as independent.
        encoder: `propagated`: the noise of joint readings is added to that of the rows, to first order. `estimated`:
            the true joint values of every configuration are estimated too, with the readings as their priors.
        loss: Treatment of large residuals: `none` or a robust loss (see `graph.robust`).
        estimate_noise: Whether the sigmas specified are only a start, and scaled to what is seen.
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
    max_iterations: int | None = None
    accept: Limits = field(default_factory=Limits)
    folds: int | None = None

    def __post_init__(self) -> None:
        if isinstance(self.accept, Mapping):
            check_names("accept", self.accept, list(LIMITED), "limit")
            object.__setattr__(self, "accept", Limits(**self.accept))
        check_fields(self)
        for key, least in (("max_iterations", 1), ("folds", 2)):
            if getattr(self, key) is not None:
                check_number(key, getattr(self, key), least=least, whole=True)

    @classmethod
    def of(cls, options: Options | None = None, **choices: Any) -> Options:
        """The options given, or options from keywords; `prior=False` is `gauge="none"`.

        Raises:
            InputError: Both were given, a keyword is not known, or its value is not one of those possible.
        """
        if options is not None:
            if choices:
                raise InputError("options", f"both options and {next(iter(choices))}=...", "one of the two")
            return options
        check_names("options", choices, [*(f.name for f in fields(cls)), "prior"], "option")
        if "prior" in choices:
            prior = choices.pop("prior")
            check_type("prior", prior, bool)
            gauge = choices.setdefault("gauge", "prior" if prior else "none")
            expect(prior == (gauge == "prior"), "prior", f"found {prior} with gauge: {gauge}", "gauge alone")
        choices["prefer"] = listed("prefer", choices.get("prefer", ()))
        return cls(**choices)

    @property
    def has_priors(self) -> bool:
        """Whether the robot's tolerances are priors."""
        return self.gauge == "prior"
