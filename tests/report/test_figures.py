"""Figures of what can be identified: every value, direction and name is in them."""

import numpy as np
import pytest
from matplotlib.text import Text
from simulated import measure, paper_robot, planar_robot, small_arm

from fg_calib.observability.identifiability import observe_configurations, observe_structure
from fg_calib.report.figures import draw_correlations, draw_groups, draw_spectrum, write_figures


@pytest.fixture(scope="module")
def structural():
    return observe_structure(paper_robot(), "distance-rotation")


@pytest.fixture(scope="module")
def practical():
    robot = small_arm()
    return observe_configurations(robot, measure(robot, 40, np.random.default_rng(0)), "pose")


def words(figure):
    found = [text.get_text() for text in figure.findobj(Text)]
    return " ".join(" ".join(found).split())


def test_the_spectrum_shows_every_singular_value(structural):
    figure = draw_spectrum(structural)
    shown = sum(len(line.get_xdata()) for line in figure.axes[0].lines if line.get_linestyle() == "None")
    assert shown == 35
    assert "rank 23 of 35" in words(figure)
    assert "gap" in words(figure)


def markers(figure):
    """How many values each entry of the legend stands for: as drawn, and as its words say."""
    lines = [line for line in figure.axes[0].lines if line.get_linestyle() == "None"]
    return {line.get_label(): len(line.get_xdata()) for line in lines}


def test_weak_values_are_told_from_strong_and_lost_ones(structural, practical):
    o = practical.observability
    n_weak = int(np.sum(o.singular_values[: o.rank] < 10.0))
    assert n_weak
    shown = markers(draw_spectrum(practical))
    assert shown["determined, but weak: " + str(n_weak)] == n_weak
    assert sum(shown.values()) == len(o.names)
    drawn = {line.get_label(): line.get_ydata() for line in draw_spectrum(practical).axes[0].lines}
    assert drawn["determined, but weak: " + str(n_weak)] == pytest.approx(o.singular_values[o.rank - n_weak : o.rank])
    assert not any("weak" in label for label in markers(draw_spectrum(structural)))  # its noise is arbitrary


def test_where_nothing_is_determined_there_is_still_a_figure():
    # An arm in the plane turns about one axis, which its angles do not calibrate: every singular value is zero.
    found = observe_structure(planar_robot(), "rotation")
    assert found.observability.rank == 0
    assert markers(draw_spectrum(found)) == {"lost, zero: 8": 8}  # 4 of each joint


def test_the_groups_have_a_cell_for_every_change(structural):
    figure = draw_groups(structural)
    cells = figure.axes[0].images[0].get_array()
    assert cells.shape == (12, 16)  # 7 alone, and [beta1 theta2] [beta2 theta3] [d3 d4 d5] [beta5 theta6]
    assert np.ma.count(cells) == sum(len(lost.relation) for lost in structural.lost)


def test_the_groups_name_every_parameter_that_moves_unseen(structural):
    shown = words(draw_groups(structural))
    for lost in structural.lost:
        assert all(name in shown for name in lost.relation)
    assert "parallel axes 3, 4" in shown
    assert "blind to the base" in shown


def test_the_correlations_name_every_kept_parameter(practical):
    shown = words(draw_correlations(practical))
    assert all(name in shown for name in practical.observability.kept)


@pytest.mark.slow
def test_files_are_written_where_they_mean_something(structural, practical, tmp_path):
    for name, found in (("structural", structural), ("practical", practical)):
        folder = tmp_path / name
        folder.mkdir()
        write_figures(folder, found)
    assert {f.name for f in (tmp_path / "structural").iterdir()} == {"spectrum.png", "groups.png"}
    written = {f.name for f in (tmp_path / "practical").iterdir()}
    assert {"spectrum.png", "correlations.png"} <= written
    assert ("groups.png" in written) == bool(practical.lost)
    assert all(f.stat().st_size > 5000 for f in (tmp_path / "practical").iterdir())
