"""Slices of the expected error: what is in a cell, and that a picture of it is drawn."""

import numpy as np
import pytest
from simulated import measure, small_arm, true_robot

from fg_calib import calibrate, predict
from fg_calib.prediction import prediction
from fg_calib.report.slices import CELLS, SLAB, draw_slices, slices_of


@pytest.fixture(scope="module")
def found():
    rng = np.random.default_rng(1)
    robot = small_arm(tolerance={"a": 2e-3, "d": 2e-3, "alpha": 2e-3, "theta": 2e-3})
    result = calibrate(robot, measure(true_robot(robot, rng), 20, rng), model="pose")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prediction, "N_DRAWN", 2000)
        return predict(result)


def test_a_cell_holds_the_rms_of_the_errors_of_its_configurations(found):
    p, error = found.errors.position, found.expected[:, 0]
    *_, around = slices_of(found)
    r = np.hypot(p[:, 0], p[:, 1])
    i, j = np.argwhere(np.isfinite(around.error))[7]
    inside = (around.x[i] <= r) & (r < around.x[i + 1]) & (around.y[j] <= p[:, 2]) & (p[:, 2] < around.y[j + 1])
    assert around.error[i, j] == pytest.approx(np.sqrt(np.mean(error[inside] ** 2)), rel=1e-12)
    low, high = p.min(axis=0), p.max(axis=0)
    thick = SLAB * (high - low).max()
    lowest = slices_of(found)[0]
    height = np.quantile(p[:, 2], 0.2)
    inside = np.abs(p[:, 2] - height) <= 0.5 * thick
    n, _, _ = np.histogram2d(p[inside, 0], p[inside, 1], (lowest.x, lowest.y))
    assert n.sum() == inside.sum()  # none is outside of the picture
    assert np.array_equal(np.isfinite(lowest.error), n > 0)
    assert lowest.error.shape == (CELLS, CELLS)


def test_height_over_distance_holds_every_configuration_and_the_worst(found):
    *_, around = slices_of(found)
    p = found.errors.position
    assert around.x[-1] >= np.hypot(p[:, 0], p[:, 1]).max()
    assert (around.y[0], around.y[-1]) <= (p[:, 2].min(), np.inf)
    assert around.y[-1] >= p[:, 2].max()
    x, y, z = found.worst.errors.position[0]
    assert around.worst == pytest.approx([np.hypot(x, y), z])
    assert len(around.measured) == 20


def test_cells_of_which_nothing_is_known_are_told_from_empty_ones(found):
    from dataclasses import replace

    errors = replace(found.errors, base=np.full_like(found.errors.base, np.nan))
    *_, around = slices_of(replace(found, errors=errors, worst=None))
    assert around.unknown.any()
    assert np.isnan(around.error).all()
    *_, known = slices_of(found)
    assert np.array_equal(around.unknown, np.isfinite(known.error))


@pytest.mark.slow
def test_a_picture_has_four_slices_one_scale_and_names(found):
    figure = draw_slices(found, "arm")
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[3] == "all around the z axis"
    assert [title.startswith("z = ") for title in titles[:3]] == [True] * 3
    assert figure.axes[4].get_ylabel().endswith("[mm]")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["measured", f"largest: {found.worst.errors.base[0, 0] * 1e3:.3g} mm"]
