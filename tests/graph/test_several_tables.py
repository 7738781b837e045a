"""Several tables in one job, each with its kind, frame and noise: shared configurations, frames and landmarks."""

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import yaml
from custom_kinds import lengths_to_anchors
from scipy.spatial.transform import Rotation
from simulated import LARGE, measure, pairs_between, paper_robot, small_arm, true_robot
from touches import corners, touch

from fg_calib import ProblemError, Table, assess, build_problem, solve
from fg_calib.io import Units, write_csv, write_robot
from fg_calib.measurements import Groups, no_pairs
from fg_calib.simulation import table_columns

PLACED = (Rotation.from_rotvec([0.4, -1.1, 2.0]), np.array([3.0, -1.0, 0.5]))
ANOTHER = (Rotation.from_rotvec([-2.0, 0.3, 0.7]), np.array([-2.0, 4.0, 1.0]))
SIGMA = (5e-4, 5e-4)


def pairs_of(true, q, rng, sigma=2e-4):
    """Distances measured between each configuration and the next, at the true joint values q."""
    rows = np.arange(len(q))
    return pairs_between(true, q, (rows[:-1], rows[1:]), rng, sigma=(sigma, 0.0), source="lengths.csv")


def mixture(seed, *, n=16, sigma_joint=0.0, shared=True):
    """Positions by a tracker somewhere, and lengths of a ball bar, at the same configurations or at others."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=LARGE)
    true = true_robot(robot, rng)
    stood = rng.uniform(-np.pi, np.pi, (n, 4))
    read = stood + sigma_joint * rng.normal(size=stood.shape)
    tracker = measure(true, n, rng, sigma=SIGMA, frame=PLACED, readings=stood)
    noise = np.full(4, sigma_joint)
    tracker = replace(tracker, readings=read, sigma_joint=noise, rotation=None, source="tracker.csv", named=True)
    other = stood if shared else rng.uniform(-np.pi, np.pi, (n, 4))
    other_read = read if shared else other + sigma_joint * rng.normal(size=other.shape)
    ids = tracker.ids if shared else np.char.add("b", tracker.ids)
    bar = replace(
        tracker, readings=other_read, ids=ids, position=None, sigma_position=None, pairs=pairs_of(true, other, rng),
        source="bar.csv",
    )  # fmt: skip
    return robot, true, [Table(tracker, "position", frame="unknown"), Table(bar, "distance")]


def test_each_table_has_its_own_frame():
    rng = np.random.default_rng(5)
    robot = paper_robot({"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3})
    true = true_robot(robot, rng)
    first, second = (measure(true, 25, rng, sigma=SIGMA, frame=frame) for frame in (PLACED, ANOTHER))
    tables = [Table(first, "pose", frame="unknown"), Table(second, "position", frame="unknown")]
    uncertainty = assess(solve(build_problem(robot, tables)))
    assert len(uncertainty.estimates.frames) == 2
    for found, (turn, shift) in zip(uncertainty.estimates.frames, (PLACED, ANOTHER), strict=True):
        off = np.concatenate([(turn.inv() * Rotation.from_quat(found.quaternion_xyzw)).as_rotvec(), found.xyz - shift])
        assert np.all(np.abs(off[:3]) < 6 * found.sigma[:3])
        assert np.linalg.norm(off[3:]) < 6 * np.linalg.norm(found.sigma[3:])
    table = uncertainty.fit.residuals
    rows = [np.arange(table.n)[table.rows_of(number)].tolist() for number in (0, 1)]
    assert rows == [np.flatnonzero(table.block == number).tolist() for number in (0, 1)]
    turned = assess(solve(build_problem(robot, tables[::-1]))).estimates.frames[::-1]
    for found, again in zip(uncertainty.estimates.frames, turned, strict=True):
        assert again.sigma == pytest.approx(found.sigma, rel=1e-6)
    together = np.sqrt(np.diag(uncertainty.covariance))
    alone = np.sqrt(np.diag(assess(solve(build_problem(robot, tables[0]))).covariance))
    assert np.all(together <= alone * (1 + 1e-9))


def test_the_order_of_tables_and_one_table_in_parts_change_nothing():
    rng = np.random.default_rng(6)
    robot = small_arm(tolerance=LARGE)
    m = measure(true_robot(robot, rng), 30, rng, sigma=SIGMA, sigma_joint=3e-4)
    parts = [m.select(rows) for rows in (np.arange(12), np.arange(12, 30))]
    whole = assess(solve(build_problem(robot, m, model="pose")))
    for tables in (parts, parts[::-1]):
        found = assess(solve(build_problem(robot, tables, model="pose")))
        assert np.array([p.estimate for p in found.estimates.parameters]) == pytest.approx(
            np.array([p.estimate for p in whole.estimates.parameters]),
            abs=1e-6 * np.nanmin([p.sigma or 1 for p in whole.estimates.parameters]),
        )
        assert found.fit.chi_square.value == pytest.approx(whole.fit.chi_square.value, rel=1e-9)
        assert found.fit.chi_square.dof == whole.fit.chi_square.dof


def test_a_point_of_one_name_in_two_tables_is_one_point():
    """Touches of three points, the last of them and the distances in a second table: the same as one table."""
    rng = np.random.default_rng(7)
    robot = small_arm(tolerance=LARGE)
    true = true_robot(robot, rng)
    m = touch(true, corners(robot, 3, rng), 8, rng, distances=((1, 2, 1e-5),))
    of_first = np.arange(24) < 13  # touches of the second point are in both
    none = no_pairs("first.csv")

    def part(rows, pairs, source):
        names = tuple(np.array(m.groups.names)[np.unique(m.groups.index[rows])])
        index = np.searchsorted(names, np.array(m.groups.names)[m.groups.index[rows]])
        place = np.searchsorted(names, np.array(m.groups.names)) if pairs.n_pairs else None
        pairs = replace(pairs, a=place[pairs.a], b=place[pairs.b]) if pairs.n_pairs else pairs
        return replace(
            m, readings=m.readings[rows], ids=m.ids[rows], test=m.test[rows], sigmas={"point": m.sigma("point")[rows]},
            groups=Groups(names, index, pairs), source=source,
        )  # fmt: skip

    first, second = part(of_first, none, "first.csv"), part(~of_first, m.groups.pairs, "second.csv")
    one, two = (assess(solve(build_problem(robot, given, model="distance"))) for given in (m, [first, second]))
    assert [p.name for p in two.estimates.landmarks] == [p.name for p in one.estimates.landmarks] == ["g0", "g1", "g2"]
    assert [p.n for p in two.estimates.landmarks] == [8, 8, 8]
    a, b = ([(p.estimate, p.sigma or np.inf) for p in found.estimates.parameters] for found in (one, two))
    assert max(abs(x - y) / sigma for (x, sigma), (y, _) in zip(a, b, strict=True)) < 1e-6
    assert two.fit.chi_square.dof == one.fit.chi_square.dof
    assert two.fit.chi_square.value == pytest.approx(one.fit.chi_square.value, rel=1e-9)


def test_a_landmark_of_one_name_started_at_two_places_is_refused():
    robot, _, table = lengths_to_anchors(0, n=20)
    (own,) = table.own
    again = replace(own, unknowns=own.unknowns + 0.01)
    with pytest.raises(ProblemError, match=r"start \[.*\] of unknown A, expected that of the other A: \["):
        build_problem(robot, replace(table, own=(own, again)))
    parts = [replace(own, data=own.data[rows], ends=np.arange(20)[rows, None], which=own.which[rows], test=None)
             for rows in (slice(0, 12), slice(12, 20))]  # fmt: skip
    both = build_problem(robot, replace(table, own=tuple(parts)))
    assert both.data.landmarks.names == ["A", "B", "C"]
    with pytest.raises(ProblemError, match="lengths: the same CustomMeasurements twice, expected every"):
        build_problem(robot, replace(table, own=(own, own)))


def test_a_landmark_of_one_name_in_another_frame_is_another():
    """In a table with a frame of its own the tool, and so the anchor, is seen in that frame."""
    robot, _, table = lengths_to_anchors(0, n=20)
    rng = np.random.default_rng(0)
    m = measure(robot, 20, rng, sigma=SIGMA, frame=PLACED, readings=table.measurements.readings)
    other = Table(m, "position", frame="unknown", own=(replace(table.own[0], data=table.own[0].data + 0.1),))
    assert len(build_problem(robot, [table, other]).data.landmarks.names) == 6


def write_tables(folder, robot, tables, **keys):
    write_robot(folder / "robot.yaml", robot)
    for name, columns in (one for table in tables for one in table_columns(table, robot, Units()).items()):
        write_csv(folder / name, columns)
    tracker = {"table": "tracker.csv", "model": "position", "frame": "unknown", "noise": {"position": SIGMA[0]}}
    bar = {"table": "bar.csv", "pairs": "lengths.csv", "model": "distance", "noise": {"distance": 2e-4}}
    job = {"robot": "robot.yaml", "units": {"length": "m", "angle": "rad"}, "measurements": [tracker, bar]}
    job |= {"noise": {"joint": 5e-4, "position": 1.0}}
    path = folder / "job.yaml"
    path.write_text(yaml.safe_dump(job | keys))
    return path


def test_a_job_of_several_tables_runs(fg_calib, tmp_path):
    robot, _, tables = mixture(11, sigma_joint=5e-4)
    ended = fg_calib("calibrate", write_tables(tmp_path, robot, tables), "--out", tmp_path / "result")
    expected = assess(solve(build_problem(robot, tables)))
    document = json.loads((tmp_path / "result" / "result.json").read_text())
    assert (ended.code, ended.err) == (0, "")
    assert "position of tracker.csv" in ended.out
    assert "distance of bar.csv" in ended.out
    assert document["chi2"] == pytest.approx(expected.fit.chi_square.value, rel=1e-6)
    assert document["model"] == "position + distance"
    assert sorted(document["inputs"]) == ["bar.csv", "job.yaml", "lengths.csv", "robot.yaml", "tracker.csv"]
    rows = pl.read_csv(tmp_path / "result" / "residuals.csv")
    assert rows.group_by("table").len().sort("table").rows() == [("bar.csv", 15), ("tracker.csv", 48)]


def test_two_tables_that_contradict_each_other_are_refused():
    robot, _, tables = mixture(12)
    moved = tables[1].measurements.readings.copy()
    moved[2, 1] += 1e-6
    other = replace(tables[1], measurements=replace(tables[1].measurements, readings=moved))
    expected = r"^bar\.csv: other joint readings at id 2, expected those of tracker\.csv, or another id$"
    with pytest.raises(ProblemError, match=expected):
        build_problem(robot, [tables[0], other])
    noisy = replace(tables[1], measurements=replace(tables[1].measurements, sigma_joint=np.full(4, 1e-3)))
    with pytest.raises(ProblemError, match=r"^bar\.csv: another noise\.joint, expected that of tracker\.csv: "):
        build_problem(robot, [tables[0], noisy])


@pytest.mark.parametrize(("models", "said"), [
    (("pose", "pose"), "the same (orientations|positions) as in measurements"),
    (("pose", "reversed"), "the same (orientations|positions) as in measurements"),
    (("pose", "a part"), "the same (orientations|positions) as in measurements"),
    (("pose", "position"), "the same positions as in measurements"),
    (("distance", "position"), "the same positions as in measurements"),
    (("rotation", "position"), None),
    (("orientation", "position"), None),
])  # fmt: skip
def test_a_table_given_twice_is_refused(models, said):
    rng = np.random.default_rng(9)
    robot = small_arm(tolerance=LARGE)
    m = measure(true_robot(robot, rng), 12, rng, sigma=SIGMA)
    places = {"reversed": np.arange(12)[::-1], "a part": np.arange(5)}

    def table(model):
        return Table(m.select(places.get(model, np.arange(12))), "pose" if model in places else model)

    tables = [table(model) for model in models]
    if said is None:
        assert build_problem(robot, tables).n_residuals
        return
    with pytest.raises(ProblemError, match=said):
        build_problem(robot, tables)


@pytest.mark.parametrize("model", ["pose", "position", "distance-rotation"])
def test_a_block_that_was_pasted_twice_into_a_table_is_warned_of(model, caplog):
    rng = np.random.default_rng(9)
    robot = small_arm(tolerance=LARGE)
    m = measure(true_robot(robot, rng), 12, rng, sigma=SIGMA)

    def pasted(rows):
        """These rows, some of them perhaps again, by names of their own."""
        return replace(m.select(np.array(rows)), ids=np.arange(len(rows)).astype(str))

    found = "have the readings and figures of an earlier one, such as 0 and 12; were they copied? They count as often"
    for rows, n in (([*range(12), *range(12)], 12), ([*range(12), 0], 1)):
        build_problem(robot, [Table(pasted(rows), model)])
        assert [r.message for r in caplog.records] == [f"measurements: {n} rows {found}"]
        caplog.clear()
    again = pasted([*range(12), *range(12)])
    build_problem(robot, [Table(replace(again, position=again.position + rng.normal(size=(24, 3)) * 1e-4), model)])
    build_problem(robot, [Table(replace(again, test=np.arange(24) >= 12), model)])
    assert caplog.records == []


def test_pairs_in_both_directions_are_warned_of_and_repeats_are_not(caplog):
    robot, _, (_, table) = mixture(11)
    m, p = table.measurements, table.measurements.pairs
    twice = p.select(np.tile(np.arange(p.n_pairs), 2))
    back = np.arange(twice.n_pairs) >= p.n_pairs
    both = replace(twice, a=np.where(back, twice.b, twice.a), b=np.where(back, twice.a, twice.b))
    for pairs in (twice, both):
        build_problem(robot, [Table(replace(m, pairs=pairs), "distance")])
        assert ["15 rows have the readings and figures of an earlier one, such as 0-1;" in r.message
                for r in caplog.records] == [True]  # fmt: skip
        caplog.clear()
    repeats = replace(both, distance=both.distance + 1e-4 * back)
    assert build_problem(robot, [Table(replace(m, pairs=repeats), "distance")]).n_residuals == 30
    assert caplog.records == []


def test_pairs_measured_again_are_not_the_same():
    rng = np.random.default_rng(9)
    q = rng.uniform(-np.pi, np.pi, (10, 4))
    robot = small_arm(tolerance=LARGE)
    m = replace(measure(robot, 10, rng, readings=q), pairs=pairs_of(robot, q, rng))
    other = replace(m, pairs=replace(m.pairs, distance=m.pairs.distance + 1e-5))
    assert build_problem(robot, [Table(m, "distance"), Table(other, "distance")]).n_residuals == 18
    with pytest.raises(ProblemError, match="the same distances as in"):
        build_problem(robot, [Table(m, "distance"), Table(m, "distance-rotation")])


@pytest.mark.slow
def test_a_loss_that_drops_a_whole_table_is_a_finding():
    rng = np.random.default_rng(3)
    robot = small_arm(tolerance=LARGE)
    true = true_robot(robot, rng)
    good = measure(true, 20, rng, sigma=(1e-4, 1e-4))
    bad = measure(true, 8, rng, sigma=(1e-4, 1e-4))
    bad = replace(bad, position=bad.position + 0.3 * rng.normal(size=(8, 3)), source="bad.csv")
    found = assess(solve(build_problem(robot, [good, bad], model="position", loss="gnc")))
    said = "loss gnc takes 8 of 8 measurements of position of bad.csv for outliers: more than it can tell from noise"
    assert said in found.verdict.errors


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("model", ["distance-rotation", "distance", "pose"])
def test_test_rows_have_no_say_in_the_fit(model, apart):
    rng = np.random.default_rng(3)
    robot = small_arm(tolerance=LARGE)
    m = measure(true_robot(robot, rng), 20, rng, sigma_joint=1e-4, n_test=12)
    train, test = m.select(np.flatnonzero(~m.test)), m.select(np.flatnonzero(m.test))
    together = [Table(part, model) for part in (train, replace(test, source="others"))] if apart else Table(m, model)
    alone, both = (build_problem(robot, tables) for tables in (Table(train, model), together))
    fitted, both = solve(alone), solve(both)
    sigma = np.sqrt(np.diag(assess(fitted).spread.tangent))
    step = fitted.problem.variables.step(fitted.parameters, both.parameters) / sigma
    assert np.abs(step).max() < 1e-6
