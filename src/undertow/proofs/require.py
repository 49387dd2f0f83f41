"""What proofs ask of what they are given."""

from __future__ import annotations

from undertow.base.arguments import require
from undertow.models.mechanism import TIME, Mechanism


def require_autonomous(mechanism: Mechanism, proved: str) -> None:
    """Refuse a force that depends on time."""
    remedy = f"Prove the {proved} for the undisturbed mechanism"
    good = TIME not in mechanism.force.free_symbols
    require(good, f"force of '{mechanism.name}'", "depends on time", "autonomous", remedy)
