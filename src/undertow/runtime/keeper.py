"""A keeper between controller and rig: a process of its own that outlives the controller.

The rig lives in the keeper.  When the controller falls silent, or is killed, the keeper
brings the output to zero within its slew rate and lets go: the safe stop that a dead
process cannot make.  It has a session of its own, which the signals of a terminal
(Ctrl-C, Ctrl-Z, a lost connection) do not reach.
"""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from undertow.errors import ArtefactError
from undertow.mechanism import FloatArray
from undertow.rig.interface import Measurement, Rig
from undertow.runtime.clock import prompt
from undertow.runtime.processes import fork, pipe, withdraw
from undertow.runtime.steps import confine

__all__ = ["KeptRig"]

#: Outputs that wait for the keeper at most.
QUEUE = 100

SILENT = "the keeper does not answer"

#: How long a rig that takes no output is asked again to take zero, s.
INSISTENCE = 1.0


class _Reply(NamedTuple):
    """What the keeper says after an output: the reading, and what failed, in words."""

    measurement: Measurement | None
    read: str
    write: str


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

    Raises
    ------
    ArtefactError
        When the rig cannot be made.
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
        try:
            self._said: _Reply = self._pipe.recv()
        except EOFError as error:
            raise ArtefactError(
                "rig of a keeper",
                value="it could not be made",
                limit="a rig that can be read",
                remedy="The keeper's own error is printed above",
            ) from error
        self._unanswered = 0

    def read(self) -> Measurement:
        """Return the measurement that the keeper took after the last output.

        Raises
        ------
        TimeoutError
            When the keeper does not answer within half a period.
        EOFError
            When it is gone.
        OSError
            When the rig could not be read.
        """
        if self._unanswered:
            if not self._pipe.poll(0.5 * self.period):
                raise TimeoutError(SILENT)
            while self._pipe.poll(0.0):  # late answers too: the newest counts
                self._said = self._pipe.recv()
            self._unanswered = 0
        if self._said.measurement is None:
            raise OSError(self._said.read)
        return self._said.measurement

    def write(self, u: FloatArray) -> None:
        """Hand the output to the keeper.

        Raises
        ------
        OSError
            When the keeper is gone, or the rig did not take the output before.
        TimeoutError
            When so much is unanswered that to send more could block.
        """
        if self._unanswered >= QUEUE:
            raise TimeoutError(SILENT)
        self._pipe.send(u)
        self._unanswered += 1
        if self._said.write:
            raise OSError(self._said.write)

    def close(self) -> None:
        """Let the keeper bring the output to zero and let go."""
        with contextlib.suppress(OSError):
            self._pipe.send(None)
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
    withdraw()
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
    """Return what was done: when an output last came, when it was zero, the largest, the last."""
    u, zero, largest = np.zeros_like(limits), np.zeros_like(limits), 0.0
    heard = at_zero = time.perf_counter()
    failure, gone = "", False
    _reply(ours, rig, failure)
    while not gone or u.any() or (failure and time.perf_counter() < heard + INSISTENCE):
        wanted = None
        try:
            if gone:
                time.sleep(period)
            elif ours.poll(period if u.any() or failure else silence):
                wanted = ours.recv()
                while wanted is not None and ours.poll(0.0):
                    wanted = ours.recv()  # after a stall outputs have queued: the newest counts
                gone = wanted is None
        except (EOFError, OSError):
            gone = True
        now = time.perf_counter()
        if wanted is not None:
            heard = now
            confine(wanted, u, limits, slew)
        elif (u.any() or failure) and (gone or now - heard > silence):
            confine(zero, u, limits, slew)
        else:
            continue
        largest = max(largest, float(np.max(np.abs(u))))
        failure = _attempt(rig, u)
        if not u.any() and not failure:
            at_zero = time.perf_counter()
        if wanted is not None:
            _reply(ours, rig, failure)
    with contextlib.suppress(Exception):  # a rig that failed may fail again
        rig.close()
    facts: dict[str, object] = {"heard": heard, "zero": at_zero, "largest": largest}
    return {**facts, "u": u.tolist(), "failure": failure}


def _attempt(rig: Rig, u: FloatArray) -> str:
    """Write to the rig; return what failed, in words."""
    try:
        rig.write(u.copy())
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def _reply(ours: Connection, rig: Rig, failure: str) -> None:
    """Read the rig, and tell the controller."""
    try:
        reply = _Reply(rig.read(), "", failure)
    except Exception as error:
        reply = _Reply(None, f"{type(error).__name__}: {error}", failure)
    with contextlib.suppress(OSError):
        ours.send(reply)
