"""What the tool will miss by, and what to command."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.prediction.correction": "correct",
        "fg_calib.prediction.predict": "write_prediction",
        "fg_calib.prediction.prediction": "PredictedErrors",
        "fg_calib.robot.reaching": "Correction",
    },
)
