"""Criteria against their published formulas, worked out anew from the whole information with numpy alone."""

import numpy as np
import pytest
from systems import random_poses, random_system, system_with_less
from tolerances import rounding

from fg_calib.designs import criteria
from fg_calib.designs.criteria import Measure
from fg_calib.designs.information import PoseRows, System, build_system

CRITERIA = ("I", "D", "A", "E", "O1", "O2", "O3", "O4", "O5")


def formula(criterion, system, M):
    """The table of `criteria`: S by a Schur complement of the information in a basis of core and rest, then its SVD."""
    P = system.core
    rest = np.linalg.svd(P)[2][len(P) :]
    T = np.vstack([np.linalg.pinv(P).T, rest])  # columns of T^T: the functions P, then the rest of a basis
    B = np.linalg.inv(np.vstack([P, rest]))
    N, p = B.T @ M @ B, len(P)
    assert np.allclose(T @ np.vstack([P, rest]).T, np.eye(len(T)))
    S = N[:p, :p] - N[:p, p:] @ np.linalg.inv(N[p:, p:]) @ N[p:, :p] if len(rest) else N
    s = np.sqrt(np.linalg.svd(S)[1])
    match criterion:
        case "I":
            return np.trace(system.task @ np.linalg.inv(M))
        case "D" | "O1":
            return -np.log(np.linalg.det(S))
        case "A":
            return np.trace(np.linalg.inv(S))
        case "E" | "O3":
            return -s[-1]
        case "O2":
            return -s[-1] / s[0]
        case "O4":
            return -(s[-1] ** 2) / s[0]
        case "O5":
            return np.sum(1.0 / s)


def information(system, chosen):
    M = system.known.copy()
    for k in chosen:
        M += system.rows[k].T @ system.rows[k]
    return M


def systems():
    """Of few and many rows a pose, with and without nuisances, and of something undetermined."""
    rng = np.random.default_rng(3)
    shapes = [{}, {"h": 1, "nuisances": 0}, {"h": 6, "p": 3, "nuisances": 5}, {"h": 1, "p": 6}, {"p": 1}]
    return [random_system(rng, **shape) for shape in shapes] + [system_with_less(rng)]


SYSTEMS = systems()
SETS = ([], [0], [3, 1], [0, 1, 2, 3, 4, 5, 6])


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("number", range(len(SYSTEMS)))
def test_values_are_the_published_formulas(number, criterion):
    """To the rounding of two inverses of the information."""
    system = SYSTEMS[number]
    for chosen in SETS:
        M = information(system, chosen)
        expected = formula(criterion, system, M)
        found = Measure(criterion, system).value(system.information(np.array(chosen, dtype=np.int64)))
        assert found == pytest.approx(expected, rel=rounding(1.0, np.linalg.cond(M)), abs=rounding())


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("number", range(len(SYSTEMS)))
def test_the_best_candidate_is_the_best_when_each_is_tried(number, criterion):
    system = SYSTEMS[number]
    allowed = np.ones(system.n_candidates, dtype=np.bool_)
    allowed[[2, 5]] = False
    for chosen in SETS:
        M = information(system, chosen)
        each = np.array([formula(criterion, system, M + A.T @ A) for A in system.rows])
        k, value = Measure(criterion, system).best(M, allowed)
        condition = max(np.linalg.cond(M + A.T @ A) for A in system.rows)
        tolerance = rounding(np.abs(each), condition) + rounding()
        assert allowed[k]
        assert each[k] <= each[allowed].min() + tolerance
        assert value == pytest.approx(each[k], abs=tolerance)


@pytest.mark.parametrize(
    ("criterion", "size", "best"),
    [("A", 2e-5, 1), ("A", 5e-6, 0), ("O5", 5e-5, 1), ("O5", 2e-5, 0), ("D", 2e-4, 1), ("D", 5e-5, 0), ("E", 1e-6, 1)],
)
def test_candidates_that_say_little_are_ordered_by_the_derivative(monkeypatch, criterion, size, best):
    """Of variances 1 and 100 two candidates see one each: traces fall by w^2, roots by w^1.5, logarithms by w."""
    monkeypatch.setattr(criteria, "N_TRIED", 1)
    one = np.eye(2)
    system = System(np.array([[[-1e-3, 0.0]], [[0.0, size]]]), np.diag([1.0, 0.01]), one, one, 0.0)
    assert Measure(criterion, system).best(system.known, np.ones(2, dtype=np.bool_))[0] == best


# --- the system -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [False, True])
def test_the_task_counts_in_its_own_units_and_without_what_none_determines(lost):
    """`tr(W C)` by the pseudo-inverse in changes of ordinary size, the weak prior being 1e-8 of what is measured."""
    poses, direction, W = random_poses(np.random.default_rng(5), lost=lost)
    given = np.random.default_rng(6).normal(size=(1, 5)) / poses.scales
    if lost:
        u = direction / poses.scales
        given -= (given * poses.scales @ u / (u @ u))[:, None] * (u / poses.scales)
    system = build_system(poses, given, W)
    chosen = np.array([0, 3, 4, 9, 11])
    A = np.vstack([poses.rows[chosen].reshape(-1, 5), poses.always, given]) * poses.scales
    C = np.linalg.pinv(A.T @ A, rcond=1e-12, hermitian=True)[:3, :3] * np.outer(poses.scales[:3], poses.scales[:3])
    found = Measure("I", system).value(system.information(chosen))
    assert system.rows.shape == (15, 2, 4 if lost else 5)
    exact = PoseRows(1e12 * poses.rows, poses.always, poses.scales, 3)  # what is lost is lost at any noise
    assert build_system(exact, given, W).rows.shape == system.rows.shape
    assert found == pytest.approx(np.trace(W @ C), rel=1e-4)
    share = 0.0
    if lost:
        u = direction / poses.scales / np.linalg.norm(direction / poses.scales)
        at = u[:3] * poses.scales[:3]
        share = at @ W @ at / np.sum(np.diag(W) * poses.scales[:3] ** 2)
    assert system.unknown == pytest.approx(share, abs=1e-9)
    assert len(system.core) == (2 if lost else 3)
