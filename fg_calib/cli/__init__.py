"""The command line, one module a command: the only place that prints."""

from fg_calib.cli.entry import app, main
from fg_calib.cli.example import EXAMPLES

__all__ = ["EXAMPLES", "app", "main"]
