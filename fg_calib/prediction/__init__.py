"""Expected errors of the tool, and commands that correct them."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.prediction.correction": "Correction correct_targets",
        "fg_calib.prediction.tool_pose": "ExpectedError PoseRms ToolErrors ToolPoseUncertainty expected_error",
        "fg_calib.prediction.workspace": "PredictedErrors predict_errors",
    },
)
