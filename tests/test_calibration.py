"""The front door: one call does the steps, and what it found prints, predicts, and is saved and loaded."""

import copy
import pickle
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from refusals import refusal
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, measure_drawn, small_arm

from fg_calib import Calibration, Measurements, Options, ProblemError, assess, build_problem, calibrate, solve
from fg_calib.diagnostics.multistart import multistart
from fg_calib.inputs import FrozenArrays, InputError
from fg_calib.robot import pose

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3, "tool": 2e-3}
FRAME = (Rotation.from_rotvec([0.3, -0.2, 1.0]), np.array([0.5, 1.0, -0.3]))

CASES = {
    "unknown frame and tool": ({"model": "pose", "frame": "unknown"}, {"tolerance": TOLERANCE, "estimate": TOOL}),
    "priors": ({"model": "distance-rotation"}, {"tolerance": TOLERANCE}),
    "nothing holds what is lost": ({"model": "distance-rotation", "gauge": "none"}, {}),
    "nothing holds base and tool": ({"model": "pose", "gauge": "none"},
                                    {"estimate": [*TOOL, *(name.replace("tool", "base") for name in TOOL)]}),
    "some are kept": ({"model": "position", "gauge": "keep"}, {"tolerance": TOLERANCE}),
}  # fmt: skip


def given(name, n=25):
    settings, of_robot = CASES[name]
    robot = small_arm(**of_robot)
    return robot, measure_drawn(robot, n, seed=7, frame=FRAME if "frame" in name else None, n_test=5), settings


@pytest.fixture(scope="module")
def found():
    """Every case's calibration."""
    return {name: calibrate(robot, m, **settings) for name, (robot, m, settings) in ((c, given(c)) for c in CASES)}


Q = np.random.default_rng(1).uniform(-1.5, 1.5, (4, 4))


def test_parts_are_tables_and_drawings(found):
    result = found["priors"]
    rows = result.to_dataframe().rows_by_key("name", named=True, unique=True)
    assert {name: row["sigma"] for name, row in rows.items()} == {n: p.sigma for n, p in result.parameters.items()}
    covariance = result.to_dataframe("covariance")
    assert covariance["name"].to_list() == covariance.columns[1:] == list(result.result.covariance.names)
    assert np.array_equal(covariance[:, 1:].to_numpy(), result.covariance(), equal_nan=True)
    assert result.to_dataframe("residuals").equals(result.residuals)
    for drawing in (result.plot_parameters(), result.plot_residuals(), result.plot_workspace()):
        assert drawing.startswith("<svg")
        assert drawing._repr_svg_() == drawing
    assert "of: found 'frames', expected one of parameters, covariance" in refusal(result.to_dataframe, "frames")


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", CASES)
def test_one_call_does_the_steps(found, name):
    robot, m, settings = given(name)
    solution = multistart(solve(build_problem(robot, m, **settings)))
    uncertainty = assess(solution)
    assert np.array_equal(found[name].solution.parameters, solution.parameters)
    assert np.array_equal(found[name].assessment.covariance, uncertainty.covariance, equal_nan=True)
    assert list(found[name].findings) == list(uncertainty.verdict.errors)
    assert found[name].robot == uncertainty.robot
    assert found[name].trustworthy == uncertainty.trustworthy
    assert len(found[name].residuals) == uncertainty.fit.residuals.n
    p_values = {fit.kind: fit.p_value for fit in uncertainty.fit.goodness.kinds}
    assert {k: g.p_value for k, g in found[name].result.goodness.items()} == p_values


def test_parameters_are_found_by_name(found):
    result = found["priors"]
    assert list(result.parameters) == [p.name for p in result.robot.parameters]
    a2 = result.parameters["a2"]
    i = result.assessment.names.index("a2")
    assert a2.estimate == result.robot.parameters[result.robot.index("a2")].nominal
    assert a2.sigma == pytest.approx(np.sqrt(result.assessment.covariance[i, i]), rel=1e-15)
    assert "a9" not in result.parameters


def test_covariance_is_in_the_order_asked_for(found):
    result = found["priors"]
    u = result.assessment
    assert np.array_equal(result.covariance(), u.covariance, equal_nan=True)
    i, j = (u.names.index(name) for name in ("d3", "a2"))
    assert np.array_equal(result.covariance(["d3", "a2"]), u.covariance[np.ix_([i, j], [i, j])])
    with_fixed = result.covariance(["tool.x", "a2"])  # the tool is fixed here
    assert np.array_equal(with_fixed, [[0.0, 0.0], [0.0, u.covariance[j, j]]])
    assert "covariance: unknown parameter 'a9'" in refusal(result.covariance, ["a9"])
    assert result.covariance("a2") == u.covariance[j, j]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", CASES)
def test_predictions_agree_with_differences(found, name):
    """`Uncertainty.predict` differentiates any function of the robot by central differences.

    With steps of 1e-5 rad, rounding of positions of some metres leaves 1e-10 of each derivative; two more digits are
    for derivatives that cancel in a sum.
    """
    result = found[name]
    predicted = result.predict(Q)
    for k, q in enumerate(Q):
        at = pose(result.robot, [q])
        assert predicted.position[k] == pytest.approx(at.position[0], abs=1e-14)
        assert predicted.rotation[k] == pytest.approx(at.rotation[0], abs=1e-14)

        def moved(robot, q=q, R=at.rotation[0]):
            there = pose(robot, [q])
            return np.concatenate([there.position[0], Rotation.from_matrix(there.rotation[0] @ R.T).as_rotvec()])

        expected = result.assessment.predict(moved)
        scale = np.outer(expected.sigma, expected.sigma)
        assert np.array_equal(np.isnan(predicted.covariance[k]), np.isnan(expected.covariance))
        assert predicted.covariance[k] / scale == pytest.approx(expected.covariance / scale, abs=1e-8, nan_ok=True)
    if name == "nothing holds base and tool":
        assert np.isfinite(predicted.covariance).all()  # although base, tool and some of the arm are not known
        assert any(p.sigma is None for p in result.parameters.values())
    if name == "nothing holds what is lost":
        assert np.isnan(predicted.sigma_position).all()  # distances tell nothing of the base


def test_predictions_in_the_measurement_frame(found):
    """What was measured there is predicted within its noise; the base frame alone is known far worse."""
    result, (_, m, _) = found["unknown frame and tool"], given("unknown frame and tool")
    world = result.predict(m.readings, world=True)
    off = (world.position - m.position)[m.test] / 1e-3  # sigma of a measured position
    assert np.sum(off**2) < 2.0 * off.size
    turn, shift = Rotation.from_quat(result.result.frame_estimate.quaternion_xyzw), result.result.frame_estimate.xyz
    base = result.predict(m.readings)
    assert world.position == pytest.approx(turn.apply(base.position) + shift, abs=1e-12)
    assert np.all(world.sigma_position.max(axis=1) < base.sigma_position.max(axis=1))


@pytest.mark.parametrize("name", CASES)
def test_what_is_loaded_says_what_was_saved(found, tmp_path, name):
    result = found[name]
    result.save(tmp_path)
    again = Calibration.load(tmp_path)
    assert again.result.document() | {"files": {}} == result.result.document()
    assert again.parameters == result.parameters
    assert np.array_equal(again.covariance(), result.covariance(), equal_nan=True)
    assert again.robot.nominal == pytest.approx(result.robot.nominal, abs=1e-15)
    assert (again.trustworthy, again.findings) == (result.trustworthy, result.findings)
    for world in (False, True)[: 1 + (result.result.frame_estimate is not None)]:
        before, after = result.predict(Q, world=world), again.predict(Q, world=world)
        # The frame goes through a quaternion; all else is the same figures.
        assert after.position == pytest.approx(before.position, abs=1e-14)
        size = np.nanmax(np.abs(before.covariance), initial=0.0)
        assert after.covariance == pytest.approx(before.covariance, rel=1e-10, abs=1e-13 * size, nan_ok=True)
    assert repr(again) == repr(result)
    assert str(again) == str(result)
    for nothing in (lambda: again.solution, lambda: again.assessment, lambda: again.save(tmp_path / "again")):
        assert "it was loaded from a folder" in refusal(nothing)


@pytest.mark.slow
def test_noise_is_estimated_from_nothing_specified():
    robot, m, _ = given("priors", n=40)
    specified = calibrate(robot, m, model="pose", estimate_noise=True)
    bare = replace(m, sigma_position=None, sigma_orientation=None)
    free = calibrate(robot, bare, model="pose", estimate_noise=True)
    # The factors settle to 1e-5 wherever they start (see `variance_components`).
    for kind, true in (("position", 1e-3), ("orientation", 2e-4)):
        seen, seen_too = (
            r.result.goodness[kind].specified_sigma_rms * r.result.goodness[kind].observed_over_specified
            for r in (free, specified)
        )
        assert seen == pytest.approx(seen_too, rel=1e-4)
        assert seen == pytest.approx(true, rel=0.3)  # 120 residuals: 1 sigma of their RMS is 7 %


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", CASES)
def test_everything_fits_a_screen(found, name):
    result = found[name]
    robot, m, _ = given(name)
    for shown in (robot, m, result.solution.problem, result.solution, result.assessment, result):
        lines = repr(shown).splitlines()
        assert len(lines) <= 10
        assert max(map(len, lines)) <= 100
        assert "array(" not in repr(shown)
    assert str(result).startswith(f"{robot.name}: {result.result.model}")
    assert "Fit statistics" in str(result)


def frozen(value, seen):
    """The dataclasses whose arrays are to be read-only, in a value at any depth."""
    if id(value) in seen or not is_dataclass(value):
        return
    seen[id(value)] = value
    if isinstance(value, FrozenArrays):
        yield value
    for field in fields(value):
        one = getattr(value, field.name)
        for part in one if isinstance(one, tuple) else (one,):
            yield from frozen(part, seen)


def test_what_a_calibration_is_made_of_is_read_only(found):
    """But for arrays that kernels were compiled for."""
    uncertainty = found["priors"].assessment
    every = {type(part).__name__: part for part in frozen(uncertainty, {})}
    assert {"Assessment", "Goodness", "PredictedFit", "PriorFit", "Spread"} <= set(every)
    for name, part in every.items():
        for key, array in vars(part).items():
            if isinstance(array, np.ndarray) and key not in part._left_open:
                assert not array.flags.writeable, (name, key)


def test_a_calibration_goes_to_other_processes(found):
    result = found["unknown frame and tool"]
    for again in (copy.deepcopy(result), pickle.loads(pickle.dumps(result))):
        assert np.array_equal(again.predict(Q).covariance, result.predict(Q).covariance)
        assert str(again) == str(result)


@pytest.mark.parametrize(("wrong", "error", "message"), [
    ({"model": "positon"}, InputError, "model: found 'positon', .*did you mean position?"),
    ({"modle": "position"}, InputError, "options: unknown option 'modle'"),
    ({"options": Options("pose"), "frame": "unknown"}, InputError, "options: both options and frame=..."),
    ({"robot": "robot.yaml"}, InputError, "robot: found 'robot.yaml', expected a Robot, such as Robot.from_dh"),
    ({"measurements": Q}, InputError,
     r"measurements: found ndarray of shape \(4, 4\), expected a Measurements or a Table"),
    ({"measurements": Measurements.from_arrays(Q[:, :3], position=np.zeros((4, 3)))}, InputError,
     "measurements: readings of 3 joints, expected 4"),
    ({"measurements": Measurements.from_arrays(Q, position=np.zeros((4, 3)), source="mine")}, ProblemError,
     "mine: no sigma for position"),
])  # fmt: skip
def test_mistakes_are_named(wrong, error, message):
    robot, m, _ = given("priors")
    arguments = {"robot": robot, "measurements": m} | ({} if "options" in wrong else {"model": "position"}) | wrong
    with pytest.raises(error, match=message):
        calibrate(**arguments)


def test_predictions_are_of_this_robot(found):
    predict = found["priors"].predict
    assert "readings: shape (4, 3), expected (n, 4)" in refusal(predict, Q[:, :3])
    assert "world: the measurement frame was not estimated" in refusal(predict, Q, world=True)
    assert "world: found 'yes'" in refusal(predict, Q, world="yes")
    assert predict(Q[0]).position.shape == (1, 3)


def test_the_frame_of_several_is_named():
    rng = np.random.default_rng(0)
    robot = small_arm(TOLERANCE)
    tables = [measure(robot, 20, rng, sigma=(1e-4, 1e-4), frame=FRAME) for _ in range(2)]
    other = (Rotation.from_rotvec([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 0.0]))
    tables[1] = replace(measure(robot, 20, rng, sigma=(1e-4, 1e-4), frame=other), source="other")
    found = calibrate(robot, tables, model="pose", frame="unknown")
    q = np.zeros(4)
    several = "table: several measurement frames, expected one of 0, 1: the table whose"
    assert several in refusal(found.predict, q, world=True)
    at = [found.predict(q, world=True, table=k).position[0] for k in range(2)]
    p = pose(robot, q[None]).position[0]
    for k, (rotation, shift) in enumerate((FRAME, other)):
        assert at[k] == pytest.approx(rotation.apply(p) + shift, abs=5e-3)
