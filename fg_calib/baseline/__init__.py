"""Plain least squares, and the comparison with it."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.baseline.comparison": "Comparison compare real_errors",
        "fg_calib.baseline.least_squares": "LeastSquares fit_least_squares",
    },
)
