"""The little protocol that the example drivers and their emulated device speak.

A command is one line, ``u <number> <volt>``; the answer is one line, ``q <number> <t> <count>
<count>``: the number of the command, the device's clock in seconds and two encoder counts.  A
number tells an answer that is late from one that is lost.  A real device would do the same in
a few lines of C, and switch its motor off when no command has come for 20 ms.
"""

from __future__ import annotations

import math

import numpy as np

from undertow.plants import Measurement, RealisticRig

#: Counts per turn of both encoders.
COUNTS = 4096

#: A reading that was lost.
LOST = Measurement(math.nan, np.full(2, math.nan))


def command(number: int, u: float) -> bytes:
    """Return the line that asks for an input and a measurement."""
    return f"u {number} {u:.6f}\n".encode()


def parse(line: bytes) -> tuple[int, Measurement]:
    """Return the number of an answer and its measurement; -1 for what cannot be read."""
    try:
        letter, number, t, *counts = line.decode().split()
        q = 2 * math.pi / COUNTS * np.array([int(c) for c in counts], dtype=float)
        if letter == "q" and q.shape == (2,):
            return int(number), Measurement(float(t), q)
    except ValueError:  # a letter that is none, a word that is no number, too few of them
        pass
    return -1, LOST


class Device:
    """The other end: a simulated bench that answers each command."""

    def __init__(self, rig: RealisticRig) -> None:
        self.rig = rig

    def answer(self, line: bytes) -> bytes:
        """Apply the input of a command, advance by one period, report; 0 V if unreadable."""
        number, u = "-1", 0.0
        try:
            _, number, volt = line.decode().split()
            u = float(volt)
        except ValueError:
            pass
        self.rig.write([u if math.isfinite(u) else 0.0])
        now = self.rig.read()
        counts = np.floor(now.q / (2 * math.pi / COUNTS) + 0.5).astype(int)
        return f"q {number} {now.t:.6f} {' '.join(map(str, counts))}\n".encode()
