"""A rig that is wired wrongly, to see whether the wizard finds it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from undertow.errors import InvalidInputError
from undertow.mechanism import FloatArray, Mechanism
from undertow.rig.interface import Measurement, Rig

__all__ = ["Miswired", "miswired"]


class Miswired:
    """A rig with factors on its inputs and encoders, and a delay besides its own.

    Parameters
    ----------
    rig
        The rig.
    inputs, encoders
        Factors, (m,) and (n,): −1 is a swapped sign, 0 a cable that is off.
    delay
        Further delay of the inputs, s; whole periods.
    """

    def __init__(
        self,
        rig: Rig,
        inputs: Sequence[float] | FloatArray,
        encoders: Sequence[float] | FloatArray,
        delay: float = 0.0,
    ) -> None:
        self.rig, self.period = rig, rig.period
        self._inputs, self._encoders = np.asarray(inputs), np.asarray(encoders)
        late = round(delay / rig.period)
        self._queue = deque([np.zeros(len(self._inputs))] * late)

    def read(self) -> Measurement:
        """Return what the wrong wiring says."""
        measured = self.rig.read()
        v = None if measured.v is None else measured.v * self._encoders
        return Measurement(measured.t, measured.q * self._encoders, v)

    def write(self, u: FloatArray) -> None:
        """Write what the wrong wiring lets through."""
        self._queue.append(np.asarray(u) * self._inputs)
        self.rig.write(self._queue.popleft())

    def close(self) -> None:
        """Let go of the rig."""
        self.rig.close()


def miswired(rig: Rig, mechanism: Mechanism, faults: Sequence[str]) -> Rig:
    """Return a rig with faults given in words, ``part=value``.

    Parameters
    ----------
    faults
        ``voltage=-1`` (factor of an input), ``theta=2`` (factor of an encoder; 0: cable off),
        ``delay=0.0015`` (s, besides the rig's own).

    Raises
    ------
    InvalidInputError
        For a part that the mechanism does not have, or what is no number.
    """
    if not faults:
        return rig
    factors = {i.name: 1.0 for i in mechanism.inputs} | {c.name: 1.0 for c in mechanism.coordinates}
    factors["delay"] = 0.0
    for word in faults:
        part, _, value = word.partition("=")
        try:
            factors[part] = float(value) if part in factors else np.nan
        except ValueError:
            factors[part] = np.nan
        if not np.isfinite(factors[part]):
            raise InvalidInputError(
                "fault",
                value=repr(word),
                limit=f"part=number, the part one of {', '.join(f for f in factors if f != part)}",
                remedy="Write for instance --fault theta=-1",
            )
    return Miswired(
        rig,
        [factors[i.name] for i in mechanism.inputs],
        [factors[c.name] for c in mechanism.coordinates],
        factors["delay"],
    )
