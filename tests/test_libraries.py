"""The folder where a program runs, and a wrong environment, set nothing in libraries."""

import os
import subprocess
import sys

import pytest

DRAW = """
from fg_calib import InputError
try:
    from fg_calib import Measurements, Robot
    from fg_calib.report.figures import _figure
    from fg_calib.robot import kernels
    figure, _ = _figure(1.0, 1.0)
    import matplotlib
    Measurements.from_frame({"q1": [0.0]}, Robot.from_dh([[1, 0, 0, 0]], convention="dh"))
    print(matplotlib.rcParams["text.usetex"])
except InputError as error:
    print(error)
"""


def ended(folder, **variables):
    """What a program in a folder prints that draws a figure and loads the kernels: in stdout, or in stderr."""
    environment = {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p), **os.environ, **variables}
    ran = subprocess.run([sys.executable, "-c", DRAW], cwd=folder, env=environment, capture_output=True, text=True)  # noqa: PLW1510
    return ran.stdout.strip(), ran.stderr


FILES = ["text.usetex: True", b"\xff".decode("latin-1")]


@pytest.mark.slow
@pytest.mark.parametrize("matplotlib", FILES)
def test_files_of_the_current_folder_set_nothing(tmp_path, matplotlib):
    (tmp_path / "matplotlibrc").write_bytes(matplotlib.encode("latin-1"))
    assert ended(tmp_path) == ("False", "")
    assert [f.name for f in tmp_path.iterdir()] == ["matplotlibrc"]


WRONG = [
    ("POLARS_MAX_THREADS", "0", "POLARS_MAX_THREADS in the environment: found '0', expected a number above 0"),
    ("NUMBA_DISABLE_JIT", "1", "NUMBA_DISABLE_JIT in the environment: found '1', expected none"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "value", "expected"), WRONG)
def test_a_wrong_environment_is_one_line(tmp_path, name, value, expected):
    assert ended(tmp_path, **{name: value}) == (expected, "")


FORK = """
import os, sys
from fg_calib import InputError
from fg_calib.io.csv_writer import write_csv
from fg_calib.io.frames import as_polars
from fg_calib.io.parquet import parquet_columns
as_polars({"a": [1.0]}, "t")
if os.fork() == 0:
    for use in (lambda: as_polars({"a": [1.0]}, "t"), lambda: parquet_columns(b"", "t"), lambda: write_csv("t", {})):
        try:
            use()
        except InputError as error:
            print(error, flush=True)
    os._exit(0)
os.wait()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks on this system")
def test_a_fork_of_a_process_that_has_loaded_polars_is_refused(tmp_path):
    ran = subprocess.run([sys.executable, "-c", FORK], cwd=tmp_path, capture_output=True, text=True, timeout=60)  # noqa: PLW1510
    line = "t: polars does not work in a fork of a process that has loaded it; use multiprocessing.get_context"
    assert ran.stdout == f'{line}("spawn") or "forkserver"\n' * 3
