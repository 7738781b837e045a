"""The factor graph: variables, factors, whitening, start, problem and solver."""
