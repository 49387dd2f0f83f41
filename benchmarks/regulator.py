"""Least energy by linear-quadratic feedback: the cheapest that arrives, over a sweep of weights.

A yardstick for mechanisms whose cascade is far from the optimal-control bound: u = −K x, clipped,
with K of weights q I on the state and I on the input.  Printed for each mechanism: the cheapest
∫uᵀu dt until ‖x‖ ≤ 0.01 within 60 s, its q, and when it arrives.  Without a name: of TORA.
"""

from __future__ import annotations

import sys

import numpy as np
import scipy.integrate
import scipy.linalg

import undertow as ut
from undertow.models import FloatArray, linearise

from harness import command_line, mechanism_names  # isort: skip

WEIGHTS = 10.0 ** np.arange(-9.0, 1.0)
HORIZON = 60.0
RADIUS = 0.01


def run(mechanism: ut.Mechanism, q: float) -> tuple[float, float]:
    """Return cost and time of arrival with weight q; infinite where it does not arrive."""
    lin, n = linearise(mechanism), 2 * mechanism.n
    try:
        P = scipy.linalg.solve_continuous_are(lin.A, lin.input, q * np.eye(n), np.eye(mechanism.m))
    except np.linalg.LinAlgError:
        return np.inf, np.inf
    K, limits = lin.input.T @ P, mechanism.input_limits

    def rate(_t: float, y: FloatArray) -> FloatArray:
        u = np.clip(-K @ y[:n], -limits, limits)
        qdd = mechanism.accelerations(0.0, y[:n], u)
        return np.concatenate([y[mechanism.n : n], qdd, [u @ u]])

    def arrives(_t: float, y: FloatArray) -> float:
        return float(np.linalg.norm(y[:n])) - RADIUS

    arrives.terminal = True  # type: ignore[attr-defined]
    y0 = np.append(mechanism.state(**mechanism.start), 0.0)
    motion = scipy.integrate.solve_ivp(
        rate, (0.0, HORIZON), y0, rtol=1e-6, atol=1e-10, events=arrives, max_step=0.1
    )
    if motion.status != 1:
        return np.inf, np.inf
    return float(motion.y[-1, -1]), float(motion.t[-1])


def main() -> int:
    """Sweep the weights for each mechanism that is named."""
    parser = command_line(__doc__, "tora reaction_wheel_pendulum", clocks=False)
    mechanism_names(parser)
    for name in parser.parse_args().names or ["tora"]:
        mechanism = ut.mechanisms.LIBRARY[name]()
        (cost, arrival), q = min((run(mechanism, q), q) for q in WEIGHTS)
        print(f"{name}: {cost:.3g} with q = {q:.1e}, arrives at {arrival:.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
