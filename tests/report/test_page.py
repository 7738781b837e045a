"""The report as a page: all of it there, in a browser too, and no name of a file can do anything."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import browse
from instruments import measured_by
from lxml import etree, html
from simulated import measure, plus, small_arm, true_robot, write_job

from fg_calib import Calibration, KnownPoint, Measurements, Robot, Table, calibrate, predict, write_report
from fg_calib.io.saved import read_configurations
from fg_calib.observability.observed_quantities import Seen
from fg_calib.pages import load_run
from fg_calib.report.page.arm import scene
from fg_calib.report.page.charts import Scale, limits_of, short
from fg_calib.report.page.figures import _histogram
from fg_calib.report.page.files import FIGURES
from fg_calib.report.page.sections import correlations, tiles
from fg_calib.report.slices import slices_of
from fg_calib.robot.kinematics import pose
from fg_calib.simulation.obstacles import link_points

LARGE = {"a": 0.01, "d": 0.01, "alpha": 0.01, "theta": 0.01}
TITLES = (
    *("Accuracy before and after", "The arm and what was measured", "Cross-validation"),
    *("Error over joint space", "Parameters"),
    *("What is not determined", "Correlations", "Residuals", "Expected error over the workspace"),
    "Inputs, options and versions",
)
MOST_BYTES = 1_500_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A saved calibration with a wrong row among the fitted ones, and its page and figures."""
    into = tmp_path_factory.mktemp("page")
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE, estimate=("tool.x", "tool.y", "tool.z"))
    m = measure(true_robot(robot, rng), 40, rng, sigma=(1e-4, 1e-4), n_test=20)
    m = replace(m, position=plus(m.position, 7, 0.003))
    limits = {"position": 5e-4, "orientation": 1e-9}
    calibrate(robot, m, model="pose", frame="unknown", accept=limits).save(into / "result")
    write_report(into / "result", figures=True)
    return into / "result"


@pytest.fixture(scope="module")
def page(folder):
    return html.parse(str(folder / "report.html"))


def text_of(page):
    return " ".join(page.getroot().body.text_content().split())


def test_every_section_is_there(page):
    assert tuple(page.xpath("//section/h2/text()")) == TITLES


def test_where_the_robot_states_no_limits_the_page_says_what_stands_for_them(page):
    text = text_of(page)
    assert "the workspace within no joint limits (turns by ±180 deg and slides as far as they were read" in text
    assert "drawn within no joint limits (turns" in text
    assert "within the joint limits" not in text


def test_the_verdict_comes_first(page, folder):
    first, second, *_ = page.xpath("//main/div[contains(@class, 'verdict')]")
    assert first.findtext("strong") == "NOT EVALUATED: the limits that were set"
    assert second.findtext("strong") == "DOUBTFUL: not to be trusted"
    result = json.loads((folder / "result.json").read_text())
    assert all(" ".join(finding.split()) in text_of(page) for finding in result["findings"])


def test_every_parameter_is_in_the_table_of_its_class(page, folder):
    parameters = json.loads((folder / "result.json").read_text())["parameters"]
    for title, kind in (("Independent", "independent"), ("Relative", "relative"), ("Ineffective", "ineffective")):
        names = [p["name"] for p in parameters if p["identifiability"] == kind]
        found = page.xpath(f"//h3[starts-with(., '{title}:')]/following-sibling::div[1]//tr/td[1]/text()")
        assert found == names


def test_suspects_can_be_found(page, folder):
    """Each is named with its configuration and the line of residuals.csv that it stands in."""
    rows = page.xpath("//h3[starts-with(., 'Suspicious rows')]/following-sibling::div[1]//tbody/tr")
    cells = [[td.text_content() for td in row] for row in rows]
    lines = (folder / "residuals.csv").read_text().splitlines()
    names = lines[0].split(",")
    assert cells
    assert cells[0][1] == "7"
    for kind, configuration, *_, place in cells:
        line = lines[int(place.removeprefix("residuals.csv:")) - 1].split(",")
        found = dict(zip(names, line, strict=True))
        assert (found["kind"], found["a"], found["suspect"]) == (kind, configuration, "true")


@pytest.mark.slow
def test_inputs_options_versions_and_the_command_are_there(tmp_path, fg_calib):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE)
    job = write_job(tmp_path, robot, measure(true_robot(robot, rng), 30, rng, n_test=9), model="position")
    ended = fg_calib("calibrate", job, "--out", tmp_path / "out", "--report")
    assert (ended.code, ended.err) == (0, "")
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    words = text_of(html.parse(str(tmp_path / "out" / "report.html")))
    assert "fg-calib calibrate calibration.yaml --out out" in words
    assert result["inputs"]
    for name, digest in result["inputs"].items():
        assert f"{name}{digest}" in words
    for name, version in result["versions"].items():
        assert f"{name}{version}" in words
    assert result["options"]["model"] == "position"
    assert "modelposition" in words


def test_it_is_one_small_file_that_asks_for_nothing(folder):
    text = (folder / "report.html").read_text()
    assert len(text.encode()) < MOST_BYTES
    assert not re.search(r"""(?:src|href|action|url)\s*[=(]\s*["']?(?!#)""", text.replace("xmlns", ""))
    assert "default-src 'none'" in text


@pytest.mark.slow
def test_ten_thousand_configurations_are_still_a_small_file(tmp_path):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE)
    result = calibrate(robot, measure(true_robot(robot, rng), 10_000, rng, n_test=500), model="pose")
    result.save(tmp_path)
    write_report(tmp_path)
    assert (tmp_path / "report.html").stat().st_size < MOST_BYTES


HOSTILE = "</script><script>document.title='hacked'</script><img src=x onerror=\"document.title='hacked'\">&lt;\x1b[2J"


class Tags(HTMLParser):
    """Every element and attribute of a page, as browsers tell them."""

    def __init__(self):
        super().__init__()
        self.names = []
        self.attributes = set()

    def handle_starttag(self, tag, attrs):
        self.names.append(tag)
        self.attributes |= {name for name, _ in attrs}


def hostile_page(folder):
    rng = np.random.default_rng(0)
    robot = replace(small_arm(tolerance=LARGE), name=HOSTILE)
    robot = replace(robot, joints=tuple(replace(j, name=f"{HOSTILE}{i}") for i, j in enumerate(robot.joints)))
    m = measure(true_robot(robot, rng), 30, rng)
    m = replace(m, ids=np.array([f"{HOSTILE}{i}" for i in range(30)]), position=plus(m.position, 4, 0.1))
    calibrate(robot, m, model="pose").save(folder)
    write_report(folder)
    return folder / "report.html"


@pytest.mark.slow
def test_names_are_text_and_nothing_else(tmp_path):
    page = hostile_page(tmp_path)
    tags = Tags()
    tags.feed(page.read_text())
    assert tags.names.count("script") == 2
    assert "img" not in tags.names
    assert not any(name.startswith("on") for name in tags.attributes)
    assert "\x1b" not in page.read_text()
    words = text_of(html.parse(str(page)))
    assert "document.title='hacked'" in words  # it is shown


@pytest.mark.slow
def test_names_do_nothing_in_a_browser(tmp_path):
    dom, console = browse(hostile_page(tmp_path), tmp_path)
    assert "<title>Calibration of &lt;/script&gt;" in dom
    assert console == []


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--force-dark-mode", "--window-size=390,844")], ids=["light", "dark phone"])
def test_a_browser_shows_all_of_it_and_has_nothing_to_say(folder, tmp_path, options):
    dom, console = browse(folder / "report.html", tmp_path, *options)
    page = html.fromstring(dom)
    assert console == []
    assert len(page.xpath("//figure/*[name() = 'svg']")) == len(page.xpath("//figure")) > 10
    assert page.get_element_by_id("arm-words").text.startswith("configuration 7 (train): position residual")
    width, height = (int(page.get_element_by_id("arm").get(key)) for key in ("width", "height"))
    assert width == height > 100


@pytest.mark.slow
def test_errors_count_in_the_frame_that_the_measurements_know(tmp_path):
    """After the best rigid fit where nothing says where the base is; in the base frame where something does."""
    rng = np.random.default_rng(1)
    robot, true, anchors = measured_by("anchors", rng, n=30)
    seen = Table(measure(true, 30, rng, sigma=(1e-4, 1e-4)), "position")
    names = anchors.measurements.labels["anchor"].names
    known = replace(anchors, known={name: KnownPoint((1.0, 0.5, 0.0), 0.5) for name in names})
    assert not Seen.by([known]).blind_to_base
    for tables, fitted in (([anchors], True), ([seen], False), ([anchors, seen], False)):
        assert Seen.by(tables).blind_to_base == fitted
        if len(tables) == 1:
            calibrate(robot, tables).save(tmp_path)
            words = " ".join(tiles(load_run(tmp_path)).itertext())
            assert ("covariance, after the best rigid fit" in words) == fitted
            assert ("covariance, in the base frame" in words) != fitted


@pytest.mark.slow
def test_the_command_repeats_what_was_done_whatever_names_are(tmp_path, fg_calib):
    robot = small_arm(tolerance=LARGE)
    rng = np.random.default_rng(0)
    job = write_job(tmp_path, robot, measure(true_robot(robot, rng), 30, rng), model="position")
    job = job.rename(tmp_path / "my job; ls.yaml")
    assert fg_calib("calibrate", job, "--out", tmp_path / "it's", "--folds", "3").code == 0
    command = load_run(tmp_path / "it's").command
    assert shlex.split(command) == ["fg-calib", "calibrate", "my job; ls.yaml", "--out", "it's", "--folds", "3"]


def test_columns_at_the_ends_hold_what_is_beyond():
    values = np.concatenate([np.zeros(90), [-7.0, 5.5, 6.0, 1e6, *[4.9] * 6]])
    svg = _histogram(values, "position")
    assert [t.text for t in svg.iter("text") if t.text[0] in "<>"] == ["< \N{MINUS SIGN}5", "> 5"]
    heights = [float(box.get("height")) for box in svg.iter("rect") if box.get("class") == "beyond"]
    assert heights[1] / heights[0] == pytest.approx(3.0, abs=0.3)  # a decimal of a coordinate
    assert not [box for box in _histogram(np.zeros(9), "position").iter("rect") if box.get("class") == "beyond"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("n", "few"), [(9, True), (60, False)])
def test_correlations_of_few_rows_are_told_to_be_that(tmp_path, n, few):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE)
    calibrate(robot, measure(true_robot(robot, rng), n, rng), model="position").save(tmp_path)
    words = " ".join(p.text or "" for p in correlations(load_run(tmp_path)))
    assert ("Only 27 residuals for 16 parameters" in words) == few
    assert "farther apart" in words or not few


@pytest.mark.slow
@pytest.mark.parametrize("instrument", ["anchors", "planes", "board", "targets", "pixels"])
def test_every_instrument_has_a_page(tmp_path, instrument):
    robot, _, table = measured_by(instrument, np.random.default_rng(1), n=30)
    result = calibrate(robot, table)
    result.save(tmp_path)
    write_report(tmp_path, figures=True)
    assert tuple(html.parse(str(tmp_path / "report.html")).xpath("//section/h2/text()")) == TITLES


def test_figures_are_files_of_their_own(folder):
    for name in FIGURES:
        root = etree.parse(folder / f"{name}.svg").getroot()
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        assert len(root.findall("{http://www.w3.org/2000/svg}svg"))


@pytest.mark.parametrize("option", ["--report", "--figures"])
def test_a_page_needs_a_folder(example, fg_calib, option):
    ended = fg_calib("calibrate", example / "calibration.yaml", option)
    assert ended.code == 2
    assert "needs --out" in ended.err


def test_a_result_without_its_tables_has_a_page_that_says_so(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "result", ignore=shutil.ignore_patterns("*.csv", "*.html", "*.svg"))
    write_report(tmp_path / "result")
    words = text_of(html.parse(str(tmp_path / "result" / "report.html")))
    assert words.count("The folder holds no configurations.csv") == 2
    assert words.count("The folder holds no residuals.csv") == 1


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("configurations.csv", ("q1", "q0"), "configurations.csv: no column q1"),
        ("configurations.csv", ("test", "tset"), "configurations.csv:42: split: found 'tset', expected train or test"),
        ("residuals.csv", ("studentised", "student"), "residuals.csv: no column studentised"),
    ],
)
def test_damaged_tables_are_one_line(folder, tmp_path, fg_calib, file, change, message):
    shutil.copytree(folder, tmp_path / "result")
    text = (tmp_path / "result" / file).read_text()
    (tmp_path / "result" / file).write_text(text.replace(*change, 1))
    (tmp_path / "result" / "report.html").unlink()
    other = fg_calib("report", tmp_path / "result")
    assert other.err.startswith(f"error: {tmp_path / 'result' / file}: changed, or of another calibration")
    result = json.loads((tmp_path / "result" / "result.json").read_text())
    (tmp_path / "result" / "result.json").write_text(json.dumps(result | {"files": {}}))  # as older ones are
    ended = fg_calib("report", tmp_path / "result")
    assert ended.code == 1
    assert ended.err.startswith(f"error: {message}")
    assert ended.err.count("\n") == 1
    assert not (tmp_path / "result" / "report.html").exists()


@pytest.mark.slow
def test_another_page_of_that_name_is_not_replaced(folder, tmp_path, fg_calib):
    (tmp_path / "report.html").write_text("mine")
    ended = fg_calib("report", folder, "--out", tmp_path)
    assert ended.code == 1
    assert (tmp_path / "report.html").read_text() == "mine"


@pytest.mark.slow
def test_two_results_are_shown_side_by_side(tmp_path, fg_calib):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE, estimate=("tool.x", "tool.y", "tool.z"))
    true = true_robot(robot, rng)
    for name, moved in (("old", 0.0), ("new", 0.005)):
        theta = [0.0] * len(robot.parameters)
        theta[[p.name for p in robot.parameters].index("theta2")] = moved
        m = measure(true.with_values(true.nominal + theta), 40, rng, sigma=(1e-4, 1e-4), n_test=10)
        calibrate(robot, m, model="pose").save(tmp_path / name)
    ended = fg_calib("compare", tmp_path / "old", tmp_path / "new", "--json", "--out", tmp_path / "two", "--figures")
    assert (ended.code, ended.err) == (0, "")
    by_name = {p["name"]: p for p in json.loads(ended.out)["parameters"]}
    assert by_name["theta2"]["change"] == pytest.approx(0.005, abs=5 * by_name["theta2"]["sigma"])
    assert by_name["theta2"]["in_sigma"] > 10.0
    assert abs(by_name["a1"]["in_sigma"]) < 5.0
    words = text_of(html.parse(str(tmp_path / "two" / "comparison.html")))
    assert "Old: old" in words
    assert f"{by_name['theta2']['in_sigma']:+.1f}" in words
    assert (tmp_path / "two" / "comparison.svg").read_text().startswith("<svg")
    shown = fg_calib("compare", tmp_path / "old", tmp_path / "new")
    assert f"{by_name['theta2']['in_sigma']:+.1f}" in shown.out


@pytest.mark.slow
def test_results_of_different_robots_are_not_compared(folder, tmp_path, fg_calib):
    rng = np.random.default_rng(0)
    other = Robot.from_dh([[0.5, 0.3, 0.1, 0.0], [0.4, 1.3, 0.0, 0.0]], convention="mdh")
    calibrate(other, measure(other, 30, rng), model="pose", gauge="none").save(tmp_path / "other")
    ended = fg_calib("compare", folder, tmp_path / "other")
    assert ended.code == 1
    assert "another robot, expected the parameters of" in ended.err


@pytest.mark.slow
def test_estimators_have_a_figure_too(example, tmp_path, fg_calib):
    ended = fg_calib("compare", example / "calibration.yaml", "--out", tmp_path / "out", "--figures")
    assert ended.code == 0
    text = (tmp_path / "out" / "comparison.svg").read_text()
    assert all(f">{name}<" in text for name in ("nominal", "graph", "scipy", "gauss-newton"))


def test_the_arm_ends_where_its_tool_is():
    rng = np.random.default_rng(3)
    robot = true_robot(small_arm(estimate=("tool.x", "tool.y", "tool.z")), rng)
    q = rng.uniform(-3.0, 3.0, (5, robot.n_joints))
    assert link_points(robot, q)[:, -1] == pytest.approx(pose(robot, q).position, abs=1e-12)  # some rounding of metres


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.2, 7.9), (1e-9, 2e-9), (-1e6, 1e6), (99.9, 100.1)])
def test_ticks_are_round_and_within(low, high):
    scale = Scale(low, high, 0.0, 300.0)
    ticks = scale.ticks()
    assert 2 <= len(ticks) <= 7
    assert all(low - 1e-9 * (high - low) <= t <= high + 1e-9 * (high - low) for t in ticks)
    assert np.ptp(np.diff(ticks)) == pytest.approx(0.0, abs=1e-9 * (high - low))


def test_nothing_to_show_has_limits_too():
    assert limits_of() == (-0.05, 1.05)
    assert limits_of([np.nan]) == (-0.05, 1.05)
    assert limits_of([2.0]) == pytest.approx((1.9, 2.1))
    assert limits_of([0.0]) == (-1.0, 1.0)


def test_a_run_knows_what_it_is_of(folder):
    run = load_run(folder / "result.json")
    assert run.folder == folder
    assert (run.judged_on, run.family, run.free_of_frame, run.command) == ("test", "position", True, None)


@pytest.mark.slow
def test_several_tables_and_touched_points_have_a_page(tmp_path):
    """A configuration may have no row of a kind."""
    rng = np.random.default_rng(2)
    robot, true, anchors = measured_by("anchors", rng, n=30)
    tables = [anchors, Table(measure(true, 30, rng, sigma=(1e-4, 1e-4)), "position")]
    calibrate(robot, tables).save(tmp_path / "tables")
    write_report(tmp_path / "tables", figures=True)
    q = np.repeat(rng.uniform(-1.0, 1.0, (6, robot.n_joints)), 4, axis=0) + 0.2 * rng.normal(size=(24, robot.n_joints))
    touched = Measurements.from_arrays(q, group=np.repeat(["a", "b"], 12), sigma_point=1e-2)
    calibrate(robot, touched, model="distance").save(tmp_path / "touched")
    write_report(tmp_path / "touched")
    for name in ("tables", "touched"):
        assert tuple(html.parse(str(tmp_path / name / "report.html")).xpath("//section/h2/text()")) == TITLES


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["unknown", "known"])  # which is fitted, or nothing at all
def test_an_evaluation_says_that_it_is_one(tmp_path, frame):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE, estimate=("tool.x", "tool.y", "tool.z"))
    m = measure(robot, 30, rng)
    calibrate(robot, replace(m, test=np.ones(30, dtype=bool)), model="position", frame=frame).save(tmp_path)
    write_report(tmp_path, figures=True)
    words = text_of(html.parse(str(tmp_path / "report.html")))
    assert "Evaluated only: all rows are test rows" in words
    assert "the estimate never saw them" not in words
    assert "no covariance says how large its errors are" in words
    assert not list(tmp_path.glob("**/workspace*.svg"))
    assert {item["test"] for item in scene(load_run(tmp_path))["items"]} == {True}


def test_an_evaluation_of_nothing_but_test_rows_is_read_back_and_expects_no_errors(tmp_path):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE)
    saved = calibrate(robot, measure(true_robot(robot, rng), 0, rng, n_test=8), model="position")
    saved.save(tmp_path)
    assert Calibration.load(tmp_path).posterior.tangent.shape == (0, 0)
    write_report(tmp_path, figures=True)
    assert "no covariance says how large its errors are" in text_of(html.parse(str(tmp_path / "report.html")))
    assert not list(tmp_path.rglob("workspace*"))


def test_a_configuration_is_held_out_only_if_no_fitted_pair_is_of_it(tmp_path):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE)
    q = rng.uniform(-2.0, 2.0, (30, robot.n_joints))
    p = pose(true_robot(robot, rng), q).position
    a, b = (ends.ravel() for ends in np.triu_indices(30, 1))
    chosen = rng.permutation(len(a))[:150]
    a, b = a[chosen], b[chosen]
    test = (rng.uniform(size=len(a)) < 0.3) | (a == 3) | (b == 3)
    pairs = {"a": a, "b": b, "distance": np.linalg.norm(p[a] - p[b], axis=1), "sigma_distance": 1e-4, "test": test}
    saved = calibrate(robot, Measurements.from_arrays(q, pairs=pairs), model="distance")
    saved.save(tmp_path)
    found, rows = read_configurations(tmp_path, robot.n_joints), saved.uncertainty.residuals
    assert np.flatnonzero(found.test).tolist() == [3]
    for k in range(30):
        mine = ((rows.a == k) | (rows.b == k)) & (rows.split == (k == 3))
        assert found.rms["distance"][k] == pytest.approx(np.sqrt(np.mean(rows.after[mine] ** 2)), rel=1e-6)
    assert saved.result.expected_error.of == 1


@pytest.mark.parametrize(
    ("model", "offered"),
    [("distance", "distance: 0.5 mm"), ("rotation", "angle: 0.1 deg"), ("pose", "position: 0.5 mm")],
)
def test_limits_that_the_page_offers_can_be_judged(tmp_path, model, offered):
    rng = np.random.default_rng(0)
    robot = small_arm(tolerance=LARGE)
    calibrate(robot, measure(true_robot(robot, rng), 20, rng), model=model).save(tmp_path)
    write_report(tmp_path)
    assert f"with accept: {{{offered}}} in the job" in text_of(html.parse(str(tmp_path / "report.html")))


def test_a_tool_on_its_only_axis_has_a_page_and_pictures(tmp_path):
    robot = Robot.from_dh([[0.0, 0.0, 0.2, 0.0]], tolerance=LARGE)
    q, there = np.linspace(-3.0, 3.0, 15)[:, None], np.tile([0.0, 0.0, 0.2], (15, 1))
    calibrate(robot, Measurements.from_arrays(q, position=there, sigma_position=1e-4), model="position").save(tmp_path)
    write_report(tmp_path)
    for one in slices_of(predict(tmp_path)):
        assert one.x[-1] > one.x[0]
        assert one.y[-1] > one.y[0]


def test_long_names_keep_what_tells_them_apart():
    assert short("shoulder_pan_joint.x") == "should…joint.x"
    assert short("theta7") == "theta7"
