"""Verifies a certificate from the file and the mechanism alone.

The kernel decides every claim again.  Nothing of the search that found it is imported here,
directly or through others (``pyproject.toml`` and the tests see to it): no linear program, no
semidefinite solver, no optimiser.  What is proved is proved for the equations of the mechanism that
is passed in; the file only supplies numbers to try.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from undertow.base.arguments import require
from undertow.base.errors import CertificateError, UndertowError
from undertow.base.verdict import Verdict
from undertow.law.surface import ProvedSet
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.certificate import Certificate, Subject
from undertow.proofs.claims.closed_loop import LoopClaim
from undertow.proofs.claims.document import decide_document
from undertow.proofs.claims.model_data import model_data
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.reader import digest

#: What is asked of a certificate.
_require = partial(require, error=CertificateError)

AGAIN = "The proof is for that value: certify again with --set"


@dataclass(frozen=True)
class Checked:
    """One claim, decided again.

    Parameters
    ----------
    subject
        Whose claim it is.
    claim
        Its numbers, exact.
    verdict
        As it was decided now, with the sentence that was decided.
    model
        Fingerprint of the mechanism that it was decided for: equations, parameters, limits.
    """

    subject: Subject
    claim: kernel.Claim
    verdict: Verdict
    model: str


def match(
    certificate: Certificate, mechanism: Mechanism, *, own_parameters: bool = False
) -> Mechanism:
    """Return the mechanism that a certificate is about, or refuse.

    ``certificate``: from the file. ``mechanism``: what it should be about. ``own_parameters``: the
    mechanism's parameters count, and must be the certificate's; otherwise it takes the
    certificate's. Raises CertificateError for other equations, parameters or input limits.
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
    whose = "Name the mechanism that it is about, NAME or FILE: undertow verify --mechanism"
    _require(alike, f"parameters of '{name}'", ", ".join(sorted(present)), wanted, whose)
    changed = {k: v for k, v in own.parameters.items() if present[k] != v}
    for key, value in changed.items() if own_parameters else ():
        what, limit = f"parameter '{key}' of '{name}'", f"{value}, the certificate's"
        _require(False, what, f"{present[key]}", limit, AGAIN)
    limits = tuple(i.limit for i in mechanism.inputs)
    wanted = f"{own.input_limits}, the certificate's"
    _require(limits == own.input_limits, f"input limits of '{name}'", limits, wanted)
    try:
        matched = mechanism.with_parameters(**changed)
    except UndertowError as error:
        raise CertificateError(
            "parameters of a certificate", value=str(error), limit="physical"
        ) from error
    found, stated = digest(model_data(matched)), own.document.model_hash
    made_with = str(own.document.made_with.get("sympy"))[:12]
    _require(
        found == stated,
        f"equations of '{name}'",
        f"hash {found[:12]}…",
        f"{stated[:12]}…, those of the certificate (SymPy {made_with!r})",
        "The model has changed since: certify again",
    )
    return matched


def check_settings(certificate: Certificate, settings: Mapping[str, float]) -> None:
    """Refuse a certificate whose parameters are not the stated ones.

    Raises
    ------
    CertificateError
        With the first parameter that is unknown or has another value.
    """
    for name, value in settings.items():
        stated = certificate.parameters.get(name)
        limit = "one of the certificate's" if stated is None else f"{stated}, as proved"
        what = f"parameter '{name}' of the certificate"
        _require(stated == value, what, f"{value}", limit, AGAIN)


def verify(
    certificate: Certificate,
    mechanism: Mechanism | None,
    *,
    own_parameters: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Checked, ...]:
    """Decide all claims of a certificate again.

    Parameters
    ----------
    certificate
        From :func:`undertow.proofs.read_certificate`.
    mechanism, own_parameters
        As for :func:`match`.  The file says everything by itself: with None it is decided for the
        model that is in it.
    progress
        Called with (claim, part done).

    Returns
    -------
    tuple of Checked
        In the order of the file; it holds if every verdict is ``proved``.

    Raises
    ------
    CertificateError
        For another mechanism, or a certificate without claims.
    ModelError
        For a mechanism that is not smooth.
    """
    document = certificate.document
    model = document.model_hash
    if mechanism is not None:
        model = match(certificate, mechanism, own_parameters=own_parameters).fingerprint
    subjects = [s for s in certificate.subjects for _ in s.claims]
    decided = decide_document(document, progress)
    return tuple(
        Checked(subject, claim, verdict, model)
        for subject, (_, claim, verdict) in zip(subjects, decided, strict=True)
    )


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
    proved = (item for item in checked if item.verdict)
    found = (_proved_set(mechanism, item.subject, item.claim) for item in proved)
    return tuple(region for region in found if region is not None)


def _proved_set(mechanism: Mechanism, subject: Subject, claim: kernel.Claim) -> ProvedSet | None:
    law = mechanism, subject.surface, subject.reaching
    if isinstance(claim, kernel.TerminalEllipsoid):
        return TerminalEllipsoid.of(claim).proved_set(*law)
    if isinstance(claim, kernel.ClosedLoop):
        return LoopClaim.of(claim).proved_set(*law)
    return None
