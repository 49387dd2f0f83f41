"""What the optimiser may choose, and the coordinates in which it searches.

Surface entries are searched in symmetric-logarithmic coordinates z with p = w sinh z, entry
by entry, around a first surface: entries may change sign, and small and large values are
resolved alike.  Reaching gains are searched as ln η, and the boundary layer through the
rate η/ε, kept between 1/s and what the integration step can bear; where the rate alone is
free, as its logarithm, up to that of the reaching law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from undertow.base import InvalidInputError, check_fields, checked, checked_names, positive, require
from undertow.closed_loop import ClosedLoop, RolloutBuffers
from undertow.closed_loop.trajectory import Batch
from undertow.law import LawLayout, Plan, ReachingLaw, Surface, rising_from_zero
from undertow.models import FloatArray, growth_rate
from undertow.objective import ERROR_PRICE, finite_limits
from undertow.symbolic import compiled

#: Slowest rate η/ε at which a surface is reached, 1/s, where the rate alone is free; and how many
#: times as fast as what leaves the target by itself it is at least: a slower law bears little that
#: the model does not know.
SLOWEST, FASTER = 1.0, 2.0


@checked_names
@dataclass(frozen=True)
class DecisionVariables:
    """What may be chosen besides the paper's surface parameters λ_a, α_u, λ_u.

    Parameters
    ----------
    reaching
        Also the reaching gains η_i and the layers ε_i.
    times
        Times at which further surfaces take over, s; the first is 0: a schedule.
    alpha_a
        Also the off-diagonal entries of α_a (m > 1); its diagonal stays −1.
    rate
        Of the reaching law the rates η_i/ε_i alone, at most those of the given law, whose gains η_i
        stay: near the target it may be gentler then, and far from it is as strong as ever.
        ``None``: a cascade frees them where that pays, see :meth:`for_loop`; an optimiser by itself
        does not.
    schedule
        Surfaces one after another, with their reaching laws.  For least time each for so long, s,
        and as many as the motion needs; for another cost five, the first for so long or longer,
        the others for twice the time each, the last one for good.  0: those of ``times``.

    Raises
    ------
    InvalidInputError
        For times that do not rise from 0, a schedule without free reaching laws or with times, and
        rates besides reaching laws.
    """

    reaching: bool = False
    times: tuple[float, ...] = (0.0,)
    alpha_a: bool = False
    schedule: float = 0.0
    rate: bool | None = None

    def __post_init__(self) -> None:
        """Refuse times that do not rise from 0, and a schedule of fixed gains."""
        check_fields(self)
        positive("schedule", self.schedule, "0.1 s, the cascade's period, is usual", zero=True)
        if self.schedule and not (self.reaching and self.times == (0.0,)):
            raise InvalidInputError(
                "schedule",
                value=f"{self.schedule:g} s, reaching={self.reaching}, times={self.times}",
                limit="free reaching laws, no other times",
                remedy="Write DecisionVariables(reaching=True, schedule=0.1)",
            )
        if self.rate and self.reaching:
            raise InvalidInputError(
                "decision variables",
                value="reaching=True, rate=True",
                limit="one of them: a free reaching law has its own rate",
            )
        rising = rising_from_zero(self.times)
        require(rising, "times of a schedule", self.times, "rising times from 0 s")

    @property
    def plainer(self) -> DecisionVariables | None:
        """A set that this one contains: one surface, then plain reaching, then plain α_a.

        ``None`` for the paper's three parameters, with free rates too: these are found as surely
        from the beginning.
        """
        if self.schedule or len(self.times) > 1:
            return replace(self, schedule=0.0, times=(0.0,))
        if self.reaching:
            return replace(self, reaching=False)
        return replace(self, alpha_a=False) if self.alpha_a else None

    @checked
    def for_loop(self, loop: ClosedLoop) -> DecisionVariables:
        """Return these as they suit a closed loop: rates that were left open are free, or not.

        They are where the reaching law is not, the cost is smooth, and an error of each coordinate
        costs at least what it does in ``effort`` beside the full input: what is best near the
        target is a linear-quadratic regulator then, which brings every coordinate home.  Where
        errors cost less it is so gentle that dry friction takes more than is saved.
        """
        if self.rate is not None or self.reaching:
            return self
        return replace(self, rate=not loop.price_of_time > 0 and _regulates(loop))


def _regulates(loop: ClosedLoop) -> bool:
    mechanism, stage = loop.mechanism, loop.objective.stage_function(loop.mechanism)
    n, size = mechanism.n, 2 * mechanism.n + mechanism.m
    full = np.r_[np.zeros(2 * n), finite_limits(mechanism)]
    rest, effort, *errors = (
        float(stage(*at)[0]) for at in (np.zeros(size), full, *np.eye(size)[:n])
    )
    least = ERROR_PRICE * (effort - rest) / mechanism.m
    return all(error - rest >= least * (1 - 1e-9) for error in errors)


class SearchSpace:
    """Search coordinates z for plans of one closed loop.

    ``loop``: the closed loop: its reaching law is the centre of the reaching coordinates.
    ``anchor``: first surface: sets the scale of each entry. ``freedom``: what may be chosen.
    """

    def __init__(self, loop: ClosedLoop, anchor: Surface, freedom: DecisionVariables) -> None:
        self.loop, self.anchor, self.freedom = loop, anchor, freedom
        n, m = loop.mechanism.n, loop.mechanism.m
        self.n, self.m, layout = n, m, LawLayout(n, m)
        scale, searched = np.abs(anchor.normalised().vector), np.ones(2 * m * n, dtype=bool)
        largest = scale[layout.starts[1] :].max()
        layout.blocks(scale).alpha_a[:] = 1.0
        layout.blocks(searched).alpha_a[:] = ~np.eye(m, dtype=bool) & freedom.alpha_a
        self._free = searched
        self._width = 0.1 * np.maximum(scale, 0.05 * largest)[self._free]
        self._base = -np.eye(m).ravel()
        self._places = np.flatnonzero(self._free)
        # Runge-Kutta is stable up to a rate of 2.8/step; the law is resolved up to 0.8/step.
        self._fastest = 0.8 / (loop.step * max(1, loop.zoh_steps))
        eta, layer = loop.reaching.per_surface(m)
        self._eta, self._highest = eta, eta / layer
        slowest = max(SLOWEST, FASTER * growth_rate(loop.mechanism)) if freedom.rate else np.inf
        self._lowest = np.minimum(slowest, self._highest)
        #: Whether the rates alone are free: a thick layer may leave them no room.
        self.rate = bool((self._lowest < self._highest).any())

    def at(self, times: tuple[float, ...]) -> SearchSpace:
        """Return the coordinates of the same kind for surfaces that take over at these times, s."""
        freedom = replace(self.freedom, times=times, schedule=0.0)
        return SearchSpace(self.loop, self.anchor, freedom)

    @property
    def segments(self) -> int:
        """Surfaces in a plan."""
        return len(self.freedom.times)

    @property
    def _entries(self) -> int:
        return int(self._free.sum())

    @property
    def size(self) -> int:
        """Dimension of z."""
        return self.segments * (self._entries + self.m * self._per_input)

    @property
    def frees_law(self) -> bool:
        """Whether anything of the reaching law is free, so that each plan has its own."""
        return self._per_input > 0

    @property
    def _per_input(self) -> int:
        """Numbers of the reaching law that are free, for each input."""
        return 2 if self.freedom.reaching else int(self.rate)

    def steps(self, rng: np.random.Generator, spread: FloatArray) -> FloatArray:
        """Draw steps in z, (N, d), of standard deviations ``spread``, (N,).

        The surfaces of a schedule move together, and each a little by itself.
        """
        size = (len(spread), self.segments, self.size // self.segments)
        drawn = rng.standard_normal((size[0], 1, size[2])).repeat(self.segments, axis=1)
        if self.segments > 1:
            drawn = drawn + 0.4 * rng.standard_normal(size)
        return spread[:, None] * drawn.reshape(len(spread), -1)

    def encode(self, plan: Plan) -> FloatArray:
        """Return the coordinates of a plan, sampled at the times of the schedule, (d,)."""
        parts = []
        for t in self.freedom.times:
            surface, law = plan.at(t)
            parts.append(np.arcsinh(surface.normalised().vector[self._free] / self._width))
            if self.freedom.reaching:
                eta, layer = (law or self.loop.reaching).per_surface(self.m)
                part = np.clip((eta / layer - 1.0) / (self._fastest - 1.0), 1e-6, 1 - 1e-6)
                parts += [np.log(eta), np.log(part / (1 - part))]
            elif self.rate:
                eta, layer = (law or self.loop.reaching).per_surface(self.m)
                parts.append(np.log(np.clip(eta / layer, self._lowest, self._highest)))
        return np.concatenate(parts)

    def decode(self, z: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Return surface vectors (N, S, 2mn) and gains (N, S, 2m) of coordinates (N, d)."""
        rows = z.reshape(len(z), self.segments, -1)
        vectors = np.empty((len(z), self.segments, 2 * self.m * self.n))
        gains = np.empty((len(z), self.segments, 2 * self.m * self.freedom.reaching))
        _decode(rows, self._base, self._places, self._width, self._fastest, vectors, gains)
        if self.rate:
            low, high = np.log(self._lowest), np.log(self._highest)
            layer = self._eta / np.exp(np.clip(rows[:, :, self._entries :], low, high))
            gains = np.concatenate([np.broadcast_to(self._eta, layer.shape), layer], axis=2)
        return vectors, gains if self.frees_law else None

    def plan(self, z: FloatArray) -> Plan:
        """Return the plan at some coordinates, (d,)."""
        vectors, gains = self.decode(z[None])
        surfaces = tuple(Surface.from_vector(v, self.n, self.m) for v in vectors[0])
        laws = None
        if gains is not None:
            switching = self.loop.reaching.switching
            laws = tuple(
                ReachingLaw(tuple(row[: self.m]), tuple(row[self.m :]), switching)
                for row in gains[0].tolist()
            )
        return Plan(surfaces, self.freedom.times, laws)

    def batch(self, x: FloatArray, z: FloatArray, **how: Any) -> Batch:
        """Roll out the plans at coordinates (N, d) from a state, see ``ClosedLoop.roll_out``."""
        buffers = RolloutBuffers(self.loop, len(z), self.segments).fill(x, *self.decode(z))
        return self.loop.roll_out(buffers, self.freedom.times, **how)


@compiled(small=True)
def _decode(rows, base, places, width, fastest, vectors, gains):  # type: ignore[no-untyped-def]
    m, free = gains.shape[2] // 2, len(places)
    for k in range(rows.shape[0]):
        for segment in range(rows.shape[1]):
            for j in range(vectors.shape[2]):
                vectors[k, segment, j] = base[j] if j < len(base) else 0.0
            for j in range(free):
                z = max(-15.0, min(15.0, rows[k, segment, j]))
                vectors[k, segment, places[j]] = width[j] * math.sinh(z)
            for j in range(m):
                eta = math.exp(max(-5.0, min(10.0, rows[k, segment, free + j])))
                logit = max(-14.0, min(14.0, rows[k, segment, free + m + j]))
                rate = 1.0 + (fastest - 1.0) / (1.0 + math.exp(-logit))
                gains[k, segment, j] = eta
                gains[k, segment, m + j] = eta / rate
