"""Graph and baselines side by side: errors against other formulas, the report, the document, the command."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from oracle import tool_pose
from reported import format_comparison
from scipy.spatial.transform import Rotation
from simulated import TOOL, measure, paper_robot, planar_robot, small_arm, true_robot
from tolerances import rounding

from fg_calib import InputError, Job, Options, compare, read_job
from fg_calib.baseline import ESTIMATORS, real_errors
from fg_calib.baseline import comparison as comparison_module
from fg_calib.report import comparison_document
from fg_calib.robot import pose

TOLERANCE = {"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3}
FRAME = (Rotation.from_rotvec(np.pi * np.array([0.0, 0.6, 0.8])), np.array([7.0, -30.0, 2.0]))


def job_of(robot, truth, measurements, model, tmp_path, **settings):
    """A job that was never on disk."""
    return Job(tmp_path / "calibration.yaml", robot, measurements, Options(model=model, **settings), truth)


@pytest.fixture
def simulated_job(tmp_path):
    rng = np.random.default_rng(5)
    robot = paper_robot(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    measurements = measure(true, 60, rng, sigma=(1e-3, 2e-4), sigma_joint=1e-4, n_test=25)
    # Plain least squares knows no shared errors; with them the graph has another optimum.
    return job_of(robot, true, measurements, "distance-rotation", tmp_path, pair_errors="independent")


# --- what is compared -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_all_estimators_run_on_the_same_job(simulated_job):
    found = compare(simulated_job)
    assert [e.name for e in found.estimates] == list(ESTIMATORS)
    assert (found.judged_on, found.n_judged, found.trustworthy) == ("test", 25, True)
    graph, keep, plain, weighted = found.estimates
    for e in found.estimates:
        assert e.converged, e.message
        assert e.iterations > 1
        assert 0.0 < e.seconds < 60.0
        assert e.residual_rms["test"]["distance"] < found.rms_before["test"]["distance"]
        assert e.errors.base_frame.rms < found.errors_before.base_frame.rms
    kept = set(keep.sigma)
    assert len(kept) == 23
    assert set(plain.sigma) == set(weighted.sigma) == kept
    assert len(graph.sigma) == 35
    _same_optimum(found)
    assert plain.predicted_position_rms != pytest.approx(weighted.predicted_position_rms, rel=0.01)
    assert weighted.predicted_position_rms == pytest.approx(keep.predicted_position_rms, rel=2e-3)


@pytest.mark.parametrize("prefer", [(), ("theta4", "d4")])
def test_unknown_frame_and_tool_start_where_the_graph_starts(tmp_path, prefer):
    """What is held of an unknown tool stays at nominal, not where the closed form would start it."""
    rng = np.random.default_rng(4)
    robot = small_arm(estimate=TOOL)
    true = true_robot(robot, rng)
    measurements = measure(true, 60, rng, frame=FRAME, n_test=10)
    found = compare(job_of(robot, true, measurements, "pose", tmp_path, frame="unknown", prefer=prefer))
    assert all(e.converged for e in found.estimates)
    _, keep, _, weighted = found.estimates
    held = {p.name for p in robot.parameters if p.estimated} - set(keep.sigma)
    assert any(name.startswith("tool.") for name in held) == bool(prefer)
    assert all(weighted.robot.nominal[robot.index(name)] == robot.nominal[robot.index(name)] for name in held)
    for name, sigma in keep.sigma.items():
        values = [found.correction(e.robot, name) for e in (keep, weighted)]
        assert values[1] == pytest.approx(values[0], rel=0, abs=1e-4 * sigma), name
    assert weighted.residual_rms["test"]["position"] == pytest.approx(keep.residual_rms["test"]["position"], rel=1e-4)
    assert found.errors_before.best_rigid_fit.rms > keep.errors.best_rigid_fit.rms


@pytest.mark.slow
def test_a_job_without_test_rows_is_reweighted_at_its_train_rows(simulated_job):
    job = replace(simulated_job, truth=None, measurements=replace(simulated_job.measurements, test=np.zeros(85, bool)))
    found = compare(job)
    assert (found.judged_on, found.n_judged, found.errors_before) == ("train", 85, None)
    assert all(e.errors is None for e in found.estimates)
    text = format_comparison(found)
    assert "  no test rows: judged at the train configurations, which is optimistic for every estimator" in text
    assert "  the truth is unknown: no real errors (key truth of a job)" in text
    assert "Real error" not in text


@pytest.mark.slow
def test_a_baseline_that_cannot_run_or_goes_astray_says_so(simulated_job, monkeypatch):
    original = comparison_module.fit_least_squares

    def broken(*arguments, weighted=False, **settings):
        if weighted:
            raise InputError("poses.csv", "no sigma for distance")
        return replace(original(*arguments, **settings), converged=False)

    monkeypatch.setattr(comparison_module, "fit_least_squares", broken)
    found = compare(simulated_job)
    *_, plain, scipys = found.estimates
    assert (scipys.robot, scipys.converged, scipys.predicted_position_rms) == (None, False, None)
    assert scipys.message == "could not run: poses.csv: no sigma for distance"
    assert not plain.converged
    assert found.trustworthy
    text = format_comparison(found)
    assert re.search(r"converged +- +yes +yes +NO +NO\n", text)
    assert re.search(r"iterations +- +\d+ +\d+ +\d+ +-\n", text)
    assert "could not run: poses.csv: no sigma for distance" in " ".join(text.split())
    document = comparison_document(found)["estimates"][-1]
    assert (document["ran"], document["parameters"], document["residual_rms"]) == (False, [], None)


def test_where_nothing_is_determined_only_the_graph_with_priors_runs(tmp_path):
    robot = planar_robot(tolerance={"a": 1e-3}).with_estimated(["a1", "a2"])  # which turn nothing
    measurements = measure(robot, 20, np.random.default_rng(0))
    found = compare(job_of(robot, None, measurements, "rotation", tmp_path))
    graph, *others = found.estimates
    assert graph.converged
    assert graph.sigma == pytest.approx({"a1": 1e-3, "a2": 1e-3})
    for e in others:
        assert (e.robot, e.converged) == (None, False)
        assert e.message == (
            "could not run: measurements: the rows determine none of the parameters to estimate, "
            "expected rows that some of them act on"
        )
    assert re.search(r"n estimated +- +2 +- +- +-\n", format_comparison(found))


# --- every instrument -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("instrument", ["targets", "targets stations", "anchors offset", "planes", "pixels"])
def test_plain_least_squares_finds_the_graphs_optimum_of_every_instrument(instrument, tmp_path):
    """Two roads that share residuals alone, places and frames unknown to both: to a thousandth of a sigma."""
    robot, true, table = measured_by(instrument, np.random.default_rng(0))
    _same_optimum(compare(Job(tmp_path / "job.yaml", robot, (table,), Options(), true)))


def _same_optimum(found):
    """Of the graph that is weighted by the same noise and has no priors, and of what is claimed there."""
    _, keep, plain, *weighted = found.estimates
    assert plain.converged, plain.message
    for e in weighted:
        assert e.converged, e.message
        for name, sigma in keep.sigma.items():
            expected = keep.robot.nominal[keep.robot.index(name)]
            assert e.robot.nominal[e.robot.index(name)] == pytest.approx(expected, rel=0, abs=1e-3 * sigma), name
            assert e.sigma[name] == pytest.approx(sigma, rel=1e-3), name
        for split, kinds in keep.residual_rms.items():
            for kind, rms in kinds.items():
                assert e.residual_rms[split][kind] == pytest.approx(rms, rel=1e-3)


# --- real errors ------------------------------------------------------------------------------------------------------


def test_real_errors_are_those_of_the_tool_poses():
    rng = np.random.default_rng(1)
    robot = small_arm()
    true = true_robot(robot, rng)
    q = rng.uniform(-np.pi, np.pi, (40, 4))
    found = real_errors(robot, true, q)
    T, T_true = (np.array([tool_pose(r, row) for row in q]) for r in (robot, true))
    distance = np.linalg.norm(T[:, :3, 3] - T_true[:, :3, 3], axis=1)
    angle = Rotation.from_matrix(np.swapaxes(T[:, :3, :3], 1, 2) @ T_true[:, :3, :3]).magnitude()
    off, expected = found.base_frame, [distance.max(), distance.mean(), np.sqrt(np.mean(distance**2))]
    assert [off.max, off.mean, off.rms] == pytest.approx(expected, rel=rounding(1, 10), abs=0)
    assert found.base_frame.orientation_rms == pytest.approx(np.sqrt(np.mean(angle**2)), rel=1e-6)
    points, onto = T[:, :3, 3], T_true[:, :3, 3]
    turn, rssd = Rotation.align_vectors(onto - onto.mean(axis=0), points - points.mean(axis=0))
    assert found.best_rigid_fit.rms == pytest.approx(rssd / np.sqrt(40), rel=1e-6)
    angle = Rotation.from_matrix(np.swapaxes(turn.as_matrix() @ T[:, :3, :3], 1, 2) @ T_true[:, :3, :3]).magnitude()
    assert found.best_rigid_fit.orientation_rms == pytest.approx(np.sqrt(np.mean(angle**2)), rel=1e-6)
    assert found.best_rigid_fit.rms < found.base_frame.rms


def test_an_arm_that_was_only_moved_has_no_error_after_the_fit():
    robot = small_arm()
    moved = robot.with_values(robot.nominal + np.array([0.1, -0.2, 0.3, 0.4, 0.1, -0.2] + [0.0] * 22))
    q = np.random.default_rng(2).uniform(-np.pi, np.pi, (20, 4))
    found = real_errors(moved, robot, q)
    assert found.base_frame.rms > 0.1
    assert found.best_rigid_fit.max == pytest.approx(0.0, abs=rounding(10.0))
    assert found.best_rigid_fit.orientation_rms == pytest.approx(0.0, abs=rounding(10.0))
    assert real_errors(moved, robot, q[:2]).best_rigid_fit is None


# --- report, document, command ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_report_shows_the_figures_in_millimetres_and_degrees(simulated_job):
    found = compare(simulated_job)
    lines = format_comparison(found).splitlines()
    assert lines[0] == "space-robot: distance-rotation, judged at 25 test configurations"
    assert lines[2].split() == ["nominal", "graph", "graph-keep", "gauss-newton", "scipy"]
    errors = [found.errors_before, *(e.errors for e in found.estimates)]

    def values(label, after="Real error in the base frame"):
        row = next(line for line in lines[lines.index(after) :] if line.strip().startswith(label))
        return row.split(label)[1].split()

    assert values("max") == ["mm", *(f"{e.base_frame.max * 1e3:.3f}" for e in errors)]
    assert values("orientation rms") == ["deg", *(f"{np.rad2deg(e.base_frame.orientation_rms):.4f}" for e in errors)]
    angles = [np.rad2deg(e.residual_rms["test"]["angle"]) for e in found.estimates]
    assert values("angle", "Residuals, test rows (RMS)")[2:] == [f"{a:.4f}" for a in angles]
    assert values("n estimated") == ["-", "35", "23", "23", "23"]
    assert values("converged") == ["-", "yes", "yes", "yes", "yes"]
    a2 = next(line for line in lines if line.startswith("a2 "))
    shown = [f"{found.correction(e.robot, 'a2') * 1e3:+.3f} ±{e.sigma['a2'] * 1e3:.3f}" for e in found.estimates]
    truth = f"{found.correction(simulated_job.truth, 'a2') * 1e3:+.3f}"
    assert a2.split() == ["a2", "mm", truth, *" ".join(shown).split()]


@pytest.mark.slow
def test_comparing_a_simulated_job_from_files_tells_real_errors(fg_calib, example, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")  # of 80 columns, as parallel tests have, titles wrap where times are long
    job = example / "calibration.yaml"
    ended = fg_calib("compare", job)
    assert (ended.code, ended.err) == (0, "")
    assert "Real error in the base frame" in ended.out
    document = json.loads(fg_calib("compare", job, "--json", "--out", example / "out").out)
    written = json.loads((example / "out" / "comparison.json").read_text())
    assert list(written) == list(document)
    assert [e["name"] for e in document["estimates"]] == list(ESTIMATORS)
    given = read_job(job)
    m = given.tables[0].measurements
    q = m.readings[m.test]
    for e in document["estimates"]:
        values = given.robot.nominal
        for p in e["parameters"]:
            values[given.robot.index(p["name"])] = p["estimate"]
            assert p["true"] == given.truth.nominal[given.truth.index(p["name"])]
        step = pose(given.robot.with_values(values), q).position - pose(given.truth, q).position
        rms = np.sqrt(np.mean(np.sum(step**2, axis=1)))
        assert e["errors"]["base_frame"]["rms"] == pytest.approx(rms, rel=rounding(1, 10), abs=0)
        assert e["errors"]["best_rigid_fit"]["rms"] < rms
