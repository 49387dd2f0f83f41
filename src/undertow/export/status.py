"""What an exported controller says of a period and of an offered plan."""

from __future__ import annotations

from enum import IntEnum, IntFlag

__all__ = ["LARGEST", "STALE_SPAN", "Status", "Verdict"]

#: A measurement beyond is no number either.
LARGEST = 1e9

#: So many numbers up to the last accepted plan's are stale; every other one is a later one's, so
#: that none locks out the next. Numbers count modulo 2³².
STALE_SPAN = 2**16


class Status(IntFlag):
    """What happened in a period; the bits that the C returns."""

    OK = 0
    CLIPPED = 1
    SLEWED = 2
    BRIDGED = 4
    LOST = 8
    SINGULAR = 16
    SWITCHED = 32
    FAULT = 64
    FALLBACK = 128


class Verdict(IntEnum):
    """Answer to an offered plan."""

    ACCEPTED = 0
    BUSY = 1
    STALE = 2
    INVALID = 3
    CORRUPT = 4
