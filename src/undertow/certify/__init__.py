"""Certificates: claims about a surface, a region or the closed loop, each with its verdict.

Needs the extra ``undertow[certify]`` (python-flint, Clarabel), imported when first used.
"""

from undertow.base.verdict import Verdict
from undertow.certify.claims.certificate import Certificate, Claim, Subject, read_certificate
from undertow.certify.claims.gate import Policy, assess, certified_gate
from undertow.certify.region.region import LyapunovFunction, SurfaceMotion, verify_region
from undertow.certify.region.search import ProvedRegion, prove_region
from undertow.certify.surface.ellipsoid import TerminalEllipsoid, verify_ellipsoid
from undertow.certify.surface.ellipsoid_search import terminal_sets
from undertow.certify.surface.reaching import DisturbanceBound, ReachingCertificate, reaching
from undertow.certify.surface.surface import (
    CriticalMode,
    closed_forms,
    critical_mode,
    hurwitz,
    nonsingular,
    singular_distance,
)

__all__ = [
    "Certificate",
    "Claim",
    "CriticalMode",
    "DisturbanceBound",
    "LyapunovFunction",
    "Policy",
    "ProvedRegion",
    "ReachingCertificate",
    "Subject",
    "SurfaceMotion",
    "TerminalEllipsoid",
    "Verdict",
    "assess",
    "certified_gate",
    "closed_forms",
    "critical_mode",
    "hurwitz",
    "nonsingular",
    "prove_region",
    "reaching",
    "read_certificate",
    "singular_distance",
    "terminal_sets",
    "verify_ellipsoid",
    "verify_region",
]
