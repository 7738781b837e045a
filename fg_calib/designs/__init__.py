"""Where to measure: candidates, and which of them tell most."""
