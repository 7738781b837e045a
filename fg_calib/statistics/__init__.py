"""What rows say of a solution: covariance, residuals, goodness of fit, outliers, variance components."""
