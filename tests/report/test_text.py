"""The report: its whole text for a problem one can draw, and its width."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from simulated import measure, plus, small_arm, true_robot

from fg_calib import (
    Job,
    Measurements,
    Pairing,
    assess,
    build_problem,
    compare,
    format_comparison,
    format_identifiability,
    format_report,
    observe_configurations,
    observe_structure,
    solve,
)
from fg_calib.options import Options
from fg_calib.report.tables import plain_table, plain_text
from fg_calib.robot.model import Joint, Robot, RobotBuilder
from fg_calib.statistics import goodness_of_fit as goodness


def planar_arm(tolerance=None) -> Robot:
    """Two links of 2 m and 1 m in a plane; unknown are both lengths, and by `tolerance` the last joint's offset d2."""
    builder = RobotBuilder("two-links", "dh")
    builder.add_frame("base", {}, 0, False)
    for i, length in enumerate((2.0, 1.0)):
        builder.add_convention_joint(Joint(f"q{i + 1}"), {"theta": 0.0, "d": 0.0, "a": length, "alpha": 0.0})
    builder.add_frame("tool", {}, 3, False)
    return builder.build(fixed=["theta1", "d1", "alpha1", "theta2", "alpha2"], tolerance=tolerance)


def planar_measurements(n_test=2) -> Measurements:
    """Positions by hand of an arm with links of 2.003 m and 0.998 m, each coordinate off by 1 mm to and fro."""
    q = np.deg2rad([[0, 0], [0, 90], [90, 90], [45, -90], [-30, 60], [120, -45], [10, 30], [-80, -20]])
    first, second = q[:, 0], q[:, 0] + q[:, 1]
    position = np.stack(
        [2.003 * np.cos(first) + 0.998 * np.cos(second), 2.003 * np.sin(first) + 0.998 * np.sin(second)]
    )
    position = np.vstack([position, np.zeros(8)]).T
    position[:, :2] += 1e-3 * np.array([[1, -1], [-1, 1], [1, 1], [-1, -1], [1, -1], [-1, 1], [1, 1], [-1, -1]])
    return Measurements(
        readings=q,
        ids=np.arange(8).astype(str),
        test=np.arange(8) >= 8 - n_test,
        position=position,
        rotation=None,
        sigma_position=np.full((8, 3), 1e-3),
        sigma_orientation=None,
        sigma_joint=np.zeros(2),
    )


def report(robot, measurements, **settings):
    """The report, with what depends on the machine replaced: time, steps and how far the last one had to go."""
    solution = solve(build_problem(robot, measurements, **settings))
    text = format_report(solution, assess(solution))
    return re.sub(r"\d+ iterations, \S+ s,", "N iterations, T s,", text)


GOLDEN = """\
two-links: position
GOOD: converged: less than 3e-07 sigma from the optimum
test rows: chi-square 1.849 where 6 is expected (p-value 0.93)

Fit statistics
configurations     6
residuals          18, and 1 priors
estimated          3 unknowns, 3 directions determined
chi-square         10.8175 with 16 degrees of freedom
reduced chi-square 0.6761 (good from 0.221 to 2.58), p-value 0.82
solver             N iterations, T s, cost 34.5646 -> 5.40874

Goodness of fit (1 sigma of a row)
            stated   seen ratio p-value
position mm 1.0000 0.8452 0.845    0.78 as stated
  no row (|studentised residual| above 3.53) and no configuration is suspicious

Prediction of the test rows
         rows chi-square expected ratio p-value
position    6      2.012        6 0.579    0.92 as expected

Expected tool error (RMS at 2 test configurations)
                in the base frame after the best rigid fit
position    mm             0.6327                   0.4147
orientation deg           0.00000                  0.00067

Residuals (RMS)
            train before  after test before  after
position mm       3.3943 1.3427      2.2226 1.0383

Parameters
        estimate    sigma     correction   nominal  prior class
theta1   0.00000          deg                             fixed
d1        0.0000          mm                              fixed
a1     2003.2998 ± 0.4390 mm     +3.2998 2000.0000        independent
alpha1   0.00000          deg                             fixed
theta2   0.00000          deg                             fixed
d2        0.0000 ± 0.3780 mm     +0.0000    0.0000 1.0000 independent
a2      998.2353 ± 0.4390 mm     -1.7647 1000.0000        independent
alpha2   0.00000          deg                             fixed"""

GOLDEN_OPEN = {
    "Parameters": """\
        estimate     sigma     correction   nominal prior class
theta1   0.00000           deg                            fixed
d1        0.0000           mm                             fixed
a1     2003.4954 ±  0.5298 mm     +3.4954 2000.0000       independent
alpha1   0.00000           deg                            fixed
theta2   0.00000           deg                            fixed
d2        0.0000 ± unknown mm     +0.0000    0.0000       ineffective
a2      998.4334 ±  0.4644 mm     -1.5666 1000.0000       independent
alpha2   0.00000           deg                            fixed""",
    "Measurement frame (world_T_base)": """\
xyz                                     -0.6005  -0.0083  0.0000 mm
± along its axes                         0.5375  0.5397  unknown mm
quaternion xyzw  0.00000000  0.00000000  -0.00010889  0.99999999
± about its axes                       0.05496  0.03790  0.01237 deg""",
    "Notes": """\
  axes 1 and 2 are parallel and convention dh has no parameter for a tilt about y between them: use
  dh-hayati
  what the data leave open of d2 stays at nominal
  no test rows: how well this predicts new configurations was not checked""",
}


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
        assert re.search(rf"{name} +{length:.4f} ± {s:.4f} mm", GOLDEN)
    assert f"chi-square         {left.item():.6g} with {18 + 1 - 3} degrees" in GOLDEN
    assert f"-> {left.item() / 2:.6g}" in GOLDEN
    assert f"± {1 / np.sqrt(7):.4f} mm     +0.0000    0.0000 1.0000" in GOLDEN
    leverage = np.sum(J @ np.linalg.inv(J.T @ J) * J) + 6 / 7  # of d2, six times
    seen = np.sqrt(left.item() / (18 - leverage))
    assert f"position mm 1.0000 {seen:.4f} {seen:.3f} " in GOLDEN
    test = m.readings[6:]
    ahead = np.array([[f(q[0]), f(q.sum())] for q in test for f in (np.cos, np.sin)])  # of x and y, (4, 2)
    predicted = ahead @ lengths - 1e3 * m.position[6:, :2].ravel()
    of_estimate = ahead @ np.linalg.inv(J.T @ J) @ ahead.T
    # z is 0 where it was measured, and off by d2, which makes both of its rows 0.
    assert f"chi-square {predicted @ np.linalg.solve(np.eye(4) + of_estimate, predicted):.4g} where 6 is" in GOLDEN
    assert f"position    6 {np.sum(predicted**2 / (1 + np.diag(of_estimate))):10.4g} " in GOLDEN
    assert f"position    mm             {np.sqrt(np.trace(of_estimate) / 2 + 1 / 7):.4f} " in GOLDEN
    assert f"3.3943 {np.sqrt(left.item() / 6):.4f} " in GOLDEN


def test_it_is_said_that_some_of_many_test_rows_are_whitened(monkeypatch):
    def line(wrong=0.0):
        m = planar_measurements()
        position = m.position + wrong * m.test[:, None]
        return report(planar_arm(), replace(m, position=position), model="position").splitlines()[1:]

    assert "rows" not in line()[1].removeprefix("test rows: ")
    monkeypatch.setattr(goodness, "MAX_WHITENED", 4)
    some = r"test rows: chi-square \S+ where 4 is expected \(p-value \S+\), of 4 of the 6 rows, evenly spaced"
    assert re.fullmatch(some, line()[1])
    some = some.replace("p-value ", "p-value < ")
    assert re.match(f"DOUBTFUL: {some}: the arm does not predict", " ".join(line(0.1)))
    monkeypatch.setattr(goodness, "MAX_KEPT", 0)  # all of them, one by one
    assert re.fullmatch(r"test rows: chi-square \S+ where 6 is expected \(p-value \S+\)", line()[1])


def test_the_report_names_the_frame_and_what_stays_open():
    m = planar_measurements()
    train = replace(
        m,
        readings=m.readings[:6],
        ids=m.ids[:6],
        test=m.test[:6],
        position=m.position[:6],
        sigma_position=m.sigma_position[:6],
    )
    found = sections(report(planar_arm(), train, model="position", frame="unknown"))
    assert {heading: found[heading] for heading in GOLDEN_OPEN} == GOLDEN_OPEN
    assert re.search("^d2 ", found["What the data do not determine"], flags=re.M)


def test_doubt_stands_first():
    m = planar_measurements()
    text = report(planar_arm(), replace(m, sigma_position=m.sigma_position / 5), model="position")
    assert text.startswith("two-links: position\nDOUBTFUL: reduced")
    # A tilt that positions in the arm's plane do not see is no cause.
    assert "axes 1 and 2 are parallel" in text.partition("Notes")[2]
    assert "noise specified too small" in text
    assert "GOOD" not in text


LONG = ("shoulder_pan_joint", "elbow_flexion_joint", "wrist_3_joint")


def arm_with_long_names():
    """Three joints named as URDFs name them."""
    builder = RobotBuilder("arm", "urdf")
    builder.add_frame("base", {}, 0, False)
    for i, (name, axis) in enumerate(zip(LONG, np.eye(3)[[2, 1, 0]], strict=True)):
        builder.add_urdf_joint(Joint(name), {"x": 0.1 * i, "z": 0.3}, axis)
    builder.add_frame("tool", {"x": 0.1, "z": 0.2}, 4, False)
    return builder.build(tolerance={"x": 1e-3, "yaw": 2e-3}, estimate=["tool.x", "tool.y", "tool.z"])


@pytest.fixture(scope="module")
def long_reports(tmp_path_factory):
    """From a width to the text, of every command, and its words on a very wide page."""
    robot, rng = arm_with_long_names(), np.random.default_rng(5)
    m = measure(true_robot(robot, rng), 25, rng, sigma_joint=1e-4, n_test=10)
    m = replace(m, position=plus(m.position, 7, 0.03))  # for suspicious rows and configurations
    solutions = [
        solve(build_problem(robot, m, model=model, frame="unknown", **options))
        for model, options in (
            ("pose", {}),
            ("distance", {"loss": "huber", "gauge": "none"}),
        )
    ]
    job = Job(tmp_path_factory.mktemp("job") / "job.yaml", robot, m, Options(), truth=true_robot(robot, rng))
    reports = [
        *(partial(format_report, s, assess(s)) for s in solutions),
        partial(format_identifiability, observe_structure(robot, "distance-rotation", n_configurations=50)),
        partial(format_identifiability, observe_configurations(robot, m, "pose")),
        partial(format_comparison, compare(job)),
    ]
    return [(report, words(report(width=1000))) for report in reports]


def words(text):
    """The words of a report but the headings of columns that may be empty."""
    return set(text.split()) - {"prior", "b"}


@pytest.mark.slow
@pytest.mark.parametrize("width", [40, 60, 100, 80, 200])
def test_no_width_breaks_a_word(long_reports, width):
    """What was a word on a very wide page is one on every page: names, figures, units."""
    for text, expected in long_reports:
        found = text(width=width)
        assert words(found) == expected
        lines = found.splitlines()
        assert max(map(len, lines)) <= width
        assert all(line == line.rstrip() for line in lines)
        assert any(f"{LONG[0]}.roll" in line for line in lines)


def test_a_page_narrower_than_a_name_is_as_wide_as_the_name(long_reports):
    for text, expected in long_reports:
        assert words(text(width=10)) == expected


def test_a_row_without_room_is_a_paragraph(long_reports):
    wide, narrow = (long_reports[0][0](width=width) for width in (200, 50))
    (row,) = (line for line in sections(wide)["Parameters"].splitlines() if line.startswith("wrist_3_joint.x "))
    name, estimate, _, sigma, unit, correction, nominal, prior, kind = row.split()
    found = " ".join(sections(narrow)["Parameters"].split())
    assert (
        f"{name} estimate {estimate} ± sigma {sigma} {unit} correction {correction} nominal {nominal} prior {prior} "
        f"class {kind}" in found
    )


# --- the poses behind suspicious pairs -------------------------------------------------------------------------------


def suspicious_rows(pairing, wrong, *, n=30, **options):
    """The section of a report on pairs formed from n poses, of which some are measured 20 mm off."""
    robot, rng = small_arm({"a": 1e-3, "d": 1e-3, "theta": 1e-3, "alpha": 1e-3}), np.random.default_rng(8)
    m = measure(true_robot(robot, rng), n, rng)
    m = replace(m, position=plus(m.position, wrong, 0.02 * np.array([1.0, -1.0, 1.0])))
    solution = solve(build_problem(robot, replace(m, ids=np.array([f"p{i}" for i in range(n)])), model="distance",
                                   pairing=pairing, **options))  # fmt: skip
    return sections(format_report(solution, assess(solution)))["Suspicious rows"]


@pytest.mark.slow
def test_a_pose_is_named_before_its_pairs():
    first, second, *_ = suspicious_rows(Pairing("all"), [17], loss="gnc").splitlines()
    found = re.fullmatch(r"  pose p17 is in (\d+) of (\d+) suspicious pairs, and in 29 pairs in all", first)
    assert int(found[1]) > 0.5 * 29
    assert int(found[1]) >= 0.8 * int(found[2])
    assert "pose" not in second


@pytest.mark.slow
def test_several_wrong_poses_are_told_apart():
    text = suspicious_rows(Pairing("all"), [5, 17], loss="gnc")
    assert set(re.findall(r"pose (p\d+) is in", text)) == {"p5", "p17"}


@pytest.mark.slow
def test_the_hub_of_a_star_is_not_blamed_for_a_wrong_spoke():
    """It is in every suspicious pair, but in many good ones too; the spoke's only pair stands in the table."""
    text = suspicious_rows(Pairing("star"), [9], loss="gnc")
    assert "pose" not in text
    assert re.search(r"^p0 +p9 +distance", text, flags=re.M)


@pytest.mark.slow
def test_in_a_chain_both_pairs_of_a_pose_are_its():
    assert suspicious_rows(Pairing("chain"), [9], loss="gnc").startswith(
        "  pose p9 is in 2 of 2 suspicious pairs, and in 2 pairs in all\n"
    )


def test_a_row_of_a_paragraph_without_a_name_goes_on_with_the_one_above():
    table = plain_table(("error", "left"), ("RMS", "right"), ("largest", "right"))
    table.add_row("of positions", "1.5", "2.5")
    table.add_row("", "0.1", "0.2")
    assert plain_text(table, 20) == "\n".join(
        ["error of positions", "  RMS 1.5  largest", "  2.5", "  RMS 0.1  largest", "  0.2"]
    )
