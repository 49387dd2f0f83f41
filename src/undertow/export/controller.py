"""What is exported: a mechanism, its law and plan, an estimator, and how fast it runs.

Plans are rounded to the numbers that the C holds, with checksums, which ``ut_plan_seal`` computes
in C.  A change of any single word changes that of its row for certain, since every step of the sum
can be undone; other damage does but for one case in 2³² (single precision) or 2⁶⁴.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import (
    InvalidInputError,
    check_fields,
    checked_names,
    one_for_each,
    one_of,
    positive,
    require,
)
from undertow.export.estimate import DerivativeStep, EstimatorStep, KalmanStep
from undertow.export.names import HEADERS, c_name
from undertow.law import (
    SUITED,
    LawLayout,
    Plan,
    ReachingLaw,
    SlidingModeLaw,
    Surface,
    check_surface,
    usual_reaching,
)
from undertow.models import FloatArray, Mechanism
from undertow.symbolic import Real, literal


@checked_names
@dataclass(frozen=True, eq=False)
class EmbeddedController:
    """The inner loop of a mechanism, as it is to run on a microcontroller.

    Parameters
    ----------
    mechanism
        The controller's belief; its parameter values become constants of the C.
    surface
        The surface, or the plan of surfaces, that is built in.
    reaching
        Reaching law where the plan has none of its own; by default
        :func:`undertow.law.usual_reaching` on its first surface.
    period
        Sample period, s.
    differentiator
        Where velocities come from when positions alone are measured: a differentiator, or the
        model itself, :class:`undertow.export.KalmanStep`.
    slew
        Largest rate of the inputs, their unit per second: one for all or one for each;
        ``None``: no limit.
    missed
        Periods for which a lost measurement is bridged by the last velocity.
    rows
        Most surfaces in a plan; 0: as many as are built in.
    real
        ``"double"`` or ``"float"``.
    prefix
        Beginning of every C name.

    Raises
    ------
    InvalidInputError
        When a number cannot be used, an input has no limit, or the boundary layer is too thin
        for the period.
    SingularSurfaceError, UnstableSurfaceError
        When Γ is singular at the target, or the motion on a surface does not die out there.

    Examples
    --------
    >>> import undertow as ut
    >>> from undertow.export import files
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> controller = EmbeddedController(rig, ut.first_surface(rig))
    >>> sorted(files(controller))[:2]
    ['rotary_pendulum.c', 'rotary_pendulum.h']
    """

    mechanism: Mechanism
    surface: Surface | Plan
    reaching: ReachingLaw = SUITED
    period: float = 0.001
    differentiator: EstimatorStep = DerivativeStep()
    slew: float | tuple[float, ...] | None = None
    missed: int = 5
    rows: int = 0
    real: Real = "double"
    prefix: str = "ut"

    #: Sequence number of the plan that is built in.
    number: ClassVar[int] = 1

    @property
    def stem(self) -> str:
        """Name of the files: the mechanism's, as far as C and ``#include`` can bear it."""
        stem = re.sub(r"[^A-Za-z0-9_]+", "_", c_name(self.mechanism.name))
        stem = f"rig_{stem}" if stem[:1].isdigit() else stem
        return f"{stem}_rig" if stem in HEADERS else stem[:60] or "rig"

    @cached_property
    def plan(self) -> Plan:
        """The plan that is built in."""
        return Plan.of(self.surface)

    @cached_property
    def slew_rates(self) -> FloatArray:
        """Largest rate of each input, its unit per second, (m,); infinite where there is none."""
        m = self.mechanism.m
        slew = np.inf if self.slew is None else self.slew
        return one_for_each("slew rate", slew, m, infinite=True)

    @property
    def most_rows(self) -> int:
        """Most surfaces in a plan."""
        return self.rows or len(self.plan.surfaces)

    def __post_init__(self) -> None:
        """Refuse what cannot run: see the class."""
        check_fields(
            self, "mechanism", "surface", "period", "slew", "missed", "rows", "real", "prefix"
        )
        require(
            hasattr(self.differentiator, "gains"),
            "differentiator",
            repr(self.differentiator),
            "undertow.export.DerivativeStep(), SuperTwistingStep() or KalmanStep()",
        )
        limits = self.mechanism.input_limits
        built_in = len(self.plan.surfaces)
        named = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,15}", self.prefix)
        rows, plan_to_most = self.most_rows, f"{built_in} (those of the plan) to 64"
        require(0 < self.period < 1, "period of the exported loop", self.period, "> 0, < 1 s")
        require(0 <= self.missed < 2**15 - 1, "missed periods", self.missed, "0 to 32766")
        one_of("real", self.real, ("double", "float"))
        require(named, "prefix", repr(self.prefix), "a C name of at most 16 letters")
        require(built_in <= rows <= 64, "rows of the surface table", rows, plan_to_most)
        positive(
            f"input limits of '{self.mechanism.name}'",
            limits,
            "Name what the actuators can deliver: mechanism.with_input_limit, "
            f"--limit {self.mechanism.inputs[0].name}=10",
        )
        if self.reaching is None:
            law = usual_reaching(self.mechanism, self.plan.surfaces[0], period=self.period)
            object.__setattr__(self, "reaching", law)
        for law in self.laws:
            check_surface(self.mechanism, law.surface)
            layer = law.reaching.vector(self.mechanism.m)[self.mechanism.m :]
            gains = law(0.0, np.zeros(2 * self.mechanism.n)).gains
            fast = self.period * gains >= 2 * layer
            if law.reaching.has_layer and fast.any():
                raise InvalidInputError(
                    "period of the exported loop",
                    value=f"{self.period:g} s",
                    limit=f"below 2 ε/k = {np.min(2 * layer / gains):g} s",
                    remedy="Use a shorter period, a thicker boundary layer or smaller gains",
                )
        self.starts(self.plan)
        self.slew_rates  # noqa: B018  # refuses what cannot be used
        if isinstance(self.differentiator, KalmanStep):
            self.differentiator.noises(self.mechanism.n)
        else:
            self.differentiator.gains(self.mechanism.n)

    @cached_property
    def laws(self) -> tuple[SlidingModeLaw, ...]:
        """The laws of the plan, one for each surface."""
        return self.laws_of(self.plan)

    def laws_of(self, plan: Plan) -> tuple[SlidingModeLaw, ...]:
        """Return the laws of a plan, one for each surface."""
        pairs = zip(plan.surfaces, plan.laws(self.reaching), strict=True)
        return tuple(SlidingModeLaw(self.mechanism, surface, law) for surface, law in pairs)

    def starts(self, plan: Plan) -> list[int]:
        """Return the periods, from the start of a plan, at which its surfaces take over."""
        starts = [round(t / self.period) for t in plan.times]
        if len(starts) > self.most_rows or any(np.diff(starts) < 1) or starts[-1] >= 2**32:
            raise InvalidInputError(
                "times of an exported plan",
                value=list(plan.times),
                limit=f"at most {self.most_rows}, a period of {self.period:g} s apart or more, "
                "below 2^32 periods",
                remedy="Leave out the surfaces that never act, or ask for more rows",
            )
        return starts

    def limit(self, value: float) -> str:
        """Return a C literal that is nowhere above a positive value."""
        if self.real == "float":
            single = np.float32(value)
            if float(single) > value:
                single = np.nextafter(single, np.float32(0))
            value = float(single)
        return literal(value, self.real)


#: Bits of a word, and the odd factor of each step, by precision.
WIDTH = {"double": 64, "float": 32}
FACTOR = {"double": 0x9E3779B97F4A7C15, "float": 0x9E3779B1}


def as_held(value: float, real: Real) -> float:
    """Return a number as the C holds it."""
    return float(np.float32(literal(value, real).rstrip("f")) if real == "float" else value)


def checksums(
    number: int, starts: Sequence[int], rows: Sequence[tuple[ArrayLike, ...]], real: Real
) -> list[int]:
    """Return the checksum of each row.

    ``starts``: periods at which the rows take over, ascending from 0; ``rows``: numbers of each, as
    ``as_held`` gives them: surface (2mn,), η (m,) and ε (m,).
    """
    width = WIDTH[real]
    mask = (1 << width) - 1
    kind, unsigned = (np.float32, np.uint32) if real == "float" else (np.float64, np.uint64)

    def folded(value: int) -> int:
        return (value ^ value >> 32) & mask

    words = []
    for k, ((start, following), (surface, eta, layer)) in enumerate(
        zip(pairwise([*starts, 0]), rows, strict=True)
    ):
        gains = np.stack([np.asarray(eta), np.asarray(layer)], axis=1)
        values = np.concatenate([np.asarray(surface), gains.ravel()]).astype(kind)
        total = folded(number)
        for word in (
            len(rows),
            k,
            folded(start),
            folded(following),
            *values.view(unsigned).tolist(),
        ):
            turned = (total << 5 | total >> width - 5) & mask
            total = (turned ^ word) * FACTOR[real] & mask
        words.append(total)
    return words


def plan_numbers(
    controller: EmbeddedController, plan: Plan
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return what the C holds of each row of a plan: surface (2mn,), η (m,) and ε (m,)."""
    m = controller.mechanism.m
    layout = LawLayout(controller.mechanism.n, m)
    rows = []
    for surface, law in zip(plan.surfaces, plan.laws(controller.reaching), strict=True):
        values = np.concatenate([surface.vector, law.vector(m)])
        held = np.array([as_held(v, controller.real) for v in values.tolist()])
        rows.append((held[layout.surface], held[layout.eta], held[layout.layer]))
    return rows


def plan_text(controller: EmbeddedController, plan: Plan, number: int) -> dict[str, str]:
    """Return the C initialisers of a plan: count, starts and rows with their checksums."""
    whole = controller if plan is controller.plan else replace(controller, surface=plan)
    starts, numbers = whole.starts(plan), plan_numbers(whole, plan)
    checks = checksums(number, starts, numbers, controller.real)
    rows = []
    for law, row, check in zip(whole.laws, numbers, checks, strict=True):
        parts = [f"{{{_listed(v, controller.real)}}}" for v in row]
        gamma = literal(law.gamma_target, controller.real)
        rows.append(f"        {{{', '.join([*parts, gamma, f'{check:#x}u'])}}},")
    return {
        "count": str(len(rows)),
        "starts": ", ".join(f"{k}UL" for k in starts),
        "rows": "\n".join(rows),
    }


def _listed(values: Iterable[float], real: Real) -> str:
    return ", ".join(literal(v, real) for v in values)
