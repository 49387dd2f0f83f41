"""What the live page shows: a cascade in real time, a simulated run, the log of a run."""

from undertow.studies.live.recorded import Recorded, of_log, of_run, recorded_run
from undertow.studies.live.simulation import Simulation, simulation

__all__ = ["Recorded", "Simulation", "of_log", "of_run", "recorded_run", "simulation"]
