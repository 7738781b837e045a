"""Problems and solutions go to worker processes and come back the same to the last bit."""

import copy
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, is_dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import gtsam
import numpy as np
import pytest
import scipy.sparse
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, small_arm, true_robot
from touches import TOOL_POINT, corners, touch

from fg_calib import assess, build_problem, solve

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3, "tool": 1e-3}

CASES = {
    "pose in an unknown frame": {"model": "pose", "frame": "unknown"},
    "star by a robust loss": {"model": "distance-rotation", "loss": "huber"},
    "kept parameters": {"model": "distance-rotation", "gauge": "keep"},
    "joint values of touched points": {"model": "distance", "encoder": "estimated"},
}


def problem(name):
    rng = np.random.default_rng(5)
    if "touched points" in name:
        robot = small_arm(TOLERANCE, estimate=TOOL_POINT)
        true = true_robot(robot, rng)
        m = touch(true, corners(true, 2, rng), 10, rng, distances=[(0, 1, 1e-4)])
        return build_problem(robot, replace(m, sigma_joint=np.full(4, 1e-4)), **CASES[name])
    robot = small_arm(TOLERANCE, estimate=TOOL if "frame" in name else ())
    frame = (Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.5, 1.0, -0.3]))
    return build_problem(robot, measure(true_robot(robot, rng), 14, rng, frame=frame, n_test=3), **CASES[name])


def same(a, b):
    """Whether two things hold the very same figures; GTSAM's graph by what it says of the start."""
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, gtsam.Values):
        return a.keys() == b.keys() and pickle.dumps(a) == pickle.dumps(b)
    if isinstance(a, gtsam.NonlinearFactorGraph):
        return a.size() == b.size()
    if isinstance(a, scipy.sparse.csr_array):
        return same((a.data, a.indices, a.indptr), (b.data, b.indices, b.indptr))
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.compare)
    if hasattr(a, "__dict__") and not callable(a):
        return type(a) is type(b) and same(vars(a), vars(b))
    return a == b or (a != a and b != b)


def through_pickle(thing):
    return pickle.loads(pickle.dumps(thing))


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("name", "again"),
    [*((name, through_pickle) for name in CASES), ("kept parameters", copy.deepcopy)],
)
def test_nothing_changes_on_the_way(name, again):
    given = problem(name)
    found = solve(given)
    assert same(again(given), given)
    assert same(again(found), found)
    assert again(found).problem.graph.error(found.values) == found.problem.graph.error(found.values)
    uncertainty = assess(found)
    assert same(assess(again(found)), uncertainty)
    assert same(again(uncertainty), uncertainty)
    assert again(uncertainty).identifiability.lost == uncertainty.identifiability.lost
    anew = solve(again(given))
    assert (anew.cost, anew.iterations) == (found.cost, found.iterations)
    assert np.array_equal(anew.parameters, found.parameters)


ONCE = """
import pickle, sys
sys.path[:0] = sys.argv[1:]
from test_pickle import problem
from fg_calib import assess, solve
from fg_calib.robot import kernels
for name in ("pose in an unknown frame", "star by a robust loss"):
    assess(pickle.loads(pickle.dumps(solve(pickle.loads(pickle.dumps(problem(name)))))))
compiled = [f for f in vars(kernels).values() if hasattr(f, "signatures")]
print({"readonly" in str(argument) for f in compiled for signature in f.signatures for argument in signature})
"""


@pytest.mark.slow
def test_kernels_are_not_compiled_again_for_read_only_arrays():
    """Which would take seconds."""
    here = Path(__file__).parent
    command = [sys.executable, "-c", ONCE, str(here), str(here.parent)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "{False}\n"


@pytest.mark.slow
def test_a_worker_process_returns_solutions():
    """Spawned, not forked: a process of its own that has only what was sent to it."""
    problems = [problem("pose in an unknown frame"), problem("star by a robust loss")]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(solve, problems))
    for one, here in zip(found, map(solve, problems), strict=True):
        assert np.array_equal(one.parameters, here.parameters)
        assert one.cost == here.cost
        assert np.array_equal(assess(one).covariance, assess(here).covariance, equal_nan=True)
