"""Simulated effects of an arm: true data follow what the table says, and a model without the effects misfits them."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import tool_poses
from scenarios import SIGMA, TOLERANCE, WALL
from simulated import arm_with

from fg_calib import InputError, Pairing, assess, build_problem, design, read_job, simulate, solve
from fg_calib.prediction import errors_at
from fg_calib.robot import Backlash, Compliance, Coupling, ErrorCurve, Gain, Harmonics, Mass, Thermal
from fg_calib.simulation import Errors, GivenReadings, Instrument, RandomReadings, Scenario, write_simulation
from fg_calib.statistics import spread_of

MASSES = (Mass(2, 12.0, (0.2, 0.0, 0.1)), Mass(4, 5.0, (0.0, 0.0, 0.1)))
BOARD = Instrument(model="board", name="board", boards=WALL | {"again": WALL["wall"]})
PAIRS = Instrument(model="distance-rotation", name="pairs", pairs=Pairing("random", 200))


def scenario(*effects, **changes):
    robot = arm_with(*effects, tolerance=TOLERANCE)
    errors = Errors("normal", {p.name: p.tolerance for p in robot.parameters if p.tolerance})
    given = {"configurations": RandomReadings(60), "noise": SIGMA, "job": {"model": "pose"}, "temperature": (12, 21)}
    return Scenario(robot, errors, **given | changes)


@pytest.mark.parametrize("side", ["moves", "side"])
@pytest.mark.parametrize("instruments", [(), (BOARD,)])
def test_true_data_follow_the_columns_and_the_order_of_the_table(side, instruments, tmp_path):
    """The board is not seen from all configurations: sides are by those that are in the table."""
    more = {"instruments": instruments, "frame": "base", "job": {} if instruments else {"model": "pose"}}
    of = scenario(Backlash([1, 2], side=side), Thermal(lengths=False, zeros=True), validation=RandomReadings(9), **more)
    s = simulate(replace(of, errors=Errors("values", {"backlash": 2e-3, "drift": 1e-4})), 1, exact=True)
    write_simulation(tmp_path, s)
    m = read_job(tmp_path / "calibration.yaml").tables[0].measurements
    T, b, first = m.context["temperature"], m.context[side][:, :2], np.sort(np.unique(m.ids, return_index=True)[1])
    assert (len(first) < 69) == bool(instruments)
    stood = m.readings + 1e-4 * (T[:, None] - 20.0)
    stood[:, :2] += 2e-3 * b
    if side == "moves":
        assert b[first] == pytest.approx(np.sign(np.diff(m.readings[first, :2], axis=0, prepend=m.readings[:1, :2])))
    assert set(b[len(m.ids) // len(first) :].ravel()) == {-1.0, 1.0}
    assert [T.min(), T.max()] == pytest.approx([12.5, 20.5], abs=0.5)
    tool = tool_poses(s.true_robot.geometry, stood)
    seen = np.einsum("nji,nj->ni", tool[:, :3, :3], WALL["wall"].position - tool[:, :3, 3])
    assert m.position == pytest.approx(seen if instruments else tool[:, :3, 3], abs=1e-12)  # rounding of 17 digits


CURVE = ErrorCurve(knots=9, sigma=2e-3)
EACH = (Gain(), Harmonics(), CURVE, Compliance(MASSES), Backlash(), Coupling([(3, 4)]), Thermal(zeros=True))


@pytest.mark.parametrize("effect", EACH, ids=lambda effect: type(effect).__name__)
def test_a_model_without_its_effect_misfits(effect):
    s = simulate(scenario(effect, instruments=(PAIRS,), job={}), 3)
    found, plain = (assess(solve(build_problem(robot, s.tables))).fit for robot in (s.robot, scenario().robot))
    n = found.chi_square.dof
    assert found.chi_square.value == pytest.approx(n, abs=4.0 * np.sqrt(2.0 * n))  # 4 sigma
    assert plain.chi_square.value > n + 20.0 * np.sqrt(2.0 * n)


def test_what_cannot_be_simulated_is_refused():
    with pytest.raises(InputError, match=r"temperature: found \[10.0, 5.0\], expected the lower one first"):
        scenario(temperature=(10, 5))
    touching = Instrument(model="plane", name="faces", contact=True)
    message = "instruments: faces: contact, with effects by temperature, expected none of these effects"
    with pytest.raises(InputError, match=message):
        simulate(scenario(Thermal(), instruments=(touching,), job={}))


def test_a_design_for_compliance_takes_poses_with_torque():
    effect = Compliance(MASSES)
    of = scenario(effect, frame="base", errors=None)
    plan = design(replace(of, robot=of.robot.with_estimated(["theta2.compliance", "theta3.compliance"])), n=4)
    chosen, pool = (effect.values(of.robot.geometry, q, {}, np.zeros(4))[:, 1:3, 0] for q in
                    (plan.readings, plan.pool.readings))  # fmt: skip
    assert (np.sqrt(np.mean(chosen**2, axis=0)) > 1.3 * np.sqrt(np.mean(pool**2, axis=0))).all()


def test_a_design_expects_what_a_calibration_with_error_curves_then_finds():
    of = scenario(ErrorCurve(knots=24, sigma=5e-4), errors=Errors("values", {}))
    plan = design(of, n=15, seed=0)
    s = simulate(replace(of, configurations=GivenReadings(plan.readings)), exact=True)
    spread = spread_of(solve(build_problem(s.robot, s.tables)))
    found = errors_at(spread, plan.task.readings)[plan.task.fitted].position
    assert plan.expected.position == pytest.approx(found, rel=1e-3)  # second order of the start of the frame
    assert plan.random == pytest.approx(found, rel=0.05)


def test_a_design_after_a_calibration_counts_what_is_known_of_error_curves(tmp_path):
    write_simulation(tmp_path, simulate(scenario(Harmonics(), ErrorCurve(knots=12, sigma=1e-3)), 1))
    plan = design(read_job(tmp_path / "calibration.yaml"), n=4)
    assert plan.expected.position < plan.random < plan.before.position
