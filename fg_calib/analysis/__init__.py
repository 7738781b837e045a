"""What a solution is worth: rank and reasons, covariance, goodness of fit, what may be wrong."""
