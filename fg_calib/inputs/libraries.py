"""Libraries that take long to import, or that a forked process must not share: imported when first used."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__all__ = ["etree", "optimize", "pl"]


class _Library:
    """A module that is imported when something of it is first asked for."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(import_module(self._name), attribute)


if TYPE_CHECKING:
    import polars as pl
    from lxml import etree
    from scipy import optimize
else:
    pl, etree, optimize = map(_Library, ("polars", "lxml.etree", "scipy.optimize"))
