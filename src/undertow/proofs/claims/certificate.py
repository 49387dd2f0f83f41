"""A certificate: what is proved of a mechanism's surfaces, and the file that states it.

The file (``docs/certificate-format.md``) holds the model, the laws and the numbers of each claim,
and no words.  Nothing in it is trusted: :mod:`.verify` decides every claim again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from undertow.base.artefacts import write_file
from undertow.base.errors import CertificateError
from undertow.base.files import check_file, read_file
from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.document import document_bytes, law_objects, read_document
from undertow.proofs.claims.words import sentence
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.reader import LARGEST, Document


@dataclass(frozen=True)
class StatedClaim:
    """A claim as the kernel decides it, with the verdict that was given.

    ``claim``: its numbers, exact. ``verdict``: ``undecided`` for what was only read from a file.
    """

    claim: kernel.Claim
    verdict: Verdict

    @property
    def kind(self) -> str:
        """Of which kind it is, a word of the file."""
        return self.claim.kind


@dataclass(frozen=True)
class Subject:
    """A surface with its reaching law, what is proved of it, and what is not.

    ``surface``, ``reaching``: the law. ``claims``: proved claims, or those of a file. ``remarks``:
    other verdicts, for people: no file keeps them.
    """

    surface: Surface
    reaching: ReachingLaw
    claims: tuple[StatedClaim, ...]
    remarks: tuple[Verdict, ...] = ()


@dataclass(frozen=True)
class Certificate:
    """Subjects of one mechanism, and the file that states their claims.

    ``name``: the mechanism's. ``subjects``: what is certified. ``content``: the file; empty where
    no claim is proved.
    """

    name: str
    subjects: tuple[Subject, ...]
    content: bytes = b""
    _document: Document | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        """Show whose it is and how many claims it has."""
        claims = sum(len(subject.claims) for subject in self.subjects)
        return f"Certificate({self.name}, surfaces: {len(self.subjects)}, claims: {claims})"

    def __str__(self) -> str:
        """Return a line for each claim, and for each verdict that is no proof."""
        lines = [f"{self.name}:"]
        for subject in self.subjects:
            lines.append(f"  {subject.surface}")
            verdicts = [*(claim.verdict for claim in subject.claims), *subject.remarks]
            lines += [f"    {verdict.kind}: {verdict.claim}" for verdict in verdicts]
        return "\n".join(lines)

    @classmethod
    def of(
        cls,
        mechanism: Mechanism,
        subjects: Sequence[Subject],
        versions: Mapping[str, str | None] | None = None,
    ) -> Self:
        """State the proved claims of one mechanism's surfaces; only they go into the file.

        Raises
        ------
        CertificateError
            For a claim that is not proved, or what a file cannot hold.
        """
        for verdict in (claim.verdict for subject in subjects for claim in subject.claims):
            if not verdict:
                raise CertificateError(
                    "claim of a certificate",
                    value=str(verdict),
                    limit="proved",
                    remedy="Keep it as a remark",
                )
        stated = [
            (s.surface, s.reaching, [claim.claim for claim in s.claims])
            for s in subjects
            if s.claims
        ]
        if not stated:
            return cls(mechanism.name, tuple(subjects))
        content = document_bytes(mechanism, stated, versions or {})
        return cls(mechanism.name, tuple(subjects), content, read_document(content))

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Read a file; what is damaged, edited, or of another version is refused.

        Raises
        ------
        CertificateError
            With what is wrong.
        """
        document = read_document(content)
        subjects = []
        for subject in document.subjects:
            known = [kernel.read_claim(data, document.model) for data in subject.claims]
            stated = (
                StatedClaim(c, Verdict(sentence(c, document.model), "undecided")) for c in known
            )
            subjects.append(Subject(*law_objects(subject.law), tuple(stated)))
        return cls(document.model.name, tuple(subjects), content, document)

    @property
    def document(self) -> Document:
        """What the kernel decides.

        Raises
        ------
        CertificateError
            Where no claim is proved.
        """
        if self._document is None:
            raise CertificateError(
                f"certificate of '{self.name}'",
                value="no proved claim",
                limit="at least one",
                remedy="print(certificate) says what could not be proved",
            )
        return self._document

    @property
    def parameters(self) -> dict[str, float]:
        """The mechanism's parameter values, SI units."""
        return {p.name: float(p.value or 0) for p in self.document.model.parameters}

    @property
    def input_limits(self) -> tuple[float, ...]:
        """Of the mechanism's inputs, ``inf`` for none."""
        inputs = self.document.model.inputs
        return tuple(math.inf if i.value is None else float(i.value) for i in inputs)

    def to_bytes(self) -> bytes:
        """Return the file.

        Raises
        ------
        CertificateError
            Where no claim is proved.
        """
        _ = self.document  # refused where there is none
        return self.content

    def save(self, path: str | Path) -> Path:
        """Write the file that :func:`undertow.verify` reads, and return where it is.

        Raises
        ------
        CertificateError
            Where no claim is proved.
        ArtefactError
            When it cannot be written.
        """
        return write_file(Path(path), self.to_bytes())


def read_certificate(path: Path) -> Certificate:
    """Read a certificate file.

    Raises
    ------
    ArtefactError
        When the file cannot be read, or is no plain file.
    CertificateError
        When it is too large, damaged or of another version.
    """
    remedy = "undertow certify NAME --out FOLDER writes one"
    size = check_file(path, "certificate", remedy=remedy)
    if size > LARGEST:
        raise CertificateError(
            f"certificate '{path}'", value=f"{size} bytes", limit=f"at most {LARGEST}"
        )
    content = read_file(path, "certificate", most=LARGEST, remedy=remedy)
    try:
        return Certificate.from_bytes(content)
    except CertificateError as error:
        raise CertificateError(
            f"certificate '{path}'", value=error.value, limit=error.limit, remedy=error.remedy
        ) from error
