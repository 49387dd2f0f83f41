"""A keeper between controller and rig: a process of its own that outlives the controller.

The rig lives in the keeper.  When the controller falls silent, or is killed, the keeper
brings the output to zero within its slew rate and lets go: the safe stop that a dead
process cannot make.
"""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from undertow.mechanism import FloatArray
from undertow.rig.interface import Measurement, Rig
from undertow.runtime.clock import prompt
from undertow.runtime.processes import fork, pipe
from undertow.runtime.steps import confine

__all__ = ["KeptRig"]


class KeptRig:
    """A rig that is kept by another process.

    Parameters
    ----------
    make
        Makes the rig, in the keeper.  What it needs should be compiled already.
    limits, slew
        Largest |u|, and largest change in one period, (m,).
    silence
        Time without an output after which the keeper takes over, s.
    record
        File for what the keeper did, as JSON, once it has let go.
    """

    def __init__(
        self,
        make: Callable[[], Rig],
        period: float,
        limits: FloatArray,
        slew: FloatArray,
        *,
        silence: float = 0.02,
        record: Path | None = None,
    ) -> None:
        self.period = period
        confine(np.zeros_like(limits), np.zeros_like(limits), limits, slew)  # compiled by now
        self._pipe, theirs = pipe()
        self.process = fork(
            _keep,
            (make, theirs, self._pipe, period, limits, slew, silence, record),
            "undertow keeper",
            daemon=False,
        )
        theirs.close()
        self._last: Measurement = self._pipe.recv()
        self._asked = 0

    def read(self) -> Measurement:
        """Return the measurement that the keeper took after the last output.

        Raises
        ------
        TimeoutError
            When the keeper does not answer within half a period.
        EOFError
            When it is gone.
        """
        if self._asked:
            if not self._pipe.poll(0.5 * self.period):
                message = "the keeper does not answer"
                raise TimeoutError(message)
            while self._asked and self._pipe.poll(0.0):  # late answers too: the newest counts
                self._last = self._pipe.recv()
                self._asked -= 1
        return self._last

    def write(self, u: FloatArray) -> None:
        """Hand the output to the keeper."""
        self._pipe.send(u)
        self._asked += 1

    def close(self) -> None:
        """Let the keeper bring the output to zero and let go."""
        with contextlib.suppress(OSError):
            self._pipe.close()
        self.process.join(timeout=1.0)


def _keep(
    make: Callable[[], Rig],
    ours: Connection,
    theirs: Connection,
    period: float,
    limits: FloatArray,
    slew: FloatArray,
    silence: float,
    record: Path | None,
) -> None:
    """Apply what comes; once nothing comes, bring the output to zero."""
    theirs.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    with prompt():
        facts = _hold(make(), ours, period, limits, slew, silence)
    if record is not None:
        record.write_text(json.dumps(facts))


def _hold(
    rig: Rig,
    ours: Connection,
    period: float,
    limits: FloatArray,
    slew: FloatArray,
    silence: float,
) -> dict[str, object]:
    u, zero, largest = np.zeros_like(limits), np.zeros_like(limits), 0.0
    heard = at_zero = time.perf_counter()
    gone = False
    with contextlib.suppress(OSError):
        ours.send(rig.read())
    while not gone or u.any():
        wanted = None
        try:
            if gone:
                time.sleep(period)
            elif ours.poll(period if u.any() else silence):
                wanted = ours.recv()
        except (EOFError, OSError):
            gone = True
        now = time.perf_counter()
        if wanted is not None:
            heard = now
            confine(wanted, u, limits, slew)
        elif u.any() and (gone or now - heard > silence):
            confine(zero, u, limits, slew)
        else:
            continue
        largest = max(largest, float(np.max(np.abs(u))))
        rig.write(u)
        if not u.any():
            at_zero = time.perf_counter()
        if wanted is not None:
            with contextlib.suppress(OSError):
                ours.send(rig.read())
    rig.close()
    return {"heard": heard, "zero": at_zero, "largest": largest, "u": u.tolist()}
