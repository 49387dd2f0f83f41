"""Mechanism and law integrated: the kernel, many runs at once, and what one run was.

:mod:`.kernel` compiles what :mod:`.kernel_source` writes: small Runge-Kutta steps, and the large
ones of :mod:`.exponential_integrator`, with the linear model of :mod:`.linear_model`.  Motions that
are shown, and those that decide with an exact belief, are integrated to a tolerance, by
:mod:`.adaptive_integrator`; :mod:`.gate` decides which of two plans a loop goes on with.
"""

from undertow.closed_loop.along_reference import simulate_along
from undertow.closed_loop.buffers import RolloutBuffers
from undertow.closed_loop.cuda import on_gpu
from undertow.closed_loop.ensemble import Ensemble, Risk
from undertow.closed_loop.kernel import compile_loop
from undertow.closed_loop.rollout import ROUNDING, RTOL, ClosedLoop
from undertow.closed_loop.trajectory import INADMISSIBLE, UNSTABLE, Event, Trajectory
from undertow.closed_loop.work_array import LANES

__all__ = [
    "INADMISSIBLE",
    "LANES",
    "ROUNDING",
    "RTOL",
    "UNSTABLE",
    "ClosedLoop",
    "Ensemble",
    "Event",
    "Risk",
    "RolloutBuffers",
    "Trajectory",
    "compile_loop",
    "on_gpu",
    "simulate_along",
]
