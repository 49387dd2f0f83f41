"""The law as one compiled step: what the fast loop calls once a sample.

The same formulas as :class:`undertow.SlidingModeLaw`, printed as scalar code: about a
microsecond, no allocation, no lock of the interpreter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from undertow.base import checked_names
from undertow.law.schedule import Plan
from undertow.law.sliding import LawSymbols, SlidingModeLaw, build_law_graph
from undertow.law.surface import ReachingLaw, Surface, Switching
from undertow.models import FloatArray, Mechanism, linearise
from undertow.symbolic import BRIEF, Tape, Workspace, function_source, scalar_module, unpacked


@checked_names
@dataclass(eq=False)
class InnerLoop:
    """The sliding-mode law of a mechanism, compiled, with a surface that can be exchanged.

    Parameters
    ----------
    mechanism
        The controller's belief.
    surface
        Where to slide.
    reaching
        How to get there.

    Attributes
    ----------
    u, demand, s
        What the last step gave, (m,): clipped, not clipped, values of the surface.  The
        arrays are written over by the next step.
    parameters
        Values of the mechanism's parameters that the steps believe in, (P,), SI units: who learns
        them writes them here, or calls :meth:`believe`.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> law = InnerLoop(rig, ut.Surface(-1, -0.5, 5, 10))
    >>> round(float(law(rig.state(phi=0.5))[0]), 3)
    -2.799
    """

    mechanism: Mechanism
    surface: Surface
    reaching: ReachingLaw = ReachingLaw()

    def __post_init__(self) -> None:
        """Set out the arrays that every step fills."""
        mechanism = self.mechanism
        memory = Workspace(LAYOUT, p=len(mechanism.parameters), m=mechanism.m)
        memory["parameters"][:] = mechanism.parameter_values
        memory["limits"][:] = mechanism.input_limits
        self.u, self.demand, self.s = memory["u"], memory["demand"], memory["s"]
        self.margin, self._block = memory["margin"], memory.block
        self.parameters: FloatArray = memory["parameters"]
        self.use(self.surface, self.reaching)

    @cached_property
    def _step(self) -> Callable[..., None]:
        return law_module(self.mechanism, self.reaching.switching).step  # type: ignore[no-any-return]

    def use(self, surface: Surface, reaching: ReachingLaw | None = None) -> None:
        """Exchange the surface, and the reaching law where one is given; checked first.

        Raises
        ------
        InvalidInputError
            When shapes do not fit.
        SingularSurfaceError
            When Γ is singular at the target.
        """
        law = SlidingModeLaw(self.mechanism, surface, reaching or self.reaching)
        self.lane = pack_law_parameters(law)
        if law.reaching.switching != self.reaching.switching:
            vars(self).pop("_step", None)  # compiled for one switching function
        self.surface, self.reaching = surface, law.reaching

    def follow(self, plan: Plan, elapsed: float, otherwise: ReachingLaw) -> None:
        """Go on with the surface of a plan that is in force so long after its start, s.

        ``otherwise`` is the reaching law of a surface for which the plan has none.
        """
        surface, reaching = plan.at(elapsed)
        reaching = reaching or otherwise
        if (surface, reaching) != (self.surface, self.reaching):
            self.use(surface, reaching)

    def believe(self, parameters: FloatArray, x: FloatArray, least: float = 0.0) -> bool:
        """Go on with other values of the parameters, (P,), if the surface bears them at x, (2n,).

        Where det Γ(q) would change its sign with them, so would the input: a surface that was
        chosen with what was known before, close to where it is singular, is kept with that until
        another one is chosen.  ``least`` is the det Γ(q)/det Γ(0) that has to be left.  Whether
        they were taken over.
        """
        before = self.parameters.copy()
        self.parameters[:] = parameters
        self._step(x, self.lane, self._block)
        if self.margin[0] > least:
            return True
        after, self.parameters[:] = self.parameters.copy(), before
        self._step(x, self.lane, self._block)
        if self.margin[0] > least:
            return False
        self.parameters[:] = after  # it is singular here in any case
        return True

    def feedback(self) -> FloatArray:
        """Return k, (m, 2n), with u = k x near the target, inside the boundary layer."""
        columns = []
        for x in 1e-6 * np.eye(2 * self.mechanism.n):
            self(x)
            ahead = self.demand.copy()
            self(-x)
            columns.append((ahead - self.demand) / 2e-6)
        return np.column_stack(columns)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the input at the state x, (2n,): never NaN, never past the limits, (m,)."""
        self._step(x, self.lane, self._block)
        return self.u  # type: ignore[no-any-return]


@lru_cache(maxsize=8)
def feedback_at_target(
    mechanism: Mechanism, surface: Surface, reaching: ReachingLaw | None = None
) -> FloatArray:
    """Return k, (m, 2n), with u = k x near the target; the paper's gains by default.

    It is kept, and read-only.
    """
    k = InnerLoop(mechanism, surface, reaching or ReachingLaw()).feedback()
    k.flags.writeable = False
    return k


def matrix_at_target(
    mechanism: Mechanism, surface: Surface, reaching: ReachingLaw | None = None
) -> FloatArray:
    """Return A of the closed loop ẋ = Ax near the target, (2n, 2n); the paper's gains by default.

    Raises
    ------
    ModelError
        As for :func:`undertow.models.linearise`.
    """
    plant = linearise(mechanism)
    return plant.A + plant.input @ feedback_at_target(mechanism, surface, reaching)


def pack_law_parameters(law: SlidingModeLaw) -> FloatArray:
    """Return the numbers of a law in the order of the kernels: surface, η, ε, det Γ(0)."""
    reaching = law.reaching.vector(law.mechanism.m)
    return np.concatenate([law.surface.vector, reaching, [law.gamma_target]])


#: What a step of the law reads besides the state and its surface, and what it fills.
LAYOUT = {
    "parameters": "p", "limits": "m", "u": "m", "demand": "m", "s": "m", "margin": "1",
}  # fmt: skip

#: A demand that is not a number becomes no input at all; the rest is clipped.
_CLIP = f"""
{BRIEF}
def step(x, lane, block):
{unpacked(LAYOUT)}
    law(x, lane, parameters, demand, s, margin)
    for i in range(u.shape[0]):
        if not (abs(demand[i]) < math.inf):
            demand[i] = 0.0
        u[i] = max(-limits[i], min(limits[i], demand[i]))
"""


@lru_cache(maxsize=64)
def law_module(mechanism: Mechanism, switching: Switching, *, implicit: bool = False) -> Any:
    """Return the compiled module of a law: ``law``, and ``step`` on a :data:`LAYOUT`.

    ``implicit``: as for :func:`undertow.law.build_law_graph`.
    """

    def functions() -> tuple[str, str]:
        tape, symbols = Tape(), LawSymbols.of(mechanism.n, mechanism.m)
        law = build_law_graph(
            mechanism.partition(tape), mechanism.x, symbols, switching,
            mechanism.disturbance_bounds, implicit=implicit,
        )  # fmt: skip
        body = function_source(
            "law",
            tape,
            {"x": mechanism.x, "lane": symbols.vector, "parameters": mechanism.parameter_symbols},
            {"demand": law.u, "s": law.s, "margin": [law.margin]},
        )
        return body, _CLIP

    sizes = f"p, m = {len(mechanism.parameters)}, {mechanism.m}\n"
    depends = mechanism.structure, switching, repr(implicit)
    return scalar_module("law", "Sliding-mode law", mechanism.name, depends, functions, sizes)
