"""Results as text, documents and figures."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.report.compare": "comparison_document format_comparison write_comparison",
        "fg_calib.report.inspect": "format_identifiability format_inspection inspection_document "
        "observability_document write_observability",
        "fg_calib.report.text": "format_result",
    },
)
