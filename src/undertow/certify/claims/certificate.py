"""The certificate file: claims as plain numbers, for a sceptic to check again.

One JSON document, ``undertow-certificate`` version 1:

``mechanism``
    Name, hash of the equations, parameters, input limits: for which model.
``subjects``
    Surfaces with their reaching laws, each with its claims: a kind, the numbers of the claim
    (a Lyapunov function, an ellipsoid, a region of positions, …), and the verdict that was given.
``remarks``
    Verdicts that are no proofs (sampled, refuted, undecided); kept for people, never counted.
``versions``, ``checksum``
    What made the file, and SHA-256 of the canonical JSON of everything else.

Nothing in the file is believed: :mod:`undertow.certify.claims.verify` decides every claim again,
and says in words of its own what it decided; those of a claim in the file are for readers and
never shown. Texts that hold anything but printable characters are refused.  The checksum is
against accidents and careless edits, not against forgers; those meet the proof.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from undertow.base.errors import CertificateError, UndertowError
from undertow.base.files import check_file, parse_json, read_file
from undertow.base.verdict import Verdict
from undertow.certify.region.lyapunov import LyapunovFunction
from undertow.certify.surface.ellipsoid import TerminalEllipsoid
from undertow.law.sliding import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism

__all__ = [
    "Certificate",
    "Claim",
    "Subject",
    "ellipsoid_data",
    "ellipsoid_of",
    "function_data",
    "function_of",
    "read_certificate",
]

FORMAT, VERSION = "undertow-certificate", 1

#: Largest file that is read, bytes; a certificate of the appendix has some ten thousand.
LARGEST = 4_000_000

#: Longest name of a mechanism, a parameter or a kind of claim that is read.
LONGEST_NAME = 64


@dataclass(frozen=True)
class Claim:
    """One claim about a subject.

    Parameters
    ----------
    kind
        Which checker decides it, see :data:`undertow.certify.claims.verify.CHECKS`.
    data
        Its numbers, as JSON values.
    verdict
        The verdict that was given; only ``proved`` ones become claims of a certificate.
    """

    kind: str
    data: Mapping[str, Any]
    verdict: Verdict


@dataclass(frozen=True)
class Subject:
    """A surface with its reaching law, what is proved of it, and what is not.

    Parameters
    ----------
    surface, reaching
        The law.
    claims
        Proved claims.
    remarks
        Other verdicts, for people.
    """

    surface: Surface
    reaching: ReachingLaw
    claims: tuple[Claim, ...]
    remarks: tuple[Verdict, ...] = ()


@dataclass(frozen=True)
class Certificate:
    """The content of a certificate file.

    Parameters
    ----------
    name, structure
        The mechanism's name and the hash of its equations.
    parameters
        Its parameter values, SI units.
    input_limits
        Of its inputs, ``inf`` for none.
    subjects
        What is certified.
    versions
        Of everything that made it.
    """

    name: str
    structure: str
    parameters: Mapping[str, float]
    input_limits: tuple[float, ...]
    subjects: tuple[Subject, ...]
    versions: Mapping[str, str | None] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        mechanism: Mechanism,
        subjects: Sequence[Subject],
        versions: Mapping[str, str | None] | None = None,
    ) -> Self:
        """Collect subjects of one mechanism; only proved claims are kept as claims."""
        for subject in subjects:
            unproved = [c.verdict for c in subject.claims if not c.verdict]
            if unproved:
                raise CertificateError(
                    "claim of a certificate",
                    value=str(unproved[0]),
                    limit="proved",
                    remedy="Keep it as a remark",
                )
        return cls(
            mechanism.name,
            mechanism.structure,
            {p.name: p.value for p in mechanism.parameters},
            tuple(i.limit for i in mechanism.inputs),
            tuple(subjects),
            dict(versions or {}),
        )

    def to_bytes(self) -> bytes:
        """Return the file.

        Raises
        ------
        CertificateError
            For numbers that are not finite.
        """
        document = {
            "format": FORMAT,
            "version": VERSION,
            "mechanism": {
                "name": self.name,
                "structure": self.structure,
                "parameters": dict(self.parameters),
                "input_limits": [v if math.isfinite(v) else None for v in self.input_limits],
            },
            "subjects": [_subject_data(s) for s in self.subjects],
            "versions": dict(self.versions),
        }
        document["checksum"] = _checksum(document)
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
        # A line for each innermost list; no string of JSON has a line break inside.
        text = re.sub(r"\[\n\s+([^\[\]{}]*?)\n\s+\]", _on_one_line, text)
        return (text + "\n").encode()

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Read a file; what is damaged, edited, or of an unknown version is refused.

        Raises
        ------
        CertificateError
            With what is wrong.
        """
        document = _parse(content)
        if document.get("format") != FORMAT:
            raise CertificateError(
                "certificate", value=f"format {document.get('format')!r}", limit=repr(FORMAT)
            )
        if document.get("version") != VERSION:
            raise CertificateError(
                "certificate",
                value=f"version {document.get('version')!r}",
                limit=VERSION,
                remedy="Certify again with this version of Undertow, or verify with that one",
            )
        if document.get("checksum") != _checksum(document):
            raise CertificateError(
                "certificate",
                value="a checksum that does not fit its content",
                limit="the file as it was written",
                remedy="It was edited or damaged; certify again",
            )
        try:
            return cls._from_document(document)
        except (
            UndertowError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError,
            RecursionError,
        ) as error:  # fmt: skip
            raise CertificateError(
                "certificate",
                value=f"{type(error).__name__}: {error}",
                limit="complete, with numbers of the right shapes",
            ) from error

    @classmethod
    def _from_document(cls, document: Mapping[str, Any]) -> Self:
        model = document["mechanism"]
        limits = tuple(math.inf if v is None else float(v) for v in model["input_limits"])
        return cls(
            _name(model["name"]),
            str(model["structure"]),
            {_name(k): float(v) for k, v in model["parameters"].items()},
            limits,
            tuple(_subject_of(s) for s in document["subjects"]),
            dict(document["versions"]),
        )


def read_certificate(path: Path) -> Certificate:
    """Read a certificate file.

    Raises
    ------
    ArtefactError
        When the file cannot be read, or is no plain file.
    CertificateError
        When it is too large, damaged or of an unknown version.
    """
    remedy = "undertow certify NAME --out FOLDER writes one"
    size = check_file(path, "certificate", remedy=remedy)
    if size > LARGEST:
        raise CertificateError(
            f"certificate '{path}'", value=f"{size} bytes", limit=f"at most {LARGEST}"
        )
    content = read_file(path, "certificate", most=LARGEST, remedy=remedy)
    return Certificate.from_bytes(content)


# -- JSON that means one thing -----------------------------------------------------------------


def _parse(content: bytes) -> dict[str, Any]:
    """Parse strictly: one object, no repeated keys, no NaN or infinity, nothing absurd."""
    try:
        if len(content) > LARGEST:
            raise ValueError(f"{len(content)} bytes")
        document = parse_json(content)
        if not isinstance(document, dict):
            raise ValueError("no JSON object")
        if not all(text.isprintable() for text in _texts(document)):
            raise ValueError("a text with characters that cannot be printed")
    except (ValueError, RecursionError) as error:
        raise CertificateError(
            "certificate",
            value=str(error) or type(error).__name__,
            limit="JSON as undertow certify writes it",
            remedy="The file is damaged or something else; certify again",
        ) from error
    return document


def _texts(value: Any) -> Iterator[str]:
    """Yield all texts of a JSON value, keys too."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, list):
        for item in value:
            yield from _texts(item)
    elif isinstance(value, dict):
        yield from value
        yield from _texts(list(value.values()))


def _name(text: Any) -> str:
    """A name of a mechanism, a parameter or a kind: no room for a sentence."""
    name = str(text)
    if len(name) > LONGEST_NAME:
        raise ValueError(f"a name of {len(name)} characters")
    return name


def _printable(text: str) -> str:
    """Return a text on one line without what cannot be printed."""
    return "".join(c for c in " ".join(text.split()) if c.isprintable())


def _on_one_line(found: re.Match[str]) -> str:
    return "[" + re.sub(r"\n\s+", " ", found[1]) + "]"


def _checksum(document: Mapping[str, Any]) -> str:
    """SHA-256 of the canonical JSON of everything but the checksum."""
    rest = {k: v for k, v in document.items() if k != "checksum"}
    try:
        text = json.dumps(
            rest, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
        )
    except (ValueError, TypeError, RecursionError) as error:
        raise CertificateError(
            "certificate", value=str(error), limit="finite numbers, texts and lists alone"
        ) from error
    return hashlib.sha256(text.encode()).hexdigest()


def _subject_data(subject: Subject) -> dict[str, Any]:
    surface, law = subject.surface, subject.reaching
    m = surface.m
    eta, layer = np.split(law.vector(m), 2)
    return {
        "surface": {
            "alpha_a": surface.alpha_a.tolist(),
            "lambda_a": surface.lambda_a.tolist(),
            "alpha_u": surface.alpha_u.tolist(),
            "lambda_u": surface.lambda_u.tolist(),
        },
        "reaching": {
            "eta": eta.tolist(),
            "layer": layer.tolist(),
            "switching": law.switching,
        },
        "claims": [
            {"kind": c.kind, "data": dict(c.data), "verdict": _verdict_data(c.verdict)}
            for c in subject.claims
        ],
        "remarks": [_verdict_data(v) for v in subject.remarks],
    }


def _subject_of(data: Mapping[str, Any]) -> Subject:
    law = data["reaching"]
    eta, layer = (tuple(float(v) for v in law[k]) for k in ("eta", "layer"))
    return Subject(
        Surface(**{k: data["surface"][k] for k in ("alpha_a", "lambda_a", "alpha_u", "lambda_u")}),
        ReachingLaw(
            eta[0] if len(eta) == 1 else eta,
            layer[0] if len(layer) == 1 else layer,
            law["switching"],
        ),
        tuple(
            Claim(_name(c["kind"]), dict(c["data"]), _verdict_of(c["verdict"]))
            for c in data["claims"]
        ),
        tuple(_verdict_of(v) for v in data["remarks"]),
    )


def _verdict_data(verdict: Verdict) -> dict[str, Any]:
    margin = verdict.margin if math.isfinite(verdict.margin) else None
    return {
        "claim": _printable(verdict.claim),
        "kind": verdict.kind,
        "margin": margin,
        "unit": verdict.unit,
        "witness": {k: float(v) for k, v in verdict.witness.items() if math.isfinite(v)},
        "method": _printable(verdict.method),
    }


def _verdict_of(data: Mapping[str, Any]) -> Verdict:
    if data["kind"] not in ("proved", "sampled", "refuted", "undecided"):
        raise ValueError(f"verdict of kind {data['kind']!r}")
    margin = math.nan if data["margin"] is None else float(data["margin"])
    return Verdict(
        str(data["claim"]),
        data["kind"],
        margin,
        str(data["unit"]),
        {str(k): float(v) for k, v in data["witness"].items()},
        str(data["method"]),
    )


# -- numbers of claims -------------------------------------------------------------------------


def _matrix(value: Any, *shape: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape} where {shape} is due")
    return array


def function_data(V: LyapunovFunction) -> dict[str, Any]:
    """Return a Lyapunov function as JSON values."""
    data: dict[str, Any] = {
        "scale": V.scale.tolist(),
        "exponents": np.asarray(V.exponents).tolist(),
        "coefficients": np.asarray(V.coefficients).tolist(),
    }
    if V.stretch is not None:
        data |= {"stretch": np.asarray(V.stretch).tolist(), "pole": float(V.pole)}
    return data


def function_of(data: Mapping[str, Any]) -> LyapunovFunction:
    """Rebuild a Lyapunov function; sizes that no search makes are refused."""
    terms, size = len(data["exponents"]), len(data["scale"])
    if not (0 < size <= 12 and 0 < terms <= 5000):
        raise ValueError(f"a function of {size} variables with {terms} terms")
    exponents = np.array(data["exponents"])
    if exponents.dtype.kind != "i" or exponents.shape != (terms, size) or exponents.max() > 24:
        raise ValueError("exponents that are no whole numbers up to 24, one row per term")
    stretch, pole = None, math.inf
    if "stretch" in data:
        count = len(data["stretch"])
        if count > 12:
            raise ValueError(f"{count} stretches")
        stretch, pole = _matrix(data["stretch"], count, size, size), float(data["pole"])
    return LyapunovFunction(
        _matrix(data["scale"], size, size),
        exponents.astype(np.int64),
        _matrix(data["coefficients"], terms),
        stretch,
        pole,
    )


def ellipsoid_data(found: TerminalEllipsoid) -> dict[str, Any]:
    """Return a terminal ellipsoid as JSON values."""
    return {"W": found.W.tolist(), "U": found.U.tolist(), "radius": float(found.radius)}


def ellipsoid_of(data: Mapping[str, Any]) -> TerminalEllipsoid:
    """Rebuild a terminal ellipsoid."""
    size = len(data["W"])
    W, U = _matrix(data["W"], size, size), _matrix(data["U"], size, size)
    return TerminalEllipsoid(W, U, float(data["radius"]))
