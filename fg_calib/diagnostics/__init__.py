"""What is wrong with a set-up, a model or a solution, and the verdict on it."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.diagnostics.inspection": "Inspection inspect_job",
        "fg_calib.diagnostics.setup_check": "SetupCheck check_setup",
    },
)
