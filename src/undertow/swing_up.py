"""Swing-up and catch: energy to the top, then the sliding-mode law, and back if thrown out.

The swing-up is Fantoni and Lozano's (*Non-linear Control for Underactuated Mechanical
Systems*, Springer 2002), one formula for every mechanism with one input and a potential:
with Ẽ = E − E(target), the Lyapunov function ½ Ẽ² + ½ k_D q̇_a² + ½ k_P q_a² falls as −k_V q̇_a²
under

    B u = −(k_P q_a + k_V q̇_a + k_D S⁻¹ h) / (Ẽ + k_D S⁻¹),    S q̈_a = h + B u   (4),

where Ẽ + k_D/S > 0; with a clipped input, small gains k_D swing up by bang-bang instead and
no proof is left.  The gains are therefore found by search, and what counts is the hand-over:
only from a state from which the law is *predicted* to bring the mechanism home, with the
clip and the end stops in place, and from disturbed copies of that state too.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import scipy.linalg
import sympy as sp

from undertow.codegen.function import COMPILED, PREAMBLE, function_source
from undertow.codegen.store import content_key, generated, generators, recall, remember
from undertow.codegen.tape import Tape
from undertow.errors import InfeasibleError, InvalidInputError, ModelError, UndertowError
from undertow.inner_loop import InnerLoop
from undertow.mechanism import FloatArray, Mechanism
from undertow.objective import MinimumTime, state_box
from undertow.rig.simulated import IdealRig
from undertow.rig.stepping import dynamics_source
from undertow.rollout import ClosedLoop
from undertow.search import CMAES
from undertow.sliding import ReachingLaw, Surface
from undertow.stability import first_surface, linearise

__all__ = ["CatchRegion", "Gains", "SwingUp", "SwingUpAndCatch", "hanging"]

#: While the kinetic energy is below this part of what is missing, the law pushes: at rest
#: its formula gives nothing.
STILL = 0.002
#: How hard it pushes, part of the input's limit.
KICK = 0.3

#: Plants on which the search tries its gains: how many, parameters this far off, relative,
#: and Coulomb friction up to this part of the input's limit.
PLANTS, OFF, DRAG = 8, 0.05, 0.03
#: Gains that are kept, to be tried in turn.
CHOICES = 8

_BODY = f"""
{COMPILED}
def swing(x, gains, parameters, limit, middle, work):
    energies(x, parameters, work[0:2])
    blocks(x, parameters, work[2:5])
    kinetic, missing, S, h, B = work[0], work[1], work[2], work[3], work[4]
    n = x.shape[0] // 2
    away = x[0] - middle
    if kinetic < {STILL} * abs(missing - kinetic):
        return {KICK} * limit * (-1.0 if away * B > 0.0 else 1.0)
    weight = max(missing + gains[0] / S, 1e-9)
    force = -(gains[1] * away + gains[2] * x[n] + gains[0] * h / S) / weight
    return max(-limit, min(limit, force / B))


{COMPILED}
def attempt(x0, gains, belief, plant, drag, limit, middle, stops, P, level, wraps, seconds, h):
    # Time until xᵀPx ≤ level; negative closeness where that is never so.
    n = x0.shape[0] // 2
    x, stage, total = x0.copy(), x0.copy(), x0.copy()
    qdd, viscous, u, work = np.zeros(n), np.zeros(n), np.zeros(1), np.zeros(5)
    nearest = math.inf
    for k in range(int(seconds / h)):
        # Coulomb friction of the driven joint, as a part of the input's limit.
        u[0] = swing(x, gains, belief, limit, middle, work)
        u[0] -= drag * limit * math.tanh(x[n] / 0.02) * (1.0 if work[4] > 0.0 else -1.0)
        for i in range(2 * n):
            stage[i] = x[i]
            total[i] = 0.0
        for s in range(4):
            forward(0.0, stage, u, viscous, plant, qdd)
            weight = 1.0 if s == 0 or s == 3 else 2.0
            reach = h if s == 2 else 0.5 * h
            for i in range(n):
                d, dd = stage[n + i], qdd[i]
                total[i] += weight * d
                total[n + i] += weight * dd
                stage[i] = x[i] + reach * d
                stage[n + i] = x[n + i] + reach * dd
        for i in range(2 * n):
            x[i] += h / 6.0 * total[i]
        for i in range(n):
            if not stops[i, 0] < x[i] < stops[i, 1]:
                return -1e6 - nearest
            stage[i] = x[i] - wraps[i] * math.floor(x[i] / wraps[i] + 0.5) if wraps[i] > 0.0 else x[i]
            stage[n + i] = x[n + i]
        distance = 0.0
        for i in range(2 * n):
            for j in range(2 * n):
                distance += stage[i] * P[i, j] * stage[j]
        nearest = min(nearest, distance / level)
        if distance <= level:
            return k * h
    return -nearest
"""  # noqa: E501

_GENERATOR = generators("swing_up.py", "rig/stepping.py", "codegen/function.py")


@lru_cache(maxsize=32)
def _module(mechanism: Mechanism) -> Any:
    key = content_key(mechanism.structure, mechanism.name, sources=_GENERATOR)

    def write() -> str:
        tape = Tape()
        part = mechanism.partition(tape)
        velocities = sp.Matrix(mechanism.x[mechanism.n :])
        kinetic = (velocities.T * sp.Matrix(mechanism.mass_matrix) * velocities)[0] / 2
        assert mechanism.potential is not None  # SwingUp refuses it otherwise
        at_target = mechanism.potential.subs(dict.fromkeys(mechanism.q, 0))
        energies = tape.let_all([kinetic, kinetic + mechanism.potential - at_target])
        given = {"x": mechanism.x, "parameters": mechanism.parameter_symbols}
        blocks = [part.S[0, 0], part.h[0], part.B[0, 0]]
        return "\n\n".join(
            [
                f'"""Swing-up of {mechanism.name}; generated, do not edit."""\n\n{PREAMBLE}',
                dynamics_source(mechanism),
                function_source("energies", tape, given, {"E": energies}),
                function_source("blocks", tape, given, {"out": blocks}),
                _BODY,
            ]
        )

    return generated("swing", mechanism.name, key, write)


def hanging(mechanism: Mechanism) -> FloatArray:
    """Return the state of lowest energy, at rest, (2n,): where a swing-up starts.

    Raises
    ------
    ModelError
        When the mechanism was given without a potential, or does not hang.
    """
    n = mechanism.n
    turning = [i for i, c in enumerate(mechanism.coordinates) if c.unit == "rad"]
    best, lowest = np.zeros(2 * n), float(mechanism.energy(np.zeros(2 * n)))
    for choice in np.ndindex(*(2,) * len(turning)):
        x = np.zeros(2 * n)
        x[turning] = math.pi * np.array(choice)
        energy = float(mechanism.energy(x))
        if energy < lowest - 1e-9:
            best, lowest = x, energy
    if not best.any():
        raise ModelError(
            f"swing-up of '{mechanism.name}'",
            value="no lower energy at half turns than at the target",
            limit="a target that stands upright",
            remedy="Nothing has to swing up here",
        )
    return best


@dataclass(frozen=True)
class Gains:
    """k_D, k_P and k_V of the swing-up, in SI units, relative to a gain of 1 on the energy."""

    on_acceleration: float
    on_position: float
    on_velocity: float


def _periods(mechanism: Mechanism) -> FloatArray:
    """Return 2π for coordinates that turn freely, 0 for the others, (n,)."""
    return np.array(
        [
            2 * math.pi if c.unit == "rad" and not math.isfinite(c.high - c.low) else 0.0
            for c in mechanism.coordinates
        ]
    )


@dataclass(frozen=True, eq=False)
class SwingUp:
    """Fantoni and Lozano's swing-up, clipped.

    Parameters
    ----------
    mechanism
        The controller's belief: one input, a potential, an input limit.
    gains
        One or more :class:`Gains`, the best first; :meth:`designed` finds them.

    Raises
    ------
    ModelError
        For a mechanism that the formula does not cover.
    """

    mechanism: Mechanism
    gains: tuple[Gains, ...]
    _work: FloatArray = field(default_factory=lambda: np.zeros(5), repr=False)

    def __post_init__(self) -> None:
        """Refuse several inputs, no potential, no limit."""
        mechanism = self.mechanism
        if (
            mechanism.m != 1
            or mechanism.potential is None
            or not math.isfinite(mechanism.inputs[0].limit)
        ):
            raise ModelError(
                f"swing-up of '{mechanism.name}'",
                value=f"{mechanism.m} inputs, "
                f"{'no' if mechanism.potential is None else 'a'} potential, "
                f"limit {mechanism.inputs[0].limit:g}",
                limit="one input with a finite limit, and a potential",
                remedy="Give potential= and a limit to the mechanism",
            )

    @cached_property
    def _numbers(self) -> tuple[Any, FloatArray, FloatArray, float]:
        gains = np.array([astuple(g) for g in self.gains])
        limit = self.mechanism.inputs[0].limit
        return _module(self.mechanism), gains, self.mechanism.parameter_values, limit

    def __call__(self, x: FloatArray, choice: int = 0) -> FloatArray:
        """Return the input at the state x, (2n,), as (1,), within its limit.

        ``choice`` counts through the gains, round and round.
        """
        module, gains, parameters, limit = self._numbers
        row = gains[choice % len(gains)]
        u = module.swing(x, row, parameters, limit, 0.0, self._work)
        return np.array([u if math.isfinite(u) else 0.0])

    @classmethod
    def designed(cls, mechanism: Mechanism, *, seconds: float = 15.0, seed: int = 0) -> Self:
        """Find gains that swing the mechanism up quickly, on plants that are a little off.

        Random gains, log-uniform over four decades each, are tried on the model from hanging
        at rest; the quickest are tried again on plants whose parameters are off by 5 %, and
        the one with the shortest mean time wins.  Arrival is the ellipsoid in which the
        linear-quadratic regulator does not clip.  The answer is kept on disk.

        From rest a swing-up is sensitive to rounding, and so is this search: what it finds
        on the model is not always good on a rig.  For mechanisms whose gains were tried on
        20 realistic rigs, those of ``swing_gains.json`` are taken instead.

        Raises
        ------
        InfeasibleError
            When no gains bring it there.
        """
        tried = _tried().get(mechanism.fingerprint)
        if tried is not None and (seconds, seed) == (15.0, 0):
            return cls(mechanism, tuple(Gains(*row) for row in tried))
        key = content_key(mechanism.fingerprint, f"{seconds} {seed}", sources=_GENERATOR)
        kept = recall("swing_gains", key)
        if kept is not None:
            return cls(mechanism, tuple(Gains(*row) for row in json.loads(kept)))
        unit = cls(mechanism, (Gains(1.0, 1.0, 1.0),))
        found = _search(unit, seconds, seed)
        if not found:
            raise InfeasibleError(
                f"no gains found that swing up '{mechanism.name}'",
                value=f"inputs up to {mechanism.inputs[0].limit:g} {mechanism.inputs[0].unit}",
                limit=f"near the target within {seconds:g} s",
                remedy="Give it more time, or a larger input limit",
            )
        remember("swing_gains", key, json.dumps([astuple(gains) for gains in found]))
        return cls(mechanism, found)


@lru_cache(maxsize=1)
def _tried() -> dict[str, list[list[float]]]:
    """Gains that were tried on realistic rigs, by the fingerprint of the mechanism."""
    path = Path(__file__).with_name("swing_gains.json")
    kept = json.loads(path.read_text(encoding="utf-8"))
    return {fingerprint: entry["gains"] for fingerprint, entry in kept.items()}


def _search(unit: SwingUp, seconds: float, seed: int) -> tuple[Gains, ...]:
    """Return the best gains and some others that are good."""
    mechanism = unit.mechanism
    module, _, belief, limit = unit._numbers
    n = mechanism.n
    P, level = _quadratic(mechanism)
    x0 = hanging(mechanism)
    stops = np.array([[0.97 * c.low, 0.97 * c.high] for c in mechanism.coordinates])
    missing = float(mechanism.energy(np.zeros(2 * n)) - mechanism.energy(x0))
    scale = missing * float(mechanism.M(x0[:n])[0, 0])
    rng = np.random.default_rng(seed)
    decades = rng.uniform(-2.5, 1.5, (1500, 3))
    candidates = 10.0**decades * np.array([scale, missing, 0.1 * missing])
    plants = [belief * (1 + OFF * rng.uniform(-1, 1, len(belief))) for _ in range(PLANTS)]
    drags = np.linspace(0.0, DRAG, PLANTS)

    def time(gains: FloatArray, plant: FloatArray, drag: float) -> float:
        end = module.attempt(
            x0, gains, belief, plant, drag, limit, 0.0, stops, P, level, _periods(mechanism),
            seconds, 0.004,
        )  # fmt: skip
        return float(end) if end >= 0 else math.inf

    def mean_time(gains: FloatArray) -> float:
        """Mean over the plants; a miss counts as three times the longest wait."""
        tried = [time(gains, plant, drag) for plant, drag in zip(plants, drags, strict=True)]
        return float(np.minimum(tried, 3 * seconds).mean())

    times = np.array([time(gains, belief, 0.0) for gains in candidates])
    quick = np.argsort(times, kind="stable")[:60]
    quick = quick[np.isfinite(times[quick])]
    if not len(quick):
        return ()
    means = np.array([mean_time(candidates[i]) for i in quick])
    best = quick[int(np.argmin(means))]
    search = CMAES(np.log(candidates[best]), 0.3, 12, rng)
    refined, score = candidates[best], float(means.min())
    for _ in range(12):
        asked = search.ask()
        scores = np.array([mean_time(np.exp(z)) for z in asked])
        search.tell(asked, scores)
        if scores.min() < score:
            refined, score = np.exp(asked[int(np.argmin(scores))]), float(scores.min())
    others = candidates[quick[np.argsort(means, kind="stable")[: CHOICES - 1]]]
    return tuple(Gains(*(float(v) for v in row)) for row in (refined, *others))


def _quadratic(mechanism: Mechanism) -> tuple[FloatArray, float]:
    """Return P of a linear-quadratic regulator and the largest level at which it never clips.

    With R = 1/u_max², |k x| ≤ u_max on xᵀPx ≤ 1/(u_max² BᵀPB).
    """
    lin = linearise(mechanism)
    n, m = mechanism.n, mechanism.m
    limit = mechanism.inputs[0].limit
    Q = np.diag([0.1] * m + [1.0] * (n - m) + [0.01] * n)
    P = np.asarray(
        scipy.linalg.solve_continuous_are(lin.A, lin.input, Q, np.eye(m) / limit**2), np.float64
    )
    return P, float(1.0 / (limit**2 * (lin.input.T @ P @ lin.input)[0, 0]))


class CatchRegion:
    """From where the sliding-mode law is predicted to bring the mechanism home: sampled.

    Several surfaces are rolled out at once from the state and from disturbed copies of it;
    a surface catches when all of its copies come home: no proof, but a prediction with a
    margin.

    Parameters
    ----------
    mechanism
        The controller's belief.
    surfaces
        Candidates; by default quadratic designs of several rates.
    reaching
        Reaching law.
    spread
        Standard deviations of the copies, (2n,), SI units: 0.01 rad or m, 0.1 rad/s or m/s by
        default.
    seconds
        Home within this time, s.
    copies
        Disturbed copies per surface.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        surfaces: Sequence[Surface] | None = None,
        *,
        reaching: ReachingLaw | None = None,
        spread: FloatArray | None = None,
        seconds: float = 8.0,
        copies: int = 7,
    ) -> None:
        n = mechanism.n
        self.mechanism = mechanism
        self.surfaces = tuple(surfaces or _candidates(mechanism))
        self.reaching = reaching or ReachingLaw()
        ranges = {
            c.name: 0.97 * min(-c.low, c.high)
            for c in mechanism.coordinates
            if 0 < min(-c.low, c.high) < math.inf
        }
        goal = replace(
            MinimumTime(horizon=seconds, terminal_radius=0.1), constraints=state_box(**ranges)
        )
        self.loop = ClosedLoop(mechanism, goal, self.reaching)
        if spread is None:
            spread = np.repeat([0.01, 0.1], n)
        if np.shape(spread) != (2 * n,) or copies < 1:
            raise InvalidInputError(
                "spread and copies of a catch region",
                value=(np.shape(spread), copies),
                limit=f"({2 * n},) and at least 1",
            )
        rng = np.random.default_rng(0)
        shifts = rng.standard_normal((copies, 2 * n)) * spread
        self._shifts = np.vstack([np.zeros(2 * n), shifts])
        self._vectors = np.repeat([s.vector for s in self.surfaces], copies + 1, axis=0)
        self._P, self._level = _quadratic(mechanism)
        self._periods = _periods(mechanism)

    def turns(self, x: FloatArray) -> FloatArray:
        """Return whole turns of the freely turning joints, as a state to take off, (2n,)."""
        n, offset = self.mechanism.n, np.zeros(len(x))
        free = self._periods > 0
        offset[:n][free] = self._periods[free] * np.round(x[:n][free] / self._periods[free])
        return offset

    def worth_asking(self, x: FloatArray) -> bool:
        """Whether x, turns taken off, is within reach at all: a cheap test before the rollouts."""
        return bool(x @ self._P @ x <= 100.0 * self._level)

    def surface(self, x: FloatArray) -> Surface | None:
        """Return the surface that catches soonest from x, turns taken off; ``None``: outside."""
        if not np.isfinite(x).all():
            return None
        count = len(self._shifts)
        batch = self.loop.batch(np.tile(x + self._shifts, (len(self.surfaces), 1)), self._vectors)
        reached = batch.reached.reshape(-1, count).all(axis=1)
        if not reached.any():
            return None
        worst = np.where(reached, batch.time.reshape(-1, count).max(axis=1), math.inf)
        return self.surfaces[int(np.argmin(worst))]


def _candidates(mechanism: Mechanism) -> list[Surface]:
    """Quadratic designs of several rates and weights, as far as they exist."""
    found: list[Surface] = []
    n, m = mechanism.n, mechanism.m
    for rate, weight in ((0.0, 1.0), (0.0, 0.1), (0.0, 10.0), (1.0, 1.0), (1.0, 0.1), (2.0, 1.0)):
        try:
            weights = [weight] * m + [10.0] * (n - m) + [0.1] * n
            found.append(first_surface(mechanism, weights, rate))
        except UndertowError:
            continue
    return found


@dataclass
class SwingUpAndCatch:
    """Swings up, hands over inside the catch region, goes back when thrown out.

    Parameters
    ----------
    swing, region
        The two halves.
    every
        Time between two tests of the region, s.
    patience
        Time after which a swing-up that has not led to a catch goes on with other gains, s.
    lost
        Free coordinates further than this from the target have been thrown out, rad or m.

    Attributes
    ----------
    events
        (t, "catch" or "lost") in order.
    """

    swing: SwingUp
    region: CatchRegion
    every: float = 0.005
    patience: float = 4.0
    lost: float = math.radians(60.0)
    events: list[tuple[float, str]] = field(default_factory=list)
    _law: InnerLoop | None = None
    _offset: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    _next: float = 0.0
    _since: float | None = None
    _choice: int = 0

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x), (1,)."""
        m, n = self.region.mechanism.m, self.region.mechanism.n
        if self._law is not None:
            home = x - self._offset
            if np.abs(home[m:n]).max() <= self.lost:
                return self._law(home)
            self._law, self._since = None, None
            self.events.append((t, "lost"))
        if self._since is None:
            self._since = t
        if t - self._since > self.patience:
            self._since, self._choice = t, self._choice + 1
        offset = self.region.turns(x)
        if t >= self._next and self.worth_asking(x):
            self._next = t + self.every
            surface = self.region.surface(x - offset)
            if surface is not None:
                self._law = InnerLoop(self.region.mechanism, surface, self.region.reaching)
                self._offset = offset
                self.events.append((t, "catch"))
                return self._law(x - offset)
        return self.swing(x, self._choice)

    def worth_asking(self, x: FloatArray) -> bool:
        """Whether a catch from x is worth the rollouts that answer it: a cheap test."""
        m, n = self.region.mechanism.m, self.region.mechanism.n
        home = x - self.region.turns(x)
        return bool(np.abs(home[m:n]).max() <= 0.8 * self.lost) and self.region.worth_asking(home)

    def ahead(self, x: FloatArray, seconds: float, choice: int = 0) -> FloatArray:
        """Return where the swing-up, with one choice of its gains, brings x in a while, (2n,)."""
        rig = IdealRig(self.region.mechanism, x)
        for _ in range(round(seconds / rig.period)):
            rig.write(self.swing(rig.truth, choice))
        return rig.truth

    @property
    def balancing(self) -> bool:
        """Whether the law is in charge."""
        return self._law is not None

    @property
    def offset(self) -> FloatArray:
        """Whole turns that count as the target, (2n,)."""
        return self._offset if self.balancing else np.zeros(2 * self.region.mechanism.n)
