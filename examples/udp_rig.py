"""A rig at the other end of a network, over UDP, and a device emulated on this machine.

Run ``python examples/udp_rig.py``, or give a host and a port.  A datagram may be lost: then the
reading is lost, and the Kalman filter goes on without it.
"""

from __future__ import annotations

import socket
import sys
import threading

from wire import Device, command, parse

import undertow as ut
from undertow.estimators import KalmanFilter, drive
from undertow.inner_loop import InnerLoop
from undertow.mechanism import FloatArray
from undertow.rig import Measurement, RealisticRig, srv02_rig


class UdpRig:
    """A driver: all that Undertow needs of hardware."""

    def __init__(self, host: str, port: int, period: float = 0.001, timeout: float = 0.2) -> None:
        self.period = period
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(timeout)
        self.socket.connect((host, port))
        self.write([0.0])

    def read(self) -> Measurement:
        """Return the answer to the last write; NaN where none came."""
        try:
            return parse(self.socket.recv(256))
        except (TimeoutError, ConnectionError):
            return parse(b"")

    def write(self, u: FloatArray | list[float]) -> None:
        """Send the voltage; the device answers with a measurement."""
        self.socket.send(command(u[0]))

    def close(self) -> None:
        """Leave the motor without voltage."""
        self.write([0.0])
        self.socket.close()


def emulate(rig: RealisticRig, lose_every: int = 0) -> tuple[str, int]:
    """Serve a simulated bench on this machine; every so many answers are lost on the way."""
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind(("127.0.0.1", 0))

    def serve() -> None:
        device, number = Device(rig), 0
        while True:
            line, sender = server.recvfrom(256)
            number += 1
            answer = device.answer(line)
            if lose_every and number % lose_every == 0:
                answer = b"lost\n"
            server.sendto(answer, sender)

    threading.Thread(target=serve, daemon=True).start()
    host, port = server.getsockname()
    return str(host), int(port)


def main(host: str | None = None, port: str = "0", seconds: float = 5.0) -> float:
    """Balance the pendulum for a while; return the largest |φ̂| of the last second, rad."""
    bench = srv02_rig()
    arm = bench.mechanism
    x0 = arm.state(phi=ut.deg(20))
    simulated = RealisticRig(bench, x0, seed=1)
    rig = UdpRig(host, int(port)) if host else UdpRig(*emulate(simulated, lose_every=50))
    estimator = KalmanFilter(arm, delay=0.0025, disturbance_drift=5.0)
    estimator.reset(x0)
    law = InnerLoop(arm, ut.first_surface(arm))
    record = drive(rig, estimator, lambda t, x: law(x), seconds)
    rig.close()
    return float(abs(record.x[-1000:, 1]).max())


if __name__ == "__main__":
    largest = main(*(sys.argv[1:3] if len(sys.argv) > 2 else (None, "0")))
    print(f"largest |φ| of the last second: {largest / ut.deg(1):.2f}°")
