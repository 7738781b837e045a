"""Readers and writers, one a format; the only place of units."""
