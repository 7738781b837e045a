"""What rows say of a solution: covariance, residuals, goodness of fit, outliers, variance components."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.statistics.cross_validation": "cross_validate",
        "fg_calib.statistics.priors": "estimate_tolerances",
        "fg_calib.statistics.variance_components": "estimate_noise",
    },
)
