"""The report: its whole text for a problem one can draw, and which poses it names."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from reported import format_report
from simulated import measure, planar_robot, plus, small_arm, true_robot

from fg_calib import Measurements, Pairing, Robot, assess, build_problem, solve
from fg_calib.report import compare
from fg_calib.report.tables import plain_text, table_of


def planar_arm(tolerance=None) -> Robot:
    """Two links of 2 m and 1 m in a plane; unknown are both lengths, and by `tolerance` the last joint's offset d2."""
    fixed = ["theta1", "d1", "alpha1", "theta2", "alpha2"]
    return planar_robot(tolerance, name="two-links", fixed=fixed)


def planar_measurements(n_test=2) -> Measurements:
    """Positions by hand of an arm with links of 2.003 m and 0.998 m, each coordinate off by 1 mm to and fro."""
    q = np.deg2rad([[0, 0], [0, 90], [90, 90], [45, -90], [-30, 60], [120, -45], [10, 30], [-80, -20]])
    first, second = q[:, 0], q[:, 0] + q[:, 1]
    position = np.array([2.003 * f(first) + 0.998 * f(second) for f in (np.cos, np.sin, np.zeros_like)]).T
    position[:, :2] += 1e-3 * np.array([[1, -1], [-1, 1], [1, 1], [-1, -1], [1, -1], [-1, 1], [1, 1], [-1, -1]])
    return Measurements.from_arrays(q, position=position, sigma_position=1e-3, test=np.arange(8) >= 8 - n_test)


def report(robot, measurements, **settings):
    """The report, with what depends on the machine replaced: time, steps and how far the last one had to go."""
    solution = solve(build_problem(robot, measurements, **settings))
    text = format_report(solution, assess(solution))
    return re.sub(r"\d+ iterations, \S+ s,", "N iterations, T s,", text)


GOLDEN = """\
two-links: position
GOOD: converged: less than 3e-07 sigma from the optimum
test rows: chi-square 1.849 where 6 is expected (p-value 0.93)

Residuals (RMS)
              train before   after  test before   after
position  mm        3.3943  1.3427       2.2226  1.0383
                     test rows: mean     std    95 %     max
position before  mm           2.2115  0.2223  2.4115  2.4337
position after   mm           1.0352  0.0812  1.1083  1.1164
mean: the accuracy of ISO 9283, averaged over these rows

Fit statistics
configurations      6
residuals           18, and 1 priors
estimated           3 unknowns, 3 directions determined
chi-square          10.8175 with 16 degrees of freedom
reduced chi-square  0.6761 (good from 0.221 to 2.58), p-value 0.82
solver              N iterations, T s, cost 34.5646 -> 5.40874

Goodness of fit (1 sigma of a row)
              specified  observed  ratio  p-value
position  mm     1.0000    0.8452  0.845     0.78  as specified
  no row (|studentised residual| above 3.53) and no configuration is suspicious

Prediction of the test rows
          rows  ratio  p-value
position     6  0.579     0.92  as expected

Expected tool error (RMS at 6 train configurations)
                  in the base frame  after the best rigid fit
position     mm              0.6901                    0.5044
orientation  deg            0.00000                   0.00254

Parameters
         estimate  ± sigma       correction    nominal   prior  class
theta1    0.00000           deg                                 fixed
d1         0.0000           mm                                  fixed
a1      2003.2998   0.4390  mm      +3.2998  2000.0000          independent
alpha1    0.00000           deg                                 fixed
theta2    0.00000           deg                                 fixed
d2         0.0000   0.3780  mm      +0.0000     0.0000  1.0000  independent
a2       998.2353   0.4390  mm      -1.7647  1000.0000          independent
alpha2    0.00000           deg                                 fixed"""


def sections(text):
    """A report's sections by heading; the first one is called `""`."""
    first, *rest = text.split("\n\n")
    return {"": first} | dict(section.split("\n", 1) for section in rest)


def test_the_report_of_two_links_is_this_text():
    found = sections(report(planar_arm({"d2": 0.001}), planar_measurements(), model="position"))
    expected = sections(GOLDEN)
    assert list(found)[: len(expected)] == list(expected)
    assert {heading: found[heading] for heading in expected} == expected


def test_its_figures_are_those_of_linear_least_squares_by_hand():
    """Lengths are linear in the positions: normal equations in mm; d2 is 6 readings of 0 and a prior, all 1 mm."""
    m = planar_measurements()
    first, both = m.readings[:6, 0], m.readings[:6].sum(axis=1)
    J = np.stack([np.concatenate([np.cos(q), np.sin(q)]) for q in (first, both)], axis=1)  # (12, 2)
    y = 1e3 * m.position[:6, :2].T.ravel()
    lengths, left = np.linalg.lstsq(J, y, rcond=None)[:2]
    sigma = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    for name, length, s in zip(("a1", "a2"), lengths, sigma, strict=True):
        assert re.search(rf"{name} +{length:.4f}   {s:.4f}  mm", GOLDEN)
    assert f"chi-square          {left.item():.6g} with {18 + 1 - 3} degrees" in GOLDEN
    assert f"-> {left.item() / 2:.6g}" in GOLDEN
    assert f"{1 / np.sqrt(7):.4f}  mm      +0.0000     0.0000  1.0000" in GOLDEN
    leverage = np.sum(J @ np.linalg.inv(J.T @ J) * J) + 6 / 7  # of d2, six times
    seen = np.sqrt(left.item() / (18 - leverage))
    assert f"position  mm     1.0000    {seen:.4f}  {seen:.3f} " in GOLDEN
    test = m.readings[6:]
    ahead = np.array([[f(q[0]), f(q.sum())] for q in test for f in (np.cos, np.sin)])  # of x and y, (4, 2)
    predicted = ahead @ lengths - 1e3 * m.position[6:, :2].ravel()
    of_estimate = ahead @ np.linalg.inv(J.T @ J) @ ahead.T
    expected = np.trace(J @ np.linalg.inv(J.T @ J) @ J.T)  # at train rows: two test rows are too few for a rigid fit
    # z is 0 where it was measured, and off by d2, which makes both of its rows 0.
    assert f"chi-square {predicted @ np.linalg.solve(np.eye(4) + of_estimate, predicted):.4g} where 6 is" in GOLDEN
    assert f"position     6  {np.sqrt(np.sum(predicted**2 / (1 + np.diag(of_estimate))) / 6):.3f} " in GOLDEN
    assert f"position     mm              {np.sqrt(expected / 6 + 1 / 7):.4f} " in GOLDEN
    assert f"3.3943  {np.sqrt(left.item() / 6):.4f} " in GOLDEN


def test_the_report_names_the_frame_and_what_is_not_identifiable():
    found = sections(report(planar_arm(), planar_measurements(0), model="position", frame="unknown", gauge="none"))
    assert found["Measurement frame (world_T_base)"].splitlines()[0].split()[:3] == ["xyz", "-0.5077", "0.0507"]
    assert "unknown  mm" in found["Measurement frame (world_T_base)"]
    assert found["Not identifiable from these data"].splitlines()[1].startswith("d2  the measurement is blind to the")
    assert "  not identifiable from these data, kept at nominal: d2\n" in found["Notes"]
    assert found["Notes"].endswith("no test rows: the prediction of new configurations was not checked")


def test_doubt_stands_first():
    m = planar_measurements()
    text = report(planar_arm(), replace(m, sigma_position=m.sigma_position / 5), model="position")
    assert text.startswith("two-links: position\nDOUBTFUL: reduced")
    # A tilt that positions in the arm's plane do not see is no cause.
    assert "axes 1 and 2 are parallel" in text.partition("Notes")[2]
    assert "noise specified too small" in text
    assert "GOOD" not in text


def test_where_the_terminal_is_narrow_no_word_and_no_value_is_cut():
    row, heads = ("theta2.compliance", "errors of a configuration", -0.123, "ruled out"), ("", "", "change|rad", "a b")
    for width in range(20, 110, 10):
        text = plain_text(table_of(heads, [row]), width)
        words = f"change a b {row[0]} {row[1]} -7.04738 {row[3]}".split()
        assert sorted(text.split()) == sorted(words)
        assert max(map(len, text.splitlines())) <= max(width, 17 + 13 + 8 + 5 + 3 * 2)  # of the longest words


def test_names_in_brackets_are_text():
    m = replace(planar_measurements(), ids=np.array([f"[red]{i}" for i in range(8)]))
    wrong = replace(m, position=plus(m.position, [0], 0.05))
    assert "[red]0" in report(planar_arm({"d2": 0.001}), wrong, model="position")


def test_a_wrong_pose_of_pairs_is_the_first_suspicious_configuration():
    robot, rng = small_arm({"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}), np.random.default_rng(8)
    m = measure(true_robot(robot, rng), 12, rng)
    position = plus(m.position, [7], 0.02 * np.array([1.0, -1.0, 1.0]))
    m = replace(m, position=position, ids=np.array([f"p{i}" for i in range(12)]))
    found = sections(report(robot, m, model="distance", pairing=Pairing("all")))
    assert found["Suspicious configurations"].splitlines()[1].split()[:2] == ["p7", "11"]
    assert "p7" in found["Suspicious rows"].splitlines()[1].split()[:2]


def test_a_history_counts_no_whole_turns():
    """An angle found a turn away has changed by what is left; another one by more, in its sigma."""
    before, run = (
        SimpleNamespace(parameters={"theta1": (angle, 1e-3, "rad"), "a1": (length, 1e-4, "m")})
        for angle, length in ((3.1, 0.5), (3.1 + 2e-3 - 2.0 * np.pi, 0.5003))
    )
    most = compare._largest_change(before, run)
    assert (most["name"], most["in_sigma"]) == ("a1", pytest.approx(3.0))
    for one in (before, run):
        del one.parameters["a1"]
    assert compare._largest_change(before, run)["change"] == pytest.approx(2e-3)
