"""`fg-calib compare`."""

from pathlib import Path
from typing import Annotated

from fg_calib.cli.output import Json, argument, end, option, show_result


def compare(
    job: Annotated[Path, argument("JOB|OLD", "The job, such as calibration.yaml; or an older result.")],
    new: Annotated[Path | None, argument("[NEW]", "A newer result, to compare with the older.")] = None,
    out: Annotated[Path | None, option("--out", "DIR", "Write comparison.json there.")] = None,
    as_json: Json = False,
) -> None:
    """Compare the factor graph with plain least squares on the same job, or a new result with an old one."""
    from fg_calib import baseline, io
    from fg_calib.report import compare as report
    from fg_calib.report import write_document

    if new is not None:
        both, files = (io.read_result(job), io.read_result(new)), (job, new)
        show_result(
            as_json, lambda: report.changes_document(*both, files), lambda: report.build_changes_report(*both, files)
        )
        return
    found = baseline.comparison.compare(io.read_job(job))
    if out is not None:
        write_document(out, "comparison.json", report.comparison_document(found))
    show_result(as_json, lambda: report.comparison_document(found), lambda: report.build_comparison_report(found))
    end(found.findings)
