"""The arm: its parameters and conventions, its chain, forward and inverse kinematics."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.robot.inverse": "Inverse solve_inverse",
        "fg_calib.robot.kinematics": "pose",
        "fg_calib.robot.model": "Robot",
    },
)
