"""What is said of a job before it is solved: each fault is named where it is, and healthy jobs are not alarmed."""

from dataclasses import replace
from functools import partial

import jobs
import numpy as np
import pytest
from jobs import PLACED, ur5e
from scenarios import INSTRUMENTS, scenario
from simulated import measure, plus

from fg_calib import Job, Options, ProblemError, Robot, calibrate, simulate
from fg_calib.diagnostics import inspect_job

SLOW = ("pixels", "camera in the room", "contact", "faces", "sockets")
"""Instruments whose simulation, or placing, takes longest."""

measured = partial(jobs.measured, placed=PLACED, n=40, n_test=10)
MODELS = [("pose", "unknown"), ("position", "known"), ("distance-rotation", "known"), ("distance", "known")]


@pytest.fixture
def arm(tmp_path):
    """A UR5e with a tolerance for everything."""
    return ur5e(tmp_path)


def inspected(robot, m, model="pose", frame="unknown", **choices):
    return inspect_job(Job(None, robot, m, Options(model, frame=frame, **choices)))


def said(found):
    """All that is said of a job."""
    return (*found.findings, *found.cautions)


# --- healthy jobs ----------------------------------------------------------------------------------------------------


@pytest.mark.sampled(2)
@pytest.mark.parametrize("model", [model for model, _ in MODELS])
def test_a_healthy_table_of_poses_is_ready(arm, model):
    found = inspected(arm, measured(arm), model)
    assert said(found) == ()
    assert all(one.excess < 2.0 for check in found.setups for one in check.residuals)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in SLOW)) for n in INSTRUMENTS])
def test_a_healthy_table_of_every_instrument_is_ready(name, seed):
    simulation = simulate(scenario(INSTRUMENTS[name], n=40 + 20 * (name == "faces")), seed=seed)
    found = inspect_job(Job(None, simulation.robot, tuple(simulation.tables), Options()))
    assert found.findings == ()
    assert [check.table for check in found.setups] == [t.name if len(found.tables) > 1 else "" for t in found.tables]
    assert all(t.n_repeats == 0 for t in found.tables)  # corners of one image are none


def test_rows_to_test_alone_are_inspected_as_an_evaluation(arm):
    m = measured(arm)
    found = inspected(arm, replace(m, test=np.ones(50, dtype=bool)))
    assert found.evaluated
    assert found.findings == ()
    assert found.expected_error is None


# --- mistakes in the set-up ------------------------------------------------------------------------------------------


def test_a_mistake_in_the_set_up_is_a_finding(arm):
    m = measured(arm)
    found = inspected(arm, replace(m, position=m.position * 1e3))
    (finding,) = found.findings
    assert "if x, y, z are in mm, not m" in finding
    assert found.disagreements == ()  # not looked for: all rows would


def test_two_targets_with_the_same_positions_are_named():
    """Copied from one to the other they fit perfectly, and count twice."""
    simulation = simulate(scenario(INSTRUMENTS["targets"], n=8), seed=1)
    (table,) = simulation.tables
    position = table.measurements.position.copy()
    position[1::3] = position[::3]
    copied = replace(table, measurements=replace(table.measurements, position=position))
    with pytest.raises(ProblemError, match=r"^it\.csv: target it target 2: the same positions as in .* it target 1, "):
        inspect_job(Job(None, simulation.robot, (copied,), Options()))


# --- single rows -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("model", "frame"), MODELS)
@pytest.mark.parametrize("size", [0.03, pytest.param(1.0, marks=pytest.mark.slow)])
def test_rows_that_disagree_with_the_arm_are_named(arm, model, frame, size):
    """The rest of the table is not spoilt by them: one off by a metre shifts a frame by least squares."""
    m = measured(arm, placed=PLACED if frame == "unknown" else None)
    found = inspected(arm, replace(m, position=plus(m.position, [7, 43], [0.0, size, 0.0])), model, frame)
    (finding,) = found.findings
    assert finding.startswith("measurements that disagree with the others: 2 (")
    assert {one.name.split("-")[-1]: one.test for one in found.disagreements} == {"7": False, "43": True}


@pytest.mark.parametrize("n_test", [0, 10])
def test_limits_that_cannot_be_evaluated_are_reported(arm, n_test):
    m = measured(arm)
    m = replace(m, test=np.arange(m.n_configurations) < n_test)
    limits = {"position": 1e-3, "distance": 1e-3}
    found = inspect_job(Job(None, arm, m, Options(model="pose", frame="unknown", accept=limits)))
    lacking, *others = found.findings
    assert lacking == "accept: nothing in this job measures any distance: its limit cannot be evaluated"
    said = "accept: limits are judged by what is held out, and nothing is"
    assert [text.startswith(said) for text in others] == [True] * (n_test == 0)
    folds = Options(model="pose", frame="unknown", accept={"position": 1e-3}, folds=5)
    assert not inspect_job(Job(None, arm, m, folds)).findings


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "name",
    [pytest.param("targets", marks=pytest.mark.slow), "anchors", "planes", "board", "pairs", "sockets", "stations"],
)
def test_a_wrong_row_of_every_instrument_is_named(name):
    simulation = simulate(scenario(INSTRUMENTS[name], n=40), seed=1)
    tables = list(simulation.tables)
    m = tables[0].measurements
    if m.pairs is not None:
        m = replace(m, pairs=replace(m.pairs, distance=plus(m.pairs.distance, [5], 0.5)))
    elif "distance" in m.columns:
        m = m.with_values({"distance": plus(m.value("distance"), [5], 0.5)})
    elif m.groups is not None:
        m = replace(m, readings=plus(m.readings, [5], [0.3, 0.0, 0.0, 0.0]))
    else:
        m = replace(m, position=plus(m.position, [5], [0.0, 5.0 if name == "targets" else 0.5, 0.0]))
    tables[0] = replace(tables[0], measurements=m)
    found = inspect_job(Job(None, simulation.robot, tuple(tables), Options()))
    assert len(found.disagreements) == len(found.findings) == 1
    assert "that disagree with the others: 1 (" in found.findings[0]


def test_a_robust_loss_makes_wrong_rows_a_caution(arm):
    m = measured(arm)
    found = inspected(arm, replace(m, position=plus(m.position, [7], 0.1)), loss="gnc")
    assert not found.findings
    assert found.cautions[0].endswith(": 1 (7)")


# --- what rows hold --------------------------------------------------------------------------------------------------


def test_copies_of_rows_are_distinguished_from_repeats(arm):
    """A repeat has the same readings and another measurement."""
    m = measured(arm)
    again = m.select(np.array([*range(50), 3]))
    again = replace(again, ids=np.arange(51).astype(str), test=np.append(m.test, False))
    found = inspected(arm, again)
    (caution,) = found.cautions
    copies = "rows that are exact copies of others: 1 (3 and 50); each counts as one more"
    assert caution.startswith(f"measurements: {copies}")
    assert (found.tables[0].n_copies, found.tables[0].n_repeats) == (1, 0)
    repeated = inspected(arm, replace(again, position=plus(again.position, [50], 1e-5)))
    text = "measurements: readings repeated under another id: 1; their joint errors count as independent: where the arm"
    assert said(repeated) == (f"{text} stood still, average the rows",)
    assert (repeated.tables[0].n_copies, repeated.tables[0].n_repeats) == (0, 1)


def test_test_rows_at_train_configurations_are_reported(arm):
    q = np.random.default_rng(5).uniform(-2, 2, (50, 6))
    q[[41, 42]] = q[[1, 2]] + 5e-4
    found = inspected(arm, measured(arm, readings=q))
    assert found.cautions == ("measurements: test rows at configurations of train rows, no check of a prediction: 2",)


def test_a_table_without_test_rows_is_reported(arm):
    (caution,) = said(inspected(arm, measured(arm, n_test=0, n=50)))
    assert caution.startswith("no test rows")


def test_a_joint_that_hardly_moves_is_reported(arm):
    q = np.random.default_rng(5).uniform(-2, 2, (50, 6))
    q[:, 3] = 0.3
    found = inspected(arm, measured(arm, readings=q))
    assert [joint.name for joint in found.joints if joint.still] == ["q4"]
    assert not found.findings
    assert found.cautions[0] == "q4 hardly moves: its zero is not distinguishable from the link before"
    assert any("not excited by these configurations" in caution for caution in found.cautions)


def test_a_good_fit_of_priors_says_how_little_its_rows_determine(arm):
    found = calibrate(arm, measured(arm, n=2, n_test=0), model="pose", frame="unknown")
    assert found.trustworthy
    assert found.result.reservations[0].startswith("these rows determine 6 of 30 parameters; directions not excited by")


def test_readings_far_outside_limits_are_a_finding():
    """Of a job that was not read from files: the reader refuses them."""
    robot = Robot.from_dh([[0.5, 0.2, 0.1, 0]] * 3, "dh", limits=[[-2, 2]] * 3, tolerance={"a": 1e-3})
    rng = np.random.default_rng(0)
    m = measure(robot, 30, rng, readings=rng.uniform(-1.9, 1.9, (30, 3)))
    found = inspected(robot, replace(m, readings=plus(m.readings, [4], [60.0, 0, 0])), "position", "known")
    assert "q1 is outside its limits in 1 configurations: is it in another unit?" in found.findings
    assert found.joints[0].n_outside == 1


# --- what can be determined ------------------------------------------------------------------------------------------


def test_a_job_whose_rows_determine_nothing_is_not_ready():
    """Lengths alone are to be estimated, and turns alone were measured."""
    robot = Robot.from_dh([[0.5, 0.2, 0.1, 0]] * 3, "dh", tolerance={"a": 1e-3}).with_estimated(["a1", "a2"])
    found = inspected(robot, measured(robot, placed=None), "orientation", "known")
    assert found.identifiability.observability.rank == 0
    assert found.findings == ("these rows determine none of the parameters that are estimated",)
