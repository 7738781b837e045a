from .correction import Correction, correct_targets
from .tool_pose import (
    ExpectedError,
    PoseRms,
    ToolErrors,
    ToolPoseUncertainty,
    base_chain,
    errors_at,
    expected_error,
    judged_configurations,
    pose_rms,
    predict_poses,
    tool_derivatives,
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
    "base_chain",
    "correct_targets",
    "errors_at",
    "expected_error",
    "judged_configurations",
    "pose_rms",
    "predict_errors",
    "predict_poses",
    "summed_up",
    "tool_derivatives",
]
