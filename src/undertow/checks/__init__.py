"""Checks of a mechanism: identities of every model, and compiled code against its formulas.

:mod:`.check` tests the model; :mod:`.agreement` compares what is compiled with :mod:`.exact`
arithmetic on the same expressions. In Python: ``ut.check_mechanism(mechanism)``.
"""

from undertow.checks.check import MechanismReport, check_mechanism

__all__ = ["MechanismReport", "check_mechanism"]
