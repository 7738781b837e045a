"""Files on disk: readable, or a clear line; written whole, or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fg_calib.errors import InputError


def require_file(path: Path) -> None:
    """Check that there is a readable file at `path`.

    Raises:
        InputError: There is not.
    """
    if path.is_dir():
        raise InputError(str(path), "is a folder", "a file")
    if not path.exists():
        raise InputError(str(path), "no such file")
    if not os.access(path, os.R_OK):
        raise InputError(str(path), "may not be read", hint="check the file's permissions")


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, without a byte order mark.

    Raises:
        InputError: There is no such file, or it is not UTF-8.
    """
    require_file(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise InputError(f"{path.name}:{line}", f"byte {error.object[error.start]:#04x}", "UTF-8 text") from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside `path`, which takes its place when the block ends well and vanishes when it does not.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    if not path.parent.is_dir():
        raise InputError(str(path), f"there is no folder {path.parent}")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise InputError(str(path), f"cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text that appears whole or not at all.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode())
