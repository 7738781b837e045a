"""Errors, array types, checks of what comes from outside, and every choice of a calibration."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
