"""Whether a calibration still holds by new data, what has changed, and its update."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.monitoring.check": "Check Explanation",
    },
)
