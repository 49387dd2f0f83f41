"""The whole closed loop, boundary layer and input clip included, in coordinates (q, p, s).

With p = N (M_auᵀ q̇_a + M_uu q̇_u), N⁻¹ = M_uu at the target, and s the surface (10),

    q̇ from  [N M_auᵀ  N M_uu; α_a α_u] q̇ = [p; s − λ_a q_a − λ_u q_u],
    ṗ = N f_u + d/dt[N M_auᵀ  N M_uu] q̇,
    ṡ = −K sat(s/ε) + Γ S⁻¹ B [clip(u) − u°],

where u is what the law (5), (12) demands and u° is what it would demand if it knew the plant
(u° = u for a plant that is the law's own model).  The input acts on s alone; unsaturated and
with a known plant ṡ = −K sat(s/ε) exactly.  det E, E = M_uu − M_auᵀ α_a⁻¹ α_u, is not zero
where these coordinates exist, which is where Γ is invertible (37).

A held input is a matter of :mod:`undertow.certify.loop_held`, which builds on the parts here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from undertow.certify.batch import Interval
from undertow.certify.interval import OutwardFunction
from undertow.certify.loop_pieces import (
    Reader,
    excess,
    saturation,
    stacked,
    through_switch,
    zeros,
)
from undertow.certify.loop_program import LoopProgram
from undertow.certify.tube import Paths, matmul, stack
from undertow.errors import InvalidInputError
from undertow.mechanism import TIME, Mechanism
from undertow.sliding import ReachingLaw, Surface, check_surface_shape

__all__ = ["LoopMotion", "LoopParts", "LoopRates", "put_boxes"]

FloatArray = NDArray[np.float64]


class LoopRates(NamedTuple):
    """The closed loop over boxes; the last axis counts boxes.

    ``rate`` (N, L) encloses ż, ``slope`` (N, N + k, L) its generalised derivatives in z and in
    the k uncertain parameters, ``demand`` (m, L) the unclipped input, and ``push`` (m, L) what
    clip and ignorance add to ṡ = −K sat(s/ε) + push.  ``kinked`` (L,) marks boxes in which an
    input may be on either side of its limit; ``W`` (m, m, L) is ∂ṡ/∂u.
    """

    rate: Interval
    slope: Interval
    demand: Interval
    demand_slope: Interval
    push: Interval
    push_slope: Interval
    W: Interval
    kinked: NDArray[np.bool_]

    def put(self, lanes: NDArray[np.intp], part: LoopRates) -> LoopRates:
        """Return the same with some boxes' answers replaced."""
        return LoopRates(*put_boxes(self, lanes, part))


def put_boxes(whole: tuple[Any, ...], lanes: NDArray[np.intp], part: tuple[Any, ...]) -> list[Any]:
    """Return entries, intervals or masks whose last axis counts boxes, with some replaced."""

    def one(old: Any, new: Any) -> Any:
        copy = old.copy()
        copy[..., lanes] = new
        return copy

    return [
        Interval(one(a.lo, b.lo), one(a.hi, b.hi)) if isinstance(a, Interval) else one(a, b)
        for a, b in zip(whole, part, strict=True)
    ]


class LoopParts(NamedTuple):
    """What the equations are made of, over boxes, with slopes in z and in k parameters.

    ``slow`` (2n − m, L), the ``demand`` (m, L), ``W`` = Γ S⁻¹ B (m, m, L), and the ``gap``
    (m, L): the demand less what it would be if the law knew the plant.  The slopes of demand
    and gap have m more columns, for sat(s/ε).
    """

    slow: Interval
    slow_slope: Interval
    demand: Interval
    demand_slope: Interval
    W: Interval
    W_slope: Interval
    gap: Interval
    gap_slope: Interval


@dataclass(frozen=True, eq=False)
class LoopMotion:
    """A mechanism under its sliding-mode law, in z = (q, p, s), of order N = 2n.

    Parameters
    ----------
    mechanism
        The model that the law was derived from, and the plant but for ``uncertain``.
    surface
        Where the law slides.
    reaching
        η and ε, constant; switching by saturation.
    uncertain
        Plant parameters that are only known to lie in [low, high], SI units; the law keeps
        the mechanism's own values, which lie in there too.
    period
        The input is renewed every ``period`` seconds and held between; 0: at every instant.

    Raises
    ------
    InvalidInputError
        For a surface of another size, a force that depends on time, a switching function
        other than saturation, gains that vary with the state (declared disturbance bounds),
        a parameter that is unknown or whose own value is outside its range, or a period that is
        no time.
    """

    mechanism: Mechanism
    surface: Surface
    reaching: ReachingLaw = ReachingLaw()
    uncertain: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    period: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what this model of the loop does not cover."""
        mechanism = self.mechanism
        check_surface_shape(mechanism, self.surface)
        if TIME in mechanism.force.free_symbols:
            raise InvalidInputError(
                f"force of '{mechanism.name}'",
                value="depends on time",
                limit="autonomous",
                remedy="Prove the region for the undisturbed mechanism",
            )
        if self.reaching.switching != "saturation":
            raise InvalidInputError(
                "switching function of a proved loop",
                value=repr(self.reaching.switching),
                limit="'saturation'",
                remedy="Use ReachingLaw(switching='saturation')",
            )
        if any(mechanism.disturbance_bounds):
            raise InvalidInputError(
                "gains of a proved loop",
                value="state-dependent gains (13)",
                limit="constant gains",
                remedy="Declare no disturbance bounds; certify.reaching says what K overcomes",
            )
        own = {p.name: p.value for p in mechanism.parameters}
        for name, (low, high) in self.uncertain.items():
            if name not in own or not low <= own[name] <= high:
                raise InvalidInputError(
                    "uncertain parameter",
                    value=f"{name}: [{low}, {high}]",
                    limit=f"low ≤ {own[name]} ≤ high" if name in own else ", ".join(sorted(own)),
                )
        if not (np.isfinite(self.period) and self.period >= 0):
            raise InvalidInputError(
                "period of a held input", value=self.period, limit="finite, ≥ 0 s"
            )

    # -- names and sizes -----------------------------------------------------------------

    @property
    def size(self) -> int:
        """N = 2n."""
        return 2 * self.mechanism.n

    @property
    def slow(self) -> int:
        """Number of slow coordinates (q, p): 2n − m."""
        return 2 * self.mechanism.n - self.mechanism.m

    @property
    def names(self) -> tuple[str, ...]:
        """Names of z."""
        c = self.mechanism.coordinates
        m = self.mechanism.m
        return (
            *(k.name for k in c),
            *(f"p_{k.name}" for k in c[m:]),
            *(f"s_{k.name}" for k in c[:m]),
        )

    @cached_property
    def gains(self) -> tuple[FloatArray, FloatArray]:
        """K and ε, (m,) each."""
        eta, layer = np.split(self.reaching.vector(self.mechanism.m), 2)
        return eta, layer

    @cached_property
    def odd(self) -> bool:
        """Whether the loop commutes with z → −z, decided on the mechanism's expressions."""
        flip = {x: -x for x in self.mechanism.x}
        even = [*self.mechanism.mass_matrix, *self.mechanism.input_matrix]
        whole = [e - e.xreplace(flip) for e in even]
        whole += [e + e.xreplace(flip) for e in self.mechanism.force]
        return all(sp.expand(e) == 0 for e in whole)

    @cached_property
    def at_rest(self) -> bool:
        """Whether the target is an equilibrium without input, decided symbolically."""
        origin = dict.fromkeys(self.mechanism.x, 0)
        return all(sp.simplify(e.subs(origin)) == 0 for e in self.mechanism.force)

    # -- equations -----------------------------------------------------------------------

    @cached_property
    def _program(self) -> LoopProgram:
        return LoopProgram(self.mechanism, self.surface, self.gains[0], self.uncertain.keys())

    @cached_property
    def _spread(self) -> dict[str, float]:
        """Uncertain parameters: how far from the law's own value, in the mechanism's order."""
        found = {}
        for p in self.mechanism.parameters:
            if p.name in self.uncertain:
                low, high = self.uncertain[p.name]
                own = Interval(p.value)
                ends = (Interval(high) - own).hi, (own - Interval(low)).hi
                found[p.name] = max(0.0, *(float(e) for e in ends))
        return found

    @cached_property
    def radii(self) -> FloatArray:
        """Radii of the k uncertain parameters around the law's own values, (k,)."""
        return np.array(list(self._spread.values()))

    def _parameters(self, middle: bool) -> list[Interval]:
        """Plant parameters as intervals, in the mechanism's order."""
        values = []
        for p in self.mechanism.parameters:
            radius = 0.0 if middle else self._spread.get(p.name, 0.0)
            one = Interval(p.value)
            values.append(one + Interval(-radius, radius) if radius else one)
        return values

    def from_state(self, x: ArrayLike) -> FloatArray:
        """Return z at states (q, q̇), (…, 2n), in float64, for the mechanism's own parameters."""
        state = self.mechanism.check_state(x)
        n, m = self.mechanism.n, self.mechanism.m
        q, v = state[..., :n], state[..., n:]
        momentum = np.einsum("...ij,...j->...i", self.mechanism.M(q)[..., m:, :], v)
        unit = self.mechanism.M(np.zeros(n))[m:, m:]
        if self.uncertain:
            unit = np.diag(np.diag(unit))
        p = np.linalg.solve(unit, momentum[..., None])[..., 0]
        return np.concatenate([q, p, self.surface.s(state)], axis=-1)

    def rest(self, q: Sequence[Interval]) -> list[Interval]:
        """Return z for a box of positions at rest: p = 0 and s = λ_a q_a + λ_u q_u."""
        row = self.surface.position_row
        p = [Interval(np.zeros_like(q[0].lo)) for _ in range(self.slow - len(q))]
        s = []
        for weights in row:
            total = Interval(np.zeros_like(q[0].lo))
            for weight, value in zip(weights, q, strict=True):
                total = total + Interval(float(weight)) * value
            s.append(total)
        return [*q, *p, *s]

    def __call__(self, z: ArrayLike, clipped: bool = True) -> tuple[FloatArray, FloatArray]:
        """Return ż and the demand in float64: (…, N) to (…, N), (…, m)."""
        columns = np.moveaxis(np.asarray(z, dtype=float), -1, 0)
        eta, layer = self.gains
        n_slow, m = self.slow, self.mechanism.m
        switch = np.clip(np.moveaxis(columns[n_slow:], 0, -1) / layer, -1, 1)
        with np.errstate(all="ignore"):
            values = self._program.floats(
                *columns, *np.moveaxis(switch, -1, 0), *self.mechanism.parameter_values
            )
        shape = columns.shape[1:]
        values = [np.broadcast_to(v, shape) for v in values]
        u = np.stack(values[n_slow : n_slow + m], axis=-1)
        W = np.stack(values[n_slow + m :][: m * m], axis=-1).reshape(*shape, m, m)
        limit = self.mechanism.input_limits
        excess = np.clip(u, -limit, limit) - u if clipped else np.zeros_like(u)
        s_dot = -eta * switch + np.einsum("...ij,...j->...i", W, excess)
        return np.concatenate([np.stack(values[:n_slow], axis=-1), s_dot], axis=-1), u

    def over(
        self,
        z: Interval,
        *,
        middle: bool = False,
        paths: Paths | None = None,
        brief: bool = False,
    ) -> LoopRates:
        """Enclose ż, its slopes and the demand over boxes z, (N, L).

        Parameters
        ----------
        middle
            For the uncertain parameters' middle values alone.
        paths
            What is known of the points in the boxes besides.
        brief
            Without effect: all slopes are enclosed.
        """
        m, slow = self.mechanism.m, self.slow
        eta, layer = self.gains
        lanes, columns = z.lo.shape[1], self.size + len(self.radii)
        switch, bend = zip(
            *(saturation(z[slow + i], float(layer[i])) for i in range(m)), strict=True
        )
        parts = self.parts(z, switch, bend, middle=middle, paths=paths)
        u, gap, W = parts.demand, parts.gap, parts.W
        # ṡ = −K sat + W (excess + gap): the clip's excess, and what the law does not know.
        more, kink = excess(u, self.mechanism.input_limits)
        total = more + gap
        total_slope = kink[:, None] * parts.demand_slope + parts.gap_slope
        push = matmul(W, total[:, None])[:, 0]
        push_slope = matmul(W, total_slope)
        for j in range(m):
            push_slope = push_slope + parts.W_slope[:, j] * total[j]
        hold = Interval(eta[:, None])
        decay = zeros(m, columns, lanes)
        for i in range(m):
            loss = -(hold[i] * bend[i])
            decay.lo[i, slow + i], decay.hi[i, slow + i] = loss.lo, loss.hi
        s_rate = push - hold * stacked(switch)
        return LoopRates(
            stack(parts.slow, s_rate),
            stack(parts.slow_slope, push_slope + decay),
            u,
            parts.demand_slope,
            push,
            push_slope,
            W,
            (kink.lo != kink.hi).any(axis=0),
        )

    def parts(
        self,
        z: Interval,
        switch: Sequence[Interval],
        bend: Sequence[Interval],
        *,
        middle: bool = False,
        paths: Paths | None = None,
    ) -> LoopParts:
        """Enclose the parts of the equations over boxes z, (N, L), for sat(s/ε) in ``switch``.

        ``bend`` holds the slopes of ``switch`` in s; the rest as for :meth:`over`.  Slopes of
        u and gap come back in z and the parameters alone.
        """
        m, slow, lanes, k = self.mechanism.m, self.slow, z.lo.shape[1], len(self.radii)
        rows = [z[i] for i in range(self.size)]
        own = self._parameters(True)
        parts = self._blocks(rows, switch, own if middle else self._parameters(False), lanes)
        if k:
            zero = zeros(m, lanes)
            if middle:  # the law knows a plant that is its own model
                parts = parts._replace(gap=zero, gap_slope=_in_parameters(parts.gap_slope, k, m))
            else:
                parts = self._around(parts, self._blocks(rows, switch, own, lanes), rows, switch)
        columns = self.size + k
        parts = parts._replace(
            demand_slope=through_switch(parts.demand_slope, bend, columns, slow),
            gap_slope=through_switch(parts.gap_slope, bend, columns, slow),
        )
        if middle:
            return parts
        # Mean value forms: the natural ones lose much to cancellation.
        known = _Known.of(z, self.radii) if paths is None else paths
        rate, u, gap = self._sharpen(
            known,
            (parts.slow, parts.slow_slope),
            (parts.demand, parts.demand_slope),
            (parts.gap, parts.gap_slope),
        )
        return parts._replace(slow=rate, demand=u, gap=gap)

    def _blocks(
        self,
        rows: Sequence[Interval],
        switch: Sequence[Interval],
        parameters: Sequence[Interval],
        lanes: int,
    ) -> LoopParts:
        m, slow, columns = self.mechanism.m, self.slow, self.size + len(self.radii)
        get = Reader(self._program.boxes(*rows, *switch, *parameters), lanes)
        return LoopParts(
            get.block(slow), get.block(slow, columns),
            get.block(m), get.block(m, columns + m),
            get.block(m, m), get.block(m, m, columns),
            get.block(m), get.block(m, columns + m),
        )  # fmt: skip

    def _around(
        self,
        wide: LoopParts,
        own: LoopParts,
        rows: Sequence[Interval],
        switch: Sequence[Interval],
    ) -> LoopParts:
        """Meet enclosures for unknown parameters with those around the law's own values.

        f(z, p) ∈ f(z, p̂) + ∂f/∂p (p − p̂) for a slope f too; the gap vanishes at p̂.  Natural
        enclosures of it would subtract two large numbers that hardly differ.
        """
        k, m, lanes = len(self.radii), self.mechanism.m, rows[0].lo.shape[0]
        slow, columns = self.slow, self.size + k
        get = Reader(self._program.mixed(*rows, *switch, *self._parameters(False)), lanes)
        unknown = Interval(-self.radii[:, None], self.radii[:, None])

        def change(block: Interval) -> Interval:
            """Last axis but one counts parameters."""
            total = block[..., 0, :] * unknown[0]
            for j in range(1, k):
                total = total + block[..., j, :] * unknown[j]
            return total

        gap_own = _in_parameters(own.gap_slope, k, m)
        slow_slope = own.slow_slope + change(get.block(slow, columns, k))
        demand_slope = own.demand_slope + change(get.block(m, columns + m, k))
        W_slope = own.W_slope + change(get.block(m, m, columns, k))
        gap_slope = gap_own + change(get.block(m, columns + m, k))
        gap_slope = wide.gap_slope.intersect(gap_slope)
        W = own.W + change(wide.W_slope[:, :, -k:])
        return LoopParts(
            wide.slow,
            wide.slow_slope.intersect(slow_slope),
            wide.demand,
            wide.demand_slope.intersect(demand_slope),
            wide.W.intersect(W),
            wide.W_slope.intersect(W_slope),
            wide.gap.intersect(change(gap_slope[:, self.size : columns])),
            gap_slope,
        )

    def _sharpen(self, known: Paths, *pairs: tuple[Interval, Interval]) -> tuple[Interval, ...]:
        """Meet enclosures over boxes with values at a middle plus slopes times the way from it."""
        slow, middle = self.slow, Interval(known.middle)
        rows = [middle[i] for i in range(self.size)]
        layer = self.gains[1]
        switch = [saturation(rows[slow + i], float(e))[0] for i, e in enumerate(layer)]
        flat = self._program.points(*rows, *switch, *self._parameters(True))
        get = Reader(flat, known.middle.shape[1])
        return tuple(
            value.intersect(get.block(len(value.lo)) + known.way(slope)) for value, slope in pairs
        )

    def slow_rates(self, z: Interval, middle: bool) -> tuple[Interval, Interval]:
        """Enclose the slow rows of ż, (2n − m, L), and their slopes, as :meth:`over` does."""
        if len(self.radii):
            rates = self.over(z, middle=middle)
            return rates.rate[: self.slow], rates.slope[: self.slow]
        rate, slope = self._slow_rates(z)
        if middle:
            return rate, slope
        known = _Known.of(z, self.radii)
        return rate.intersect(self._slow_rates(Interval(known.middle))[0] + known.way(slope)), slope

    def _slow_rates(self, z: Interval) -> tuple[Interval, Interval]:
        rows = [z[i] for i in range(self.size)]
        get = Reader(self._program.slow(*rows, *self._parameters(True)), z.lo.shape[1])
        return get.block(self.slow), get.block(self.slow, self.size)

    def jerk(self, z: Interval, speed: Interval, middle: bool) -> Interval:
        """Enclose s̈ for a held input, (m, L), over boxes z (N, L) and ṡ (m, L).

        With ``middle`` for the law's own parameters alone.
        """
        return self._jerk(self._program.jerk, z, speed, middle).block(self.mechanism.m)

    def jerk_slope(self, z: Interval, speed: Interval) -> tuple[Interval, Interval]:
        """Enclose s̈ and its slopes in (z, ṡ, parameters), (m, N + m + k, L)."""
        m = self.mechanism.m
        get = self._jerk(self._program.jerk_slope, z, speed, False)
        return get.block(m), get.block(m, self.size + m + len(self.radii))

    def _jerk(self, run: OutwardFunction, z: Interval, speed: Interval, middle: bool) -> Reader:
        rows, speeds = [z[i] for i in range(self.size)], [speed[i] for i in range(len(speed.lo))]
        return Reader(run(*rows, *speeds, *self._parameters(middle)), z.lo.shape[1])

    def bend(self, z: Interval, rate: Interval) -> Interval:
        """Enclose d/dt of the slow rows of the slopes, (2n − m, N + k, L).

        Over boxes z (N, L) for velocities ż in ``rate`` (N, L).  The slow rows do not hold
        the input, so they are smooth where sat and clip have their corners.
        """
        lanes = z.lo.shape[1]
        rows = [z[i] for i in range(self.size)]
        speeds = [rate[i] for i in range(self.size)]
        flat = self._program.second(*rows, *speeds, *self._parameters(False))
        return Reader(flat, lanes).block(self.slow, self.size + len(self.radii))


@dataclass(frozen=True)
class _Known:
    """Points of boxes: middle + away, parameters p̂ + unknown."""

    middle: FloatArray
    away: Interval

    @classmethod
    def of(cls, z: Interval, radii: FloatArray) -> _Known:
        middle = 0.5 * (z.lo + z.hi)
        off = z - Interval(middle)
        unknown = np.repeat(radii[:, None], middle.shape[1], axis=1)
        low, high = np.concatenate([off.lo, -unknown]), np.concatenate([off.hi, unknown])
        return cls(middle, Interval(low, high))

    def way(self, slope: Interval) -> Interval:
        return matmul(slope, self.away[:, None])[:, 0]


def _in_parameters(slope: Interval, k: int, m: int) -> Interval:
    """Return slopes (…, C + k + m, L) that vanish in z and in sat."""
    lo, hi = np.zeros_like(slope.lo), np.zeros_like(slope.hi)
    at = slice(slope.lo.shape[1] - k - m, slope.lo.shape[1] - m)
    lo[:, at], hi[:, at] = slope.lo[:, at], slope.hi[:, at]
    return Interval(lo, hi)
