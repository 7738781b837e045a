from .comparison import ESTIMATORS, Comparison, Estimate, RealErrors, compare, real_errors
from .least_squares import LeastSquares, fit_least_squares

__all__ = [
    "ESTIMATORS",
    "Comparison",
    "Estimate",
    "LeastSquares",
    "RealErrors",
    "compare",
    "fit_least_squares",
    "real_errors",
]
