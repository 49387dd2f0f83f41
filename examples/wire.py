"""The little protocol that the example drivers and their emulated device speak.

A command is one line, ``u <number>``; the answer is one line, ``q <t> <count> <count>``: the
device's clock in seconds and two encoder counts.  A real device would do the same in a few
lines of C.
"""

from __future__ import annotations

import math

import numpy as np

from undertow.rig import Measurement, RealisticRig

#: Counts per turn of both encoders.
COUNTS = 4096


def command(u: float) -> bytes:
    """Return the line that asks for an input and a measurement."""
    return f"u {u:.6f}\n".encode()


def parse(line: bytes) -> Measurement:
    """Return the measurement in an answer; what cannot be read is a lost reading, NaN."""
    try:
        _, t, *counts = line.decode().split()
        q = 2 * math.pi / COUNTS * np.array([int(c) for c in counts], dtype=float)
        return Measurement(float(t), q)
    except (UnicodeDecodeError, ValueError):
        return Measurement(math.nan, np.full(2, math.nan))


class Device:
    """The other end: a simulated bench that answers each command."""

    def __init__(self, rig: RealisticRig) -> None:
        self.rig = rig

    def answer(self, line: bytes) -> bytes:
        """Apply the input of a command, advance by one period, report; 0 if it is unreadable."""
        try:
            u = float(line.decode().split()[1])
        except (UnicodeDecodeError, ValueError, IndexError):
            u = 0.0
        self.rig.write([u if math.isfinite(u) else 0.0])
        now = self.rig.read()
        counts = np.floor(now.q / (2 * math.pi / COUNTS) + 0.5).astype(int)
        return f"q {now.t:.6f} {' '.join(map(str, counts))}\n".encode()
