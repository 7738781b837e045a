"""Few wrong measurements are told from noise and from what is not modelled, however far they are off."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from instruments import measured_by
from reported import format_report
from simulated import LARGE, measure, plus, small_arm, true_robot
from sparing import diagonal
from systematic import measured, of_joint, problem_of

from fg_calib import Pairing, assess, build_problem, solve
from fg_calib.statistics import ResidualTable


@pytest.mark.slow
@pytest.mark.parametrize("swapped", [3, 4])
def test_anchors_exchanged_where_the_fit_goes_far_astray_are_outliers(swapped):
    """Half a metre, and one row too many a parameter."""
    robot, _, table = measured_by("anchors", np.random.default_rng(10), n=45)
    m = table.measurements
    anchor = m.labels["anchor"]
    index = anchor.index.copy()
    index[[swapped, swapped + 12]] = index[[swapped + 1, swapped + 13]]
    wrong = replace(m, labels={**m.labels, "anchor": replace(anchor, index=index)})
    found = assess(solve(build_problem(robot, [replace(table, measurements=wrong)])))
    assert {fit.verdict for fit in found.fit.goodness.kinds} == {"outliers"}
    assert sorted(found.fit.goodness.gross.names) == sorted(str(m.ids[k]) for k in (swapped, swapped + 12))


def spoilt(name, by, rng):
    """A problem one measurement of which is `by` sigma off, and the name of its configuration."""
    robot = small_arm(tolerance=LARGE)
    if name in ("anchors", "planes", "board", "targets"):
        robot, _, table = measured_by(name, rng)
        m = table.measurements
        if name in ("anchors", "planes"):
            m = m.with_values({"distance": plus(m.value("distance"), 9, by * 1e-4)})
        else:
            m = replace(m, position=plus(m.position, (9, 1), by * 3e-4))
        return build_problem(robot, [replace(table, measurements=m)]), str(m.ids[9])
    m = measure(true_robot(robot, rng), 16 if name == "all" else 30, rng, sigma=(1e-3, 5e-4), sigma_joint=1e-4)
    m = replace(m, position=plus(m.position, 9, by * 1e-3))
    if name == "pose":
        return build_problem(robot, m, model="pose"), "9"
    return build_problem(robot, m, model="distance-rotation", pairing=Pairing(name)), "9"


SPOILT = ["pose", "star", "all", "anchors", "planes", "board", "targets"]


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("name", "by"), diagonal(SPOILT, [60.0, 2000.0]))
def test_one_wrong_measurement_is_named_however_far_it_is_off(name, by):
    problem, wrong = spoilt(name, min(by, 300.0) if name == "all" else by, np.random.default_rng(5))
    found = assess(solve(problem))
    verdicts = {fit.verdict for fit in found.fit.goodness.kinds}
    assert "outliers" in verdicts <= {"outliers", "others", "as specified"}
    assert [name.removeprefix("0 and ") for name in found.fit.goodness.gross.names] == [wrong]
    assert found.fit.goodness.gross.ratio < 1.5
    assert found.fit.goodness.gross_alone
    assert not found.noise_may_be_estimated


def test_what_is_an_end_of_several_wrong_pairs_is_named_in_their_place():
    ends = SimpleNamespace(names="0123456789", a=[0, 3, 4, -1], b=[9, 9, 5, 7])
    assert ResidualTable.named(ends, range(4)) == ("9", "4 and 5", "7")


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 5])
def test_noise_specified_too_small_is_named_next_to_outliers(n):
    rng = np.random.default_rng(8)
    robot, m = measured("6R", rng, unit=0.5)
    m = replace(m, position=plus(m.position, rng.choice(60, n, replace=False), 0.05))
    found = assess(solve(problem_of(robot, m, "position")))
    assert [fit.verdict for fit in found.fit.goodness.kinds] == ["too small"]
    assert found.fit.goodness.gross.names
    assert not found.fit.goodness.gross_alone


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize("error", [lambda _, q: 1e-3 * q, lambda _, q: 1e-3 * np.cos(q)], ids=["gain", "eccentric"])
def test_what_is_not_modelled_is_no_outlier(error, k):
    robot, m = measured("6R", np.random.default_rng(k), effect=of_joint(k, error))
    solution = solve(problem_of(robot, m, "pose"))
    found = assess(solution)
    assert not {fit.verdict for fit in found.fit.goodness.kinds} & {"outliers", "others"}
    assert not found.fit.goodness.gross_alone
    assert "loss: gnc" not in format_report(solution, found)
