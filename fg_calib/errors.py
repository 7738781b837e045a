"""The exceptions of the package: each message is one line that a user can act on."""


class CalibrationError(Exception):
    """Base of every error the package raises on purpose."""


class InputError(CalibrationError):
    """What the user gave cannot be used as it is.

    The message is one line in a fixed order, so that every module words it alike:
    `place: found, expected; hint`.

    Args:
        place: File, with row or key where there is one: `poses.csv:17`, `robot.yaml: joints[2].a`.
        found: What stands there.
        expected: What should stand there.
        hint: A likely cause or cure, where there is one.
    """

    def __init__(self, place: str, found: str, expected: str = "", hint: str = "") -> None:
        self.place = place
        self.found = found
        self.expected = expected
        self.hint = hint
        message = f"{place}: {found}"
        if expected:
            message += f", expected {expected}"
        if hint:
            message += f"; {hint}"
        super().__init__(" ".join(message.split()))


class ProblemError(InputError):
    """Readable input that does not make a solvable calibration problem."""


class SolverError(CalibrationError):
    """The solver could not do its work at all (a doubtful result is a `Status`, not this)."""
