"""Whether a mechanism of one's own is sound, and what is compiled is the model that was meant."""

from undertow.checks.check import MechanismReport, check_mechanism

__all__ = [
    "MechanismReport",
    "check_mechanism",
]
