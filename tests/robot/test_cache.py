"""The cache of compiled kernels: what is damaged or cannot be written is compiled anew."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fg_calib.robot import cache, kernels

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


@pytest.mark.slow
def test_a_kernel_is_compiled_once(tmp_path):
    first = kernel(tmp_path)
    assert (first(1.5), hits(first)) == (3.0, 0)
    again = kernel(tmp_path)
    assert (again(1.5), hits(again)) == (3.0, 1)


@pytest.mark.sampled(1)
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


@pytest.mark.parametrize(("there", "often"), [(True, "once an installation"), (False, "each time, unless NUMBA_CACHE")])
def test_it_is_said_whether_kernels_will_be_compiled_again(tmp_path, monkeypatch, caplog, there, often):
    monkeypatch.setattr(kernels._CompileNotice, "said", False)
    monkeypatch.setattr(kernels._CompileNotice, "kept", True)
    monkeypatch.setattr(kernels, "has_cache_folder", lambda: there)
    kernel(tmp_path)(1.5)
    (notice,) = caplog.messages
    assert notice.startswith(f"compiling the kernels: some seconds, {often}")


def test_a_cache_that_cannot_be_written_is_none(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache._CheckedFiles, "_open_for_write", full)
    found = kernel(tmp_path)
    assert (found(1.5), hits(found)) == (3.0, 0)
    assert [*Path(tmp_path / "__pycache__").glob("*.nb?")] == []


@pytest.mark.slow
def test_a_cached_kernel_is_loaded_without_what_compiling_needs(tmp_path):
    """Of numba's declarations, which take longer to load than a kernel, nothing; and the second kernel is compiled."""
    (tmp_path / "kernel.py").write_text(KERNEL + "\n@compiled\ndef sines(x):\n    return np.sin(x) + np.empty(3)\n")
    code = "import numpy as np, sys; import kernel; kernel.np = np; print(kernel.twice(1.5), 'numba.typed.dictimpl' in "
    code += "sys.modules); print(kernel.sines(np.zeros(3)).shape, 'numba.typed.dictimpl' in sys.modules)"
    path = os.pathsep.join([str(tmp_path), str(Path(cache.__file__).parents[2])])
    found = []
    for _ in range(3):
        if len(found) == 1:
            for file in (tmp_path / "__pycache__").glob("kernel.sines*"):
                file.unlink()
        command = [sys.executable, "-c", code]
        env = os.environ | {"PYTHONPATH": path}
        found.append(subprocess.run(command, env=env, capture_output=True, text=True, check=False))
    assert [(run.stdout, run.returncode) for run in found] == [
        ("3.0 True\n(3,) True\n", 0), ("3.0 False\n(3,) True\n", 0), ("3.0 False\n(3,) False\n", 0)
    ]  # fmt: skip
