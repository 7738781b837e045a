"""The page: every section, from a new and a loaded calibration, in one file; names in it are text."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by
from lxml import html
from simulated import measure, small_arm, true_robot

from fg_calib import Calibration, calibrate
from fg_calib.calibration import write_report
from fg_calib.report.charts import Scale
from fg_calib.report.html import build_page

WEAKLY = "Weakly determined (sigma above a tenth of the prior sigma, or of 1 mrad at the reach)"
SECTIONS = [
    *("The arm and what was measured", "Notes", "Residuals (RMS)", "Fit statistics",
      "Goodness of fit (1 sigma of a row)"),
    *("Prediction of the test rows", "Expected tool error (RMS at 10 test configurations)"),
    *("Parameters", "Suspicious rows", "Suspicious test rows", "Suspicious configurations"),
    "Measurement frame (world_T_base)",
    *("Not identifiable from these data", WEAKLY, "Studentised residuals", "Error over joint space"),
    *("Correlations", "Expected error over the workspace"),
    "Inputs, options and versions",
]  # fmt: skip
TOLERANCE = {"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}


def calibrated(robot=None, **options):
    rng = np.random.default_rng(3)
    robot = robot or small_arm(TOLERANCE)
    m = measure(true_robot(robot, rng), 30, rng, n_test=10)
    position = m.position.copy()
    position[4] += 0.02
    given = {"model": "position", "frame": "unknown", "accept": {"position": 1e-3}} | options
    return calibrate(robot, replace(m, position=position), **given)


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


def test_a_loaded_calibration_has_the_same_page(made, folder, tmp_path):
    write_report(folder, tmp_path)
    assert (tmp_path / "report.html").read_text() == (folder / "report.html").read_text()


def test_the_verdict_comes_first_with_its_values(made, page):
    verdicts = [text_of(one) for one in page.xpath("//div[contains(@class, 'verdict')]")]
    assert verdicts[0].startswith("DOUBTFUL: not to be trusted")
    assert all(finding in verdicts[0] for finding in made.findings)
    assert verdicts[1].startswith("FAIL: the specified limits FAIL: position")
    tiles = {text_of(tile) for tile in page.xpath("//div[@class='tile']")}
    rms = made.result.residual_rms["test"]["position"]
    expected = f"{rms.after * 1e3:.3g} mm position, rows held out; before: {rms.before * 1e3:.3g} mm"
    assert expected in tiles


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


def test_figures_are_svg_files_of_their_own(folder):
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
