"""The calibrated arm as others read it: one module a format, and the door to all of them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
