"""Files on disk: readable, or a clear line; written whole, or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import socket
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from tempfile import mkdtemp
from typing import ParamSpec, TypeVar

from fg_calib.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")

NO_MEMORY = "there is not enough memory for it"

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


def within_memory(read: Callable[P, R]) -> Callable[P, R]:
    """A reader of tables that names its table, the argument `path`, where memory does not suffice for it.

    It raises `InputError` then.
    """

    @wraps(read)
    def reading(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return read(*args, **kwargs)
        except MemoryError:
            table = args[0] if args else kwargs["path"]
            name = Path(table).name if isinstance(table, str | os.PathLike) else "frame"
            raise InputError(name, NO_MEMORY) from None

    return reading


def require_memory(name: str, size: int) -> None:
    """Raise, for a table of this name, where so many bytes cannot be had: polars would end the process instead."""
    try:
        bytes(size)  # zeros, which the system hands out when they are first looked at
    except MemoryError:
        raise InputError(name, NO_MEMORY) from None


def read_bytes(path: Path) -> bytes:
    """The content of a file.

    Raises:
        InputError: There is no such file, it may not be read, or it is a folder, a pipe or a device.
    """
    content = _looked_into(path, Path.read_bytes)
    noted = _noted.get()
    if noted is not None:
        noted[path] = hashlib.sha256(content).hexdigest()
    return content


def file_at(path: Path) -> Path:
    """Where a file stands that somebody else is to read, some of it at a time.

    Raises:
        InputError: There is no such file, it may not be read, or it is a folder, a pipe or a device.
    """
    noted = _noted.get()

    def look(found: Path) -> Path:
        with found.open("rb") as file:
            if noted is not None:
                noted[path] = hashlib.file_digest(file, "sha256").hexdigest()
        return found

    return _looked_into(path, look)


def _looked_into(path: Path, look: Callable[[Path], R]) -> R:
    """What is found in a file, wherever it stands.

    Raises:
        InputError: There is no such file, it may not be read, or it is a folder, a pipe or a device.
    """
    try:
        return _content(_newest(path), path, look)
    except FileNotFoundError:
        raise InputError(_short(str(path)), "no such file") from None
    except PermissionError:
        raise InputError(str(path), "may not be read", hint="check the permissions of file and folder") from None
    except MemoryError:
        raise InputError(_short(str(path)), NO_MEMORY) from None
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        found = f"cannot be read: {getattr(error, 'strerror', None) or error}"
        raise InputError(_short(str(path)), found, "a file") from None


def digest_of(path: Path) -> str:
    """SHA-256 of a file that was written, read piece by piece.

    Raises:
        InputError: There is no such file, or it may not be read.
    """
    try:
        with _newest(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(_short(str(path)), f"cannot be read: {error.strerror or error}", "a file") from None


def _content(found: Path, path: Path, look: Callable[[Path], R]) -> R:
    """What is found in what stands for a path."""
    try:
        mode = found.stat().st_mode
        if stat.S_ISDIR(mode):
            raise InputError(str(path), "is a folder", "a file")
        if not stat.S_ISREG(mode):
            raise InputError(str(path), "is a pipe or a device", "a file")
        return look(found)
    except FileNotFoundError:
        if found.parent.name != _WRITTEN:
            raise
        return look(path)  # it was moved to its place in the meantime


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST_PATH else f"{text[: _LONGEST_PATH - 3]}..."


_LONGEST_PATH = 120


def decoded(content: bytes, name: str) -> str:
    """UTF-8 text, without a byte order mark.

    Raises:
        InputError: It is something else; the message names line and byte.
    """
    for encoding, marks in _WIDE.items():
        if content.startswith(marks):
            raise InputError(name, f"{encoding} text", "UTF-8 text", "save it as UTF-8")
    if b"\0" in content:
        line = content.partition(b"\0")[0].count(b"\n") + 1
        hint = "is it UTF-16, or no text at all? save it as UTF-8"
        raise InputError(f"{name}:{line}", "a null character", "UTF-8 text", hint)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        hint = "is it Latin-1 or Windows text? save it as UTF-8"
        raise InputError(f"{name}:{line}", f"byte {content[error.start]:#04x}", "UTF-8 text", hint) from None


_WIDE = {"UTF-32": (b"\xff\xfe\0\0", b"\0\0\xfe\xff"), "UTF-16": (b"\xff\xfe", b"\xfe\xff")}
"""Encodings and the marks with which their texts begin."""


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, without a byte order mark.

    Raises:
        InputError: There is no such file, or it is not UTF-8.
    """
    return decoded(read_bytes(path), path.name)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file, which takes the place of `path` when the block ends well and vanishes when it does not.

    It is in a folder of its own beside that: nobody else can have put a file there.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    if not path.parent.is_dir():
        raise InputError(str(path), f"there is no folder {path.parent}")
    within = None
    try:
        within = _made_in(path.parent, _BESIDE)
        yield within / path.name
        (within / path.name).replace(path)
    except OSError as error:
        raise InputError(str(path), f"cannot be written: {error.strerror or error}") from None
    finally:
        if within is not None:
            shutil.rmtree(within, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text that appears whole or not at all.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode())


RESERVED = ".fg-calib-"
"""How all names begin that are used here while files are written."""

_BESIDE = f"{RESERVED}file-"
"""Folder beside a file that is written."""

_WRITING, _WRITTEN, _REMOVED = f"{RESERVED}writing-", f"{RESERVED}written", f"{RESERVED}removed"
"""Folders within a folder that is filled: while files are written, and when all are there but not yet moved; and in the
latter the list of files that are to be removed."""


def fill_folder(folder: Path, write: Callable[[Path], None], own: Mapping[str, bytes] | None = None) -> None:
    """Let `write` write files that then appear in a folder, all of them or none.

    They are written to a folder within it, which is renamed when all of them are there: from then on they count as
    written, and `read_bytes` reads them there. Only then they are moved to their places, and files of an earlier time
    removed; what interrupts that, the next that fills the folder makes good. Renaming within one folder is atomic on
    local disks and network mounts, also where the folder itself is a mount or its parent may not be written.

    Args:
        folder: Where the files appear.
        write: Writes them to the folder that it is given.
        own: What may be written, and replaced: see `require_own`. What is not written now is removed.

    Raises:
        InputError: The folder cannot be written, or holds other files in their places.
    """
    own = own or {}
    missing = _missing(folder)
    temporary = None
    try:
        temporary = _begun(folder)
        write(temporary)
        names = [file.name for file in temporary.iterdir()]
        for name in names:
            if (folder / name).is_dir():
                raise InputError(str(folder / name), "is a folder", "a place for a file")
        if left := sorted(set(own).difference(names)):
            (temporary / _REMOVED).write_text("\n".join(left))
        while True:
            _finish(folder)
            require_own(folder, own)
            try:
                temporary.rename(folder / _WRITTEN)
                break
            except OSError as error:  # another writer's files came between
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
        temporary = None
        _finish(folder)
    except InputError as error:  # of a file, where it was to appear
        place = error.place.replace(str(temporary), str(folder))
        raise InputError(place, error.found, error.expected, error.hint) from error
    except OSError as error:
        raise InputError(
            str(folder), f"cannot be written: {error.strerror or error}", "a folder that can be"
        ) from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
            _remove_empty(missing)


@dataclass(frozen=True)
class Filling:
    """What is to appear in a folder: see `fill_folder`.

    Attributes:
        folder: Where.
        write: Writes the files to the folder that it is given.
        own: What may be written, and replaced.
    """

    folder: Path
    write: Callable[[Path], None]
    own: Mapping[str, bytes]


def fill_folders(fillings: Sequence[Filling]) -> None:
    """Fill several folders, all of them or none: the files of all are written before any of them appear.

    Args:
        fillings: What is to appear where.

    Raises:
        InputError: A folder cannot be written, or holds other files in their places.
    """
    for one in fillings:
        require_own(one.folder, one.own)
    if fillings:
        first, *others = fillings

        def write(into: Path) -> None:
            first.write(into)
            fill_folders(others)

        fill_folder(first.folder, write, first.own)


def _begun(folder: Path) -> Path:
    """A new folder to write to, in a folder that is made if it is not there."""
    for _ in range(_TRIES):
        with suppress(FileNotFoundError):  # another writer has made it, looked whether it can, and removed it
            folder.mkdir(parents=True, exist_ok=True)
            clear_dead(folder)
            return _made_in(folder, f"{_WRITING}{_here()}-")
    folder.mkdir(parents=True, exist_ok=True)
    return _made_in(folder, f"{_WRITING}{_here()}-")


_TRIES = 10
"""How often a folder that is gone is made again."""


def _made_in(folder: Path, prefix: str) -> Path:
    """A new folder in another, by the other's own path: one that leads there from the root need not be open to us."""
    return folder / Path(mkdtemp(prefix=prefix, dir=folder)).name


def require_writable(folder: Path) -> None:
    """Check that files can be written to a folder, which need not exist.

    Raises:
        InputError: They cannot.
    """
    missing = _missing(folder)
    fill_folder(folder, lambda _: None)
    _remove_empty(missing)


def _missing(folder: Path) -> list[Path]:
    """The folder and those above it that are not there.

    Raises:
        InputError: It has a name that no folder can have.
    """
    try:
        return [f for f in (folder, *folder.parents) if not f.exists()]
    except (OSError, ValueError) as error:
        found = f"cannot be written: {getattr(error, 'strerror', None) or error}"
        raise InputError(_short(str(folder)), found, "a folder that can be") from None


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
        if os.path.lexists(folder / name):  # also a link to nothing
            raise InputError(str(folder / name), "is there already", "a folder without it")


def require_own(folder: Path, own: Mapping[str, bytes]) -> None:
    """Check that files that would be replaced or removed were written by the same command.

    Args:
        folder: Where they are.
        own: Names of what the command writes, and how each begins. The first says of all others whose they are, as some
            begin as anybody's may.

    Raises:
        InputError: One was not, it cannot be read, or it is another user's and not to be replaced.
    """
    first = next(iter(own), "")
    for name, beginning in own.items():
        found = _beginning(folder / name, len(beginning))
        if found is None:
            continue
        # The first is looked at after it: other writers may have come between.
        if found != beginning or _beginning(folder / first, len(own[first])) != own[first]:
            raise InputError(str(folder / name), "is there already, not written by this command", "another folder")
        if not _may_replace(folder / name, os.geteuid()):
            raise InputError(str(folder / name), "is another user's in a folder that all share", "another folder")


def _may_replace(path: Path, user: int) -> bool:
    """Whether a user who may write to a file's folder may replace or remove it: not all may, if the folder is sticky.

    A file that is not there may be put there.
    """
    folder = path.parent.stat()
    with suppress(FileNotFoundError):
        return not folder.st_mode & stat.S_ISVTX or user in (0, folder.st_uid, path.lstat().st_uid)
    return True


def _beginning(path: Path, size: int) -> bytes | None:
    """How a file begins; None where there is none.

    Raises:
        InputError: It is a folder, a pipe or a device, or a link that leads nowhere.
    """
    for found in (_newest(path), path):  # again: it may have been moved to its place in the meantime
        try:
            if not stat.S_ISREG(found.stat().st_mode):
                raise InputError(str(path), "is no file", "a place for a file")
            with found.open("rb") as file:
                return file.read(size)
        except FileNotFoundError:
            if found.is_symlink():
                raise InputError(str(path), "is a link to nothing", "a place for a file") from None
            continue
        except OSError:
            return b""
    return None


def exists(path: Path) -> bool:
    """Whether there is a file or folder; in a folder that was filled, what counts as written."""
    try:
        return _newest(path).exists()
    except (OSError, ValueError):  # a name that no file can have
        return False


def stamp(path: Path) -> tuple[int, int] | None:
    """What is another when a file has been written anew, as `exists` sees it; None where none can be read."""
    try:
        found = _newest(path).stat()
    except (OSError, ValueError, InputError):
        return None
    return found.st_ino, found.st_mtime_ns


def is_folder(path: Path) -> bool:
    """Whether there is a folder; none has a name that no file can have."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def _newest(path: Path) -> Path:
    """Where a file stands that was written but not yet moved to its place; else the path.

    Nothing is moved to read it, as the folder may be another's.

    Raises:
        InputError: Somebody else wrote it than the folder's owner or this user, or it may not be read.
    """
    written = path.parent / _WRITTEN
    foreign = InputError(str(written), "files of another user", "none", _OF_ANOTHER)
    try:
        user = written.lstat().st_uid
        if user not in (os.geteuid(), path.parent.stat().st_uid) and not _may_replace(path, user):
            return path  # whose place theirs can never take
        with _opened(written) as journal:
            if os.fstat(journal).st_uid not in (os.geteuid(), path.parent.stat().st_uid):
                raise foreign
            if path.name in os.listdir(journal):
                return written / path.name
            return path.parent / _REMOVED / path.name if path.name in _removed(journal) else path
    except PermissionError:
        if os.access(path.parent, os.X_OK):
            raise foreign from None
        return path
    except (OSError, ValueError):  # none, or none of ours: a file or link; ValueError: a path with a null character
        return path


_OF_ANOTHER = "have them moved to their places or removed, or use another folder"


@contextmanager
def _opened(folder: Path) -> Iterator[int]:
    """A descriptor of a folder, not of what a link leads to."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _removed(journal: int) -> list[str]:
    """Names of files that are to be removed from the folder in which a folder of written files is."""
    try:
        descriptor = os.open(_REMOVED, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=journal)
    except FileNotFoundError:
        return []
    with os.fdopen(descriptor, encoding="utf-8", errors="replace") as file:
        return [name for name in file.read().split("\n") if name and Path(name).name == name]


def _finish(folder: Path) -> None:
    """Move files to their places that were written to a folder and are not yet there, and remove earlier ones.

    All of it goes through a descriptor of the folder that holds them: when another process is done with that, it is
    gone, and nothing more is moved out of it or, which is how files are removed, into it.

    Raises:
        InputError: They cannot be moved, or this user has not written them.
    """
    written = folder / _WRITTEN
    try:
        with _opened(written) as journal:
            _require_mine(written, journal)
            names = sorted(set(os.listdir(journal)) - {_REMOVED})
            for name in _removed(journal):
                _rename(folder / name, name + _REMOVED, None, journal)
            for name in names:
                if name.endswith(_REMOVED):
                    continue
                _rename(name, folder / name, journal, None)
            for name in os.listdir(journal):
                if name.endswith(_REMOVED) and name != _REMOVED:
                    _unlink(name, journal)
            _unlink(_REMOVED, journal)
    except FileNotFoundError:
        return
    except OSError as error:
        if error.errno in (errno.ENOTDIR, errno.ELOOP):
            raise InputError(str(written), "is no folder of written files", "none", "remove it") from None
        if error.errno in (errno.EACCES, errno.EPERM) and written.lstat().st_uid != os.geteuid():
            raise InputError(str(written), "files of another user", "none", _OF_ANOTHER) from None
        found = f"holds files that could not be moved to their places: {error.strerror or error}"
        raise InputError(str(folder), found, f"those of {_WRITTEN} in it") from None
    with suppress(OSError):
        written.rmdir()


def _require_mine(written: Path, journal: int) -> None:
    """Check that this user wrote a folder of written files, and that it holds nothing but files.

    Raises:
        InputError: It is not so.
    """
    if os.fstat(journal).st_uid != os.geteuid():
        raise InputError(str(written), "files of another user", "none", _OF_ANOTHER)
    for name in os.listdir(journal):
        with suppress(FileNotFoundError):  # another process moves them too
            if not stat.S_ISREG(os.stat(name, dir_fd=journal, follow_symlinks=False).st_mode):
                raise InputError(str(written / name), "is no file", "files alone", "remove it")


def _rename(source: Path | str, target: Path | str, source_in: int | None, target_in: int | None) -> None:
    with suppress(FileNotFoundError):  # another process did it
        os.replace(source, target, src_dir_fd=source_in, dst_dir_fd=target_in)


def _unlink(name: str, folder: int) -> None:
    with suppress(FileNotFoundError):
        os.unlink(name, dir_fd=folder)


def clear_dead(folder: Path) -> None:
    """Remove what this user's processes of this machine, or container, left half written when they were killed."""
    for left in folder.glob(f"{_WRITING}{_host()}-*"):
        process = left.name.rpartition("-")[0].rpartition("-")[2]
        with suppress(FileNotFoundError):
            if process.isdigit() and not _runs(int(process)) and left.lstat().st_uid == os.geteuid():
                shutil.rmtree(left, ignore_errors=True)


def _here() -> str:
    return f"{_host()}-{os.getpid()}"


def _host() -> str:
    """Within what a process has its number: the machine's name, and the namespace of numbers where there are such."""
    try:
        return f"{socket.gethostname()}-{os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:
        return socket.gethostname()


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
