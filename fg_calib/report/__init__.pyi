from .charts import write_charts
from .compare import build_history, comparison_document, format_comparison, history_document, write_comparison
from .design import build_design_report, design_document, write_design
from .figures import Drawn, error_slices
from .html import build_page, draw_figures, parameter_table_html
from .inspect import (
    build_identifiability_report,
    build_inspection_report,
    format_identifiability,
    format_inspection,
    inspection_document,
    observability_document,
    write_observability,
)
from .monitor import build_check_report, check_document
from .predict import (
    build_correction_report,
    build_prediction_report,
    correction_document,
    prediction_document,
    require_commands,
    write_commands,
    write_prediction_table,
)
from .tables import SHOWN, WIDTH, figure, in_order, indented, line, plain, section, shortened, table_of, width_for
from .text import build_report, format_result, judged, notes_of, summary

__all__ = [
    "SHOWN",
    "WIDTH",
    "Drawn",
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
    "error_slices",
    "figure",
    "format_comparison",
    "format_identifiability",
    "format_inspection",
    "format_result",
    "history_document",
    "in_order",
    "indented",
    "inspection_document",
    "judged",
    "line",
    "notes_of",
    "observability_document",
    "parameter_table_html",
    "plain",
    "prediction_document",
    "require_commands",
    "section",
    "shortened",
    "summary",
    "table_of",
    "width_for",
    "write_charts",
    "write_commands",
    "write_comparison",
    "write_design",
    "write_observability",
    "write_prediction_table",
]
