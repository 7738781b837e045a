from .check import Check, Explanation, check_rows
from .hypotheses import named_changes
from .new_data import Rows
from .prior_information import Calibrated, at_nominal, counted_before, fingerprints, knowledge_of
from .update import predicted_before, updated

__all__ = [
    "Calibrated",
    "Check",
    "Explanation",
    "Rows",
    "at_nominal",
    "check_rows",
    "counted_before",
    "fingerprints",
    "knowledge_of",
    "named_changes",
    "predicted_before",
    "updated",
]
