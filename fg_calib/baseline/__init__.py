"""Plain least squares, and the comparison with it."""
