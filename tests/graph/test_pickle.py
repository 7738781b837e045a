"""Problems and solutions go to worker processes and come back the same to the last bit."""

import copy
import json
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, small_arm, true_robot
from touches import TOOL_POINT, corners, touch

from fg_calib import Calibration, assess, build_problem, solve

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3, "tool": 1e-3}

CASES = {
    "pose in an unknown frame": {"model": "pose", "frame": "unknown"},
    "star by a robust loss": {"model": "distance-rotation", "loss": "huber"},
    "kept parameters": {"model": "distance-rotation", "gauge": "keep"},
    "joint values of contact points": {"model": "distance", "encoder": "estimated"},
}


def problem(name):
    rng = np.random.default_rng(5)
    if "contact points" in name:
        robot = small_arm(TOLERANCE, estimate=TOOL_POINT)
        true = true_robot(robot, rng)
        m = touch(true, corners(true, 2, rng), 10, rng, distances=[(0, 1, 1e-4)])
        return build_problem(robot, replace(m, sigma_joint=np.full(4, 1e-4)), **CASES[name])
    robot = small_arm(TOLERANCE, estimate=TOOL if "frame" in name else ())
    frame = (Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.5, 1.0, -0.3]))
    return build_problem(robot, measure(true_robot(robot, rng), 14, rng, frame=frame, n_test=3), **CASES[name])


def through_pickle(thing):
    return pickle.loads(pickle.dumps(thing))


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("name", "again"), [*((c, through_pickle) for c in CASES), ("kept parameters", copy.deepcopy)])
def test_nothing_changes_on_the_way(name, again):
    given = problem(name)
    found = solve(given)
    anew = solve(again(given))
    assert (anew.cost, anew.iterations) == (found.cost, found.iterations)
    assert np.array_equal(anew.parameters, found.parameters)
    assert again(found).problem.graph.error(found.values) == found.problem.graph.error(found.values)
    assessed = assess(found)
    date = "2026-01-01T00:00:00+00:00"
    results = [Calibration.of(found, of, date=date) for of in (assessed, assess(again(found)), again(assessed))]
    documents = [one.result.document() for one in results]
    assert json.dumps(documents[1]) == json.dumps(documents[0])
    assert json.dumps(documents[2]) == json.dumps(documents[0])


ONCE = """
import pickle, sys
sys.path[:0] = sys.argv[1:]
from test_pickle import problem
from fg_calib import Calibration, assess, solve
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
