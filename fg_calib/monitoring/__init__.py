"""Whether a calibration still holds by new data, what has changed, and its update."""
