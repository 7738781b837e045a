"""Parquet, read by a process of its own.

Some damaged files make polars abort, or allocate without end, and the process that it is in with it: no error, no line.
So another process reads them, one for all files. It is handed the bytes of a file and hands back columns; where it ends
instead, or takes too long, the file is named.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from io import BytesIO
from threading import Event, Lock, Timer
from typing import TYPE_CHECKING

from fg_calib.errors import InputError
from fg_calib.libraries import require_polars

if TYPE_CHECKING:  # polars is imported where it is used: `fg-calib --help` need not wait for it
    import polars as pl

_SECONDS, _SECONDS_A_BYTE = 60.0, 1e-6
"""After which a file counts as one that never ends: a hundred times what ordinary ones take."""

_READ = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from io import BytesIO
import polars as pl
source, sink = sys.stdin.buffer, sys.stdout.buffer
while head := source.readline():
    columns, size = json.loads(head)
    content, found, error = BytesIO(source.read(size)), BytesIO(), ""
    try:
        if columns is None:
            found.write(json.dumps(list(pl.read_parquet_schema(content))).encode())
        else:
            pl.read_parquet(content, columns=columns).write_ipc(found)
    except BaseException as caught:
        panic = type(caught).__name__ == "PanicException"
        error = "polars cannot read it" if panic else str(caught).strip().partition("\\n")[0] or type(caught).__name__
    answer = b"" if error else found.getvalue()
    sink.write(json.dumps([error, len(answer)]).encode() + b"\\n" + answer)
    sink.flush()
"""
"""What the process does: a line `[columns, size]` and the file in, a line `[error, size]` and the answer out."""


def parquet_columns(content: bytes, name: str) -> list[str]:
    """Names of the columns of a Parquet file.

    Args:
        content: Its bytes.
        name: Its name, for messages.

    Raises:
        InputError: It is damaged.
    """
    return list(json.loads(_READER.ask(None, content, name)))


def read_parquet(content: bytes, columns: Sequence[int], name: str) -> pl.DataFrame:
    """Columns of a Parquet file, by their numbers in ascending order.

    Args:
        content: Its bytes.
        columns: Numbers of the columns.
        name: Its name, for messages.

    Raises:
        InputError: It is damaged.
    """
    import polars as pl

    return pl.read_ipc(BytesIO(_READER.ask(list(columns), content, name)))


class _Reader:
    """The process that reads, started when it is first needed and again after it has ended."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0  # a fork of the owner has its pipes, but is not to be answered
        self._lock = Lock()

    def ask(self, columns: list[int] | None, content: bytes, name: str) -> bytes:
        """Columns as Arrow's IPC file, or the names of all as JSON if None."""
        require_polars(name)  # which also keeps a fork from a lock that nobody opens
        with self._lock:
            process = self._started(name)
            seconds, late = _SECONDS + _SECONDS_A_BYTE * len(content), Event()

            def end() -> None:
                late.set()
                process.kill()

            waiting = Timer(seconds, end)
            waiting.start()
            try:
                error, answer = _exchange(process, columns, content)
            except (OSError, ValueError):  # it has ended
                self.stop()
                if late.is_set():  # of a damaged file, or because it was stopped
                    found = f"polars took more than {seconds:.3g} s to read it"
                    raise InputError(name, found, hint="try again; if it is damaged, write it anew") from None
                raise InputError(name, "not a Parquet file: polars ends on it", hint="write it anew") from None
            except BaseException:  # such as Ctrl-C: what it would still answer is to nobody's question
                self.stop()
                raise
            finally:
                waiting.cancel()
        if error:
            raise InputError(name, f"not a Parquet file: {error}", hint="write it anew")
        return answer

    def _started(self, name: str) -> subprocess.Popen[bytes]:
        if self._process is None or self._owner != os.getpid() or self._process.poll() is not None:
            path = json.dumps([folder for folder in sys.path if folder])  # not the folder where the files are
            command = [sys.executable, "-I", "-c", _READ, path]
            pipe = subprocess.PIPE
            try:
                self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL)
            except OSError as error:
                found = f"cannot be read: no process can be started for it: {error.strerror or error}"
                raise InputError(name, found, hint="a CSV needs none") from None
            self._owner = os.getpid()
        return self._process

    def stop(self) -> None:
        """End the process, if there is one."""
        process, self._process = self._process, None
        if process is not None and self._owner == os.getpid():
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                with suppress(OSError):
                    if pipe is not None:
                        pipe.close()


def _exchange(process: subprocess.Popen[bytes], columns: list[int] | None, content: bytes) -> tuple[str, bytes]:
    """Question and answer.

    Raises:
        OSError: The process has ended, or ends while it reads.
        ValueError: The same: the answer is cut off.
    """
    source, sink = process.stdin, process.stdout
    if source is None or sink is None:
        raise ValueError("a process without pipes")
    source.write(json.dumps([columns, len(content)]).encode() + b"\n" + content)
    source.flush()
    error, size = json.loads(sink.readline())
    answer = sink.read(size)
    if len(answer) != size:
        raise ValueError("an answer that is cut off")
    return error, answer


_READER = _Reader()
atexit.register(_READER.stop)
