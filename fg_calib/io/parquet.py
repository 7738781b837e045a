"""Parquet, read by a process of its own.

Some damaged files make polars abort, or allocate without end, and the process that it is in with it: no error, no line.
So another process reads them, one for all files. It is handed the bytes of a file and hands back columns; where it ends
instead, or takes too long, the file is named. Of a file that is larger than memory should be it is told the place, and
reads there what the rows that are asked for take.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from threading import Event, Lock, Timer
from typing import IO, TYPE_CHECKING

from fg_calib.errors import InputError
from fg_calib.io.atomic import NO_MEMORY
from fg_calib.libraries import require_polars

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_SECONDS, _SECONDS_A_BYTE = 60.0, 1e-6
"""After which a file counts as one that never ends: a hundred times what ordinary ones take."""

_MEMORY_WORDS = (b"memory allocation of", b"MemoryError")
"""What polars and Python say before they end for want of memory."""

_SECONDS_TO_END = 5.0
"""After which a process whose pipes are closed has ended."""

_READ = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from io import BytesIO
import polars as pl
source, sink = sys.stdin.buffer, sys.stdout.buffer
while head := source.readline():
    columns, span, size = json.loads(head)
    if size is not None:
        content = BytesIO(source.read(size)) if type(size) is int else size
    found, error = BytesIO(), ""
    try:
        file = open(content, "rb") if type(content) is str else content
        if columns is None:
            found.write(json.dumps(list(pl.read_parquet_schema(file))).encode())
        elif not columns:
            found.write(json.dumps(pl.scan_parquet(file).select(pl.len()).collect().item()).encode())
        elif span is None:
            pl.read_parquet(file, columns=columns).write_ipc(found)
        else:
            pl.scan_parquet(file).select(pl.nth(*columns)).slice(*span).collect().write_ipc(found)
    except MemoryError:
        error = "memory"
    except BaseException as caught:
        panic = type(caught).__name__ == "PanicException"
        error = "polars cannot read it" if panic else str(caught).strip().partition("\\n")[0] or type(caught).__name__
        if type(caught) is OSError and not str(caught):  # so polars passes a MemoryError on
            error = "memory"
    answer = b"" if error else found.getbuffer()
    sink.write(json.dumps([error, len(answer)]).encode() + b"\\n")
    sink.write(answer)
    sink.flush()
"""
"""What the process does: a line `[columns, span, size]` and the file in, a line `[error, size]` and the answer out.

A span is the first row and how many at most, or null for all. A path instead of a size means the file that is there,
no size that of the question before. No columns ask for the number of rows, null for the names of all columns.
"""


def parquet_rows(content: bytes | Path, name: str) -> int:
    """Number of rows of a Parquet file.

    Args:
        content: Its bytes, or where it stands.
        name: Its name, for messages.

    Raises:
        InputError: It is damaged.
    """
    return int(json.loads(_READER.ask([], content, name)))


def parquet_columns(content: bytes | Path, name: str) -> list[str]:
    """Names of the columns of a Parquet file.

    Args:
        content: Its bytes, or where it stands.
        name: Its name, for messages.

    Raises:
        InputError: It is damaged.
    """
    return list(json.loads(_READER.ask(None, content, name)))


def read_parquet(
    content: bytes | Path, columns: Sequence[int], name: str, span: tuple[int, int] | None = None
) -> pl.DataFrame:
    """Columns of a Parquet file, by their numbers in ascending order.

    Args:
        content: Its bytes, or where it stands.
        columns: Numbers of the columns.
        name: Its name, for messages.
        span: The first row and how many at most; all if None. The file is kept for the next rows until there are less.

    Raises:
        InputError: It is damaged, or memory does not suffice for it.
    """
    import polars as pl

    answer = _READER.ask(list(columns), content, name, span)
    frame = pl.read_ipc(BytesIO(answer))
    if span is not None and frame.height < span[1]:
        _READER.forget()
    return frame


class _Reader:
    """The process that reads, started when it is first needed and again after it has ended."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] = BytesIO()  # what the process says on stderr
        self._kept: bytes | Path | None = None  # the file that the process is to keep
        self._owner = 0  # a fork of the owner has its pipes, but is not to be answered
        self._lock = Lock()

    def forget(self) -> None:
        """Keep no file."""
        self._kept = None

    def ask(
        self, columns: list[int] | None, content: bytes | Path, name: str, span: tuple[int, int] | None = None
    ) -> bytes:
        """Columns as Arrow's IPC file; as JSON the names of all if None, and the number of rows if there are none."""
        require_polars(name)  # which also keeps a fork from a lock that nobody opens
        with self._lock:
            process = self._started(name)
            seconds, late = _SECONDS + _SECONDS_A_BYTE * _size_of(content), Event()

            def end() -> None:
                late.set()
                process.kill()

            waiting = Timer(seconds, end)
            waiting.start()
            try:
                error, answer = _exchange(process, columns, span, None if content is self._kept else content)
                self._kept = None if span is None else content
            except (OSError, ValueError):  # it has ended
                no_memory = self._ended_for_memory(process)
                self.stop()
                if late.is_set():  # of a damaged file, or because it was stopped
                    found = f"polars took more than {seconds:.3g} s to read it"
                    raise InputError(name, found, hint="try again; if it is damaged, write it anew") from None
                if no_memory:
                    raise InputError(name, NO_MEMORY, hint="if it is damaged, write it anew") from None
                raise InputError(name, "not a Parquet file: polars ends on it", hint="write it anew") from None
            except BaseException:  # such as Ctrl-C: its answer would be taken for that to the next question
                self.stop()
                raise
            finally:
                waiting.cancel()
        if error == "memory":
            raise InputError(name, NO_MEMORY)
        if error:
            raise InputError(name, f"not a Parquet file: {error}", hint="write it anew")
        return answer

    def _started(self, name: str) -> subprocess.Popen[bytes]:
        if self._process is None or self._owner != os.getpid() or self._process.poll() is not None:
            path = json.dumps([folder for folder in sys.path if folder])  # not the folder where the files are
            command = [sys.executable, "-I", "-c", _READ, path]
            pipe = subprocess.PIPE
            try:
                self._said.close()
                self._said = TemporaryFile()  # noqa: SIM115 -- as long as the process
                self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._said)
            except OSError as error:
                found = f"cannot be read: no process can be started for it: {error.strerror or error}"
                raise InputError(name, found, hint="a CSV needs none") from None
            self._owner, self._kept = os.getpid(), None
        return self._process

    def _ended_for_memory(self, process: subprocess.Popen[bytes]) -> bool:
        """Whether a process that ends does so because it got no memory, or the system took it for using too much."""
        with suppress(subprocess.TimeoutExpired):
            process.wait(_SECONDS_TO_END)
        self._said.seek(0)
        said = self._said.read()
        return process.returncode == -signal.SIGKILL or any(word in said for word in _MEMORY_WORDS)

    def stop(self) -> None:
        """End the process, if there is one."""
        process, self._process, self._kept = self._process, None, None
        self._said.close()
        if process is not None and self._owner == os.getpid():
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                with suppress(OSError):
                    if pipe is not None:
                        pipe.close()


def _exchange(
    process: subprocess.Popen[bytes],
    columns: list[int] | None,
    span: tuple[int, int] | None,
    content: bytes | Path | None,
) -> tuple[str, bytes]:
    """Question and answer; of the file of the question before where there is no content.

    Raises:
        OSError: The process has ended, or ends while it reads.
        ValueError: The same: the answer is cut off.
    """
    source, sink = process.stdin, process.stdout
    if source is None or sink is None:
        raise ValueError("a process without pipes")
    where = len(content) if isinstance(content, bytes) else None if content is None else str(content.absolute())
    source.write(json.dumps([columns, span, where]).encode() + b"\n")
    source.write(content if isinstance(content, bytes) else b"")
    source.flush()
    error, size = json.loads(sink.readline())
    answer = sink.read(size)
    if len(answer) != size:
        raise ValueError("an answer that is cut off")
    return error, answer


def _size_of(content: bytes | Path) -> int:
    """Bytes of a file; none of one that is gone, which the process says."""
    if isinstance(content, bytes):
        return len(content)
    return content.stat().st_size if content.exists() else 0


_READER = _Reader()
atexit.register(_READER.stop)
