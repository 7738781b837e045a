"""Stops, the sigma of their means, and the offset of clocks, on recordings whose truth is known."""

import re

import numpy as np
import pytest
from recordings import arm, correlated, record
from scipy.spatial.transform import Rotation

from fg_calib import InputError
from fg_calib.importers.bag import JointStream, PoseStream, Source, average_stops, correlation_time


def averaged(motion, **more):
    return average_stops(*motion.streams(), arm(1e-3), **more)


def nees(stops, motion):
    """Mean squared error over its variance, of positions and orientations."""
    k = [int(name[4:]) - 1 for name in stops.ids]
    off = (stops.means["position"] - motion.true_position[k]) / stops.sigmas["position"]
    true = Rotation.from_matrix(motion.true_rotation[k])
    turned = Rotation.from_matrix(stops.means["orientation"].copy()).inv() * true
    return np.mean(off**2), np.mean((turned.as_rotvec() / stops.sigmas["orientation"]) ** 2)


@pytest.fixture(scope="module")
def motion():
    return record(1)


def test_every_stop_gives_a_row_of_its_configuration(motion):
    stops = averaged(motion)
    assert stops.ids == tuple(f"stop{k + 1}" for k in range(12))
    assert stops.skipped == ()
    scatter = 2e-5 / np.sqrt(100.0)  # some 110 readings a stop
    assert np.abs(stops.means["joint"] - motion.true_readings).max() < 5.0 * scatter
    assert stops.scatter["position"].single == pytest.approx(1e-4, rel=0.2)
    assert nees(stops, motion) == pytest.approx([1.0, 1.0], abs=5.0 * np.sqrt(2.0 / 36.0))


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("offset", "tool"), [(0.137, (0.15, -0.1, 0.05)), (-2.5, (0, 0, 0)), (1.6e9, (0, 0, 0))])
def test_the_offset_of_the_clocks_is_found_to_a_hundredth_of_a_second(offset, tool):
    """Wherever the target is on the tool, and with a clock of another day."""
    found = averaged(record(2, offset=offset, tool=tool)).offset
    assert found.seconds == pytest.approx(offset, abs=0.01)
    assert found.correlation > 0.98


def test_a_specified_offset_is_used_and_a_large_one_refused(motion):
    stops = averaged(motion, offset=0.13)
    assert (stops.applied, stops.offset) == (0.13, None)
    with pytest.raises(InputError, match=r"topic /pose: an offset of 0\.1\d* s .*, expected at most 0\.1 s"):
        averaged(motion, most_offset=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("turns", [0, 1, -1])
def test_of_motions_that_repeat_themselves_the_offset_nearest_to_receipt_is_taken(turns):
    once = record(5, n_stops=4, sigma_position=1e-5, sigma_orientation=1e-5)
    joints, poses = once.streams()
    period, many = once.joint_time[-1] + 1.0, 6
    time, pose_time = (np.concatenate([t + k * period for k in range(many)]) for t in (joints.time, poses.time))
    repeated = (joints.readings, poses.position, poses.rotation)
    readings, position, rotation = (np.concatenate([x] * many) for x in repeated)
    source = Source("/pose", "", lag=-(0.137 + turns * period))
    shifted = PoseStream(pose_time + turns * period, position, rotation, source)
    found = average_stops(JointStream(time, readings, joints.source), shifted, arm()).offset
    assert found.seconds == pytest.approx(0.137 + turns * period, abs=0.01)


def test_poses_of_something_else_are_refused():
    joints, _ = record(6).streams()
    _, poses = record(7, move=2.0).streams()
    said = r"the poses do not move as the joints do \(correlation .*\), expected poses of"
    with pytest.raises(InputError, match=said):
        average_stops(joints, poses, arm())
    with pytest.raises(InputError, match=r"no standstill of 2 s, expected the arm at rest.*; the longest pause is"):
        averaged(record(11, rest=0.6), still=2.0)


def test_stops_that_scatter_far_more_than_others_are_skipped(motion):
    joints, poses = motion.streams()
    first, last = averaged(motion).interval[5] + motion.offset
    inside = (poses.time >= first) & (poses.time <= last)
    position = poses.position.copy()
    position[inside, 1] += 0.01 * (poses.time[inside] - first) / (last - first)
    stops = average_stops(joints, PoseStream(poses.time, position, poses.rotation, poses.source), arm(1e-3))
    assert [s.id for s in stops.skipped] == ["stop6"]
    assert re.fullmatch("the position scatters .* times as much as usual", stops.skipped[0].reason)


@pytest.mark.parametrize(("phi", "n"), [(0.0, 100), (0.5, 400), (0.8, 400), (0.95, 100)])
def test_correlation_time_is_that_of_the_noise_or_of_the_stop_where_noise_is_as_slow(phi, n):
    """Against the sum over the lags of AR(1)."""
    generator = np.random.default_rng(3)
    stops = [x - x.mean(axis=0) for x in (s * correlated(generator, (n, 3), phi) for s in (1.0, 10.0) * 50)]
    k = np.arange(1, n)
    expected = 1.0 + 2.0 * np.sum((1.0 - k / n) * phi**k)
    assert correlation_time(stops) == pytest.approx(expected if expected < n / 8 else n, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize(("phi", "least"), [(0.0, 0.85), (0.5, 0.8), (0.97, 0.2)])
def test_sigmas_are_those_of_the_errors(phi, least):
    """Monte Carlo: 20 recordings of 12 stops; of noise as slow as a stop sigmas may be larger, not smaller."""
    found = [nees(averaged(motion), motion) for motion in (record(100 + s, phi=phi) for s in range(20))]
    mean, error = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(20)
    assert np.all(mean < 1.05 + 3.0 * error)
    assert np.all(mean > least - 3.0 * error)


def test_sigmas_of_orientations_are_about_the_tools_axes_and_of_positions_along_the_worlds():
    joints, poses = record(12, sigma_position=1e-9, sigma_orientation=1e-9).streams()
    generator = np.random.default_rng(0)
    off, turn = generator.standard_normal((2, len(poses.time), 3)) * [[[1e-4, 1e-3, 1e-4]], [[1e-3, 1e-4, 1e-4]]]
    rotation = Rotation.from_matrix(poses.rotation.copy()) * Rotation.from_rotvec(turn)
    noisy = PoseStream(poses.time, poses.position + off, rotation.as_matrix(), poses.source)
    stops = average_stops(joints, noisy, arm())
    position, orientation = (np.median(stops.sigmas[kind], axis=0) for kind in ("position", "orientation"))
    assert position / position[0] == pytest.approx([1, 10, 1], rel=0.2)
    assert orientation / orientation[1] == pytest.approx([10, 1, 1], rel=0.2)
