"""The cache of compiled kernels: what is damaged or cannot be written is compiled anew."""

import importlib.util
from pathlib import Path

import pytest

from fg_calib.robot import cache

KERNEL = """
from fg_calib.robot.kernels import compiled

@compiled
def twice(x):
    return 2.0 * x
"""


def kernel(folder):
    """A kernel of a module in the folder, loaded anew."""
    file = folder / "kernel.py"
    if not file.exists():
        file.write_text(KERNEL)
    spec = importlib.util.spec_from_file_location("kernel", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.twice


def hits(found):
    return sum(found.stats.cache_hits.values())


def test_a_kernel_is_compiled_once(tmp_path):
    first = kernel(tmp_path)
    assert (first(1.5), hits(first)) == (3.0, 0)
    again = kernel(tmp_path)
    assert (again(1.5), hits(again)) == (3.0, 1)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize(
    "damage", [lambda c: b"", lambda c: c[: len(c) // 2], lambda c: c[:-40] + bytes(40), lambda c: b"x" * len(c)]
)
def test_a_damaged_cache_is_made_anew(tmp_path, ending, damage):
    kernel(tmp_path)(1.5)
    (file,) = (tmp_path / "__pycache__").glob(f"*.{ending}")
    file.write_bytes(damage(file.read_bytes()))
    found = kernel(tmp_path)
    assert (found(1.5), hits(found)) == (3.0, 0)
    again = kernel(tmp_path)
    assert (again(1.5), hits(again)) == (3.0, 1)


def test_a_cache_that_cannot_be_written_is_none(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache._CheckedFiles, "_open_for_write", full)
    found = kernel(tmp_path)
    assert (found(1.5), hits(found)) == (3.0, 0)
    assert [*Path(tmp_path / "__pycache__").glob("*.nb?")] == []
