"""Single surfaces that switch where the earliest arrival over all inputs switches.

The earliest motion has its inputs at their limits but for switches from one to the other.  A law
with a large gain is at its limits, too, and switches where it asks for no input: one linear
equation in the entries of its surface for each switching point, see :mod:`.fitting`.  For 2n states
the earliest motion of one input has 2n − 1 switches, and a surface as many entries.  What is left
is what the law's finite gain, its layer and the end of the motion change.  A narrow population
search makes up for it: too narrow for one that comes from far away to find.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from undertow.closed_loop import INADMISSIBLE
from undertow.law import stability_margin
from undertow.models import FloatArray
from undertow.optimiser.arrival import ArrivalSearch
from undertow.optimiser.cma_es import CMAES, minimise
from undertow.optimiser.fitting import switching_fits
from undertow.optimiser.schedules import earliest_arrival, earliest_motion
from undertow.optimiser.task import Optimisation

#: Draws around the fits, and their spread, between two powers of ten.
DRAWN, SPREAD = 2000, (-2.5, 0.0)

#: Members, first spread and most generations of a population around the closest of them.
MEMBERS, NARROW, GENERATIONS = 24, 0.05, 60

#: When such motions may arrive, in parts of the earliest arrival: from the first number to the
#: second, or to the best plan's arrival where that is sooner.
SOONEST, LATEST = 1.01, 1.5

#: Around the one that comes closest: draws with which a search for arrivals begins, the spread of
#: these, and its members.
AROUND, CLOSE, FEW = 100, (-3.0, -1.0), 16


@dataclass(frozen=True, eq=False)
class SwitchingSurfaces:
    """Surfaces fitted to the switches of the earliest arrival.

    ``z``: their search coordinates, (N, d). ``time``: when that motion arrives, s.
    """

    z: FloatArray
    time: float

    @classmethod
    def of(cls, task: Optimisation, keep: int) -> SwitchingSurfaces | None:
        """Return those of the earliest motion near the best plan's; ``None`` where there is none.

        So many evaluations are left over.
        """
        arrival = earliest_arrival(task, keep)
        motion = earliest_motion(task, arrival)
        if motion is None:
            return None
        x, qdd = arrival.switches(motion)
        if not x.size:
            return None
        return cls(
            switching_fits(task.space, task.optimiser.anchor, x, qdd, motion.x.T), motion.time
        )

    def search(self, task: Optimisation, arrivals: ArrivalSearch) -> float:
        """Search from draws around them; return the earliest arrival that was found, s."""
        space, rng, loop = task.space, task.rng, task.loop
        if arrivals.without(DRAWN + MEMBERS * GENERATIONS + AROUND):
            return math.inf
        known = task.best_cost < INADMISSIBLE
        last = min(LATEST, max(SOONEST, task.best_cost / self.time)) if known else LATEST
        T = self.time * math.exp(rng.uniform(math.log(SOONEST), math.log(last)))

        def off(z: FloatArray) -> FloatArray:
            x, _ = task.states(z, T)
            vectors, _ = space.decode(z)
            stable = stability_margin(loop.mechanism, vectors[:, -1]) > 0
            return np.where(stable, np.linalg.norm(x, axis=1), np.inf)

        drawn = self.z[rng.integers(0, len(self.z), DRAWN)]
        drawn = drawn + space.steps(rng, 10.0 ** rng.uniform(*SPREAD, DRAWN))
        misses = off(drawn)
        nearest = drawn[misses.argmin()]
        if not math.isfinite(misses.min()):
            return math.inf
        narrow = CMAES(nearest, NARROW, MEMBERS, rng)
        narrow.best_x, narrow.best_f = nearest, float(misses.min())
        minimise(
            narrow, off, evaluations=MEMBERS * GENERATIONS,
            stop=lambda: narrow.best_f < arrivals.radius or task.late(),
        )  # fmt: skip
        around = space.steps(rng, 10.0 ** rng.uniform(*CLOSE, AROUND))
        return arrivals.run(np.vstack([narrow.best_x, narrow.best_x + around]), T, FEW)
