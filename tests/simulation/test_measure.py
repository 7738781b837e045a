"""What simulated instruments measure: against 4x4 products without noise, noise by statistics, jobs by running."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from exported import matrix
from oracle import tool_pose
from refusals import refusal
from scenarios import CAMERA, EXACT, GRID, INSTRUMENTS, SIGMA, WALL, scenario
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from simulated import nees, planar_robot
from tolerances import rounding

from fg_calib import InputError, calibrate, read_job, simulate
from fg_calib.initialization import Camera
from fg_calib.robot.rotations import rotation_angle
from fg_calib.simulation import Instrument, Placement, RandomReadings, Spot, write_simulation
from fg_calib.simulation.simulator import project


@cache
def exact(which):
    """What an instrument measures without noise, the truth, and the true tool frames, 4x4."""
    n = {"pixels": 400, "camera in the room": 60, "faces": 12, "contact": 12}.get(which, 40)
    of = scenario(INSTRUMENTS[which], n=n, noise=EXACT, specified_noise=SIGMA, validation=RandomReadings(7))
    s = simulate(of)
    m = s.tables[0].measurements
    return m, s.truth, np.stack([tool_pose(s.true_robot, q) for q in m.readings])


def as_matrix(frame):
    """4x4 of a `Placement`."""
    return matrix(frame.rotation, frame.position)


def names_of(labels):
    return [labels.names[k] for k in labels.index]


CLOSE = rounding(30.0)  # products of a few lengths of metres


@pytest.mark.parametrize("which", ["pose", "orientations", "targets", "stations"])
def test_a_tracker_sees_targets_from_its_stations(which):
    m, truth, T = exact(which)
    targets = names_of(m.labels["target"]) if "target" in m.labels else [None] * len(T)
    stations = names_of(m.labels["station"]) if "station" in m.labels else [None] * len(T)
    for k, (target, station) in enumerate(zip(targets, stations, strict=True)):
        X = as_matrix(truth["frames"]["it" if station is None else f"it, station {station}"])
        there = [0, 0, 0] if target is None else truth["targets"][target].xyz
        if m.position is not None:
            assert m.position[k] == pytest.approx((X @ T[k] @ [*there, 1.0])[:3], abs=CLOSE)
        if m.rotation is not None:
            assert m.rotation[k] == pytest.approx((X @ T[k])[:3, :3], abs=CLOSE)
    if which == "stations":
        assert [*zip(m.ids, stations, targets, strict=True)][1:3] == [("p0", "s1", "b"), ("p1", "s2", "a")]


def test_pairs_are_measured_between_configurations():
    m, _, T = exact("pairs")
    pairs = m.pairs
    assert pairs.n_pairs == 80 + 21  # and all of seven test rows
    step = T[pairs.b, :3, 3] - T[pairs.a, :3, 3]
    turn = np.swapaxes(T[pairs.a, :3, :3], 1, 2) @ T[pairs.b, :3, :3]
    assert pairs.distance == pytest.approx(np.linalg.norm(step, axis=1), abs=CLOSE)
    assert pairs.angle == pytest.approx(rotation_angle(turn)[0], abs=rounding(100.0))


@pytest.mark.parametrize("which", ["anchors", "offset", "contact"])
def test_lengths_go_to_anchors_in_turn(which):
    m, truth, T = exact(which)
    names, every = names_of(m.labels["anchor"]), m.labels["anchor"].names
    away = np.linalg.norm(T[:, :3, 3] - [truth["anchors"][name].xyz for name in names], axis=1)
    away += 0.12 * (which == "offset")
    assert m.value("distance") == pytest.approx(away, abs=1e-9 if which == "contact" else CLOSE)
    assert names == [every[k % len(every)] for k in range(len(T))]
    assert truth.get("offsets", {}) == ({"it": 0.12} if which == "offset" else {})


@pytest.mark.parametrize("which", ["planes", "faces"])
def test_distances_are_across_planes(which):
    m, truth, T = exact(which)
    planes = [truth["planes"][name] for name in names_of(m.labels["plane"])]
    away = np.array([p.normal @ t[:3, 3] - p.distance for p, t in zip(planes, T, strict=True)])
    assert away == pytest.approx(m.columns.get("distance", 0.0), abs=1e-9 if which == "faces" else CLOSE)
    assert ("distance" not in m.columns) == (which == "faces")
    normals = np.array([p.normal for p in truth["planes"].values()])[:3]
    assert normals @ normals.T == pytest.approx(np.eye(3), abs=CLOSE)


def test_a_camera_on_the_tool_sees_boards_in_front_of_it():
    m, _, T = exact("board")
    seen = np.linalg.inv(T) @ as_matrix(WALL["wall"])
    assert m.rotation == pytest.approx(seen[:, :3, :3], abs=CLOSE)
    assert m.position == pytest.approx(seen[:, :3, 3], abs=CLOSE)
    assert (seen[:, 2, 3] > 0.0).all()
    assert (np.sum(seen[:, :3, 2] * seen[:, :3, 3], axis=1) < 0.0).all()
    assert 5 < len(T) < 40  # the others are behind


@pytest.mark.sampled(1)
@pytest.mark.parametrize("which", ["pixels", "camera in the room"])
def test_corners_are_seen_where_a_pinhole_has_them_and_nowhere_else(which):
    m, truth, T = exact(which)
    for k in range(len(T)):
        corner = [*m.image[k, 2:], 0.0, 1.0]
        on_tool = np.linalg.inv(T[k]) @ as_matrix(WALL["wall"])
        X = on_tool if which == "pixels" else as_matrix(truth["frames"]["it"]) @ T[k]
        x, y, z = (X @ corner)[:3]
        assert z > 0.0
        assert X[:3, 2] @ X[:3, 3] < 0.0  # from its front
        r2 = (x * x + y * y) / z**2
        distorted = 1.0 - 0.1 * r2 + 0.05 * r2**2
        u, v = 900 * x / z * distorted + 640, 905 * y / z * distorted + 480
        assert m.image[k, :2] == pytest.approx([u, v], abs=rounding(1000.0, 100))
        assert 0 <= u <= 1280
        assert 0 <= v <= 960
    counts = np.unique(m.ids, return_counts=True)[1]
    assert counts.max() == len(GRID) == 20
    assert counts.min() < 20  # where the board leaves the image


def test_a_lens_whose_distortion_turns_back_shows_nothing_beyond():
    """r (1 - 0.3 r^2) grows up to r = 1.05."""
    camera = Camera(fx=300, fy=300, cx=640, cy=480, k1=-0.3)
    points = np.array([[0.95, 0.0, 1.0], [1.2, 0.0, 1.0], [-0.5, 0.2, 1.0], [0.0, 0.0, -1.0]])
    assert project(camera, points)[1].tolist() == [True, False, True, False]


@pytest.mark.slow
def test_sockets_are_touched_in_turn_and_measured_against_each_other():
    m, truth, T = exact("sockets")
    places = np.array([truth["sockets"][name].xyz for name in m.groups.names])
    assert T[:, :3, 3] == pytest.approx(places[m.groups.index], abs=1e-9)
    assert m.groups.index[:4].tolist() == [0, 1, 2, 0]
    apart = [np.linalg.norm(places[a] - places[b]) for a, b in ((0, 1), (0, 2), (1, 2))]
    assert m.groups.pairs.distance == pytest.approx(apart, abs=CLOSE)


NOISY = {
    "pose": [("position", 1e-4), ("rotation", 2e-4)],
    "targets": [("position", 1e-4)],
    "anchors": [("distance", 1e-4)],
    "planes": [("distance", 1e-4)],
    "board": [("position", 1e-4), ("rotation", 2e-4)],
    "pixels": [("image", 0.1)],
}


@pytest.mark.parametrize("which", NOISY)
def test_noise_has_its_sigma(which):
    """The same seed with and without: standard normal numbers times sigma, to five of its own sigma."""
    of = scenario(INSTRUMENTS[which], n=700)
    noisy, clean = (simulate(of, 3, exact=which).tables[0].measurements for which in (False, True))
    for name, sigma in NOISY[which]:
        a, b = noisy.value(name), clean.value(name)
        if name == "rotation":  # the tracker's about the tool's axes, the camera's about its own
            b = np.swapaxes(b, 1, 2)
            off = Rotation.from_matrix(a @ b if which == "board" else b @ a).as_rotvec()
        else:
            off = (a - b).reshape(len(a), -1)[:, : 2 if name == "image" else 3]
        assert off.std() == pytest.approx(sigma, rel=5.0 / np.sqrt(2.0 * off.size))
        assert np.abs(off.mean(axis=0)).max() < 5.0 * sigma / np.sqrt(len(off))


@pytest.mark.slow
@pytest.mark.parametrize("which", INSTRUMENTS)
def test_every_instrument_calibrates_as_it_is_simulated(which):
    """At a chi-square and errors of the arm that noise explains, within 99.9 %."""
    n = {"board": 100, "pixels": 300, "camera in the room": 120}.get(which, 40)
    s = simulate(scenario(INSTRUMENTS[which], n=n, noise=replace(SIGMA, joint=1e-4)), 1)
    result = calibrate(s.robot, s.tables)
    assert result.trustworthy
    assert chi2.cdf(*nees(result.assessment, s.true_robot)) < 0.999


@pytest.mark.sampled(1)
@pytest.mark.parametrize("which", INSTRUMENTS)
def test_the_files_say_what_the_tables_do(which, tmp_path):
    s = simulate(scenario(INSTRUMENTS[which], n=300 if which == "pixels" else 12, length_unit="mm", angle_unit="deg",
                          validation=RandomReadings(9)), 4)  # fmt: skip
    names = write_simulation(tmp_path / "job", s)
    assert sorted(file.name for file in (tmp_path / "job").iterdir()) == list(names)
    job = read_job(tmp_path / "job" / "calibration.yaml")
    assert job.truth.nominal == pytest.approx(s.true_robot.nominal, abs=rounding(10.0))
    (read,), (made,) = job.measurements, s.tables
    for name in ("model", "pairing", "frame", "offset", "camera", "fixed_camera"):
        assert getattr(read, name) == getattr(made, name), name
    assert read.known.keys() == made.known.keys()
    for name, point in made.known.items():
        assert (*read.known[name].xyz, read.known[name].tolerance) == pytest.approx((*point.xyz, point.tolerance))
    a, b = read.measurements, made.measurements
    assert (a.ids.tolist(), a.test.tolist()) == (b.ids.tolist(), b.test.tolist())
    assert {k: names_of(v) for k, v in a.labels.items()} == {k: names_of(v) for k, v in b.labels.items()}
    for x, y in ((a, b), (a.pairs, b.pairs), (a.groups and a.groups.pairs, b.groups and b.groups.pairs)):
        same(x, y)


def same(a, b):
    """To the rounding of a change of units; sigmas, or no pairs, may be there of what is not measured."""
    for name, y in vars(b).items() if b is not None else ():
        if isinstance(y, np.ndarray) and y.dtype.kind in "fi":
            assert getattr(a, name) == pytest.approx(y, rel=rounding(1, 10), abs=rounding(10.0), nan_ok=True), name
        elif y is None and not name.startswith(("sigma", "pairs")):
            assert getattr(a, name) is None, name


# --- several at once --------------------------------------------------------------------------------------------------


def test_the_same_configuration_has_the_same_joint_errors_in_all_tables():
    """Instruments without noise of their own, of an arm whose encoders have some."""
    one, wire = Instrument(model="position", name="one", frame="base"), Instrument(model="anchor", name="wire")
    of = scenario(one, replace(one, name="two"), wire, noise=replace(EXACT, joint=1e-3), specified_noise=SIGMA)
    s = simulate(of)
    first, second, wire = (table.measurements for table in s.tables)
    assert first.ids.tolist() == second.ids.tolist() == wire.ids.tolist()
    assert first.position == pytest.approx(second.position, abs=0.0)
    anchors = np.array([s.truth["anchors"][name].xyz for name in names_of(wire.labels["anchor"])])
    assert wire.value("distance") == pytest.approx(np.linalg.norm(first.position - anchors, axis=1), abs=CLOSE)
    moved = np.stack([tool_pose(s.true_robot, q)[:3, 3] for q in s.true_readings])
    assert np.abs(s.true_readings - first.readings).max() > 1e-4
    assert first.position == pytest.approx(moved, abs=CLOSE)


def test_a_point_of_one_name_is_one_and_is_known_alike_in_all_tables():
    bolt = {"bolt": Spot([1.0, 0.5, 0.2], 1e-3)}
    wire, bar = (Instrument(model="anchor", name=name, anchors=bolt) for name in ("wire", "bar"))
    known = [table.known["bolt"] for table in simulate(scenario(wire, bar), 2).tables]
    assert known[0].xyz.tolist() == known[1].xyz.tolist()
    assert known[0].tolerance == 1e-3
    assert 0.0 < np.abs(known[0].xyz - bolt["bolt"].xyz).max() < 5e-3
    (table,) = simulate(scenario(wire), 2, exact=True).tables
    assert table.known["bolt"].xyz.tolist() == [1.0, 0.5, 0.2]
    with pytest.raises(InputError, match=r"^scenario: instruments: anchors: bolt: at two places, expected one"):
        simulate(scenario(wire, replace(bar, anchors={"bolt": Spot([1.0, 0.5, 0.3])})))


# --- what cannot be ---------------------------------------------------------------------------------------------------

FAR = Instrument(model="anchor", name="it", anchors={"far": Spot([50.0, 0, 0])}, contact=True)
AWAY = {"away": Placement(np.eye(3), np.array([0, 0, 900.0]))}
CANNOT = [
    (Instrument(model="anchor", name="it"), {"noise": EXACT},
     "noise: distance: found 0, expected a number above 0; a calibration takes nothing "
     "for exact: specify what to assume under job: noise: distance"),
    (FAR, {"robot": planar_robot(), "configurations": RandomReadings(2)},
     "nothing is reached from 2 configurations, expected points within the joint limits"),
    (Instrument(model="pixels", name="it", camera=CAMERA, corners=GRID, boards=AWAY), {},
     "sees no board at any of 60 configurations; configurations: {board: ...} have the camera look at one"),
]  # fmt: skip


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("instrument", "changes", "message"), CANNOT, ids=range(len(CANNOT)))
def test_what_cannot_be_measured_is_one_line(instrument, changes, message):
    assert refusal(simulate, scenario(instrument, **changes)) == f"scenario: instruments: it: {message}"
