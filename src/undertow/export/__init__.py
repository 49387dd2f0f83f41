"""The inner loop for a microcontroller: heap-free C99 from the kernel's own expressions."""

from undertow.export.controller import EmbeddedController, files
from undertow.export.differentiators import Differentiator, FilteredDerivative, SuperTwisting
from undertow.export.host import Agreement, Build, Footprint, HostProcess
from undertow.export.twin import Status, Twin, Verdict

__all__ = [
    "Agreement",
    "Build",
    "Differentiator",
    "EmbeddedController",
    "FilteredDerivative",
    "Footprint",
    "HostProcess",
    "Status",
    "SuperTwisting",
    "Twin",
    "Verdict",
    "files",
]
