"""Figures of what can be identified: every value, direction and name is in them."""

import numpy as np
import pytest
from matplotlib.text import Text
from simulated import measure, paper_robot, small_arm

from fg_calib.figures import draw_correlations, draw_groups, draw_spectrum, write_figures
from fg_calib.identifiability import observe_configurations, observe_structure


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


def test_the_groups_name_every_parameter_that_moves_unseen(structural):
    shown = words(draw_groups(structural))
    for lost in structural.lost:
        assert all(name in shown for name in lost.relation)
    assert "parallel axes 3, 4" in shown
    assert "blind to the base" in shown


def test_the_correlations_name_every_kept_parameter(practical):
    shown = words(draw_correlations(practical))
    assert all(name in shown for name in practical.observability.kept)


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
