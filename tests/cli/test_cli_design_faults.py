"""`fg-calib design`: what is there is not lost, and what is written can be filled in and used."""

import math
import re

import polars as pl
import pytest
import yaml

from fg_calib import design, read_scenario
from fg_calib.report.plan_files import draw_designs

ROBOT = """
name: scara
convention: dh
units: {length: mm, angle: deg}
joints:
  - {a: 325, alpha: 0, d: 400, theta: 0, limits: [-150, 150]}
  - {a: 275, alpha: 180, d: 0, theta: 0, limits: [-140, 140]}
  - {a: 0, alpha: 0, d: 50, theta: 0, type: prismatic, limits: [0, 200]}
tolerance: {a: 0.5, d: 0.5, alpha: 0.1, theta: 0.3}
"""

TRACKER = {"model": "position", "name": "tracker"}

SOCKETS = {"a": {"x": 400, "y": 0, "z": 200}, "b": {"x": 300, "y": 200, "z": 200}}

FEW = ("--candidates", 12)


@pytest.fixture
def plan(tmp_path):
    """`plan(instruments, **keys)`: a scenario file of a small arm."""
    (tmp_path / "robot.yaml").write_text(ROBOT)

    def write(*instruments, name="plan.yaml", **keys):
        scenario = {
            "robot": "robot.yaml",
            "units": {"length": "mm", "angle": "deg"},
            "errors": {"normal": "tolerance"},
            "configurations": {"random": {"count": 9}},
            "noise": {"position": 0.05, "distance": 0.01, "point": 0.05, "joint": 0.0},
            "frame": "unknown",
            "instruments": [*(instruments or [TRACKER])],
            **keys,
        }
        (tmp_path / name).write_text(yaml.safe_dump(scenario))
        return tmp_path / name

    return write


@pytest.fixture
def measured(plan, fg_calib, tmp_path):
    """A job whose rows were measured at the stops of a design."""
    scenario, out = plan(), tmp_path / "plan"
    assert fg_calib("design", scenario, "--n", 8, *FEW, "--out", out).code == 0
    truth = plan(name="truth.yaml", configurations={"table": "plan/configurations.csv"})
    assert fg_calib("simulate", truth, "--seed", 1, "--out", tmp_path / "seen").code == 0
    seen = pl.read_csv(tmp_path / "seen" / "tracker.csv")
    table = pl.read_csv(out / "tracker.csv").with_columns(seen[axis] for axis in "xyz")
    table.write_csv(out / "tracker.csv")
    return out / "calibration.yaml"


@pytest.mark.slow
def test_a_table_that_was_filled_in_is_not_replaced_by_another_plan(measured, plan, fg_calib):
    table = measured.parent / "tracker.csv"
    before = {file.name: file.read_bytes() for file in measured.parent.iterdir()}
    ended = fg_calib("design", plan(), "--n", 4, *FEW, "--out", measured.parent)
    assert ended.code == 1
    assert f"error: {table}: a table that has been filled in, expected another folder\n" in ended.err
    assert {file.name: file.read_bytes() for file in measured.parent.iterdir()} == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "instrument",
    [
        TRACKER,
        {"model": "anchor", "name": "pin", "anchors": {"b": {"x": 500, "y": 100, "z": 150}}, "contact": True},
        {"model": "distance", "name": "sockets", "sockets": SOCKETS},
    ],
    ids=["measured", "touched", "sockets"],
)  # fmt: skip
def test_a_plan_that_nobody_filled_in_is_replaced(instrument, plan, fg_calib, tmp_path):
    scenario = plan(instrument)
    for n in (6, 4):
        assert fg_calib("design", scenario, "--n", n, *FEW, "--out", tmp_path / "plan").code == 0
    assert len(pl.read_csv(tmp_path / "plan" / "configurations.csv")) == 4


def test_where_to_go_is_written_as_finely_as_an_arm_is_told(plan, fg_calib, tmp_path):
    """Six decimals of degrees and millimetres, the same in all tables, within the limits, and no column of nothing."""
    out, edge = tmp_path / "plan", tmp_path / "edge.csv"
    low = math.degrees(math.nextafter(math.radians(-150.0), 0.0))  # which six decimals would put at the limit
    edge.write_text(f"q1,q2,q3\n{low!r},1.23456789,20\n150,-7.7777777777,199.99999999\n1,2,3\n")
    assert fg_calib("design", plan(TRACKER, PIN), "--n", 3, "--candidates", edge, "--out", out).code == 0
    stops = pl.read_csv(out / "configurations.csv")
    assert stops.columns == ["id", "q1", "q2", "q3", "tool_x", "tool_y", "tool_z"]
    joints = stops.select("q1", "q2", "q3")
    assert sorted(joints["q2"].to_list()) == [-7.777778, 1.234568, 2.0]
    assert sorted(joints["q3"].to_list()) == [3.0, 20.0, 200.0]
    assert joints["q1"].min() >= -150.0
    assert pl.read_csv(out / "tracker.csv").select("q1", "q2", "q3").equals(joints)
    assert pl.read_csv(out / "pin.csv").select("q1", "q2", "q3").equals(joints)


@pytest.mark.slow
def test_lengths_are_planned_between_points_that_are_touched_alone(plan, fg_calib, tmp_path):
    out = tmp_path / "plan"
    sockets = {"model": "distance", "name": "sockets", "sockets": 5}
    ended = fg_calib("design", plan(sockets), "--n", 4, "--candidates", 20, "--out", out)
    assert ended.code == 0
    touched = set(pl.read_csv(out / "sockets.csv")["group"].to_list())
    pairs = pl.read_csv(out / "sockets_pairs.csv")
    assert 1 < len(touched) < 5
    assert set(pairs["a"].to_list()) | set(pairs["b"].to_list()) == touched
    assert re.search(r"sockets: lengths of \d+ mm to \d+ mm", ended.out)


def test_a_box_about_the_arms_own_foot_is_named(plan, fg_calib, tmp_path):
    """The second of two; the first is beside the arm. A simulation says it too."""
    beside = {"lower": [900, 900, -100], "upper": [950, 950, 50]}
    floor = {"lower": [-900, -900, -100], "upper": [900, 900, 50]}
    scenario = plan(configurations={"random": {"count": 9}, "keep_out": [beside, floor]})
    for command, more in (("design", FEW), ("simulate", ("--out", tmp_path / "demo"))):
        ended = fg_calib(command, scenario, *more)
        assert ended.code == 1
        foot = "keep_out 2 holds the foot of the moving arm, (0, 0, 0) m, in every configuration"
        assert ended.err.splitlines()[-1].endswith(f"; {foot}")


def test_a_convention_that_cannot_say_a_tilt_is_warned_of(plan, fg_calib):
    said = " ".join(fg_calib("design", plan(), "--n", 5, *FEW).out.split())
    assert "axes 1, 2 and 3 are parallel and convention dh has no parameter for a tilt about y between them" in said


BAR = {"model": "distance", "name": "bar", "pairs": "star"}


@pytest.mark.parametrize("instrument", [TRACKER, BAR], ids=["positions", "pairs"])
def test_of_one_configuration_a_plan_is_made_or_it_is_said_why_not(instrument, plan, fg_calib, tmp_path):
    (tmp_path / "one.csv").write_text("q1,q2,q3\n10,20,30\n")
    scenario = plan(instrument)
    ended = fg_calib("design", scenario, "--n", 1, "--candidates", tmp_path / "one.csv")
    if instrument is BAR:
        message = "error: candidates: one, of which no pair is made, expected more configurations"
        assert (ended.code, ended.err.splitlines()) == (1, [message])
    else:
        assert "where to measure at 1 stop\n" in ended.out
    given = fg_calib("design", scenario, "--n", 1, "--given", tmp_path / "one.csv", "--candidates", 12)
    assert (given.code, given.err.splitlines()[1:]) == (0, [])


@pytest.mark.slow
def test_a_given_configuration_is_an_end_of_pairs(plan, fg_calib, tmp_path):
    """The hub, whichever of the candidates would make a better one."""
    (tmp_path / "one.csv").write_text("q1,q2,q3\n1,2,3\n")
    for seed in range(4):
        out = tmp_path / f"plan{seed}"
        asked = ("--n", 5, "--seed", seed, "--given", tmp_path / "one.csv", "--candidates", 40)
        assert fg_calib("design", plan(BAR), *asked, "--out", out).code == 0
        stops = pl.read_csv(out / "configurations.csv").select("q1", "q2", "q3")
        assert (1.0, 2.0, 3.0) in stops.rows()


PIN = {"model": "anchor", "name": "pin", "anchors": {"b": {"x": 500, "y": 100, "z": 150}}}


@pytest.mark.slow
def test_no_table_of_an_earlier_plan_stays_beside_a_new_one(plan, fg_calib, tmp_path):
    """A table of one's own stays, and one of the plan's that was filled in keeps the next plan out."""
    out = tmp_path / "plan"
    assert fg_calib("design", plan(TRACKER, PIN), "--n", 6, *FEW, "--out", out).code == 0
    (out / "mine.csv").write_text("id\n")
    assert fg_calib("design", plan(TRACKER), "--n", 6, *FEW, "--out", out).code == 0
    assert sorted(file.name for file in out.glob("*.csv")) == ["configurations.csv", "mine.csv", "tracker.csv"]
    assert fg_calib("design", plan(TRACKER, PIN), "--n", 6, *FEW, "--out", out).code == 0
    filled = pl.read_csv(out / "pin.csv").with_columns(distance=pl.lit(300.0))
    filled.write_csv(out / "pin.csv")
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    ended = fg_calib("design", plan(TRACKER), "--n", 4, *FEW, "--out", out)
    assert ended.err.splitlines()[-1].endswith("pin.csv: a table that has been filled in, expected another folder")
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


@pytest.mark.slow
def test_plans_of_several_instruments_are_all_written_or_none(plan, fg_calib, tmp_path):
    out = tmp_path / "plans"
    (out / "b").mkdir(parents=True)
    (out / "b" / "tracker.csv").write_text("id,x\na,1\n")
    for name in "ab":
        (tmp_path / f"{name}.yaml").write_text("noise: {position: 0.1}\n")
    instruments = ("--instruments", tmp_path / "a.yaml", tmp_path / "b.yaml")
    ended = fg_calib("design", plan(), "--n", 5, *FEW, *instruments, "--out", out)
    assert ended.code == 1
    assert sorted(file.name for file in out.rglob("*")) == ["b", "tracker.csv"]


@pytest.mark.slow
def test_an_instrument_none_of_whose_stops_was_chosen_gets_no_table(plan, fg_calib, tmp_path):
    wild = {"model": "distance", "name": "sockets", "sockets": 2, "noise": {"point": 1e6, "distance": 1e6}}
    out = tmp_path / "plan"
    ended = fg_calib("design", plan(TRACKER, wild), "--n", 5, *FEW, "--out", out)
    assert ended.code == 0
    assert "sockets: none of its own stops was chosen" in ended.out
    assert [one["table"] for one in yaml.safe_load((out / "calibration.yaml").read_text())["measurements"]] == [
        "tracker.csv"
    ]
    assert not (out / "sockets.csv").exists()


def test_a_result_is_no_job(fg_calib, tmp_path):
    (tmp_path / "result.json").write_text("{}")
    for of in (tmp_path, tmp_path / "result.json"):
        ended = fg_calib("design", of, "--n", 3)
        assert ended.code == 1
        assert f"{of}: a result, expected a scenario, or the job that the result came from" in ended.err


@pytest.mark.slow
def test_more_rows_of_a_job_are_to_update_its_result(measured, fg_calib, tmp_path):
    """As the job that is written for them says: by themselves they would be a calibration without the others."""
    more, result, new = tmp_path / "more" / "calibration.yaml", tmp_path / "result", tmp_path / "new"
    assert fg_calib("design", measured, "--n", 3, *FEW, "--out", more.parent).code == 0
    assert "`fg-calib update RESULT` this file" in more.read_text().splitlines()[1]
    assert "`fg-calib calibrate` this file" in measured.read_text().splitlines()[1]
    assert fg_calib("design", measured, "--n", 4, *FEW, "--out", more.parent).code == 0  # known as a plan's own
    table = pl.read_csv(more.parent / "tracker.csv")
    seen = pl.read_csv(measured.parent / "tracker.csv").head(len(table))
    joints, places = ["q1", "q2", "q3"], ["x", "y", "z"]
    table.with_columns(seen[name] + 1e-3 * (name in places) for name in joints + places).write_csv(
        more.parent / "tracker.csv"
    )
    assert fg_calib("calibrate", measured, "--out", result).code in (0, 3)
    ended = fg_calib("update", result, more, "--out", new)
    assert ended.code in (0, 3), ended.err
    assert (new / "result.json").is_file()


@pytest.mark.slow
def test_more_rows_of_a_job_have_new_names_and_the_noise_that_it_states(measured, fg_calib, tmp_path):
    ended = fg_calib("design", measured, "--n", 3, *FEW, "--out", tmp_path / "more")
    assert ended.code == 0
    assert pl.read_csv(tmp_path / "more" / "tracker.csv")["id"].to_list() == ["s9", "s10", "s11"]
    job = yaml.safe_load((tmp_path / "more" / "calibration.yaml").read_text())
    assert job["measurements"][0]["noise"] == {"position": 0.05}
    assert "--candidates SCENARIO" in ended.out


@pytest.mark.slow
def test_more_rows_of_a_job_are_where_a_scenario_says(measured, plan, fg_calib, tmp_path):
    wall = {"lower": [200, -900, -900], "upper": [900, 900, 900]}  # the arm reaches 600 mm to all sides
    where = plan(name="where.yaml", configurations={"random": {"count": 9}, "keep_out": [wall]})
    out = tmp_path / "more"
    ended = fg_calib("design", measured, "--n", 6, "--candidates", where, "--out", out)
    assert ended.code == 0, ended.err
    assert pl.read_csv(out / "configurations.csv")["tool_x"].max() < 200
    assert "--candidates SCENARIO" not in ended.out


@pytest.mark.slow
def test_a_curve_ends_with_the_pairs_that_are_chosen(plan, fg_calib):
    """All that is drawn is explained, and a target is reached with as few as a plan of so many does."""
    scenario = plan({"model": "distance", "name": "bar", "pairs": "star"})
    ended = fg_calib("design", scenario, "--n", 9, "--candidates", 60)
    found = design(read_scenario(scenario), n=9, n_candidates=60)
    assert found.structure in ("chain", "tree", "free")
    assert found.expected.position == min(found.pairings.values()) == pytest.approx(found.curve[-1].designed, rel=1e-6)
    for words in ("designed mm", "stars of 9 random stops", f"{found.n} stops in 8 pairs"):
        assert words in ended.out
    axes = draw_designs({"": found}).axes[0]
    words = ["designed", "random: half are better", "random: 80 % of them"]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == words
    assert axes.lines[0].get_ydata() == pytest.approx([1e3 * p.designed for p in found.curve])
    assert set(axes.get_xticks()) <= {p.n for p in found.curve}
    target = 1.000001 * found.expected.position  # what more pairs of a star would need
    reached = design(read_scenario(scenario), target=target, n_candidates=60)
    assert reached.reached
    assert len(reached.pairs) <= 8


@pytest.mark.slow
def test_a_comparison_says_where_the_errors_of_each_instrument_count(plan, fg_calib, tmp_path):
    """A tracker in the base frame against one anywhere: two errors, of which neither is the better by its figure."""
    for frame in ("base", "unknown"):
        (tmp_path / f"{frame}.yaml").write_text(f"frame: {frame}\n")
    files = [tmp_path / "base.yaml", tmp_path / "unknown.yaml"]
    ended = fg_calib("design", plan(), "--n", 4, *FEW, "--instruments", *files)
    rows = {row.split()[0]: row for row in ended.out.split("With so many stops")[1].splitlines() if row}
    assert "in the base frame" in rows["base"]
    assert "after the best rigid fit" in rows["unknown"]
    assert "not the same error of all: --error fitted, or base, compares them by one" in ended.out
    same = fg_calib("design", plan(), "--n", 4, *FEW, "--error", "fitted", "--instruments", *files).out
    assert same.count("after the best rigid fit") == 2
    assert "not the same error" not in same


@pytest.mark.slow
def test_a_picture_of_errors_that_are_not_the_same_says_which_is_which(plan):
    designs = {frame: design(read_scenario(plan(frame=frame)), n=4, n_candidates=12) for frame in ("base", "unknown")}
    labels = [text.get_text() for text in draw_designs(designs).axes[0].get_legend().get_texts()]
    assert labels[:2] == ["base, in the base frame", "unknown, after the best rigid fit"]
    alike = {"one": designs["base"], "other": designs["base"]}
    assert [text.get_text() for text in draw_designs(alike).axes[0].get_legend().get_texts()][:2] == ["one", "other"]


def test_an_arm_too_long_for_its_noise_is_one_line(plan, fg_calib, tmp_path):
    scenario = plan({"model": "position"}, noise={"position": 0.05, "joint": [0.003, 0.003, 0.01]})
    (tmp_path / "robot.yaml").write_text(ROBOT.replace("a: 275", "a: 1.0e+14"))
    ended = fg_calib("design", scenario, "--n", 4, *FEW)
    assert ended.code == 1
    assert "error: noise: lost in rounding beside what errors of the joint readings do" in ended.err
