"""Results read back: the typed result is its own document, and damaged folders are refused in a line."""

import json
from dataclasses import replace

import numpy as np
import pytest
from exported import column
from simulated import measure, measure_drawn, small_arm

from fg_calib import Calibration, InputError, Pairing, calibrate
from fg_calib.robot.model import Axis, Element

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}

CASES = {
    "poses in an unknown frame": {"model": "pose", "frame": "unknown"},
    "kept parameters of pairs": {"model": "distance-rotation", "gauge": "keep"},
    "no priors": {"model": "distance", "gauge": "none", "pairing": Pairing("chain")},
    "joint values and a loss": {"model": "pose", "encoder": "estimated", "loss": "huber"},
    "estimated noise": {"model": "position", "estimate_noise": True},
    "limits and folds": {"model": "position", "accept": {"position": 1e-3}},
}

PROMISED = {
    *("schema", "version", "robot", "model", "frame", "pairing", "n_configurations", "n_pairs", "n_residuals"),
    *("n_excluded", "solver", "chi2", "dof", "reduced_chi2", "residual_rms", "parameters", "covariance"),
    *("frame_estimate", "observability", "inputs"),
}


@pytest.fixture(scope="module")
def calibrations():
    def found(settings):
        robot = small_arm(TOLERANCE)
        return calibrate(robot, measure_drawn(robot, 20, seed=5, n_test=4, sigma_joint=1e-4), **settings)

    return {name: found(settings) for name, settings in CASES.items()}


@pytest.fixture
def folder(calibrations, tmp_path):
    calibrations["poses in an unknown frame"].save(tmp_path / "result")
    return tmp_path / "result"


@pytest.mark.parametrize("name", CASES)
def test_a_loaded_result_has_the_same_document_and_prints_the_same(calibrations, tmp_path, name):
    made = calibrations[name]
    made.save(tmp_path)
    document = json.loads((tmp_path / "result.json").read_text())
    loaded = Calibration.load(tmp_path)
    assert loaded.result.document() == document
    assert document | {"files": {}} == made.result.document()
    assert str(loaded) == str(made)
    assert loaded.residuals.equals(made.residuals, null_equal=True)
    assert loaded.configurations.equals(made.configurations, null_equal=True)


def test_frames_and_combinations_have_the_promised_names_and_what_is_not_determined_no_sigma(calibrations):
    document = calibrations["poses in an unknown frame"].result.document()
    promised = {"parameters", "lost", "relations", "keep"}
    assert all(one.keys() >= promised for one in document["observability"]["relative"])
    assert document["frame_estimate"].keys() == {"xyz", "quaternion_xyzw", "sigma"}
    result = calibrations["no priors"].result
    i = result.covariance.names.index(next(p.name for p in result.parameters if p.sigma is None))
    assert result.document()["covariance"]["matrix"][i][i] is None


@pytest.mark.parametrize("residuals", ["parquet", "none"])
def test_residuals_are_written_as_asked(calibrations, tmp_path, residuals):
    made = calibrations["no priors"]
    made.save(tmp_path, residuals=residuals)
    assert not (tmp_path / "residuals.csv").exists()
    table = Calibration.load(tmp_path).residuals
    assert table is None if residuals == "none" else table.equals(made.residuals, null_equal=True)


def changed(folder, change):
    """Change result.json by a function of the document."""
    document = json.loads((folder / "result.json").read_text())
    change(document)
    (folder / "result.json").write_text(json.dumps(document))


def move(parameter):
    """Move an estimate by 1 mm."""
    parameter["estimate"] += 1e-3
    parameter["correction"] += 1e-3


def scale(matrix):
    """Make a covariance 10 000 times as large."""
    matrix[:] = (1e4 * np.array(matrix, float)).tolist()


@pytest.mark.parametrize(("damage", "message"), [
    (lambda f: (f / "result.json").write_text("{"), "result.json: not JSON: .*; was it cut off?"),
    (lambda f: (f / "result.json").write_text('{"n": NaN}'), "result.json: not JSON: NaN is no number"),
    (lambda f: (f / "result.json").write_text("[]"), "result.json: schema nothing, expected"),
    (lambda f: (f / "result.json").unlink(), "result: no result.json, expected what"),
    (lambda f: changed(f, lambda d: d["posterior"].update(variables={"K(9)": 22 * ["a"]})), "posterior: other var"),
    (lambda f: changed(f, lambda d: d.update(n_pairs="many")), "result.json: n_pairs: found 'many'"),
    (lambda f: changed(f, lambda d: d.update(trustworthy="yes")), "trustworthy: found 'yes', expected true or false"),
    (lambda f: changed(f, lambda d: d["parameters"][2].pop("sigma")), "json: parameter 3: missing key 'sigma'"),
    (lambda f: changed(f, lambda d: d["parameters"].pop()), "robot_calibrated.yaml: other parameters than in"),
    (lambda f: changed(f, lambda d: move(d["parameters"][8])), "robot_calibrated.yaml: other values than in"),
    (lambda f: (f / "robot_calibrated.yaml").unlink(), "neither robot_calibrated.yaml nor robot_calibrated.urdf"),
    (lambda f: changed(f, lambda d: d["posterior"]["variables"].popitem()), "json: posterior: covariance: shape"),
    (lambda f: changed(f, lambda d: d["observability"]["lost"].pop()), "observability: lost: found 5, expected 6"),
    (lambda f: changed(f, lambda d: d["observability"].update(rank=3)), "directions lost: found 6, expected 13"),
    (lambda f: changed(f, lambda d: d["observability"]["sigma"].update(a9=1)), r"unknown names: found \['a9'\]"),
    (lambda f: changed(f, lambda d: d["observability"]["classes"].pop()), "classes: found 15, expected 16"),
    (lambda f: changed(f, lambda d: d["parameters"][2].update(sigma=-1)), "3: sigma: found -1, expected a number not"),
    (lambda f: changed(f, lambda d: d.update(chi2_p_value=7)), "chi2_p_value: found 7, expected a number not above 1"),
    (lambda f: changed(f, lambda d: scale(d["covariance"]["matrix"])), "not the squares of sigmas: found 16"),
    (lambda f: changed(f, lambda d: scale(d["posterior"]["covariance"])), "variances of parameters other than those"),
    (lambda f: (f / "residuals.csv").write_text("kind\n"), "residuals.csv: changed, or of another calibration"),
])  # fmt: skip
def test_a_damaged_folder_is_refused_in_a_line(folder, damage, message):
    damage(folder)
    with pytest.raises(InputError, match=message) as error:
        str(Calibration.load(folder))
    assert "\n" not in str(error.value)


def test_what_a_urdf_cannot_hold_is_not_saved(tmp_path):
    robot, rng = column(tmp_path), np.random.default_rng(0)
    robot = replace(robot, elements=(*robot.elements, Element(Axis.TX, 0.3)))
    made = calibrate(robot, measure(robot, 30, rng, readings=rng.uniform(0, 0.7, (30, 5))), model="position")
    with pytest.raises(InputError, match=r"robot_calibrated\.urdf: the robot has elements or parameters of its own"):
        made.save(tmp_path / "result")
    assert not (tmp_path / "result").exists()


def test_an_arm_that_was_only_evaluated_reads_back(tmp_path):
    """Nothing is estimated: the covariance has no row."""
    rng = np.random.default_rng(6)
    robot = small_arm(TOLERANCE)
    m = measure(robot, 12, rng)
    calibrate(robot, replace(m, test=np.ones(12, dtype=bool)), model="position").save(tmp_path)
    found = Calibration.load(tmp_path)
    assert found.result.evaluated_only
    assert found.covariance().shape == (0, 0)


def test_version_1_is_readable_with_no_more_than_it_promised(folder):
    before = Calibration.load(folder)
    now = {"trustworthy", "posterior", "options", "frames", "goodness", "carried", "history", "files", "expected_error"}
    (folder / "residuals.csv").unlink()
    (folder / "configurations.csv").unlink()

    def to_version_1(document):
        for key in document.keys() - PROMISED:
            del document[key]
        for key in ("robot", "n_configurations", "lost", "fixed", "missing", "with_fixed_known", "kept"):
            document["observability"].pop(key, None)
        document |= {"schema": "fg-calib/result/1", "of a later day": 1}

    assert not now & PROMISED
    changed(folder, to_version_1)
    found = Calibration.load(folder)
    assert found.parameters == before.parameters
    assert "position" in str(found)
    q = np.random.default_rng(0).uniform(-1, 1, (5, 4))
    new, old = before.predict(q), found.predict(q)
    # Nothing is undetermined here: equal to rounding of sums of 16 terms.
    assert old.covariance == pytest.approx(new.covariance, rel=1e-9, abs=1e-12 * np.abs(new.covariance).max())
    for refused in (found.check, found.update):
        with pytest.raises(InputError, match=r"new\.csv: the calibration does not say how its tables were read"):
            refused(folder / "new.csv")
