"""Every option is checked where it enters the Python API: one line that says what is possible, and what was meant."""

from dataclasses import fields
from typing import get_args

import numpy as np
import pytest
from refusals import refusal
from simulated import measure, planar_robot

from fg_calib import Noise, Pairing, SolverOptions, build_problem, simulate, solve
from fg_calib.inputs import InputError, options
from fg_calib.io import Units, read_measurements
from fg_calib.observability import observe_configurations, observe_structure
from fg_calib.observability.cramer_rao import cramer_rao
from fg_calib.robot import pose
from fg_calib.simulation.scenario import Errors, RandomReadings, Scenario

ROBOT = planar_robot(tolerance={"a": 1e-3, "theta": 1e-3})
TABLE = measure(ROBOT, 20, np.random.default_rng(0))


def problem(**options):
    return build_problem(ROBOT, TABLE, **{"model": "distance"} | options)


def bound(**options):
    return cramer_rao(ROBOT, TABLE, **{"model": "distance"} | options)


def structure(model="distance", **options):
    return observe_structure(ROBOT, model, **options)


def practical(model="distance", **options):
    return observe_configurations(ROBOT, TABLE, model, **options)


def scenario(**changes):
    return Scenario(**{"robot": ROBOT, "errors": Errors("values", {}), "configurations": RandomReadings(2),
                       "noise": Noise(1e-3, 1e-3)} | changes)  # fmt: skip


WORDS = {
    "model": (options.Model, (problem, bound, structure, practical)),
    "frame": (options.FrameKnowledge, (problem, bound, structure, practical)),
    "gauge": (options.Gauge, (problem,)),
    "pair_errors": (options.PairErrors, (problem, bound)),
    "encoder": (options.EncoderNoise, (problem,)),
    "loss": (options.Loss, (problem,)),
}
CALLS = [(function, key) for key, (_, functions) in WORDS.items() for function in functions]


@pytest.mark.parametrize(("function", "key"), CALLS, ids=[f"{f.__name__} {key}" for f, key in CALLS])
def test_a_word_in_capitals_is_refused_with_the_word_that_was_meant(function, key):
    for word in get_args(WORDS[key][0]):
        caught = refusal(function, **{key: word.capitalize()})
        expected = f"expected one of {', '.join(get_args(WORDS[key][0]))}; did you mean {word}?"
        assert caught == f"{key}: found {word.capitalize()!r}, {expected}"


NAN, INF = float("nan"), float("inf")
MISTAKES = {
    "a strategy": (lambda: Pairing("Chain"), "pairing: found 'Chain', expected one of star, chain, all, random; "
                   "did you mean chain?"),
    "no random pairs": (lambda: Pairing("random"), "pairing: count: found 0, expected a whole number above 0"),
    "a seed of halves": (lambda: Pairing("random", 3, np.float32(2)), "pairing: seed: found 2.0, expected a whole "
                         "number not below 0"),
    **{f"a bare strategy {f.__name__}": (
        lambda f=f: f(pairing="chain"), "pairing: found 'chain', expected a Pairing, such as Pairing('chain')"
    ) for f in (problem, bound, practical)},
    "a bare noise": (lambda: read_measurements("poses.csv", ROBOT, noise=1e-3), "noise: found 0.001, expected a Noise, "
                     "such as Noise(position=1e-3)"),
    "a bare unit": (lambda: read_measurements("poses.csv", ROBOT, units="mm"), "units: found 'mm', expected a Units, "
                    "such as Units(length='mm')"),
    "options as a mapping": (lambda: solve(problem(), {"max_iterations": 5}), "options: found {'max_iterations': 5}, "
                             "expected a SolverOptions, such as SolverOptions(max_iterations=200)"),
    **{f"a name to keep {f.__name__}": (
        lambda f=f: f(prefer=["A2"]), "prefer: unknown parameter 'A2', expected one of base.x, base.y, base.z, "
        "base.yaw, base.pitch, base.roll, theta1, d1, a1, alpha1, theta2, d2, ...; did you mean a2?"
    ) for f in (problem, structure, practical)},
    "one name for a list": (lambda: structure(prefer="a2"), "prefer: found 'a2', expected a list of names"),
    "readings of another robot": (lambda: pose(ROBOT, np.zeros((2, 3))), "readings: shape (2, 3), expected (n, 2) for "
                                  "the robot's joints"),
    "configurations below 0": (lambda: structure(n_configurations=-1), "n_configurations: found -1, expected a whole "
                               "number not below 0"),
    "a simulation's seed": (lambda: simulate(scenario(), 1.0), "seed: found 1.0, expected a whole number not below 0"),
    "a unit of length": (lambda: Units(length="MM"), "units: length: found 'MM', expected one of m, cm, mm, um, in; "
                         "did you mean mm?"),
    "more noise than a float holds": (lambda: Noise(10**400), f"noise: position: found 1{'0' * 47}...000000..., "
                                      "expected a finite number not below 0"),
}  # fmt: skip


@pytest.mark.parametrize(("call", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named_in_one_line(call, message):
    assert refusal(call) == message


@pytest.mark.parametrize("figure", [-1.0, NAN, "1"], ids=repr)
@pytest.mark.parametrize("key", [f.name for f in fields(Noise) if f.name != "more"])
def test_noise_is_a_finite_number_not_below_0(key, figure):
    assert refusal(Noise, **{key: figure}) == f"noise: {key}: found {figure!r}, expected a finite number not below 0"


@pytest.mark.parametrize("key", [f.name for f in fields(Noise) if f.name not in ("joint", "more")])
def test_a_calibration_takes_nothing_for_exact(tmp_path, key):
    (tmp_path / "poses.csv").write_text("q1,q2,x,y,z\n0,0,1,0,0\n")
    with pytest.raises(InputError, match=f"^noise: {key}: found 0.0, expected a finite number above 0$"):
        read_measurements(tmp_path / "poses.csv", ROBOT, noise=Noise(**{key: 0.0}))


@pytest.mark.parametrize("value", [-1, NAN, INF, "10"], ids=repr)
@pytest.mark.parametrize("key", [f.name for f in fields(SolverOptions)])
def test_options_of_the_solver_are_finite_numbers_not_below_0(key, value):
    said = f"^solver: {key}: found {value!r}, expected a (finite|whole) number not below "
    with pytest.raises(InputError, match=said):
        SolverOptions(**{key: value})


@pytest.mark.parametrize("yes", [True, np.True_])
@pytest.mark.parametrize("no", [False, np.False_])
def test_a_switch_of_numpys_counts_as_pythons(yes, no):
    """`np.False_ is False` is false: it used to switch priors on."""
    assert problem(prior=yes).options.gauge == "prior"
    assert problem(prior=no).options.gauge == "none"


def test_numbers_of_numpys_are_numbers():
    assert Pairing("random", np.int64(3), np.int32(1)).count == 3
    assert Noise(np.float64(1e-3), np.float32(1e-3), (0, np.float64(1.0))).orientation == pytest.approx(1e-3)
    assert solve(problem(), SolverOptions(max_iterations=np.int64(7))).iterations <= 7
