"""What a run keeps to: limits of the output, patience with sensors, optimiser and clock."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from undertow.base import InvalidInputError
from undertow.models import FloatArray, Mechanism

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings:
    """Limits and patience of the fast loop.

    Parameters
    ----------
    output_limit
        Largest |u|, in the input's unit; the mechanism's own limits apply besides.
    slew_time
        Shortest time in which an input may cross its whole range, s: the slew rate is
        2 u_max / slew_time.  Inputs without a limit have none on their rate either.
    lead, longest_lead
        How far ahead proposals are computed, s: from a request to the use of its answer.
        It starts at ``lead``, grows by half when an answer comes late, and shrinks by a tenth
        when one comes in less than half of it.
    silence
        An optimiser that has not answered for this long after its time is replaced, s.
    surprise
        A proposal is refused when, at its time of use, an entry of the state is off the
        predicted one by more than this, in units of 1 + |entry|.
    patience
        Longest gap in a sensor that the model bridges, s.
    jump
        Largest believable difference between a position and its prediction, rad or m, besides
        two periods of motion at the present speed.
    frozen
        A reading that does not move while the model has moved by this, rad or m, is frozen.
    dead_band
        Part of the input's limit that friction may swallow without anything moving.
    settle
        The sensors must have been sound for this long before the law takes over, s.
    near
        ‖(q_u, q̇_u)‖₂ of the unactuated coordinates within which the mechanism counts as
        settled; beyond twice that it does not.
    margin
        det Γ(q)/det Γ(0) below which the law is taken to be lost, (37).
    travel
        Largest |q_i|, rad or m, besides the ranges of the coordinates.
    lost
        A free angle further than this from the target has been thrown out, rad.
    escape
        ‖x‖₂ beyond which the mechanism has been thrown out, whatever the predictions' own limit.
    stall
        Longest gap between two steps, s; after a longer one the loop stops safely.
    window, failing, sparse
        When more than the share ``failing`` of the reads or of the writes fail, or more than
        ``sparse`` of the readings of one sensor are missing, over a sliding window of this
        length, s, the loop stops safely.
    overrun
        When more than this share of the periods of the last second had no step that ended in
        time, the loop stops safely.
    drift
        The rig's clock may go wrong against the host's, or against the steps made, by this much
        in a second, s; beyond that the loop stops safely.
    bring_up
        Longest bring-up, s; when the law cannot take over by then the loop stops safely.
    insist
        How long a rig that does not take an output of zero is asked again after a safe stop, s.
    home, homing
        ‖x‖₂ within which a run that ends settled has come home; and how long after it has
        settled, s, it is on its way and may be four times as far away.
    """

    output_limit: float = math.inf
    slew_time: float = 0.004
    lead: float = 0.1
    longest_lead: float = 0.5
    silence: float = 0.5
    surprise: float = 0.5
    patience: float = 0.02
    jump: float = 0.05
    frozen: float = 0.25
    dead_band: float = 0.05
    settle: float = 0.02
    near: float = 0.2
    margin: float = 0.02
    travel: float = math.inf
    lost: float = math.pi / 2
    escape: float = 500.0
    stall: float = 0.1
    window: float = 0.25
    failing: float = 0.2
    sparse: float = 0.6
    overrun: float = 0.3
    drift: float = 0.1
    bring_up: float = 2.0
    insist: float = 1.0
    home: float = 0.35
    homing: float = 5.0

    def __post_init__(self) -> None:
        """Refuse what is not positive."""
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0:
                raise InvalidInputError(
                    f"{item.name} of a run",
                    value=value,
                    limit="> 0",
                    remedy="Leave it out for the usual value",
                )

    def limits(self, mechanism: Mechanism) -> FloatArray:
        """Largest |u_i|, (m,)."""
        return np.minimum(mechanism.input_limits, self.output_limit)

    def slew(self, mechanism: Mechanism) -> FloatArray:
        """Largest |du_i/dt|, (m,), in the input's unit per second."""
        return 2.0 * self.limits(mechanism) / self.slew_time

    def bands(self, mechanism: Mechanism) -> FloatArray:
        """Part of each input that friction may swallow, (m,); 0 where there is no limit."""
        limits = self.limits(mechanism)
        return np.where(np.isfinite(limits), self.dead_band * limits, 0.0)

    def travels(self, mechanism: Mechanism) -> FloatArray:
        """Lowest and highest positions, (n, 2), rad or m."""
        low = [max(c.low, -self.travel) for c in mechanism.coordinates]
        high = [min(c.high, self.travel) for c in mechanism.coordinates]
        return np.column_stack([low, high])
