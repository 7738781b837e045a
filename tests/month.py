"""An arm that was calibrated, and rows of it a month later, for several test files."""

from dataclasses import replace

import numpy as np
from jobs import ROWS, SIGMA
from scenarios import INSTRUMENTS, scenario
from scipy.spatial.transform import Rotation
from simulated import measure, true_robot

from fg_calib import Measurements, Robot, Table, calibrate, simulate
from fg_calib.measurements.dataset import Labels
from fg_calib.robot import pose
from fg_calib.simulation.scenario import Errors

TOLERANCE = {"a": 5e-4, "d": 5e-4, "alpha": 1e-3, "theta": 2e-3}


def arm(**more):
    """A UR5e."""
    rows, limits = [[a, np.deg2rad(alpha), d, 0] for d, a, alpha in ROWS], [[-3.0, 3.0]] * 6
    return Robot.from_dh(rows, "dh", name="ur5e", tool=[0.05, -0.03, 0.12], tolerance=TOLERANCE, limits=limits, **more)


def placed(rng):
    """A measurement frame."""
    return Rotation.from_rotvec(0.3 * rng.normal(size=3)), rng.normal(size=3)


def measured(true, n, rng, *, frame=None, q=None, sigma=SIGMA, ids=""):
    """Poses at random configurations."""
    readings = rng.uniform(-2.5, 2.5, (n, true.n_joints)) if q is None else q
    found = measure(true, n, rng, sigma=sigma, frame=frame, readings=readings)
    return replace(found, ids=np.array([f"{ids}{i}" for i in range(n)]))


def seen(true, spots, rng, n, ids):
    """Positions of targets on the tool."""
    q = rng.uniform(-2.5, 2.5, (n, 6))
    of = np.arange(n) % len(spots)
    poses = pose(true, q)
    at = np.array(list(spots.values()))[of]
    p = poses.position + np.einsum("nij,nj->ni", poses.rotation, at) + SIGMA[0] * rng.normal(size=(n, 3))
    rows = Measurements.from_arrays(q, position=p, sigma_position=SIGMA[0], ids=[f"{ids}{i}" for i in range(n)])
    return Table(replace(rows, labels={"target": Labels(tuple(spots), of)}), "position")


def calibrated(seed=0, *, n=40, unknown=False, model="pose", robot=None, sigma=SIGMA, **options):
    """The calibration, the true arm, and a generator to go on with."""
    rng = np.random.default_rng(seed)
    robot = robot or arm()
    true = true_robot(robot, rng)
    rows = measured(true, n, rng, frame=placed(rng) if unknown else None, sigma=sigma)
    frame = "unknown" if unknown else "known"
    return calibrate(robot, rows, model=model, frame=frame, **options), true, rng


OF_INSTRUMENTS = {kind: INSTRUMENTS[kind] for kind in INSTRUMENTS if kind not in ("pose", "targets")}
"""Of every kind but poses of the tool, which other tests have; targets are those of the stations, at places given."""


def months_of(kind, seed, *, n=60, n_new=40, slip=None, **changes):
    """The robot, the true one, and tables of an instrument at first and of the month after: tables, anchors, planes,
    boards and points of their own.

    Args:
        kind: Which instrument.
        seed: Of what is drawn.
        n: Configurations at first.
        n_new: Those of the month after.
        slip: What changes in between, by parameter.
        changes: Of the scenario.
    """
    first = simulate(scenario(OF_INSTRUMENTS[kind], n=n, **changes), seed=seed)
    robot, true = first.robot, first.true_robot
    off = {p.name: x for p, x in zip(robot.parameters, true.nominal - robot.nominal, strict=True) if x}
    for name, size in (slip or {}).items():
        off[name] = off.get(name, 0.0) + size
    later = scenario(OF_INSTRUMENTS[kind], n=n_new, **changes | {"errors": Errors("values", off)})
    after = simulate(later, seed=10_000 + seed)  # what cannot be touched by chance
    return robot, true, first.tables, tuple(map(_of_another_month, after.tables))


def _of_another_month(table):
    """The same with other names of all but targets: what has the same name in two tables of a job is the same."""
    m = table.measurements
    labels = {
        what: label if what == "target" else replace(label, names=tuple(f"{name} later" for name in label.names))
        for what, label in m.labels.items()
    }
    groups = m.groups and replace(m.groups, names=tuple(f"{name} later" for name in m.groups.names))
    known = {name if "target" in labels else f"{name} later": place for name, place in table.known.items()}
    ids = np.array([f"{name} later" for name in m.ids])
    later = replace(m, ids=ids, labels=labels, groups=groups, source=f"{m.source} later")
    return replace(table, measurements=later, known=known)
