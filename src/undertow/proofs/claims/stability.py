"""Stability on the surface, decided exactly for any n and m.

A guess of the rate comes from eigenvalues in doubles; the kernel decides it, by a Routh array in
exact rational arithmetic (every float parameter is the binary number that it is).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from undertow.base.verdict import Verdict, inward
from undertow.law import ReachingLaw, Surface, check_surface_shape
from undertow.law.stability import sliding_matrix
from undertow.models.mechanism import TIME, Mechanism
from undertow.proofs.claims.claim import Claim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.words import sentence
from undertow.proofs.exact_model import exact_mechanism
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.graph import Span
from undertow.proofs.kernel.model import Model, System


def exact_linearisation(mechanism: Mechanism) -> list[list[Span]]:
    """Return [M | F | D] at the target, n rows of 3n numbers.

    ``M q̈ = F q + D q̇`` near x = 0; entries are exact where the model is rational at the target
    with its float parameters taken as the binary numbers that they are. Raises ModelError for a
    model that is not smooth.
    """
    n, m = mechanism.n, mechanism.m
    blocks = [np.eye(m), np.eye(m), np.zeros((m, n - m)), np.zeros((m, n - m))]
    own = System(model_of(mechanism), law_of(mechanism, Surface(*blocks), ReachingLaw()))
    graph, one = own.graph, own.graph.number(1)
    slopes = [graph.tangents(own.f, {x: one}) for x in graph.inputs[: 2 * n]]
    return [graph.exact([*own.M[i], *(d[i] for d in slopes)], own.origin()) for i in range(n)]


def _slowest_mode(mechanism: Mechanism, surface: Surface) -> tuple[complex, dict[str, float]]:
    """The eigenvalue with the largest real part, in float64, and its mode.

    The mode: state names of z = (q_a, q_u, q̇_u) to the magnitude of the eigenvector's entry.
    """
    eigenvalues, vectors = np.linalg.eig(sliding_matrix(mechanism, surface))
    worst = int(np.argmax(eigenvalues.real))
    names = (
        mechanism.state_names[: mechanism.n] + mechanism.state_names[mechanism.n + mechanism.m :]
    )
    shape = np.abs(vectors[:, worst]) / np.abs(vectors[:, worst]).max()
    return complex(eigenvalues[worst]), dict(zip(names, shape.tolist(), strict=True))


def hurwitz(mechanism: Mechanism, surface: Surface) -> Verdict:
    """Decide local exponential stability on the surface, exactly, for any n and m.

    Returns
    -------
    Verdict
        ``proved`` with a proved decay rate (every eigenvalue left of −margin, 1/s),
        ``refuted`` with the offending eigenvalue as witness, or ``undecided`` (where the
        target is not shown to be an equilibrium, or the model is not rational there and balls
        cannot tell).

    Raises
    ------
    InvalidInputError
        When the surface has another n or m than the mechanism.
    ModelError
        For a model that is not smooth.
    """
    check_surface_shape(mechanism, surface)
    claim = "motions on the surface near the target converge to it exponentially"
    if TIME in exact_mechanism(mechanism).force.free_symbols:
        return Verdict(claim, "undecided", unit="1/s", method="the force depends on time")
    model, law = model_of(mechanism), law_of(mechanism, surface, ReachingLaw())
    stable = kernel.decide(model, law, kernel.Stability(Fraction(0)))
    if stable.kind == "undecided":
        return Verdict(claim, "undecided", unit="1/s", method=stable.why)
    if "no sliding dynamics" in stable.why:
        return Verdict(claim, "refuted", -math.inf, "1/s", method=stable.why)
    eigenvalue, shape = _slowest_mode(exact_mechanism(mechanism), surface)
    estimate = -eigenvalue.real
    witness = {"Re eigenvalue": eigenvalue.real, "Im eigenvalue": eigenvalue.imag}
    details = {"critical mode": shape}
    if stable.kind == "refuted":
        return Verdict(claim, "refuted", min(estimate, 0.0), "1/s", witness, stable.why, details)
    margin, proved = 0.0, stable
    # Rounding moves an eigenvalue of multiplicity k by the k-th root of 1e-16.
    for slack in (1e-12, 1e-9, 1e-6, 1e-4, 1e-2, 0.1, 0.5):
        rate = estimate * (1 - slack)
        found = kernel.decide(model, law, kernel.Stability(Fraction(max(rate, 0.0))))
        if found.kind == "proved":
            margin, proved = max(rate, 0.0), found
            break
    return Verdict(claim, "proved", margin, "1/s", witness, proved.why, details)


@dataclass(frozen=True)
class StabilityClaim(Claim):
    """Motions on the surface near the target converge to it exponentially."""

    def decide(self, mechanism: Mechanism, surface: Surface, law: ReachingLaw) -> Verdict:
        """Decide it as :func:`hurwitz` does."""
        return hurwitz(mechanism, surface)

    def stated(self, mechanism: Mechanism, verdict: Verdict) -> kernel.Claim:
        """Return it with the rate that was proved."""
        return kernel.Stability(Fraction(max(verdict.margin, 0.0)))


@sentence.register
def _(claim: kernel.Stability, model: Model) -> str:
    return (
        "motions on the surface near the target converge to it exponentially, at a rate of at "
        f"least {inward(claim.rate, 6)} 1/s, the plant the model and no other force; how near is "
        "not said, and the input is not limited"
    )
