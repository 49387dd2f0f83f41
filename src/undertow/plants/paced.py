"""Hardware at its own pace, for what asks a rig step by step and keeps no clock."""

from __future__ import annotations

import time

from undertow.models import FloatArray
from undertow.plants.interface import Measurement, Rig

__all__ = ["Paced"]


class Paced:
    """A rig whose steps come one period of the wall clock apart.

    A simulated rig advances when it is written to, hardware by itself: here each
    :meth:`write` waits until the next reading is due.  After a late one the pace starts anew.

    Parameters
    ----------
    rig
        The driver.

    Examples
    --------
    >>> import undertow as ut
    >>> from undertow.plants import IdealRig
    >>> rig = Paced(IdealRig(ut.mechanisms.rotary_pendulum()))
    >>> rig.write([0.0])
    >>> rig.read().t
    0.001
    """

    def __init__(self, rig: Rig) -> None:
        self.rig, self.period = rig, rig.period
        self._due = time.perf_counter()

    def read(self) -> Measurement:
        """Return the present measurement."""
        return self.rig.read()

    def write(self, u: FloatArray) -> None:
        """Apply the inputs u, (m,), and wait until the next reading is due."""
        self.rig.write(u)
        self._due += self.period
        rest = self._due - time.perf_counter()
        if rest > 0:
            time.sleep(rest)
        else:
            self._due -= rest

    def close(self) -> None:
        """Let go of the rig."""
        self.rig.close()
