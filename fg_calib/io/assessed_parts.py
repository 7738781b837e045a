"""What is known of a calibration of a table in parts: covariance, what the data determine, and what the sums say.

Sums over all rows judge the fit as a whole: chi-square, and corrections against tolerances. What needs single rows is
not asked: outliers, mistakes, other optima, whether residuals follow the arm. So the verdict has no word for good.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from fg_calib.arrays import Brief
from fg_calib.diagnostics.verdict import Statement, check_chi_square, check_priors
from fg_calib.graph.factors import corrections_of, prior_rows
from fg_calib.graph.information import named_rows
from fg_calib.io.parts_solver import Part, PartsSolution, problem_of_table, table_of_part
from fg_calib.measurements.dataset import Measurements
from fg_calib.observability.identifiability import Identifiability
from fg_calib.observability.indices import Observability, observability_of_rows
from fg_calib.observability.parallel_axes import missing_motions
from fg_calib.prediction.expected_error import ExpectedError, expected_error
from fg_calib.statistics.estimates import FrameEstimate, ParameterEstimate
from fg_calib.statistics.estimates import estimate_frames as frame_estimates
from fg_calib.statistics.estimates import finite as known
from fg_calib.statistics.goodness_of_fit import ChiSquare, chi_square_of
from fg_calib.statistics.prior_consistency import PriorFit, judge_tolerances
from fg_calib.threads import single_threaded

_log = logging.getLogger(__name__)

UNJUDGED = "solved in parts: no single row was judged, and no outlier, mistake or other optimum looked for"
"""What its reader must know of every such calibration."""

INDEPENDENT = "pairs count as independent: where they share errors of joint readings the sigmas are too small"


@dataclass(frozen=True)
class AssessedParts(Brief):
    """What is known of a calibration in parts.

    Attributes:
        solution: The calibration.
        parameters: Every parameter of the robot.
        frames: The measurement frame, if it was estimated.
        chi2: Chi-square of all fitted rows and the priors.
        n_priors: Number of the latter.
        priors: Corrections against tolerances; None without priors.
        identifiability: What the data alone determine, at the nominal parameters.
        findings: Why it is not to be trusted; empty if nothing that was looked at speaks against it.
        cautions: What its reader should know besides.
        configurations: The table of configurations, if it was not cut: that of pairs; else None.
        expected_error: Of the tool at these, by the covariance; None without.
    """

    solution: PartsSolution
    parameters: tuple[ParameterEstimate, ...]
    frames: tuple[FrameEstimate, ...]
    chi2: ChiSquare
    n_priors: int
    priors: PriorFit | None
    identifiability: Identifiability
    findings: tuple[str, ...]
    cautions: tuple[str, ...]
    configurations: Measurements | None
    expected_error: ExpectedError | None

    @property
    def reservations(self) -> tuple[str, ...]:
        """Those of the cautions that the verdict has to mention."""
        return tuple(text for text in self.cautions if text in (UNJUDGED, INDEPENDENT))


@single_threaded
def assess_parts(solution: PartsSolution, part: Part) -> AssessedParts:
    """What is known of a calibration in parts.

    Args:
        solution: The calibration.
        part: One of the parts: of pairs all have the same configurations; for the reasons why directions are lost.
    """
    posterior, options, n_configurations = solution.posterior, solution.options, solution.reduced.n_configurations
    assert n_configurations is not None
    variables = posterior.variables
    robot, n_priors = variables.robot, len(prior_rows(variables, solution.parameters)[0])
    by_name = {p.name: p for p in robot.parameters}
    estimated = [by_name[name] for name in variables.names[: variables.n_robot_columns]]
    observability = observability_of_rows(
        named_rows(variables, solution.start, solution.at_start.triangle[:, :-1]),
        estimated,
        scales=np.array([robot.scale_of(p.unit) for p in estimated]),
        n_measurements=solution.at_start.n_measurements,
    )
    table = table_of_part(part, options)
    problem = problem_of_table(robot, table, options, solution.start)
    identifiability = Identifiability(
        *(robot.name, options.model, "practical", n_configurations, observability, (problem, solution.start)),
        missing=missing_motions(robot),
    )
    shared = options.uses_pairs and options.pair_errors == "independent"
    dof = solution.reduced.n_residuals + n_priors - solution.rank
    chi2 = chi_square_of(solution.chi2, dof, independent=not shared)
    priors = judge_tolerances(variables, solution.parameters, posterior.tangent)
    statements = [] if solution.converged else [Statement("error", solution.message)]
    statements += [*check_chi_square(chi2), *check_priors(priors)]
    statements += [Statement("note", text) for text in _missing_figures(solution, table.measurements)]
    statements += [Statement("note", UNJUDGED), *([Statement("note", INDEPENDENT)] if shared else [])]
    return AssessedParts(
        solution=solution,
        parameters=_parameters(solution, observability),
        frames=frame_estimates(variables, solution.parameters, posterior),
        chi2=chi2,
        n_priors=n_priors,
        priors=priors,
        identifiability=identifiability,
        findings=tuple(s.text for s in statements if s.severity == "error"),
        cautions=tuple(s.text for s in statements if s.severity != "error"),
        configurations=replace(table.measurements, pairs=None) if options.uses_pairs else None,
        expected_error=expected_error(problem, posterior) if options.uses_pairs else None,
    )


def _missing_figures(solution: PartsSolution, m: Measurements) -> list[str]:
    """A sentence, that is warned of too, on each figure that the model uses and no fitted pair has."""
    if m.pairs is None:
        return []
    missing = [name for name, (n, _) in solution.reduced.squares.items() if not n]
    texts = [f"{m.pairs.source}: no fitted pair has values of {name}; is a column misspelt?" for name in missing]
    for text in texts:
        _log.warning("%s", text)
    return texts


def _parameters(solution: PartsSolution, observability: Observability) -> tuple[ParameterEstimate, ...]:
    """Every parameter of the robot."""
    robot, classes = (
        solution.posterior.variables.robot,
        dict(zip(observability.names, observability.classes, strict=True)),
    )
    values, sigma = solution.robot.nominal, solution.sigma
    corrections = corrections_of(robot, values)
    return tuple(
        ParameterEstimate(
            name=p.name,
            unit=p.unit,
            nominal=p.nominal,
            estimate=float(values[i]),
            correction=float(corrections[i]),
            sigma=known(sigma.get(p.name, 0.0)),
            prior_sigma=p.tolerance if p.estimated and solution.options.has_priors else None,
            identifiability=classes.get(p.name, "fixed"),
        )
        for i, p in enumerate(robot.parameters)
    )
