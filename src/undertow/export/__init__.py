"""The inner loop for a microcontroller: heap-free C99 from the kernel's own expressions."""

from undertow.export.controller import EmbeddedController
from undertow.export.differentiators import DerivativeStep, DifferentiatorStep, SuperTwistingStep
from undertow.export.host import Agreement, Build, Footprint, HostProcess
from undertow.export.observer import KalmanStep
from undertow.export.sources import files
from undertow.export.status import Status, Verdict
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
    "Status",
    "SuperTwistingStep",
    "Twin",
    "Verdict",
    "files",
]
