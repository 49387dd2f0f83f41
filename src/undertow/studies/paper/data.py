"""What the paper prints: conditions, surfaces and totals of Tables 1 and 2, with errata.

Errata that touch these numbers (those of the equations stand where the equations do):

* Sec. 4 gives d_e = 0.073 N m s/rad and "|φ(0)| between 40 deg and 45 deg".  Under these the
  printed totals cannot occur: see :func:`undertow.studies.paper.findings`, which computes why.  One
  other condition gives all six, d_e = 0.025 N m s/rad and φ(0) = 40.9°, found by a fit of
  the two numbers to the six totals; it is called *matched* here.
* "[The] horizon … never exceeds 17 s" (Sec. 4.1) does not go with λ_a/α_a = 0.1 1/s, a time
  constant of 10 s, and ν = 0.01 on the whole state: Table 1's cascade needs about 58 s.
* Table 2 prints its parameters as α_ii, λ_ii and λ_ia: α_u, λ_u and λ_a.
* The appendix computes with b = 0.0033 kg m²; Sec. 4's own numbers give 0.0045016.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import radians
from types import MappingProxyType

from undertow.law import Surface
from undertow.mechanisms import rotary_pendulum
from undertow.models import FloatArray, Mechanism
from undertow.objective import MinimumEnergy, MinimumTime, Objective

#: Δt between re-optimisations, s (Sec. 4).
PERIOD = 0.1

#: "varies during the optimization but never exceeds 17 s" (Sec. 4.1).
HORIZON_CLAIM = 17.0

ROWS = ("base", "one-time", "cascade")


@dataclass(frozen=True)
class Condition:
    """A plant and a start: damping d_e, N m s/rad, and φ(0), rad, all else at rest."""

    key: str
    title: str
    d_e: float
    phi: float

    @property
    def mechanism(self) -> Mechanism:
        """The rotary pendulum with this damping."""
        return rotary_pendulum(d_e=self.d_e)

    @property
    def start(self) -> FloatArray:
        """The initial state, (4,)."""
        return self.mechanism.state(phi=self.phi)


CONDITIONS: Mapping[str, Condition] = MappingProxyType(
    {
        c.key: c
        for c in (
            Condition("as-printed-40", "as printed, 40°", 0.073, radians(40.0)),
            Condition("as-printed-45", "as printed, 45°", 0.073, radians(45.0)),
            Condition("matched", "matched, 40.9°", 0.025, radians(40.9)),
        )
    }
)


#: (40) and (41) with the paper's ν = 0.01; its 17 s horizon cannot be kept (see above), 60 s can.
OBJECTIVES: Mapping[str, Objective] = MappingProxyType(
    {"energy": MinimumEnergy(unit="V² s"), "time": MinimumTime()}
)


@dataclass(frozen=True)
class Printed:
    """One column of Table 1 or 2: the surfaces, in order of use, and the total."""

    surfaces: tuple[Surface, ...]
    total: float

    @property
    def switch_times(self) -> tuple[float, ...]:
        """When each surface takes over, s."""
        return tuple(k * PERIOD for k in range(len(self.surfaces)))


def _surface(alpha_u: float, lambda_u: float, lambda_a: float) -> Surface:
    """Return a surface from the order of the tables, α_a = −1."""
    return Surface(-1.0, lambda_a, alpha_u, lambda_u)


#: The base case of Tables 1 and 2.
BASE = _surface(5, 10, -0.5)
_ENERGY = (
    _surface(1.94, 11.14, -0.248),
    _surface(2.18, 13.37, -0.1),
    _surface(2.5, 15.27, -0.107),
    _surface(2.46, 15.25, -0.1),
)
_TIME = (
    _surface(1.96, 12.1, -1.59),
    _surface(1.5, 9.69, -2.36),
    _surface(1.49, 9.66, -2.4),
    _surface(1.49, 9.66, -2.4),
)

#: (objective, row) to what Tables 1 (energy, V² s) and 2 (time, s) print.
PRINTED: Mapping[tuple[str, str], Printed] = MappingProxyType(
    {
        ("energy", "base"): Printed((BASE,), 44.7),
        ("energy", "one-time"): Printed(_ENERGY[:1], 17.6),
        ("energy", "cascade"): Printed(_ENERGY, 15.7),
        ("time", "base"): Printed((BASE,), 16.2),
        ("time", "one-time"): Printed(_TIME[:1], 2.8),
        ("time", "cascade"): Printed(_TIME, 2.0),
    }
)

#: The appendix's five cases: a name to the surface.
CASES: Mapping[str, Surface] = MappingProxyType(
    {
        "1 base case": BASE,
        "2 one-time, energy": _ENERGY[0],
        "3 last of cascade, energy": _ENERGY[3],
        "4 one-time, time": _TIME[0],
        "5 last of cascade, time": _TIME[3],
    }
)
