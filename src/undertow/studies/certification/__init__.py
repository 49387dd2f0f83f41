"""What `undertow certify` and `undertow verify` do: claims composed, shown, drawn, written."""

from undertow.studies.certification.bench import SEARCH, certify_bench
from undertow.studies.certification.decide import (
    LOOP_SECONDS,
    Certified,
    certify_appendix,
    certify_run,
    certify_surface,
)
from undertow.studies.certification.figures import loop_figure, region_figure
from undertow.studies.certification.interface import Verification, certify, verify
from undertow.studies.certification.report import (
    appendix_report,
    certificate_files,
    run_report,
    subject_report,
    verification_report,
)

__all__ = [
    "LOOP_SECONDS",
    "SEARCH",
    "Certified",
    "Verification",
    "appendix_report",
    "certificate_files",
    "certify",
    "certify_appendix",
    "certify_bench",
    "certify_run",
    "certify_surface",
    "loop_figure",
    "region_figure",
    "run_report",
    "subject_report",
    "verification_report",
    "verify",
]
