"""`fg-calib example`."""

from pathlib import Path
from typing import Annotated

from fg_calib import cli, inputs
from fg_calib.cli.output import argument, option, say_next


def example(
    name: Annotated[str, argument("NAME", "The example: space-robot.")],
    out: Annotated[Path, option("--out", "DIR", "Folder to write it to.")],
) -> None:
    """Write a ready job to try the package on: robot, measurements and calibration.yaml."""
    from fg_calib.io import fill_folder, require_absent

    known = sorted(folder.name for folder in cli.EXAMPLES.iterdir() if folder.is_dir())
    if name not in known:
        raise inputs.InputError("example", f"found {name!r}", f"one of {', '.join(known)}")
    files = {file.name: file.read_bytes() for file in sorted((cli.EXAMPLES / name).iterdir()) if file.is_file()}
    require_absent(out, files)
    fill_folder(out, files)
    say_next([*files], out)
