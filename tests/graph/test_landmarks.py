"""Contact points, targets, stations, anchors, planes and boards: started, estimated with the arm, named, or refused."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
import pytest
from instruments import CAMERA, TARGETS, measured_by
from refusals import refusal
from scipy.stats import chi2
from simulated import nees, small_arm, true_robot, write_job
from sparing import diagonal
from touches import SIGMA, TOLERANCE, TOOL_POINT, corners, touch

from fg_calib import KnownPoint, Noise, ProblemError, SolverOptions, Table, assess, build_problem, calibrate, solve
from fg_calib.io.tables import read_measurements
from fg_calib.measurements.dataset import Groups, Measurements, Pairs, no_pairs
from fg_calib.robot import pose
from fg_calib.statistics.residual_table import residual_table

RIGID = ("a1", "alpha1", "d1", "theta1")
"""Parameters of the small arm that move it as one body."""

INSTRUMENTS = ["targets", "targets known", "targets stations", "anchors", "anchors offset", "anchors known"]
INSTRUMENTS += ["planes", "board", "pixels", "room"]


def case(seed=0, *, n_points=4, n_each=12, tolerance=TOLERANCE, sigma=SIGMA, distances=((0, 1, 1e-4),), **more):
    """The nominal arm, the true one, and touches of points."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=tolerance, estimate=TOOL_POINT)
    true = true_robot(robot, rng)
    return robot, true, touch(true, corners(true, n_points, rng), n_each, rng, sigma, distances, **more)


def all_pairs(m):
    """The same touches as pairs of each group, with sigma sqrt(n) times that of a touch."""
    index, parts = m.groups.index, []
    for g in range(len(m.groups.names)):
        rows = np.flatnonzero(index == g)
        parts.append(rows[np.array(np.triu_indices(len(rows), 1))])
    a, b = np.hstack(parts)
    nan = np.full(len(a), np.nan)
    sigma = np.sqrt(np.bincount(index)[index[a]]) * m.sigma("point")[a]
    pairs = Pairs(a, b, np.zeros(len(a)), nan, sigma, nan, np.zeros(len(a), dtype=bool))
    return replace(m, groups=None, pairs=pairs)


def test_touches_of_a_point_are_all_pairs_of_its_touches():
    """Without noise the information is the same, and that of a point touched once is none."""
    _, true, m = case(sigma=0.0, distances=(), tolerance=None)
    once = touch(true, corners(true, 1, np.random.default_rng(1)), 1, np.random.default_rng(2), 0.0)
    more = replace(
        m, readings=np.vstack([m.readings, once.readings]), ids=np.append(m.ids, "last"), test=np.append(m.test, False),
        sigmas={"point": np.append(m.sigma("point"), SIGMA)},
        groups=Groups((*m.groups.names, "once"), np.append(m.groups.index, 4), no_pairs("pairs.csv"))
    )  # fmt: skip
    J = [build_problem(true, x, model="distance").system.left.A for x in (m, all_pairs(m), more)]
    wanted = J[0].T @ J[0]
    assert J[1].T @ J[1] == pytest.approx(wanted, abs=1e-8 * wanted.max())
    assert J[2].T @ J[2] == pytest.approx(wanted, abs=1e-7 * wanted.max())
    dof = [assess(solve(build_problem(true, x, model="distance", prior=False))).fit.chi_square.dof for x in (m, more)]
    assert dof[0] == dof[1]


def test_what_moves_arm_and_points_as_one_body_stays_where_it_is():
    robot, _, m = case(tolerance=None)
    problem = build_problem(robot, m, model="distance")
    found = assess(solve(problem))
    for name in RIGID:
        p = next(p for p in found.estimates.parameters if p.name == name)
        assert (abs(p.correction) < 1e-9, p.sigma, p.identifiability) == (True, None, "ineffective")
    assert all(np.isnan(p.sigma).all() for p in found.estimates.landmarks)
    start = problem.start.copy()
    start[problem.variables.nuisance_span] += 0.01 * np.random.default_rng(4).normal(size=12)
    again = solve(replace(problem, start=start))
    for i, p in enumerate(found.estimates.parameters):
        assert not p.sigma or abs(again.parameters[i] - p.estimate) < 1e-3 * p.sigma
    for name in RIGID:
        assert abs(again.parameters[robot.index(name)] - robot.nominal[robot.index(name)]) < 1e-9


def test_points_of_test_rows_are_predicted_and_train_rows_alone_are_fitted():
    """Fitted points are the means of their touches, moved by what the distance between them pulls."""
    robot, _, m = case(distances=((0, 1, 1e-4), (0, 3, 1e-4)), test=(3,))
    m = replace(m, test=m.test | (np.arange(len(m.test)) == 0))  # a row of group 0
    specified = replace(m, groups=replace(m.groups, pairs=replace(m.groups.pairs, test=np.zeros(2, dtype=bool))))
    problem = build_problem(robot, m, model="distance")
    solution, other = (solve(build_problem(robot, x, model="distance")) for x in (m, specified))
    assert np.array_equal(other.parameters, solution.parameters)  # a distance to a test point is a test row
    found = assess(solution)
    assert problem.n_residuals == 3 * 35 + 1
    assert [v.symbol for v in problem.variables.nuisance] == ["L(0)", "L(1)", "L(2)"]
    assert [(p.name, p.n) for p in found.estimates.landmarks] == [("g0", 11), ("g1", 12), ("g2", 12), ("g3", 0)]
    table = found.fit.residuals
    kind = np.array(table.families)[table.family]
    contact, distances = kind == "point", np.flatnonzero(kind == "distance")
    assert np.sum(table.test & contact) == 3 * 13
    assert table.test[distances].tolist() == [False, True]
    p, d = pose(found.robot, m.readings).position, m.groups.pairs.distance
    means = [p[1:12].mean(axis=0), *(p[12 * g : 12 * (g + 1)].mean(axis=0) for g in (1, 2, 3))]
    along, pull = means[1] - means[0], (SIGMA / 1e-4) ** 2
    off = pull * (1.0 - d[0] / np.linalg.norm(along)) / (1.0 + pull * (1 / 11 + 1 / 12))
    means[0], means[1] = means[0] + off / 11 * along, means[1] - off / 12 * along
    expected = np.array([p[k] - means[g] for k, g in enumerate(m.groups.index)])
    assert table.after[contact] == pytest.approx(expected.ravel(), abs=1e-10)
    miss = [np.linalg.norm(means[g] - means[0]) - d[i] for i, g in enumerate((1, 3))]
    assert table.after[distances] == pytest.approx(miss, abs=1e-10)


def test_groups_of_a_table_and_distances_between_them_are_read(tmp_path):
    rows = "id,q1,q2,q3,q4,group,split\np0,0,0,0,0,left,\np1,1,0,0,0,left,\np2,0,1,0,0,right,test\np3,0,0,1,1,,\n"
    (tmp_path / "poses.csv").write_text(rows)
    (tmp_path / "pairs.csv").write_text("a,b,distance\nleft,right,0.05\np0,p3,0.7\n")
    noise = Noise(distance=1e-3, point=2e-4)
    m = read_measurements(tmp_path / "poses.csv", small_arm(), noise=noise, pairs=tmp_path / "pairs.csv")
    assert (m.groups.names, m.groups.index.tolist()) == (("left", "right"), [0, 0, 1, -1])
    assert m.sigma("point").tolist() == [2e-4] * 4
    between = m.groups.pairs
    assert (between.a.tolist(), between.b.tolist(), between.distance.tolist()) == ([0], [1], [0.05])
    assert between.test.tolist() == [True]  # as all of its touches are
    assert (m.pairs.a.tolist(), m.pairs.b.tolist(), m.pairs.distance.tolist()) == ([0], [3], [0.7])


def test_a_job_with_contacts_runs_from_the_command_line(fg_calib, tmp_path):
    robot, _, m = case(distances=((0, 1, 1e-4), (0, 3, 1e-4)), test=(3,))
    path = write_job(tmp_path, robot, m, model="distance", noise={"point": SIGMA, "distance": 1e-4})
    ended = fg_calib("calibrate", path, "--out", tmp_path / "out")
    assert (ended.code, ended.err) == (0, "")
    assert "ontact points" in ended.out
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert [g["name"] for g in result["groups"]] == ["g0", "g1", "g2", "g3"]
    assert result["residual_rms"]["test"]["point"]["after"] < 4 * SIGMA
    last = pl.read_csv(tmp_path / "out" / "residuals.csv", infer_schema_length=None).rows(named=True)[-1]
    assert [last[k] for k in ("kind", "a", "b", "split", "unit")] == ["distance", "g0", "g3", "test", "m"]


refused = partial(refusal, build_problem, error=ProblemError)


def test_contacts_that_a_model_cannot_use_or_without_sigmas_are_refused():
    robot, _, m = case(n_each=3)
    pairs = replace(m.groups.pairs, sigma_distance=np.array([np.nan]))
    for model in ("pose", "rotation"):
        said = f"poses.csv: group with model {model}, expected model distance or distance-rotation"
        assert refused(robot, m, model=model) == said
    said = "poses.csv: no sigma for contact points, expected noise.point or a column sigma_point"
    assert refused(robot, replace(m, sigmas={}), model="distance") == said
    said = "pairs.csv: no sigma for distance, expected noise.distance or a column sigma_distance"
    assert refused(robot, replace(m, groups=replace(m.groups, pairs=pairs)), model="distance") == said


# --- instruments ------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("instrument", "seed"), diagonal(INSTRUMENTS, [0, 1], every=2))
def test_it_arrives_from_nominal_wherever_landmarks_are(instrument, seed):
    """In few steps, at a chi-square and errors of the arm that noise explains: within 99.9 %."""
    robot, true, table = measured_by(instrument, np.random.default_rng(seed))
    solution = solve(build_problem(robot, table))
    found = assess(solution)
    assert solution.message == "converged: less than 3e-07 sigma from the optimum"
    assert solution.iterations <= 6
    assert not found.verdict.errors
    assert chi2.cdf(found.fit.chi_square.value, found.fit.chi_square.dof) < 0.999
    assert chi2.cdf(*nees(found, true)) < 0.999


@pytest.mark.slow
def test_corners_that_are_far_off_do_not_lead_a_robust_loss_astray():
    """6 % of the corners off by 30 pixels: the estimate is nearly that of least squares on the others."""
    robot, _, table = measured_by("room gross", np.random.default_rng(0))
    clean = measured_by("room", np.random.default_rng(0))[2].measurements.image
    wrong = np.any(table.measurements.image != clean, axis=1)
    found = assess(solve(build_problem(robot, table, loss="gnc")))
    others = replace(table, measurements=replace(table.measurements, test=wrong))
    oracle = assess(solve(build_problem(robot, others)))
    assert not found.verdict.errors
    rows = [robot.index(name) for name in found.names]
    off = (found.robot.nominal - oracle.robot.nominal)[rows] / np.sqrt(np.diag(oracle.covariance))
    assert np.abs(off).max() < 0.5
    assert "reduced chi-square" in assess(solve(build_problem(robot, table))).verdict.errors[0]


def test_known_targets_hold_the_others_and_those_with_a_tolerance_move():
    robot, _, table = measured_by("targets known", np.random.default_rng(2))
    points = {p.name: p for p in assess(solve(build_problem(robot, table))).estimates.landmarks}
    assert [points[f"t{i}"].kind for i in range(3)] == ["target"] * 3
    assert points["t0"].xyz == pytest.approx(TARGETS[0], abs=0.0)
    assert not points["t0"].sigma.any()
    for k in (1, 2):
        assert np.all(np.abs(points[f"t{k}"].xyz - TARGETS[k]) < 5.0 * points[f"t{k}"].sigma)
    assert np.all(points["t1"].sigma < 1e-3)


def in_two(table, rows):
    """The same measurements in two tables, those of some rows in the second."""
    m, mine = table.measurements, np.isin(np.arange(table.measurements.n_configurations), rows)
    parts = [replace(m.select(np.flatnonzero(chosen)), source=name) for chosen, name in ((~mine, "a"), (mine, "b"))]
    return [replace(table, measurements=part) for part in parts]


SHARED = ["anchors", "anchors known", "planes", "board"]


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("instrument", "second"), diagonal(SHARED, ["half", "few", "test rows"], every=2))
def test_landmarks_of_one_name_in_two_tables_are_one(instrument, second):
    """The optimum is that of one table, also where the second alone does not determine its anchors and planes."""
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
    within = "[1.0, 2.0, 3.0] within 0.001"
    said = f"b: start {place.tolist()} of unknown a0, expected that of the other a0: {within}"
    assert refused(robot, tables) == said


def test_a_length_of_zero_is_contact_unless_the_instrument_adds_an_offset():
    robot, _, table = measured_by("anchors", np.random.default_rng(7))
    length = table.measurements.value("distance").copy()
    length[[4, 7]] = 0.0
    for offset, kinds in ((True, {"AnchorDistance": 40}), (False, {"AnchorDistance": 38, "AnchorContact": 2})):
        m = table.measurements.with_values({"distance": length})
        blocks = build_problem(robot, replace(table, measurements=m, offset=offset)).data.blocks
        assert {type(s.kind).__name__: s.n for s in blocks} == kinds
    assert [[s.of.names[i] for i in s.of.index[:3]] for s in blocks] == [["a0", "a1", "a2"], ["a1", "a1"]]


def test_what_an_instruments_model_lacks_is_named():
    robot, _, table = measured_by("anchors", np.random.default_rng(8))
    m = table.measurements
    for model, lacks in (
        ("plane", "no column plane, expected the name of a plane for model plane"),
        ("board", "no columns qx, qy, qz, qw or roll, pitch, yaw, expected measured"),
        ("pixels", "no columns u, v, corner_x, corner_y, expected images of a board's points for model pixels"),
    ):
        assert refused(robot, Table(m, model)).startswith(f"measurements: {lacks}")
    names = np.array(m.labels["anchor"].names)[m.labels["anchor"].index]
    given = {"anchor": names, "distance": m.value("distance"), "test": m.labels["anchor"].index == 1}
    data = Measurements.from_arrays(m.readings, sigma_distance=1e-4, **given)
    said = "anchor a1 has test rows alone, expected train rows too, or its place as"
    assert said in refused(robot, Table(data, "anchor"))
    known = {"a1": KnownPoint([1.0, 2.0, 3.0])}
    assert solve(build_problem(robot, Table(data, "anchor", known=known))).converged
    last = np.arange(40) >= 34
    tables = in_two(Table(replace(m, test=last), "anchor", offset=True), np.flatnonzero(last))
    assert refused(robot, tables).startswith("b: offset of b has test rows alone, expected")
    robot, _, table = measured_by("pixels", np.random.default_rng(10))
    assert "no camera, expected the key camera for model pixels" in refused(robot, replace(table, camera=None))
    assert table.camera == CAMERA
    robot, _, table = measured_by("targets", np.random.default_rng(4), n=12)
    m, q = table.measurements, table.measurements.readings.copy()
    q[1] += 0.01
    said = "measurements: other joint readings at id c0, expected those of"
    assert refused(robot, replace(table, measurements=replace(m, readings=q))).startswith(said)


@pytest.mark.parametrize(
    ("instrument", "column", "unit"),
    [("targets stations", "target", "m"), ("anchors", "anchor", "m"), ("pixels", None, "px")],
)
def test_residuals_name_what_they_are_of_the_row_of_the_table_and_their_unit(instrument, column, unit, tmp_path):
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
    assert set(rows["unit"]) == {unit}
    assert rows["of"].to_list() == expected[at].tolist() == result.residuals["of"].to_list()
    assert rows["a"].cast(pl.String).to_list() == m.ids[at].tolist()
    assert set(at) == set(range(m.n_configurations))
    if "stations" in instrument:
        station = np.array(m.labels["station"].names)[m.labels["station"].index]
        assert rows["table"].to_list() == [f"measurements, station {name}" for name in station[at]]


def test_rows_of_the_tool_itself_are_of_no_target():
    robot, _, table = measured_by("targets", np.random.default_rng(5), n=15)
    of = table.measurements.labels["target"]
    some = replace(of, index=np.where(of.index == 0, -1, of.index))
    some = replace(table, measurements=replace(table.measurements, labels={"target": some}))
    rows = residual_table(solve(build_problem(robot, some), SolverOptions(max_iterations=1)))
    target = np.array(rows.labels)[rows.label_code]
    assert set(target[rows.table_row % 3 == 0]) == {""}
    assert set(target[rows.table_row % 3 == 2]) == {"t2"}


def test_a_station_without_rows_has_no_frame_and_pairs_are_of_one_station():
    robot, _, table = measured_by("targets stations", np.random.default_rng(5))
    m = table.measurements
    first = m.select(np.flatnonzero(m.labels["station"].index == 0))
    both, alone = (build_problem(robot, replace(table, measurements=x)) for x in (m, first))
    of_pairs = build_problem(robot, replace(m, labels={"station": m.labels["station"]}), model="distance")
    assert {t.measurements.source for t in of_pairs.data.tables} == {f"measurements, station s{k}" for k in (0, 1)}
    assert [t.measurements.source for t in alone.data.tables] == ["measurements, station s0"]
    assert len(both.variables.frames) - len(alone.variables.frames) == 1
