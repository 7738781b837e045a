from .obstacles import link_points
from .scenario import (
    MOST_DRAWN,
    BoardViews,
    Box,
    Configurations,
    Errors,
    GivenReadings,
    Instrument,
    Placement,
    Plane,
    RandomReadings,
    Scenario,
    Spot,
    TargetViews,
    read_scenario,
)
from .simulator import Simulation, simulate
from .views import Candidates, draw_candidates
from .write import job_text, table_columns, to_fill_in, write_simulation

__all__ = [
    "MOST_DRAWN",
    "BoardViews",
    "Box",
    "Candidates",
    "Configurations",
    "Errors",
    "GivenReadings",
    "Instrument",
    "Placement",
    "Plane",
    "RandomReadings",
    "Scenario",
    "Simulation",
    "Spot",
    "TargetViews",
    "draw_candidates",
    "job_text",
    "link_points",
    "read_scenario",
    "simulate",
    "table_columns",
    "to_fill_in",
    "write_simulation",
]
