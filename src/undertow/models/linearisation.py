"""A mechanism linearised at its target: A, B, and how far they are from uncontrollable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp
from sympy.core.function import Application

from undertow.base import ModelError, require_extra
from undertow.models.mechanism import Mechanism
from undertow.models.partition import compiled
from undertow.models.quantities import TIME, FloatArray, numbers
from undertow.models.validity import kinks, require_smooth, shortened

#: Largest |f_u| at a target, as a part of :func:`force_scale`.
AT_REST = 1e-9

#: Longest Runge-Kutta step in time constants of the fastest mode: a step of the fourth order is off
#: by 8e-6 of what that mode then has.
OF_FASTEST = 0.25

#: What counts as no distance from an uncontrollable pair, see :func:`controllability`.
UNCONTROLLABLE = 1e-9


@dataclass(frozen=True, eq=False)
class Linearisation:
    """``M q̈ = F q + D q̇ + (B u, 0)`` at the target, numbers; u from the input that holds it.

    ``M, F, D`` are (n, n), ``B`` (m, m); ``states`` and ``inputs`` are names, in the order of
    A, and ``name`` is the mechanism's.
    """

    M: FloatArray
    F: FloatArray
    D: FloatArray
    B: FloatArray
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    name: str = ""

    def __repr__(self) -> str:
        """Show its states, its inputs and the eigenvalues of A."""
        modes = ", ".join(f"{mode:.4g}" for mode in np.linalg.eigvals(self.A))
        return f"Linearisation({', '.join(self.states)}; {', '.join(self.inputs)}; eig A: {modes})"

    @property
    def A(self) -> FloatArray:
        """State matrix of ẋ = A x + ``input`` u with x = (q, q̇), (2n, 2n)."""
        n = len(self.M)
        lower = np.linalg.solve(self.M, np.hstack([self.F, self.D]))
        return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower])

    @property
    def fastest(self) -> float:
        """Rate of the fastest mode, the largest |eigenvalue| of A, 1/s."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    @property
    def growth(self) -> float:
        """Rate at which what leaves the target by itself grows, the largest Re λ or 0, 1/s."""
        return max(0.0, float(np.linalg.eigvals(self.A).real.max()))

    @property
    def input(self) -> FloatArray:
        """Input matrix of ẋ = ``A`` x + ``input`` u, (2n, m)."""
        n, m = len(self.M), len(self.B)
        force = np.vstack([self.B, np.zeros((n - m, m))])
        return np.vstack([np.zeros((n, m)), np.linalg.solve(self.M, force)])

    def ss(self) -> Any:
        """Return ẋ = A x + B u, y = x as a ``control.StateSpace`` of python-control, with names.

        Raises
        ------
        MissingExtraError
            Without python-control.
        """
        control = require_extra("control", "interop", "state-space objects need python-control")
        size, m = len(self.states), len(self.inputs)
        return control.ss(
            self.A,
            self.input,
            np.eye(size),
            np.zeros((size, m)),
            states=self.states,
            inputs=self.inputs,
            outputs=self.states,
            name=self.name.replace(".", "_") or None,  # python-control takes no dots
        )


@lru_cache(maxsize=128)
def linearise(mechanism: Mechanism) -> Linearisation:
    """Linearise a mechanism at its target x = 0, disturbances at t = 0 included.

    Raises
    ------
    ModelError
        When the target is no equilibrium under any input, or f has no derivative there.
    """
    n = mechanism.n
    if not _is_analytic(mechanism.force, mechanism.x):
        require_smooth(
            f"force of '{mechanism.name}'", mechanism.force, mechanism.x, at=_target(mechanism)
        )
    rest, jacobian = _force_at_target(mechanism, mechanism.parameter_values)
    if not (np.isfinite(rest).all() and np.isfinite(jacobian).all()):
        raise ModelError(
            f"force of '{mechanism.name}' at the target",
            value=f"f = {rest}, with slopes that are not finite"
            if np.isfinite(rest).all()
            else rest,
            limit="finite, with its slopes",
            remedy="Something is divided by zero there: rewrite the expression",
        )
    if not np.abs(rest[mechanism.m :]).max() <= AT_REST * force_scale(mechanism):
        from undertow.models.importers.equations import nearest_equilibrium

        raise ModelError(
            f"target of '{mechanism.name}'",
            value=f"f_u(0, 0) = {rest[mechanism.m :]}",
            limit="an equilibrium, f_u = 0",
            remedy=nearest_equilibrium(mechanism),
        )
    return Linearisation(
        M=mechanism.M(np.zeros(n)),
        F=jacobian[:, :n],
        D=jacobian[:, n:],
        B=_gain(mechanism, mechanism.parameter_values[None])[0],
        states=mechanism.state_names,
        inputs=tuple(i.name for i in mechanism.inputs),
        name=mechanism.name,
    )


@lru_cache(maxsize=128)
def force_scale(mechanism: Mechanism) -> float:
    """Largest force at rest over random positions, N m or N; 1 where there is none."""
    q = np.random.default_rng(0).uniform(-1, 1, (64, mechanism.n))
    with np.errstate(all="ignore"):  # some may lie outside the domain of f
        forces = mechanism.f(np.hstack([q, np.zeros_like(q)]))
    return float(np.abs(forces[np.isfinite(forces)]).max(initial=0.0)) or 1.0


@lru_cache(maxsize=128)
def has_linear_model(mechanism: Mechanism) -> bool:
    """Whether f has a derivative at the target: :func:`linearise` refuses where it has none."""
    return _is_analytic(mechanism.force, mechanism.x) or (
        next(kinks(mechanism.force, mechanism.x, at=_target(mechanism)), None) is None
    )


def linear_numbers(
    mechanism: Mechanism, values: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return M, (K, n, n), ∂f/∂x, (K, n, 2n), and B, (K, m, m), at the target for K plants.

    ``values`` are those of all parameters, (K, P), SI units; nothing is checked.
    """
    n, count = mechanism.n, len(values)
    at_rest = [0.0] * (2 * n + 1)
    mass = _stacked(mechanism.function("mass")(*at_rest, *values.T), count)
    found = _complex_step(mechanism, values)
    slopes = (
        np.stack([_force_at_target(mechanism, each)[1] for each in values])
        if found is None
        else found[1]
    )
    return mass.reshape(count, n, n), slopes, _gain(mechanism, values)


def growth_rate(mechanism: Mechanism) -> float:
    """Return how fast what leaves the target by itself grows, 1/s; 0 without a linear model."""
    try:
        return linearise(mechanism).growth
    except ModelError:
        return 0.0


def fastest_rate(mechanism: Mechanism) -> float:
    """Return the largest |λ| of the linear model, 1/s.

    A motor's back-EMF or a damped joint may be a thousand times as fast as the balancing, and a
    step that is long beside it is off, or unstable.  Where there is no linear model, the force
    having a kink, nothing is known of modes: then it is 0.
    """
    try:
        return linearise(mechanism).fastest
    except ModelError:
        return 0.0


def longest_step(mechanism: Mechanism, most: float, part: float = OF_FASTEST) -> float:
    """Return how long Runge-Kutta steps may be, s: ``most``, or less where a mode is fast.

    That is, longer than ``part`` of its time constant.
    """
    rate = fastest_rate(mechanism)
    return part / rate if rate * most > part else most


def steps_in(mechanism: Mechanism, seconds: float, most: float, part: float = OF_FASTEST) -> int:
    """Return how many Runge-Kutta steps a length takes, none longer than :func:`longest_step`."""
    return math.ceil(seconds / longest_step(mechanism, most, part) - 1e-9)


def linear_accelerations(mechanism: Mechanism, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ∂q̈/∂x, (K, n, 2n), and ∂q̈/∂u, (K, n, m), at the target for K plants.

    ``values`` are those of all parameters, (K, P), SI units; nothing is checked.
    """
    mass, forces, gain = linear_numbers(mechanism, values)
    inputs = np.pad(gain, [(0, 0), (0, mechanism.n - mechanism.m), (0, 0)])
    return np.linalg.solve(mass, forces).astype(float), np.linalg.solve(mass, inputs).astype(float)


def _gain(mechanism: Mechanism, values: FloatArray) -> FloatArray:
    """Return B of K plants, (K, m, m), from all their parameters, (K, P)."""
    function = compiled(mechanism.input_matrix, mechanism.parameter_symbols)
    return _stacked(function(*values.T), len(values)).reshape(-1, mechanism.m, mechanism.m)


def _stacked(entries: Sequence[Any], count: int) -> FloatArray:
    """Return entries, numbers or (K,), as (K, entries)."""
    columns = [np.broadcast_to(np.asarray(e, dtype=float), count) for e in entries]
    return np.stack(columns, axis=-1)


def _target(mechanism: Mechanism) -> dict[sp.Symbol, float]:
    """All symbols of f to their values at the target, at t = 0."""
    return mechanism.substitution | dict.fromkeys((*mechanism.x, TIME), 0.0)


#: Functions that NumPy continues analytically to complex arguments.
_ANALYTIC = (
    sp.sin, sp.cos, sp.tan, sp.exp, sp.log, sp.sinh, sp.cosh, sp.tanh, sp.atan, sp.asinh,
)  # fmt: skip


@lru_cache(maxsize=256)
def _is_analytic(force: sp.ImmutableDenseMatrix, x: tuple[sp.Symbol, ...]) -> bool:
    """Whether NumPy continues f analytically to complex states."""
    return all(isinstance(f, _ANALYTIC) for f in force.atoms(Application)) and all(
        power.exp.is_Integer for power in force.atoms(sp.Pow) if power.base.has(*x)
    )


def _complex_step(mechanism: Mechanism, values: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return f, (K, n), and ∂f/∂x, (K, n, 2n), at the target by a complex step, exact to rounding.

    ``None`` where f is not analytic, or not finite.
    """
    if not _is_analytic(mechanism.force, mechanism.x):
        return None
    size = 2 * mechanism.n
    step = 1e-200  # its square is nothing: what is flat to first order comes out as zero
    x = np.vstack([np.zeros(size), 1j * step * np.eye(size)])
    function = mechanism.function("force")
    columns = values[0] if len(values) == 1 else values.T[:, :, None]
    with np.errstate(all="ignore"):
        entries = function(0.0, *x.T, *columns)
        at_rest = function(0.0, *np.zeros(size), *columns)
    real = all(np.isfinite(np.asarray(e, dtype=float)).all() for e in at_rest)
    f = np.stack([np.broadcast_to(e, (len(values), size + 1)) for e in entries], axis=1)
    if not (real and np.isfinite(f).all()):  # of a negative number, a logarithm is complex
        return None
    return f[:, :, 0].real, f[:, :, 1:].imag / step


def _force_at_target(mechanism: Mechanism, given: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return f, (n,), and ∂f/∂x, (n, 2n), at x = 0 and t = 0, for some parameter values.

    By a complex step where f is analytic; else by symbolic derivatives.
    """
    found = _complex_step(mechanism, given[None])
    if found is not None:
        return found[0][0], found[1][0]
    at_target = dict.fromkeys(mechanism.x, 0)
    numbered = dict(zip(mechanism.parameter_symbols, given.tolist(), strict=True))
    numeric = sp.Matrix(mechanism.force).subs(numbered | {TIME: 0})
    jacobian = numeric.jacobian(list(mechanism.x)).subs(at_target)
    try:
        return numbers(numeric.subs(at_target)).ravel(), numbers(jacobian)
    except TypeError as error:  # zoo, or complex
        raise ModelError(
            f"force of '{mechanism.name}' at the target",
            value=shortened(list(numeric.subs(at_target))),
            limit="real and finite, with its slopes",
            remedy="Something is divided by zero there, or a root or logarithm taken of a "
            "negative number",
        ) from error


def full_accelerations(mechanism: Mechanism) -> FloatArray:
    """What the full inputs do to each acceleration at the target, (n,), rad/s² or m/s².

    Of an input without a limit one unit counts.
    """
    limits, rest = mechanism.input_limits, np.zeros(2 * mechanism.n)
    full = np.diag(np.where(np.isfinite(limits), limits, 1.0))
    still = mechanism.accelerations(0.0, rest, np.zeros(len(limits)))
    driven = sum(np.abs(mechanism.accelerations(0.0, rest, u) - still) for u in full)
    return np.asarray(driven, dtype=float)


def controllability(mechanism: Mechanism) -> float:
    """Distance of (A, B) at the target from an uncontrollable pair, relative, ≥ 0.

    The smallest singular value of [λI − A, B] over the eigenvalues λ of A (Hautus test),
    over ‖[A, B]‖₂; zero means that no linear surface can stabilise.  Inputs are in units in which
    their columns of B are as long as A: whether N or µN does not count.
    """
    lin = linearise(mechanism)
    A = lin.A
    largest = np.abs(lin.input).max(axis=0)
    B = lin.input / np.where(largest > 0, largest, 1.0)  # squares of it neither vanish nor overflow
    B *= np.linalg.norm(A, 2) / np.fmax(np.linalg.norm(B, axis=0), 1.0)
    scale = float(np.linalg.norm(np.hstack([A, B]), 2))
    tests = [
        np.linalg.svd(np.hstack([eigenvalue * np.eye(len(A)) - A, B]), compute_uv=False)[-1]
        for eigenvalue in np.linalg.eigvals(A)
    ]
    return float(min(tests)) / scale


def uncontrollable(mechanism: Mechanism) -> ModelError:
    """Return the condition that no linear feedback stabilises a mechanism at its target."""
    return ModelError(
        f"linearisation of '{mechanism.name}' at the target",
        value=f"relative distance to an uncontrollable pair {controllability(mechanism):.2e}",
        limit="> 0",
        remedy="No linear surface or feedback stabilises it: choose another target or actuate "
        "another joint",
    )
