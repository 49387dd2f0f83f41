"""The whole closed loop, boundary layer and input clip included, in coordinates (q, p, s).

With p = M₀⁻¹ (M_auᵀ q̇_a + M_uu q̇_u), M₀ = M_uu at the target, and s the surface (10),

    q̇ from  [M_auᵀ M_uu; α_a α_u] q̇ = [M₀ p; s − λ_a q_a − λ_u q_u],
    ṗ = M₀⁻¹ (f_u + d/dt[M_auᵀ M_uu] q̇),
    ṡ = −K sat(s/ε) + Γ S⁻¹ B [clip(u) − u°],

where u is what the law (5), (12) demands and u° is what it would demand if it knew the plant
(u° = u for a plant that is the law's own model).  The input acts on s alone; unsaturated and
with a known plant ṡ = −K sat(s/ε) exactly.  det E, E = M_uu − M_auᵀ α_a⁻¹ α_u, is not zero
where these coordinates exist, which is where Γ is invertible (37).

sat and clip are Lipschitz, not smooth: their slopes are enclosed by intervals that hold every
slope between two points of the box (Clarke's generalised derivative), which is all that a mean
value form needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from undertow.certify.batch import Interval, IntervalArithmetic
from undertow.certify.interval import OutwardFunction, compile_outward, derivative_tape
from undertow.certify.tube import Paths, bracket, matmul
from undertow.codegen import Tape, compile_numpy
from undertow.errors import InvalidInputError
from undertow.mechanism import TIME, Mechanism
from undertow.sliding import ReachingLaw, Surface, check_surface_shape

__all__ = ["LoopMotion", "LoopRates"]

FloatArray = NDArray[np.float64]


def _exact(block: ArrayLike) -> sp.Matrix:
    array = np.asarray(block, dtype=float)
    return sp.Matrix(
        *array.shape, [sp.Rational(*float(v).as_integer_ratio()) for v in array.ravel()]
    )


class LoopRates(NamedTuple):
    """The closed loop over boxes; the last axis counts boxes.

    ``rate`` (N, L) encloses ż, ``slope`` (N, N + k, L) its generalised derivatives in z and in
    the k uncertain parameters, ``demand`` (m, L) the unclipped input, and ``push`` (m, L) what
    clip and ignorance add to ṡ = −K sat(s/ε) + push.  ``kinked`` (L,) marks boxes in which an
    input may be on either side of its limit.
    """

    rate: Interval
    slope: Interval
    demand: Interval
    demand_slope: Interval
    push: Interval
    push_slope: Interval
    kinked: NDArray[np.bool_]

    def put(self, lanes: NDArray[np.intp], part: LoopRates) -> LoopRates:
        """Return the same with some boxes' answers replaced."""

        def one(old: Interval, new: Interval) -> Interval:
            lo, hi = old.lo.copy(), old.hi.copy()
            lo[..., lanes], hi[..., lanes] = new.lo, new.hi
            return Interval(lo, hi)

        kinked = self.kinked.copy()
        kinked[lanes] = part.kinked
        return LoopRates(*(one(a, b) for a, b in zip(self[:-1], part[:-1], strict=True)), kinked)


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
        the mechanism's own values.

    Raises
    ------
    InvalidInputError
        For a surface of another size, a force that depends on time, a switching function
        other than saturation, gains that vary with the state (declared disturbance bounds),
        or an unknown parameter.
    """

    mechanism: Mechanism
    surface: Surface
    reaching: ReachingLaw = ReachingLaw()
    uncertain: Mapping[str, tuple[float, float]] = field(default_factory=dict)

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
        names = {p.name for p in mechanism.parameters}
        for name, (low, high) in self.uncertain.items():
            if name not in names or not low <= high:
                raise InvalidInputError(
                    "uncertain parameter",
                    value=f"{name}: [{low}, {high}]",
                    limit=f"low ≤ high, one of {', '.join(sorted(names))}",
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
    def _unit(self) -> sp.Matrix:
        """M₀ in exact numbers (the nearest floats to its entries)."""
        m = self.mechanism.m
        return _exact(self.mechanism.M(np.zeros(self.mechanism.n))[m:, m:])

    @cached_property
    def _program(self) -> _Program:
        return _Program(self)

    @cached_property
    def _brackets(self) -> dict[str, tuple[float, float]]:
        """Uncertain parameters as middle ± radius, in the mechanism's order."""
        found = {}
        for p in self.mechanism.parameters:
            if p.name in self.uncertain:
                low, high = (np.asarray(v, dtype=float) for v in self.uncertain[p.name])
                middle, radius = bracket(low, high)
                found[p.name] = (float(middle), float(radius))
        return found

    @cached_property
    def radii(self) -> FloatArray:
        """Radii of the k uncertain parameters, (k,)."""
        return np.array([radius for _, radius in self._brackets.values()])

    def _parameters(self, middle: bool) -> list[Interval]:
        """Plant parameters as intervals, in the mechanism's order."""
        values = []
        for p in self.mechanism.parameters:
            centre, radius = self._brackets.get(p.name, (p.value, 0.0))
            one = Interval(centre)
            values.append(one if middle or not radius else one + Interval(-radius, radius))
        return values

    def from_state(self, x: ArrayLike) -> FloatArray:
        """Return z at states (q, q̇), (…, 2n), in float64, for the mechanism's own parameters."""
        state = self.mechanism.check_state(x)
        n, m = self.mechanism.n, self.mechanism.m
        q, v = state[..., :n], state[..., n:]
        momentum = np.einsum("...ij,...j->...i", self.mechanism.M(q)[..., m:, :], v)
        unit = np.array(self._unit, dtype=float)
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

    def over(self, z: Interval, *, middle: bool = False, paths: Paths | None = None) -> LoopRates:
        """Enclose ż, its slopes and the demand over boxes z, (N, L).

        Parameters
        ----------
        middle
            For the uncertain parameters' middle values alone.
        paths
            What is known of the points in the boxes besides.
        """
        program, m, slow = self._program, self.mechanism.m, self.slow
        eta, layer = self.gains
        lanes = z.lo.shape[1]
        rows = [z[i] for i in range(self.size)]
        switch, bend = zip(
            *(_saturation(rows[slow + i], float(layer[i])) for i in range(m)), strict=True
        )
        flat = program.boxes(*rows, *switch, *self._parameters(middle))
        get = _Reader(flat, lanes)
        columns = self.size + len(self.radii)
        rate = get.block(slow)
        slope = get.block(slow, columns)
        u = get.block(m)
        u_slope = get.block(m, columns + m)
        W = get.block(m, m)
        W_slope = get.block(m * m, columns)
        gap = get.block(m)
        gap_slope = get.block(m, columns + m)
        u_slope, gap_slope = (_through_switch(k, bend, columns, slow) for k in (u_slope, gap_slope))
        if not middle:
            # Mean value forms: the natural ones lose much to cancellation.
            known = _Known.of(z, self.radii) if paths is None else paths
            rate, u, gap = self._sharpen(known, (rate, slope), (u, u_slope), (gap, gap_slope))
        # ṡ = −K sat + W (excess + gap): the clip's excess, and what the law does not know.
        excess, kink = _excess(u, self.mechanism.input_limits)
        total = excess + gap
        total_slope = _expand(kink) * u_slope + gap_slope
        push = matmul(W, total[:, None])[:, 0]
        push_slope = matmul(W, total_slope)
        for j in range(m):
            push_slope = push_slope + W_slope.reshape(m, m, columns, lanes)[:, j] * total[j]
        hold = Interval(eta[:, None])
        decay = _zeros(m, columns, lanes)
        for i in range(m):
            loss = -(hold[i] * bend[i])
            decay.lo[i, slow + i], decay.hi[i, slow + i] = loss.lo, loss.hi
        s_rate = push - hold * _rows(switch)
        return LoopRates(
            _below(rate, s_rate),
            _below(slope, push_slope + decay),
            u,
            u_slope,
            push,
            push_slope,
            (kink.lo != kink.hi).any(axis=0),
        )

    def _sharpen(self, known: Paths, *pairs: tuple[Interval, Interval]) -> tuple[Interval, ...]:
        """Meet enclosures over boxes with values at a middle plus slopes times the way from it."""
        slow, middle = self.slow, Interval(known.middle)
        rows = [middle[i] for i in range(self.size)]
        layer = self.gains[1]
        switch = [_saturation(rows[slow + i], float(e))[0] for i, e in enumerate(layer)]
        flat = self._program.points(*rows, *switch, *self._parameters(True))
        get = _Reader(flat, known.middle.shape[1])
        return tuple(
            value.intersect(get.block(len(value.lo)) + known.way(slope)) for value, slope in pairs
        )

    def bend(self, z: Interval, rate: Interval) -> Interval:
        """Enclose d/dt of the slow rows of the slopes, (2n − m, N + k, L).

        Over boxes z (N, L) for velocities ż in ``rate`` (N, L).  The slow rows do not hold
        the input, so they are smooth where sat and clip have their corners.
        """
        lanes = z.lo.shape[1]
        rows = [z[i] for i in range(self.size)]
        speeds = [rate[i] for i in range(self.size)]
        flat = self._program.second(*rows, *speeds, *self._parameters(False))
        return _Reader(flat, lanes).block(self.slow, self.size + len(self.radii))


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


class _Program:
    """The equations on a tape, as float and as interval functions."""

    def __init__(self, motion: LoopMotion) -> None:
        mechanism = motion.mechanism
        n, m = mechanism.n, mechanism.m
        self.z = tuple(sp.Symbol(f"z_{i}", real=True) for i in range(2 * n))
        self.switch = tuple(sp.Symbol(f"sw_{i}", real=True) for i in range(m))
        tape = Tape()
        slow, q_dot = _slow_rates(tape, motion, self.z)
        state = dict(zip(mechanism.x, [*self.z[:n], *q_dot], strict=True))
        # Unknown parameters are the plant's; the law keeps its own numbers.
        own = {
            p.symbol: sp.Rational(*float(p.value).as_integer_ratio()) for p in mechanism.parameters
        }
        free = [p.symbol for p in mechanism.parameters if p.name in motion.uncertain]
        u, W = _law(tape, motion, state, q_dot, self.switch)
        gap: list[sp.Expr] = [sp.Integer(0)] * m
        if free:
            believed, _ = _law(tape, motion, {**state, **own}, q_dot, self.switch)
            gap = tape.let_all([a - b for a, b in zip(believed, u, strict=True)])
            u = believed
        inputs = [*self.z, *self.switch, *mechanism.parameter_symbols]
        self.floats = compile_numpy(tape, inputs, [*slow, *u, *W])
        state_like = [*self.z, *free]
        with_switch = [*self.z, *free, *self.switch]

        def slopes(outputs: Sequence[sp.Expr], variables: Sequence[sp.Symbol]) -> list[sp.Expr]:
            return [d for e in outputs for d in _derivatives(tape, variables, e)]

        outputs = [
            *slow, *slopes(slow, state_like), *u, *slopes(u, with_switch),
            *W, *slopes(list(W), state_like), *gap, *slopes(gap, with_switch),
        ]  # fmt: skip
        self.points: OutwardFunction = compile_outward(
            tape, inputs, [*slow, *u, *gap], IntervalArithmetic()
        )
        speeds = [sp.Symbol(f"dz_{i}", real=True) for i in range(2 * n)]
        first = slopes(slow, self.z)
        change = tape.let_all(
            sum(d * v for d, v in zip(first[i * 2 * n : (i + 1) * 2 * n], speeds, strict=True))
            for i in range(len(slow))
        )
        self.second: OutwardFunction = compile_outward(
            tape,
            [*self.z, *speeds, *mechanism.parameter_symbols],
            slopes(change, state_like),
            IntervalArithmetic(),
        )
        self.boxes: OutwardFunction = compile_outward(tape, inputs, outputs, IntervalArithmetic())


def _derivatives(tape: Tape, variables: Sequence[sp.Symbol], e: sp.Expr) -> list[sp.Expr]:
    if not sp.sympify(e).free_symbols:
        return [sp.Integer(0)] * len(variables)
    return derivative_tape(tape, variables, e)


def _slow_rates(
    tape: Tape, motion: LoopMotion, z: Sequence[sp.Symbol]
) -> tuple[list[sp.Expr], list[sp.Expr]]:
    """Lay (q̇, ṗ) on the tape; q̇ apart as atoms."""
    mechanism, surface = motion.mechanism, motion.surface
    n, m = mechanism.n, mechanism.m
    q, p, s = sp.Matrix(z[:n]), sp.Matrix(z[n : 2 * n - m]), sp.Matrix(z[2 * n - m :])
    where = dict(zip(mechanism.q, q, strict=True))
    lower = mechanism.mass_matrix[m:, :]
    rows = sp.Matrix(n - m, n, tape.let_all([e.xreplace(where) for e in lower]))
    inverse = _exact(surface.alpha_a).inv()
    alpha_u = _exact(surface.alpha_u)
    r = tape.matrix(s - _exact(surface.lambda_a) * q[:m, :] - _exact(surface.lambda_u) * q[m:, :])
    pull = tape.matrix(rows[:, :m] * inverse)
    E = tape.matrix(rows[:, m:] - pull * alpha_u)
    adjugate, determinant = tape.adjugate(E)
    reciprocal = tape.let(1 / determinant)
    right = tape.matrix(motion._unit * p - pull * r)
    v_u = tape.matrix(tape.product(adjugate, right) * reciprocal)
    v_a = tape.matrix(inverse * (r - alpha_u * v_u))
    q_dot = [*v_a, *v_u]
    rates = sp.zeros(n - m, n)
    for symbol, speed in zip(mechanism.q, q_dot, strict=True):
        rates += lower.diff(symbol).applyfunc(lambda e: e.xreplace(where)) * speed
    state = {**where, **dict(zip(mechanism.x[n:], q_dot, strict=True))}
    force = sp.Matrix([e.xreplace(state) for e in mechanism.force[m:, :]])
    p_dot = tape.matrix(motion._unit.inv() * (force + rates * sp.Matrix(q_dot)))
    return [*q_dot, *p_dot], q_dot


def _law(
    tape: Tape,
    motion: LoopMotion,
    rename: Mapping[sp.Symbol, sp.Expr],
    q_dot: Sequence[sp.Expr],
    switch: Sequence[sp.Symbol],
) -> tuple[list[sp.Expr], list[sp.Expr]]:
    """Lay the demand u, (5) with (12), and Γ S⁻¹ B on the tape."""
    mechanism, surface = motion.mechanism, motion.surface
    m = mechanism.m
    part = mechanism.partition(tape, dict(rename))
    alpha_u = _exact(surface.alpha_u)
    gamma = tape.matrix(_exact(surface.alpha_a) - alpha_u * part.X)
    adjugate, determinant = tape.adjugate(gamma)
    reciprocal = tape.let(1 / determinant)
    v = sp.Matrix(q_dot)
    eta, _ = motion.gains
    push = sp.Matrix([_exact([[k]])[0] * w for k, w in zip(eta, switch, strict=True)])
    drive = tape.matrix(
        alpha_u * part.y
        + _exact(surface.lambda_a) * v[:m, :]
        + _exact(surface.lambda_u) * v[m:, :]
        + push
    )
    wanted = tape.matrix(-tape.product(adjugate, drive) * reciprocal)
    force = tape.matrix(part.S * wanted - part.h)
    b_adjugate, b_determinant = tape.adjugate(part.B)
    u = tape.let_all(list(b_adjugate * force / b_determinant))
    W = tape.product(gamma, tape.cholesky(part.S).solve(part.B))
    return u, list(W)


# -- interval pieces -------------------------------------------------------------------------


class _Reader:
    """Takes blocks off a flat list of results, all broadcast to L boxes."""

    def __init__(self, flat: Sequence[Any], lanes: int) -> None:
        self.flat, self.lanes, self.at = [Interval.of(v) for v in flat], lanes, 0

    def block(self, *shape: int) -> Interval:
        count = int(np.prod(shape))
        part = self.flat[self.at : self.at + count]
        self.at += count
        lo = np.array([np.broadcast_to(v.lo, self.lanes) for v in part])
        hi = np.array([np.broadcast_to(v.hi, self.lanes) for v in part])
        return Interval(lo.reshape(*shape, self.lanes), hi.reshape(*shape, self.lanes))


def _below(upper: Interval, lower: Interval) -> Interval:
    """Stack two blocks of rows."""
    return Interval(np.concatenate([upper.lo, lower.lo]), np.concatenate([upper.hi, lower.hi]))


def _zeros(*shape: int) -> Interval:
    """Return zeros whose ends are arrays of their own, to be written to."""
    return Interval(np.zeros(shape), np.zeros(shape))


def _rows(parts: Sequence[Interval]) -> Interval:
    return Interval(np.array([v.lo for v in parts]), np.array([v.hi for v in parts]))


def _expand(v: Interval) -> Interval:
    return v[:, None]


def _saturation(s: Interval, layer: float) -> tuple[Interval, Interval]:
    """Return sat(s/ε) and its slopes in s, over boxes."""
    ratio = s * (1 / Interval(layer))
    value = Interval(np.clip(ratio.lo, -1.0, 1.0), np.clip(ratio.hi, -1.0, 1.0))
    inside = (ratio.lo >= -1) & (ratio.hi <= 1)
    outside = (ratio.lo >= 1) | (ratio.hi <= -1)
    slope = 1 / Interval(layer)
    return value, Interval(np.where(inside, slope.lo, 0.0), np.where(outside, 0.0, slope.hi))


def _excess(u: Interval, limits: FloatArray) -> tuple[Interval, Interval]:
    """Return clip(u) − u and its slopes in u, over boxes (m, L)."""
    limit = limits[:, None]
    free = (u.lo >= -limit) & (u.hi <= limit)
    clipped = (u.lo >= limit) | (u.hi <= -limit)
    # Decreasing in u: its extremes are at the ends.
    low = Interval(np.clip(u.lo, -limit, limit)) - Interval(u.lo)
    high = Interval(np.clip(u.hi, -limit, limit)) - Interval(u.hi)
    value = Interval(np.where(free, 0.0, high.lo), np.where(free, 0.0, low.hi))
    return value, Interval(np.where(free, 0.0, -1.0), np.where(clipped, -1.0, 0.0))


def _through_switch(slope: Interval, bend: Sequence[Interval], columns: int, slow: int) -> Interval:
    """Turn derivatives in (z, parameters, sw) into those in (z, parameters): sw = sat(s)."""
    lo, hi = slope.lo[:, :columns].copy(), slope.hi[:, :columns].copy()
    for i, b in enumerate(bend):
        at = slow + i
        more = Interval(lo[:, at], hi[:, at]) + b * Interval(
            slope.lo[:, columns + i], slope.hi[:, columns + i]
        )
        lo[:, at], hi[:, at] = more.lo, more.hi
    return Interval(lo, hi)
