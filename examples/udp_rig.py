"""A rig at the other end of a network, over UDP, and a device emulated on this machine.

``python examples/udp_rig.py`` balances a pendulum on the emulated device, as fast as it goes;
give a host and a port for another. A datagram may be lost: then the reading is lost, and the
Kalman filter goes on without it. Driver and device each listen to the other alone: the driver's
socket is connected, and the device obeys the first that asks it until that falls silent. (An
address can be forged: on a network that others share, sign the datagrams.) Against the clock:

    undertow run rotary_pendulum --rig examples/udp_rig.py:emulated --start phi=20deg
"""

from __future__ import annotations

import contextlib
import select
import socket
import sys
import threading
import time

from wire import LOST, Device, command, parse

import undertow as ut
from undertow.estimators import KalmanFilter, run_recorded
from undertow.law import InnerLoop
from undertow.models import FloatArray
from undertow.plants import Measurement, OutputOnError, RealisticRig, srv02_rig

#: How long an answer is waited for where no clock drives the loop, and in the end, s.
PATIENCE = 0.004


class UdpRig:
    """A driver: all that Undertow needs of hardware.

    A read waits for at most ``timeout``, s, by default for less than half a period: a datagram that
    is lost must not cost the loop its deadline.
    """

    def __init__(
        self, host: str, port: int, period: float = 0.001, timeout: float | None = None
    ) -> None:
        self.period, self.timeout = period, 0.4 * period if timeout is None else timeout
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((host, port))  # what others send does not come in
        self.number, self.answered = 0, 0
        self.write([0.0])

    def read(self) -> Measurement:
        """Return the answer to the last write, or the newest that came in time, else NaN."""
        newest, until = LOST, time.monotonic() + self.timeout
        while self.answered < self.number and (left := until - time.monotonic()) > 0:
            # A socket's own timeout would be rounded up to a millisecond.
            if not select.select([self.socket], [], [], left)[0]:
                break
            number, measurement = parse(self.socket.recv(256))
            if self.answered < number <= self.number:
                self.answered, newest = number, measurement
        return newest

    def write(self, u: FloatArray | list[float]) -> None:
        """Send the voltage; the device answers with a measurement."""
        self.number += 1
        self.socket.send(command(self.number, u[0]))

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
            self.socket.close()
        raise OutputOnError(f"the device may still drive the motor: {why}")


#: A device takes orders from another sender once the first has been silent for so long, s.
SILENCE = 1.0


def emulate(rig: RealisticRig, lose_every: int = 0) -> tuple[str, int]:
    """Serve a simulated bench on this machine; every so many answers are lost on the way.

    It obeys one sender at a time: what others send is neither applied nor answered.
    """
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind(("127.0.0.1", 0))

    def serve() -> None:
        device, number, master, heard = Device(rig), 0, None, 0.0
        while True:
            line, sender = server.recvfrom(256)
            now = time.monotonic()
            if sender != master and master is not None and now - heard < SILENCE:
                continue
            master, heard, number = sender, now, number + 1
            answer = device.answer(line)
            if not lose_every or number % lose_every:
                server.sendto(answer, sender)

    threading.Thread(target=serve, daemon=True).start()
    host, port = server.getsockname()
    return str(host), int(port)


def emulated(timeout: float | None = None) -> UdpRig:
    """Return a driver of an emulated device that loses datagrams, for ``undertow run --rig``."""
    bench = srv02_rig()
    simulated = RealisticRig(bench, bench.mechanism.state(phi=ut.deg(20)), seed=1)
    return UdpRig(*emulate(simulated, lose_every=50), timeout=timeout)


def main(host: str | None = None, port: str = "0", seconds: float = 5.0) -> float:
    """Balance the pendulum for a while; return the largest |φ̂| of the last second, rad."""
    arm = srv02_rig().mechanism
    # As fast as it goes nothing is late: each answer is waited for.
    rig = UdpRig(host, int(port), timeout=PATIENCE) if host else emulated(PATIENCE)
    estimator = KalmanFilter(arm, delay=0.0025, disturbance_drift=5.0)
    estimator.reset(arm.state(phi=ut.deg(20)))
    law = InnerLoop(arm, ut.first_surface(arm))
    with contextlib.closing(rig):
        record = run_recorded(rig, estimator, lambda t, x: law(x), seconds)
    return float(abs(record.x[-1000:, 1]).max())


if __name__ == "__main__":
    largest = main(*(sys.argv[1:3] if len(sys.argv) > 2 else (None, "0")))
    print(f"largest |φ̂| of the last second: {largest / ut.deg(1):.2f}°")
