"""Certificates: claims about a surface, a region or the closed loop, each with its verdict.

``kernel`` decides.  ``claims`` has a file for each kind of claim and reads, writes and verifies
certificates; what ``search`` finds is trusted nowhere.  The admission gate
(:mod:`undertow.proofs.gate`) and random trials (:mod:`undertow.proofs.sampled`) prove less.
"""

from undertow.base.verdict import Verdict
from undertow.proofs.claims.certificate import Certificate, StatedClaim, Subject, read_certificate
from undertow.proofs.claims.claim import Claim
from undertow.proofs.claims.closed_loop import LoopClaim
from undertow.proofs.claims.nonsingular import NonsingularClaim, nonsingular, singular_distance
from undertow.proofs.claims.reaching import (
    DisturbanceBound,
    ReachingCertificate,
    ReachingClaim,
    reaching,
)
from undertow.proofs.claims.region import RegionClaim, verify_region
from undertow.proofs.claims.stability import StabilityClaim, hurwitz
from undertow.proofs.claims.terminal_ellipsoid import ClosedLoopProgram, TerminalEllipsoid
from undertow.proofs.claims.verify import Checked, check_settings, proved_sets, verify
from undertow.proofs.gate import GatePolicy, assess, certified_gate
from undertow.proofs.region.lyapunov import LyapunovFunction
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.sampled import box_starts, sampled_extent, sampled_region
from undertow.proofs.search.closed_loop import ProvedLoop, prove_loop
from undertow.proofs.search.region import ProvedRegion, prove_region
from undertow.proofs.search.terminal_ellipsoid import search_for, terminal_sets

__all__ = [
    "Certificate",
    "Checked",
    "Claim",
    "ClosedLoopProgram",
    "DisturbanceBound",
    "GatePolicy",
    "LoopClaim",
    "LyapunovFunction",
    "NonsingularClaim",
    "ProvedLoop",
    "ProvedRegion",
    "ReachingCertificate",
    "ReachingClaim",
    "RegionClaim",
    "StabilityClaim",
    "StatedClaim",
    "Subject",
    "SurfaceMotion",
    "TerminalEllipsoid",
    "Verdict",
    "assess",
    "box_starts",
    "certified_gate",
    "check_settings",
    "hurwitz",
    "nonsingular",
    "prove_loop",
    "prove_region",
    "proved_sets",
    "reaching",
    "read_certificate",
    "sampled_extent",
    "sampled_region",
    "search_for",
    "singular_distance",
    "terminal_sets",
    "verify",
    "verify_region",
]
