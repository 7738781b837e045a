from .inspection import Inspection, inspect_job
from .nominal_residuals import MAX_ROWS
from .setup_check import SetupCheck, check_setup, check_tables, reporting
from .unmodelled_effects import LIKE_NOISE, basis_of
from .verdict import MOST_ESTIMATED, Verdict, chi2_in_words, judge, predicted_in_words, probability

__all__ = [
    "LIKE_NOISE",
    "MAX_ROWS",
    "MOST_ESTIMATED",
    "Inspection",
    "SetupCheck",
    "Verdict",
    "basis_of",
    "check_setup",
    "check_tables",
    "chi2_in_words",
    "inspect_job",
    "judge",
    "predicted_in_words",
    "probability",
    "reporting",
]
