"""The inner loop for a microcontroller: heap-free C99 from the kernel's own expressions."""

from undertow.export.controller import EmbeddedController, files
from undertow.export.differentiators import DerivativeStep, DifferentiatorStep, SuperTwistingStep
from undertow.export.host import Agreement, Build, Footprint, HostProcess
from undertow.export.observer import KalmanStep
from undertow.export.twin import Status, Twin, Verdict

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
