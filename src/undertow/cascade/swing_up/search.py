"""The search for a swing-up's gains: judged by many swings, each a little different.

From rest a swing-up is chaotic: a change in the last bit of a state, or a plant off by one
per cent, sends it past the target on the other side.  What one swing on the model says of
gains is therefore chance, and the gains that are quickest there may fail on a bench.  Here
gains are judged by the average of many swings: plants drawn within a standard deviation of the
model's parameters (0.58 of their tolerances, or of the usual ones where they have none), dry
friction and the hand that lets go differ from swing to swing, and some begin where a mechanism
that was thrown out may be.

No gains suit all plants.  A swing-up that has not led to a catch goes on with the next ones, so
these are searched for on the swings that the ones before have not brought up, from where those
have left them.  All are judged once more, in turn, by swings that the search has not seen.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undertow.base import InfeasibleError
from undertow.cascade.swing_up.attempts import SECONDS, Attempts
from undertow.cascade.swing_up.law import Gains, SwingUp, hanging
from undertow.estimators.belief import EVEN, Belief
from undertow.models import FloatArray, Mechanism
from undertow.optimiser import CMAES
from undertow.plants.bench import plausible_rig
from undertow.symbolic import content_key, recall, remember

#: Gains of mechanisms of the library, as the search found them: see :func:`kept_text`.
KEPT = Path(__file__).with_name("gains.json")

#: Dry friction of the driven joint, up to this part of the input's limit; the part of the
#: swings that begins anywhere, not hanging at rest.
DRAG, ANYWHERE = 0.03, 0.25

#: Random gains and the swings that each is tried on; those that are tried on all swings; so many
#: generations refine the best.  Gains that are found, one after the other; swings of which those
#: that are left are searched for; swings that judge what is taken.
RANDOM, FEW, GOOD, GENERATIONS, SWINGS = 2000, 4, 60, 24, 48
TURNS, LOOKED, FRESH = 6, 1024, 512

#: Where gains lie, decades about their scales: k_D, k_P, k_V, surplus, k_E.
DECADES = np.array([[-2.5, 1.5], [-2.5, 1.5], [-2.5, 1.5], [-3.0, -0.3], [-2.5, 1.5]])


@dataclass(frozen=True)
class RatedGains:
    """Gains and what swings that the search had not seen said of them.

    Part of the swings that came near the target in time is ``arrives``: of those that the gains
    before had not brought there, or of ``SWINGS`` where fewer were left. ``expected`` is the time
    until one does, s, when such swings follow one another.
    """

    gains: Gains
    arrives: float
    expected: float


@dataclass(frozen=True, eq=False)
class _Batch:
    """Swings: where they begin, (N, 2n), the plants' parameters, (N, P), dry friction, (N,)."""

    starts: FloatArray
    plants: FloatArray
    drags: FloatArray

    def __len__(self) -> int:
        return len(self.drags)

    def __getitem__(self, rows: slice | NDArray[np.intp]) -> _Batch:
        return _Batch(self.starts[rows], self.plants[rows], self.drags[rows])


class _Swings:
    """Swings on benches of usual quality, drawn one after the other from a seed."""

    def __init__(self, mechanism: Mechanism, seed: int) -> None:
        self.mechanism, self.seed = mechanism, seed
        values = {p.name: abs(p.value) for p in mechanism.parameters}
        known = Belief.usual(mechanism).tolerances
        parts = {name: EVEN * tolerance / values[name] for name, tolerance in known.items()}
        self.bench = replace(plausible_rig(mechanism), tolerance=parts)
        self.low, n = hanging(mechanism), mechanism.n
        self.attempts = Attempts(mechanism)
        self.missing = float(mechanism.energy(np.zeros(2 * n)) - mechanism.energy(self.low))

    def _draw(self, number: int) -> tuple[FloatArray, FloatArray, float]:
        rng = np.random.default_rng([self.seed, number])
        plant = self.bench.drawn(rng)
        anywhere = rng.uniform() < ANYWHERE
        start = self._anywhere(rng) if anywhere else self.bench.released(self.low, rng)
        return start, plant.parameter_values, rng.uniform(0.0, DRAG)

    def _anywhere(self, rng: np.random.Generator) -> FloatArray:
        """Return a state with no more than half the missing energy above the target's, (2n,)."""
        mechanism, n = self.mechanism, self.mechanism.n
        wraps, stops = self.attempts.wraps, self.attempts.stops
        room = np.where(wraps > 0, math.pi, 0.5 * np.minimum(1.0, stops[:, 1]))
        x = np.concatenate([room * rng.uniform(-1.0, 1.0, n), rng.standard_normal(n)])
        kinetic = 0.5 * float(x[n:] @ mechanism.M(x[:n]) @ x[n:])
        still = mechanism.energy(np.concatenate([x[:n], np.zeros(n)]))
        spare = float(mechanism.energy(np.zeros(2 * n))) + 0.5 * self.missing - float(still)
        x[n:] *= math.sqrt(max(spare, 0.0) * rng.uniform() / kinetic)
        return x

    def drawn(self, first: int, last: int) -> _Batch:
        """Return some of the swings."""
        starts, plants, drags = zip(*(self._draw(k) for k in range(first, last)), strict=True)
        return _Batch(np.array(starts), np.array(plants), np.array(drags))

    def __call__(self, gains: FloatArray, batch: _Batch) -> tuple[FloatArray, FloatArray]:
        """Return times and nearest distances, (N, 2), and where swings have got to, (N, 2n)."""
        return self.attempts(gains, batch.starts, batch.plants, batch.drags)

    def left(self, found: Sequence[FloatArray], batch: _Batch) -> tuple[_Batch, int]:
        """Return what the next gains meet after those that were found, and how many are left.

        First those that none has brought up, from where they have been left, then the others
        from their starts.
        """
        rest, starts = np.arange(len(batch)), batch.starts.copy()
        for gains in found:
            if len(rest):
                ends, starts[rest] = self(gains, replace(batch, starts=starts)[rest])
                rest = rest[np.isinf(ends[:, 0])]
        others = np.setdiff1d(np.arange(len(batch)), rest)
        starts[others] = batch.starts[others]
        return replace(batch, starts=starts)[np.concatenate([rest, others])], len(rest)


def _merit(ends: FloatArray) -> float:
    """Mean of how near swings came, in decades; in [−1, 0] where they arrived, soon is less."""
    times, near = ends.T
    missed = np.log10(np.clip(near, 1.0, 1e3))
    return float(np.where(np.isfinite(times), times / SECONDS - 1.0, missed).mean())


def _judged(row: FloatArray, ends: FloatArray) -> RatedGains:
    """Return gains with the time that swings which are tried again and again take.

    A swing is given up after ``SECONDS``: E[min(t, SECONDS)]/P(t ≤ SECONDS).
    """
    times = ends[:, 0]
    part = float(np.isfinite(times).mean())
    spent = float(np.minimum(times, SECONDS).mean())
    expected = spent / part if part else math.inf
    return RatedGains(Gains(*(float(v) for v in row)), part, expected)


def _in_turn(swings: _Swings, rows: Sequence[FloatArray], batch: _Batch) -> list[RatedGains]:
    """Return gains with what swings say of them that come to each after those before."""
    found = []
    for k, row in enumerate(rows):
        meets, count = swings.left(rows[:k], batch)
        found.append(_judged(row, swings(row, meets[: max(count, SWINGS)])[0]))
    return found


def search(mechanism: Mechanism, seed: int = 0) -> tuple[RatedGains, ...]:
    """Search for gains that swing a mechanism up, whatever is a little different.

    Random gains are tried on a few swings, the best of them on more, and the best one is refined
    by CMA-ES; then the same on the swings that it has not brought up, from where it has left
    them, and so on.  Nothing that was found before is looked at.

    The mechanism has one input with a limit, a potential, and a target that stands upright.
    ``seed`` is that of the gains and of the swings.  Gains come in the order in which they are to
    be tried, none where nothing arrives.

    Raises
    ------
    ModelError
        For a mechanism that the formula does not cover, or that does not hang.
    """
    SwingUp(mechanism, (Gains(1.0, 1.0, 1.0),))  # refuses what the formula does not cover
    swings, rng = _Swings(mechanism, seed), np.random.default_rng(seed)
    inertia, missing = float(mechanism.M(swings.low[: mechanism.n])[0, 0]), swings.missing
    pump = 1.0 / (missing * math.sqrt(missing * inertia))
    scale = missing * np.array([inertia, 1.0, 0.1, 1.0, pump])
    seen, fresh = swings.drawn(0, LOOKED), swings.drawn(LOOKED, LOOKED + FRESH)
    found: list[FloatArray] = []
    for _ in range(TURNS):
        batch = swings.left(found, seen)[0][:SWINGS]

        def merits(some: FloatArray, batch: _Batch = batch) -> FloatArray:
            return np.array([_merit(swings(row, batch)[0]) for row in some])

        rows = 10.0 ** rng.uniform(DECADES[:, 0], DECADES[:, 1], (RANDOM, 5)) * scale
        rows = rows[np.argsort(merits(rows, batch[:FEW]), kind="stable")[:GOOD]]
        best = rows[np.argmin(merits(rows))]
        climb = CMAES(np.log(best), 0.3, 12, rng)
        for _ in range(GENERATIONS):
            asked = climb.ask()
            climb.tell(asked, merits(np.exp(asked)))
        found.append(np.exp(climb.best_x))
    return tuple(one for one in _in_turn(swings, found, fresh) if one.arrives)


def designs_for(
    mechanism: Mechanism, *, seed: int = 0, fresh: bool = False
) -> tuple[RatedGains, ...]:
    """Return what :func:`search` finds, from what is kept where it was found before.

    With ``fresh`` nothing that is kept is looked at; the library keeps what seed 0 found.

    Raises
    ------
    InfeasibleError
        When no gains bring it there.
    """
    key = content_key(mechanism.fingerprint, str(seed))
    if not fresh:
        shipped = _kept().get(mechanism.fingerprint) if seed == 0 else None
        if shipped is not None:
            return shipped
        text = recall("swing_gains", key)
        if text is not None:
            return _read(json.loads(text))
    found = search(mechanism, seed)
    if not found:
        raise InfeasibleError(
            f"no gains found that swing up '{mechanism.name}'",
            value=f"inputs up to {mechanism.inputs[0].limit:g} {mechanism.inputs[0].unit}",
            limit=f"near the target within {SECONDS:g} s",
            remedy="Give it a larger input limit; one that needs longer than that, as a reaction "
            "wheel does, is not searched for",
        )
    remember("swing_gains", key, json.dumps([asdict(one) for one in found]))
    return found


def designed(mechanism: Mechanism) -> SwingUp:
    """Return the swing-up with the gains that :func:`designs_for` returns: see there."""
    return SwingUp(mechanism, tuple(one.gains for one in designs_for(mechanism)))


def kept_text(found: Mapping[Mechanism, Sequence[RatedGains]]) -> str:
    """Return the text of the file ``KEPT`` for what the search found, seed 0."""
    rows = {
        mechanism.fingerprint: {
            "mechanism": mechanism.name,
            "found": [asdict(one) for one in some],
        }
        for mechanism, some in found.items()
    }
    return json.dumps(rows, indent=1) + "\n"


def _read(rows: Sequence[dict[str, Any]]) -> tuple[RatedGains, ...]:
    return tuple(RatedGains(**{**row, "gains": Gains(**row["gains"])}) for row in rows)


@lru_cache(maxsize=1)
def _kept() -> dict[str, tuple[RatedGains, ...]]:
    """What the library keeps, by the fingerprint of the mechanism."""
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    return {fingerprint: _read(entry["found"]) for fingerprint, entry in kept.items()}
