"""Checks a certificate again, from the file and the mechanism alone.

Every claim is decided afresh by its checker; nothing of the search that found it is imported
here, directly or through others (``pyproject.toml`` and the tests see to it): no linear program,
no semidefinite solver, no optimiser.  What is proved is proved for the equations of the
mechanism that is passed in; the file only brings the numbers to try.  So the sentence of a verdict
is the checker's, made from the numbers that it decided on; the file's own words do not count.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp

from undertow.certify.appendix import CASES, Constants, Lyapunov, two_vertex
from undertow.certify.certificate import Certificate, Claim, Subject, ellipsoid_of, function_of
from undertow.certify.ellipsoid import verify_ellipsoid
from undertow.certify.exact_model import exact_mechanism
from undertow.certify.loop_claim import LoopClaim, verify_loop
from undertow.certify.lyapunov import LyapunovFunction
from undertow.certify.motion import Motion, SurfaceMotion
from undertow.certify.reaching import reaching
from undertow.certify.region import verify_region
from undertow.certify.surface import hurwitz, nonsingular
from undertow.certify.taylor import TaylorProgram
from undertow.certify.taylor_kernel import bounds
from undertow.codegen import Tape
from undertow.errors import CertificateError, UndertowError
from undertow.mechanism import Mechanism
from undertow.verdict import Verdict, inward, within

__all__ = ["CHECKS", "Checked", "check_settings", "match", "region_words", "verify"]

Box = dict[str, tuple[float, float]]


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
    claim: Claim
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
    if certificate.name != mechanism.name:
        raise CertificateError(
            "certificate of another mechanism",
            value=repr(certificate.name),
            limit=f"'{mechanism.name}'",
            remedy="Name the mechanism that it is about",
        )
    if certificate.structure != mechanism.structure:
        raise CertificateError(
            f"equations of '{mechanism.name}'",
            value=f"hash {mechanism.structure[:12]}…",
            limit=f"{certificate.structure[:12]}…, those of the certificate "
            f"(SymPy {str(certificate.versions.get('sympy'))[:12]!r})",
            remedy="The model has changed since: certify again",
        )
    present = {p.name: p.value for p in mechanism.parameters}
    if set(present) != set(certificate.parameters):
        raise CertificateError(
            f"parameters of '{mechanism.name}'",
            value=", ".join(sorted(present)),
            limit=", ".join(repr(name) for name in sorted(certificate.parameters)),
        )
    changed = {k: v for k, v in certificate.parameters.items() if present[k] != v}
    if changed and own_parameters:
        name, value = next(iter(changed.items()))
        raise CertificateError(
            f"parameter '{name}' of '{mechanism.name}'",
            value=f"{present[name]:.17g}",
            limit=f"{value:.17g}, the certificate's",
            remedy="The proof is for that value: certify again with --set",
        )
    limits = tuple(i.limit for i in mechanism.inputs)
    if limits != certificate.input_limits:
        raise CertificateError(
            f"input limits of '{mechanism.name}'",
            value=limits,
            limit=f"{certificate.input_limits}, the certificate's",
        )
    try:
        return mechanism.with_parameters(**changed)
    except UndertowError as error:
        raise CertificateError(
            "parameters of a certificate", value=str(error), limit="physical"
        ) from error


def check_settings(certificate: Certificate, settings: Mapping[str, float]) -> None:
    """Refuse a certificate whose parameters are not the stated ones.

    Raises
    ------
    CertificateError
        With the first parameter that is unknown or has another value.
    """
    for name, value in settings.items():
        stated = certificate.parameters.get(name)
        if stated != value:
            raise CertificateError(
                f"parameter '{name}' of the certificate",
                value=f"{value:.17g}",
                limit="one of the certificate's" if stated is None else f"{stated:.17g}, as proved",
                remedy="The proof is for that value: certify again with --set",
            )


def verify(
    certificate: Certificate,
    mechanism: Mechanism,
    *,
    own_parameters: bool = False,
    max_seconds: float = 600.0,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[Checked, ...]:
    """Decide all claims of a certificate again.

    Parameters
    ----------
    certificate
        From :func:`undertow.certify.certificate.read_certificate`.
    mechanism, own_parameters
        As for :func:`match`.
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
    matched = match(certificate, mechanism, own_parameters=own_parameters)
    model = exact_mechanism(matched)
    tasks = [(s, c) for s in certificate.subjects for c in s.claims]
    if not tasks:
        raise CertificateError("certificate", value="no claim", limit="at least one")
    unknown = sorted({c.kind for _, c in tasks} - set(CHECKS))
    if unknown:
        raise CertificateError(
            "claim of a certificate",
            value=", ".join(repr(kind) for kind in unknown),
            limit=f"one of {', '.join(CHECKS)}",
            remedy="It was made by a later version of Undertow",
        )
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


def _decide(mechanism: Mechanism, subject: Subject, claim: Claim, seconds: float) -> Verdict:
    try:
        verdict = CHECKS[claim.kind](mechanism, subject, claim.data, seconds)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise CertificateError(
            f"claim '{claim.kind}'",
            value=f"{type(error).__name__}: {error}",
            limit="complete, with numbers that can be computed with",
        ) from error
    stated = claim.verdict.margin
    if verdict and math.isfinite(stated) and not verdict.margin >= stated - 1e-9 * abs(stated):
        return replace(
            verdict,
            kind="undecided",
            method=f"the file states a margin of {stated:.6g}, "
            f"proved is {inward(verdict.margin, 6)}",
        )
    return verdict


# -- one checker for each kind of claim ---------------------------------------------------------


def _box(data: Mapping[str, Any]) -> Box:
    return {str(k): (float(a), float(b)) for k, (a, b) in data.items()}


def _stability(m: Mechanism, s: Subject, _data: Mapping[str, Any], _seconds: float) -> Verdict:
    return hurwitz(m, s.surface)


def _nonsingular(m: Mechanism, s: Subject, data: Mapping[str, Any], _seconds: float) -> Verdict:
    return nonsingular(m, s.surface, _box(data["region"]))


def _reaching(m: Mechanism, s: Subject, data: Mapping[str, Any], _seconds: float) -> Verdict:
    return reaching(
        m,
        s.surface,
        _box(data["region"]),
        s.reaching,
        eta=[float(v) for v in data["eta"]],
        disturbance=[float(v) for v in data["disturbance"]],
    ).verdict


#: Functions of one region that are read.
LONGEST_CHAIN = 200


def _region(m: Mechanism, s: Subject, data: Mapping[str, Any], seconds: float) -> Verdict:
    motion = SurfaceMotion(m, s.surface)
    listed = data["functions"] if "functions" in data else [data["function"]]
    if not 0 < len(listed) <= LONGEST_CHAIN:
        raise ValueError(f"a chain of {len(listed)} functions")
    chain = [function_of(item) for item in listed]
    start = [float(v) for v in data["start"]]
    box = _box(data.get("parameters", {}))
    own = {p.name: p.value for p in m.parameters}
    for name, (low, high) in box.items():
        if not low <= own[name] <= high:
            raise ValueError(f"a box [{low:g}, {high:g}] of {name} without its {own[name]:g}")
    claim = region_words(motion, start, box)
    verdict = replace(
        verify_region(motion, chain, parameters=box, max_seconds=seconds), claim=claim
    )
    if not verdict:
        return verdict
    if not reaches(chain[-1], start):
        return Verdict(claim, "undecided", method="the stated start is not shown inside")
    return replace(
        verdict,
        margin=float(np.linalg.norm(start)),
        witness=dict(zip(motion.names, start, strict=True)),
    )


def region_words(motion: Motion, start: Sequence[float], parameters: Box) -> str:
    """Return in words that a region on the surface holds a start, for parameters in a box.

    The line from 0 to the start is inside: with one entry it may be rounded towards 0.
    """
    away = {n: v for n, v in zip(motion.names, start, strict=True) if v}
    points = [f"{n} = {inward(v, 6) if len(away) == 1 else repr(v)}" for n, v in away.items()]
    ranges = "".join(f", for every {n} in {within(a, b)}" for n, (a, b) in parameters.items())
    return (
        "a region of attraction on the surface, non-singular and compact, contains "
        f"{', '.join(points) or 'the target'}{ranges}, the inputs not limited"
    )


def reaches(V: LyapunovFunction, point: Sequence[float], pieces: int = 512) -> bool:
    """Whether V < 1 on the whole line from 0 to a point, outward-rounded: same component as 0.

    Pieces of the line on which it is not seen are cut, some times.
    """
    size = len(V.scale)
    if len(point) != size or (V.stretch is not None and abs(point[0]) >= V.pole):
        return False
    part = sp.Symbol("_part", real=True)
    tape = Tape()
    y = tape.matrix(sp.Matrix([sp.Rational(*float(v).as_integer_ratio()) * part for v in point]))
    value, _ = V.lay(tape, list(y), [sp.Integer(0)] * size)
    program = TaylorProgram.of(tape, [part], [], [value])
    ends = np.linspace(0.0, 1.0, pieces + 1)
    low, high = ends[:-1], ends[1:]
    for _ in range(12):
        _, above = bounds(program(low[None], high[None]), 1)
        left = ~(above[0] < 1.0)
        if not left.any():
            return True
        low, high = low[left], high[left]
        middle = 0.5 * (low + high)
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    return False


def _ellipsoid(m: Mechanism, s: Subject, data: Mapping[str, Any], _seconds: float) -> Verdict:
    return verify_ellipsoid(m, s.surface, s.reaching, ellipsoid_of(data))


def _loop(m: Mechanism, s: Subject, data: Mapping[str, Any], seconds: float) -> Verdict:
    return verify_loop(m, s.surface, s.reaching, LoopClaim.from_dict(data), max_seconds=seconds)


def _interval(m: Mechanism, s: Subject, data: Mapping[str, Any], _seconds: float) -> Verdict:
    """The appendix's R(y₁) ≻ 0, with the b, c, d of the mechanism and some P."""
    case = next((c for c in CASES if c.surface == s.surface), None)
    if case is None:
        raise ValueError("a surface that is none of the appendix's")
    constants = Constants.of(m)
    P = Lyapunov.of(*(_exact(v) for v in data["P"]))
    return two_vertex(case.reduced(constants), P, Fraction(_exact(data["half_width"])))


def _exact(value: Any) -> str:
    """A number as text, digits alone: an exponent may stand for more of them than there are."""
    text = str(value)
    if not re.fullmatch(r"-?[0-9]{1,40}(/[0-9]{1,40}|\.[0-9]{1,40})?", text):
        raise ValueError("a number that is neither a decimal nor a fraction of up to 40 digits")
    return text


Check = Callable[[Mechanism, Subject, Mapping[str, Any], float], Verdict]

#: Kind of claim to its checker.
CHECKS: Mapping[str, Check] = {
    "stability": _stability,
    "nonsingular": _nonsingular,
    "reaching": _reaching,
    "surface region": _region,
    "terminal ellipsoid": _ellipsoid,
    "closed loop": _loop,
    "appendix interval": _interval,
}
