"""Files: read or refused in one line, and written whole or not at all."""

import hashlib
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from tempfile import TemporaryDirectory

from fg_calib.inputs import InputError, expect

_noted: ContextVar[dict[Path, str] | None] = ContextVar("_noted", default=None)


@contextmanager
def noting_reads() -> Iterator[dict[Path, str]]:
    """The SHA-256 of the bytes of every file that is read in the block, by its path."""
    digests: dict[Path, str] = {}
    token = _noted.set(digests)
    try:
        yield digests
    finally:
        _noted.reset(token)


def read_bytes(path: Path) -> bytes:
    """The content of a file.

    Raises:
        InputError: There is no such file, it may not be read, or it is a folder, a pipe or a device.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise InputError(str(path), "is a folder" if stat.S_ISDIR(mode) else "is a pipe or a device", "a file")
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(str(path), "no such file") from None
    except (OSError, ValueError, MemoryError) as error:  # ValueError: a path with a null character
        found = f"cannot be read: {getattr(error, 'strerror', None) or error or 'there is not enough memory for it'}"
        raise InputError(str(path), found, "a file that can be") from None
    if (noted := _noted.get()) is not None:
        noted[path] = hashlib.sha256(content).hexdigest()
    return content


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, without a byte order mark.

    Raises:
        InputError: There is no such file, or it is not UTF-8.
    """
    return decoded(read_bytes(path), path.name)


def decoded(content: bytes, name: str, other: str = "") -> str:
    """UTF-8 text, without a byte order mark, or text in another encoding where it is not UTF-8.

    Raises:
        InputError: The text is neither; the message names the line and the byte.
    """
    at, found = content.find(b"\0"), "a null character"
    if at < 0:
        try:
            return content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            at, found = error.start, f"byte {content[error.start]:#04x}"
            with suppress(UnicodeDecodeError, LookupError):
                return content.decode(other)
    line = content.count(b"\n", 0, at) + 1
    raise InputError(f"{name}:{line}", found, "UTF-8 text", "is it UTF-16, Latin-1 or Windows text? save it as UTF-8")


exists, is_folder = os.path.exists, os.path.isdir
"""Whether there is a file, a folder; False for a name that nothing can have."""


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text, whole or not at all.

    Raises:
        InputError: The folder does not exist or may not be written to.
    """
    content = text.encode()
    expect(is_folder(path.parent), str(path), f"there is no folder {path.parent}")
    try:
        with TemporaryDirectory(prefix=".fg-calib-", dir=path.parent, ignore_cleanup_errors=True) as made:
            Path(made, path.name).write_bytes(content)
            os.replace(Path(made, path.name), path)  # on the same disk, where a move is atomic
    except OSError as error:
        raise InputError(str(path), f"cannot be written: {error.strerror or error}") from None


File = str | bytes | Callable[[Path], object]
"""What a file holds, or a function that writes it to the path that it is given, after those before it."""


def fill_folder(folder: Path, files: Mapping[str, File], own: Mapping[str, bytes] | None = None) -> None:
    """Write several files to a folder, after all of them were written to another folder.

    An interruption while they are moved may leave old files with new ones. The first of `own` is moved last: where it
    holds digests of the others, a reader detects that.

    Args:
        folder: Where the files appear; it is made if it does not exist.
        files: The files by name.
        own: Files that may be written, replaced, and removed if they are not written now: see `require_own`.

    Raises:
        InputError: The folder cannot be written, or holds other files of these names.
    """
    own = own or {}
    last = next(iter(own), "")
    missing = [f for f in (folder, *folder.parents) if not exists(f)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".fg-calib-", dir=folder, ignore_cleanup_errors=True) as made:
            try:
                for name, content in files.items():
                    if callable(content):
                        content(Path(made, name))
                    else:
                        Path(made, name).write_bytes(content.encode() if isinstance(content, str) else content)
            except InputError as error:
                place = error.place.replace(made, str(folder))
                raise InputError(place, error.found, error.expected, error.hint) from error
            names = sorted((file.name for file in Path(made).iterdir()), key=lambda name: name == last)
            require_own(folder, own)
            for name in set(own).difference(names):
                (folder / name).unlink(missing_ok=True)
            for name in names:
                os.replace(Path(made, name), folder / name)
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        found = f"cannot be written: {getattr(error, 'strerror', None) or error}"
        raise InputError(str(folder), found, "a folder that can be") from error
    finally:
        for parent in missing:  # where nothing was written, they are empty
            with suppress(OSError, ValueError):
                parent.rmdir()


def require_writable(folder: Path) -> None:
    """Check that files can be written to a folder, which need not exist.

    Raises:
        InputError: A file cannot be written.
    """
    fill_folder(folder, {})


def require_absent(folder: Path, names: Iterable[str]) -> None:
    """Check that files that would be replaced do not exist.

    Raises:
        InputError: One does.
    """
    for path in (folder / name for name in names):  # also a link to nothing
        expect(not os.path.lexists(path), str(path), "is there already", "a folder without it")


def require_own(folder: Path, own: Mapping[str, bytes]) -> None:
    """Check that files that would be replaced or removed were written by the same command.

    Args:
        folder: Where they are.
        own: Names of what the command writes, and how each begins. The first identifies the others, as some begin with
            nothing that is typical.

    Raises:
        InputError: One was not.
    """
    first = next(iter(own), "")
    for name, beginning in own.items():
        if os.path.lexists(path := folder / name):
            expect(path.is_file(), str(path), "is no file", "a place for a file")
            ours = _begins(path, beginning) and _begins(folder / first, own[first])
            expect(ours, str(path), "is there already, not written by this command", "another folder")


def _begins(path: Path, beginning: bytes) -> bool:
    with suppress(OSError), path.open("rb") as file:
        return file.read(len(beginning)) == beginning
    return False
