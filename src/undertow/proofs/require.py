"""What proofs ask of what they are given."""

from __future__ import annotations

from undertow.base.errors import InvalidInputError
from undertow.models.mechanism import TIME, Mechanism


def require(
    good: object, what: str, value: object = None, limit: object = None, remedy: str = ""
) -> None:
    """Refuse what is not as it has to be.

    Raises
    ------
    InvalidInputError
        With the value, the limit and the remedy.
    """
    if not good:
        raise InvalidInputError(what, value=value, limit=limit, remedy=remedy)


def require_autonomous(mechanism: Mechanism, proved: str) -> None:
    """Refuse a force that depends on time."""
    remedy = f"Prove the {proved} for the undisturbed mechanism"
    good = TIME not in mechanism.force.free_symbols
    require(good, f"force of '{mechanism.name}'", "depends on time", "autonomous", remedy)
