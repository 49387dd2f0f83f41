"""For other tools: heap-free C99 and what carries it on, Gymnasium's environments, python-control.

Begin at :class:`EmbeddedController` (:mod:`.controller`), whose C :mod:`.sources` writes from the
templates; :mod:`.carriers` packs it for FMI, ROS 2 and Simulink, :mod:`.twin` is its step in
Python. The task of balancing is :mod:`.balancing`'s; Gymnasium's classes are in
:mod:`undertow.export.gym`, which is imported where it is needed. Systems of python-control are
:mod:`.python_control`'s.
"""

from undertow.export.balancing import BalancingTask, environment, vector_environment
from undertow.export.carriers import carriers
from undertow.export.controller import EmbeddedController
from undertow.export.estimate import (
    DerivativeStep,
    DifferentiatorStep,
    KalmanStep,
    SuperTwistingStep,
)
from undertow.export.host import Agreement, Build, Footprint, HostProcess, RigRun, run_on_rig
from undertow.export.names import PlanAnswer, Status
from undertow.export.python_control import (
    LoopMargins,
    loop_margins,
    loop_transfer,
    nlsys,
    phase_plane,
)
from undertow.export.sources import export_c, files
from undertow.export.twin import Twin

__all__ = [
    "Agreement",
    "BalancingTask",
    "Build",
    "DerivativeStep",
    "DifferentiatorStep",
    "EmbeddedController",
    "Footprint",
    "HostProcess",
    "KalmanStep",
    "LoopMargins",
    "PlanAnswer",
    "RigRun",
    "Status",
    "SuperTwistingStep",
    "Twin",
    "carriers",
    "environment",
    "export_c",
    "files",
    "loop_margins",
    "loop_transfer",
    "nlsys",
    "phase_plane",
    "run_on_rig",
    "vector_environment",
]
