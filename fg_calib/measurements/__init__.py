"""What was measured, in memory: configurations, kinds of measurement, how pairs are formed."""
