"""The claim that the whole closed loop converges from a box of starts; the kernel decides it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Self, cast

import numpy as np

from undertow.base.errors import InvalidInputError
from undertow.base.verdict import Verdict, exactly, inward, within
from undertow.law import ProvedSet, ReachingLaw, Surface
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.claim import Claim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.words import limits_words, region_words, sentence, verdict_on
from undertow.proofs.claims.written import claim_data
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.model import Model, Quantity


@dataclass(frozen=True, eq=False)
class LoopClaim(Claim):
    """Every motion from a box of starts converges, with the boundary layer and the input clip.

    ``data``: its numbers as ``docs/certificate-format.md``, section 5.6, has them.
    """

    data: Mapping[str, Any]

    @classmethod
    def of(cls, claim: kernel.Claim) -> Self:
        """Return the claim that a certificate states."""
        return cls(claim_data(claim))

    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
        """Let the kernel decide it; the margin is the largest start of the first state that varies.

        Raises
        ------
        Refused
            For numbers that do not fit the mechanism.
        """
        model = model_of(mechanism)
        own = self._own(model)
        answer = kernel.decide(model, law_of(mechanism, surface, law), own)
        varied = [x for x in model.states if x in own.starts]
        if answer.kind != "proved" or not varied:
            return verdict_on(own, model, answer)
        margin = float(min(abs(v) for v in own.starts[varied[0]]))
        unit = mechanism.coordinates[model.states.index(varied[0]) % mechanism.n].unit
        return verdict_on(own, model, answer, margin, unit)

    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim:
        """Return the kernel's claim."""
        return self._own(model_of(mechanism))

    def _own(self, model: Model) -> kernel.ClosedLoop:
        claim = kernel.read_claim({"kind": kernel.ClosedLoop.kind, **self.data}, model)
        return cast(kernel.ClosedLoop, claim)

    def box(self, mechanism: Mechanism) -> FloatArray:
        """Return the starts, (2n, 2), rounded inwards to 1e-15 of their size, SI units."""
        model = model_of(mechanism)
        starts = self._own(model).starts
        ends = np.array([[float(v) for v in starts.get(x, (0, 0))] for x in model.states])
        return np.asarray(ends * (1 - 1e-15))

    @property
    def period(self) -> float:
        """How long the input is held, s; 0: it is renewed at every instant."""
        return float(Fraction(self.data["period"]))

    def terminal(self, mechanism: Mechanism, surface: Surface) -> tuple[FloatArray, float]:
        """Return W, (2n, 2n), and ρ of the set |W x| ≤ ρ in which its motions end.

        With a held input the set is one of (q, p, s), which is linear in x near the target only:
        then W is of that.

        Raises
        ------
        InvalidInputError
            For a claim that names none.
        """
        end = self._own(model_of(mechanism)).terminal
        if end is None:
            raise InvalidInputError("claim of a closed loop", value="no terminal set in its hint")
        W, n, m = np.array(end.W, dtype=float), mechanism.n, mechanism.m
        if self.period:
            momenta = np.hstack([np.zeros((n - m, n)), mechanism.M(np.zeros(n))[m:]])
            W = W @ np.vstack([np.eye(n, 2 * n), momenta, surface.matrix])
        return W, float(end.radius)

    def proved_set(
        self, mechanism: Mechanism, surface: Surface, law: ReachingLaw
    ) -> ProvedSet | None:
        """Return its starts; a held input, another plant or a force is not the gate's loop."""
        own = self._own(model_of(mechanism))
        if own.period or own.plant or any(own.disturbance):
            return None
        return ProvedSet(surface, law, Starts(self.box(mechanism)), mechanism.fingerprint)


@dataclass(frozen=True)
class Starts:
    """Starts of a closed loop, a box of states (2n, 2), SI units."""

    box: FloatArray

    def contains(self, x: FloatArray) -> bool:
        """Whether the state is one of them."""
        state = np.asarray(x, dtype=float)
        return bool(((self.box[:, 0] <= state) & (state <= self.box[:, 1])).all())


@sentence.register
def _(claim: kernel.ClosedLoop, model: Model) -> str:
    rates = [Quantity(f"{p.name}_dot", f"{p.unit}/s") for p in model.positions]
    starts = region_words([*model.positions, *rates], claim.starts).replace("for ", "with ", 1)
    end = f"‖x‖ ≤ {inward(claim.ball, 6)}" if claim.ball else "the target"
    held = f"held for {exactly(claim.period)} s" if claim.period else "renewed at every instant"
    varied = ", ".join(f"{k} in {within(*ends)}" for k, ends in claim.plant.items())
    plant = f"any with {varied}" if varied else "the model"
    loads = ", ".join(inward(v, 6) for v in claim.disturbance)
    return (
        f"every motion from starts {starts}, exists for ever and converges to {end}, the law with "
        f"its layer, its input clipped to {limits_words(model)} and {held}, the plant {plant}, "
        f"{f'forces up to {loads}' if any(claim.disturbance) else 'no other force'}"
    )
