"""Which configurations to measure."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.designs.criteria": "Criterion",
        "fg_calib.designs.design": "Design",
    },
)
