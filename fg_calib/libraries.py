"""Former name of `parallel`."""

from fg_calib.parallel import require_polars

__all__ = ["require_polars"]
