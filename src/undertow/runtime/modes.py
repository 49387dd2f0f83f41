"""The states of a run and the guarded transitions between them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

__all__ = ["Command", "Mode", "Signs", "successor"]


class Mode(IntEnum):
    """What the fast loop is doing.

    ``IDLE`` nothing, output zero; ``BRING_UP`` watching the sensors settle, output zero;
    ``SWING_UP`` bringing the mechanism near its target; ``CATCH`` under the sliding-mode law,
    not settled yet; ``BALANCE`` under the law and settled; ``SAFE_STOP`` output brought to
    zero within the slew rate and kept there until the operator resets.
    """

    IDLE = 0
    BRING_UP = 1
    SWING_UP = 2
    CATCH = 3
    BALANCE = 4
    SAFE_STOP = 5


class Command(IntEnum):
    """What the operator asks for."""

    NONE = 0
    START = 1
    STOP = 2
    RESET = 3


@dataclass(slots=True)
class Signs:
    """What the guards look at.

    Attributes
    ----------
    command
        The operator's wish.
    fault
        Why the run cannot go on; empty when it can.
    ready
        The sensors have been sound for long enough.
    inside
        The state is where the law may take over.
    lost
        The state is where the law cannot hold it.
    settled
        The state is close to the target.
    swings
        There is a swing-up.
    """

    command: Command = Command.NONE
    fault: str = ""
    ready: bool = False
    inside: bool = False
    lost: bool = False
    settled: bool = False
    swings: bool = False


def successor(mode: Mode, signs: Signs) -> tuple[Mode, str]:
    """Return the next state and the reason for a change; the same state with ``""`` if none.

    Faults come before everything, and nothing but the operator leads out of a safe stop.

    Examples
    --------
    >>> successor(Mode.IDLE, Signs(command=Command.START))
    (<Mode.BRING_UP: 1>, 'operator: start')
    >>> successor(Mode.SAFE_STOP, Signs(ready=True, inside=True))
    (<Mode.SAFE_STOP: 5>, '')
    """
    if mode == Mode.SAFE_STOP:
        reset = signs.command == Command.RESET and not signs.fault
        return (Mode.IDLE, "operator: reset") if reset else (mode, "")
    if signs.command == Command.STOP:
        return Mode.SAFE_STOP, "operator: stop"
    if mode == Mode.IDLE:
        start = signs.command == Command.START
        return (Mode.BRING_UP, "operator: start") if start else (mode, "")
    if signs.fault:
        return Mode.SAFE_STOP, signs.fault
    if mode == Mode.BRING_UP and signs.ready:
        if signs.inside:
            return Mode.CATCH, "inside the region of the law"
        if signs.swings:
            return Mode.SWING_UP, "outside the region of the law"
    if mode == Mode.SWING_UP and signs.inside:
        return Mode.CATCH, "inside the region of the law"
    if mode in (Mode.CATCH, Mode.BALANCE) and signs.lost:
        return (Mode.SWING_UP if signs.swings else Mode.SAFE_STOP), "thrown out"
    if mode == Mode.CATCH and signs.settled:
        return Mode.BALANCE, "settled"
    if mode == Mode.BALANCE and not signs.settled:
        return Mode.CATCH, "disturbed"
    return mode, ""
