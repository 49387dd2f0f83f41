"""A rig behind a serial line, and a device emulated on a pseudo-terminal to try it on.

``python examples/serial_rig.py`` balances a pendulum over the pseudo-terminal, as fast as it
goes; with the name of a port, ``python examples/serial_rig.py /dev/ttyACM0``, the device there.
Against the clock, with the optimiser, watchdog and log of the runtime:

    undertow run rotary_pendulum --rig examples/serial_rig.py:emulated --start phi=20deg

POSIX only.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import sys
import termios
import threading
import time
import tty

from wire import LOST, Device, command, parse

import undertow as ut
from undertow.estimators import KalmanFilter, run_recorded
from undertow.law import InnerLoop
from undertow.models import FloatArray
from undertow.plants import Measurement, OutputOnError, RealisticRig, srv02_rig

#: How long an answer is waited for where no clock drives the loop, and in the end, s.
PATIENCE = 0.004


class SerialRig:
    """A driver: all that Undertow needs of hardware.

    The port is its own: a second program that opened it would take half of the answers, and could
    move the motor.  A read waits for at most ``timeout``, s, by default less than half a period.
    """

    def __init__(self, port: str, period: float = 0.001, timeout: float | None = None) -> None:
        self.period, self.timeout = period, 0.4 * period if timeout is None else timeout
        self.line = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            fcntl.flock(self.line, fcntl.LOCK_EX | fcntl.LOCK_NB)  # as all that keep to it do
            fcntl.ioctl(self.line, termios.TIOCEXCL)  # and against those that do not
        except OSError as error:
            os.close(self.line)
            raise OSError(error.errno, f"{port} is in use by another program") from error
        tty.setraw(self.line)
        termios.tcflush(self.line, termios.TCIOFLUSH)
        self.number, self.answered, self.rest = 0, 0, b""
        self.write([0.0])

    def read(self) -> Measurement:
        """Return the answer to the last write, or the newest that came in time, else NaN."""
        newest, until = LOST, time.monotonic() + self.timeout
        while self.answered < self.number and (left := until - time.monotonic()) > 0:
            if not select.select([self.line], [], [], left)[0]:
                break
            if not (data := os.read(self.line, 4096)):
                raise ConnectionError("the serial line was closed")
            *lines, self.rest = (self.rest[-80:] + data).split(b"\n")
            for number, measurement in map(parse, lines):
                if self.answered < number <= self.number:
                    self.answered, newest = number, measurement
        return newest

    def write(self, u: FloatArray | list[float]) -> None:
        """Send the voltage; the device answers with a measurement."""
        self.number += 1
        os.write(self.line, command(self.number, u[0]))

    def close(self) -> None:
        """Leave the motor without voltage: ask for zero until the device answers, five times.

        Raises OutputOnError where it does not: nobody knows then what the motor does.
        """
        self.timeout, why = max(self.timeout, PATIENCE), "five commands of 0 V were not answered"
        try:
            for _ in range(5):
                self.write([0.0])
                self.read()
                if self.answered == self.number:
                    return
        except OSError as error:  # the device may be gone
            why = str(error)
        finally:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self.line, termios.TIOCNXCL)
            os.close(self.line)
        raise OutputOnError(f"the device may still drive the motor: {why}")


def emulate(rig: RealisticRig) -> str:
    """Serve a simulated bench on a pseudo-terminal, in a thread, and return the port's name."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)

    def serve() -> None:
        device, rest = Device(rig), b""
        while True:
            try:
                rest += os.read(ours, 256)
            except OSError:  # the other end was closed
                return
            *lines, rest = rest.split(b"\n")
            for line in lines:
                os.write(ours, device.answer(line))

    threading.Thread(target=serve, daemon=True).start()
    return os.ttyname(theirs)


def emulated(timeout: float | None = None) -> SerialRig:
    """Return a driver of an emulated device, for ``undertow run --rig``."""
    bench = srv02_rig()
    simulated = RealisticRig(bench, bench.mechanism.state(phi=ut.deg(20)), seed=1)
    return SerialRig(emulate(simulated), timeout=timeout)


def main(port: str | None = None, seconds: float = 5.0) -> float:
    """Balance the pendulum for a while; return the largest |φ̂| of the last second, rad."""
    arm = srv02_rig().mechanism
    # As fast as it goes nothing is late: each answer is waited for.
    rig = SerialRig(port, timeout=PATIENCE) if port else emulated(PATIENCE)
    estimator = KalmanFilter(arm, delay=0.0025, disturbance_drift=5.0)
    estimator.reset(arm.state(phi=ut.deg(20)))
    law = InnerLoop(arm, ut.first_surface(arm))
    with contextlib.closing(rig):
        record = run_recorded(rig, estimator, lambda t, x: law(x), seconds)
    return float(abs(record.x[-1000:, 1]).max())


if __name__ == "__main__":
    largest = main(sys.argv[1] if len(sys.argv) > 1 else None)
    print(f"largest |φ̂| of the last second: {largest / ut.deg(1):.2f}°")
