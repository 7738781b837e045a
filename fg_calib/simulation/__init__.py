"""Robots and measurements to try things on."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.simulation.scenario": "BoardCamera BoardPoints BoardViews Box Corners Errors GivenReadings Indicator "
        "LengthGauge PairGauge Placement Plane RandomReadings Scenario Sockets Spot TargetViews Tracker read_scenario",
        "fg_calib.simulation.simulator": "Simulation simulate",
        "fg_calib.simulation.write": "write_simulation",
    },
)
