"""The energy law of a swing-up.

Fantoni and Lozano's (*Non-linear Control for Underactuated Mechanical Systems*, Springer
2002), one formula for every mechanism with one input and a potential: with
Ẽ = E − E(target) − surplus, the Lyapunov function ½ Ẽ² + ½ k_D q̇_a² + ½ k_P q_a² falls as
−k_V q̇_a² under

    B u = −(k_P q_a + k_V q̇_a + k_D S⁻¹ h) / (Ẽ + k_D S⁻¹),    S q̈_a = h + B u   (4),

where Ẽ + k_D/S > 0; with a clipped input, small gains k_D swing up by bang-bang instead and
no proof is left: gains are found by search (``search.py``).  The surplus, which the books
leave at zero, pays for what friction takes on the way to the top.

Then (4) drives q_a home before what hangs from it has its energy: a second link stays hanging
where it is heavy or rubs.  −k_E Ẽ M_au q̇_u more, inside the brackets, accelerates q_a as
Spong's pumping does (*IEEE Control Systems* 15(1), 1995): while energy is missing, so that what
is not driven gains it.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import sympy as sp

from undertow.base import ModelError, require
from undertow.models import FloatArray, Mechanism
from undertow.symbolic import (
    COMPILED,
    PREAMBLE,
    Tape,
    content_key,
    docstring,
    function_source,
    generated,
)

#: While the kinetic energy is below this part of what is missing, the law pushes the way the joint
#: moves, or inwards: at rest its formula gives nothing.
STILL = 0.002
#: How hard it pushes, part of the input's limit.
KICK = 0.3

_BODY = f"""
{COMPILED}
def swing(x, gains, parameters, limit, middle, work):
    energies(x, parameters, work[0:2])
    blocks(x, parameters, work[2:6])
    kinetic, S, h, B = work[0], work[2], work[3], work[4]
    missing = work[1] - gains[3]
    n = x.shape[0] // 2
    away = x[0] - middle
    if kinetic < {STILL} * abs(missing - kinetic):
        along = x[n] if x[n] != 0.0 else -away
        return {KICK} * limit * (-1.0 if along * B < 0.0 else 1.0)
    weight = max(missing + gains[0] / S, 1e-9)
    pump = gains[4] * missing * work[5]
    force = -(gains[1] * away + gains[2] * x[n] + gains[0] * h / S - pump) / weight
    return max(-limit, min(limit, force / B))
"""


def swing_source(mechanism: Mechanism) -> str:
    """Return compiled ``swing(x, gains, parameters, limit, middle, work)``, as source.

    It gives the input, within its limit, for k_D, k_P, k_V, the surplus and k_E, about q_a =
    ``middle``; ``work`` holds six numbers.
    """
    tape = Tape()
    part = mechanism.partition(tape)
    velocities = sp.Matrix(mechanism.x[mechanism.n :])
    kinetic = (velocities.T * sp.Matrix(mechanism.mass_matrix) * velocities)[0] / 2
    assert mechanism.potential is not None  # SwingUp refuses it otherwise
    at_target = mechanism.potential.subs(dict.fromkeys(mechanism.q, 0))
    energies = tape.let_all([kinetic, kinetic + mechanism.potential - at_target])
    given = {"x": mechanism.x, "parameters": mechanism.parameter_symbols}
    coupling = (sp.Matrix(mechanism.mass_matrix)[:1, 1:] * velocities[1:, :])[0]
    blocks = [part.S[0, 0], part.h[0], part.B[0, 0], tape.let_all([coupling])[0]]
    return "\n\n".join(
        [
            function_source("energies", tape, given, {"E": energies}),
            function_source("blocks", tape, given, {"out": blocks}),
            _BODY,
        ]
    )


@lru_cache(maxsize=32)
def _module(mechanism: Mechanism) -> Any:
    key = content_key(mechanism.structure, mechanism.name)

    def write() -> str:
        head = docstring(f"Swing-up of {mechanism.name}; generated, do not edit.")
        return f"{head}{PREAMBLE}\n\n{swing_source(mechanism)}"

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
    """k_D, k_P and k_V of the swing-up, in SI units, relative to a gain of 1 on the energy.

    ``surplus`` is what it aims at above the energy of the target, J; ``on_coupling`` is k_E, which
    pumps energy into what is not driven.
    """

    on_acceleration: float
    on_position: float
    on_velocity: float
    surplus: float = 0.0
    on_coupling: float = 0.0


def periods(mechanism: Mechanism) -> FloatArray:
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
        One or more :class:`Gains`, the best first; :func:`undertow.cascade.swing_up.designed` finds
        them.

    Raises
    ------
    ModelError
        For a mechanism that the formula does not cover.
    """

    mechanism: Mechanism
    gains: tuple[Gains, ...]
    _work: FloatArray = field(default_factory=lambda: np.zeros(6), repr=False)

    def __post_init__(self) -> None:
        """Refuse several inputs, no potential, no limit."""
        mechanism = self.mechanism
        limit, bare = mechanism.inputs[0].limit, mechanism.potential is None
        require(
            mechanism.m == 1 and not bare and math.isfinite(limit),
            f"swing-up of '{mechanism.name}'",
            f"{mechanism.m} inputs, {'no' if bare else 'a'} potential, limit {limit:g}",
            "one input with a finite limit, and a potential",
            "Give potential= and a limit to the mechanism"
            if mechanism.m == 1
            else "With several inputs start it near its target, where the law holds it",
            ModelError,
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
