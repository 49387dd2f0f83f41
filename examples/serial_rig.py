"""A rig behind a serial line, and a device emulated on a pseudo-terminal to try it on.

Run ``python examples/serial_rig.py`` for a balanced pendulum over the pseudo-terminal, or give
the name of a port: ``python examples/serial_rig.py /dev/ttyACM0``.  POSIX only.
"""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty

from wire import Device, command, parse

import undertow as ut
from undertow.estimators import KalmanFilter, drive
from undertow.inner_loop import InnerLoop
from undertow.mechanism import FloatArray
from undertow.rig import Measurement, RealisticRig, srv02_rig


class SerialRig:
    """A driver: all that Undertow needs of hardware."""

    def __init__(self, port: str, period: float = 0.001, timeout: float = 1.0) -> None:
        self.period, self.timeout = period, timeout
        self.line = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.line)
        termios.tcflush(self.line, termios.TCIOFLUSH)
        self.rest = b""
        self.write([0.0])

    def read(self) -> Measurement:
        """Return the answer to the last write; NaN where none came."""
        while b"\n" not in self.rest:
            if not select.select([self.line], [], [], self.timeout)[0]:
                return parse(b"")  # nothing came: a lost reading
            self.rest += os.read(self.line, 256)
        answer, _, self.rest = self.rest.partition(b"\n")
        return parse(answer)

    def write(self, u: FloatArray | list[float]) -> None:
        """Send the voltage; the device answers with a measurement."""
        os.write(self.line, command(u[0]))

    def close(self) -> None:
        """Leave the motor without voltage."""
        self.write([0.0])
        os.close(self.line)


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


def main(port: str | None = None, seconds: float = 5.0) -> float:
    """Balance the pendulum for a while; return the largest |φ| of the last second, rad."""
    bench = srv02_rig()
    arm = bench.mechanism
    x0 = arm.state(phi=ut.deg(20))
    rig = SerialRig(port or emulate(RealisticRig(bench, x0, seed=1)))
    estimator = KalmanFilter(arm, delay=0.0025, disturbance_drift=5.0)
    estimator.reset(x0)
    law = InnerLoop(arm, ut.first_surface(arm))
    record = drive(rig, estimator, lambda t, x: law(x), seconds)
    rig.close()
    return float(abs(record.q[-1000:, 1]).max())


if __name__ == "__main__":
    largest = main(sys.argv[1] if len(sys.argv) > 1 else None)
    print(f"largest |φ| of the last second: {largest / ut.deg(1):.2f}°")
