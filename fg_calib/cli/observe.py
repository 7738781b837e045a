"""`fg-calib observe`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from fg_calib.cli.output import (
    Angle,
    BaseLink,
    Json,
    Length,
    TipLink,
    argument,
    names_in,
    option,
    say,
    show_result,
)
from fg_calib.inputs import PAIR_MODELS, POSE_MODELS, FrameKnowledge, Model, check_number

Sigma = Annotated[
    float | None, option("--position-noise", "SIGMA", "1 sigma of a position in TABLE; 1 mm if not given.")
]
Turn = Annotated[
    float | None, option("--orientation-noise", "SIGMA", "1 sigma of an orientation in TABLE; 1 mrad if not given.")
]
Reading = Annotated[float, option("--joint-noise", "SIGMA", "1 sigma of a joint reading in TABLE.")]
Table = Annotated[
    Path | None, option("--configurations", "TABLE", "Your configurations; random ones within limits if none.")
]
Pairs = Annotated[Literal["star", "chain", "all"], option("--pairing", None, "Pairs of TABLE's configurations.")]
Prefer = Annotated[str, option("--prefer", "NAMES", "Parameters to keep, first choice first: theta2,d5.")]
RandomSeed = Annotated[int, option("--seed", None, "Of the random configurations, without TABLE.")]


def observe(
    context: typer.Context,
    robot: Annotated[Path, argument("ROBOT", "The robot: robot.yaml or a URDF.")],
    model: Annotated[Model, option("--model", None, "What is measured.")] = "distance-rotation",
    configurations: Table = None,
    out: Annotated[Path | None, option("--out", "DIR", "Write observability.json and figures there.")] = None,
    frame: Annotated[FrameKnowledge, option("--frame", None, "Whether world_T_base is estimated too.")] = "known",
    pairing: Pairs = "star",
    base_link: BaseLink = None,
    tip_link: TipLink = None,
    prefer: Prefer = "",
    length: Length = "m",
    angle: Angle = "rad",
    position_noise: Sigma = None,
    orientation_noise: Turn = None,
    joint_noise: Reading = 0.0,
    seed: RandomSeed = 0,
    as_json: Json = False,
) -> None:
    """Say which parameters measurements can determine, which only together, and why not the others."""
    from fg_calib.inputs import Pairing
    from fg_calib.io import Units, read_measurements, read_robot
    from fg_calib.measurements import Noise
    from fg_calib.observability import observe_configurations, observe_structure
    from fg_calib.report import build_identifiability_report, observability_document, write_observability

    _refuse_options_without_effect(context, model, structural=configurations is None)
    for name, sigma in (("position", position_noise), ("orientation", orientation_noise), ("joint", joint_noise)):
        if sigma is not None:
            check_number(f"--{name}-noise", sigma, above=name != "joint")
    arm = read_robot(robot, base_link=base_link, tip_link=tip_link)
    names = names_in(prefer)
    for name in names:
        arm.index(name)
    if configurations is None:
        found = observe_structure(arm, model, frame=frame, prefer=names, seed=seed)
    else:
        units = Units(length=length, angle=angle)
        position, orientation = (
            None if sigma is None else units.sigma(sigma, unit, f"--{name}-noise")
            for name, sigma, unit in (("position", position_noise, "m"), ("orientation", orientation_noise, "rad"))
        )
        joint = tuple(units.sigma(joint_noise, joint.unit, "--joint-noise") for joint in arm.joints)
        noise = Noise(position=position, orientation=orientation, joint=joint)
        table = read_measurements(configurations, arm, units=units, noise=noise)
        found = observe_configurations(arm, table, model, frame=frame, pairing=Pairing(pairing), prefer=names)
    if out is not None:
        write_observability(out, found)
    show_result(as_json, lambda: observability_document(found), lambda: build_identifiability_report(found))


def _refuse_options_without_effect(context: typer.Context, model: Model, *, structural: bool) -> None:
    """End with 2 where an option is given that has no effect on what is observed."""
    with_orientation, with_position = POSE_MODELS.get(model, (True, True))
    with_distance, with_angle = PAIR_MODELS.get(model, (True, True))
    idle = {
        "seed": (not structural, "with --configurations"),
        **dict.fromkeys(
            ("pairing", "length", "angle", "position_noise", "orientation_noise", "joint_noise"),
            (structural, "without --configurations"),
        ),
    }
    of_model = {
        "frame": model in PAIR_MODELS,
        "pairing": model not in PAIR_MODELS,
        "position_noise": not (with_position and with_distance),
        "orientation_noise": not (with_orientation and with_angle),
    }
    reasons = [*idle.items(), *((name, (is_idle, f"with --model {model}")) for name, is_idle in of_model.items())]
    for name, (is_idle, circumstance) in reasons:
        source = context.get_parameter_source(name)
        if is_idle and source is not None and source.name != "DEFAULT":
            say(f"error: --{name.replace('_', '-')} has no effect {circumstance}")
            raise typer.Exit(2)
