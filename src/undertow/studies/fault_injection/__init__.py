"""Faults put into runs on purpose: what fails, how, and whether the run ends safely.

:mod:`~undertow.studies.fault_injection.simulated` runs the list of
:mod:`~undertow.studies.fault_injection.cases` in simulated time,
:mod:`~undertow.studies.fault_injection.live` what needs real time and processes, and
:mod:`~undertow.studies.fault_injection.systematic` lets every call of the system fail in turn.
"""

from undertow.studies.fault_injection.cases import CASES, Case
from undertow.studies.fault_injection.failing_calls import Fault, intercepts_sqlite
from undertow.studies.fault_injection.live import KillResult, LiveResult, kill_drill, live_drill
from undertow.studies.fault_injection.report import drill_table, kill_table, systematic_table
from undertow.studies.fault_injection.simulated import CaseResult, drill
from undertow.studies.fault_injection.systematic import FaultResult, Systematic

__all__ = [
    "CASES",
    "Case",
    "CaseResult",
    "Fault",
    "FaultResult",
    "KillResult",
    "LiveResult",
    "Systematic",
    "drill",
    "drill_table",
    "intercepts_sqlite",
    "kill_drill",
    "kill_table",
    "live_drill",
    "systematic_table",
]
