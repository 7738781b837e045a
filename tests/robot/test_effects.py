"""What an arm does beyond its geometry: each effect by an independent formula, in kinematics and in a calibration."""

import re
from dataclasses import replace

import numpy as np
import pytest
from refusals import refusal
from simulated import ROWS, tool_points

from fg_calib import InputError, Measurements, Options, Robot, calibrate, observe_structure
from fg_calib.io import Units, quantity
from fg_calib.robot import Mass, Parameter, build_chain, forward, pose
from fg_calib.robot.effects import Backlash, Bending, Compliance, Coupling, ErrorCurve, Gain, Harmonics, Thermal

MASSES = (Mass(1, 5.0, (0.1, 0.02, -0.05)), Mass(2, 3.0, (0.2, 0.0, 0.1)), Mass(4, 1.5, (0.01, 0.05, 0.08)))
Q = np.random.default_rng(5).uniform(-2.5, 2.5, (7, 4))
CONTEXT = {"moves": np.sign(Q[::-1]), "temperature": np.linspace(15.0, 30.0, 7)}
EFFECTS = {
    "gain": Gain(),
    "harmonics": Harmonics([1, 2.5]),
    "curve": ErrorCurve([2, 3], knots=9),
    "compliance": Compliance(MASSES, lateral=True),
    "tilt": Compliance(MASSES, [2, 3, 4], gravity="estimate"),
    "loads": Compliance(None, [2, 3]),
    "bending": Bending(MASSES),
    "backlash": Backlash(),
    "coupling": Coupling([(3, 4)]),
    "thermal": Thermal(zeros=True),
}


@pytest.fixture
def arm():
    return Robot.from_dh(ROWS, "dh", base=[0.1, 0.2, 0.3, 0.4, 0.1, -0.2], tool=[0.1, 0.0, 0.2])


def with_coefficients(robot, seed=1):
    """A robot with effects whose coefficients are not zero."""
    values, rng = robot.nominal, np.random.default_rng(seed)
    more = [i for i, p in enumerate(robot.parameters) if p.tolerance is not None]
    values[more] = rng.normal(size=len(more)) * [robot.parameters[i].tolerance for i in more]
    return robot.with_values(values)


def potential(robot, q):
    """Minus the potential energy of the masses, whose gradient in q are the torques of gravity, [N m]."""
    total = 0.0
    for m in MASSES:
        part = replace(robot, elements=robot.elements[: robot.end_of(m.link)])
        at = forward(build_chain(part), part.trig(q))
        total = total + m.mass * (at.position + at.rotation @ np.array(m.com)) @ [0.0, 0.0, -9.81]
    return total


def torques(robot, q, h=1e-5):
    """By central differences, shape (n, n_joints)."""
    return np.stack([(potential(robot, q + d) - potential(robot, q - d)) / (2 * h) for d in h * np.eye(4)], axis=1)


def test_joints_turn_by_their_readings_and_the_sum_of_their_effects(arm):
    effects = [EFFECTS[name] for name in ("gain", "harmonics", "coupling", "backlash")]
    robot = with_coefficients(arm.with_effects(*effects))
    c = {p.name: p.nominal for p in robot.parameters}
    turned = Q.copy()
    for i in range(4):
        j = f"theta{i + 1}"
        turned[:, i] += c[f"{j}.gain"] * Q[:, i] + c[f"{j}.backlash"] * CONTEXT["moves"][:, i]
        turned[:, i] += c[f"{j}.sin1"] * np.sin(Q[:, i]) + c[f"{j}.cos1"] * np.cos(Q[:, i])
        turned[:, i] += c[f"{j}.sin2_5"] * np.sin(2.5 * Q[:, i]) + c[f"{j}.cos2_5"] * np.cos(2.5 * Q[:, i])
    turned[:, 3] += c["theta4.coupling3"] * Q[:, 2]
    found = forward(build_chain(robot), robot.trig(Q, CONTEXT))
    expected = forward(build_chain(arm), arm.trig(turned))
    assert found.position == pytest.approx(expected.position, abs=1e-14)  # rounding of lengths of 1 m
    assert found.rotation == pytest.approx(expected.rotation, abs=1e-14)


def test_torques_are_the_gradient_of_the_potential(arm):
    found = Compliance(MASSES).values(arm, Q, {}, np.zeros(4))[:, :, 0]
    assert found == pytest.approx(torques(arm, Q), abs=1e-7)  # rounding of 50 J over 1e-5


def test_joints_give_way_to_equilibrium(arm):
    k = np.array([2e-5, 1e-4, 5e-5, 2e-4])
    turned = Q
    for _ in range(30):
        turned = Q + k * torques(arm, turned)
    once = Q + k * torques(arm, Q)
    found = Q + k * Compliance(MASSES).values(arm, Q, {}, k)[:, :, 0]
    largest = np.abs(once - turned).max()
    assert largest > 1e-6
    assert np.abs(found - turned).max() < 0.02 * largest  # third order in k


@pytest.mark.parametrize("lateral", [False, True])
def test_a_tilt_of_gravity_is_that_of_the_base(arm, lateral):
    k, tilts = np.linspace(1e-5, 4e-5, 12 if lateral else 4), [0.02, -0.03]
    gravity = np.array([0.0, 0.0, -9.81])
    tilted = Compliance(MASSES, lateral=lateral, gravity=gravity + np.cross([*tilts, 0.0], gravity))
    estimated = arm.with_effects(Compliance(MASSES, lateral=lateral, gravity="estimate"))
    estimated = estimated.with_values([*arm.nominal, *k, *tilts])
    expected = arm.with_effects(tilted).with_values([*arm.nominal, *k])
    found = tool_points(estimated, Q)
    assert found == pytest.approx(tool_points(expected, Q), abs=1e-14)
    assert np.abs(found - tool_points(arm, Q)).max() > 1e-4
    J = forward(build_chain(estimated, {estimated.index("base.tilt_x"): 0}), estimated.trig(Q)).jacobian[:, 3:, 0]
    h = np.zeros(len(estimated.parameters))
    h[estimated.index("base.tilt_x")] = 1e-4
    ends = [estimated.with_values(estimated.nominal + d) for d in (h, -h)]
    a, b = (tool_points(r, Q) for r in ends)  # the load as tilted too
    assert J == pytest.approx((a - b) / 2e-4, rel=2e-2, abs=1e-7)  # joints as they have turned: k times as much


def test_free_loads_are_the_torques_of_first_moments(arm):
    effect, h = Compliance(None, [2]), 1e-6
    names = [t.name for t in effect.terms(arm)]
    found = dict(zip(names, effect.values(arm, Q, {}, np.zeros(len(names)))[:, :, 0].T, strict=True))
    turn = np.array([0.0, 1.0, 0.0, 0.0])

    def point(q, link, along):
        part = replace(
            arm, elements=arm.elements[: next(i for i, e in enumerate(arm.elements) if e.joint == link - 1) + 1]
        )
        return forward(build_chain(part), part.trig(q)).rotation[:, 2, along]

    for link in (2, 3, 4):
        for along, x in enumerate("xy"):
            rate = (point(Q + h * turn, link, along) - point(Q - h * turn, link, along)) / (2 * h)
            assert found[f"theta2.load{link}{x}"] == pytest.approx(-9.81 * rate, abs=1e-8)


@pytest.mark.parametrize("name", EFFECTS)
def test_derivatives_in_coefficients_are_central_differences(arm, name):
    robot = with_coefficients(arm.with_effects(EFFECTS[name], *([] if name == "gain" else [EFFECTS["gain"]])))
    n = len(robot.parameters)
    chain, trig = build_chain(robot, {i: i for i in range(n)}), robot.trig(Q, CONTEXT)
    J = forward(chain, trig).jacobian[:, 3:]
    own = forward(chain.with_turn_columns(), trig).jacobian[:, 3:, n:]
    for i in range(len(arm.parameters), n):
        h = np.zeros(n)
        h[i] = 1e-3 * robot.parameters[i].tolerance
        ends = [forward(chain.at(robot.nominal + d), trig).position for d in (h, -h)]
        expected = (ends[0] - ends[1]) / (2.0 * h[i])
        if robot.parameters[i].kind == "curve":  # its column is the joint's, times the spline
            joint, k = robot.parameters[i].owner - 1, int(re.search(r"\[(\d+)\]", robot.parameters[i].name)[1])
            knots, weights = chain.splines(trig)[joint]
            found = own[:, :, joint] * np.where(knots == k, weights, 0.0).sum(axis=1)[:, None]
        else:
            found = J[:, :, i]
        largest = max(np.abs(expected).max(), 1e-3)
        assert found == pytest.approx(expected, abs=1e-6 * largest)  # second order of a step of 1e-3 sigma


def test_splines_sum_to_one_and_repeat_each_turn(arm):
    robot = arm.with_effects(ErrorCurve([2], knots=9))
    values = robot.nominal
    values[len(arm.parameters) :] = 0.01
    q, turn = Q.copy(), np.zeros(4)
    q[:, 1] += 2.0 * np.pi
    turn[1] = 0.01
    found = forward(build_chain(robot.with_values(values)), robot.trig(q))
    expected = pose(arm, Q + turn)
    assert found.position == pytest.approx(expected.position, abs=1e-13)


def test_free_loads_hold_the_torques_of_masses_beyond_a_slide():
    rows = [[0, -1.5, 0.4, 0], [0, 1.5, 0.15, 0], [0, 0, 0.3, 0], [0.1, 0, 0.2, 0]]
    robot = Robot.from_dh(rows, "dh", types=["revolute", "revolute", "prismatic", "revolute"])
    q = np.random.default_rng(0).uniform(-2, 2, (60, 4)) * [1, 1, 0.3, 1]
    loads, known = Compliance(None, [2]), Compliance(MASSES, [2]).values(robot, q, {}, np.zeros(1))[:, 0, 0]
    found = loads.values(robot, q, {}, np.zeros(len(loads.terms(robot))))[:, :, 0]
    assert found @ np.linalg.lstsq(found, known)[0] == pytest.approx(known, abs=1e-9)


def test_a_payload_of_each_row_weighs_what_its_column_says_or_else_its_mass(arm):
    payload, q = Mass(4, 2.0, (0.0, 0.1, 0.1), "load"), np.repeat(Q[:1], 3, axis=0)
    of = Compliance((*MASSES, payload), [2, 3])
    found = of.values(arm, q, of.context(arm, q, lambda _: np.array([[0.0], [7.0], [np.nan]])), np.zeros(2))[:, :, 0]
    for row, mass in zip(found, (0.0, 7.0, 2.0), strict=True):
        one = Compliance((*MASSES, payload._replace(mass=mass, column="")), [2, 3])
        assert row == pytest.approx(one.values(arm, q[:1], {}, np.zeros(2))[0, :, 0])


def test_a_length_that_shrinks_below_what_grows_keeps_its_expansion():
    nominal = Robot.from_dh([[0.021, 0.3, 0.2, 0], [0.3, 0.1, 0, 0]], "dh").with_effects(Thermal())
    robot = nominal.with_values(nominal.nominal - 2e-3 * (np.array(nominal.nominal) == 0.021))
    assert robot.terms == nominal.terms
    assert robot.trig(np.zeros((1, 2))).shape == nominal.trig(np.zeros((1, 2))).shape


def test_lengths_grow_and_zeros_drift_with_temperature(arm):
    robot = with_coefficients(arm.with_effects(EFFECTS["thermal"]))
    c, values = {p.name: p.nominal for p in robot.parameters}, arm.nominal
    for i, p in enumerate(arm.parameters):
        if p.kind in ("a", "d"):
            values[i] *= 1.0 + c[f"{p.name}.expansion"] * 10.0
        elif p.kind == "theta":
            values[i] += c[f"{p.name}.drift"] * 10.0
    found = forward(build_chain(robot), robot.trig(Q, {"temperature": np.full(7, 30.0)}))
    assert found.position == pytest.approx(pose(arm.with_values(values), Q).position, abs=1e-14)


def test_moves_tell_the_side_of_approach(arm):
    q = np.array([[0.0, 0, 0, 0], [1, 0, 0, 0], [1, -1, 0, 0], [0.5, -1, 1, 0]])
    sides = Backlash().context(arm, q, None)["moves"]
    assert sides.tolist() == [[0, 0, 0, 0], [1, 0, 0, 0], [1, -1, 0, 0], [-1, -1, 1, 0]]


def test_a_gain_is_calibrated_and_shown_in_parts_in_a_million(arm):
    robot = arm.with_effects(Gain()).with_estimated([*(f"theta{i}.gain" for i in range(1, 5)), "a2"])
    gains, values = np.array([2e-3, -1e-3, 5e-4, 1e-3]), robot.nominal
    values[-4:] = gains
    at = pose(robot.with_values(values), Q)
    measured = Measurements.from_arrays(Q, position=at.position, sigma_position=1e-6)
    calibration = calibrate(robot, measured, Options(model="position"))
    found = calibration.parameters
    assert [found[f"theta{i}.gain"].estimate for i in range(1, 5)] == pytest.approx(gains, abs=1e-6)  # priors pull
    assert (found["theta1.gain"].unit, found["a2"].unit) == ("1", "m")
    assert re.search(r"theta1\.gain +2000\.0 .* ppm ", str(calibration))
    assert observe_structure(robot, model="position").with_fixed_known.observability.rank == 5


def test_units_of_a_gain_in_files_and_options():
    assert quantity("100 ppm", "1", None, "growth") == pytest.approx(1e-4)
    assert (Units("mm", "deg").name("1"), Units("mm", "deg").factor("1")) == ("1", 1.0)
    with pytest.raises(InputError, match=r"growth: 3; give a unit, such as 3ppm"):
        quantity("3", "1", None, "growth")


@pytest.mark.parametrize(
    ("effects", "said"),
    [
        ([Gain([5])], "gain: joints: found 5, expected joints, of 1, 2, 3, 4"),
        ([Gain(), Gain([1])], "robot: two effects with the parameter theta1.gain, expected one"),
        ([Compliance([Mass(9, 1.0)])], "masses: found link 9, expected 0 (the base) to 5 (the tool)"),
        (["gain"], "effects: found 'gain', expected effects, such as Harmonics([1, 2])"),
    ],
)
def test_effects_that_cannot_be_are_one_line(arm, effects, said):
    assert refusal(arm.with_effects, *effects) == said


def test_sides_by_loads_need_masses():
    assert refusal(Backlash, side="load") == "masses: found (), expected a Mass for each link, 0 kg or more"


@pytest.mark.parametrize(("name", "kind"), [("q1.spring", "spring"), ("q1.shift", "yaw")])
def test_an_unknown_kind_and_a_name_that_hides_it_are_one_line(name, kind):
    with pytest.raises(InputError, match=rf"parameter '{name}': kind '{kind}', expected a name that ends in its kind"):
        Parameter(name, kind, 1, 0.0)


def test_loads_are_those_of_the_arm_as_its_parameters_are(arm):
    robot = arm.with_effects(Compliance(MASSES, lateral=True), Bending(MASSES), Gain())
    values = robot.nominal + 1e-3 * np.random.default_rng(2).normal(size=len(robot.parameters))
    found = robot.trig(Q, None, values)
    assert found == pytest.approx(robot.with_values(values).trig(Q), abs=1e-12)
    assert np.abs(found - robot.trig(Q)).max() > 1e-3  # of tens of N m
