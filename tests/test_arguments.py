"""Whatever a public function is given, what is wrong with it is one line of the package's own."""

import inspect
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from simulated import measure, planar_robot

import fg_calib
from fg_calib import (
    Calibration,
    Comparison,
    InputError,
    Job,
    Options,
    Pairing,
    Robot,
    Table,
    Units,
    assess,
    build_problem,
    calibrate,
    calibrate_job,
    compare,
    comparison_document,
    cramer_rao,
    expand,
    format_report,
    multistart,
    observe_structure,
    pose,
    read_job,
    read_measurements,
    read_result,
    read_robot,
    simulate,
    solve,
    write_results,
)
from fg_calib.arguments import _hints, as_hinted

ROBOT = planar_robot(tolerance={"a": 1e-3, "theta": 1e-3})
TABLE = measure(ROBOT, 20, np.random.default_rng(0))
A_ROBOT = "a Robot, such as Robot.from_dh(...)"
A_TABLE = "a Measurements, a Table or a list of them, such as Measurements.from_arrays(...)"
A_PROBLEM = "a Problem, such as build_problem(robot, measurements)"
A_SOLUTION = "a Solution, such as solve(problem)"

MISTAKES = {
    "no measurements": (lambda: build_problem(ROBOT, None), f"measurements: found None, expected {A_TABLE}"),
    "no measurements at the front door": (
        lambda: calibrate(ROBOT, None),
        f"measurements: found None, expected {A_TABLE}",
    ),
    "a table that is none": (lambda: calibrate(ROBOT, [TABLE, 3]), "measurements[1]: found 3, expected a Measurements "
                             "or a Table, such as Measurements.from_arrays(...)"),
    "no robot": (lambda: build_problem(None, TABLE), f"robot: found None, expected {A_ROBOT}"),
    "the class Robot": (lambda: pose(Robot, [[0, 0]]),
                        f"robot: found <class 'fg_calib.robot.model.Robot'>, expected {A_ROBOT}"),
    "a robot's path": (lambda: read_measurements("poses.csv", "robot.yaml"),
                       f"robot: found 'robot.yaml', expected {A_ROBOT}"),
    "no job": (lambda: calibrate_job(None), "job: found None, expected a Job or a path, such as read_job('job.yaml')"),
    "no path of a job": (lambda: read_job(3), "path: found 3, expected a path"),
    "no path of a robot": (lambda: read_robot(b"robot.yaml"), "path: found b'robot.yaml', expected a path"),
    "no folder": (lambda: Calibration.load(None), "path: found None, expected a path"),
    "no result": (lambda: read_result([]), "path: found [], expected a path"),
    "nothing to compare": (lambda: compare("job.yaml"),
                           "job: found 'job.yaml', expected a Job, such as read_job('job.yaml')"),
    "nothing to solve": (lambda: solve(None), f"problem: found None, expected {A_PROBLEM}"),
    "nothing to expand": (lambda: expand(3), f"problem: found 3, expected {A_PROBLEM}"),
    "nothing to assess": (lambda: assess(None), f"solution: found None, expected {A_SOLUTION}"),
    "nothing to look about": (lambda: multistart({}), f"solution: found {{}}, expected {A_SOLUTION}"),
    "nothing to report": (lambda: format_report(None, None), f"solution: found None, expected {A_SOLUTION}"),
    "nothing to write": (lambda: write_results("out", 1, 2), f"solution: found 1, expected {A_SOLUTION}"),
    "nothing to simulate": (lambda: simulate("space-robot"),
                            "scenario: found 'space-robot', expected a Scenario, such as read_scenario('space-robot')"),
    "a bound of an array": (lambda: cramer_rao(ROBOT, np.zeros((9, 3)), model="pose"), "measurements: found ndarray of "
                            "shape (9, 3), expected a Measurements, a Table or a list of them, such as "
                            "Measurements.from_arrays(...)"),
    "options and keywords": (lambda: build_problem(ROBOT, TABLE, Options("pose"), frame="unknown"),
                             "options: both options and frame=..., expected one of the two"),
    "a job without options": (lambda: Job(None, ROBOT, TABLE, None),
                              "job: options: found None, expected an Options, such as Options(model='pose')"),
    "no pairing": (lambda: Options(pairing=None), "pairing: found None, expected a Pairing, such as Pairing('chain')"),
    "a table's own that is none": (lambda: Table(TABLE, own=(3,)), "table: own[0]: found 3, expected an Own, such as "
                                   "Own(kind, data, sigma)"),
    "a name that is no text": (lambda: Robot.from_dh([[0, 0, 0, 0]], name=3), "name: found 3, expected text"),
    "names that are arrays": (lambda: build_problem(ROBOT, TABLE, prefer=np.zeros((2, 2))),
                              "prefer: unknown parameter [0.0, 0.0], expected one of base.x, base.y, base.z, "
                              "base.yaw, base.pitch, base.roll, theta1, d1, a1, alpha1, theta2, d2, ..."),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_in_one_line(mistake):
    call, said = MISTAKES[mistake]
    with pytest.raises(InputError) as found:
        call()
    assert str(found.value) == said


def test_every_public_function_compares_its_arguments_with_its_hints():
    without_objects = {"levenberg_marquardt_params", "result_schema"}
    for name in set(fg_calib.__all__) - without_objects:
        public = getattr(fg_calib, name)
        if inspect.isfunction(public):
            assert public.__code__.co_name == "with_checked", name
            assert _hints(public), name


def test_a_wrong_call_is_said_as_python_says_it():
    with pytest.raises(TypeError, match=r"missing 1 required positional argument: 'measurements'"):
        build_problem(ROBOT)


def test_numpy_words_and_numbers_are_words_and_numbers():
    pairing = Pairing(np.str_("random"), np.int64(15), np.int32(1))
    word = np.str_("distance")
    found = build_problem(ROBOT, TABLE, model=word, pairing=pairing, max_iterations=np.int64(9), gauge=np.str_("none"))
    assert type(found.options.model) is str
    assert found.options == Options("distance", Pairing("random", 15, 1), max_iterations=9, gauge="none")
    assert observe_structure(ROBOT, np.str_("pose")).model == "pose"
    assert Units(np.str_("mm")) == Units("mm")


@dataclass
class Place(os.PathLike):
    """A path of somebody else's."""

    path: object

    def __fspath__(self):
        return self.path


def test_a_path_is_whatever_python_takes_for_one(tmp_path):
    result = calibrate(ROBOT, TABLE, model="position")
    result.save(Place(str(tmp_path / "result")))
    assert Calibration.load(Place(str(tmp_path / "result"))).robot.nominal.tolist() == result.robot.nominal.tolist()
    assert read_robot(Place(str(tmp_path / "result" / "robot_calibrated.yaml"))).n_joints == 2
    assert as_hinted("path", Place("a/b"), Path | str) == Path("a/b")
    with pytest.raises(InputError, match=r"^path: found .*, expected a path$"):
        read_result(Place(b"result"))
    for takes in (read_result, read_robot, result.save):  # Python has the current folder for it
        with pytest.raises(InputError, match=r"^(path|folder): found '', expected a path$"):
            takes("")


def test_hints_that_are_imported_when_they_are_needed_are_compared_too():
    with pytest.raises(InputError, match=r"^comparison: found 3, expected a Comparison, such as compare\(read_job"):
        comparison_document(3)
    assert _hints(comparison_document)["comparison"] is Comparison
