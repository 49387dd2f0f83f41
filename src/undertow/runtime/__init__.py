"""The runtime: the cascade against the clock, the log of a run, and its replay.

A run is data (:mod:`.recipe`), and :mod:`.session` carries it out. The fast loop (:mod:`.loop`)
reads, asks the :mod:`.controller` what to do, writes and logs; the controller, a pure state
machine, checks its readings (:mod:`.sensors`), steps (:mod:`.steps`, :mod:`.modes`) and looks at
each plan before it uses it (:mod:`.plan_check`). The slow loop (:mod:`.slow_loop`) selects plans,
in a thread or in processes (:mod:`.workers`). :mod:`.supervisor`, in a process of its own, sets
the output to zero when the controller hangs or dies. What was logged (:mod:`.log`, columns in
:mod:`.encoding`) is read by :mod:`.recording` and run again, bit for bit, by :mod:`.replay`.
"""

from undertow.runtime.clock import Histogram, SimulatedClock, WallClock
from undertow.runtime.controller import Controller, Inputs
from undertow.runtime.controller_defaults import default_gate, estimator_for, for_rig, reaching_for
from undertow.runtime.encoding import Columns
from undertow.runtime.log import Log
from undertow.runtime.log_files import column_units, to_mcap, to_parquet
from undertow.runtime.loop import Runtime
from undertow.runtime.modes import Command, Mode, Reason
from undertow.runtime.recipe import Recipe
from undertow.runtime.recording import GrowingLog, Recording, read_log
from undertow.runtime.replay import Replay, about, replay, replay_controller
from undertow.runtime.session import run, session
from undertow.runtime.settings import Settings
from undertow.runtime.slow_loop import Answer, Request, respond
from undertow.runtime.supervisor import SupervisedRig
from undertow.runtime.targets import RunTarget, send_target, target_of_run
from undertow.runtime.verdict import EXIT_CODES, Ending, Report, RunVerdict
from undertow.runtime.workers import BackgroundWorker, InlineWorker, Worker, background_worker

__all__ = [
    "EXIT_CODES",
    "Answer",
    "BackgroundWorker",
    "Columns",
    "Command",
    "Controller",
    "Ending",
    "GrowingLog",
    "Histogram",
    "InlineWorker",
    "Inputs",
    "Log",
    "Mode",
    "Reason",
    "Recipe",
    "Recording",
    "Replay",
    "Report",
    "Request",
    "RunTarget",
    "RunVerdict",
    "Runtime",
    "Settings",
    "SimulatedClock",
    "SupervisedRig",
    "WallClock",
    "Worker",
    "about",
    "background_worker",
    "column_units",
    "default_gate",
    "estimator_for",
    "for_rig",
    "reaching_for",
    "read_log",
    "replay",
    "replay_controller",
    "respond",
    "run",
    "send_target",
    "session",
    "target_of_run",
    "to_mcap",
    "to_parquet",
]
