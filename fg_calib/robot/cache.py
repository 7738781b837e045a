"""Numba's cache of compiled kernels, with a checksum: LLVM ends the process when it is handed damaged machine code.

A file that is damaged counts as none, so its kernel is compiled anew; so it is where the cache cannot be written. What
is cached is loaded without all that numba knows to compile, which takes longer than the machine code.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from fg_calib.robot.compiler import FunctionCache, IndexDataCacheFile, runtime

_SIZE = hashlib.sha256().digest_size


class _CheckedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """The index and the data of one kernel's cache, each behind the SHA-256 of its content."""

    def save(self, key: object, data: object) -> None:
        """Save an entry, if the disk takes it."""
        with suppress(OSError):
            super().save(key, data)

    def _load_index(self) -> dict[Any, str]:
        found = _read(self._index_path)
        if found is None or found[0] != (self._version, self._source_stamp):
            return {}
        overloads: dict[Any, str] = found[1]
        return overloads

    def _save_index(self, overloads: dict[Any, str]) -> None:
        self._write(self._index_path, ((self._version, self._source_stamp), overloads))

    def _load_data(self, name: str) -> Any:
        return _read(self._data_path(name))

    def _save_data(self, name: str, data: object) -> None:
        self._write(self._data_path(name), data)

    def _write(self, path: str, content: object) -> None:
        data = self._dump(content)
        with self._open_for_write(path) as file:
            file.write(hashlib.sha256(data).digest() + data)


class _LightCache(FunctionCache):  # type: ignore[misc]
    """A kernel's cache, from which it is loaded with numba's runtime alone: compiling asks for the rest by itself."""

    def load_overload(self, sig: object, target_context: Any) -> Any:
        """The kernel of a signature; None if it is not there."""
        runtime.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def check_cache(kernel: Callable[..., Any]) -> None:
    """Have a kernel's cache checked wherever it is read; as numba has it if this numba has another kind of cache."""
    cache = getattr(kernel, "_cache", None)
    files = getattr(cache, "_cache_file", None)
    if type(cache) is FunctionCache and type(files) is IndexDataCacheFile:
        cache.__class__, files.__class__ = _LightCache, _CheckedFiles


def _read(path: str) -> Any:
    """What was written to a file; None if there is none, or it is damaged."""
    try:
        content = Path(path).read_bytes()
    except OSError:
        return None
    checksum, data = content[:_SIZE], content[_SIZE:]
    return pickle.loads(data) if hashlib.sha256(data).digest() == checksum else None
