"""`fg-calib inspect`, `observe` and `compare`: what rows can determine, and what estimators make of them."""

from pathlib import Path
from typing import Annotated, Any, Literal

import fg_calib
from fg_calib import diagnostics, io, measurements, observability, report
from fg_calib.cli.output import Angle, BaseLink, Json, Length, TipLink, argument, end, names_in, option, show_result
from fg_calib.inputs import FrameKnowledge, Model, Pairing

Sigma = float | None
Strategy = Literal["star", "chain", "all"]


def inspect(job: Annotated[Path, argument("JOB", "The job, such as calibration.yaml.")], as_json: Json = False) -> None:
    """Say what a job holds, what looks wrong with it, and what it can determine, without solving it."""
    given = io.read_job(job)
    found = diagnostics.inspect_job(given)
    show_result(as_json, report.inspection_document, report.build_inspection_report, found, given)
    end(found.findings, "look at this first")


def observe(
    robot: Annotated[Path, argument("ROBOT", "The robot: robot.yaml or a URDF.")],
    model: Annotated[Model, option("--model", None, "What is measured.")] = "distance-rotation",
    configurations: Annotated[Path | None, option("--configurations", "TABLE", "Random ones if not given.")] = None,
    out: Annotated[Path | None, option("--out", "DIR", "Write observability.json there.")] = None,
    frame: Annotated[FrameKnowledge, option("--frame", None, "Whether world_T_base is estimated too.")] = "known",
    pairing: Annotated[Strategy, option("--pairing", None, "Pairs of TABLE's configurations.")] = "star",
    base_link: BaseLink = None,
    tip_link: TipLink = None,
    prefer: Annotated[str, option("--prefer", "NAMES", "Parameters to keep, first choice first: theta2,d5.")] = "",
    length: Length = "m",
    angle: Angle = "rad",
    position_noise: Annotated[Sigma, option("--position-noise", "SIGMA", "1 mm if not given.", min=0.0)] = None,
    orientation_noise: Annotated[Sigma, option("--orientation-noise", "SIGMA", "1 mrad if not.", min=0.0)] = None,
    joint_noise: Annotated[float, option("--joint-noise", "SIGMA", "1 sigma of a joint reading.", min=0.0)] = 0.0,
    seed: Annotated[int, option("--seed", None, "Of the random configurations, without TABLE.")] = 0,
    as_json: Json = False,
) -> None:
    """Say which parameters measurements can determine, which only together, and why not the others."""
    arm, names = io.read_robot(robot, base_link=base_link, tip_link=tip_link), names_in(prefer)
    if configurations is None:
        found = observability.observe_structure(arm, model, frame=frame, prefer=names, seed=seed)
    else:
        units = io.Units(length, angle)
        noise = measurements.Noise(
            position=None if position_noise is None else position_noise * units.factor("m"),
            orientation=None if orientation_noise is None else orientation_noise * units.factor("rad"),
            joint=tuple(joint_noise * units.factor(joint.unit) for joint in arm.joints),
        )
        table = io.read_measurements(configurations, arm, units=units, noise=noise)
        how: dict[str, Any] = {"frame": frame, "pairing": Pairing(pairing), "prefer": names}
        found = observability.observe_configurations(arm, table, model, **how)
    if out is not None:
        report.write_document(out, "observability.json", report.observability_document(found))
    show_result(as_json, report.observability_document, report.build_identifiability_report, found)


def compare(
    job: Annotated[Path, argument("JOB", "The job, such as calibration.yaml.")],
    out: Annotated[Path | None, option("--out", "DIR", "Write comparison.json there.")] = None,
    as_json: Json = False,
) -> None:
    """Compare the factor graph with plain least squares on the same job."""
    found = fg_calib.compare(io.read_job(job))
    if out is not None:
        report.write_document(out, "comparison.json", report.comparison_document(found))
    show_result(as_json, report.comparison_document, report.build_comparison_report, found)
    end(found.findings)
