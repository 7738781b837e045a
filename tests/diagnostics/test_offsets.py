"""An instrument that adds something to every length is found where that was not estimated, and is no chance."""

from dataclasses import replace

import numpy as np
import pytest
from instruments import measured_by

from fg_calib.assessment import assess
from fg_calib.diagnostics.offsets import CERTAIN, forgotten_offsets
from fg_calib.graph.build import build_problem
from fg_calib.graph.solver import solve


def lengths(rng, offset, n=60):
    """An arm, and lengths to anchors with an offset of which the job says nothing."""
    robot, _, table = measured_by("anchors", rng, n=n, sigma_joint=3e-5)
    m = table.measurements
    return robot, replace(table, measurements=replace(m, length=m.length + offset))


@pytest.mark.slow
def test_a_forgotten_offset_is_a_reservation_with_its_size():
    robot, table = lengths(np.random.default_rng(1), 5e-3)
    solution = solve(build_problem(robot, [table]))
    (found,) = forgotten_offsets(solution)
    told = solve(build_problem(robot, [replace(table, offset=True)]))
    unknowns = told.problem.data.unknowns
    place = int(np.flatnonzero(unknowns.owners == [n.startswith("offset") for n in unknowns.names].index(True))[0])
    estimate = told.parameters[told.problem.variables.nuisance_span][place]
    # As it is estimated with all others: linear to a tenth of its sigma.
    assert found.size == pytest.approx(estimate, abs=0.1 * found.sigma)
    assert abs(found.size - 5e-3) < 4.0 * found.sigma
    verdict = assess(solution)
    said = [*verdict.findings, *verdict.reservations]
    assert any("offset: estimate" in text for text in said)
    healthy = assess(told)
    assert not any("offset: estimate" in text for text in [*healthy.findings, *healthy.cautions])


@pytest.mark.slow
@pytest.mark.parametrize(("offset", "least", "most"), [(0.0, 0, 0), (5e-3, 8, 12)])
def test_a_robust_loss_hides_no_forgotten_offset(offset, least, most):
    """Of 12 tables with gross errors; the loss takes a part of what the offset does to the lengths for outliers."""
    n = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        robot, table = lengths(rng, offset)
        m = table.measurements
        gross = 0.03 * rng.normal(size=len(m.length)) * (rng.random(len(m.length)) < 0.08)
        table = replace(table, measurements=replace(m, length=m.length + gross))
        n += len(forgotten_offsets(solve(build_problem(robot, [table], loss="gnc"))))
    assert least <= n <= most


@pytest.mark.slow
def test_lengths_without_one_have_none():
    """40 tables, CERTAIN of which by chance each."""
    rng = np.random.default_rng(2)
    n = sum(len(forgotten_offsets(solve(build_problem(robot, [table])))) for robot, table in
            (lengths(rng, 0.0, 40) for _ in range(40)))  # fmt: skip
    assert n == 0
    assert 40 * CERTAIN < 0.01
