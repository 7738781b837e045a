"""Closed-form and linear starts of frames, landmarks and boards."""
