"""Files on disk: readable, or a clear line; written whole, or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
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
        raise InputError(_short(str(path)), "no such file") from None
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


_WRITING, _WRITTEN = ".fg-calib-writing-", ".fg-calib-written"
"""Folders within a folder that is filled: while files are written, and when all are there but not yet moved."""


def fill_folder(folder: Path, write: Callable[[Path], None], together: Sequence[str] = ()) -> None:
    """Let `write` write files that then appear in a folder, all of them or none.

    They are written to a folder within it, which is renamed when all of them are there: from then on they count as
    written. Only then they are moved to their places; what interrupts that is made good by `finish` (see there), which
    everything that reads from such a folder or writes to it calls first. Renaming within one folder is atomic on local
    disks and network mounts, also where the folder itself is a mount or its parent may not be written.

    Args:
        folder: Where the files appear.
        write: Writes them to the folder that it is given.
        together: Files that belong together: those of an earlier time that are not written now are removed.

    Raises:
        InputError: The folder cannot be written.
    """
    missing = [f for f in (folder, *folder.parents) if not f.exists()]
    temporary = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _clear_dead(folder)
        temporary = Path(mkdtemp(prefix=f"{_WRITING}{_here()}-", dir=folder))
        write(temporary)
        names = [file.name for file in temporary.iterdir()]
        for file in temporary.iterdir():
            if (folder / file.name).is_dir():
                raise InputError(str(folder / file.name), "is a folder", "a place for a file")
        while True:
            finish(folder)
            try:
                temporary.rename(folder / _WRITTEN)
                break
            except OSError as error:  # another writer's files came between
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
        temporary = None
        finish(folder)
        for name in set(together).difference(names):
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            str(folder), f"cannot be written: {error.strerror or error}", "a folder that can be"
        ) from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
            _remove_empty(missing)


def require_writable(folder: Path) -> None:
    """Check that files can be written to a folder, which need not exist.

    Raises:
        InputError: They cannot.
    """
    missing = [f for f in (folder, *folder.parents) if not f.exists()]
    fill_folder(folder, lambda _: None)
    _remove_empty(missing)


def _remove_empty(folders: Iterable[Path]) -> None:
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def require_absent(folder: Path, names: Iterable[str]) -> None:
    """Check that files that would be replaced are not there.

    Raises:
        InputError: One is.
    """
    for name in names:
        if (folder / name).exists():
            raise InputError(str(folder / name), "is there already", "a folder without it")


def finish(folder: Path) -> None:
    """Move files to their places that were written to a folder by a process that ended before it had moved them.

    Raises:
        InputError: They cannot be moved.
    """
    written = folder / _WRITTEN
    try:
        files = sorted(written.iterdir())
    except OSError:
        return
    for file in files:
        try:
            file.replace(folder / file.name)
        except FileNotFoundError:  # another process moves them too
            continue
        except OSError as error:
            found = f"holds files that could not be moved to their places: {error.strerror or error}"
            raise InputError(str(folder), found, f"those of {_WRITTEN} in it") from None
    with suppress(OSError):
        written.rmdir()


def _clear_dead(folder: Path) -> None:
    """Remove what processes of this machine left half written when they were killed."""
    for left in folder.glob(f"{_WRITING}{socket.gethostname()}-*"):
        process = left.name.rpartition("-")[0].rpartition("-")[2]
        if process.isdigit() and not _runs(int(process)):
            shutil.rmtree(left, ignore_errors=True)


def _here() -> str:
    return f"{socket.gethostname()}-{os.getpid()}"


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
