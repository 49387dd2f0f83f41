"""The whole closed loop, boundary layer and input clip included, in coordinates (q, p, s).

With p = N (M_auᵀ q̇_a + M_uu q̇_u), N⁻¹ = M_uu at the target, and s the surface (10),

    q̇ from  [N M_auᵀ  N M_uu; α_a α_u] q̇ = [p; s − λ_a q_a − λ_u q_u],
    ṗ = N f_u + d/dt[N M_auᵀ  N M_uu] q̇,
    ṡ = −K sat(s/ε) + Γ S⁻¹ B [clip(u) − u°],

where u is what the law (5), (12) demands and u° is what it would demand if it knew the plant
(u° = u for a plant that is the law's own model).  The input acts on s alone; unsaturated and
with a known plant ṡ = −K sat(s/ε) exactly.  det E, E = M_uu − M_auᵀ α_a⁻¹ α_u, is not zero
where these coordinates exist, which is where Γ is invertible (37).

A held input is a matter of :mod:`undertow.proofs.closed_loop.sampled_data`, which builds on the
parts here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from undertow.law import ReachingLaw, Surface, check_surface_shape
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.closed_loop.parts import LoopEquations
from undertow.proofs.closed_loop.pieces import excess, saturation, stacked
from undertow.proofs.closed_loop.program import LoopFunctions
from undertow.proofs.closed_loop.tube import Paths, matmul, stack
from undertow.proofs.intervals.batch import Interval
from undertow.proofs.intervals.exact_model import exact_mechanism, is_odd, vanishes
from undertow.proofs.intervals.require import require, require_autonomous
from undertow.proofs.region.motion import unused


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
    ModelError
        For a model that is not smooth.
    """

    mechanism: Mechanism
    surface: Surface
    reaching: ReachingLaw = ReachingLaw()
    uncertain: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    period: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what this model of the loop does not cover."""
        mechanism = exact_mechanism(self.mechanism)
        object.__setattr__(self, "mechanism", mechanism)
        check_surface_shape(mechanism, self.surface)
        require_autonomous(mechanism, "region")
        require(
            self.reaching.switching == "saturation",
            "switching function of a proved loop",
            repr(self.reaching.switching),
            "'saturation'",
            "Use ReachingLaw(switching='saturation')",
        )
        require(
            not any(mechanism.disturbance_bounds),
            "gains of a proved loop",
            "state-dependent gains (13)",
            "constant gains",
            "Declare no disturbance bounds; certify.reaching says what K overcomes",
        )
        own = {p.name: p.value for p in mechanism.parameters}
        for name, (low, high) in self.uncertain.items():
            good = name in own and low <= own[name] <= high
            limit = f"low ≤ {own[name]} ≤ high" if name in own else ", ".join(sorted(own))
            require(good, "uncertain parameter", f"{name}: [{low}, {high}]", limit)
        good = np.isfinite(self.period) and self.period >= 0
        require(good, "period of a held input", self.period, "finite, ≥ 0 s")

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
        made = [*(f"p_{k.name}" for k in c[m:]), *(f"s_{k.name}" for k in c[:m])]
        names = [k.name for k in c]
        return (*names, *unused(made, names))

    @cached_property
    def gains(self) -> tuple[FloatArray, FloatArray]:
        """K and ε, (m,) each."""
        return self.reaching.per_surface(self.mechanism.m)

    @cached_property
    def odd(self) -> bool:
        """Whether the loop commutes with z → −z, decided on the mechanism's expressions."""
        even = [*self.mechanism.mass_matrix, *self.mechanism.input_matrix]
        return is_odd(self.mechanism.force, self.mechanism.x, even)

    @cached_property
    def at_rest(self) -> bool:
        """Whether the target is an equilibrium without input, decided symbolically."""
        return vanishes(self.mechanism.force, self.mechanism.x)

    # -- equations -----------------------------------------------------------------------

    @cached_property
    def equations(self) -> LoopEquations:
        """The parts of the equations over boxes."""
        eta, layer = self.gains
        program = LoopFunctions(self.mechanism, self.surface, eta, self.uncertain.keys())
        return LoopEquations(self.mechanism, program, layer, self._spread)

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

    def __call__(self, z: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return ż and the demand in float64: (…, N) to (…, N), (…, m)."""
        columns = np.moveaxis(np.asarray(z, dtype=float), -1, 0)
        eta, layer = self.gains
        n_slow, m = self.slow, self.mechanism.m
        switch = np.clip(np.moveaxis(columns[n_slow:], 0, -1) / layer, -1, 1)
        with np.errstate(all="ignore"):
            values = self.equations.program.floats(
                *columns, *np.moveaxis(switch, -1, 0), *self.mechanism.parameter_values
            )
        shape = columns.shape[1:]
        values = [np.broadcast_to(v, shape) for v in values]
        u = np.stack(values[n_slow : n_slow + m], axis=-1)
        W = np.stack(values[n_slow + m :][: m * m], axis=-1).reshape(*shape, m, m)
        limit = self.mechanism.input_limits
        excess = np.clip(u, -limit, limit) - u
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
        parts = self.equations.parts(z, switch, bend, middle=middle, paths=paths)
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
        decay = Interval.zeros(m, columns, lanes)
        for i in range(m):
            decay[i, slow + i] = -(hold[i] * bend[i])
        s_rate = push - hold * stacked(switch, lanes)
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

    def bend(self, z: Interval, rate: Interval) -> Interval:
        """Enclose d/dt of the slopes of the slow rows, (2n − m, N + k, L), for ż in ``rate``."""
        return self.equations.bend(z, rate)
