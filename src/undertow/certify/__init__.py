"""Certificates: claims about a surface with a verdict, a margin and a witness.

Needs the extra ``undertow[certify]`` (python-flint, Clarabel), imported when first used.
"""

from undertow.certify.reaching import DisturbanceBound, ReachingCertificate, reaching
from undertow.certify.region import LyapunovFunction, SurfaceMotion, verify_region
from undertow.certify.region_search import ProvedRegion, prove_region
from undertow.certify.surface import (
    CriticalMode,
    closed_forms,
    critical_mode,
    hurwitz,
    nonsingular,
    singular_distance,
)
from undertow.certify.verdict import Verdict

__all__ = [
    "CriticalMode",
    "DisturbanceBound",
    "LyapunovFunction",
    "ProvedRegion",
    "ReachingCertificate",
    "SurfaceMotion",
    "Verdict",
    "closed_forms",
    "critical_mode",
    "hurwitz",
    "nonsingular",
    "prove_region",
    "reaching",
    "singular_distance",
    "verify_region",
]
