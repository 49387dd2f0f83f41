"""The admission gate with verdicts: a new surface needs evidence for the present state.

A :class:`GatePolicy` says which kinds of evidence the user accepts, the strongest first:

``region``
    The state is inside a proved region of attraction of the closed loop with the new surface
    (a terminal set found on the spot, or a set that was proved before).  *Proved.*
``dual``
    Dual mode: the predicted motion keeps the margins of the policy and enters a proved terminal
    set.  The set is proved; the motion is one float64 trajectory and no validated tube, so the
    verdict is *sampled*, and says so.
``sampled``
    Random states around the present one are all brought home; *sampled*, with a confidence.
``local``
    The closed loop is exponentially stable near the target, and the predicted motion arrives:
    what :func:`undertow.cascade.cost_gate` asks for.  Of the state nothing is proved; the verdict
    is *sampled*: one float64 trajectory and float64 eigenvalues.

The gate is a pure function, as the cascade needs it; the cascade knows nothing of this module.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np

from undertow.base.arguments import at_least, checked_names, require
from undertow.base.verdict import Verdict
from undertow.closed_loop.gate import Admission, Gate, cost_gate
from undertow.closed_loop.rollout import ClosedLoop
from undertow.closed_loop.trajectory import Batch, Event
from undertow.law import Plan, ProvedSet, ReachingLaw, Surface, stability_margin
from undertow.models.mechanism import FloatArray
from undertow.proofs.search.terminal_ellipsoid import EllipsoidSearch, search_for

Evidence = Literal["region", "dual", "sampled", "local"]
#: When a prediction is first looked at, s; then after half the time again, and so on.
FIRST_LOOK = 1.0

_KINDS: tuple[Evidence, ...] = ("region", "dual", "sampled", "local")


@checked_names
@dataclass(frozen=True)
class GatePolicy:
    """Which evidence is accepted for a new surface at the present state, with what margins.

    Parameters
    ----------
    accept
        Kinds of evidence that will do.
    singular_margin
        Smallest det Γ(q)/det Γ(0) that the predicted motion may meet, in [0, 1).
    constraint_margin
        Smallest value of the objective's path constraints along it, in their units, ≥ 0.
    input_margin
        Smallest u_max − |demand| along it, in the input's unit, ≥ 0; where the objective has a
        hard input limit.  A soft one is clipped in the prediction as it is in the plant.
    samples, spread
        For ``sampled``: how many states, drawn uniformly from the box x ± spread, SI units.

    Examples
    --------
    >>> GatePolicy(accept=("region", "dual")).singular_margin
    0.05
    """

    accept: tuple[Evidence, ...] = ("region", "dual")
    singular_margin: float = 0.05
    constraint_margin: float = 0.0
    input_margin: float = 0.0
    samples: int = 64
    spread: float = 0.01

    def __post_init__(self) -> None:
        """Refuse an empty or unknown choice and margins that mean nothing."""
        good = all(kind in _KINDS for kind in self.accept)
        limit = f"one or more of {', '.join(_KINDS)}"
        require(self.accept and good, "evidence that a policy accepts", self.accept, limit)
        highest = {"singular_margin": 1.0} | dict.fromkeys(
            ("constraint_margin", "input_margin", "spread"), math.inf
        )
        for name, high in highest.items():
            value = getattr(self, name)
            require(0 <= value < high, f"{name} of a policy", value, f"in [0, {high:g})")
        at_least("samples of a policy", self.samples, 1)


@dataclass(frozen=True, eq=False)
class _Case:
    """One plan from one state."""

    loop: ClosedLoop
    plan: Plan
    x: FloatArray
    horizon: float
    policy: GatePolicy
    sets: Sequence[ProvedSet]

    @property
    def surface(self) -> Surface:
        """The surface that the plan ends on."""
        return self.plan.surfaces[-1]

    @property
    def law(self) -> ReachingLaw:
        """Its reaching law."""
        return self.plan.laws(self.loop.reaching)[-1]

    @property
    def why_not(self) -> str:
        """Why no terminal set is proved for this kind of loop, or nothing."""
        if self.loop.zoh_steps:
            return "terminal sets are proved for the continuous law, and this loop is sampled"
        if not self.law.has_layer:
            return "terminal sets need a boundary layer, and this law switches with sign(s)"
        return ""

    @cached_property
    def search(self) -> EllipsoidSearch | None:
        """The search for terminal sets of the last surface."""
        if self.why_not:
            return None
        return search_for(self.loop.mechanism, self.surface, self.law)

    @cached_property
    def known(self) -> list[ProvedSet]:
        """Sets that were proved before for the last surface, and not of another mechanism."""
        if self.loop.zoh_steps:
            return []
        own = ("", self.loop.mechanism.fingerprint)
        return [
            s
            for s in self.sets
            if s.surface == self.surface and self._is_law(s.reaching) and s.model in own
        ]

    def _is_law(self, other: ReachingLaw) -> bool:
        """Whether another law is this one, its numbers for all surfaces or one by one."""
        m, law = self.surface.m, self.law
        alike = np.array_equal(other.vector(m), law.vector(m))
        return other.switching == law.switching and alike

    def proved_at(self, x: FloatArray) -> tuple[float, str] | None:
        """Whether a state is in a set that is proved, or can be on the spot; margin, method."""
        if any(known.contains(x) for known in self.known):
            return math.nan, "a region of attraction proved before"
        found = None if self.search is None else self.search.around(x)
        if found is None or not found.contains(x):
            return None
        return found.ball, "a terminal ellipsoid of the full closed loop, interval arithmetic"


def assess(
    loop: ClosedLoop,
    plan: Plan,
    x: FloatArray,
    horizon: float,
    policy: GatePolicy = GatePolicy(),
    sets: Iterable[ProvedSet] = (),
) -> Verdict:
    """Return the strongest accepted evidence that a plan brings the state x to the target.

    Parameters
    ----------
    loop
        The predicted closed loop, belief as plant.
    plan
        What would be applied from now on.
    x
        Present state, (2n,).
    horizon
        Longest prediction, s.
    policy
        What is accepted.
    sets
        Proved regions from before (for instance from certificates).

    Returns
    -------
    Verdict
        ``details["evidence"]`` is its kind, ``None`` where nothing that is accepted holds; the
        verdict is then ``undecided`` and its method names what failed.
    """
    case = _Case(loop, plan, np.asarray(x, dtype=float), horizon, policy, tuple(sets))
    tests = {"region": _region, "dual": _dual, "sampled": _sampled, "local": _local}
    failures = []
    for kind in _KINDS:
        if kind in policy.accept:
            answer = tests[kind](case)
            if isinstance(answer, Verdict):
                return replace(answer, details={"evidence": kind, **answer.details})
            failures.append(f"{kind}: {answer}")
    claim = "the present state is brought to the target"
    return Verdict(claim, "undecided", method="; ".join(failures), details={"evidence": None})


def _event(batch: Batch, k: int = 0) -> str:
    return Event(int(batch.event[k])).name.lower()


def _region(case: _Case) -> Verdict | str:
    if len(case.plan.surfaces) > 1:
        return "the plan changes surfaces later on"
    proof = case.proved_at(case.x)
    if proof is None:
        return case.why_not or "no proved set holds the state"
    return Verdict(
        "every motion from the present state stays in a proved set and converges",
        "proved",
        proof[0],
        "radius of the largest ball inside",
        method=proof[1],
    )


def _dual(case: _Case) -> Verdict | str:
    if not case.known and (case.search is None or not case.search.succeeds):
        return case.why_not or "the linear closed loop has no proved terminal set"
    x, t, span = case.x, 0.0, FIRST_LOOK
    margins = _Margins(case.policy)
    while t < case.horizon:
        span = max(1, math.floor(min(span, case.horizon - t) / case.loop.step + 1e-6))
        span *= case.loop.step
        batch = case.loop.batch(x, case.plan.shifted(t), duration=span, terminal=0.0)
        t += span
        if broken := margins.broken(case.loop, batch.singular, batch.path, batch.input):
            return f"{broken} within {t:.3g} s"
        if batch.event[0] != Event.HORIZON:
            return f"the predicted motion ends: {_event(batch)}"
        x = batch.x[0]
        one = len(case.plan.shifted(t).surfaces) == 1
        proof = case.proved_at(x) if one else None
        if proof is not None:
            return Verdict(
                f"the predicted motion is in a proved terminal set after {t:.3g} s",
                "sampled",
                margins.singular,
                "det Γ/det Γ(0)",
                method=f"one float64 trajectory, not validated, to {proof[1]}",
                details={"arrival": t, "ball": proof[0]},
            )
        span = 0.5 * t
    return f"the predicted motion is in no proved set after {case.horizon:.3g} s"


class _Margins:
    """Smallest margins along a prediction, against the policy's."""

    def __init__(self, policy: GatePolicy) -> None:
        self.policy = policy
        self.singular = math.inf

    def broken(
        self, loop: ClosedLoop, singular: FloatArray, path: FloatArray, inputs: FloatArray
    ) -> str:
        policy = self.policy
        self.singular = min(self.singular, float(singular.min()))
        if not self.singular >= policy.singular_margin:
            return f"singularity margin {self.singular:.3g} < {policy.singular_margin:g}"
        for constraint, value in zip(loop.objective.constraints, path.min(axis=0), strict=True):
            if not value >= policy.constraint_margin:
                return f"'{constraint.name}' margin {value:.3g} < {policy.constraint_margin:g}"
        if loop.objective.hard_input and not inputs.min() >= policy.input_margin:
            return f"input margin {inputs.min():.3g} < {policy.input_margin:g}"
        return ""


def _sampled(case: _Case) -> Verdict | str:
    policy = case.policy
    rng = np.random.default_rng(0)
    around = case.x + rng.uniform(-policy.spread, policy.spread, (policy.samples, len(case.x)))
    batch = case.loop.batch(around, case.plan, duration=case.horizon)
    if not batch.reached.all():
        bad = int(np.argmin(batch.reached))
        count = int((~batch.reached).sum())
        return f"{count} of {policy.samples} nearby states fail ({_event(batch, bad)})"
    margins = _Margins(policy)
    if broken := margins.broken(case.loop, batch.singular, batch.path, batch.input):
        return broken
    # Clopper-Pearson for no failure: P(all succeed) ≤ 5 % unless the part is above this.
    part = 0.05 ** (1.0 / policy.samples)
    return Verdict(
        f"with 95 % confidence over {100 * part:.1f} % of the states within "
        f"{policy.spread:g} of the present one reach the target",
        "sampled",
        margins.singular,
        "det Γ/det Γ(0)",
        method=f"{policy.samples} float64 rollouts, uniform",
        details={"samples": policy.samples, "confidence": 0.95, "part": part},
    )


def _local(case: _Case) -> Verdict | str:
    margin = float(stability_margin(case.loop.mechanism, case.surface))
    if not margin > 0:
        return f"unstable, margin {margin:.3g} 1/s"
    batch = case.loop.batch(case.x, case.plan, duration=case.horizon)
    if not batch.reached.all():
        return f"the predicted motion ends: {_event(batch)}"
    margins = _Margins(case.policy)
    if broken := margins.broken(case.loop, batch.singular, batch.path, batch.input):
        return broken
    return Verdict(
        "the predicted motion reaches the target, where the closed loop is stable",
        "sampled",
        margin,
        "1/s",
        method="one float64 trajectory and float64 eigenvalues, neither validated; nothing is "
        "proved of the present state",
    )


@lru_cache(maxsize=8)
def _with_tail(loop: ClosedLoop, tail: float) -> ClosedLoop:
    return replace(loop, tail_rtol=tail)


@dataclass(frozen=True)
class CertifiedGate:
    """The gate that :func:`certified_gate` returns; a plain record, so it can be pickled."""

    policy: GatePolicy
    sets: tuple[ProvedSet, ...]
    base: Gate
    tail: float

    def __call__(
        self, loop: ClosedLoop, old: Plan, new: Plan, x: FloatArray, horizon: float
    ) -> Admission:
        """Decide on a plan, as :func:`undertow.cascade.cost_gate` does."""
        judged = _with_tail(loop, self.tail) if self.tail else loop

        def verdict(plan: Plan) -> Verdict:
            return assess(loop, plan, x, horizon, self.policy, self.sets)

        first = self.base(judged, old, new, x, horizon)
        if not first.accepted:
            return replace(first, verdict=verdict(old))
        answer = verdict(new)
        if answer.details["evidence"] is not None:
            reason = f"{first.reason}; {answer.details['evidence']}: {answer.claim}"
            return Admission(True, reason, first.cost, answer)
        cost = self.base(judged, old, old, x, horizon).cost
        reason = f"no accepted evidence from here ({answer.method})"
        return Admission(False, reason, cost, verdict(old))


def certified_gate(
    policy: GatePolicy = GatePolicy(),
    *,
    sets: Iterable[ProvedSet] = (),
    base: Gate = cost_gate,
    tail: float = 0.0,
) -> CertifiedGate:
    """Return a gate that admits a plan only with accepted evidence for the present state.

    Parameters
    ----------
    policy
        Which evidence is accepted.
    sets
        Regions that were proved before.
    base
        The gate that comes first: stable, feasible, cost not raised (Lemma 3).
    tail
        Relative tolerance of the large steps in which the base gate's predictions end (see
        :mod:`undertow.closed_loop.exponential_integrator`); 0: small steps to the terminal set.

    Returns
    -------
    CertifiedGate
        For ``Cascade(gate=…)``.  The admission's verdict is that of the plan which stays in use.

    Examples
    --------
    >>> import undertow as ut
    >>> from undertow.proofs import GatePolicy, certified_gate
    >>> rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    >>> cascade = ut.Cascade(rig, ut.MinimumTime(), gate=certified_gate(GatePolicy(("dual",))))
    """
    return CertifiedGate(policy, tuple(sets), base, tail)
