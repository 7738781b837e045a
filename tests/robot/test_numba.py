"""Compilation of kernels: cached between processes, announced, and possible where nothing can be written."""

import importlib.util

import numba

from fg_calib.robot import _numba

KERNEL = """
from fg_calib.robot._numba import compiled

@compiled
def twice(x):
    return 2.0 * x
"""


def load_kernel(folder):
    """A kernel of a module in the folder, loaded anew."""
    file = folder / "kernel.py"
    file.write_text(KERNEL)
    spec = importlib.util.spec_from_file_location("kernel", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.twice


def cache_hits(kernel):
    return sum(kernel.stats.cache_hits.values())


def test_a_kernel_is_compiled_once_an_installation(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(_numba._CompileNotice, "said", False)
    first = load_kernel(tmp_path)
    assert (first(1.5), cache_hits(first)) == (3.0, 0)
    again = load_kernel(tmp_path)
    assert (again(1.5), cache_hits(again)) == (3.0, 1)
    assert caplog.messages == ["compiling the kernels: some seconds, once an installation"]


def test_kernels_compile_where_no_cache_can_be_written(tmp_path, monkeypatch, caplog):
    compile_function = numba.njit

    def without_cache(cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return compile_function(**options)

    monkeypatch.setattr(_numba._CompileNotice, "said", False)
    monkeypatch.setattr(_numba._CompileNotice, "cached", True)
    monkeypatch.setattr(_numba.numba, "njit", without_cache)
    assert load_kernel(tmp_path)(1.5) == 3.0
    (notice,) = caplog.messages
    assert notice.endswith("each time, unless NUMBA_CACHE_DIR is a folder that can be written")
