"""Measurements from recordings, images and other people's tables."""
