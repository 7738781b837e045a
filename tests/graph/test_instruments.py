"""Targets, stations, anchors, planes, boards and pixels: started anywhere, solved, known as well as is said."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import polars as pl
import pytest
from instruments import CAMERA, TARGETS, measured_by
from scipy.stats import chi2, kstest
from sparing import diagonal

from fg_calib.assessment import assess
from fg_calib.calibration import calibrate
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import SolverOptions, solve
from fg_calib.inputs import ProblemError
from fg_calib.measurements.dataset import Measurements
from fg_calib.measurements.table import KnownPoint, Table
from fg_calib.robot.model import FRAME_KINDS
from fg_calib.statistics.residual_table import residual_table

INSTRUMENTS = [
    *("targets", "targets known", "targets stations", "anchors", "anchors offset", "anchors known"),
    *("planes", "board", "pixels"),
]
EVERY = pytest.mark.parametrize("instrument", INSTRUMENTS)


def errors_of(uncertainty, true):
    """Squared error over its covariance, and degrees of freedom."""
    place = {p.name: i for i, p in enumerate(true.parameters)}
    rows = [place[name] for name in uncertainty.names]
    e = uncertainty.robot.nominal[rows] - true.nominal[rows]
    return float(e @ np.linalg.solve(uncertainty.covariance, e)), len(rows)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("instrument", [*INSTRUMENTS, "room"])
@pytest.mark.parametrize("seed", [0, 1])
def test_it_arrives_from_nominal_wherever_things_are(instrument, seed):
    """In few steps, at a chi-square and errors of the arm that noise explains: within 99.9 %."""
    robot, true, table = measured_by(instrument, np.random.default_rng(seed))
    solution = solve(build_problem(robot, table))
    uncertainty = assess(solution)
    assert solution.message == "converged: less than 3e-07 sigma from the optimum"
    assert solution.iterations <= 6
    assert not uncertainty.verdict.errors
    assert chi2.cdf(uncertainty.fit.chi_square.value, uncertainty.fit.chi_square.dof) < 0.999
    error, n = errors_of(uncertainty, true)
    assert chi2.cdf(error, n) < 0.999


@pytest.mark.slow
def test_corners_that_are_far_off_do_not_lead_a_robust_loss_astray():
    """6 % of the corners off by 30 pixels at 0.3: neither the board's poses nor what they start are spoiled.

    What is then wrong is what least squares on the other corners is off by, and without a loss the result says so.
    """
    far, oracle = [], []
    for seed in range(3):
        robot, true, table = measured_by("room gross", np.random.default_rng(seed))
        clean = measured_by("room", np.random.default_rng(seed))[2].measurements.image
        wrong = np.any(table.measurements.image != clean, axis=1)
        uncertainty = assess(solve(build_problem(robot, table, loss="gnc")))
        assert not uncertainty.verdict.errors
        error, n = errors_of(uncertainty, true)
        assert chi2.cdf(error, n) < 0.999
        told = replace(table, measurements=replace(table.measurements, test=wrong))
        far.append(error)
        oracle.append(errors_of(assess(solve(build_problem(robot, told))), true)[0])
        assert "reduced chi-square" in assess(solve(build_problem(robot, table))).verdict.errors[0]
    assert np.sqrt(np.sum(far) / np.sum(oracle)) < 1.15


@EVERY
@pytest.mark.parametrize("sigma_joint", [0.0, 5e-4])
@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
def test_sigmas_are_what_they_are_said_to_be(instrument, sigma_joint):
    """NEES of 40 draws within 4 of its own sigma, p-values of chi-square uniform at 0.1 %."""
    nees, p = [], []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        robot, true, table = measured_by(instrument, rng, sigma_joint=sigma_joint)
        uncertainty = assess(solve(build_problem(robot, table)))
        error, n = errors_of(uncertainty, true)
        nees.append(error / n)
        p.append(uncertainty.fit.chi_square.p_value)
    assert abs(np.mean(nees) - 1.0) < 4.0 * np.sqrt(2.0 / n / len(nees))
    assert kstest(p, "uniform").pvalue > 1e-3


def test_targets_that_are_known_hold_the_others_and_those_with_a_tolerance_move():
    robot, _, table = measured_by("targets known", np.random.default_rng(2))
    points = {p.name: p for p in assess(solve(build_problem(robot, table))).estimates.landmarks}
    assert [points[f"t{i}"].kind for i in range(3)] == ["target"] * 3
    assert points["t0"].xyz == pytest.approx(TARGETS[0], abs=0.0)
    assert not points["t0"].sigma.any()
    for k in (1, 2):
        assert np.all(np.abs(points[f"t{k}"].xyz - TARGETS[k]) < 5.0 * points[f"t{k}"].sigma)
    assert np.all(points["t1"].sigma < 1e-3)


@pytest.mark.slow
def test_several_rows_of_a_configuration_share_its_joint_noise():
    """What three targets show of one and the same error is told apart from the arm's own."""
    rng = np.random.default_rng(3)
    robot, _, table = measured_by("targets", rng, sigma_joint=2e-3)
    together = assess(solve(build_problem(robot, table)))
    m = table.measurements
    alone = Measurements.from_arrays(
        m.readings,
        position=m.position,
        sigma_position=m.sigma_position,
        sigma_joint=m.sigma_joint,
        target=np.array(m.labels["target"].names)[m.labels["target"].index],
    )
    apart = assess(solve(build_problem(robot, Table(alone, "position", frame="unknown"))))
    ratio = np.sqrt(np.diag(together.covariance) / np.diag(apart.covariance))
    known = np.array(
        [p.identifiability == "independent" for p in together.estimates.parameters if p.name in together.names]
    )
    assert np.median(ratio[known]) < 0.5


def test_a_configuration_has_one_reading():
    robot, _, table = measured_by("targets", np.random.default_rng(4), n=12)
    q = table.measurements.readings.copy()
    q[1] += 0.01
    m = table.measurements
    other = Measurements.from_arrays(
        q, position=m.position, sigma_position=1e-4, target=["a", "b", "c"] * 12, ids=m.ids
    )
    with pytest.raises(ProblemError, match=r"^measurements: other joint readings at id c0, expected those of"):
        build_problem(robot, Table(other, "position", frame="unknown"))


@cache
def calibrated(instrument):
    """What several tests look at."""
    robot, _, table = measured_by(instrument, np.random.default_rng(5))
    return calibrate(robot, [table])


@pytest.mark.slow
@EVERY
def test_the_front_door_reports_and_saves_it(instrument, tmp_path):
    result = calibrated(instrument)
    assert result.trustworthy
    kind = {"targets": "target", "anchors": "anchor", "planes": "plane", "board": "board", "pixels": "board"}
    wanted = kind[instrument.partition(" ")[0]]
    headings = {"target": "Targets (", "anchor": "Anchors (", "plane": "Planes (", "board": "Boards ("}
    assert headings[wanted] in str(result)
    result.save(tmp_path / "result")
    from fg_calib import Calibration

    loaded = Calibration.load(tmp_path / "result").result
    assert {group.kind for group in loaded.groups} >= {wanted}


@pytest.mark.sampled(1)
@EVERY
def test_rows_are_in_the_unit_of_their_kind(instrument, tmp_path):
    calibrated(instrument).save(tmp_path / "result")
    rows = pl.read_csv(tmp_path / "result" / "residuals.csv").select("kind", "unit").unique().rows()
    units = {"position": "m", "orientation": "rad", "distance": "m", "pixel": "px"}
    assert {(kind, units[kind.partition(".")[0]]) for kind, _ in rows} == set(rows)


CHOICES = [{"loss": "huber"}, {"encoder": "estimated"}, {"estimate_noise": True}]


@pytest.mark.slow
@pytest.mark.parametrize(("instrument", "choices"), diagonal(INSTRUMENTS, CHOICES, every=3), ids=str)
def test_losses_joint_values_and_noise_work_with_it(instrument, choices):
    robot, true, table = measured_by(instrument, np.random.default_rng(6), sigma_joint=2e-4)
    result = calibrate(robot, [table], **choices)
    error, n = errors_of(result.assessment, true)
    assert result.solution.converged
    assert error / n < 3.0


@pytest.mark.parametrize("offset", [True, False])
def test_a_length_of_zero_is_contact_unless_the_instrument_adds_something(offset):
    robot, _, table = measured_by("anchors", np.random.default_rng(7))
    m = table.measurements
    length = m.length.copy()
    length[:4] = 0.0
    names = np.array(m.labels["anchor"].names)[m.labels["anchor"].index]
    data = Measurements.from_arrays(m.readings, anchor=names, distance=length, sigma_distance=1e-4)
    kinds = {type(s.kind).__name__: s.n for s in build_problem(robot, Table(data, "anchor", offset=offset)).data.series}
    assert kinds == ({"AnchorDistance": 40} if offset else {"AnchorDistance": 36, "AnchorContact": 4})


def test_what_a_model_lacks_is_named():
    robot, _, table = measured_by("anchors", np.random.default_rng(8))
    m = table.measurements
    cases = [
        (Table(m, "plane"), "no column plane, expected the name of a plane for model plane"),
        (Table(m, "board"), "no columns qx, qy, qz, qw, or roll, pitch, yaw, or rx, ry, rz, expected measured"),
        (
            Table(m, "pixels"),
            "no columns u, v, corner_x, corner_y, expected images of a board's points for model pixels",
        ),
        (Table(m, "position"), "no columns x, y, z, expected measured positions for model position"),
    ]
    for wrong, message in cases:
        with pytest.raises(ProblemError) as error:
            build_problem(robot, wrong)
        assert str(error.value).startswith(f"measurements: {message}")


def test_an_anchor_of_test_rows_alone_is_named_unless_it_is_known():
    robot, _, table = measured_by("anchors", np.random.default_rng(9))
    m = table.measurements
    test = m.labels["anchor"].index == 1
    names = np.array(m.labels["anchor"].names)[m.labels["anchor"].index]
    data = Measurements.from_arrays(m.readings, anchor=names, distance=m.length, sigma_distance=1e-4, test=test)
    with pytest.raises(ProblemError, match="anchor a1 has test rows alone, expected train rows too, or its place as"):
        build_problem(robot, Table(data, "anchor"))
    known = {"a1": KnownPoint([1.0, 2.0, 3.0])}
    assert solve(build_problem(robot, Table(data, "anchor", known=known))).converged


def in_two(table, rows):
    """The same measurements in two tables, those of some rows in the second."""
    m, mine = table.measurements, np.isin(np.arange(table.measurements.n_configurations), rows)
    parts = [replace(m.select(np.flatnonzero(chosen)), source=name) for chosen, name in ((~mine, "a"), (mine, "b"))]
    return [replace(table, measurements=part) for part in parts]


SHARED = ["anchors", "anchors known", "planes", "board"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("instrument", "second"), diagonal(SHARED, ["half", "few", "test rows"], every=2))
def test_what_has_one_name_in_two_tables_is_one_thing(instrument, second):
    """The optimum is that of one table, also where the second alone does not say where its anchors and planes are."""
    robot, _, table = measured_by(instrument, np.random.default_rng(11))
    if second == "test rows":
        table = replace(table, measurements=replace(table.measurements, test=np.arange(40) >= 34))
    rows = {"half": np.arange(1, 40, 3), "few": np.arange(3), "test rows": np.arange(34, 40)}[second]
    one, two = (solve(build_problem(robot, tables)) for tables in (table, in_two(table, rows)))
    assert two.converged
    assert two.cost == pytest.approx(one.cost, rel=1e-9)
    n = len(robot.parameters)
    sigma = np.array([p.sigma for p in assess(one).estimates.parameters])
    assert np.all(np.abs(two.parameters - one.parameters)[:n] <= 1e-5 * np.nan_to_num(sigma))
    names = [f"{p.kind} {p.name}" for p in assess(two).estimates.landmarks if p.kind != "offset"]
    assert len(names) == len(set(names))


def test_what_an_instrument_adds_is_said_by_its_own_train_rows():
    robot, _, table = measured_by("anchors offset", np.random.default_rng(13))
    tables = in_two(replace(table, measurements=replace(table.measurements, test=np.arange(40) >= 34)), range(34, 40))
    with pytest.raises(ProblemError, match=r"^b: offset of b has test rows alone, expected"):
        build_problem(robot, tables)


def test_what_one_table_says_of_an_anchor_holds_for_all_and_two_may_not_differ():
    robot, _, table = measured_by("anchors known", np.random.default_rng(12))
    place, other = table.known["a0"].xyz, KnownPoint([1.0, 2.0, 3.0], 1e-3)
    for said in (0, 1):
        tables = in_two(table, np.arange(10))
        tables[1 - said] = replace(tables[1 - said], known={})
        points = {p.name: p for p in assess(solve(build_problem(robot, tables))).estimates.landmarks}
        assert points["a0"].xyz == pytest.approx(place, abs=0.0)
        assert not points["a0"].sigma.any()
    tables[0] = replace(tables[0], known={"a0": other})
    with pytest.raises(ProblemError) as error:
        build_problem(robot, tables)
    within = "[1.0, 2.0, 3.0] within 0.001"
    assert str(error.value) == f"b: start {place.tolist()} of unknown a0, expected that of the other a0: {within}"


def test_a_camera_is_needed_for_pixels():
    robot, _, table = measured_by("pixels", np.random.default_rng(10))
    with pytest.raises(ProblemError, match="no camera, expected the key camera for model pixels"):
        build_problem(robot, Table(table.measurements, "pixels"))
    assert table.camera == CAMERA


# --- rows say what they are of ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("instrument", "column"), [("targets", "target"), ("targets stations", "target"), ("anchors", "anchor"),
                               ("planes", "plane"), ("pixels", None)]
)  # fmt: skip
def test_residuals_name_what_they_are_of_and_the_row_of_the_table(instrument, column, tmp_path):
    robot, _, table = measured_by(instrument, np.random.default_rng(5))
    table = replace(table, measurements=table.measurements.select(np.arange(120)[: len(table.measurements.ids)]))
    result = calibrate(robot, [table])
    result.save(tmp_path / "result")
    rows, m = pl.read_csv(tmp_path / "result" / "residuals.csv"), table.measurements
    if column is None:
        expected = np.array([f"corner {x:g} {y:g} mm" for x, y in np.round(1e3 * m.image[:, 2:])])
    else:
        expected = np.array(m.labels[column].names)[m.labels[column].index]
    at = rows["row"].to_numpy()
    assert rows["of"].to_list() == expected[at].tolist() == result.residuals["of"].to_list()
    assert rows["a"].cast(pl.String).to_list() == m.ids[at].tolist()
    assert np.array_equal(at, result.residuals["row"].to_numpy())
    assert set(at) == set(range(m.n_configurations))
    if "stations" in instrument:
        station = np.array(m.labels["station"].names)[m.labels["station"].index]
        assert rows["table"].to_list() == [f"measurements, station {name}" for name in station[at]]


def test_contact_and_rows_of_the_tool_itself_keep_their_names():
    robot, _, table = measured_by("anchors", np.random.default_rng(5))
    length = table.measurements.length.copy()
    length[[4, 7]] = 0.0  # in contact with anchors 1 and 1
    problem = build_problem(robot, replace(table, measurements=replace(table.measurements, length=length)))
    assert [[s.of.names[i] for i in s.of.index[:3]] for s in problem.data.series] == [["a0", "a1", "a2"], ["a1", "a1"]]
    robot, _, table = measured_by("targets", np.random.default_rng(5), n=15)
    of = table.measurements.labels["target"]
    some = replace(of, index=np.where(of.index == 0, -1, of.index))
    some_of_it = replace(table, measurements=replace(table.measurements, labels={"target": some}))
    rows = residual_table(solve(build_problem(robot, some_of_it), SolverOptions(max_iterations=1)))
    assert set(rows.of[rows.table_row % 3 == 0]) == {""}
    assert set(rows.of[rows.table_row % 3 == 2]) == {"t2"}


def test_files_of_tables_that_name_nothing_have_no_more_columns(tmp_path):
    robot, _, table = measured_by("board", np.random.default_rng(5))
    calibrate(robot, [table]).save(tmp_path / "result")
    assert pl.read_csv(tmp_path / "result" / "residuals.csv").columns[-2:] == ["noise_adds", "suspect"]


def shifted(instrument, rows, by=0.05):
    """A report on 60 rows to fit and 30 to test, of which some are off, counted from the first test row."""
    n, k = (20, 10) if "targets" in instrument else (60, 30)
    robot, _, table = measured_by(instrument, np.random.default_rng(5), n=n, n_test=k)
    m = table.measurements
    name, values = ("position", m.position) if m.length is None else ("length", m.length)
    values = values.copy()
    values[60 + np.array(rows)] += by
    return str(calibrate(robot, [replace(table, measurements=replace(m, **{name: values}))]))


def suspicious(report, of="test rows"):
    """A section of a report."""
    return report.split(f"Suspicious {of}\n")[1].split("\n\n")[0]


@pytest.mark.slow
def test_the_target_that_is_off_is_named():
    text = suspicious(shifted("targets", [1, 13, 22]))
    assert text.startswith("  all 9 suspicious rows are of t1, as are 30 of all 90 rows\n")
    assert re.search(r"^c20 +position\.[xyz] +t1 ", text, flags=re.M)


def test_the_anchor_that_is_off_is_named_among_others():
    text = suspicious(shifted("anchors", [1, 22, 25, 3]))
    assert text.startswith("  3 of 4 suspicious rows are of a1, as are 10 of all 30 rows\n")


@pytest.mark.slow
def test_the_station_that_is_off_is_named():
    text = suspicious(shifted("targets stations", [3, 16, 11]))
    assert text.startswith("  all 9 suspicious rows are of measurements, station s1, as are 45 of all 90 rows\n")
    assert re.search(r"^c25 +position\.[xyz] +measurements, station s1 +t1 ", text, flags=re.M)


@pytest.mark.slow
@pytest.mark.parametrize(("instrument", "rows"), [("anchors", [7]), ("targets", [4]), ("targets", [0, 13, 26])])
def test_nothing_is_said_in_common_of_one_measurement_or_of_all_alike(instrument, rows):
    assert "suspicious rows are of" not in suspicious(shifted(instrument, rows))


@pytest.mark.slow
def test_rows_that_were_fitted_are_compared_with_those_that_were_fitted():
    text = suspicious(shifted("anchors", [-59, -32, -20], 0.001), "rows")
    assert text.startswith("  both suspicious rows are of a1, as are 20 of all 60 rows\n")


def test_a_board_and_a_base_of_six_unknowns_are_two_variables():
    """Both have the letter B; only the priors say which of them moved."""
    robot, _, table = measured_by("board", np.random.default_rng(3))
    names = [*(p.name for p in robot.parameters if p.estimated), *(f"base.{k}" for k in FRAME_KINDS)]
    problem = build_problem(robot.with_estimated(names), table)
    assert {"B(0)", "B(1)"} <= {v.symbol for v in (*problem.variables.items, *problem.variables.nuisance)}
    assert solve(problem).converged


def test_a_station_that_no_rows_were_measured_from_has_no_frame():
    """Of a table of two stations those rows alone that are of one: what that station measured, and nothing more."""
    robot, _, table = measured_by("targets stations", np.random.default_rng(5))
    m = table.measurements
    first = m.select(np.flatnonzero(m.labels["station"].index == 0))
    assert first.labels["station"].names == ("s0", "s1")
    both = build_problem(robot, table)
    alone = build_problem(robot, replace(table, measurements=first))
    assert [t.measurements.source for t in alone.data.tables] == ["measurements, station s0"]
    assert len(both.variables.frames) - len(alone.variables.frames) == 1
