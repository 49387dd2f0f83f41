"""The inner loop in heap-free C99, from the kernel's own expressions, and what carries it on."""

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
from undertow.export.sources import export_c, files
from undertow.export.twin import Twin

__all__ = [
    "Agreement",
    "Build",
    "DerivativeStep",
    "DifferentiatorStep",
    "EmbeddedController",
    "Footprint",
    "HostProcess",
    "KalmanStep",
    "PlanAnswer",
    "RigRun",
    "Status",
    "SuperTwistingStep",
    "Twin",
    "carriers",
    "export_c",
    "files",
    "run_on_rig",
]
