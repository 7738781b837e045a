"""Robots and measurements to try things on."""
