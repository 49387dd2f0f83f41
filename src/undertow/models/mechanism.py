"""Mechanisms: what moves. ``M(q) q̈ = f(q, q̇) + B u``, symbolic, with parameters as data.

The coordinates come actuated first, ``q = (q_a, q_u)`` as in (1), and the state is
``x = (q, q̇)``.  Everything that runs later (kernels, laws, certificates, C) is generated
from the expressions kept here.
"""

from __future__ import annotations

import hashlib
import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base import (
    BY_NAME,
    InvalidInputError,
    ModelError,
    ReadOnly,
    a_kind,
    check_fields,
    checked,
    checked_names,
    floats,
    one_of,
    positive,
)
from undertow.models.lagrange import derived
from undertow.models.partition import Partition, compiled
from undertow.models.quantities import (
    TIME,
    Coordinate,
    FloatArray,
    Input,
    Parameter,
    StateLike,
    in_degrees,
    number_of,
    numbers,
    with_value,
)
from undertow.models.validity import (
    by_names,
    check_definite,
    check_parts,
    check_symbols,
    check_symmetric,
    expression_of,
    require_smooth,
    vocabulary,
)
from undertow.symbolic import Tape, compile_numpy

if TYPE_CHECKING:
    from undertow.models.linearisation import Linearisation

__all__ = [
    "TIME",
    "Coordinate",
    "FloatArray",
    "Input",
    "Mechanism",
    "Parameter",
    "Partition",
    "energies",
    "matrix_of",
    "numbers",
]

#: Stands for the identity of the right size until ``__post_init__`` knows m.
_IDENTITY = cast(sp.ImmutableDenseMatrix, None)

#: Equations of energies: a mechanism is often made again, with other numbers.
_derived = lru_cache(maxsize=64)(derived)


@checked_names
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
        gains (13) are computed from them.  Zero by default.
    potential
        Potential energy, J, where there is one (used by the energy balance).
    start
        A usual initial state, by names, for examples and the command line: a copy is kept.
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

    def __repr__(self) -> str:
        """Show its name, its states and its inputs."""
        return (
            f"Mechanism({self.name!r}, coordinates={[c.name for c in self.coordinates]}, "
            f"inputs={[i.name for i in self.inputs]})"
        )

    def _repr_latex_(self) -> str:
        """Show M, f and B as formulas in a notebook."""
        from undertow.symbolic.formulas import readable, tex

        rates = [c.velocity for c in self.coordinates]
        shown = []
        for name, matrix in (("M", self.mass_matrix), ("f", self.force), ("B", self.input_matrix)):
            entries = sp.ImmutableDenseMatrix(
                *matrix.shape, [readable(entry, rates) for entry in matrix]
            )
            shown.append(f"{name} &= {tex(entries)}")
        lines = r" \\ ".join([r"M \ddot{q} &= f + (B u, 0)", *shown])
        return rf"$\displaystyle \begin{{aligned}} {lines} \end{{aligned}}$"

    # -- construction -------------------------------------------------------------------

    def __post_init__(self) -> None:
        """Check shapes, names, symbols and the definiteness of M; freeze the matrices."""
        check_fields(self, "name", "start")
        if not self.name.strip() or not self.name.isprintable():
            raise InvalidInputError(
                "name of a mechanism",
                value=repr(self.name),
                limit="a text that can be printed, not empty",
                remedy="Errors, tables and files name it so",
            )
        check_parts(self.name, self.coordinates, self.inputs, self.parameters)
        for parts in ("coordinates", "inputs", "parameters"):
            object.__setattr__(self, parts, tuple(getattr(self, parts)))
        n, m = len(self.coordinates), len(self.inputs)
        check_underactuated(self.name, n, m)
        given = sp.eye(m) if self.input_matrix is None else self.input_matrix
        for attribute, value, shape in (
            ("mass_matrix", self.mass_matrix, (n, n)),
            ("force", self.force, (n, 1)),
            ("input_matrix", given, (m, m)),
        ):
            matrix = matrix_of(f"{attribute} of '{self.name}'", value)
            if matrix.shape != shape:
                remedy = "Give one row per coordinate, the actuated ones first"
                if attribute == "input_matrix":
                    remedy = (
                        "Here each input acts on actuated coordinates alone; an (n, m) matrix goes "
                        "into undertow.modelling.from_energies or from_matrices"
                    )
                raise ModelError(
                    f"shape of {attribute} of '{self.name}'",
                    value=matrix.shape,
                    limit=f"{shape}",
                    remedy=remedy,
                )
            object.__setattr__(self, attribute, matrix)
        given_bounds: Any = self.disturbance_bounds
        if not isinstance(given_bounds, Iterable):
            given_bounds = (given_bounds,)
        bounds = (
            tuple(number_of(f"disturbance_bounds of '{self.name}'", b) for b in given_bounds)
            or (0.0,) * n
        )
        if len(bounds) != n or not all(math.isfinite(b) and b >= 0 for b in bounds):
            raise InvalidInputError(
                f"disturbance_bounds of '{self.name}'",
                value=bounds,
                limit=f"{n} finite numbers ≥ 0, one per coordinate",
                remedy="Give bounds on |g_i|, 0 where nothing disturbs",
            )
        object.__setattr__(self, "disturbance_bounds", bounds)
        self._check()
        by_names(f"start of '{self.name}'", self.start)
        self.state(**self.start)
        object.__setattr__(self, "start", ReadOnly(self.start))

    def _check(self) -> None:
        data = vocabulary(parameters=self.parameters, time=False)
        places = vocabulary(self.coordinates, velocities=False, time=False) | data
        everything = vocabulary(self.coordinates, self.inputs, self.parameters)
        for what, allowed, holds, remedy in (
            (
                "mass_matrix",
                places,
                "positions and parameters alone",
                "What depends on velocities or the time is a force: it belongs to f",
            ),
            (
                "input_matrix",
                data,
                "parameters alone: B is constant",
                "Take inputs that act alike everywhere, the forces and torques of the joints; of a "
                "constant (n, m) matrix undertow.modelling.from_matrices finds the coordinates",
            ),
        ):
            odd = getattr(self, what).free_symbols & set(everything) - set(allowed)
            if odd:
                raise ModelError(
                    f"{what} of '{self.name}'",
                    value=f"made of {', '.join(sorted(map(str, odd)))}",
                    limit=f"made of {holds}",
                    remedy=remedy,
                )
        for what, known in (
            ("mass_matrix", places),
            ("input_matrix", data),
            ("force", vocabulary(self.coordinates, parameters=self.parameters)),
        ):
            check_symbols(f"{what} of '{self.name}'", getattr(self, what), known)
        if self.potential is not None:
            what = f"potential of '{self.name}'"
            object.__setattr__(self, "potential", expression_of(what, self.potential))
            check_symbols(what, [self.potential], places | {TIME: "undertow.models.mechanism.TIME"})
        check_symmetric(f"mass_matrix of '{self.name}'", self.mass_matrix)
        check_definite(f"mass_matrix of '{self.name}'", self.coordinates, self.M)
        if not abs(np.linalg.det(self.B)) > 0:
            raise ModelError(
                f"input_matrix of '{self.name}'",
                value=self.B.tolist(),
                limit="invertible",
                remedy="Each input must act on an actuated coordinate of its own",
            )

    @classmethod
    @checked
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
            When T is not a quadratic form in the velocities; for undeclared symbols; for kinks,
            where SymPy's derivatives are wrong; or as for the class.
        """
        own = {"name", "coordinates", "inputs", "mass_matrix", "force", "potential"}
        known = ["dissipation", *(f.name for f in fields(cls) if f.init and f.name not in own)]
        for given in rest:
            one_of(f"argument of {cls.__name__}.from_energies", given, known)
        T, V, D = energies(
            name, coordinates, inputs, rest.get("parameters", ()), kinetic, potential, dissipation
        )
        q, qd = zip(*((c.symbol, c.velocity) for c in coordinates), strict=True)
        mass, force = _derived(name, q, qd, T, V, D)
        return cls(name, tuple(coordinates), tuple(inputs), mass, force, potential=V, **rest)

    def with_parameters(self, /, **values: float) -> Self:
        """Return the mechanism with some parameter values replaced, SI units.

        Raises
        ------
        InvalidInputError
            For an unknown name or a value outside the parameter's bounds.
        """
        if not values:
            return self
        known = [p.name for p in self.parameters]
        values = by_names(f"parameters of '{self.name}'", values)
        remedy = "Use a declared name; values are in SI units"
        if not known:
            remedy = "What shall have a value of its own is declared: parameters=[Parameter(...)]"
        for name in values:
            one_of(f"unknown parameter of '{self.name}'", name, known, remedy)
        changed = tuple(
            replace(p, value=number_of(f"parameter '{p.name}', {p.unit}", values[p.name]))
            if p.name in values
            else p
            for p in self.parameters
        )
        return replace(self, parameters=changed)

    def with_values(self, values: ArrayLike) -> Self:
        """Return the mechanism with other values of all its parameters, (P,), SI units.

        Unlike :meth:`with_parameters` it checks nothing but the mass matrix: for estimates that
        change many times a second.

        Raises
        ------
        InvalidInputError
            For values of another shape, or outside the parameter's bounds.
        ModelError
            When the mass matrix is not positive definite with them.
        """
        numbers = self._columns("parameter values", values, [p.name for p in self.parameters])
        copy = self._with(
            parameters=tuple(
                with_value(p, float(v)) for p, v in zip(self.parameters, numbers, strict=True)
            )
        )
        check_definite(f"mass_matrix of '{self.name}'", self.coordinates, copy.M)
        return copy

    def _with(self, **numbers: tuple[Parameter, ...] | tuple[Input, ...]) -> Self:
        """Return a copy with other numbers, unchecked; what is kept of the equations stays."""
        copy = object.__new__(type(self))
        kept = {k: v for k, v in vars(self).items() if k != "fingerprint"}  # of the structure
        copy.__dict__.update(kept, structure=self.structure, **numbers)
        return copy

    def with_input_limit(self, *limits: float) -> Self:
        """Return the mechanism with other actuator limits, one per input, in its unit."""
        if len(limits) != self.m:
            raise InvalidInputError(
                f"input limits of '{self.name}'",
                value=limits,
                limit=f"{self.m} numbers",
                remedy="Give one limit per input",
            )
        inputs = tuple(
            replace(i, limit=number_of(f"limit of input '{i.name}'", v))
            for i, v in zip(self.inputs, limits, strict=True)
        )
        return self._with(inputs=inputs)

    def with_disturbance_bounds(self, *bounds: float) -> Self:
        """Return the mechanism with declared bounds |g_i|, one per coordinate (N m or N)."""
        return replace(self, disturbance_bounds=bounds)

    @checked
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
        force = by_names(f"forces on '{self.name}'", force)
        names = [c.name for c in self.coordinates]
        remedy = "Forces act on coordinates, by their names"
        for name in force:
            one_of(f"unknown coordinate of '{self.name}'", name, names, remedy)
        g = sp.Matrix([expression_of(f"force on '{name}'", force.get(name, 0)) for name in names])
        return replace(
            self,
            force=sp.ImmutableDenseMatrix(self.force + g),
            parameters=(*self.parameters, *parameters),
        )

    @checked
    def with_friction(self, *, width: float = 0.05, **bounds: float) -> Self:
        """Return the mechanism with Coulomb friction of at most these levels in its joints.

        The force −F tanh(q̇/width), with F a parameter ``friction_<coordinate>`` of half the bound,
        ± half the bound: a belief learns it.

        Parameters
        ----------
        width
            Velocity within which friction falls to zero, rad/s or m/s.
        **bounds
            Coordinate name to the largest friction that is plausible, N m or N.

        Raises
        ------
        InvalidInputError
            For unknown coordinates, and for bounds or a width that are not positive.

        Examples
        --------
        >>> import undertow as ut
        >>> rig = ut.mechanisms.rotary_pendulum().with_friction(theta=0.02)
        >>> ut.Belief.usual(rig).tolerances["friction_theta"]
        0.01
        """
        positive("width of Coulomb friction, rad/s or m/s", width, "0.05 is usual")
        velocities = {c.name: c.velocity for c in self.coordinates}
        units = {c.name: u for c, u in zip(self.coordinates, self.force_units, strict=True)}
        force, parameters = {}, []
        for name, bound in bounds.items():
            one_of(f"unknown coordinate of '{self.name}'", name, velocities)
            positive(f"friction of '{name}', {units[name]}", bound)
            level = Parameter(
                f"friction_{name}", bound / 2, units[name], f"Coulomb friction of {name}",
                -bound, math.inf, tolerance=bound / 2,
            )  # fmt: skip
            parameters.append(level)
            force[name] = -level.symbol * sp.tanh(velocities[name] / width)
        return self.disturbed(force, parameters)

    @checked
    def with_input_gain(self, **tolerances: float) -> Self:
        """Return the mechanism with motors that may be stronger or weaker than the model's.

        Column i of B is multiplied by a parameter ``gain_<input>``, 1 ± its tolerance: a belief
        learns it.

        Parameters
        ----------
        **tolerances
            Input name to how far its gain may be off, as a part of it: 0.1 is ±10 %.

        Raises
        ------
        InvalidInputError
            For unknown inputs, and for tolerances that are not between 0 and 1.

        Examples
        --------
        >>> import undertow as ut
        >>> cart = ut.mechanisms.cart_pendulum().with_input_gain(force=0.4)
        >>> ut.Belief.usual(cart).tolerances["gain_force"]
        0.4
        """
        names = [i.name for i in self.inputs]
        scale, parameters = sp.eye(self.m), []
        for name, given in tolerances.items():
            one_of(f"unknown input of '{self.name}'", name, names)
            positive(f"tolerance of the gain of '{name}'", given, "0.1 is ±10 %")
            tolerance = number_of(f"tolerance of the gain of '{name}'", given)
            if not tolerance < 1:
                raise InvalidInputError(
                    f"tolerance of the gain of '{name}'",
                    value=f"{tolerance:g}",
                    limit="below 1",
                    remedy="A motor that may turn the other way cannot be controlled",
                )
            gain = Parameter(
                f"gain_{name}", 1.0, "", f"gain of {name}", 0.0, math.inf, tolerance=tolerance
            )
            place = names.index(name)
            scale[place, place] = gain.symbol
            parameters.append(gain)
        return replace(
            self,
            input_matrix=sp.ImmutableDenseMatrix(self.input_matrix * scale),
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

    @cached_property
    def q(self) -> tuple[sp.Symbol, ...]:
        """Coordinate symbols, actuated first."""
        return tuple(c.symbol for c in self.coordinates)

    @cached_property
    def x(self) -> tuple[sp.Symbol, ...]:
        """State symbols (q, q̇)."""
        return (*self.q, *(c.velocity for c in self.coordinates))

    @cached_property
    def u(self) -> tuple[sp.Symbol, ...]:
        """Input symbols."""
        return tuple(i.symbol for i in self.inputs)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in the order of x."""
        return tuple(str(s) for s in self.x)

    @property
    def state_units(self) -> tuple[str, ...]:
        """Units of the states, in the order of x."""
        units = tuple(c.unit for c in self.coordinates)
        return (*units, *(f"{unit}/s" for unit in units))

    @cached_property
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
    def force_units(self) -> tuple[str, ...]:
        """Unit of the generalised force of each coordinate: N, or N m about a hinge.

        Or kN and kN m, where an input in kN acts on a coordinate as it is, with 1 in ``B``: masses
        are tonnes then.
        """
        own, prefix = ["N m" if c.unit == "rad" else "N" for c in self.coordinates], ""
        for unit, row in zip(own, self.B, strict=False):
            acting = np.flatnonzero(row)
            if len(acting) == 1 and abs(row[acting[0]]) == 1.0:
                given = self.inputs[acting[0]].unit
                prefix = given.removesuffix(unit) if given.endswith(unit) else prefix
        return tuple(prefix + unit for unit in own)

    @property
    def input_limits(self) -> FloatArray:
        """Actuator limits, (m,), in the units of the inputs."""
        return np.array([i.limit for i in self.inputs], dtype=float)

    @cached_property
    def structure(self) -> str:
        """Hash of everything that generated code depends on: equations and names, no values."""
        equations = (self.mass_matrix, self.force, self.input_matrix)
        names = [p.name for p in self.parameters], [i.name for i in self.inputs], self.state_names
        text = "\n".join([*map(sp.srepr, equations), *map(repr, (*names, self.disturbance_bounds))])
        return hashlib.sha256(text.encode()).hexdigest()

    @cached_property
    def fingerprint(self) -> str:
        """Hash of everything that defines the equations and their numbers."""
        limits = [i.limit for i in self.inputs]
        values = [p.value for p in self.parameters]
        return hashlib.sha256(f"{self.structure} {values} {limits}".encode()).hexdigest()

    @property
    def identity(self) -> str:
        """Hash of all that a result can depend on.

        Besides :attr:`fingerprint` these are units and travel of the coordinates, bounds and
        tolerances of the parameters, and the usual start.
        """
        declared = (self.coordinates, self.inputs, self.parameters, dict(self.start))
        return hashlib.sha256(f"{self.fingerprint} {declared!r}".encode()).hexdigest()

    @property
    def usual_start(self) -> FloatArray:
        """The usual initial state, (2n,).

        Raises
        ------
        InvalidInputError
            Where the mechanism has none: a run from the target would show nothing.
        """
        if not self.start:
            angle = self.coordinates[-1]
            raise InvalidInputError(
                f"start of '{self.name}'",
                value="none, and the mechanism has no usual one",
                limit="a state away from the target",
                remedy=f"Give one, for instance {angle.name}=0.1 {angle.unit} "
                f"(--start {angle.name}=0.1{angle.unit} on the command line), or give the "
                "mechanism a start=",
            )
        return self.state(**self.start)

    @checked
    def check_state_name(self, what: str, name: str) -> None:
        """Refuse a name that no state has; ``what`` it is meant for begins the message.

        Of a coordinate that an input acts on together with others, the message tells what it is.

        Raises
        ------
        InvalidInputError
            For an unknown state name.
        """
        meant = name.removesuffix("_dot")
        told = [
            f"{c.name} is {c.description}"
            for c in self.coordinates
            if meant in re.split(r"\W+", c.description)
        ]
        remedy = ". ".join(["Use a coordinate's name, or its velocity's", *told])
        one_of(f"{what} of '{self.name}'", name, self.state_names, remedy)

    def state(self, /, **values: float) -> FloatArray:
        """Return the state with the named entries set and all others zero, SI units.

        Raises
        ------
        InvalidInputError
            For an unknown state name or a value that is not finite.
        """
        x, names = np.zeros(2 * self.n), self.state_names
        for name, value in by_names(f"state of '{self.name}'", values).items():
            self.check_state_name("unknown state", name)
            x[names.index(name)] = number_of(
                f"state '{name}' of '{self.name}'", value, limit="a number, in rad or m, per second"
            )
        return self.check_state(x)

    @checked
    def initial_state(self, x0: StateLike | None, names: Mapping[str, float]) -> FloatArray:
        """Return an initial state, (2n,), from a vector, from names, or the usual one.

        Names may also be a mapping in the place of the vector: one that is a keyword of the
        function at hand has no other way in.

        Raises
        ------
        InvalidInputError
            For both a vector and names, for several states, and with neither where the mechanism
            has no usual start.

        Warns
        -----
        UserWarning
            Of a name that puts an unactuated angle more than a turn off the target: degrees,
            probably.
        """
        if x0 is None:
            return self._named(names) if names else self.usual_start
        if names:
            raise InvalidInputError(
                "initial state",
                value=f"x0 and {', '.join(names)}",
                limit="x0 or names, not both",
                remedy="Leave one of them out",
            )
        if isinstance(x0, Mapping):
            return self._named(x0)
        x = self.check_state(x0)
        if x.ndim != 1:
            raise InvalidInputError(
                "initial state",
                value=f"shape {x.shape}",
                limit=f"({2 * self.n},), one state",
                remedy="A run has one start; ClosedLoop.batch takes many",
            )
        return x

    def _named(self, names: Mapping[str, float]) -> FloatArray:
        """Return the initial state of these names; warn where one seems to be in degrees."""
        x = self.state(**names)
        if turned := in_degrees(self.coordinates, self.m, x):
            warnings.warn(f"initial state: {turned}", stacklevel=6)  # who called the verb
        return x

    @checked
    def check_plant(self, plant: Mechanism) -> None:
        """Refuse a plant for this belief whose coordinates or inputs are not the belief's own.

        Raises
        ------
        InvalidInputError
            With the names and units of both.
        """
        has, wanted = (
            ", ".join(
                [f"{c.name} ({c.unit})" for c in who.coordinates]
                + [f"{i.name} ({i.unit})" for i in who.inputs]
            )
            for who in (plant, self)
        )
        if (plant.n, plant.m, has) != (self.n, self.m, wanted):
            raise InvalidInputError(
                f"plant '{plant.name}' of the belief '{self.name}'",
                value=has,
                limit=f"{wanted}, in this order",
                remedy="A law for one mechanism means nothing to another: name the coordinates "
                "and inputs of a model of the plant as the belief does",
            )

    def check_state(self, x: ArrayLike) -> FloatArray:
        """Return ``x`` as a float array (…, 2n), refusing wrong lengths and NaN.

        Where its columns have names, as pandas has them, they are found by name, in any order.

        Raises
        ------
        InvalidInputError
            With the offending entry.
        """
        state = self._columns("state", x, self.state_names, BY_NAME)
        if not np.isfinite(state).all():
            first = int(np.argwhere(~np.isfinite(state))[0][-1])
            raise InvalidInputError(
                f"state '{self.state_names[first]}' of '{self.name}'",
                value=state[..., first].ravel()[0],
                limit="a finite number",
                remedy="A sensor or an earlier computation gave NaN or infinity",
            )
        return state

    def _columns(
        self, what: str, values: ArrayLike, names: Sequence[str], remedy: str = ""
    ) -> FloatArray:
        """Return values, by their names where they have some, as floats (…, len(names))."""
        what = f"{what} of '{self.name}'"
        labels = [] if isinstance(values, Mapping) else list(getattr(values, "keys", tuple)())
        if labels and all(isinstance(label, str) for label in labels):
            if not set(names) <= set(labels):
                raise InvalidInputError(
                    f"names of the {what}",
                    value=", ".join(labels),
                    limit=", ".join(names),
                    remedy="Give all of them, in any order, or numbers without names",
                )
            values = cast(Any, values)[list(names)]
        array = floats(what, values)
        if array.ndim == 0 or array.shape[-1] != len(names):
            raise InvalidInputError(
                what,
                value=f"shape {array.shape}",
                limit=f"(…, {len(names)}), in the order {', '.join(names)}",
                remedy=remedy or f"Of a state x = (q, q̇) the positions are x[:{self.n}]",
            )
        return array

    # -- equations on a tape ------------------------------------------------------------

    def partition(self, tape: Tape, rename: Mapping[sp.Symbol, sp.Expr] | None = None) -> Partition:
        """Record M, f and B on a tape and eliminate ``M_uu``, equations (1)-(4).

        ``rename`` replaces symbols first: a controller's belief keeps its own parameters.
        """
        entries = [list(m) for m in (self.mass_matrix, self.force, self.input_matrix)]
        if rename:
            entries = [[e.xreplace(dict(rename)) for e in part] for part in entries]
        return Partition.of(tape, *entries)

    # -- numbers ------------------------------------------------------------------------

    def _evaluate(self, which: str, t: ArrayLike, x: FloatArray, *more: object) -> FloatArray:
        columns = [x[..., i] for i in range(x.shape[-1])]
        values = self.function(which)(t, *columns, *more, *self.parameter_values)
        if x.ndim == 1 and not any(map(np.ndim, values)):
            return np.array(values, dtype=float)
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

    @property
    def B(self) -> FloatArray:
        """Input matrix at the values of the parameters, (m, m)."""
        return numbers(self.input_matrix.subs(self.substitution))

    def M(self, q: ArrayLike) -> FloatArray:
        """Return the mass matrix at q: (…, n) to (…, n, n), kg m² and the like.

        Raises
        ------
        InvalidInputError
            For positions of another shape, a state (…, 2n) for instance.
        """
        q = self._columns("positions", q, [c.name for c in self.coordinates])
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
        state = self.check_state(x)
        inputs = self._columns(
            "inputs", u, [i.name for i in self.inputs], "Give one number for each input, in a list"
        )
        columns = [inputs[..., i] for i in range(self.m)]
        return self._evaluate("dynamics", floats("time", t), state, *columns)

    def forces(self, t: float, x: ArrayLike, qdd: ArrayLike) -> FloatArray:
        """Inverse dynamics: M(q) q̈ − f(q, q̇), the generalised forces that give q̈, (…, n)."""
        state = self.check_state(x)
        names = [c.name for c in self.coordinates]
        qdd = self._columns("accelerations", qdd, names, "Give one number for each coordinate")
        inertial = np.einsum("...ij,...j->...i", self.M(state[..., : self.n]), qdd)
        return np.asarray(inertial - self.f(state, t))

    def linearise(self) -> Linearisation:
        """Linearise at the target x = 0: ẋ = A x + B u; ``.ss()`` is python-control's.

        u counts from the input that holds the target, ``undertow.modelling.holding_input``.
        The arrays are the caller's own.

        Raises
        ------
        ModelError
            When the target is no equilibrium under any input, or f has no derivative there.
        """
        from undertow.models.linearisation import linearise

        return deepcopy(linearise(self))

    def energy(self, x: ArrayLike, t: float = 0.0) -> FloatArray:
        """Return T + V at the states x, (…,), J, at the time t, s.

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
            tape, [TIME, *self.q, *self.parameter_symbols], [tape.let(self.potential)]
        )
        (value,) = potential(t, *np.moveaxis(q, -1, 0), *self.parameter_values)
        return np.asarray(kinetic + value)


def check_underactuated(name: str, n: int, m: int) -> None:
    """Refuse n coordinates under m inputs, unless 0 < m < n.

    Raises ModelError with both numbers.
    """
    if not 0 < m < n:
        raise ModelError(
            f"'{name}' is not underactuated",
            value=f"{n} coordinates and {m} inputs",
            limit="at least one input and fewer inputs than coordinates",
            remedy="Fully actuated mechanisms need no sliding surface of this kind",
        )


def energies(
    name: str,
    coordinates: Sequence[Coordinate],
    inputs: Sequence[Input],
    parameters: Sequence[Parameter],
    kinetic: sp.Expr,
    potential: sp.Expr,
    dissipation: sp.Expr | float,
) -> tuple[sp.Expr, sp.Expr, sp.Expr]:
    """Check T, V and D before anything is derived from them, and return them as expressions.

    Raises ModelError for undeclared symbols, and for expressions without the derivatives that the
    equations of motion need; InvalidInputError for coordinates, inputs or parameters of another
    type.
    """
    check_parts(name, coordinates, inputs, parameters)
    data = vocabulary(parameters=parameters, time=False)
    q, qd = {c.symbol for c in coordinates}, {c.velocity for c in coordinates}
    places = vocabulary(coordinates, velocities=False) | data
    motion = vocabulary(coordinates, time=False) | data
    found = []
    for what, given, known, variables in (
        ("kinetic energy", kinetic, motion, q | qd),
        ("potential energy", potential, places, q),
        ("dissipation", dissipation, motion | places, qd),
    ):
        whose = f"{what} of '{name}'"
        expression = expression_of(whose, given)
        check_symbols(whose, [expression], known)
        require_smooth(whose, [expression], variables)
        found.append(expression)
    T, V, D = found
    return T, V, D


def matrix_of(what: str, value: object) -> sp.ImmutableDenseMatrix:
    """Return a matrix of SymPy expressions; refuse text, which SymPy would evaluate."""
    try:
        if not isinstance(value, sp.MatrixBase):
            rows = np.array(value, dtype=object)
            value = sp.Matrix(*rows.shape, rows.ravel().tolist()) if rows.ndim == 2 else rows
            for entry in rows.ravel():
                expression_of(what, entry)
        return sp.ImmutableDenseMatrix(value)
    except ModelError:
        raise
    except (TypeError, ValueError, NotImplementedError) as error:
        raise ModelError(
            what,
            value=f"{value!r}, {a_kind(value)}",
            limit="a matrix of SymPy expressions",
            remedy="Write sympy.Matrix([[...], [...]])",
        ) from error


@lru_cache(maxsize=64)
def _compiled_dynamics(mechanism: Mechanism) -> Callable[..., list[Any]]:
    tape = Tape()
    forward = mechanism.partition(tape).accelerations(sp.Matrix(mechanism.u))
    arguments = [TIME, *mechanism.x, *mechanism.u, *mechanism.parameter_symbols]
    return compile_numpy(tape, arguments, forward)
