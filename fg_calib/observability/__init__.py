"""Which parameters measurements determine, and why not the others."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.observability.identifiability": "Identifiability observe_configurations observe_structure",
    },
)
