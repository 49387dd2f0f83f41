"""The runtime: the controller against the clock, its log and replay, and the fault drill."""

from undertow.runtime.clock import SimulatedClock, WallClock
from undertow.runtime.controller import Controller, Inputs
from undertow.runtime.log import Columns, Log, Recording, read_log
from undertow.runtime.loop import Runtime
from undertow.runtime.modes import Command, Mode
from undertow.runtime.recipe import Recipe
from undertow.runtime.replay import Replay, about, replay, replay_controller
from undertow.runtime.settings import Settings
from undertow.runtime.slow import InlineWorker, Worker, background_worker, respond
from undertow.runtime.verdict import Report, RunVerdict

__all__ = [
    "Columns",
    "Command",
    "Controller",
    "InlineWorker",
    "Inputs",
    "Log",
    "Mode",
    "Recipe",
    "Recording",
    "Replay",
    "Report",
    "RunVerdict",
    "Runtime",
    "Settings",
    "SimulatedClock",
    "WallClock",
    "Worker",
    "about",
    "background_worker",
    "read_log",
    "replay",
    "replay_controller",
    "respond",
]
