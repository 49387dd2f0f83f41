"""Checks of a mechanism: of its model, and of the compiled code against that model."""

from undertow.checks.check import MechanismReport, check_mechanism

__all__ = [
    "MechanismReport",
    "check_mechanism",
]
