"""The page: every section, from a new and a loaded calibration, in one file; names in it are text."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from lxml import html
from scipy.spatial.transform import Rotation
from simulated import measure, measure_drawn, plus, small_arm, tool_points

from fg_calib import Calibration, Job, Options, calibrate, calibrate_job
from fg_calib.calibration import write_report
from fg_calib.io.result import FIGURES
from fg_calib.report import figures
from fg_calib.report.charts import Scale
from fg_calib.report.html import CODE, build_page
from fg_calib.robot import Compliance, ErrorCurve, Mass

WEAKLY = "Weakly determined (sigma above a tenth of the prior sigma, or of 1 mrad at the reach)"
SECTIONS = [
    *("May I use it?", "How accurate is it?", "What the data do not determine", "What to do next"),
    *("The arm and what was measured", "Notes", "Residuals (RMS)", "Fit statistics"),
    *("Goodness of fit (1 sigma of a row)", "Prediction of the test rows"),
    *("Expected tool error (RMS at 10 test configurations)", "Parameters", "Suspicious rows", "Suspicious test rows"),
    *("Suspicious configurations", "Measurement frame (world_T_base)", "Not identifiable from these data", WEAKLY),
    *("Studentised residuals", "Error over joint space", "Correlations", "Expected error over the workspace"),
    "For technicians",
]
TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}


def calibrated(robot=None, **options):
    robot = robot or small_arm(TOLERANCE)
    m = measure_drawn(robot, 30, seed=3, n_test=10)
    given = {"model": "position", "frame": "unknown", "accept": {"position": 1e-3}} | options
    return calibrate(robot, replace(m, position=plus(m.position, 4, 0.02)), **given)


@pytest.fixture(scope="module")
def made():
    return calibrated()


@pytest.fixture(scope="module")
def folder(made, tmp_path_factory):
    path = tmp_path_factory.mktemp("result")
    made.save(path, report=True, figures=True)
    return path


@pytest.fixture(scope="module")
def page(folder):
    return html.fromstring((folder / "report.html").read_text())


def text_of(element):
    return " ".join(" ".join(element.itertext()).split())


def test_every_section_is_there_in_order(page):
    assert [text_of(title) for title in page.xpath("//h2")] == SECTIONS
    assert len(page.xpath("//figure/svg")) >= 4 + 2 + 2 + 1 + 4


def test_page_one_says_whether_and_how_well_it_may_be_used(made, page):
    (verdict,) = (text_of(one) for one in page.xpath("//div[contains(@class, 'verdict')]"))
    assert verdict.startswith("DOUBTFUL: do not use it yet FAIL: position")
    tiles = [text_of(tile) for tile in page.xpath("//div[@class='tile']")]
    assert [" error of the tool itself" in tile for tile in tiles] == [True, False, False]  # no orientation
    assert all(CODE.sub("", finding) in verdict for finding in made.findings)
    lengths = 1e3 * made.configurations["rms_position"].to_numpy()[made.report_data.held_out]
    old, new = made.result.residual_statistics["test"]["position"]["before"], np.quantile(lengths, [0.95, 1.0])
    each = {old.mean: lengths.mean(), old.p95: new[0], old.max: new[1]}
    cells = [text_of(cell) for cell in page.xpath("//div[@class='first']//td")]
    assert cells == ["position [mm]", *(f"{1e3 * old:.3g} → {new:.3g}" for old, new in each.items())]
    found = made.result.observability.observability
    assert found.rank < len(found.names)
    assert f"{found.rank} of {len(found.names)} parameters" in text_of(page.xpath("//div[@class='tile'][last()]")[0])


def test_page_one_has_no_command_and_the_last_page_all_of_them(made):
    findings = (*made.findings, "outliers: 2: let a robust loss do so (`loss: gnc`)")
    result = made.result.model_copy(update={"findings": findings})
    page = html.fromstring(build_page(replace(made.report_data, result=result)))
    one, last = text_of(page.xpath("//div[@class='first']")[0]), text_of(page.xpath("//section[last()]")[0])
    assert not any(word in one for word in ("`", "fg-calib", "--", "accept:"))
    assert "outliers: 2: let a robust loss do so" in one
    assert all(finding in last for finding in findings)


def test_page_one_says_whose_arm_it_is_and_who_measured_it(tmp_path):
    about = {"customer": "A & B", "robot_serial": 2017, "operator": None, "note": "long " * 99 + "end"}
    m = measure(small_arm(), 12, np.random.default_rng(5))
    job = Job(None, small_arm(TOLERANCE), m, Options(model="position", frame="known"), document={"about": about})
    calibrate_job(job).save(tmp_path)
    write_report(tmp_path)
    page = html.fromstring((tmp_path / "report.html").read_text())
    names, texts = ([text_of(one) for one in page.xpath(f"//{tag}")] for tag in ("dt", "dd"))
    assert names == ["customer", "robot serial", "note", "date", "measured"]
    assert texts[:2] == ["A & B", "2017"]
    assert len(texts[2]) <= 200
    assert about["note"] in text_of(page.xpath("//section[last()]")[0])


def test_page_and_text_show_the_same_tables(made, page):
    text = " ".join(str(made).split())
    for row in page.xpath("//section[h2 = 'Parameters' or h2 = 'Goodness of fit (1 sigma of a row)']//tr[td]"):
        assert text_of(row) in text
    suspects = made.residuals.filter(made.residuals["suspect"])
    shown = page.xpath("//section[h2 = 'Suspicious rows' or h2 = 'Suspicious test rows']//tr[td]")
    assert len(shown) == len(suspects) > 0


def test_the_arms_data_are_json_of_each_configuration(made, page):
    scene = json.loads(page.xpath("//script[@id='arm-data']")[0].text)
    assert {item["id"] for item in scene["items"]} == set(made.configurations["id"])
    tip = made.configurations.select("tool_x", "tool_y", "tool_z").to_numpy()
    for item, tool in zip(scene["items"], tip, strict=True):
        assert item["links"][-1] == pytest.approx(tool, abs=1e-4)


def test_it_is_one_file_that_loads_nothing(folder):
    text = (folder / "report.html").read_text()
    assert len(text) < 600_000
    assert re.search(r"""(src|href)=["'](?!#)""", text) is None
    assert "default-src 'none'" in text


def test_names_are_text_and_nothing_else():
    name = "<script>alert(1)</script>\x1b[31m"
    page = html.fromstring(build_page(calibrated(replace(small_arm(TOLERANCE), name=name)).report_data))
    assert page.xpath("//h1")[0].text == "<script>alert(1)</script>\\x1b[31m"
    assert not any("alert" in (script.text or "") for script in page.xpath("//script[not(@type)]"))


def test_figures_are_svg_files_of_their_own(folder, made):
    assert set(figures.figures_of(made.report_data)) <= set(FIGURES)
    names = {file.stem for file in folder.glob("*.svg")}
    assert names == {"joints", "parameters", "correlations", "residuals", "workspace"}
    for file in folder.glob("*.svg"):
        assert html.fromstring(file.read_text()).tag == "svg"


def test_without_tables_the_page_says_what_is_missing(folder, tmp_path):
    for name in ("result.json", "robot_calibrated.yaml"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    page = text_of(html.fromstring(build_page(Calibration.load(tmp_path).report_data)))
    assert "The folder holds no table of configurations: calibrate again with --out to have its charts." in page
    assert "no table of residuals: calibrate again with --out and without --residuals none" in page


def drawn(chart, kind):
    """Values on the axes of what a chart draws as a path of a kind, x and y."""
    svg = html.fromstring(chart.svg)
    points = re.findall(r"[ML]([-\d.]+) ([-\d.]+)", svg.xpath(f"//path[contains(@class, '{kind}')]")[0].get("d"))
    for axis, end, values in zip("xy", ("middle", "end"), np.array(points, dtype=float).T, strict=True):
        labels = svg.xpath(f"//text[@class='tick {end}']")
        at = np.array([float(one.get(axis)) for one in labels]) - 3.5 * (axis == "y")
        yield np.polyval(np.polyfit(at, [float(one.text.replace("\N{MINUS SIGN}", "-")) for one in labels], 1), values)


@pytest.fixture(scope="module")
def with_effects():
    """An arm with an error curve and compliance, held-out rows of which have joint 4 turned by 1 mrad."""
    rng, masses = np.random.default_rng(5), [Mass(4, 10.0, (0.3, 0.1, 0.2))]
    robot = small_arm(TOLERANCE).with_effects(ErrorCurve([1, 2], 8, 1e-3), Compliance(masses, [2]))
    more = [{"curve": 1e-3 * rng.normal(), "compliance": 1e-4}.get(p.kind, 0.0) for p in robot.parameters]
    q, frame = rng.uniform(-1.5, 1.5, (60, 4)), (Rotation.from_rotvec([0.5, 1.0, -0.7]), np.ones(3))
    given = {"sigma": (1e-5, 1e-5), "frame": frame, "n_test": 20, "readings": plus(q, np.s_[40:, 3], 1e-3)}
    m = replace(measure(robot.with_values(robot.nominal + more), 40, rng, **given), readings=q)
    return calibrate(robot, m, model="pose", frame="unknown")


def test_a_gross_row_flattens_no_chart(made):
    for chart in figures.error_over_joints(made.report_data):
        assert np.abs(list(drawn(chart, "dots a"))[1]).max() < 0.5 * made.report_data.rms[1].max()


def test_an_error_once_a_turn_is_a_sine_over_its_joint():
    rng, robot = np.random.default_rng(6), small_arm(TOLERANCE)
    q, frame = rng.uniform(-3.0, 3.0, (200, 4)), (Rotation.identity(), np.zeros(3))
    off = 1e-3 * np.sin(q) * [0, 1, 0, 0]
    m = measure(robot, 200, rng, readings=q + off, frame=frame, sigma=(1e-6, 1e-6))
    data = calibrate(robot, replace(m, readings=q, test=np.ones(200, dtype=bool)), model="position").report_data
    moved = 1e3 * np.linalg.norm(tool_points(robot, q + off) - tool_points(robot, q), axis=1)  # chords of 1 mrad
    _, chart, *_ = figures.error_over_joints(data)
    x, y = drawn(chart, "dots b")
    assert x == pytest.approx(np.degrees(q[:, 1]), abs=1.0)
    assert y == pytest.approx(-np.sign(np.sin(q[:, 1])) * moved, abs=0.03)


def test_error_curves_are_drawn_with_two_sigma_and_the_readings(with_effects):
    _, chart = figures.error_curves(with_effects.report_data)
    c = np.array([with_effects.parameters[f"theta2.curve[{k}]"].estimate for k in range(8)])
    x, y = drawn(chart, "curve")
    knots = np.degrees(np.arange(-4, 5) * np.pi / 4)
    expected = np.degrees([(c[k - 1] + 4.0 * c[k] + c[(k + 1) % 8]) / 6.0 for k in np.arange(-4, 5) % 8])
    assert np.interp(knots, x, y) == pytest.approx(expected, abs=1e-3)
    below, above = list(drawn(chart, "band"))[1].reshape(2, -1)
    prior = np.degrees(2e-3 * np.sqrt(18.0) / 6.0)  # of three independent coefficients, 1 mrad each
    width = 0.5 * (above[::-1] - below)
    assert width[[0, -1]] == pytest.approx(prior, rel=0.05)
    assert np.all(width[np.abs(x) < 70.0] < 0.52 * prior)  # a constant of all is that of theta2
    assert np.abs(next(drawn(chart, "dots"))).max() == pytest.approx(86.0, abs=3.0)


def test_errors_over_torque_show_the_line_that_the_compliance_takes_away(with_effects):
    (chart,) = figures.errors_over_torque(with_effects.report_data)
    k = with_effects.parameters["theta2.compliance"].estimate * 1e6
    slopes = [np.polyfit(*drawn(chart, kind), 1)[0] for kind in ("curve", "dots b", "dots a")]
    assert k == pytest.approx(100.0, rel=0.1)
    assert slopes == pytest.approx([k, k, 0.0], abs=0.1 * k)


def test_a_wide_prior_leaves_corrections_of_other_units_readable(with_effects):
    wide = [replace(p, prior_sigma=1.0) for p in with_effects.result.parameters]
    result = with_effects.result.model_copy(update={"parameters": tuple(wide)})
    *_, chart = figures.parameter_whiskers(replace(with_effects.report_data, result=result))
    labels = html.fromstring(chart.svg).xpath("//text[@class='tick middle']")
    assert chart.caption == "Effects of joints: correction [urad/(N m)]"
    assert 100.0 <= float(labels[-1].text) <= 180.0  # 1.5 times the compliance of 100 urad/(N m) and its sigma


def test_a_loaded_calibration_draws_its_effects_too(with_effects, tmp_path):
    with_effects.save(tmp_path)
    page, loaded = build_page(with_effects.report_data), Calibration.load(tmp_path)
    assert build_page(loaded.report_data) == page
    assert loaded.plot_curves()[:4] == loaded.plot_compliances()[:4] == "<svg"
    assert "Error curves of joints</h2>" in page
    assert "Compliance of joints</h2>" in page


@pytest.mark.slow
@pytest.mark.parametrize("instrument", ["anchors", "planes", "board", "targets"])
def test_every_instrument_has_a_page(instrument):
    robot, _, table = measured_by(instrument, np.random.default_rng(0))
    assert "Residuals" in build_page(calibrate(robot, [table]).report_data)


def test_an_evaluation_says_that_it_is_one():
    rng = np.random.default_rng(4)
    robot = small_arm(TOLERANCE)
    m = replace(measure(robot, 12, rng), test=np.ones(12, dtype=bool))
    page = text_of(html.fromstring(build_page(calibrate(robot, m, model="position").report_data)))
    assert "Evaluated only: all rows are test rows, nothing of the arm was calibrated." in page
    assert "± sigma" not in page


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.2, 17.0), (1e-9, 2e-9), (-1e6, 1e6)])
def test_ticks_are_round_and_within(low, high):
    ticks = Scale(low, high, 0.0, 100.0).ticks()
    assert 2 <= len(ticks) <= 6
    assert low <= min(ticks) + 1e-12 * abs(high)
    assert max(ticks) <= high * (1.0 + 1e-12)
    assert f"{ticks[1] - ticks[0]:.6e}"[:8] in ("1.000000", "2.000000", "5.000000")
