"""Regions that a verified certificate proves, for the admission gate to use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undertow.base.errors import CertificateError
from undertow.certify.claims.certificate import ellipsoid_of
from undertow.certify.claims.verify import Checked
from undertow.certify.closed_loop.claim import LoopClaim
from undertow.certify.surface.ellipsoid import ProvedEllipsoid
from undertow.law.sliding import ReachingLaw, Surface
from undertow.models.mechanism import FloatArray, Mechanism

__all__ = ["ProvedStarts", "proved_sets"]


@dataclass(frozen=True)
class ProvedStarts:
    """Starts at rest, one coordinate off the target by at most ``extent``, SI units.

    ``model`` is the mechanism's fingerprint; empty where nobody said it.
    """

    surface: Surface
    reaching: ReachingLaw
    index: int
    extent: float
    model: str = ""

    def contains(self, x: FloatArray) -> bool:
        """Whether the state is one of them."""
        state = np.asarray(x, dtype=float)
        return bool(
            abs(state[self.index]) <= self.extent and not np.delete(state, self.index).any()
        )


def proved_sets(
    mechanism: Mechanism, checked: Sequence[Checked]
) -> tuple[ProvedEllipsoid | ProvedStarts, ...]:
    """Return the regions of the full closed loop that were proved again.

    Parameters
    ----------
    mechanism
        The one that they were checked for.
    checked
        From :func:`undertow.certify.claims.verify.verify`; what was not proved is passed over, and
        what was proved of a held input: the gate's sets are those of the continuous law.

    Returns
    -------
    tuple
        For ``certified_gate(sets=…)``.

    Raises
    ------
    CertificateError
        For claims that were checked for another mechanism, or other parameters.
    """
    if any(item.model != mechanism.fingerprint for item in checked):
        raise CertificateError(
            f"proved sets for '{mechanism.name}'",
            value="claims that were checked for other equations, parameters or limits",
            limit="those of this very mechanism",
            remedy="Pass the mechanism with the certificate's parameters: with_parameters(…)",
        )
    names = [c.name for c in mechanism.coordinates]
    found: list[ProvedEllipsoid | ProvedStarts] = []
    for item in checked:
        law = (item.subject.surface, item.subject.reaching)
        if not item.verdict:
            continue
        if item.claim.kind == "terminal ellipsoid":
            found.append(ProvedEllipsoid(*law, ellipsoid_of(item.claim.data), item.model))
        elif item.claim.kind == "closed loop":
            claim = LoopClaim.from_dict(item.claim.data)
            if claim.hold == 0:
                index = names.index(claim.coordinate)
                found.append(ProvedStarts(*law, index, claim.extent, item.model))
    return tuple(found)
