"""Results read back: version 1 and 2, against their schema, and damaged ones refused in a line."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from schemas import without_defaults
from simulated import measure, small_arm, true_robot, write_job

import fg_calib.io.result
from fg_calib import Calibration, InputError, Pairing, calibrate, calibrate_job, read_result, read_urdf, result_schema
from fg_calib.io.saved import read_residuals, require_unchanged

TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}

CASES = {
    "poses in an unknown frame": {"model": "pose", "frame": "unknown"},
    "kept parameters of pairs": {"model": "distance-rotation", "gauge": "keep"},
    "no priors": {"model": "distance", "gauge": "none", "pairing": Pairing("chain")},
    "joint values and a loss": {"model": "pose", "encoder": "estimated", "loss": "huber"},
    "estimated noise": {"model": "position", "estimate_noise": True},
}

PROMISED_IN_VERSION_1 = {
    *("schema", "version", "robot", "model", "frame", "pairing", "n_configurations", "n_pairs", "n_residuals"),
    *("n_excluded", "solver", "chi2", "dof", "reduced_chi2", "residual_rms", "parameters", "covariance"),
    *("frame_estimate", "observability", "inputs"),
}


@pytest.fixture(scope="module")
def calibrations():
    def found(settings):
        rng = np.random.default_rng(5)
        robot = small_arm(TOLERANCE)
        m = measure(true_robot(robot, rng), 20, rng, n_test=4, sigma_joint=1e-4)
        return calibrate(robot, m, **settings)

    return {name: found(settings) for name, settings in CASES.items()}


@pytest.fixture
def folder(calibrations, tmp_path):
    calibrations["poses in an unknown frame"].save(tmp_path / "result")
    return tmp_path / "result"


def changed(folder, change):
    """The folder with its result.json changed by a function of the document."""
    file = folder / "result.json"
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))
    return folder


def moved(parameter):
    """An estimate 1 mm farther from nominal."""
    return {key: parameter[key] + 1e-3 for key in ("estimate", "correction")}


def scale_posterior(document, factor):
    posterior = document["posterior"]
    posterior["covariance"] = [[factor * value for value in row] for row in posterior["covariance"]]


def enlarge_one_covariance(document):
    """One that is above the product of its sigmas, on both sides of the diagonal."""
    C = document["posterior"]["covariance"]
    C[0][1] = C[1][0] = 2.0 * (C[0][0] * C[1][1]) ** 0.5


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", CASES)
def test_what_is_written_reads_back_the_same(calibrations, tmp_path, name):
    calibrations[name].save(tmp_path)
    found = read_result(tmp_path)
    assert set(found.files) == {"configurations.csv", "residuals.csv"}
    assert found.model_copy(update={"files": {}}) == calibrations[name].result
    assert found.document() == json.loads((tmp_path / "result.json").read_text())
    assert read_result(tmp_path / "result.json") == found


def test_residuals_are_the_same_as_csv_and_as_parquet_or_not_there(calibrations, tmp_path):
    found = calibrations[next(iter(CASES))]
    for how in ("csv", "parquet", "none"):
        found.save(tmp_path / how, residuals=how)
        tables = {file.name for file in (tmp_path / how).glob("residuals.*")}
        assert tables == {"csv": {"residuals.csv"}, "parquet": {"residuals.parquet"}, "none": set()}[how]
        assert set(read_result(tmp_path / how).files) == tables | {"configurations.csv"}
    of_csv, of_parquet = (read_residuals(tmp_path / how) for how in ("csv", "parquet"))
    assert (of_csv.place(0), of_parquet.place(0)) == ("residuals.csv:2", "residuals.parquet: row 0")
    for field in fields(of_csv):
        a, b = getattr(of_csv, field.name), getattr(of_parquet, field.name)
        if field.name != "file":
            np.testing.assert_array_equal(a, b)
    assert read_residuals(tmp_path / "none") is None
    found.save(tmp_path / "csv", residuals="parquet")  # in place of the other
    assert [file.name for file in (tmp_path / "csv").glob("residuals.*")] == ["residuals.parquet"]
    with pytest.raises(InputError, match="residuals: found 'xlsx', expected one of csv, parquet, none"):
        found.save(tmp_path / "other", residuals="xlsx")
    assert not (tmp_path / "other").exists()


def test_a_parquet_table_of_residuals_that_was_changed_is_refused(calibrations, tmp_path):
    calibrations[next(iter(CASES))].save(tmp_path, residuals="parquet")
    table = tmp_path / "residuals.parquet"
    pl.read_parquet(table).with_columns(residual=0.0).write_parquet(table)
    with pytest.raises(InputError, match=r"residuals\.parquet: changed, or of another calibration"):
        require_unchanged(tmp_path, read_result(tmp_path).files)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_what_is_written_has_the_schema(calibrations, tmp_path, name):
    """By a validator that knows nothing of the model."""
    jsonschema = pytest.importorskip("jsonschema")
    calibrations[name].save(tmp_path)
    document = json.loads((tmp_path / "result.json").read_text())
    jsonschema.validate(document, result_schema())


@pytest.mark.slow
def test_the_schema_finds_what_is_missing(calibrations, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    calibrations[next(iter(CASES))].save(tmp_path)
    document = json.loads((tmp_path / "result.json").read_text())
    with pytest.raises(jsonschema.ValidationError, match="'chi2' is a required property"):
        jsonschema.validate({k: v for k, v in document.items() if k != "chi2"}, result_schema())


def test_the_schema_that_is_shipped_is_the_models():
    """To write it anew: `json.dumps(result_schema(), indent=1)`."""
    file = Path(fg_calib.io.result.__file__).with_name("result.schema.json")
    assert without_defaults(json.loads(file.read_text())) == without_defaults(result_schema())


def test_version_1_is_readable_with_no_more_than_it_promised(folder):
    def to_version_1(document):
        for key in document.keys() - PROMISED_IN_VERSION_1:
            del document[key]
        document |= {"schema": "fg-calib/result/1", "of a later day": 1}

    before = Calibration.load(folder)
    found = Calibration.load(changed(folder, to_version_1))
    assert found.result.posterior is None
    assert found.parameters == before.parameters
    q = np.random.default_rng(0).uniform(-1, 1, (5, 4))
    new, old = before.predict(q), found.predict(q)
    # Nothing is undetermined here, so the parameters' covariance says all: equal to rounding of sums of 16 terms.
    assert old.covariance == pytest.approx(new.covariance, rel=1e-9, abs=1e-12 * np.abs(new.covariance).max())
    with pytest.raises(InputError, match="world: the measurement frame was not estimated, or not saved"):
        found.predict(q, world=True)


@pytest.mark.sampled(20)
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "result.json").unlink(), r"result: no result.json in this folder, expected a folder that"),
        (lambda f: (f / "result.json").write_text('{"schema": "fg-calib/res'), "result.json: not JSON: .*; was it cut"),
        (lambda f: (f / "result.json").write_text("[" * 100_000), "result.json: nested too deeply"),
        (lambda f: (f / "result.json").write_text("[1, 2]"), "result.json: no result of a calibration"),
        (
            lambda f: changed(f, lambda d: d.update(schema="fg-calib/result/3")),
            "json: schema: found 'fg-calib/result/3'",
        ),
        (lambda f: changed(f, lambda d: d.pop("dof")), "result.json: missing key 'dof'"),
        (
            lambda f: changed(f, lambda d: d["covariance"]["matrix"].pop()),
            "covariance: matrix: found .*, expected a sym",
        ),
        (
            lambda f: changed(f, lambda d: d["covariance"]["matrix"][1].__setitem__(1, -1e-9)),
            "covariance: matrix: found .*, expected a symmetric matrix of variances and covariances of errors",
        ),
        (
            lambda f: changed(f, lambda d: d["posterior"]["covariance"][0].__setitem__(1, 1.0)),
            "posterior: covariance: found .*, expected a symmetric matrix",
        ),
        (
            lambda f: changed(f, lambda d: d["frames"].update({"X(999999999)": d["frames"]["X(0)"]})),
            r"frames: X\(999999999\).*: found 'X\(999999999\)', expected a name of the pattern",
        ),
        (
            lambda f: changed(f, enlarge_one_covariance),
            "posterior: covariance: found .*, expected a symmetric matrix",
        ),
        (
            lambda f: changed(f, lambda d: d["parameters"][2].update(sigma=-1e-4)),
            "parameter 3: sigma: found -0.0001, expected a number not below 0",
        ),
        (
            lambda f: changed(f, lambda d: d["frame_estimate"]["quaternion_xyzw"].pop()),
            "frame_estimate: quaternion_xyzw: found .*, expected more than 3 in the list",
        ),
        (
            lambda f: changed(f, lambda d: d["frame_estimate"].update(quaternion_xyzw=[0, 0, 0, 2])),
            r"frame_estimate: quaternion_xyzw: found .*, expected x y z w of length 1",
        ),
        (
            lambda f: changed(f, lambda d: d["frame_estimate"].update(xyz=[0, None, 0])),
            "frame_estimate: xyz 2: found nothing, expected a finite number",
        ),
        (
            lambda f: changed(f, lambda d: d["parameters"][8].update(correction=1e-3)),
            r"parameter 9: correction: found 0.001 of d1, expected \S+, estimate less nominal; was the file changed\?$",
        ),
        (
            lambda f: changed(f, lambda d: d["parameters"][8].update(sigma=0.5)),
            r"parameter 9: sigma: found 0.5 of d1, expected \S+, as the covariance says; was the file changed",
        ),
        (
            lambda f: changed(f, lambda d: d["parameters"][8].update(sigma=None)),
            r"parameter 9: sigma: found None of d1, expected \S+, as the covariance says",
        ),
        (
            lambda f: changed(f, lambda d: d.update(reduced_chi2=1.0)),
            r"json: reduced_chi2: found 1, expected \S+, as chi2 and dof say",
        ),
        (
            lambda f: changed(f, lambda d: d.update(dof=d["dof"] + 1)),
            r"json: reduced_chi2: found \S+, expected \S+, as chi2 and dof say",
        ),
        (
            lambda f: changed(f, lambda d: d.update(n_residuals=7)),
            r"json: n_residuals: found 7, expected \d+, as goodness says",
        ),
        (
            lambda f: changed(f, lambda d: d["solver"].update(converged=False)),
            "json: trustworthy: true of a solver that has not converged, expected false",
        ),
        (
            lambda f: changed(f, lambda d: d.update(trustworthy=False)),
            "json: trustworthy: false with 0 findings, expected true without findings, else false",
        ),
        (
            lambda f: changed(f, lambda d: d.update(findings=["outliers"])),
            "json: trustworthy: true with 1 findings, expected true without findings, else",
        ),
        (
            lambda f: changed(f, lambda d: d["frame_estimate"]["sigma"].pop()),
            "json: frame_estimate: sigma: 5 figures, expected 6",
        ),
        (
            lambda f: changed(f, lambda d: d["parameters"].append(d["parameters"][0])),
            "json: parameters: 'base.x' twice, expected different names",
        ),
        (
            lambda f: changed(f, lambda d: d["covariance"]["names"].__setitem__(0, "a9")),
            "json: covariance: names: 'a9', which is no parameter, expected names",
        ),
        (lambda f: changed(f, lambda d: d.update(schema="fg-calib/comparison/1")), "json: no result of a calibration"),
        (
            lambda f: changed(f, lambda d: d["residual_rms"]["train"]["position"].update(after=1e308)),
            r"residual_rms: train: position: after: found 1e\+308, expected a number not above 1e\+150",
        ),
        (
            lambda f: changed(f, lambda d: d["expected_error"]["position"].update(fitted=-1e308)),
            r"expected_error: position: fitted: found -1e\+308, expected a number not below -1e\+150",
        ),
        (
            lambda f: changed(f, lambda d: d["posterior"]["covariance"][0].__setitem__(0, 1e300)),
            r"posterior: covariance 1 1: found 1e\+300, expected a number not above 1e\+150",
        ),
        (lambda f: changed(f, lambda d: d["parameters"][2].pop("sigma")), "json: parameter 3: missing key 'sigma'"),
        (lambda f: changed(f, lambda d: d["parameters"][2].update(nominal=None)), "json: parameter 3: nominal: found"),
        (lambda f: changed(f, lambda d: d["covariance"]["names"].pop()), "covariance: another size than its names"),
        (lambda f: changed(f, lambda d: d["parameters"].pop()), "robot_calibrated.yaml: other parameters than in"),
        (lambda f: (f / "robot_calibrated.yaml").unlink(), "neither robot_calibrated.yaml nor robot_calibrated.urdf"),
        (
            lambda f: changed(f, lambda d: d["parameters"][8].update(moved(d["parameters"][8]))),
            "robot_calibrated.yaml: other values than in result.json, expected the files of one calibration",
        ),
        (
            lambda f: changed(f, lambda d: d["posterior"]["variables"].popitem()),
            "result.json: posterior: other variables than the robot",
        ),
        (
            lambda f: changed(f, lambda d: d["posterior"]["undetermined"].append([1.0])),
            "result.json: posterior: other variables than the robot",
        ),
        *(
            (
                lambda f, factor=factor: changed(f, lambda d: scale_posterior(d, factor)),
                "result.json: posterior: contradicts the covariance of the parameters, expected the same of both",
            )
            for factor in (0.0, 2.0)
        ),
    ],
)
def test_a_damaged_folder_is_refused_in_a_line(folder, damage, message):
    damage(folder)
    with pytest.raises(InputError, match=message) as error:
        Calibration.load(folder)
    assert "\n" not in str(error.value)


def test_an_arm_that_was_only_evaluated_reads_back(tmp_path):
    """Nothing is estimated: the covariance has no row."""
    rng = np.random.default_rng(6)
    robot = small_arm(TOLERANCE)
    m = measure(robot, 12, rng)
    calibrate(robot, replace(m, test=np.ones(12, dtype=bool)), model="position").save(tmp_path)
    found = Calibration.load(tmp_path)
    assert found.result.evaluated_only
    assert found.covariance().shape == (0, 0)


def test_there_must_be_something_to_read(tmp_path):
    with pytest.raises(InputError, match="nowhere: no such folder or file, expected what `fg-calib calibrate --out`"):
        read_result(tmp_path / "nowhere")


def test_a_urdf_with_several_tips_is_loaded_by_its_links(tmp_path):
    joint = '<joint name="{0}" type="{3}"><parent link="{1}"/><child link="{2}"/><origin xyz="0.3 0.1 0.2"/></joint>'
    joints = [("j1", "base", "a", "continuous"), ("j2", "a", "tip", "continuous"), ("j3", "a", "camera", "fixed")]
    links = "".join(f'<link name="{name}"/>' for name in ("base", "a", "tip", "camera"))
    urdf = f'<robot name="arm">{links}{"".join(joint.format(*j) for j in joints)}</robot>'
    (tmp_path / "arm.urdf").write_text(urdf)
    robot = read_urdf(tmp_path / "arm.urdf", tip_link="tip", tolerance={"x": 1e-3, "yaw": 1e-3})
    rng = np.random.default_rng(2)
    m = measure(true_robot(robot, rng), 30, rng)
    path = write_job(tmp_path, small_arm(), m, model="pose")
    path.write_text(path.read_text().replace("robot: robot.yaml", "robot: {urdf: arm.urdf, tip_link: tip}"))
    calibrate_job(path).save(tmp_path / "result")
    assert not (tmp_path / "result" / "robot_calibrated.yaml").exists()
    found = Calibration.load(tmp_path / "result")
    assert found.robot.urdf.tip_link == "tip"
    assert found.robot.nominal == pytest.approx([p.estimate for p in found.parameters.values()], abs=1e-15)
