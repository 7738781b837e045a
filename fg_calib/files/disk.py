"""Files on disk: readable, or a clear line; written whole, or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp

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


def fill_folder(folder: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a new folder, and move its files into `folder` once all of them are there.

    Raises:
        InputError: The folder cannot be written.
    """
    temporary = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        write(temporary)
        if not folder.exists():
            temporary.chmod(0o777 & ~_umask())
            temporary.rename(folder)
        else:
            for file in sorted(temporary.iterdir()):
                file.replace(folder / file.name)
    except OSError as error:
        raise InputError(
            str(folder), f"cannot be written: {error.strerror or error}", "a folder that can be"
        ) from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
