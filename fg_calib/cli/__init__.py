"""The command line, one module a command: the only place that prints."""

from pathlib import Path

EXAMPLES = Path(__file__).parents[1] / "examples"
"""The bundled examples, a folder each."""


def main() -> None:
    """Run the command line."""
    from fg_calib.cli.entry import run

    run()
