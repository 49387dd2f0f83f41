"""Identities and class conditions that every mechanism must satisfy, with their numbers.

The first half are identities of Lagrangian mechanics: they catch slips in M and f.  The second
half are the assumptions of the paper's Sec. 2 (Remarks 3 and 4): where one fails, no sliding
surface of this kind can stabilise the target, and the condition says why and what could help.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import sympy as sp

from undertow.base import ModelError, at_least, checked
from undertow.models import (
    FloatArray,
    Mechanism,
    controllability,
    force_scale,
    has_linear_model,
    linearise,
)
from undertow.models.importers.equations import nearest_equilibrium
from undertow.symbolic import Tape, compile_numpy

#: Largest relative residual of an identity at float64.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Check:
    """One condition: its name, whether it holds, the number found and the limit.

    ``value`` is NaN where it could not be computed; ``remedy`` says what could help where it fails.
    """

    name: str
    passed: bool
    value: float
    limit: str
    remedy: str = ""

    def __str__(self) -> str:
        """One line: mark, name, value, limit."""
        mark = "ok  " if self.passed else "FAIL"
        line = f"{mark} {self.name}: {self.value:.3g} ({self.limit})"
        return line if self.passed or not self.remedy else f"{line}. {self.remedy}"


@dataclass(frozen=True)
class MechanismReport:
    """All conditions of one mechanism, in the order in which they were asked."""

    mechanism: str
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every condition holds."""
        return all(check.passed for check in self.checks)

    @property
    def failures(self) -> tuple[Check, ...]:
        """The conditions that fail."""
        return tuple(check for check in self.checks if not check.passed)

    def __getitem__(self, name: str) -> Check:
        """Return the first condition whose name starts with ``name``."""
        return next(check for check in self.checks if check.name.startswith(name))

    def __repr__(self) -> str:
        """Show how many conditions hold, and those that fail; ``print`` shows all of them."""
        failed = "".join(f"; fails: {check.name}" for check in self.failures)
        held = len(self.checks) - len(self.failures)
        return f"MechanismReport({self.mechanism}, {held} of {len(self.checks)} hold{failed})"

    def __str__(self) -> str:
        """One line for each condition."""
        return "\n".join([f"{self.mechanism}:", *(f"  {check}" for check in self.checks)])


@checked
def check_mechanism(
    mechanism: Mechanism,
    *,
    strict: bool = False,
    samples: int = 64,
    seed: int = 0,
    compiled: bool = True,
) -> MechanismReport:
    """Check a mechanism at random states and at its target.

    Identities: M symmetric and positive definite, a function of q alone; the velocity-dependent
    forces those that M implies (Ṁ − 2C skew-symmetric, and more: Lagrange's own); the forces at
    rest those of the potential, so that the rate of energy equals the power of inputs and
    damping; damping that takes energy; inverse dynamics that undo forward dynamics.

    Class conditions (Sec. 2, Remarks 3-4): x = 0 is an equilibrium that the inputs can hold;
    the equilibria near it form a manifold of dimension at most m; the linearisation there is
    controllable; the start state lies within the ranges.

    Compiled code: the NumPy functions, the fast loop's law, one step of the rollout kernel and
    the programme of the proofs are compared with M, f, B and the law evaluated exactly, see
    :mod:`undertow.checks.agreement`.  What is not kept from an earlier run is compiled first,
    which takes some seconds.

    Parameters
    ----------
    mechanism
        The model to check.
    strict
        Raise on the first condition that fails, instead of reporting it.
    samples
        Random states for the identities.
    seed
        Of the random states.
    compiled
        Whether compiled code is compared with the symbols.

    Returns
    -------
    MechanismReport
        Print it for a table.

    Raises
    ------
    ModelError
        With ``strict``: the condition, the value found, the limit and the remedy.

    Examples
    --------
    >>> import undertow as ut
    >>> from undertow.checks.check import check_mechanism
    >>> check_mechanism(ut.mechanisms.rotary_pendulum()).passed
    True
    """
    at_least("samples", samples, 1, "64 are usual")
    at_least("seed", seed, 0)
    rng = np.random.default_rng(seed)
    q = _positions(mechanism, rng, samples)
    qd = rng.uniform(-3.0, 3.0, q.shape)
    checks = (
        *_inertia(mechanism, q),
        *_forces(mechanism, q, qd),
        _inverse(mechanism, q, qd, rng),
        *_target(mechanism),
        *_limits(mechanism),
        *_start(mechanism),
    )
    if compiled and _solvable(checks):
        checks += _agreement(mechanism, seed)
    report = MechanismReport(mechanism.name, checks)
    if strict and report.failures:
        first = report.failures[0]
        raise ModelError(
            f"'{mechanism.name}', {first.name}",
            value=f"{first.value:.4g}",
            limit=first.limit,
            remedy=first.remedy,
        )
    return report


def _small(name: str, value: float, of: str, remedy: str) -> Check:
    """Check that a number is zero but for rounding, relative to what ``of`` says."""
    return Check(name, value <= _ROUNDING, value, f"≤ {_ROUNDING:g} {of}", remedy)


def _large(name: str, value: float, of: str, remedy: str) -> Check:
    """Check that a number is above what rounding makes of zero."""
    return Check(name, value > _ROUNDING, value, f"> {_ROUNDING:g} {of}".rstrip(), remedy)


def _none(name: str, found: Collection[object], remedy: str) -> Check:
    """Check that nothing of a kind was found."""
    return Check(name, not found, float(len(found)), "0", remedy)


def _solvable(checks: tuple[Check, ...]) -> bool:
    """Whether M is what every later formula takes it for."""
    return all(check.passed for check in checks if check.name.startswith("M "))


def _agreement(mechanism: Mechanism, seed: int) -> tuple[Check, ...]:
    """Compare compiled code with exact values; the remedy names the worst difference."""
    # Not wanted by a mere ``import undertow``: the programmes of the proofs come with it.
    from undertow.checks.agreement import LIMIT, QUICK, Subject, numpy_functions, worst

    try:
        subject = Subject(mechanism, count=1, seed=seed)
    except ModelError as error:
        return (Check("compiled code as the symbols", False, math.nan, "comparable", str(error)),)
    differences = {
        what: worst(compare(subject))
        for what, compare in QUICK.items()
        if subject.autonomous or compare is numpy_functions
    }
    return tuple(
        Check(
            f"{what} as the symbols in 50 digits, largest difference",
            difference.relative <= LIMIT,
            difference.relative,
            f"≤ {LIMIT:g}, relative to what rounding scales with",
            f"{difference}. Empty the cache of generated code ($UNDERTOW_CACHE, or "
            "undertow in the user's); report it if it stays",
        )
        for what, difference in differences.items()
        if difference is not None
    )


def _positions(mechanism: Mechanism, rng: np.random.Generator, samples: int) -> FloatArray:
    reach = np.array([math.pi if c.unit == "rad" else 1.0 for c in mechanism.coordinates])
    low = np.maximum([c.low for c in mechanism.coordinates], -reach)
    high = np.minimum([c.high for c in mechanism.coordinates], reach)
    # A range that excludes the target is reported elsewhere; here it must not break the draw.
    return rng.uniform(np.minimum(low, high), np.maximum(low, high), (samples, mechanism.n))


def _inertia(mechanism: Mechanism, q: FloatArray) -> Iterator[Check]:
    M = mechanism.M(q)
    gap = float(np.abs(M - np.swapaxes(M, -1, -2)).max() / np.abs(M).max())
    diagonal = np.diagonal(M, axis1=-2, axis2=-1)
    smallest = -math.inf
    if (diagonal > 0).all():
        # Scaled to a unit diagonal, kg and kg m² compare.
        root = np.sqrt(diagonal)
        scaled = M / (root[..., :, None] * root[..., None, :])
        smallest = float(np.linalg.eigvalsh(scaled)[..., 0].min())
    foreign = mechanism.mass_matrix.free_symbols - {*mechanism.q, *mechanism.parameter_symbols}
    remedy = "Multiply the equations so that they are Lagrange's, row by row"
    yield _small("M is symmetric, |M − Mᵀ|", gap, "of |M|", remedy)
    remedy = "Check masses, lengths and inertias: a massless link has no M > 0"
    yield _large("M > 0, smallest eigenvalue with M scaled to unit diagonal", smallest, "", remedy)
    remedy = "Move what depends on velocity or time to f"
    yield _none("M depends on q only, other symbols", foreign, remedy)


def _forces(mechanism: Mechanism, q: FloatArray, qd: FloatArray) -> Iterator[Check]:
    """Split f into what is even and odd in q̇; the even part is Lagrange's, the odd part damps."""
    n = mechanism.n
    ahead = mechanism.f(np.hstack([q, qd]))
    back = mechanism.f(np.hstack([q, -qd]))
    rest = mechanism.f(np.hstack([q, np.zeros_like(q)]))
    even, odd = (ahead + back) / 2, (ahead - back) / 2
    entries = [sp.diff(M, symbol) for M in mechanism.mass_matrix for symbol in mechanism.q]
    slopes = _evaluated(mechanism, entries, q).astype(float).reshape(len(q), n, n, n)
    # c_i = Σ_jk (∂M_ij/∂q_k − ½ ∂M_jk/∂q_i) q̇_j q̇_k
    c = np.einsum("sijk,sj,sk->si", slopes, qd, qd)
    c -= np.einsum("sjki,sj,sk->si", slopes, qd, qd) / 2
    scale = float(np.abs(c).max() + np.abs(rest).max() + np.abs(odd).max()) or 1.0
    coriolis = float(np.abs(even - rest + c).max()) / scale
    power = np.einsum("si,si->s", odd, qd)
    yield _small(
        "velocity-dependent forces are Lagrange's (Ṁ − 2C skew-symmetric), residual",
        coriolis,
        "of |f|",
        "Derive f from M: Mechanism.from_energies does it",
    )
    if mechanism.potential is not None:
        gradient = [sp.diff(mechanism.potential, symbol) for symbol in mechanism.q]
        dV = _evaluated(mechanism, gradient, q)
        balance = float(np.abs(rest + dV).max()) / scale
        yield _small(
            "forces at rest are −∂V/∂q, so the rate of energy is the power, residual",
            balance,
            "of |f|",
            "Correct the potential, or leave it out",
        )
    worst = float(power.max()) / (scale * float(np.abs(qd).max()) * n)
    remedy = "Check the signs of damping: forces odd in q̇ must oppose the motion"
    yield _small("damping takes energy, largest power", worst, "of |f| |q̇|", remedy)


def _evaluated(mechanism: Mechanism, expressions: Iterable[sp.Expr], q: FloatArray) -> FloatArray:
    """Return expressions in q at the positions, (samples, expressions)."""
    tape = Tape()
    inputs = [*mechanism.q, *mechanism.parameter_symbols]
    run = compile_numpy(tape, inputs, tape.let_all(expressions))
    values = run(*q.T, *mechanism.parameter_values)
    return np.stack([np.broadcast_to(v, len(q)) for v in values], axis=-1)


def _inverse(
    mechanism: Mechanism, q: FloatArray, qd: FloatArray, rng: np.random.Generator
) -> Check:
    """Forward, then inverse dynamics: M q̈(u) − f = (B u, 0)."""
    limits = np.minimum(mechanism.input_limits, 1e3)
    u = rng.uniform(-1, 1, (len(q), mechanism.m)) * limits
    x = np.hstack([q, qd])
    forces = mechanism.forces(0.0, x, mechanism.accelerations(0.0, x, u))
    wanted = np.hstack([u @ mechanism.B.T, np.zeros((len(q), mechanism.n - mechanism.m))])
    scale = float(np.abs(forces).max() + np.abs(mechanism.f(x)).max()) or 1.0
    residual = float(np.abs(forces - wanted).max()) / scale
    remedy = "M is close to singular somewhere: check masses and inertias"
    return _small("inverse dynamics undo forward dynamics, residual", residual, "of |f|", remedy)


def _target(mechanism: Mechanism) -> Iterator[Check]:
    n, m = mechanism.n, mechanism.m
    rest = mechanism.f(np.zeros(2 * n))
    outside = [c.name for c in mechanism.coordinates if not c.low <= 0 <= c.high]
    left = float(np.abs(rest[m:]).max()) / force_scale(mechanism)
    effort = float(np.max(np.abs(np.linalg.solve(mechanism.B, rest[:m])) / mechanism.input_limits))
    remedy = f"Range of {', '.join(outside)}: move the target, or correct the range"
    yield _none("target x = 0 lies within the ranges, coordinates outside", outside, remedy)
    yield _small(
        "target x = 0 is an equilibrium of the free coordinates, |f_u(0, 0)|",
        left,
        "of |f| at rest",
        ("" if left <= _ROUNDING else f"{nearest_equilibrium(mechanism)}. ")
        + "Shift the coordinates: undertow.modelling.find_equilibrium and move_target",
    )
    yield Check(
        "inputs can hold the target, |B⁻¹ f_a(0, 0)| of their limits",
        effort < 1,
        effort,
        "< 1",
        "Choose a stronger actuator, or another target",
    )
    if left > _ROUNDING:
        return
    if has_linear_model(mechanism):
        yield _equilibria(mechanism)
        yield _controllable(mechanism)
    else:
        yield Check(
            "forces have a derivative at the target, kinks",
            False,
            1.0,
            "0",
            "Abs, sign, Max, Min and the like: without a linear model no surface is designed or "
            "tested; simulate with a surface of your own, or put smooth functions in their place",
        )


def _equilibria(mechanism: Mechanism) -> Check:
    """Remark 3: {q: f_u(q, 0) = 0} has dimension n − rank ∂f_u/∂q, which must not exceed m."""
    n, m = mechanism.n, mechanism.m
    name = f"equilibria near the target lie on a manifold of dimension ≤ m = {m}, dimension"
    limit = f"≤ {m}"
    q = np.random.default_rng(1).uniform(-1, 1, (32, n))
    rest = mechanism.f(np.hstack([q, np.zeros_like(q)]))[:, m:]
    moving = mechanism.f(np.hstack([q, np.ones_like(q)]))
    if np.abs(rest).max() <= 1e-12 * max(1.0, float(np.abs(moving).max())):
        return Check(
            name,
            False,
            float(n),
            limit,
            "Without a potential on the free coordinates every position is an equilibrium, and no "
            "continuous time-invariant feedback stabilises one (Remark 3, Brockett): free-floating "
            "arms and planar vessels need a discontinuous or time-varying law, or a spring, "
            "gravity or another actuator",
        )
    F_u = linearise(mechanism).F[m:]
    singular = np.linalg.svd(F_u, compute_uv=False)
    rank = int(np.sum(singular > _ROUNDING * max(float(singular[0]), 1e-300)))
    return Check(
        name,
        rank == n - m,
        float(n - rank),
        limit,
        "Some free coordinate feels neither gravity nor a spring to first order at the target "
        "(Remark 3): choose another target, or actuate that coordinate",
    )


def _controllable(mechanism: Mechanism) -> Check:
    distance = controllability(mechanism)
    return _large(
        "linearisation at the target is controllable, Hautus distance",
        distance,
        "of ‖[A, B]‖",
        "No linear surface stabilises it: choose another target or actuate another joint",
    )


def _limits(mechanism: Mechanism) -> Iterator[Check]:
    """Report inputs without a limit: they are allowed, but minimum time needs limits."""
    endless = [i.name for i in mechanism.inputs if math.isinf(i.limit)]
    if endless:
        name = f"inputs without a limit ({', '.join(endless)}), number"
        limit = "0 of a real actuator: with_input_limit gives one"
        yield Check(name, True, float(len(endless)), limit)


def _start(mechanism: Mechanism) -> Iterator[Check]:
    if not mechanism.start:
        return
    x = mechanism.state(**mechanism.start)
    places = zip(mechanism.coordinates, x, strict=False)
    outside = [c.name for c, value in places if not c.low <= value <= c.high]
    remedy = f"Range of {', '.join(outside)}: start closer, or correct the range"
    yield _none("start state lies within the ranges, coordinates outside", outside, remedy)
    size = float(np.linalg.norm(x))
    remedy = "Declare a start state to move from"
    yield Check("start state is not the target, ‖x‖", size > 0, size, "> 0", remedy)
