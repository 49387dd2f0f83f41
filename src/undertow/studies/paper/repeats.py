"""Figure 3: a motion repeated on a plant that is not ideal.

The paper repeated an experiment three times.  Here a simulated plant stands in: the law
runs at 1 kHz with its input held, sees noisy states, starts with the spread of a hand, and
meets Coulomb friction that it does not know.  These are simulations, and labelled so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import sympy as sp

from undertow.closed_loop import ClosedLoop, Trajectory
from undertow.models import Parameter
from undertow.studies.paper.data import PRINTED, Condition

#: Coulomb friction of the arm, N m: assumed, about 0.23 V at the motor.
COULOMB_FRICTION = 0.03
#: Speed below which it falls off smoothly, rad/s.
STICTION_SPEED = 0.02
#: Measurement noise (standard deviation): a 12-bit encoder's on angles, rad, and what a
#: filtered difference leaves on rates, rad/s.
ANGLE_NOISE, RATE_NOISE = 2 * math.pi / 4096 / math.sqrt(12), 0.02
#: The hand's spread of φ(0) (standard deviation), rad.
START_SPREAD = math.radians(1.0)


@dataclass(frozen=True, eq=False)
class Repeats:
    """Figure 3: one ideal motion and three simulated repeats on a disturbed plant."""

    ideal: Trajectory
    repeats: tuple[Trajectory, ...]


def noisy_repeats(condition: Condition, *, seed: int) -> Repeats:
    """Simulate Figure 3: Table 2's one-time surface, ideal, and three disturbed repeats.

    The repeats run the law at 1 kHz with its input held, see noisy states, start with a
    spread by hand, and move a plant with Coulomb friction that the law does not know.
    They stand in for the paper's three experiments; they are no measurement.
    """
    rig = condition.mechanism
    friction = Parameter("coulomb", COULOMB_FRICTION, "N m", "Coulomb friction of the arm", 0)
    speed = rig.coordinates[0].velocity
    truth = rig.disturbed({"theta": -friction.symbol * sp.tanh(speed / STICTION_SPEED)}, [friction])
    surfaces = PRINTED["time", "one-time"].surfaces
    duration, sample = 5.0, 0.001
    ideal = ClosedLoop(rig).simulate(condition.start, surfaces, duration=duration, terminal=0.0)
    loop = ClosedLoop(rig, plant=truth, step=sample / 2, zoh_steps=2)
    repeats = []
    for number in range(3):
        rng = np.random.default_rng([seed, number])
        start = condition.start
        start[1] += START_SPREAD * rng.standard_normal()
        scale = np.repeat([ANGLE_NOISE, RATE_NOISE], rig.n)
        noise = scale * rng.standard_normal((round(duration / sample), 2 * rig.n))
        repeats.append(
            loop.simulate(start, surfaces, duration=duration, terminal=0.0, every=2, noise=noise)
        )
    return Repeats(ideal, tuple(repeats))
