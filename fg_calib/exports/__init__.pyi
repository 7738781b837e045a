from .export import Export, with_names

__all__ = ["Export", "with_names"]
