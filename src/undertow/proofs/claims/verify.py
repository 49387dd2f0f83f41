"""Verifies a certificate from the file and the mechanism alone.

Every claim decides itself again (:meth:`undertow.proofs.Claim.decide`).  Nothing of the search
that found it is imported here, directly or through others (``pyproject.toml`` and the tests see to
it): no linear program, no semidefinite solver, no optimiser.  What is proved is proved for the
equations of the mechanism that is passed in; the file only supplies numbers to try.  So the
sentence of a verdict is made from the numbers that were decided on; the file's own sentences do
not count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from undertow.base.errors import CertificateError, UndertowError, error_text
from undertow.base.verdict import Verdict, inward
from undertow.law.surface import ProvedSet
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.appendix import AppendixClaim
from undertow.proofs.claims.certificate import Certificate, StatedClaim, Subject
from undertow.proofs.claims.claim import Claim
from undertow.proofs.claims.closed_loop import LoopClaim
from undertow.proofs.claims.document import decide_document
from undertow.proofs.claims.model_data import model_data
from undertow.proofs.claims.nonsingular import NonsingularClaim
from undertow.proofs.claims.reaching import ReachingClaim
from undertow.proofs.claims.region import RegionClaim
from undertow.proofs.claims.stability import StabilityClaim
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid
from undertow.proofs.intervals.exact_model import exact_mechanism
from undertow.proofs.kernel.reader import digest

#: Every kind of claim, by its name in a certificate.
CLAIMS: Mapping[str, type[Claim]] = {
    claim.kind: claim
    for claim in (
        StabilityClaim,
        NonsingularClaim,
        ReachingClaim,
        RegionClaim,
        TerminalEllipsoid,
        LoopClaim,
        AppendixClaim,
    )
}


@dataclass(frozen=True)
class Checked:
    """One claim, decided again.

    Parameters
    ----------
    subject
        Whose claim it is.
    claim
        As the file has it; its words say nothing.
    verdict
        As it was decided now, with the sentence that was decided.
    model
        Fingerprint of the mechanism that it was decided for: equations, parameters, limits.
    """

    subject: Subject
    claim: StatedClaim
    verdict: Verdict
    model: str

    @property
    def reworded(self) -> bool:
        """Whether the file says something else than what was decided."""
        return self.claim.verdict.claim != self.verdict.claim


def match(
    certificate: Certificate, mechanism: Mechanism, *, own_parameters: bool = False
) -> Mechanism:
    """Return the mechanism that a certificate is about, or refuse.

    Parameters
    ----------
    certificate
        From the file.
    mechanism
        What it should be about.
    own_parameters
        The mechanism's parameters count, and must be the certificate's; otherwise it takes
        the certificate's.

    Raises
    ------
    CertificateError
        For other equations, parameters or input limits.
    """
    own, name = certificate, mechanism.name
    _require(
        own.name == name,
        "certificate of another mechanism",
        repr(own.name),
        f"'{name}'",
        "Name the mechanism that it is about",
    )
    present = {p.name: p.value for p in mechanism.parameters}
    wanted = ", ".join(repr(key) for key in sorted(own.parameters))
    alike = set(present) == set(own.parameters)
    _require(alike, f"parameters of '{name}'", ", ".join(sorted(present)), wanted)
    changed = {k: v for k, v in own.parameters.items() if present[k] != v}
    for key, value in changed.items() if own_parameters else ():
        what, limit = f"parameter '{key}' of '{name}'", f"{value:.17g}, the certificate's"
        _require(False, what, f"{present[key]:.17g}", limit, AGAIN)
    limits = tuple(i.limit for i in mechanism.inputs)
    wanted = f"{own.input_limits}, the certificate's"
    _require(limits == own.input_limits, f"input limits of '{name}'", limits, wanted)
    try:
        matched = mechanism.with_parameters(**changed)
    except UndertowError as error:
        raise CertificateError(
            "parameters of a certificate", value=str(error), limit="physical"
        ) from error
    structure = matched.structure if own.document is None else digest(model_data(matched))
    _require(
        own.structure == structure,
        f"equations of '{name}'",
        f"hash {structure[:12]}…",
        f"{own.structure[:12]}…, those of the certificate "
        f"(SymPy {str(own.versions.get('sympy'))[:12]!r})",
        "The model has changed since: certify again",
    )
    return matched


AGAIN = "The proof is for that value: certify again with --set"


def _require(good: bool, what: str, value: object, limit: object, remedy: str = "") -> None:
    if not good:
        raise CertificateError(what, value=value, limit=limit, remedy=remedy)


def check_settings(certificate: Certificate, settings: Mapping[str, float]) -> None:
    """Refuse a certificate whose parameters are not the stated ones.

    Raises
    ------
    CertificateError
        With the first parameter that is unknown or has another value.
    """
    for name, value in settings.items():
        stated = certificate.parameters.get(name)
        limit = "one of the certificate's" if stated is None else f"{stated:.17g}, as proved"
        what = f"parameter '{name}' of the certificate"
        _require(stated == value, what, f"{value:.17g}", limit, AGAIN)


def verify(
    certificate: Certificate,
    mechanism: Mechanism | None,
    *,
    own_parameters: bool = False,
    max_seconds: float = 600.0,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Checked, ...]:
    """Decide all claims of a certificate again.

    Parameters
    ----------
    certificate
        From :func:`undertow.proofs.read_certificate`.
    mechanism, own_parameters
        As for :func:`match`.  A file of version 2 says everything by itself: with None it is
        decided for the model that is in it.
    max_seconds
        Effort for each claim.
    progress
        Called with (claim, part done).

    Returns
    -------
    tuple of Checked
        In the order of the file; it holds if every verdict is ``proved``.

    Raises
    ------
    CertificateError
        For another mechanism, a claim of an unknown kind, or one without claims.
    ModelError
        For a mechanism that is not smooth.
    MissingExtraError
        Without python-flint.
    """
    if certificate.document is not None:
        return _verify_document(certificate, mechanism, own_parameters, progress)
    if mechanism is None:
        raise CertificateError(
            "certificate of version 1", value="no mechanism", limit="the one that it is about"
        )
    matched = match(certificate, mechanism, own_parameters=own_parameters)
    model = exact_mechanism(matched)
    tasks = [(s, c) for s in certificate.subjects for c in s.claims]
    _require(bool(tasks), "certificate", "no claim", "at least one")
    unknown = ", ".join(repr(kind) for kind in sorted({c.kind for _, c in tasks} - set(CLAIMS)))
    limit, remedy = f"one of {', '.join(CLAIMS)}", "It was made by a later version of Undertow"
    _require(not unknown, "claim of a certificate", unknown, limit, remedy)
    done: list[Checked] = []
    for index, (subject, claim) in enumerate(tasks):
        if progress is not None:
            progress(claim.kind, index / len(tasks))
        asked = subject.surface, subject.reaching, claim
        known = (c for c in done if (c.subject.surface, c.subject.reaching, c.claim) == asked)
        same = next(known, None)  # what stands there again is not decided again
        verdict = _decide(model, subject, claim, max_seconds) if same is None else same.verdict
        done.append(Checked(subject, claim, verdict, matched.fingerprint))
    return tuple(done)


def _verify_document(
    certificate: Certificate,
    mechanism: Mechanism | None,
    own_parameters: bool,
    progress: Callable[[str, float], None] | None,
) -> tuple[Checked, ...]:
    document, model = certificate.document, certificate.structure
    assert document is not None
    if mechanism is not None:
        model = match(certificate, mechanism, own_parameters=own_parameters).fingerprint
    subjects = [s for s in certificate.subjects for _ in s.claims]
    stated = [c for s in certificate.subjects for c in s.claims]
    decided = decide_document(document, progress)
    return tuple(
        Checked(subject, claim, verdict, model)
        for subject, claim, (_, _, verdict) in zip(subjects, stated, decided, strict=True)
    )


def _decide(mechanism: Mechanism, subject: Subject, stated: StatedClaim, seconds: float) -> Verdict:
    try:
        claim = CLAIMS[stated.kind].from_dict(stated.data)
        verdict = claim.decide(mechanism, subject.surface, subject.reaching, seconds=seconds)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise CertificateError(
            f"claim '{stated.kind}'",
            value=error_text(error),
            limit="complete, with numbers that can be computed with",
        ) from error
    margin = stated.verdict.margin
    if verdict and math.isfinite(margin) and not verdict.margin >= margin - 1e-9 * abs(margin):
        return replace(
            verdict,
            kind="undecided",
            method=f"the file states a margin of {margin:.6g}, "
            f"proved is {inward(verdict.margin, 6)}",
        )
    return verdict


def proved_sets(mechanism: Mechanism, checked: Sequence[Checked]) -> tuple[ProvedSet, ...]:
    """Return the regions of the full closed loop that were proved again.

    Parameters
    ----------
    mechanism
        The one that they were checked for.
    checked
        From :func:`verify`; what was not proved is passed over, and
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
    _require(
        all(item.model == mechanism.fingerprint for item in checked),
        f"proved sets for '{mechanism.name}'",
        "claims that were checked for other equations, parameters or limits",
        "those of this very mechanism",
        "Pass the mechanism with the certificate's parameters: with_parameters(…)",
    )
    found = (
        CLAIMS[item.claim.kind]
        .from_dict(item.claim.data)
        .proved_set(mechanism, item.subject.surface, item.subject.reaching)
        for item in checked
        if item.verdict
    )
    return tuple(proved for proved in found if proved is not None)
