"""Readers and writers, one a format; the only place of units."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.io.columns": "Column",
        "fg_calib.io.job": "read_job",
        "fg_calib.io.result": "Result read_result",
        "fg_calib.io.robot_file": "read_robot write_robot",
        "fg_calib.io.tables": "Targets read_measurements read_targets",
        "fg_calib.io.units": "Units",
        "fg_calib.io.urdf": "read_urdf",
    },
)
