"""A driver for a data acquisition card with encoders and an analogue output, as Quanser's are.

Copy this file; change ``ENCODERS``, ``OUTPUT`` and ``open_card`` to your wiring. Here there is no
such card: ``SimulatedCard`` has those functions of Quanser's ``quanser.hardware.HIL`` that the
driver calls, and a simulated bench behind them. Balanced on it, as fast as it goes, and with the
optimiser, watchdog and log of the runtime:

    python examples/quanser_rig.py
    undertow run rotary_pendulum --rig examples/quanser_rig.py:simulated --start phi=20deg

Then on the card: with the pendulum hanging at rest

    python examples/quanser_rig.py --zero       # the counters begin here
    python examples/quanser_rig.py --watch      # no output: move by hand, see that signs are right
    undertow run rotary_pendulum --rig examples/quanser_rig.py:connected
"""
# ruff: noqa: D102  # the card's functions are described by its maker

from __future__ import annotations

import contextlib
import math
import sys
import time
from array import array
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

import undertow as ut
from undertow.estimators import KalmanFilter, run_recorded
from undertow.law import InnerLoop
from undertow.models import FloatArray
from undertow.plants import Measurement, OutputOnError, RealisticRig, srv02_rig


class Encoder(NamedTuple):
    """One encoder: its channel, counts per turn with the sign of the joint, angle at zero, rad."""

    channel: int
    counts: float
    at_zero: float


class Output(NamedTuple):
    """The analogue output: its channel, the amplifier's gain with its sign, the range, V."""

    channel: int
    gain: float
    limit: float


#: In the order of the mechanism's coordinates. The counters are zeroed with the pendulum hanging.
ENCODERS = (Encoder(0, 4096, 0.0), Encoder(1, 4096, math.pi))
OUTPUT = Output(0, 3.0, 10.0)

#: Bits of a counter, which begins again beyond them; and the card's own watchdog, s.
BITS = 24
WATCHDOG = 0.02


class Card(Protocol):
    """What is called of ``quanser.hardware.HIL``, with its names; buffers are filled in place."""

    def read_encoder(self, channels: array[int], count: int, buffer: array[int]) -> None: ...
    def set_encoder_counts(self, channels: array[int], count: int, buffer: array[int]) -> None: ...
    def write_analog(self, channels: array[int], count: int, buffer: array[float]) -> None: ...
    def watchdog_set_analog_expiration_state(
        self, channels: array[int], count: int, buffer: array[float]
    ) -> None: ...
    def watchdog_start(self, seconds: float) -> None: ...
    def watchdog_reload(self) -> None: ...
    def watchdog_stop(self) -> None: ...
    def close(self) -> None: ...


def open_card() -> Card:
    """Open the card. With another maker's library: return what has the functions of ``Card``."""
    from quanser.hardware import HIL  # type: ignore[import-not-found]  # comes with the card

    card: Card = HIL("q2_usb", "0")
    return card


class QuanserRig:
    """A driver: all that Undertow needs of hardware."""

    period = 0.001  # s

    def __init__(self, card: Card, clock: Callable[[], float] = time.monotonic) -> None:
        self.card, self.clock = card, clock
        self.encoders = array("i", [e.channel for e in ENCODERS])
        self.output = array("i", [OUTPUT.channel])
        self.counts = array("i", [0] * len(ENCODERS))
        self.volts = array("d", [0.0])
        self.scale = np.array([2 * math.pi / e.counts for e in ENCODERS])
        self.at_zero = np.array([e.at_zero for e in ENCODERS])
        self.total = np.zeros(len(ENCODERS))
        self.watched = False
        self.card.write_analog(self.output, 1, self.volts)
        self.card.watchdog_set_analog_expiration_state(self.output, 1, self.volts)

    def zero(self) -> None:
        """Let the counters begin where the mechanism is now: hanging, at rest."""
        nothing = array("i", [0] * len(ENCODERS))
        self.card.set_encoder_counts(self.encoders, len(nothing), nothing)
        self.total[:] = 0.0

    def read(self) -> Measurement:
        """Return the angles; a counter that began again is carried on."""
        self.card.read_encoder(self.encoders, len(self.counts), self.counts)
        turn = 2.0**BITS
        moved = np.array(self.counts) - self.total
        self.total += moved - turn * np.round(moved / turn)
        return Measurement(self.clock(), self.at_zero + self.scale * self.total)

    def write(self, u: FloatArray) -> None:
        """Put out what gives the motor u, V, within the card's range."""
        wanted = float(u[0]) / OUTPUT.gain
        self.volts[0] = max(-OUTPUT.limit, min(OUTPUT.limit, wanted))
        # A process that dies writes nothing: then the card itself switches off. Not before the
        # first write, which may be long in coming.
        if self.watched:
            self.card.watchdog_reload()
        else:
            self.card.watchdog_start(WATCHDOG)
            self.watched = True
        self.card.write_analog(self.output, 1, self.volts)

    def close(self) -> None:
        """Leave the motor without voltage, or say that it could not be done."""
        try:
            self.volts[0] = 0.0
            self.card.write_analog(self.output, 1, self.volts)
        except Exception as error:  # whatever the library raises: HILError is no OSError
            raise OutputOnError(f"the card did not take 0 V: {error}") from error
        finally:
            with contextlib.suppress(Exception):
                self.card.watchdog_stop()
            self.card.close()


class SimulatedCard(Card):
    """A simulated bench behind the functions of a card. A write is a period; it cannot hang."""

    def __init__(self, rig: RealisticRig) -> None:
        self.rig, self.offset = rig, [0] * len(ENCODERS)

    def _count(self, channel: int) -> int:
        encoder = next(e for e in ENCODERS if e.channel == channel)
        angle = float(self.rig.read().q[ENCODERS.index(encoder)]) - encoder.at_zero
        return round(angle * encoder.counts / (2 * math.pi))

    def read_encoder(self, channels: array[int], count: int, buffer: array[int]) -> None:
        for k in range(count):
            half = 2 ** (BITS - 1)
            raw = self._count(channels[k]) - self.offset[channels[k]]
            buffer[k] = (raw + half) % 2**BITS - half

    def set_encoder_counts(self, channels: array[int], count: int, buffer: array[int]) -> None:
        for k in range(count):
            self.offset[channels[k]] = self._count(channels[k]) - buffer[k]

    def write_analog(self, channels: array[int], count: int, buffer: array[float]) -> None:
        assert (channels[0], count) == (OUTPUT.channel, 1)
        self.rig.write([OUTPUT.gain * buffer[0]])


def connected() -> QuanserRig:
    """Return a driver of the card, for ``undertow run --rig``."""
    return QuanserRig(open_card())


def simulated(phi: float = ut.deg(20)) -> QuanserRig:
    """Return a driver of a simulated card, let go with the pendulum at phi, rad."""
    bench = srv02_rig()
    rig = RealisticRig(bench, bench.mechanism.state(phi=phi), seed=1)
    return QuanserRig(SimulatedCard(rig), clock=lambda: rig.t)


def balance(rig: QuanserRig, seconds: float = 5.0) -> float:
    """Balance for a while; return the largest |φ̂| of the last second, rad."""
    arm = srv02_rig().mechanism
    estimator = KalmanFilter(arm, delay=0.0025, disturbance_drift=5.0)
    estimator.reset(arm.state(phi=ut.deg(20)))
    law = InnerLoop(arm, ut.first_surface(arm))
    with contextlib.closing(rig):
        record = run_recorded(rig, estimator, lambda t, x: law(x), seconds)
    return float(abs(record.x[-1000:, 1]).max())


def watch(rig: QuanserRig, seconds: float = 10.0) -> None:
    """Print the angles, the output left at zero; the watchdog is fed by writing it."""
    end = time.monotonic() + seconds
    with contextlib.closing(rig):
        while time.monotonic() < end:
            rig.write(np.zeros(1))
            arm, pendulum = np.degrees(rig.read().q)
            print(f"\rarm {arm:8.1f}°, pendulum {pendulum:8.1f}° from upright", end="", flush=True)
            time.sleep(0.005)
    print()


if __name__ == "__main__":
    if "--zero" in sys.argv:
        with contextlib.closing(connected()) as card_rig:
            card_rig.zero()
    elif "--watch" in sys.argv:
        watch(connected())
    else:
        largest = balance(simulated())
        print(f"largest |φ̂| of the last second: {largest / ut.deg(1):.2f}°")
