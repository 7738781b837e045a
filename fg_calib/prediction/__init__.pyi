from .correction import Correction, correct_targets
from .tool_pose import (
    ExpectedError,
    PoseRms,
    ToolErrors,
    ToolPoseUncertainty,
    errors_at,
    expected_error,
    judged_configurations,
    pose_rms,
    predict_poses,
)
from .workspace import PredictedErrors, Responsible, WorstConfiguration, predict_errors, summed_up

__all__ = [
    "Correction",
    "ExpectedError",
    "PoseRms",
    "PredictedErrors",
    "Responsible",
    "ToolErrors",
    "ToolPoseUncertainty",
    "WorstConfiguration",
    "correct_targets",
    "errors_at",
    "expected_error",
    "judged_configurations",
    "pose_rms",
    "predict_errors",
    "predict_poses",
    "summed_up",
]
