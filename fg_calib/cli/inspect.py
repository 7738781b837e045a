"""`fg-calib inspect`."""

from pathlib import Path
from typing import Annotated

from fg_calib.cli.output import Json, argument, end, show_result


def inspect(job: Annotated[Path, argument("JOB", "The job, such as calibration.yaml.")], as_json: Json = False) -> None:
    """Say what a job holds, what looks wrong with it, and what it can determine, without solving it."""
    from fg_calib import diagnostics, io
    from fg_calib.report import build_inspection_report, inspection_document

    given = io.read_job(job)
    found = diagnostics.inspect_job(given)
    show_result(as_json, lambda: inspection_document(found, given), lambda: build_inspection_report(found, given))
    end(found.findings, "look at this first")
