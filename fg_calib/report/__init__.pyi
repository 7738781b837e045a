from .compare import (
    build_check_report,
    build_history,
    check_document,
    comparison_document,
    history_document,
    write_comparison,
)
from .design import build_design_report, design_document, write_design
from .html import build_page, draw_figures, parameter_table_html
from .inspect import (
    build_identifiability_report,
    build_inspection_report,
    inspection_document,
    observability_document,
    write_observability,
)
from .predict import (
    build_correction_report,
    build_prediction_report,
    correction_document,
    prediction_document,
    write_commands,
    write_prediction,
)
from .tables import WIDTH, in_order, line, plain, report, section, shortened, shown_in, table_of, width_for
from .text import ReportData, build_report, format_result, judged, notes_of, summary

__all__ = [
    "WIDTH",
    "ReportData",
    "build_check_report",
    "build_correction_report",
    "build_design_report",
    "build_history",
    "build_identifiability_report",
    "build_inspection_report",
    "build_page",
    "build_prediction_report",
    "build_report",
    "check_document",
    "comparison_document",
    "correction_document",
    "design_document",
    "draw_figures",
    "format_result",
    "history_document",
    "in_order",
    "inspection_document",
    "judged",
    "line",
    "notes_of",
    "observability_document",
    "parameter_table_html",
    "plain",
    "prediction_document",
    "report",
    "section",
    "shortened",
    "shown_in",
    "summary",
    "table_of",
    "width_for",
    "write_commands",
    "write_comparison",
    "write_design",
    "write_observability",
    "write_prediction",
]
