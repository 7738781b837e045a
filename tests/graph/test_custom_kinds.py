"""A kind of measurement of a user's own: solved and assessed as ours, and what is wrong with it is named."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from custom_kinds import ANCHORS, SIGMA, AnchorDistance, lengths_to_anchors
from refusals import refusal
from reported import format_report, result_document
from simulated import measure

from fg_calib import Calibration, CustomMeasurements, InputError, Table, assess, build_problem, calibrate, solve
from fg_calib.measurements import Kind, Rows
from fg_calib.measurements.kinds.pair import Distance
from fg_calib.observability.reasons import NOT_EXCITED
from fg_calib.robot.kinematics import pose


class Offset(Kind):
    """Height of the tool by a gauge with an unknown offset."""

    names, units = ("height",), ("m",)
    ends, residual_dim, width, n_nuisances = 1, 1, 1, 1

    def rows(self, at, data, nuisances):
        """See `Kind.rows`."""
        D = np.zeros((len(data), 1, 1, 6))
        D[:, 0, 0, 5] = 1.0
        return Rows(at.position[:, 0, 2:] + nuisances - data, D, np.ones((len(data), 1, 1)))


def test_an_unknown_may_have_any_number_of_coordinates(tmp_path):
    robot, _, table = lengths_to_anchors(1, n=40)
    q = table.measurements.readings
    heights = pose(robot, q).position[:, 2] + 0.01 + SIGMA * np.random.default_rng(0).normal(size=len(q))
    own = CustomMeasurements(Offset(), heights, SIGMA, unknowns=[[0.0]], names=("offset",))
    found = calibrate(robot, replace(table, own=(own,)))
    found.save(tmp_path)
    (offset,) = Calibration.load(tmp_path).result.groups
    assert abs(offset.xyz[0] - 0.01) < 5.0 * offset.sigma[0]


def test_test_rows_of_an_unknown_that_nothing_else_says_are_not_judged():
    robot, _, table = lengths_to_anchors(1, n=40)
    (own,) = table.own
    m = measure(robot, 40, np.random.default_rng(0), sigma=(1e-4, 1e-4), readings=table.measurements.readings)
    with_lengths = Table(m, "position", own=(replace(own, test=np.ones(40, bool), unknowns=own.unknowns + 0.05),))
    found = assess(solve(build_problem(robot, with_lengths)))
    assert found.fit.goodness.test is None or found.fit.goodness.test.n_rows == 0
    assert not any("test rows" in text for text in found.verdict.errors)


def test_a_sigma_that_may_mean_two_things_is_refused():
    class Three(Offset):
        residual_dim, names, units = 3, ("x", "y", "z"), ("m", "m", "m")

    with pytest.raises(InputError, match=r"own: sigma: shape \(3,\) of 3 rows, expected \(3, 1\)"):
        CustomMeasurements(Three(), [[1.0], [2.0], [3.0]], sigma=[1e-3, 2e-3, 3e-3], unknowns=[[0.0]])
    with pytest.raises(InputError, match=r"own: sigma: shape \(7,\), expected one that broadcasts to \(3, 3\)"):
        CustomMeasurements(Three(), [[1.0], [2.0], [3.0]], sigma=np.full(7, 1e-3), unknowns=[[0.0]])


def test_what_was_given_stays_as_it_was_when_the_giver_changes_it():
    ends, test = np.arange(4)[:, None], np.zeros(4, bool)
    own = CustomMeasurements(Offset(), np.ones(4), SIGMA, unknowns=[[0.0]], ends=ends, test=test)
    ends[:], test[:] = 0, True
    assert own.ends.ravel().tolist() == [0, 1, 2, 3]
    assert not own.test.any()


def test_it_has_residuals_goodness_and_predictions():
    robot, _, table = lengths_to_anchors(3, n_test=30)
    solution = solve(build_problem(robot, table))
    uncertainty = assess(solution)
    rows, fit = uncertainty.fit.residuals, uncertainty.fit.goodness
    assert rows.families == ("anchor",)
    assert (int(rows.used.sum()), int(rows.test.sum())) == (60, 30)
    (kind,) = fit.kinds
    assert (kind.kind, kind.unit, kind.n) == ("anchor", "m", 60)
    assert kind.chi2 == pytest.approx(np.sum((rows.after[rows.used] / SIGMA) ** 2), rel=1e-9)
    assert kind.p_value > 1e-4
    assert fit.test.p_value > 1e-4
    assert rows.rms()["test"]["anchor"]["after"] < 3 * SIGMA
    assert "anchor" in format_report(solution, uncertainty)
    document = result_document(solution, uncertainty)
    assert document["residual_rms"]["train"]["anchor"]["after"] < document["residual_rms"]["train"]["anchor"]["before"]
    assert document["goodness"]["anchor"]["n"] == 60


class AnchorTurns(AnchorDistance):
    """The same length as the turns of a drum of 1 m radius."""

    units = ("rad",)


def test_its_rows_are_in_its_unit_and_in_no_other(tmp_path):
    robot, _, table = lengths_to_anchors(3)
    result = calibrate(robot, replace(table, own=(replace(table.own[0], kind=AnchorTurns()),)))
    result.save(tmp_path)
    assert set(pl.read_csv(tmp_path / "residuals.csv")["unit"]) == {"rad"}
    size = np.degrees(result.assessment.fit.residuals.rms()["train"]["anchor"]["after"])
    for calibration in (result, Calibration.load(tmp_path)):
        assert f"-> {size:.3g} deg" in repr(calibration)


def test_configurations_out_of_range_are_named():
    robot, _, table = lengths_to_anchors(5)
    own = replace(table.own[0], ends=np.full((60, 1), 60))
    with pytest.raises(InputError, match=r"^own: ends: found 60, expected one a measurement, 0 to 59$"):
        build_problem(robot, replace(table, own=(own,)))
    for change, said in (
        ({"model": "posiiton"}, "table: model: found 'posiiton'"),
        ({"frame": "unkown"}, "table: frame: found 'unkown'"),
        ({"pairing": "chain"}, "table: pairing: found 'chain'"),
        ({"own": own}, "table: own: found "),
    ):
        with pytest.raises(InputError, match=f"^{said}"):
            replace(table, **change)


def test_an_anchor_that_too_few_lengths_see_is_unknown_and_harms_nothing():
    """Two lengths to the third anchor: one direction of it stays where it was started, without a sigma."""
    robot, _, table = lengths_to_anchors(6)
    own = table.own[0]
    keep = np.flatnonzero((own.which[:, 0] != 2) | (np.arange(60) < 6))
    ends = np.arange(60)[keep, None]
    few = replace(own, data=own.data[keep], which=own.which[keep], ends=ends, test=own.test[keep])
    solution = solve(build_problem(robot, replace(table, own=(few,))))
    uncertainty = assess(solution)
    assert solution.converged
    assert np.isnan(uncertainty.estimates.landmarks[2].sigma).any()
    assert np.isfinite(uncertainty.estimates.landmarks[0].sigma).all()
    assert uncertainty.fit.chi_square.dof == len(keep) - 3 - 3 - 2


def test_reasons_with_a_custom_kind_do_not_say_what_it_cannot_see():
    robot, _, table = lengths_to_anchors(0, n=60)
    found = assess(solve(build_problem(robot, table))).identifiability
    reasons = {name: lost.reason for lost in found.lost for name in lost.relation}
    assert "blind to the base" in reasons["d1"]  # the anchors move with it
    assert not any("unseen by" in reason or reason == NOT_EXCITED for reason in reasons.values())


def of_kind(kind, **changes):
    robot, _, table = lengths_to_anchors(5, n=12)
    return build_problem(robot, replace(table, own=(replace(table.own[0], kind=kind, **changes),)))


def changed(change):
    """The kind with something done to its rows."""

    class Mine(AnchorDistance):
        def rows(self, at, data, nuisances):
            return change(super().rows(at, data, nuisances))

    return Mine()


def described(**attributes):
    """The kind with other attributes; None of them leaves an attribute out."""
    own = {name: value for name, value in vars(AnchorDistance).items() if not name.startswith("_")} | attributes
    return type("Mine", (Kind,), {name: value for name, value in own.items() if value is not None})()


@pytest.mark.parametrize(("change", "said"), [
    (lambda r: None, "lengths: kind Mine: rows: returned a NoneType, expected Rows(residual, D, N)"),
    (lambda r: r._replace(residual=r.residual * np.nan), "lengths: kind Mine: residual: row 0: found nan, expected "
     "a finite number; at the start of the unknowns"),
    (lambda r: r._replace(wrenches=r.wrenches + np.inf), "lengths: kind Mine: wrenches: row 0: found inf, expected "
     "a finite number; at the start of the unknowns"),
    (lambda r: r._replace(residual="far"), "lengths: kind Mine: residual: found 'far', expected numbers of shape "
     "(12, 1)"),
    (lambda r: r._replace(residual=r.residual + 1j), "lengths: kind Mine: residual: found ndarray of shape (12, 1)"
     ", complex128, expected numbers of shape (12, 1)"),
    (lambda r: r._replace(nuisances=None), "lengths: kind Mine: nuisances: found None, expected "
     "numbers of shape (12, 1, 3)"),
])  # fmt: skip
def test_what_rows_raise_or_return_is_one_line_that_names_kind_and_table(change, said):
    assert refusal(of_kind, changed(change)) == said


@pytest.mark.parametrize(("attributes", "said"), [
    ({"ends": None}, "ends: found None, expected a whole number not below 0"),
    ({"ends": 3}, "ends: found 3, expected at most 2"),
    ({"residual_dim": "1"}, "residual_dim: found '1', expected a whole number not below 1"),
    ({"width": 1.0}, "width: found 1.0, expected a whole number not below 0"),
    ({"n_nuisances": True}, "n_nuisances: found True, expected a whole number not below 0"),
    ({"names": "anchor"}, "names: found 'anchor', expected a tuple of residual_dim = 1 words, such as ('height',)"),
    ({"units": ("m", "m")}, "units: found ('m', 'm'), expected a tuple of residual_dim = 1 of m, rad and px"),
    ({"units": None}, "units: found None, expected a tuple of residual_dim = 1 of m, rad and px"),
    ({"units": ("mm",)}, "units: found ('mm',), expected a tuple of residual_dim = 1 of m, rad and px"),
    ({"code": 1}, "code: found 1, expected None: compiled code would take the place of its rows"),
])  # fmt: skip
def test_what_a_kind_does_not_say_of_itself_is_named(attributes, said):
    found = refusal(CustomMeasurements, described(**attributes), np.ones(3), SIGMA, unknowns=ANCHORS)
    assert found == f"kind Mine: {said}"


def test_a_kind_of_ours_cannot_be_changed_under_its_compiled_twin():
    class Longer(Distance):
        def rows(self, at, data, nuisances):
            return super().rows(at, 1.1 * data, nuisances)

    with pytest.raises(InputError, match="kind Longer: code: found 0, expected None: compiled code would take"):
        CustomMeasurements(Longer(), np.ones(3), SIGMA, ends=np.zeros((3, 2), int))


@pytest.mark.parametrize(("change", "said"), [
    ({"data": ["1.0"] * 60}, "data: found ['1.0', '1.0', '1.0', '1.0', '1.0', '1.0', ...], expected finite numbers"),
    ({"data": np.full(60, np.nan)}, "data: row 0: found nan, expected a finite number"),
    ({"data": (x for x in range(60))}, "data: found a generator, expected finite numbers; list(...) makes a list"),
    ({"sigma": -1.0}, "sigma: found -1, expected a number above 0"),
    ({"sigma": 1e-200}, "sigma: found 1e-200, expected a number no larger than 1e+15; sigmas and tolerances no "),
    ({"which": np.full((60, 1), 3)}, "which: row 0: found 3, expected 0 to 2"),
    ({"ends": np.full((60, 1), -1)}, "ends: row 0: found -1, expected 0 and above"),
    ({"names": ("A", "A", "B")}, "names: found ('A', 'A', 'B'), expected 3 different words"),
    ({"names": (1, 2, 3)}, "names: found (1, 2, 3), expected 3 different words"),
    ({"unknowns": np.zeros((0, 0))}, "unknowns: shape (0, 0), expected a start for each unknown; "),
    ({"test": [True]}, "test: shape (1,), expected (60,), one a row"),
    ({"kind": AnchorDistance}, "kind: found <class 'custom_kinds.AnchorDistance'>, expected an object of a class"),
])  # fmt: skip
def test_a_mistake_in_what_was_measured_is_named(change, said):
    assert refusal(replace, lengths_to_anchors(5)[2].own[0], **change).startswith(f"own: {said}")
