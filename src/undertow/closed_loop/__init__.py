"""Mechanism and law integrated: the kernel, many runs at once, and what one run was."""

from undertow.closed_loop.buffers import RolloutBuffers, Shape
from undertow.closed_loop.kernel import compile_loop
from undertow.closed_loop.rollout import ClosedLoop
from undertow.closed_loop.trajectory import INADMISSIBLE, Event, Trajectory
from undertow.closed_loop.unchecked import UncheckedLoop

__all__ = [
    "INADMISSIBLE",
    "ClosedLoop",
    "Event",
    "RolloutBuffers",
    "Shape",
    "Trajectory",
    "UncheckedLoop",
    "compile_loop",
]
