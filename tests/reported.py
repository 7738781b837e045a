"""The report and the document of a solution and its assessment."""

from fg_calib.calibration import Calibration
from fg_calib.report.compare import build_comparison_report
from fg_calib.report.tables import plain_text
from fg_calib.report.text import format_result


def format_report(solution, assessed, width=100):
    return format_result(Calibration.of(solution, assessed).report_data, width)


def result_document(solution, assessed, inputs=None):
    return Calibration.of(solution, assessed, inputs=inputs).result.document()


def format_comparison(comparison):
    return plain_text(build_comparison_report(comparison))
