"""Partial feedback linearisation and the sliding-mode law, (3)-(16).

For a mechanism with blocks as in (1), ``X = M_uu⁻¹ M_auᵀ`` and ``S = M_aa − M_au X``:

* surface            s = α_a q̇_a + λ_a q_a + α_u q̇_u + λ_u q_u                         (10)
* singularity        Γ = α_a − α_u X must be invertible
* reaching law       v = −Γ⁻¹ [α_u M_uu⁻¹ f_u + λ_a q̇_a + λ_u q̇_u + K sw(s/ε)]         (12)
* linearising input  u = B⁻¹ [S v − f_a + M_au M_uu⁻¹ f_u]                             (5)

so that ṡ = −K sw(s/ε) + α_a g̃_a + α_u g̃_u, with sw = sign, saturation (39) or tanh.
The formulas are for any n and m and are laid on a tape once; all else is generated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base import (
    REMEDIES,
    InvalidInputError,
    SingularSurfaceError,
    a_kind,
    check_fields,
    checked_names,
)
from undertow.law.surface import LawLayout, ReachingLaw, Surface, SurfaceBlocks, Switching
from undertow.models import TIME, FloatArray, Mechanism, Partition
from undertow.symbolic import Tape, compile_numpy


class LawSymbols(NamedTuple):
    """The symbols a law on a tape is written in."""

    layout: LawLayout
    surface: tuple[sp.Symbol, ...]
    eta: tuple[sp.Symbol, ...]
    layer: tuple[sp.Symbol, ...]
    gamma_target: sp.Symbol

    @classmethod
    def of(cls, n: int, m: int) -> LawSymbols:
        """Return the symbols for n coordinates and m inputs."""

        def row(stem: str, count: int) -> tuple[sp.Symbol, ...]:
            return tuple(sp.Symbol(f"_{stem}_{i}", real=True) for i in range(count))

        return cls(
            LawLayout(n, m),
            row("surface", 2 * m * n),
            row("eta", m),
            row("layer", m),
            sp.Symbol("_gamma_target", real=True),
        )

    @property
    def vector(self) -> tuple[sp.Symbol, ...]:
        """All of them, in the order of a law vector."""
        return (*self.surface, *self.eta, *self.layer, self.gamma_target)

    @property
    def blocks(self) -> SurfaceBlocks:
        """The surface's as matrices."""
        return self.layout.matrices(self.surface)


class LawOnTape(NamedTuple):
    """Atoms of the law on a tape."""

    u: list[sp.Expr]
    s: list[sp.Expr]
    gains: list[sp.Expr]
    determinant: sp.Expr
    margin: sp.Expr


def build_law_graph(
    part: Partition,
    x: Sequence[sp.Symbol],
    symbols: LawSymbols,
    switching: Switching,
    disturbance_bounds: Sequence[float],
    *,
    implicit: bool = False,
) -> LawOnTape:
    """Lay the sliding-mode law (5), (10), (12), (13) on the tape of a partition.

    With ``implicit`` sign(s) is that of implicit Euler, s₊ = s − h K sign(s₊), for steps of h, s,
    which stand in the places of ε: K sign(s₊) = min(K, max(−K, s/h)).  So the law slides on s = 0,
    as it does in continuous time, where sign(s) would chatter by what a step of some length moves
    it (Acary and Brogliato, Systems & Control Letters 59(5), 2010).

    ``margin`` is det Γ(q) / det Γ(0): 1 at the target, 0 where the law ceases to exist,
    (37).  Where it is exactly 0 the tiny number 1e-300 stands in, so no NaN can arise.
    """
    tape = part.tape
    m = part.B.rows
    free = part.M_uu.rows
    n = m + free
    alpha_a, lambda_a, alpha_u, lambda_u = symbols.blocks
    q_a, q_u = sp.Matrix(x[:m]), sp.Matrix(x[m:n])
    qd_a, qd_u = sp.Matrix(x[n : n + m]), sp.Matrix(x[n + m :])

    s = tape.let_all(list(alpha_a * qd_a + lambda_a * q_a + alpha_u * qd_u + lambda_u * q_u))
    gamma = tape.matrix(alpha_a - alpha_u * part.X)
    adjugate, determinant = tape.adjugate(gamma)
    gains = _gains(part, alpha_a, alpha_u, symbols.eta, disturbance_bounds)
    pushes = zip(s, gains, symbols.layer, strict=True)
    push = sp.Matrix(
        [
            sp.Max(-k, sp.Min(k, tape.let(one / e)))
            if implicit
            else k * _switch(tape, one, e, switching)
            for one, k, e in pushes
        ]
    )
    drive = tape.matrix(alpha_u * part.y + lambda_a * qd_a + lambda_u * qd_u + push)
    safe = sp.Piecewise((determinant, sp.Ne(determinant, 0)), (sp.Float(1e-300), True))
    inverse = tape.let(-1 / tape.let(safe))
    v = tape.matrix(tape.matrix(adjugate * drive) * inverse)
    force = tape.matrix(part.S * v - part.h)
    if part.B.is_diagonal():
        u = tape.let_all([force[i] / part.B[i, i] for i in range(m)])
    else:
        b_adjugate, b_determinant = tape.adjugate(part.B)
        u = tape.let_all(list(b_adjugate * force / b_determinant))
    margin = tape.let(determinant / symbols.gamma_target)
    return LawOnTape(u, s, gains, determinant, margin)


def _switch(tape: Tape, s: sp.Expr, layer: sp.Expr, switching: Switching) -> sp.Expr:
    """sw(s/ε): saturation (39), tanh, or sign (12)."""
    if switching == "sign":
        return tape.let(sp.sign(s))
    ratio = tape.let(s / layer)
    if switching == "tanh":
        return tape.let(sp.tanh(ratio))
    return tape.let(sp.Max(-1, sp.Min(1, ratio)))


def _gains(
    part: Partition,
    alpha_a: sp.Matrix,
    alpha_u: sp.Matrix,
    eta: Sequence[sp.Symbol],
    bounds: Sequence[float],
) -> list[sp.Expr]:
    """Gains (13) with bounds |g| ≤ ḡ in place of the unknown g.

    |g̃_a| ≤ |S⁻¹| (ḡ_a + |M_au M_uu⁻¹| ḡ_u) and |g̃_u| ≤ |M_uu⁻¹| ḡ_u + |X| |g̃_a|, (8)-(9).
    """
    if not any(bounds):
        return list(eta)
    tape, m, free = part.tape, part.B.rows, part.M_uu.rows
    g_a = sp.Matrix([sp.Float(b) for b in bounds[:m]])
    g_u = sp.Matrix([sp.Float(b) for b in bounds[m:]])
    S_inverse = tape.cholesky(part.S).solve(sp.eye(m)).applyfunc(sp.Abs)
    Muu_inverse = tape.cholesky(part.M_uu).solve(sp.eye(free)).applyfunc(sp.Abs)
    X = part.X.applyfunc(sp.Abs)
    bound_a = tape.matrix(S_inverse * (g_a + X.T * g_u))
    bound_u = tape.matrix(Muu_inverse * g_u + X * bound_a)
    worst_a, worst_u = tape.let(sp.Max(*bound_a)), tape.let(sp.Max(*bound_u))
    return [
        tape.let(
            eta[i]
            + sum(sp.Abs(a) for a in alpha_a.row(i)) * worst_a
            + sum(sp.Abs(a) for a in alpha_u.row(i)) * worst_u
        )
        for i in range(m)
    ]


class Control(NamedTuple):
    """What the law says at a state.

    ``u`` (m,) is clipped to the actuator's limits; ``demand`` (m,) is not; ``s`` (m,) the
    surface values; ``gains`` (m,) the k_i of (13); ``margin`` is det Γ(q)/det Γ(0), which
    must stay positive (37).
    """

    u: FloatArray
    demand: FloatArray
    s: FloatArray
    gains: FloatArray
    margin: FloatArray


@checked_names
@dataclass(frozen=True, eq=False)
class SlidingModeLaw:
    """The control law (5) with (12): a surface, a reaching law, actuator limits.

    Parameters
    ----------
    mechanism
        The model that the controller believes in.
    surface
        Where to slide.
    reaching
        How to get there.

    Raises
    ------
    InvalidInputError
        When the surface has another n or m than the mechanism.
    SingularSurfaceError
        When Γ is singular at the target itself.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> law = ut.SlidingModeLaw(rig, ut.Surface(-1, -0.5, 5, 10))
    >>> float(law(0.0, rig.state(phi=0.1)).u[0]) <= 15
    True
    """

    mechanism: Mechanism
    surface: Surface
    reaching: ReachingLaw = ReachingLaw()

    def __post_init__(self) -> None:
        """Check that surface and mechanism fit and that the law exists at the target."""
        check_fields(self)
        if TIME in self.mechanism.force.free_symbols:
            raise InvalidInputError(
                f"model '{self.mechanism.name}' of a sliding-mode law",
                value="a force that depends on the time t",
                limit="autonomous",
                remedy="Derive the law from the undisturbed model; disturb the plant alone",
            )
        check_surface_shape(self.mechanism, self.surface)
        if abs(self.gamma_target) < 1e-12:
            raise SingularSurfaceError(
                "α_a − α_u M_uu⁻¹ M_auᵀ at the target",
                value=f"determinant {self.gamma_target:.3g}",
                limit="not zero",
                remedy="Change α_u: the law does not exist there (37)",
            )

    @cached_property
    def gamma_target(self) -> float:
        """Determinant of Γ at the target."""
        return float(singularity(self.mechanism, self.surface.vector, np.zeros(self.mechanism.n)))

    @cached_property
    def _function(self) -> _LawFunction:
        return _law_function(self.mechanism, self.reaching.switching)

    def __call__(self, t: float, x: ArrayLike) -> Control:
        """Evaluate the law at the states x, (…, 2n).

        Parameters
        ----------
        t
            Time, s; the law does not depend on it.
        x
            States (q, q̇), SI units.

        Returns
        -------
        Control
            Never NaN; ``u`` is always within the actuator's limits.
        """
        state = self.mechanism.check_state(x)
        return self._function(
            self.mechanism,
            state,
            self.surface.vector,
            self.reaching.vector(self.mechanism.m),
            self.gamma_target,
        )


class _LawFunction:
    """The law of all mechanisms of one structure, compiled to NumPy."""

    def __init__(self, mechanism: Mechanism, switching: Switching) -> None:
        symbols = LawSymbols.of(mechanism.n, mechanism.m)
        tape = Tape()
        law = build_law_graph(
            mechanism.partition(tape), mechanism.x, symbols, switching, mechanism.disturbance_bounds
        )
        inputs = [*mechanism.x, *symbols.vector, *mechanism.parameter_symbols]
        self.run = compile_numpy(tape, inputs, [*law.u, *law.s, *law.gains, law.margin])

    def __call__(
        self,
        mechanism: Mechanism,
        x: FloatArray,
        surface: FloatArray,
        reaching: FloatArray,
        gamma_target: float | FloatArray,
    ) -> Control:
        m = mechanism.m
        # At absurd states powers overflow; the lines below turn what comes out into limits.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            values = self.run(
                *np.moveaxis(x, -1, 0),
                *surface,
                *reaching,
                gamma_target,
                *mechanism.parameter_values,
            )
        shape = x.shape[:-1]
        stacked = np.stack([np.broadcast_to(v, shape) for v in values], axis=-1)
        limit = mechanism.input_limits
        demand = np.nan_to_num(stacked[..., :m], nan=0.0, posinf=1e300, neginf=-1e300)
        return Control(
            np.clip(demand, -limit, limit),
            demand,
            stacked[..., m : 2 * m],
            stacked[..., 2 * m : 3 * m],
            stacked[..., 3 * m],
        )


_LAW_CACHE: dict[tuple[str, Switching], _LawFunction] = {}


def _law_function(mechanism: Mechanism, switching: Switching) -> _LawFunction:
    key = (mechanism.structure, switching)
    if key not in _LAW_CACHE:
        _LAW_CACHE[key] = _LawFunction(mechanism, switching)
    return _LAW_CACHE[key]


def check_surface_shape(mechanism: Mechanism, surface: Surface) -> None:
    """Refuse what is no surface, and one whose n or m differ from the mechanism's."""
    if not isinstance(surface, Surface):
        raise InvalidInputError(
            f"surface for '{mechanism.name}'",
            value=f"{surface!r}, {a_kind(surface)}",
            limit="an undertow.Surface",
            remedy=REMEDIES["Surface"],
        )
    if (surface.n, surface.m) != (mechanism.n, mechanism.m):
        raise InvalidInputError(
            f"surface for '{mechanism.name}'",
            value=f"n = {surface.n}, m = {surface.m}",
            limit=f"n = {mechanism.n}, m = {mechanism.m}",
            remedy="Design a surface for this mechanism: undertow.first_surface",
        )


def coupling(mechanism: Mechanism, q: ArrayLike) -> FloatArray:
    """Return X = M_uu⁻¹ M_auᵀ at positions q, (…, n) to (…, n−m, m)."""
    m = mechanism.m
    M = mechanism.M(q)
    return np.asarray(np.linalg.solve(M[..., m:, m:], M[..., m:, :m]), dtype=np.float64)


def gamma_determinant(X: FloatArray, surfaces: FloatArray) -> FloatArray:
    """Return det(α_a − α_u X) for surface vectors, (…, 2mn); leading shapes broadcast."""
    free, m = X.shape[-2:]
    _, lambda_a, alpha_u, lambda_u, *_ = LawLayout(m + free, m).starts
    lead = surfaces.shape[:-1]  # searches ask this often: no more views than needed
    gamma = surfaces[..., :lambda_a].reshape(*lead, m, m)
    gamma = gamma - surfaces[..., alpha_u:lambda_u].reshape(*lead, m, free) @ X
    return np.asarray(gamma[..., 0, 0] if m == 1 else np.linalg.det(gamma))


def singularity(mechanism: Mechanism, surfaces: FloatArray, q: ArrayLike) -> FloatArray:
    """Return det(α_a − α_u M_uu⁻¹ M_auᵀ) at positions q, broadcast over surface vectors.

    ``surfaces``: surface vectors, (…, 2mn). ``q``: positions, (…, n); leading shapes broadcast.
    """
    return gamma_determinant(coupling(mechanism, q), surfaces)


def gains_at_target(mechanism: Mechanism, surfaces: FloatArray, eta: FloatArray) -> FloatArray:
    """Return the gains (13) at the target for surface vectors (N, 2mn) and η (N, m)."""
    function = _law_function(mechanism, "saturation")
    m = mechanism.m
    reaching = np.hstack([eta, np.ones_like(eta)])
    origin = np.zeros((len(surfaces), 2 * mechanism.n))
    return function(
        mechanism, origin, surfaces.T, reaching.T, np.ones(len(surfaces))
    ).gains.reshape(-1, m)
