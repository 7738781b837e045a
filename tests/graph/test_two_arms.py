"""Two arms in contact are one chain from flange to flange: the same as two arms composed by hand."""

import numpy as np
import pytest
import scipy.optimize
from tolerances import rounding

from fg_calib import assess, build_problem, simulate, solve
from fg_calib.io import read_urdf
from fg_calib.measurements.dataset import Noise
from fg_calib.robot.kinematics import pose
from fg_calib.simulation.scenario import Errors, Instrument, RandomReadings, Scenario, Spot

SIGMA = 5e-5
TOLERANCE = {"x": 1e-3, "y": 1e-3, "z": 1e-3, "roll": 2e-3, "pitch": 2e-3, "yaw": 2e-3}
PINS = {"pin": Spot([0.02, 0.01, 0.05]), "other": Spot([-0.03, 0.04, 0.03])}
ORIGINS = [
    ("0 0 0.3", "0 0 0"),
    ("0.05 0 0.2", "1.5 0.1 0"),
    ("0.3 0.02 0", "0.1 -0.2 0.3"),
    ("0.25 0 0.05", "0.2 1.4 0"),
]


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """The chain from the left flange to the right one, and both arms alone, from one URDF."""
    links, joints = ['<link name="bench"/>'], []
    for side, y in (("left", 0.25), ("right", -0.3)):
        parent = "bench"
        for i, (xyz, rpy) in enumerate([(f"0 {y} 0", "0 0 0.1"), *ORIGINS]):
            link, kind = f"{side}_{i}", "fixed" if i == 0 else "continuous"
            links.append(f'<link name="{link}"/>')
            joints.append(
                f'<joint name="{side}_joint_{i}" type="{kind}"><parent link="{parent}"/><child link="{link}"/>'
                f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/></joint>'
            )
            parent = link
    path = tmp_path_factory.mktemp("arms") / "bench.urdf"
    path.write_text(f'<robot name="bench">{"".join([*links, *joints])}</robot>')
    whole = read_urdf(path, base_link="left_4", tip_link="right_4", tolerance=TOLERANCE)
    return whole, *(read_urdf(path, base_link="bench", tip_link=f"{s}_4") for s in ("left", "right"))


def values_of(arm, named):
    """The arm with the values of a chain that has its joints too."""
    return arm.with_values(np.array([named.get(p.name, p.nominal) for p in arm.parameters]))


def right_tip_in_left_flange(left, right, named, q):
    """T_left^-1 T_right of the two arms alone; the chain has the left one's joints from its tip on."""
    a = pose(values_of(left, named), q[:, 3::-1])
    b = pose(values_of(right, named), q[:, 4:])
    return np.einsum("nji,nj->ni", a.rotation, b.position - a.position)


def test_a_chain_from_flange_to_flange_is_two_arms_composed(arms):
    whole, left, right = arms
    assert [joint.name for joint in whole.joints] == [
        *(f"left_joint_{i}" for i in (4, 3, 2, 1)), *(f"right_joint_{i}" for i in (1, 2, 3, 4))
    ]  # fmt: skip
    rng = np.random.default_rng(0)
    values = whole.nominal + 0.01 * rng.normal(size=len(whole.nominal))
    values[[p.owner in (0, 9) for p in whole.parameters]] = 0.0  # base and tool frames of the chain alone
    q = rng.uniform(-3, 3, (20, 8))
    named = dict(zip((p.name for p in whole.parameters), values, strict=True))
    composed = right_tip_in_left_flange(left, right, named, q)
    assert pose(whole.with_values(values), q).position == pytest.approx(composed, abs=rounding(3.0, 10))


@pytest.mark.slow
def test_two_arms_in_contact_are_calibrated_as_one_chain(arms):
    """Against scipy on both arms composed by hand: the right tip on pins of unknown place on the left flange."""
    whole, left, right = arms
    scenario = Scenario(
        robot=whole,
        errors=Errors("normal", {p.name: p.tolerance for p in whole.parameters if p.tolerance}),
        configurations=RandomReadings(30),
        noise=Noise(distance=SIGMA),
        instruments=(Instrument(model="anchor", name="contact", anchors=PINS, contact=True),),
        job={},
    )
    s = simulate(scenario, 1)
    solution = solve(build_problem(whole, s.tables))
    found = assess(solution)
    assert solution.converged
    assert not found.verdict.errors
    m = s.tables[0].measurements
    assert (m.length == 0.0).all()
    tolerance = np.array([whole.parameters[whole.index(name)].tolerance for name in found.names])
    nominal = np.array([whole.parameters[whole.index(name)].nominal for name in found.names])
    which = m.labels["anchor"].index
    start = np.concatenate([np.zeros(len(tolerance)), *(pin.xyz for pin in PINS.values())])

    def residuals(x):
        named = dict(zip(found.names, nominal + x[:-6], strict=True))
        tip = right_tip_in_left_flange(left, right, named, m.readings)
        pins = x[-6:].reshape(2, 3)[which]
        return np.concatenate([(tip - pins).ravel() / SIGMA, x[:-6] / tolerance])

    scale = np.concatenate([tolerance, np.full(6, 1e-3)])
    by_hand = scipy.optimize.least_squares(residuals, start, x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    estimate = solution.parameters[[whole.index(name) for name in found.names]] - nominal
    assert (estimate - by_hand.x[:-6]) / np.sqrt(np.diag(found.covariance)) == pytest.approx(0.0, abs=1e-3)
    assert 2.0 * solution.cost == pytest.approx(2.0 * by_hand.cost, rel=1e-6)
    points = {p.name: p.xyz for p in found.estimates.landmarks}
    assert points["pin"] == pytest.approx(by_hand.x[-6:-3], abs=1e-7)
    # and it is the truth, within what the sigmas say
    e = estimate + nominal - s.true_robot.nominal[[whole.index(name) for name in found.names]]
    assert e @ np.linalg.solve(found.covariance, e) / len(e) < 2.0
