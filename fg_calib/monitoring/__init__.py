"""Whether a calibration still holds by new data, what has changed, and its update."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
