"""The paper's experiment, end to end: printed data, Tables 1-2, Figures 3-11, findings."""

from undertow.studies.paper.data import CASES, CONDITIONS, OBJECTIVES, PRINTED, ROWS, Condition
from undertow.studies.paper.experiment import Effort, LowerBound, Reproduction, printed_motion
from undertow.studies.paper.figures import figures
from undertow.studies.paper.findings import Finding, findings
from undertow.studies.paper.limits import catch_limit, singular_angle
from undertow.studies.paper.tables import files, report, reproduction

__all__ = [
    "CASES",
    "CONDITIONS",
    "OBJECTIVES",
    "PRINTED",
    "ROWS",
    "Condition",
    "Effort",
    "Finding",
    "LowerBound",
    "Reproduction",
    "catch_limit",
    "figures",
    "files",
    "findings",
    "printed_motion",
    "report",
    "reproduction",
    "singular_angle",
]
