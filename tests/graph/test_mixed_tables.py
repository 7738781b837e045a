"""Several tables in one job, each with its kind, frame and noise: one optimum, honest sigmas, tables told apart."""

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import scipy.optimize
import yaml
from instruments import measured_by
from scipy.spatial.transform import Rotation
from simulated import measure, paper_robot, small_arm, true_robot, write_job
from sparing import diagonal
from test_own_kind import measured
from touches import corners, touch

from fg_calib import Measurements, Robot, read_job
from fg_calib.assessment import assess
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve
from fg_calib.inputs import InputError, ProblemError
from fg_calib.io import write_robot
from fg_calib.io.columns import write_csv
from fg_calib.measurements.dataset import Groups, Pairs, no_pairs
from fg_calib.measurements.table import Table
from fg_calib.options import Pairing
from fg_calib.robot.kinematics import pose
from fg_calib.statistics.variance_components import estimate_noise

TOLERANCE = {"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3}
PLACED = (Rotation.from_rotvec([0.4, -1.1, 2.0]), np.array([3.0, -1.0, 0.5]))
ELSEWHERE = (Rotation.from_rotvec([-2.0, 0.3, 0.7]), np.array([-2.0, 4.0, 1.0]))
SIGMA = (5e-4, 5e-4)


def pairs_of(true, q, rng, sigma=2e-4):
    """Distances measured between each configuration and the next, at the true joint values q."""
    p = pose(true, q).position
    n = len(q) - 1
    d = np.linalg.norm(np.diff(p, axis=0), axis=1) + sigma * rng.normal(size=n)
    nothing, rows = np.full(n, np.nan), np.arange(n)
    return Pairs(rows, rows + 1, d, nothing, np.full(n, sigma), nothing, np.zeros(n, bool), "pairs.csv")


def mixture(seed, *, n=16, sigma_joint=0.0, shared=True):
    """Positions by a tracker somewhere, and lengths of a ball bar, at the same configurations or at others."""
    rng = np.random.default_rng(seed)
    robot = small_arm(tolerance=TOLERANCE)
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


def everything(robot, tables, sigma_joint):
    """Optimum over arm, frame and joint values of shared configurations, by scipy."""
    tracker, bar = (t.measurements for t in tables)
    scale = np.array([p.scale if p.estimated else 0.0 for p in robot.parameters])
    columns = np.flatnonzero(scale)
    k = len(columns)

    def residuals(x):
        values = robot.nominal
        values[columns] += x[:k] * scale[columns]
        turn, shift = PLACED[0] * Rotation.from_rotvec(x[k : k + 3]), PLACED[1] + x[k + 3 : k + 6]
        q = tracker.readings + (sigma_joint * x[k + 6 :].reshape(tracker.readings.shape) if sigma_joint else 0.0)
        p = pose(robot.with_values(values), q).position
        lengths = np.linalg.norm(np.diff(p, axis=0), axis=1)
        rows = [(turn.apply(p) + shift - tracker.position) / SIGMA[0], (lengths - bar.pairs.distance) / 2e-4]
        return np.concatenate([*(r.ravel() for r in rows), x[:k], x[k + 6 :]])

    start = np.zeros(k + 6 + (tracker.readings.size if sigma_joint else 0))
    found = scipy.optimize.least_squares(residuals, start, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12)
    values = robot.nominal
    values[columns] += found.x[:k] * scale[columns]
    return values, 2.0 * found.cost


@pytest.mark.slow
@pytest.mark.parametrize("sigma_joint", [pytest.param(0.0, marks=pytest.mark.slow), 1e-3])
def test_the_optimum_is_that_over_everything(sigma_joint):
    """Joint errors of a configuration are the same in both tables."""
    robot, _, tables = mixture(1, sigma_joint=sigma_joint)
    options = {"encoder": "estimated"} if sigma_joint else {}
    solution = solve(build_problem(robot, tables, **options))
    values, least = everything(robot, tables, sigma_joint)
    uncertainty = assess(solution)
    sigma = np.array([p.sigma or 1.0 for p in uncertainty.estimates.parameters])
    assert solution.converged
    assert np.abs((solution.parameters[: len(values)] - values) / sigma).max() < 1e-4  # where scipy stops
    assert uncertainty.fit.chi_square.value == pytest.approx(least, rel=1e-6)
    assert uncertainty.fit.chi_square.dof == 3 * 16 + 15 - 6
    propagated = solve(build_problem(robot, tables))
    apart = np.abs((propagated.parameters[: len(values)] - values) / sigma).max()
    assert apart < (0.5 if sigma_joint else 1e-4)  # to first order the same


@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
@pytest.mark.parametrize("shared", [True, False])
def test_sigmas_are_honest(shared):
    """60 draws: the mean of NEES over its degrees of freedom, within five of its sigmas."""
    total, n = 0.0, 60
    for seed in range(n):
        robot, true, tables = mixture(200 + seed, sigma_joint=5e-4, shared=shared)
        uncertainty = assess(solve(build_problem(robot, tables)))
        names = list(uncertainty.names)
        off = np.array([uncertainty.robot.nominal[robot.index(x)] - true.nominal[robot.index(x)] for x in names])
        total += float(off @ np.linalg.solve(uncertainty.covariance, off)) / len(names) / n
    assert total == pytest.approx(1.0, abs=5 * np.sqrt(2.0 / (n * len(names))))


@pytest.mark.long
@pytest.mark.usefixtures("without_reasons")
def test_sigmas_are_honest_where_a_loss_loses_less_of_lengths_than_of_poses():
    """Cauchy keeps 92 % of what a clean length says, 64 % of what a pose does; both share the joints' errors."""
    nees = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        robot = small_arm(tolerance=TOLERANCE)
        true = true_robot(robot, rng)
        stood = rng.uniform(-np.pi, np.pi, (60, 4))
        m = measure(true, 60, rng, sigma=SIGMA, frame=PLACED, readings=stood)
        read = stood + 1e-4 * rng.normal(size=stood.shape)
        m = replace(m, readings=read, sigma_joint=np.full(4, 1e-4), named=True)
        bar = replace(m, position=None, rotation=None, pairs=pairs_of(true, stood, rng), source="bar.csv")
        tables = [Table(m, "pose", frame="unknown"), Table(bar, "distance")]
        found = assess(solve(build_problem(robot, tables, loss="cauchy")))
        error = (found.robot.nominal - true.nominal)[[robot.index(name) for name in found.names]]
        sigma = np.sqrt(np.diag(found.covariance))
        z = error / sigma
        nees.append(float(z @ np.linalg.solve(found.covariance / np.outer(sigma, sigma), z)) / 16)
    # 1.15 where all measurements count as poses; the standard error of the mean is sqrt(2 / 16 / 60) = 0.046.
    assert np.mean(nees) == pytest.approx(1.0, abs=2.5 * np.sqrt(2 / 16 / 60))


def test_each_table_has_its_own_frame():
    rng = np.random.default_rng(5)
    robot = paper_robot({"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3})
    true = true_robot(robot, rng)
    first, second = (measure(true, 25, rng, sigma=SIGMA, frame=frame) for frame in (PLACED, ELSEWHERE))
    tables = [Table(first, "pose", frame="unknown"), Table(second, "position", frame="unknown")]
    uncertainty = assess(solve(build_problem(robot, tables)))
    assert len(uncertainty.estimates.frames) == 2
    for found, (turn, shift) in zip(uncertainty.estimates.frames, (PLACED, ELSEWHERE), strict=True):
        off = np.concatenate([(turn.inv() * Rotation.from_quat(found.quaternion_xyzw)).as_rotvec(), found.xyz - shift])
        assert np.all(np.abs(off[:3]) < 6 * found.sigma[:3])
        assert np.linalg.norm(off[3:]) < 6 * np.linalg.norm(found.sigma[3:])
    together = np.sqrt(np.diag(uncertainty.covariance))
    alone = np.sqrt(np.diag(assess(solve(build_problem(robot, tables[0]))).covariance))
    assert np.all(together <= alone * (1 + 1e-9))


@pytest.mark.slow
def test_order_of_tables_and_one_table_in_parts_change_nothing():
    rng = np.random.default_rng(6)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 30, rng, sigma=SIGMA, sigma_joint=3e-4)
    parts = [
        replace(m, readings=m.readings[rows], ids=m.ids[rows], test=m.test[rows], position=m.position[rows],
                rotation=m.rotation[rows], sigma_position=m.sigma_position[rows],
                sigma_orientation=m.sigma_orientation[rows])
        for rows in (slice(0, 12), slice(12, 30))
    ]  # fmt: skip
    whole = assess(solve(build_problem(robot, m, model="pose")))
    for tables in (parts, parts[::-1]):
        found = assess(solve(build_problem(robot, tables, model="pose")))
        assert np.array([p.estimate for p in found.estimates.parameters]) == pytest.approx(
            np.array([p.estimate for p in whole.estimates.parameters]),
            abs=1e-6 * np.nanmin([p.sigma or 1 for p in whole.estimates.parameters]),
        )
        assert found.fit.chi_square.value == pytest.approx(whole.fit.chi_square.value, rel=1e-9)
        assert found.fit.chi_square.dof == whole.fit.chi_square.dof


@pytest.mark.slow
def test_a_point_of_one_name_in_two_tables_is_one_point():
    """Touches of three sockets, the last of them and the distances in a second table: the same as one table."""
    rng = np.random.default_rng(7)
    robot = small_arm(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    m = touch(true, corners(robot, 3, rng), 8, rng, distances=((1, 2, 1e-5),))
    of_first = np.arange(24) < 13  # the second socket has touches in both
    none = no_pairs("first.csv")

    def part(rows, pairs, source):
        names = tuple(np.array(m.groups.names)[np.unique(m.groups.index[rows])])
        index = np.searchsorted(names, np.array(m.groups.names)[m.groups.index[rows]])
        place = np.searchsorted(names, np.array(m.groups.names)) if pairs.n_pairs else None
        pairs = replace(pairs, a=place[pairs.a], b=place[pairs.b]) if pairs.n_pairs else pairs
        return replace(
            m, readings=m.readings[rows], ids=m.ids[rows], test=m.test[rows], sigma_point=m.sigma_point[rows],
            groups=Groups(names, index, pairs), source=source,
        )  # fmt: skip

    first, second = part(of_first, none, "first.csv"), part(~of_first, m.groups.pairs, "second.csv")
    one, two = (assess(solve(build_problem(robot, given, model="distance"))) for given in (m, [first, second]))
    assert [p.name for p in two.estimates.landmarks] == [p.name for p in one.estimates.landmarks] == ["g0", "g1", "g2"]
    assert [p.n for p in two.estimates.landmarks] == [8, 8, 8]
    sigma = np.array([p.sigma or np.inf for p in one.estimates.parameters])
    off = (
        np.array([p.estimate for p in two.estimates.parameters]) - [p.estimate for p in one.estimates.parameters]
    ) / sigma
    # Both are solved until a step is 1e-9 sigma; sums in another order.
    assert np.abs(off).max() < 1e-6
    assert (two.fit.chi_square.dof, two.fit.chi_square.value) == (
        one.fit.chi_square.dof,
        pytest.approx(one.fit.chi_square.value, rel=1e-9),
    )


def test_an_unknown_of_one_name_started_at_two_places_is_refused():
    robot, _, table = measured(0, n=20)
    (own,) = table.own
    again = replace(own, unknowns=own.unknowns + 0.01)
    with pytest.raises(ProblemError, match=r"start \[.*\] of unknown A, expected that of the other A: \["):
        build_problem(robot, replace(table, own=(own, again)))
    parts = [replace(own, data=own.data[rows], ends=np.arange(20)[rows, None], which=own.which[rows], test=None)
             for rows in (slice(0, 12), slice(12, 20))]  # fmt: skip
    both = build_problem(robot, replace(table, own=tuple(parts)))
    assert both.data.unknowns.names == ["A", "B", "C"]
    with pytest.raises(ProblemError, match="lengths: the same CustomMeasurements twice, expected every"):
        build_problem(robot, replace(table, own=(own, own)))


def test_an_unknown_of_one_name_in_another_frame_is_another():
    """In a table with a frame of its own the tool, and so the anchor, is seen in that frame."""
    robot, _, table = measured(0, n=20)
    rng = np.random.default_rng(0)
    m = measure(robot, 20, rng, sigma=SIGMA, frame=PLACED, readings=table.measurements.readings)
    elsewhere = Table(m, "position", frame="unknown", own=(replace(table.own[0], data=table.own[0].data + 0.1),))
    assert len(build_problem(robot, [table, elsewhere]).data.unknowns.names) == 6


@pytest.mark.slow
def test_noise_is_estimated_table_by_table():
    rng = np.random.default_rng(7)
    robot = paper_robot({"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3})
    true = true_robot(robot, rng)
    coarse, fine = (measure(true, 80, rng, sigma=(s, 2e-4)) for s in (2e-3, 2e-4))
    stated = [replace(m, sigma_position=np.full((80, 3), 1e-3)) for m in (coarse, fine)]
    tables = [Table(m, "position") for m in stated]
    found = estimate_noise(build_problem(robot, tables))
    assert found.converged
    factors = found.problem.state.factors
    assert factors[0, "position"] == pytest.approx(2.0, rel=0.2)  # 80 rows of three: 5 % each, four sigma
    assert factors[1, "position"] == pytest.approx(0.2, rel=0.2)
    kinds = assess(found).fit.goodness.kinds
    assert [(kind.table, kind.kind) for kind in kinds] == [(0, "position"), (1, "position")]


@pytest.mark.slow
def test_a_gross_error_in_one_table_is_left_out():
    robot, _, tables = mixture(8, n=40)
    wrong = tables[1].measurements.pairs.distance.copy()
    wrong[3] += 0.05
    m = replace(tables[1].measurements, pairs=replace(tables[1].measurements.pairs, distance=wrong))
    solution = solve(build_problem(robot, [tables[0], replace(tables[1], measurements=m)], loss="cauchy"))
    weights = solution.problem.state.weights
    assert solution.converged
    assert weights[1][3] < 0.01
    assert weights[0].min() > 0.1
    rows = assess(solution)
    worst = rows.fit.goodness.suspects[0]
    assert (rows.fit.residuals.series[worst], rows.fit.residuals.measurement[worst]) == (1, 3)


# --- through files ----------------------------------------------------------------------------------------------------


def write_tables(folder, robot, tables, **keys):
    write_robot(folder / "robot.yaml", robot)
    tracker, bar = (t.measurements for t in tables)
    q = {f"q{i + 1}": x for i, x in enumerate(tracker.readings.T)}
    write_csv(folder / "tracker.csv", {"id": tracker.ids, **q, **dict(zip("xyz", tracker.position.T, strict=True))})
    other = {f"q{i + 1}": x for i, x in enumerate(bar.readings.T)}
    write_csv(folder / "bar.csv", {"id": bar.ids, **other})
    p = bar.pairs
    write_csv(folder / "lengths.csv", {"a": bar.ids[p.a], "b": bar.ids[p.b], "distance": p.distance})
    job = {
        "robot": "robot.yaml",
        "units": {"length": "m", "angle": "rad"},
        "noise": {"joint": 5e-4, "position": 1.0},
        "measurements": [
            {"table": "tracker.csv", "model": "position", "frame": "unknown", "noise": {"position": SIGMA[0]}},
            {"table": "bar.csv", "pairs": "lengths.csv", "model": "distance", "noise": {"distance": 2e-4}},
        ],
    }
    path = folder / "job.yaml"
    path.write_text(yaml.safe_dump(job | keys))
    return path


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("models", "said"),
    [
        (("pose", "pose"), "the same (orientations|positions) as in measurements"),
        (("pose", "reversed"), "the same (orientations|positions) as in measurements"),
        (("pose", "a part"), "the same (orientations|positions) as in measurements"),
        (("pose", "position"), "the same positions as in measurements"),
        (("distance", "position"), "the same positions as in measurements"),
        (("rotation", "position"), None),
        (("orientation", "position"), None),
    ],
)
def test_a_table_that_is_there_twice_is_refused(models, said):
    rng = np.random.default_rng(9)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 12, rng, sigma=SIGMA)
    places = {"reversed": np.arange(12)[::-1], "a part": np.arange(5)}

    def table(model):
        rows = places.get(model, np.arange(12))
        part = {name: getattr(m, name)[rows] for name in ("readings", "ids", "test", "position", "rotation")}
        sigmas = {name: getattr(m, name)[rows] for name in ("sigma_position", "sigma_orientation")}
        return Table(replace(m, **part, **sigmas), "pose" if model in places else model)

    tables = [table(model) for model in models]
    if said is None:
        assert build_problem(robot, tables).n_residuals
        return
    with pytest.raises(ProblemError, match=said):
        build_problem(robot, tables)


def pasted(m, rows):
    """Measurements with these rows, some of them perhaps again, by names of their own."""
    parts = {name: getattr(m, name)[rows] for name in ("readings", "test", "position", "rotation")}
    sigmas = {name: getattr(m, name)[rows] for name in ("sigma_position", "sigma_orientation")}
    return replace(m, ids=np.arange(len(rows)).astype(str), **parts, **sigmas)


@pytest.mark.parametrize("model", ["pose", "position", "distance-rotation"])
def test_a_block_that_was_pasted_twice_into_a_table_is_told_of(model, caplog):
    rng = np.random.default_rng(9)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 12, rng, sigma=SIGMA)
    found = "have the readings and figures of an earlier one, such as 0 and 12; were they copied? They count as often"
    for rows, n in (([*range(12), *range(12)], 12), ([*range(12), 0], 1)):
        build_problem(robot, [Table(pasted(m, rows), model)])
        assert [r.message for r in caplog.records] == [f"measurements: {n} rows {found}"]
        caplog.clear()
    again = pasted(m, [*range(12), *range(12)])
    build_problem(robot, [Table(replace(again, position=again.position + rng.normal(size=(24, 3)) * 1e-4), model)])
    build_problem(robot, [Table(replace(again, test=np.arange(24) >= 12), model)])
    assert caplog.records == []


def test_pairs_in_both_directions_are_told_of_and_repeats_are_not(caplog):
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


def test_other_pairs_of_the_same_poses_are_not_the_same():
    rng = np.random.default_rng(9)
    q = rng.uniform(-np.pi, np.pi, (10, 4))
    robot = small_arm(tolerance=TOLERANCE)
    m = replace(measure(robot, 10, rng, readings=q), pairs=pairs_of(robot, q, rng))
    other = replace(m, pairs=replace(m.pairs, a=m.pairs.b, b=m.pairs.a))
    assert build_problem(robot, [Table(m, "distance"), Table(other, "distance")]).n_residuals == 18
    with pytest.raises(ProblemError, match="the same distances as in"):
        build_problem(robot, [Table(m, "distance"), Table(m, "distance-rotation")])


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"measurements": []}, "job.yaml: measurements: found [], expected a path, or a list of tables"),
        ({"measurements": [{"table": "tracker.csv"}]}, "job.yaml: measurement 1: missing key 'model'"),
        ({"measurements": [{"model": "position"}]}, "job.yaml: measurement 1: missing key 'table'"),
        (
            {"pairs": "lengths.csv"},
            "job.yaml: pairs: next to a list of tables, expected the key in the table's own entry",
        ),
        (
            {"measurements": [{"table": "tracker.csv", "model": "position", "loss": "huber"}]},
            "job.yaml: measurement 1: unknown key 'loss'",
        ),
    ],
)
def test_a_mistake_in_the_list_of_tables_is_named(fg_calib, tmp_path, keys, said):
    robot, _, tables = mixture(13)
    ended = fg_calib("calibrate", write_tables(tmp_path, robot, tables, **keys))
    assert ended.code == 1
    assert ended.err.startswith(f"error: {said}")
    assert ended.err.count("\n") == 1


def test_pairs_formed_of_one_table_are_mixed_with_poses_of_another():
    """Star pairs share the errors of their poses; the other table none of these."""
    rng = np.random.default_rng(14)
    robot = paper_robot({"a": 5e-3, "d": 5e-3, "alpha": 1e-3, "theta": 1e-3, "beta": 1e-3})
    true = true_robot(robot, rng)
    first, second = measure(true, 30, rng, sigma=(1e-3, 2e-4)), measure(true, 20, rng, sigma=(5e-4, 2e-4))
    alone = [
        build_problem(robot, first, model="distance-rotation", pairing=Pairing("star")),
        build_problem(robot, second, model="pose"),
    ]
    tables = [Table(first, "distance-rotation", Pairing("star")), Table(second, "pose")]
    both = build_problem(robot, tables)
    at = both.start
    cost = [p.graph.error(p.initial) for p in (*alone, both)]
    # Priors are zero at nominal, where all of them start.
    assert cost[2] == pytest.approx(cost[0] + cost[1], rel=1e-12)
    assert both.n_residuals == alone[0].n_residuals + alone[1].n_residuals
    assert np.array_equal(at, alone[0].start)


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "encoder"), diagonal(["cauchy", "gnc"], ["propagated", "estimated"]))
def test_a_loss_weighs_more_pairs_than_positions_that_share_joint_noise(loss, encoder):
    """Lengths lose less than positions: no measurement may count for more than it is by that."""
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    stood = rng.uniform(-np.pi, np.pi, (20, 4))
    m = measure(true, 20, rng, sigma=(1e-4, 1e-4), readings=stood)
    read = stood + 3e-4 * rng.normal(size=stood.shape)
    m = replace(m, readings=read, sigma_joint=np.full(4, 3e-4), named=True)
    a, b = np.triu_indices(20, 1)
    a, b = a[::4], b[::4]
    p = pose(true, stood).position
    d = np.linalg.norm(p[a] - p[b], axis=1) + 1e-4 * rng.normal(size=len(a))
    d[::20] += 0.02
    nothing = np.full(len(a), np.nan)
    pairs = Pairs(a, b, d, nothing, np.full(len(a), 1e-4), nothing, np.zeros(len(a), bool), "pairs.csv")
    tables = [Table(m, "position"), Table(replace(m, position=None, pairs=pairs, source="bar"), "distance")]
    found = assess(solve(build_problem(robot, tables, loss=loss, encoder=encoder)))
    z = [(p.estimate - t) / p.sigma for p, t in zip(found.estimates.parameters, true.nominal, strict=True) if p.sigma]
    assert np.abs(z).max() < 4.5  # of 16 parameters
    assert not found.verdict.errors


@pytest.mark.slow
def test_a_loss_that_drops_a_whole_table_is_a_finding():
    rng = np.random.default_rng(3)
    robot = small_arm(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    good = measure(true, 20, rng, sigma=(1e-4, 1e-4))
    bad = measure(true, 8, rng, sigma=(1e-4, 1e-4))
    bad = replace(bad, position=bad.position + 0.3 * rng.normal(size=(8, 3)), source="bad.csv")
    found = assess(solve(build_problem(robot, [good, bad], model="position", loss="gnc")))
    said = "loss gnc takes 8 of 8 measurements of position of bad.csv for outliers: more than it can tell from noise"
    assert said in found.verdict.errors


@pytest.mark.slow
def test_a_mistake_in_one_table_names_the_table():
    rng = np.random.default_rng(4)
    robot = small_arm(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    first, second = (measure(true, 30, rng, sigma=(1e-4, 1e-4)) for _ in range(2))
    second = replace(second, position=second.position * 1e3, source="second.csv")
    found = assess(solve(build_problem(robot, [first, second], model="position")))
    assert found.verdict.setup.table == "second.csv"
    assert found.verdict.errors[0].startswith("second.csv: position residuals fall from ")
    assert "if x, y, z are in mm" in found.verdict.errors[0]


@pytest.mark.slow
def test_another_target_on_the_tool_in_one_table_is_named():
    rng = np.random.default_rng(5)
    robot = small_arm(
        tolerance=dict.fromkeys(TOLERANCE, 2e-4) | {"tool": 2e-3}, estimate=("tool.x", "tool.y", "tool.z")
    )
    true = true_robot(robot, rng)
    values = true.nominal
    values[[true.index(f"tool.{k}") for k in "xyz"]] += [0.06, -0.02, 0.03]
    first = measure(true, 30, rng, sigma=(1e-4, 1e-4))
    second = replace(measure(true.with_values(values), 30, rng, sigma=(1e-4, 1e-4)), source="second.csv")
    found = assess(solve(build_problem(robot, [first, second], model="position")))
    assert "if tool or base differ from those of the other tables" in found.verdict.errors[0]


@pytest.mark.slow
def test_a_distance_between_points_that_another_table_touched(tmp_path):
    """The distance stands beside another table than the touches: the same as beside these."""
    rng = np.random.default_rng(7)
    robot = small_arm(tolerance=TOLERANCE)
    true = true_robot(robot, rng)
    m = touch(true, corners(robot, 3, rng), 8, rng, distances=((1, 2, 1e-5),))
    tracker = measure(true, 10, rng, sigma=SIGMA)
    path = write_job(tmp_path, robot, m)
    columns = {f"q{i + 1}": q for i, q in enumerate(tracker.readings.T)}
    write_csv(tmp_path / "tracker.csv", columns | dict(zip("xyz", tracker.position.T, strict=True)))
    noise = {"position": SIGMA[0], "point": float(m.sigma_point[0])}
    touches, poses = {"table": "poses.csv", "model": "distance"}, {"table": "tracker.csv", "model": "distance"}
    found = []
    for tables in (
        [touches | {"pairs": "pairs.csv"}, poses],
        [touches, poses | {"pairs": "pairs.csv"}],
        [poses | {"pairs": "pairs.csv"}, touches],
    ):
        path.write_text(yaml.safe_dump({"robot": "robot.yaml", "noise": noise, "measurements": tables}))
        job = read_job(path)
        (between,) = [t.measurements.groups.pairs for t in job.tables
                      if t.measurements.groups is not None and t.measurements.groups.pairs.n_pairs]  # fmt: skip
        assert not between.test.any()
        problem = build_problem(job.robot, job.tables)
        of_points = [s for s in problem.data.series if s.kind.n_nuisances]
        found.append({s.kind.names[0]: len(s.train) for s in of_points})
    assert found == 3 * [{"point.x": 24, "distance": 1}]


def test_points_of_another_table_are_named_where_arrays_are_given():
    pairs = {"a": ["left"], "b": ["right"], "distance": [0.2], "sigma_distance": [1e-5]}
    m = Measurements.from_arrays(np.zeros((3, 4)), pairs=pairs, points=["left", "right"])
    assert (m.groups.names, m.groups.pairs.test.tolist()) == (("left", "right"), [False])
    with pytest.raises(InputError, match="pairs: a: row 0: found 'left', expected an id"):
        Measurements.from_arrays(np.zeros((3, 4)), pairs=pairs)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("instrument", ["anchors", "planes", "board"])
def test_an_anchor_plane_or_board_of_one_name_in_two_tables_is_one(instrument):
    """Started by the first table's rows, solved as in one table: to what the rounding of its optimum leaves."""
    robot, _, table = measured_by(instrument, np.random.default_rng(0), n=60)
    m = table.measurements
    parts = [
        replace(table, measurements=replace(m.select(rows), source=source))
        for source, rows in (("monday", np.arange(24)), ("tuesday", np.arange(24, 60)))
    ]
    whole, mixed = (assess(solve(build_problem(robot, tables))) for tables in (table, parts))
    rows = [robot.index(name) for name in whole.names]
    off = (mixed.robot.nominal - whole.robot.nominal)[rows] / np.sqrt(np.diag(whole.covariance))
    assert np.abs(off).max() < 1e-4
    named = [[p.name for p in u.estimates.landmarks if not p.name.startswith("offset of")] for u in (mixed, whole)]
    assert named[0] == named[1]
    assert mixed.fit.chi_square.value == pytest.approx(whole.fit.chi_square.value, rel=1e-6)


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("model", ["distance-rotation", "distance", "pose"])
def test_test_rows_have_no_say_in_the_fit(model, apart):
    rng = np.random.default_rng(3)
    robot = small_arm(tolerance=TOLERANCE)
    m = measure(true_robot(robot, rng), 20, rng, sigma_joint=1e-4, n_test=12)
    train, test = m.select(np.flatnonzero(~m.test)), m.select(np.flatnonzero(m.test))
    together = [Table(part, model) for part in (train, replace(test, source="others"))] if apart else Table(m, model)
    alone, beside = (build_problem(robot, tables) for tables in (Table(train, model), together))
    fitted, beside = solve(alone), solve(beside)
    sigma = np.sqrt(np.diag(assess(fitted).spread.tangent))
    step = fitted.problem.variables.step(fitted.parameters, beside.parameters) / sigma
    assert np.abs(step).max() < 1e-6


def test_estimated_joint_errors_of_two_tables_are_shared_whatever_is_asked():
    """Of direct pairs they are all that is shared: counted as independent they end in the same covariance."""
    rng, rows = np.random.default_rng(0), [[0.4, 0.3, 0.2, 0.0], [0.3, -1.2, 0.1, 0.0], [0.5, 0.7, 0.1, 0.0]]
    robot = Robot.from_dh(rows, tolerance={"a": 1e-3, "d": 1e-3, "alpha": 1e-3, "theta": 1e-3})

    def chain(source):
        q, a = rng.uniform(-2.0, 2.0, (30, 3)), np.arange(29)
        p = pose(robot, q).position
        distance = np.linalg.norm(p[1:] - p[:-1], axis=1) + 1e-4 * rng.normal(size=29)
        pairs = {"a": a, "b": a + 1, "distance": distance, "sigma_distance": 1e-4}
        return Table(Measurements.from_arrays(q, pairs=pairs, sigma_joint=1e-4, source=source), "distance")

    tables = [chain("one"), chain("two")]
    found = [
        assess(solve(build_problem(robot, tables, encoder="estimated", pair_errors=asked))).covariance
        for asked in ("shared", "independent")
    ]
    assert found[1] == pytest.approx(found[0], rel=1e-9, abs=1e-20)
