"""The calibrated arm as others read it: one module a format, and the door to all of them."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.exports.export": "Export",
    },
)
