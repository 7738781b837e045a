"""`result.json` of a calibration of a table in parts: what is known of it, and no more."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fg_calib import __version__
from fg_calib.io.assessed_parts import AssessedParts
from fg_calib.io.atomic import digest_of, fill_folder, write_text
from fg_calib.io.csv_writer import Words, write_csv_parts
from fg_calib.io.parts import JobInParts
from fg_calib.io.parts_solver import PartsSolution
from fg_calib.io.result import IN_PARTS, SCHEMA, Carried, Covariance, Frame, Result, Rms, Solver, Step
from fg_calib.measurements.dataset import Measurements
from fg_calib.report.documents import (
    KINDS,
    RESULT_FILES,
    choices_of,
    expected_error_of,
    observability_of,
    parameter_of,
    posterior_of,
    priors_of,
    versions,
    write_calibrated_robot,
)
from fg_calib.robot.kinematics import pose
from fg_calib.robot.model import Robot


def result_of_parts(job: JobInParts, found: AssessedParts) -> Result:
    """What `result.json` holds of a calibration in parts: nothing of single rows, and no word that it is to be trusted.

    Args:
        job: The job.
        found: What is known of it.
    """
    s, options, robot = found.solution, job.options, job.robot
    frames = {
        v.symbol: Frame.model_validate(f) for v, f in zip(s.posterior.variables.frames, found.frames, strict=True)
    }
    return Result.make(
        schema_=SCHEMA,
        version=__version__,
        robot=robot.name,
        model=options.model,
        frame="unknown" if frames else options.frame,
        pairing="measured" if options.uses_pairs else None,
        pair_errors=options.pair_errors if options.uses_pairs else None,
        encoder=options.encoder,
        loss=options.loss,
        n_configurations=s.reduced.n_configurations,
        n_pairs=s.reduced.n_measurements if options.uses_pairs else 0,
        n_residuals=s.reduced.n_residuals,
        n_priors=found.n_priors,
        n_excluded=s.reduced.n_excluded,
        solver=_solver(s),
        trustworthy=False if found.findings else None,
        findings=found.findings,
        cautions=found.cautions,
        reservations=found.reservations,
        chi2=found.chi2.value,
        dof=found.chi2.dof,
        reduced_chi2=found.chi2.value / found.chi2.dof if found.chi2.dof > 0 else None,
        chi2_p_value=found.chi2.p_value,
        priors=priors_of(found.priors),
        expected_error=expected_error_of(found.expected_error),
        residual_rms=_residual_rms(s),
        parameters=tuple(map(parameter_of, found.parameters)),
        covariance=Covariance.make(
            names=s.posterior.variables.names[: s.posterior.variables.n_robot_columns], matrix=s.posterior.named()
        ),
        posterior=posterior_of(s.posterior),
        links=None if robot.urdf is None else (robot.urdf.base_link, robot.urdf.tip_link),
        frame_estimate=next(iter(frames.values()), None),
        frames=frames,
        observability=observability_of(found.identifiability),
        options=choices_of(options),
        versions=dict(versions()),
        inputs=job.inputs,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        carried=Carried.make(job=job.document),
    )


def _solver(s: PartsSolution) -> Solver:
    """What the solver did; the cost at the start is not that of before where frame, base or tool are estimated too."""
    return Solver(
        name=IN_PARTS,
        converged=s.converged,
        message=s.message,
        iterations=s.iterations,
        initial_cost=0.5 * float(s.at_start.triangle[:, -1] @ s.at_start.triangle[:, -1]) if _is_before(s) else None,
        cost=0.5 * s.chi2,
        seconds=s.seconds,
        history=tuple(Step.make(cost=i.cost, damping=i.damping, step=i.step, decrement=i.decrement) for i in s.history),
    )


def _is_before(s: PartsSolution) -> bool:
    """Whether the start is the arm as drawn with nothing left to fit: neither measurement frame nor base nor tool.

    These are fitted to some rows only before.
    """
    of_joints = range(1, s.robot.n_joints + 1)
    return not s.options.unknown_frame and all(p.owner in of_joints for p in s.robot.parameters if p.estimated)


def _residual_rms(s: PartsSolution) -> dict[str, dict[str, Rms | None]]:
    """RMS of the train rows by kind."""
    before = s.at_start.rms if _is_before(s) else {}
    train = {
        kind: Rms(before=before.get(kind), after=s.reduced.rms[kind]) if kind in s.reduced.rms else None
        for kind in dict.fromkeys((*KINDS, *s.reduced.rms))
    }
    return {"train": train, "test": dict.fromkeys(train)}


def write_result_of_parts(folder: Path | str, result: Result, found: AssessedParts) -> None:
    """Write `result.json`, the calibrated robot and, of pairs, `configurations.csv` into a folder, all or none.

    Args:
        folder: Where to.
        result: What `result.json` holds.
        found: What it was made of.

    Raises:
        InputError: The folder cannot be written.
    """

    def write(into: Path) -> None:
        write_calibrated_robot(into, found.solution.robot)
        digests = {}
        if found.configurations is not None:
            _write_configurations(into / "configurations.csv", found.configurations, found.solution.robot)
            digests["configurations.csv"] = digest_of(into / "configurations.csv")
        document = result.document() | {"files": digests}
        write_text(into / "result.json", json.dumps(document, indent=1, allow_nan=False) + "\n")

    fill_folder(Path(folder), write, RESULT_FILES)


def _write_configurations(path: Path, m: Measurements, robot: Robot) -> None:
    """One line a configuration: its readings, and where the calibrated tool is (from the base)."""
    tool = pose(robot, m.readings).position
    columns: dict[str, Any] = {
        "id": Words(m.ids.tolist(), np.arange(m.n_configurations)),
        "split": Words(("train", "test"), m.test.astype(np.int64)),
        **{f"q{i + 1}": m.readings[:, i] for i in range(robot.n_joints)},
        **{f"tool_{axis}": tool[:, i] for i, axis in enumerate("xyz")},
    }
    write_csv_parts(path, [columns])
