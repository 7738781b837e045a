from .export import Export, measured_configurations

__all__ = [
    "Export",
    "measured_configurations",
]
