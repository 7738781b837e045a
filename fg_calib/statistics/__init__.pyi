from .acceptance import LEAST, Acceptance, Judgement, accept
from .covariance import Spread, TangentCovariance, covariance_of_rows, spread_of, with_left_out
from .cross_validation import CrossValidation, cross_validate
from .estimates import Estimates, FrameEstimate, JointErrors, LandmarkEstimate, ParameterEstimate, estimates_at
from .goodness_of_fit import (
    CONFIDENCE,
    FACTOR,
    FLAGS,
    OUTLIER_WEIGHT,
    PREDICTION_VERDICTS,
    VERDICTS,
    ChiSquare,
    Fit,
    GrossErrors,
    KindFit,
    PredictedFit,
    chi_square,
    judge_fit,
    upper_probability,
)
from .outliers import judge_without_outliers
from .priors import PriorFit, estimate_tolerances, judge_priors
from .residual_table import MAX_OUTLIER_SHARE, HeldOut, ResidualTable
from .variance_components import LEAST_REDUNDANCY, estimate_noise, has_joint_noise

__all__ = [
    "CONFIDENCE",
    "FACTOR",
    "FLAGS",
    "LEAST",
    "LEAST_REDUNDANCY",
    "MAX_OUTLIER_SHARE",
    "OUTLIER_WEIGHT",
    "PREDICTION_VERDICTS",
    "VERDICTS",
    "Acceptance",
    "ChiSquare",
    "CrossValidation",
    "Estimates",
    "Fit",
    "FrameEstimate",
    "GrossErrors",
    "HeldOut",
    "JointErrors",
    "Judgement",
    "KindFit",
    "LandmarkEstimate",
    "ParameterEstimate",
    "PredictedFit",
    "PriorFit",
    "ResidualTable",
    "Spread",
    "TangentCovariance",
    "accept",
    "chi_square",
    "covariance_of_rows",
    "cross_validate",
    "estimate_noise",
    "estimate_tolerances",
    "estimates_at",
    "has_joint_noise",
    "judge_fit",
    "judge_priors",
    "judge_without_outliers",
    "spread_of",
    "upper_probability",
    "with_left_out",
]
