"""numba, without settings of the current folder: `from fg_calib.robot.compiler import numba`."""

from __future__ import annotations

import os

from fg_calib.errors import InputError
from fg_calib.libraries import without_settings

_FILE = ".numba_config.yaml"

with without_settings(_FILE, "NUMBA_*"):
    import numba
    from numba.core import config, event
    from numba.core.caching import FunctionCache, IndexDataCacheFile
    from numba.core.runtime import rtsys as runtime

__all__ = ["FunctionCache", "IndexDataCacheFile", "event", "has_cache_folder", "numba", "runtime"]

config._config_fname = ""  # it is looked for again whenever a function is compiled

if config.DISABLE_JIT:  # the kernels count on integers of 64 bits, which numpy's are not where they are small
    raise InputError("NUMBA_DISABLE_JIT in the environment", f"found {os.environ.get('NUMBA_DISABLE_JIT')!r}", "none")


def has_cache_folder() -> bool:
    """Whether compiled kernels have a place that does not depend on the current folder: who has no home has none."""
    given = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~"))
    return os.path.isabs(given)
