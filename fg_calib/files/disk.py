"""Files on disk: readable, or a clear line; written whole, or not at all."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from tempfile import mkdtemp

from fg_calib.errors import InputError

_noted: ContextVar[dict[Path, str] | None] = ContextVar("_noted", default=None)


@contextmanager
def noting_reads() -> Iterator[dict[Path, str]]:
    """The SHA-256 of the bytes of every file that is read in the block, by its path."""
    found: dict[Path, str] = {}
    token = _noted.set(found)
    try:
        yield found
    finally:
        _noted.reset(token)


def read_bytes(path: Path) -> bytes:
    """The content of a file.

    Raises:
        InputError: There is no such file, it may not be read, or it is a folder, a pipe or a device.
    """
    try:
        if path.is_dir():
            raise InputError(str(path), "is a folder", "a file")
        if path.exists() and not path.is_file():
            raise InputError(str(path), "is a pipe or a device", "a file")
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(str(path), "no such file") from None
    except PermissionError:
        raise InputError(str(path), "may not be read", hint="check the permissions of file and folder") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        found = f"cannot be read: {getattr(error, 'strerror', None) or error}"
        raise InputError(_short(str(path)), found, "a file") from None
    noted = _noted.get()
    if noted is not None:
        noted[path] = hashlib.sha256(content).hexdigest()
    return content


@contextmanager
def silent_stderr() -> Iterator[None]:
    """Nothing is written to the process's stderr in the block, by libraries in C or Rust either."""
    try:
        kept = os.dup(2)
    except OSError:  # there is no stderr
        yield
        return
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST_PATH else f"{text[: _LONGEST_PATH - 3]}..."


_LONGEST_PATH = 120


def decoded(content: bytes, name: str) -> str:
    """UTF-8 text, without a byte order mark.

    Raises:
        InputError: It is something else; the message names line and byte.
    """
    for mark, encoding in ((b"\xff\xfe", "UTF-16"), (b"\xfe\xff", "UTF-16")):
        if content.startswith(mark):
            raise InputError(name, f"{encoding} text", "UTF-8 text", "save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        hint = "is it Latin-1 or Windows text? save it as UTF-8"
        raise InputError(f"{name}:{line}", f"byte {content[error.start]:#04x}", "UTF-8 text", hint) from None


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, without a byte order mark.

    Raises:
        InputError: There is no such file, or it is not UTF-8.
    """
    return decoded(read_bytes(path), path.name)


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
