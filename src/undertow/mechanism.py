"""Mechanisms: what moves. ``M(q) q̈ = f(q, q̇) + B u``, symbolic, with parameters as data.

The coordinates come actuated first, ``q = (q_a, q_u)`` as in (1), and the state is
``x = (q, q̇)``.  Everything that runs later (kernels, laws, certificates, C) is generated
from the expressions kept here.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Self, cast

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.codegen import Tape, compile_numpy
from undertow.errors import InvalidInputError, ModelError
from undertow.lagrange import derived
from undertow.partition import Partition, compiled
from undertow.quantities import TIME, Coordinate, FloatArray, Input, Parameter, numbers
from undertow.validity import check_definite, check_names, check_symbols, check_symmetric

__all__ = [
    "TIME",
    "Coordinate",
    "FloatArray",
    "Input",
    "Mechanism",
    "Parameter",
    "Partition",
    "numbers",
]

#: Stands for the identity of the right size until ``__post_init__`` knows m.
_IDENTITY = cast(sp.ImmutableDenseMatrix, None)


@dataclass(frozen=True, eq=False)
class Mechanism:
    """An underactuated mechanism ``M(q) q̈ = f(q, q̇) + (B u, 0)``: immutable.

    Parameters
    ----------
    name
        Short identifier.
    coordinates
        The n coordinates, the m actuated ones first; the target is x = 0.
    inputs
        The m < n inputs, with their limits.
    mass_matrix
        M(q), (n, n), symmetric positive definite, as SymPy expressions.
    force
        f(q, q̇), (n,): Coriolis, centrifugal, conservative and dissipative forces.
    input_matrix
        B, (m, m), invertible; the identity by default.
    parameters
        All physical parameters that occur in the expressions.
    disturbance_bounds
        |g_i| ≤ bound, one per coordinate, in generalised force units (N m or N); the
        gains (13)-(14) are computed from them.  Zero by default.
    potential
        Potential energy, J, where there is one (used by the energy balance).
    start
        A usual initial state, by names, for examples and the command line.
    description, source
        In words, and where the model comes from.

    Raises
    ------
    ModelError
        When shapes, symbols or definiteness are wrong; the message names the entry.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> rig.n, rig.m, rig.state_names
    (2, 1, ('theta', 'phi', 'theta_dot', 'phi_dot'))
    """

    name: str
    coordinates: tuple[Coordinate, ...]
    inputs: tuple[Input, ...]
    mass_matrix: sp.ImmutableDenseMatrix
    force: sp.ImmutableDenseMatrix
    input_matrix: sp.ImmutableDenseMatrix = _IDENTITY
    parameters: tuple[Parameter, ...] = ()
    disturbance_bounds: tuple[float, ...] = ()
    potential: sp.Expr | None = None
    start: Mapping[str, float] = field(default_factory=dict)
    description: str = ""
    source: str = ""

    # -- construction -------------------------------------------------------------------

    def __post_init__(self) -> None:
        """Check shapes, names, symbols and the definiteness of M; freeze the matrices."""
        n, m = len(self.coordinates), len(self.inputs)
        if not 0 < m < n:
            raise ModelError(
                f"'{self.name}' is not underactuated",
                value=f"{n} coordinates and {m} inputs",
                limit="at least one input and fewer inputs than coordinates",
                remedy="Fully actuated mechanisms need no sliding surface of this kind",
            )
        given = sp.eye(m) if self.input_matrix is None else self.input_matrix
        for attribute, value, shape in (
            ("mass_matrix", self.mass_matrix, (n, n)),
            ("force", self.force, (n, 1)),
            ("input_matrix", given, (m, m)),
        ):
            matrix = sp.ImmutableDenseMatrix(value)
            if matrix.shape != shape:
                raise ModelError(
                    f"shape of {attribute} of '{self.name}'",
                    value=matrix.shape,
                    limit=f"{shape}",
                    remedy="Give one row per coordinate, the actuated ones first",
                )
            object.__setattr__(self, attribute, matrix)
        bounds = tuple(float(b) for b in self.disturbance_bounds) or (0.0,) * n
        if len(bounds) != n or not all(math.isfinite(b) and b >= 0 for b in bounds):
            raise InvalidInputError(
                f"disturbance_bounds of '{self.name}'",
                value=bounds,
                limit=f"{n} finite numbers ≥ 0, one per coordinate",
                remedy="Give bounds on |g_i|, 0 where nothing disturbs",
            )
        object.__setattr__(self, "disturbance_bounds", bounds)
        self._check()
        self.state(**self.start)

    def _check(self) -> None:
        states, parameters = {*self.x}, {*self.parameter_symbols}
        channels = [i.name for i in self.inputs]
        check_names(self.name, [*self.state_names, *channels, *(p.name for p in self.parameters)])
        for what, allowed in (
            ("mass_matrix", {*self.q} | parameters),
            ("input_matrix", parameters),
            ("force", states | parameters | {TIME}),
        ):
            check_symbols(f"{what} of '{self.name}'", getattr(self, what), allowed)
        check_symmetric(f"mass_matrix of '{self.name}'", self.mass_matrix)
        check_definite(f"mass_matrix of '{self.name}'", self.coordinates, self.M)
        gain = numbers(self.input_matrix.subs(self.substitution))
        if not abs(np.linalg.det(gain)) > 0:
            raise ModelError(
                f"input_matrix of '{self.name}'",
                value=gain.tolist(),
                limit="invertible",
                remedy="Each input must act on an actuated coordinate of its own",
            )

    @classmethod
    def from_energies(
        cls,
        name: str,
        coordinates: Sequence[Coordinate],
        inputs: Sequence[Input],
        kinetic: sp.Expr,
        potential: sp.Expr,
        *,
        dissipation: sp.Expr | float = 0,
        **rest: Any,
    ) -> Self:
        """Derive M and f from energies by Lagrange's equations.

        Parameters
        ----------
        name, coordinates, inputs
            As for the class; the actuated coordinates come first.
        kinetic
            Kinetic energy T(q, q̇), J, a quadratic form in the velocities.
        potential
            Potential energy V(q), J.
        dissipation
            Rayleigh's dissipation function D(q, q̇), W; its force is −∂D/∂q̇.
        **rest
            Further fields of the class (``parameters``, ``input_matrix``, …).

        Raises
        ------
        ModelError
            When T is not a quadratic form in the velocities, or as for the class.
        """
        T, V, D = sp.sympify(kinetic), sp.sympify(potential), sp.sympify(dissipation)
        q, qd = [c.symbol for c in coordinates], [c.velocity for c in coordinates]
        mass, force = derived(name, q, qd, T, V, D)
        return cls(
            name,
            tuple(coordinates),
            tuple(inputs),
            mass,
            force,
            potential=V,
            **rest,
        )

    def with_parameters(self, /, **values: float) -> Self:
        """Return the mechanism with some parameter values replaced, SI units.

        Raises
        ------
        InvalidInputError
            For an unknown name or a value outside the parameter's bounds.
        """
        if not values:
            return self
        known = {p.name: p for p in self.parameters}
        for name in values:
            if name not in known:
                raise InvalidInputError(
                    f"unknown parameter of '{self.name}'",
                    value=repr(name),
                    limit=f"one of {', '.join(known)}",
                    remedy="Use a declared name; values are in SI units",
                )
        changed = tuple(
            replace(p, value=float(values[p.name])) if p.name in values else p
            for p in self.parameters
        )
        return replace(self, parameters=changed)

    def with_input_limit(self, *limits: float) -> Self:
        """Return the mechanism with other actuator limits, one per input, in its unit."""
        if len(limits) != self.m:
            raise InvalidInputError(
                f"input limits of '{self.name}'",
                value=limits,
                limit=f"{self.m} numbers",
                remedy="Give one limit per input",
            )
        inputs = tuple(replace(i, limit=float(v)) for i, v in zip(self.inputs, limits, strict=True))
        return replace(self, inputs=inputs)

    def with_disturbance_bounds(self, *bounds: float) -> Self:
        """Return the mechanism with declared bounds |g_i|, one per coordinate (N m or N)."""
        return replace(self, disturbance_bounds=bounds)

    def disturbed(
        self, force: Mapping[str, sp.Expr | float], parameters: Iterable[Parameter] = ()
    ) -> Self:
        """Return a plant on which additional generalised forces g act, equation (1).

        Parameters
        ----------
        force
            Coordinate name to expression in states, parameters and :data:`TIME`, N m or N.
        parameters
            Further parameters that the expressions use.
        """
        unknown = set(force) - {c.name for c in self.coordinates}
        if unknown:
            raise InvalidInputError(
                f"unknown coordinate of '{self.name}'",
                value=", ".join(sorted(unknown)),
                limit=f"one of {', '.join(c.name for c in self.coordinates)}",
                remedy="Forces act on coordinates, by their names",
            )
        g = sp.Matrix([sp.sympify(force.get(c.name, 0)) for c in self.coordinates])
        return replace(
            self,
            force=sp.ImmutableDenseMatrix(self.force + g),
            parameters=(*self.parameters, *parameters),
        )

    # -- names and symbols --------------------------------------------------------------

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.coordinates)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def q(self) -> tuple[sp.Symbol, ...]:
        """Coordinate symbols, actuated first."""
        return tuple(c.symbol for c in self.coordinates)

    @property
    def x(self) -> tuple[sp.Symbol, ...]:
        """State symbols (q, q̇)."""
        return (*self.q, *(c.velocity for c in self.coordinates))

    @property
    def u(self) -> tuple[sp.Symbol, ...]:
        """Input symbols."""
        return tuple(i.symbol for i in self.inputs)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in the order of x."""
        return tuple(str(s) for s in self.x)

    @property
    def parameter_symbols(self) -> tuple[sp.Symbol, ...]:
        """Parameter symbols, in order."""
        return tuple(p.symbol for p in self.parameters)

    @property
    def parameter_values(self) -> FloatArray:
        """Parameter values, SI units, in order."""
        return np.array([p.value for p in self.parameters], dtype=float)

    @property
    def substitution(self) -> dict[sp.Symbol, float]:
        """Parameter symbols to their values, for ``subs``."""
        return {p.symbol: p.value for p in self.parameters}

    @property
    def input_limits(self) -> FloatArray:
        """Actuator limits, (m,), in the units of the inputs."""
        return np.array([i.limit for i in self.inputs], dtype=float)

    @cached_property
    def structure(self) -> str:
        """Hash of everything that generated code depends on: equations and names, no values."""
        text = "\n".join(
            [
                sp.srepr(self.mass_matrix),
                sp.srepr(self.force),
                sp.srepr(self.input_matrix),
                repr([p.name for p in self.parameters]),
                repr([i.name for i in self.inputs]),
                repr(self.state_names),
                repr(self.disturbance_bounds),
            ]
        )
        return hashlib.sha256(text.encode()).hexdigest()

    @cached_property
    def fingerprint(self) -> str:
        """Hash of everything that defines the equations and their numbers."""
        limits = [i.limit for i in self.inputs]
        values = [p.value for p in self.parameters]
        return hashlib.sha256(f"{self.structure} {values} {limits}".encode()).hexdigest()

    def state(self, /, **values: float) -> FloatArray:
        """Return the state with the named entries set and all others zero, SI units.

        Raises
        ------
        InvalidInputError
            For an unknown state name or a value that is not finite.
        """
        x = np.zeros(2 * self.n)
        for name, value in values.items():
            if name not in self.state_names:
                raise InvalidInputError(
                    f"unknown state of '{self.name}'",
                    value=repr(name),
                    limit=f"one of {', '.join(self.state_names)}",
                    remedy="Use a coordinate's name, or its velocity's",
                )
            x[self.state_names.index(name)] = value
        return self.check_state(x)

    def check_state(self, x: ArrayLike) -> FloatArray:
        """Return ``x`` as a float array (…, 2n), refusing wrong lengths and NaN.

        Raises
        ------
        InvalidInputError
            With the offending entry.
        """
        state = np.asarray(x, dtype=float)
        if state.ndim == 0 or state.shape[-1] != 2 * self.n:
            raise InvalidInputError(
                f"state of '{self.name}'",
                value=f"shape {state.shape}",
                limit=f"(…, {2 * self.n}), in the order {', '.join(self.state_names)}",
                remedy="Set states by name: mechanism.state(name=value)",
            )
        if not np.isfinite(state).all():
            first = int(np.argwhere(~np.isfinite(state))[0][-1])
            raise InvalidInputError(
                f"state '{self.state_names[first]}' of '{self.name}'",
                value=state[..., first].ravel()[0],
                limit="a finite number",
                remedy="A sensor or an earlier computation gave NaN or infinity",
            )
        return state

    # -- equations on a tape ------------------------------------------------------------

    def partition(self, tape: Tape, rename: Mapping[sp.Symbol, sp.Expr] | None = None) -> Partition:
        """Lay M, f and B on a tape and eliminate ``M_uu``, equations (1)-(4).

        ``rename`` replaces symbols first: a controller's belief keeps its own parameters.
        """
        entries = [list(m) for m in (self.mass_matrix, self.force, self.input_matrix)]
        if rename:
            entries = [[e.xreplace(dict(rename)) for e in part] for part in entries]
        return Partition.of(tape, *entries)

    # -- numbers ------------------------------------------------------------------------

    def _evaluate(self, which: str, t: float, x: FloatArray, *more: object) -> FloatArray:
        columns = [x[..., i] for i in range(x.shape[-1])]
        values = self.function(which)(t, *columns, *more, *self.parameter_values)
        shape = np.broadcast_shapes(x.shape[:-1], *(np.shape(v) for v in values))
        return np.stack([np.broadcast_to(v, shape) for v in values], axis=-1).astype(float)

    def function(self, which: str) -> Callable[..., list[Any]]:
        """Return ``"dynamics"``, ``"mass"`` or ``"force"`` compiled to NumPy.

        A function of t, x, (with ``"dynamics"``) u and the parameters, one argument each, that
        returns the entries of q̈, M or f.
        """
        states = (TIME, *self.x)
        if which == "dynamics":
            return _compiled_dynamics(self)
        matrix = self.mass_matrix if which == "mass" else self.force
        return compiled(matrix, (*states, *self.parameter_symbols))

    def M(self, q: ArrayLike) -> FloatArray:
        """Return the mass matrix at q: (…, n) to (…, n, n), kg m² and the like."""
        q = np.asarray(q, dtype=np.float64)
        x = np.concatenate([q, np.zeros_like(q)], axis=-1)
        values = self._evaluate("mass", 0.0, x)
        return values.reshape(*values.shape[:-1], self.n, self.n)

    def f(self, x: ArrayLike, t: float = 0.0) -> FloatArray:
        """Return f(q, q̇) at the states x: (…, 2n) to (…, n), N m or N."""
        return self._evaluate("force", t, self.check_state(x))

    def accelerations(self, t: float, x: ArrayLike, u: ArrayLike) -> FloatArray:
        """Forward dynamics: q̈ at (t, x, u), (…, n), equations (3)-(4).

        Parameters
        ----------
        t
            Time, s (matters only to time-dependent disturbances).
        x
            States, (…, 2n).
        u
            Inputs, (…, m), not clipped here.
        """
        state, inputs = self.check_state(x), np.asarray(u, dtype=float)
        return self._evaluate("dynamics", t, state, *np.moveaxis(inputs, -1, 0))

    def forces(self, t: float, x: ArrayLike, qdd: ArrayLike) -> FloatArray:
        """Inverse dynamics: M(q) q̈ − f(q, q̇), the generalised forces that give q̈, (…, n)."""
        state = self.check_state(x)
        inertial = np.einsum("...ij,...j->...i", self.M(state[..., : self.n]), np.asarray(qdd))
        return np.asarray(inertial - self.f(state, t))

    def energy(self, x: ArrayLike) -> FloatArray:
        """Return T + V at the states x, (…,), J.

        Raises
        ------
        ModelError
            When the mechanism was given without a potential.
        """
        if self.potential is None:
            raise ModelError(
                f"energy of '{self.name}'",
                value="no potential energy",
                limit="given at construction",
                remedy="Build it with Mechanism.from_energies, or pass potential=",
            )
        state = self.check_state(x)
        q, qd = state[..., : self.n], state[..., self.n :]
        kinetic = 0.5 * np.einsum("...i,...ij,...j->...", qd, self.M(q), qd)
        tape = Tape()
        potential = compile_numpy(
            tape, [*self.q, *self.parameter_symbols], [tape.let(self.potential)]
        )
        (value,) = potential(*np.moveaxis(q, -1, 0), *self.parameter_values)
        return np.asarray(kinetic + value)


@lru_cache(maxsize=64)
def _compiled_dynamics(mechanism: Mechanism) -> Callable[..., list[Any]]:
    tape = Tape()
    forward = mechanism.partition(tape).accelerations(sp.Matrix(mechanism.u))
    arguments = [TIME, *mechanism.x, *mechanism.u, *mechanism.parameter_symbols]
    return compile_numpy(tape, arguments, forward)
