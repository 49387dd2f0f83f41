"""A supervisor between controller and rig: a process of its own that outlives the controller.

The rig lives in the supervisor.  When the controller falls silent, or is killed, the supervisor
brings the output to zero within its slew rate and lets go: the safe stop that a dead
process cannot make.  A rig that does not take zero is asked again for a while, and what came
of that is the last thing that it says.  It has a session of its own, which the signals of a
terminal (Ctrl-C, Ctrl-Z, a lost connection) do not reach.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from undertow.base import ArtefactError, UndertowError, error_text, errors
from undertow.models import FloatArray
from undertow.plants import Measurement, OutputOnError, Rig
from undertow.runtime.clock import real_time_priority
from undertow.runtime.processes import STOPPING, fork, pipe
from undertow.runtime.steps import limit_output

#: Outputs that wait for the supervisor at most.
QUEUE = 100

SILENT = "the supervisor does not answer (a read or write of the rig may take too long)"

#: How long a rig that takes no output is asked again to take zero, s; and how long the
#: supervisor is waited for besides.
ZERO_TIMEOUT, CLOSE_TIMEOUT = 1.0, 2.0

#: Said while the rig is being closed, which may take for ever.
CLOSING = "close: it does not come to an end"

#: Asks for a new reading without an output; and how long that is waited for, s.
AGAIN, ANSWER = "read", 0.05


class _Reply(NamedTuple):
    """What the supervisor says after an output: the reading, and what failed, in words."""

    measurement: Measurement | None
    read: str
    write: str


class _Farewell(NamedTuple):
    """The last that the supervisor says: why the output is not at zero, and why closing failed."""

    output: str
    close: str


class SupervisedRig:
    """A rig that is kept by another process.

    It calls ``make`` in the supervisor, so what that needs should be compiled already. ``limits``
    are the largest |u| and ``slew`` the largest change in one period, (m,). After
    ``controller_timeout``, s, without an output the supervisor takes over; once it has let go it
    writes what it did to the file ``record``, as JSON.

    Raises what was raised in the supervisor when the rig cannot be made, an UndertowError.
    """

    def __init__(
        self,
        make: Callable[[], Rig],
        period: float,
        limits: FloatArray,
        slew: FloatArray,
        *,
        controller_timeout: float = 0.02,
        record: Path | None = None,
    ) -> None:
        self.period = period
        limit_output(np.zeros_like(limits), np.zeros_like(limits), limits, slew)  # compiled by now
        self._pipe, theirs = pipe()
        try:
            try:
                self.process = fork(
                    _supervise,
                    (make, theirs, self._pipe, record, period, limits, slew, controller_timeout),
                    "undertow supervisor",
                    daemon=False,
                    ignores=STOPPING,
                )
            finally:
                theirs.close()
            said = self._first()
        except BaseException:
            self._pipe.close()  # then the supervisor lets go
            raise
        self._said, self._closed, self._heard = said, False, time.perf_counter()
        self._unanswered = 0
        self._way = period * float(np.max(np.where(np.isfinite(limits), limits / slew, 0.0)))

    def _first(self) -> _Reply:
        try:
            said: _Reply | UndertowError = self._pipe.recv()
        except EOFError as error:
            raise ArtefactError(
                "rig of a supervisor",
                value="its process ended",
                limit="a rig that can be read",
                remedy="The supervisor's own error is printed above",
            ) from error
        if isinstance(said, UndertowError):
            raise said
        return said

    def read(self) -> Measurement:
        """Return the measurement that the supervisor took after the last output.

        After a while without outputs, as before a run, it takes a new one.

        Raises
        ------
        TimeoutError
            When the supervisor does not answer within half a period, or 50 ms for a new one.
        EOFError
            When it is gone.
        OSError
            When the rig could not be read.
        """
        patience = 0.5 * self.period
        if not self._unanswered and time.perf_counter() - self._heard > ANSWER:
            self._pipe.send(AGAIN)
            self._unanswered, patience = 1, ANSWER
        if self._unanswered:
            if not self._pipe.poll(patience):
                raise TimeoutError(SILENT)
            self._listen()  # to late answers too
        if self._said.measurement is None:
            raise _told(self._said.read)
        return self._said.measurement

    def write(self, u: FloatArray) -> None:
        """Hand the output to the supervisor.

        Raises
        ------
        OSError
            When the supervisor is gone, or the rig did not take the output before.
        TimeoutError
            When so much is unanswered that to send more could block.
        """
        if self._said.write:
            self._listen()  # who only writes, as after a safe stop, is told what came of it
        if self._unanswered >= QUEUE:
            raise TimeoutError(SILENT)
        self._pipe.send(u)
        self._unanswered += 1
        if self._said.write:
            raise _told(self._said.write)

    def _listen(self) -> None:
        """Take what the supervisor has said by now: the newest counts."""
        while self._pipe.poll(0.0):
            self._said = self._pipe.recv()
            self._unanswered, self._heard = 0, time.perf_counter()

    def close(self) -> None:
        """Let the supervisor bring the output to zero and let go.

        Raises
        ------
        OutputOnError
            When the rig did not take zero, or the supervisor does not say whether it did.
        OSError
            When the rig took it, but could not be closed.  A supervisor whose rig hangs is ended.
        """
        if self._closed:
            return
        self._closed = True
        last = _Farewell(f"{SILENT}: whether the output is at zero is not known", "")
        until = time.perf_counter() + ZERO_TIMEOUT + CLOSE_TIMEOUT + self._way
        with contextlib.suppress(OSError, EOFError):
            self._pipe.send(None)
            while self._pipe.poll(max(0.0, until - time.perf_counter())):
                if isinstance(said := self._pipe.recv(), _Farewell):
                    last = said
                    if last.close != CLOSING:
                        break
        with contextlib.suppress(OSError):
            self._pipe.close()
        self.process.join(timeout=1.0)
        if self.process.is_alive():  # its driver hangs: it would keep us, and the device, for ever
            self.process.kill()
        if last.output:
            raise _told(last.output, OutputOnError)
        if last.close:
            raise _told(last.close)


def _supervise(
    make: Callable[[], Rig], ours: Connection, theirs: Connection, record: Path | None, *bounds: Any
) -> None:
    """Apply what comes; once nothing comes, bring the output to zero, see :func:`_apply`."""
    theirs.close()
    with real_time_priority():  # also for the threads of a driver
        try:
            rig = make()
        except Exception as error:  # a driver may do anything
            ours.send(_refusal(error))
            return
        facts = _apply(rig, ours, *bounds)
    if record is not None:
        record.write_text(json.dumps(facts))


def _refusal(error: Exception) -> UndertowError:
    """Return why a rig could not be made, as a condition that the other process knows."""
    if isinstance(error, UndertowError) and hasattr(errors, type(error).__name__):
        return error
    return ArtefactError(
        "rig of a supervisor", value=error_text(error), limit="a rig that can be made and read"
    )


def _apply(
    rig: Rig,
    ours: Connection,
    period: float,
    limits: FloatArray,
    slew: FloatArray,
    controller_timeout: float,
) -> dict[str, object]:
    """Return what was done: when an output last came, when it was zero, the largest, the last."""
    u, zero, largest = np.zeros_like(limits), np.zeros_like(limits), 0.0
    heard = at_zero = time.perf_counter()
    failure, gone = "", False
    _reply(ours, rig, failure)
    while not gone or u.any() or (failure and time.perf_counter() < heard + ZERO_TIMEOUT):
        wanted = None
        try:
            if gone:
                time.sleep(period)
            elif ours.poll(period if u.any() or failure else controller_timeout):
                wanted = ours.recv()
                while wanted is not None and ours.poll(0.0):
                    wanted = ours.recv()  # after a stall outputs have queued: the newest counts
                gone = wanted is None
        except Exception:  # the other end is gone, or what came cannot be read
            gone = True
        now = time.perf_counter()
        if isinstance(wanted, str):
            _reply(ours, rig, failure)
            continue
        if wanted is not None:
            heard = now
            limit_output(wanted, u, limits, slew)
        elif (u.any() or failure) and (gone or now - heard > controller_timeout):
            limit_output(zero, u, limits, slew)
        else:
            continue
        largest = max(largest, float(np.max(np.abs(u))))
        failure = _attempt(rig, u)
        if not u.any() and not failure:
            at_zero = time.perf_counter()
        if wanted is not None:
            _reply(ours, rig, failure)
    output = "" if not failure else f"the device did not take an output of zero: {failure}"
    close = ""
    with contextlib.suppress(OSError):
        ours.send(_Farewell(output, CLOSING))
    try:
        rig.close()
    except BaseException as error:  # a rig that failed may fail again
        close = f"close: {error_text(error)}"
        output = output or (close if isinstance(error, OutputOnError) else "")
    with contextlib.suppress(OSError):
        ours.send(_Farewell(output, close))
    facts: dict[str, object] = {"heard": heard, "zero": at_zero, "largest": largest}
    return {**facts, "u": u.tolist(), "failure": failure, "close": close}


def _told(words: str, kind: type[OSError] = OSError) -> OSError:
    """Return what failed in the supervisor as an error: who shows it names its kind, and when."""
    return kind(words.removeprefix("close: ").removeprefix(f"{kind.__name__}: "))


def _attempt(rig: Rig, u: FloatArray) -> str:
    """Write to the rig; return what failed, in words."""
    try:
        rig.write(u.copy())
    except BaseException as error:  # a driver may do anything; the supervisor stays
        return error_text(error)
    return ""


def _reply(ours: Connection, rig: Rig, failure: str) -> None:
    """Read the rig, and tell the controller."""
    try:
        reply = _Reply(rig.read(), "", failure)
    except BaseException as error:
        reply = _Reply(None, error_text(error), failure)
    with contextlib.suppress(Exception):  # who listens no more is found out by what comes
        ours.send(reply)
