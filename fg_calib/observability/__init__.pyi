from .identifiability import Identifiability, identifiability_of, observe_configurations, observe_structure
from .indices import CORRELATED, IdentifiabilityClass, Observability, observability_of_rows
from .parallel_axes import MissingMotion, missing_motions
from .predicted import STRUCTURAL_FLOOR, places_of, predicted_problem, random_problem, true_problem
from .reasons import NOT_EXCITED, LostDirection, ObservedQuantities

__all__ = [
    "CORRELATED",
    "NOT_EXCITED",
    "STRUCTURAL_FLOOR",
    "Identifiability",
    "IdentifiabilityClass",
    "LostDirection",
    "MissingMotion",
    "Observability",
    "ObservedQuantities",
    "identifiability_of",
    "missing_motions",
    "observability_of_rows",
    "observe_configurations",
    "observe_structure",
    "places_of",
    "predicted_problem",
    "random_problem",
    "true_problem",
]
