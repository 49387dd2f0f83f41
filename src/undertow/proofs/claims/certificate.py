"""The certificate file: claims as plain numbers, which anyone can check again.

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

Nothing in the file is trusted: :mod:`undertow.proofs.claims.verify` decides every claim again and
states what it decided in sentences of its own; those in the file are for readers and never shown.
Texts with characters that cannot be printed are refused.  The checksum guards against accidents
and careless edits; a forged claim is caught by its proof.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from undertow.base.artefacts import write_file
from undertow.base.errors import CertificateError, UndertowError, error_text
from undertow.base.files import check_file, parse_json, read_file
from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.claim import Claim, floats_of
from undertow.proofs.claims.document import json_bytes, law_objects, read_document
from undertow.proofs.kernel.claims import read_claim
from undertow.proofs.kernel.reader import Document

FORMAT, VERSION = "undertow-certificate", 1

#: Largest file that is read, bytes; a certificate of the appendix has some ten thousand.
LARGEST = 4_000_000

#: Longest name of a mechanism, a parameter or a kind of claim that is read.
LONGEST_NAME = 64


#: What reading broken data raises.
_BROKEN = (LookupError, TypeError, ValueError, ArithmeticError, RecursionError)

_BLOCKS = ("alpha_a", "lambda_a", "alpha_u", "lambda_u")


def _error(value: str, limit: object, remedy: str = "") -> CertificateError:
    return CertificateError("certificate", value=value, limit=limit, remedy=remedy)


@dataclass(frozen=True)
class StatedClaim:
    """A claim about a subject as a certificate states it.

    Parameters
    ----------
    kind
        Of which kind it is, see :data:`undertow.proofs.claims.verify.CLAIMS`.
    data
        Its numbers, as JSON values.
    verdict
        The verdict that was given; only ``proved`` ones become claims of a certificate.
    """

    kind: str
    data: Mapping[str, Any]
    verdict: Verdict

    @classmethod
    def of(cls, claim: Claim, verdict: Verdict) -> Self:
        """State a claim with its verdict."""
        return cls(claim.kind, claim.to_dict(), verdict)


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
    claims: tuple[StatedClaim, ...]
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
    document
        What the kernel decides, for a file of version 2.
    """

    name: str
    structure: str
    parameters: Mapping[str, float]
    input_limits: tuple[float, ...]
    subjects: tuple[Subject, ...]
    versions: Mapping[str, str | None] = field(default_factory=dict)
    document: Document | None = None

    def __repr__(self) -> str:
        """Show whose it is and how many claims are proved."""
        claims = sum(len(subject.claims) for subject in self.subjects)
        return f"Certificate({self.name}, surfaces: {len(self.subjects)}, proved claims: {claims})"

    def __str__(self) -> str:
        """Return a line for each claim, and for each verdict that is no proof."""
        lines = [f"{self.name}:"]
        for subject in self.subjects:
            lines.append(f"  {subject.surface}")
            verdicts = [*(claim.verdict for claim in subject.claims), *subject.remarks]
            lines += [f"    {verdict.kind}: {verdict.claim}" for verdict in verdicts]
        return "\n".join(lines)

    def save(self, path: str | Path) -> Path:
        """Write the file that :func:`undertow.verify` reads, and return where it is.

        Raises
        ------
        ArtefactError
            When it cannot be written.
        """
        return write_file(Path(path), self.to_bytes())

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
        return json_bytes(document)

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Read a file; what is damaged, edited, or of an unknown version is refused.

        Raises
        ------
        CertificateError
            With what is wrong.
        """
        document = _parse(content)
        if document.get("version") == 2:
            return cls._from_kernel(read_document(content))
        if document.get("format") != FORMAT:
            raise _error(f"format {document.get('format')!r}", repr(FORMAT))
        if document.get("version") != VERSION:
            remedy = "Certify again with this version of Undertow, or verify with that one"
            raise _error(f"version {document.get('version')!r}", VERSION, remedy)
        if document.get("checksum") != _checksum(document):
            value, limit = "a checksum that does not fit its content", "the file as it was written"
            raise _error(value, limit, "It was edited or damaged; certify again")
        try:
            return cls._from_document(document)
        except (UndertowError, AttributeError, *_BROKEN) as error:
            value = error_text(error)
            raise _error(value, "complete, with numbers of the right shapes") from error

    @classmethod
    def _from_kernel(cls, document: Document) -> Self:
        model = document.model
        subjects = []
        for subject in document.subjects:
            known = [read_claim(data, model) for data in subject.claims]
            stated = tuple(
                StatedClaim(c.kind, c.data(), Verdict(c.sentence(model), "undecided"))
                for c in known
            )
            subjects.append(Subject(*law_objects(subject.law), stated))
        return cls(
            model.name,
            document.model_hash,
            {p.name: float(p.value or 0) for p in model.parameters},
            tuple(math.inf if i.value is None else float(i.value) for i in model.inputs),
            tuple(subjects),
            dict(document.made_with),
            document,
        )

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
        remedy = "The file is damaged or something else; certify again"
        limit = "JSON as undertow certify writes it"
        raise _error(str(error) or type(error).__name__, limit, remedy) from error
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
    """Return a name of a mechanism, a parameter or a kind of claim; long ones are refused."""
    name = str(text)
    if len(name) > LONGEST_NAME:
        raise ValueError(f"a name of {len(name)} characters")
    return name


def _printable(text: str) -> str:
    """Return a text on one line without what cannot be printed."""
    return "".join(c for c in " ".join(text.split()) if c.isprintable())


def _checksum(document: Mapping[str, Any]) -> str:
    """SHA-256 of the canonical JSON of everything but the checksum."""
    rest = {k: v for k, v in document.items() if k != "checksum"}
    try:
        text = json.dumps(
            rest, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
        )
    except (ValueError, TypeError, RecursionError) as error:
        raise _error(str(error), "finite numbers, texts and lists alone") from error
    return hashlib.sha256(text.encode()).hexdigest()


def _subject_data(subject: Subject) -> dict[str, Any]:
    surface, law = subject.surface, subject.reaching
    eta, layer = law.per_surface(surface.m)
    return {
        "surface": {name: getattr(surface, name).tolist() for name in _BLOCKS},
        "reaching": {"eta": eta.tolist(), "layer": layer.tolist(), "switching": law.switching},
        "claims": [
            {"kind": c.kind, "data": dict(c.data), "verdict": _verdict_data(c.verdict)}
            for c in subject.claims
        ],
        "remarks": [_verdict_data(v) for v in subject.remarks],
    }


def _subject_of(data: Mapping[str, Any]) -> Subject:
    law = data["reaching"]
    rows = (floats_of(law[k]) for k in ("eta", "layer"))
    eta, layer = (row[0] if len(row) == 1 else row for row in rows)
    return Subject(
        Surface(**{k: data["surface"][k] for k in _BLOCKS}),
        ReachingLaw(eta, layer, law["switching"]),
        tuple(
            StatedClaim(_name(c["kind"]), dict(c["data"]), _verdict_of(c["verdict"]))
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
