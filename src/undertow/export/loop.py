"""The exported controller in the loop: a process of its own, a rig, a pipe between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undertow.export.host import HostProcess
from undertow.export.status import Status
from undertow.models import FloatArray
from undertow.plants import Rig

__all__ = ["HELD", "Loop", "run_on_rig"]

#: Distance of an unactuated coordinate from the target up to which it counts as held, rad or m.
HELD = 0.1


@dataclass(frozen=True, eq=False)
class Loop:
    """One run on a rig, period by period.

    Attributes
    ----------
    q
        Measured positions, (N, n).
    u
        Outputs, (N, m).
    status
        What the controller said of each period.
    held
        Whether the unactuated coordinates stayed within :data:`HELD` in the last second.
    """

    q: FloatArray
    u: FloatArray
    status: tuple[Status, ...]
    held: bool


def run_on_rig(process: HostProcess, rig: Rig, seconds: float) -> Loop:
    """Let an exported controller steer a rig, from measured positions alone.

    Parameters
    ----------
    process
        The controller's process.
    rig
        Whose period is the controller's.
    seconds
        How long, on the rig's clock.
    """
    m = process.controller.mechanism.m
    positions, outputs, status = [], [], []
    for _ in range(round(seconds / rig.period)):
        q = rig.read().q
        u, said = process.step(q)
        rig.write(u)
        positions.append(q)
        outputs.append(u)
        status.append(said)
    last = np.array(positions[-max(1, round(1.0 / rig.period)) :])[:, m:]
    held = bool((np.abs(last) <= HELD).all())
    return Loop(np.array(positions), np.array(outputs), tuple(status), held)
