"""The states of a run and the guarded transitions between them."""

from __future__ import annotations

from enum import IntEnum

from undertow.symbolic import brief


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
    """What the operator asks for; ``END``: the time that was asked for is over."""

    NONE = 0
    START = 1
    STOP = 2
    RESET = 3
    END = 4


class Reason(IntEnum):
    """Why the state has changed; ``text`` says it, but what a ``FAULT`` is knows the caller."""

    NONE = 0
    START = 1
    STOP = 2
    RESET = 3
    FAULT = 4
    INSIDE = 5
    OUTSIDE = 6
    THROWN_OUT = 7
    SETTLED = 8
    DISTURBED = 9
    END = 10

    @property
    def text(self) -> str:
        """The reason in words."""
        return _WORDS[self]


_WORDS = (
    "", "operator: start", "operator: stop", "operator: reset", "fault",
    "inside the region of the law", "outside the region of the law", "thrown out", "settled",
    "disturbed", "end of the time asked for",
)  # fmt: skip

# Compiled code knows them as numbers.
_IDLE, _BRING_UP, _SWING_UP, _CATCH, _BALANCE, _SAFE_STOP = map(int, Mode)
_NO_COMMAND, _START, _STOP, _RESET, _END = map(int, Command)
(
    _STAY, _BY_START, _BY_STOP, _BY_RESET, _FAULT, _INSIDE, _OUTSIDE, _THROWN, _SETTLED, _DISTURBED,
    _BY_END,
) = map(int, Reason)  # fmt: skip


@brief()
def transition(
    mode: int,
    command: int,
    fault: bool,
    ready: bool,
    inside: bool,
    lost: bool,
    settled: bool,
    swings: bool,
) -> tuple[int, int]:
    """Return the next state and the reason for a change, as numbers; the same state if none.

    Faults come before everything, and nothing but the operator leads out of a safe stop.

    ``mode`` and ``command`` are the present :class:`Mode` and the operator's :class:`Command`.
    ``fault``: the run cannot go on; ``ready``: the sensors have been sound for long enough;
    ``inside``, ``lost``: the state is where the law may take over, and where it cannot hold it;
    ``settled``: it is close to the target; ``swings``: there is a swing-up.

    Examples
    --------
    >>> transition(Mode.IDLE.value, Command.START.value, *[False] * 6)
    (1, 1)
    >>> transition(Mode.SAFE_STOP.value, Command.NONE.value, *[True] * 6)
    (5, 0)
    """
    if mode == _SAFE_STOP:
        if command == _RESET and not fault:
            return _IDLE, _BY_RESET
        return mode, _STAY
    if command == _STOP:
        return _SAFE_STOP, _BY_STOP
    if command == _END:
        return _SAFE_STOP, _BY_END
    if mode == _IDLE:
        if command == _START:
            return _BRING_UP, _BY_START
        return mode, _STAY
    if fault:
        return _SAFE_STOP, _FAULT
    if mode == _BRING_UP and ready:
        if inside:
            return _CATCH, _INSIDE
        if swings:
            return _SWING_UP, _OUTSIDE
    if mode == _SWING_UP and inside:
        return _CATCH, _INSIDE
    if mode in (_CATCH, _BALANCE) and lost:
        return (_SWING_UP if swings else _SAFE_STOP), _THROWN
    if mode == _CATCH and settled:
        return _BALANCE, _SETTLED
    if mode == _BALANCE and not settled:
        return _CATCH, _DISTURBED
    return mode, _STAY
