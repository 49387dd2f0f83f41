"""What the live page shows: a cascade in real time, a simulated run, a run on a rig, its log."""

from undertow.studies.live.recorded import Recorded, of_log, of_run, recorded_run
from undertow.studies.live.simulation import Simulation, simulation
from undertow.studies.live.watched import Watched
from undertow.studies.live.window import Window

__all__ = [
    "Recorded",
    "Simulation",
    "Watched",
    "Window",
    "of_log",
    "of_run",
    "recorded_run",
    "simulation",
]
