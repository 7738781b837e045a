"""`fg-calib observe`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fg_calib.cli.output import BaseLink, Json, TipLink, say, show_json, show_report
from fg_calib.options import PAIR_MODELS, POSE_MODELS, AngleUnit, FrameKnowledge, LengthUnit, Model, check_number

if TYPE_CHECKING:  # imported where it is used: `--help` need not wait for it
    from fg_calib.io.units import Units
    from fg_calib.measurements.dataset import Noise
    from fg_calib.robot.model import Robot

_NOISES = ("position_noise", "orientation_noise", "joint_noise")

_OF_A_TABLE = ("pairing", "length", "angle", *_NOISES)
"""Options that say something of a table of configurations."""

_Robot = Annotated[Path, typer.Argument(metavar="ROBOT", readable=False, help="The robot: robot.yaml or a URDF.")]
_Model = Annotated[Model, typer.Option("--model", help="What is measured.")]
_Configurations = Annotated[
    Path | None,
    typer.Option(
        "--configurations",
        metavar="TABLE",
        readable=False,
        help="Your configurations; random ones within limits if none.",
    ),
]
_Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", readable=False, help="Write observability.json and figures there."),
]
_Frame = Annotated[FrameKnowledge, typer.Option("--frame", help="Whether world_T_base is estimated too.")]
_Pairing = Annotated[
    Literal["star", "chain", "all"], typer.Option("--pairing", help="Pairs of TABLE's configurations.")
]
_Prefer = Annotated[
    str, typer.Option("--prefer", metavar="NAMES", help="Parameters to keep, first choice first: theta2,d5.")
]
_Length = Annotated[LengthUnit, typer.Option("--length", help="Unit of lengths in TABLE and of its noise.")]
_Angle = Annotated[AngleUnit, typer.Option("--angle", help="Unit of angles in TABLE and of its noise.")]
_PositionNoise = Annotated[float | None, typer.Option(help="1 sigma of a position in TABLE; 1 mm if not given.")]
_OrientationNoise = Annotated[
    float | None, typer.Option(help="1 sigma of an orientation in TABLE; 1 mrad if not given.")
]
_JointNoise = Annotated[float, typer.Option(help="1 sigma of a joint reading in TABLE.")]
_Seed = Annotated[int, typer.Option(help="Of the random configurations, without TABLE.")]


def observe(
    context: typer.Context,
    robot: _Robot,
    model: _Model = "distance-rotation",
    configurations: _Configurations = None,
    out: _Out = None,
    frame: _Frame = "known",
    pairing: _Pairing = "star",
    base_link: BaseLink = None,
    tip_link: TipLink = None,
    prefer: _Prefer = "",
    length: _Length = "m",
    angle: _Angle = "rad",
    position_noise: _PositionNoise = None,
    orientation_noise: _OrientationNoise = None,
    joint_noise: _JointNoise = 0.0,
    seed: _Seed = 0,
    as_json: Json = False,
) -> None:
    """Say which parameters measurements can determine, which only together, and why not the others."""
    from fg_calib.io.robot_file import read_robot
    from fg_calib.io.tables import read_measurements
    from fg_calib.io.units import Units
    from fg_calib.observability.identifiability import observe_configurations, observe_structure
    from fg_calib.options import Pairing
    from fg_calib.report.inspect import build_identifiability_report, observability_document, write_observability

    if configurations is None:
        _refuse_idle(context, _OF_A_TABLE, "without --configurations")
    else:
        _refuse_idle(context, ("seed",), "with --configurations")
    _refuse_idle(context, _idle(model), f"with --model {model}")
    for option, figure in zip(_NOISES, (position_noise, orientation_noise, joint_noise), strict=True):
        if figure is not None:
            check_number(f"--{option.replace('_', '-')}", figure, above=option != "joint_noise")
    arm = read_robot(robot, base_link=base_link, tip_link=tip_link)
    names = [name.strip() for name in prefer.split(",") if name.strip()]
    for name in names:
        arm.index(name)
    if configurations is None:
        found = observe_structure(arm, model, frame=frame, prefer=names, seed=seed)
    else:
        units = Units(length=length, angle=angle)
        noise = _noise(units, arm, position_noise, orientation_noise, joint_noise)
        table = read_measurements(configurations, arm, units=units, noise=noise)
        found = observe_configurations(arm, table, model, frame=frame, pairing=Pairing(pairing), prefer=names)
    if out is not None:
        write_observability(out, found)
    if as_json:
        show_json(observability_document(found))
    else:
        show_report(build_identifiability_report(found))


def _idle(model: Model) -> tuple[str, ...]:
    """Options that say nothing of what a model measures."""
    with_orientation, with_position = POSE_MODELS.get(model, (True, True))
    with_distance, with_angle = PAIR_MODELS.get(model, (True, True))
    idle = {
        "frame": model in PAIR_MODELS,
        "pairing": model not in PAIR_MODELS,
        "position_noise": not (with_position and with_distance),
        "orientation_noise": not (with_orientation and with_angle),
    }
    return tuple(option for option, nothing in idle.items() if nothing)


def _noise(units: Units, robot: Robot, position: float | None, orientation: float | None, joint: float) -> Noise:
    """The noise that the options state."""
    from fg_calib.measurements.dataset import Noise

    return Noise(
        position=None if position is None else units.sigma(position, "m", "--position-noise"),
        orientation=None if orientation is None else units.sigma(orientation, "rad", "--orientation-noise"),
        joint=tuple(units.sigma(joint, j.unit, "--joint-noise") for j in robot.joints),
    )


def _refuse_idle(context: typer.Context, names: Sequence[str], circumstance: str) -> None:
    """Refuse options that were given although they do nothing in such a circumstance."""
    for name in names:
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            say(f"error: --{name.replace('_', '-')} has no effect {circumstance}")
            raise typer.Exit(2)
