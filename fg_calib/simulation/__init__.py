"""Robots and measurements to try things on."""

from fg_calib._lazy import attach

__getattr__, __dir__ = attach(
    __name__,
    {
        "fg_calib.simulation.scenario": "BoardViews GivenReadings RandomReadings Scenario TargetViews read_scenario",
        "fg_calib.simulation.simulator": "Simulation simulate",
        "fg_calib.simulation.write": "write_simulation",
    },
)
