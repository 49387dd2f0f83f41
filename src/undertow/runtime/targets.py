"""Targets for a run that goes on: checked, and told from another process.

A run with a log listens on a port of this machine's own, 127.0.0.1.  A file beside the log,
``run.db-address``, which nobody else may read, has the port and a token; who sends the token may
ask for a target, or where it is.  A thread listens, checks what comes, and leaves it where the fast
loop finds it: the loop waits for nobody.  Each side says one line of JSON.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from undertow.base import (
    ArtefactError,
    InvalidInputError,
    UndertowError,
    checked,
    error_text,
    parse_json,
    read_file,
)
from undertow.cascade import Legs, legs_of
from undertow.law import SetPoints, Target
from undertow.models import FloatArray, Mechanism, invariant_coordinates
from undertow.objective import Objective
from undertow.runtime.processes import Background
from undertow.runtime.settings import Settings

#: Largest line that is said, bytes; how long one may take, s; and how long an answer is waited
#: for: another who asked, and said nothing, may have been before.
MOST_BYTES, LINE_TIMEOUT, ANSWER_TIMEOUT = 1 << 16, 2.0, 6.0

#: Pause after each who asked, and after one who had no token, s: nobody keeps the loop busy.
PAUSE, PENALTY = 0.02, 0.2

#: How often the thread looks whether the run is over, s.
LOOK = 0.25

#: Most set-points that are asked for at once, and longest text of what is said, characters.
MOST_POINTS, MOST_TEXT = 1000, 500


@dataclass(frozen=True)
class RunTarget:
    """Where a run that goes on is steered.

    ``units``: of the coordinates along which the target may be, by name: ``m`` or ``rad``. ``t``:
    time of the run, s. ``now``: where the target is, coordinate to position; empty at x = 0.
    ``ahead``: what was asked for and is not reached yet: from which time of the run on, s, and
    where; the target jumps as soon as there is a plan for it. ``said``: what was last said of the
    target in the run.
    """

    mechanism: str
    units: Mapping[str, str]
    t: float
    now: Mapping[str, float]
    ahead: tuple[tuple[float, Mapping[str, float]], ...] = ()
    said: str = field(default="", compare=False)


class Steered(Protocol):
    """A run whose target may be asked for: a :class:`undertow.runtime.Runtime`."""

    def retarget(self, target: SetPoints) -> RunTarget:
        """Ask for another target."""
        ...

    @property
    def target(self) -> RunTarget:
        """Where it is steered."""
        ...


def checked_legs(
    mechanism: Mechanism, objective: Objective, settings: Settings, goal: Target,
    seconds: float = 0.0,
) -> Legs:  # fmt: skip
    """Return when the target jumps, s, and where to, the first at 0; see :func:`legs_of`.

    A reference is followed for so many seconds. Raises InvalidInputError for what the mechanism
    cannot rest at, for what the constraints exclude, and for positions past the travel at which a
    run stops.
    """
    legs = legs_of(mechanism, objective, goal, max(seconds, 1e-3))
    low, high = settings.travels(mechanism).T
    for begin, motion in legs:
        for k, i in np.argwhere(~((low < motion.q) & (motion.q < high)))[:1].tolist():
            name, unit = mechanism.coordinates[i].name, mechanism.coordinates[i].unit
            raise InvalidInputError(
                f"target of '{mechanism.name}' at {begin + motion.t[k]:g} s",
                value=f"{name} = {motion.q[k, i]:.4g} {unit}",
                limit=f"between {low[i]:g} and {high[i]:g} {unit}, where a run stops",
                remedy="Choose a target further inside, or a larger Settings(max_travel=...), "
                "--travel of undertow run",
            )
    return legs


def legs_from_here(
    mechanism: Mechanism, objective: Objective, settings: Settings, here: FloatArray,
    goal: SetPoints,
) -> Legs:  # fmt: skip
    """Return the legs of a target that is asked for while it is at the positions ``here``, (n,).

    Coordinates that the first set-point does not name stay there.
    """
    if len(goal.pairs) > MOST_POINTS:
        raise InvalidInputError(
            "set-points that are asked for at once",
            value=len(goal.pairs),
            limit=f"at most {MOST_POINTS}",
            remedy="Ask for the later ones later",
        )
    (begin, point), *rest = goal.pairs
    whole = SetPoints([(begin, {**named_positions(mechanism, here), **point}), *rest])
    legs = checked_legs(mechanism, objective, settings, whole)
    return legs[1:] if begin > 0 else legs


def named_positions(mechanism: Mechanism, q: FloatArray) -> dict[str, float]:
    """Return where a target is that is not at 0, by the names of what it may be moved along."""
    pairs, free = zip(mechanism.coordinates, q, strict=True), invariant_coordinates(mechanism)
    return {c.name: float(value) for c, value in pairs if value and c.name in free}


# -- from another process --------------------------------------------------------------------


def address_path(log: Path) -> Path:
    """Return the file that says where a run with this log listens."""
    return Path(f"{log}-address")


class Listener:
    """Takes targets for a run from other processes, until it is closed.

    The address is written beside the log. ``failure``: why it does not listen; empty while it does.
    Raises ResourceError when the system has no thread for it.
    """

    def __init__(self, run: Steered, log: Path) -> None:
        self.run, self.path, self.failure = run, address_path(log), ""
        self._token, self._over = secrets.token_hex(16), threading.Event()
        self._door = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._door.bind(("127.0.0.1", 0))
            self._door.listen(4)
            self._door.settimeout(LOOK)
            self._say_where()
        except OSError as error:  # a run is not lost for that
            self._door.close()
            self.failure = error_text(error)
            return
        try:
            Background(self._listen, "undertow targets")
        except BaseException:
            self.close()
            raise

    def _say_where(self) -> None:
        """Write the address; one of a run that was killed is in nobody's way."""
        self.path.unlink(missing_ok=True)
        handle = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
        with open(handle, "w", encoding="ascii") as file:
            json.dump({"port": self._door.getsockname()[1], "token": self._token}, file)

    def close(self) -> None:
        """Listen no more."""
        self._over.set()
        if not self.failure:
            with contextlib.suppress(OSError):
                self.path.unlink(missing_ok=True)
        self._door.close()

    def _listen(self) -> None:
        while not self._over.is_set():
            try:
                visitor, _ = self._door.accept()
            except TimeoutError:
                continue
            except OSError:
                if self._over.wait(PENALTY):  # closed; or no descriptor for now
                    return
                continue
            known = False
            with visitor, contextlib.suppress(Exception):  # who goes away, and all that they say
                said = read_line(visitor, LINE_TIMEOUT)
                known, answer = self._answer(said)
                visitor.sendall(json.dumps(answer).encode() + b"\n")
            self._over.wait(PAUSE if known else PENALTY)

    def _answer(self, said: bytes) -> tuple[bool, dict[str, Any]]:
        """Return whether the token was right, and what is said to what was said."""
        try:
            asked = parse_json(said)
        except ValueError as error:
            return False, _told(InvalidInputError("line", value=str(error), limit="JSON"))
        token = asked.get("token") if isinstance(asked, dict) else None
        if not (
            isinstance(token, str) and hmac.compare_digest(token.encode(), self._token.encode())
        ):
            return False, _told(
                InvalidInputError("token", value="another one", limit=f"that of '{self.path.name}'")
            )
        try:
            points = asked.get("points")
            found = self.run.target if points is None else self.run.retarget(SetPoints(points))
        except UndertowError as error:
            return True, _told(error)
        except Exception as error:  # the thread goes on, whatever was asked for
            unknown = error_text(error)
            return True, _told(InvalidInputError("set-points", value=unknown))
        return True, {"target": asdict(found)}


def _told(error: UndertowError) -> dict[str, Any]:
    """Return an error as JSON values."""
    value, limit = (None if v is None else str(v)[:MOST_TEXT] for v in (error.value, error.limit))
    return {
        "error": {
            "what": error.what[:MOST_TEXT], "value": value, "limit": limit,
            "remedy": error.remedy[:MOST_TEXT],
        }
    }  # fmt: skip


def read_line(visitor: socket.socket, timeout: float) -> bytes:
    """Return a line that is said within so many s, without its end.

    Raises OSError for one that is too long, is not ended or comes too late.
    """
    until, line = time.monotonic() + timeout, b""
    while not line.endswith(b"\n"):
        visitor.settimeout(max(1e-3, until - time.monotonic()))
        part = visitor.recv(MOST_BYTES)
        line += part
        if not part or len(line) > MOST_BYTES or time.monotonic() > until:
            raise OSError("no line")
    return line[:-1]


@checked
def send_target(log: str | Path, target: Mapping[str, float] | SetPoints) -> RunTarget:
    """Ask a run that goes on, in whatever process of this machine, for another target.

    Parameters
    ----------
    log
        Its log.
    target
        Coordinates to positions, rad or m, or :class:`undertow.SetPoints` whose times count from
        now.  What was asked for before and is not reached is given up; coordinates that are not
        named stay where the target is.

    Returns
    -------
    RunTarget
        Where the run is steered from now on; the target jumps once there is a plan for it.

    Raises
    ------
    InvalidInputError
        With the run's own reason, for a target that cannot be one: nothing has changed then.
    ArtefactError
        When nobody listens there.
    """
    goal = target if isinstance(target, SetPoints) else SetPoints(target)
    return _asked(Path(log), {"points": goal.pairs})


@checked
def target_of_run(log: str | Path) -> RunTarget:
    """Return where a run that goes on is steered; see :func:`send_target`.

    Raises
    ------
    ArtefactError
        When nobody listens there.
    """
    return _asked(Path(log), {})


def _asked(log: Path, request: Mapping[str, object]) -> RunTarget:
    remedy = "Name the log of a run that goes on: undertow run ... --log run.db"
    path = address_path(log)

    def silent(value: str) -> ArtefactError:
        return ArtefactError(
            f"run of '{log}'", value=value, limit="one that listens", remedy=remedy
        )

    if not os.path.lexists(path):
        if not os.path.lexists(log):
            raise silent("no such log")
        raise silent("one that has ended, has not begun, or is in simulated time")
    try:
        address = parse_json(read_file(path, "address of a run", most=1 << 10))
        port, token = address["port"], address["token"]
        if not (type(port) is int and 0 < port < 1 << 16 and isinstance(token, str)):
            raise ValueError("no port and token")
    except (ValueError, LookupError, TypeError) as error:
        raise silent(f"'{path}' is no address: {error}") from error
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=LINE_TIMEOUT) as line:
            line.sendall(json.dumps({**request, "token": token}).encode() + b"\n")
            answer = parse_json(read_line(line, ANSWER_TIMEOUT))
    except (OSError, ValueError) as error:
        raise silent(f"no answer, {error}: it was killed, or is busy") from error
    return _understood(answer, silent)


def _understood(answer: Any, silent: Any) -> RunTarget:
    """Return what a run has answered; raise what it raised."""
    try:
        if "error" in answer:
            error = answer["error"]
            raise InvalidInputError(
                str(error["what"]), value=error["value"], limit=error["limit"],
                remedy=str(error["remedy"]),
            )  # fmt: skip
        target = answer["target"]
        ahead = tuple((float(t), dict(q)) for t, q in target.pop("ahead"))
        return RunTarget(**target, ahead=ahead)
    except InvalidInputError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise silent("an answer that is none") from error
