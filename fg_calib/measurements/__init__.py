"""What was measured, in memory: configurations, kinds of measurement, how pairs are formed."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.measurements.dataset": "Measurements Noise",
        "fg_calib.initialization.camera": "Camera",
        "fg_calib.measurements.table": "CustomMeasurements KnownPoint Table",
    },
)
