"""The certificate's file: written from claims that were proved, read and decided by the kernel."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

from undertow.base.errors import CertificateError
from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, Surface
from undertow.models.mechanism import Mechanism
from undertow.proofs.claims.model_data import law_data, model_data
from undertow.proofs.claims.words import verdict_on
from undertow.proofs.claims.written import claim_data
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.model import Law
from undertow.proofs.kernel.reader import FORMAT, VERSION, Document, Refused, digest, read


def document_bytes(
    mechanism: Mechanism,
    subjects: Sequence[tuple[Surface, ReachingLaw, Sequence[kernel.Claim]]],
    versions: Mapping[str, str | None],
) -> bytes:
    """Return the file; every number in it is exact.  Whoever keeps it reads it first.

    Raises CertificateError for a model or a law that a certificate cannot hold.
    """
    model = model_data(mechanism)
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "model": model,
        "model_hash": digest(model),
        "subjects": [
            {
                "law": law_data(mechanism, surface, law),
                "claims": [claim_data(claim) for claim in claims],
            }
            for surface, law, claims in subjects
        ],
        "made_with": {k: v if v is None else v[:64] for k, v in versions.items()},
    }
    document["checksum"] = digest(document)
    return json_bytes(document)


def json_bytes(document: Mapping[str, Any]) -> bytes:
    """Return the text of a certificate: a line for each innermost list.

    No text of a certificate has a bracket's line break inside.
    """

    def on_one_line(found: re.Match[str]) -> str:
        return "[" + re.sub(r"\n\s+", " ", found[1]) + "]"

    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    return (re.sub(r"\[\n\s+([^\[\]{}]*?)\n\s+\]", on_one_line, text) + "\n").encode()


def read_document(content: bytes) -> Document:
    """Read a file, its claims too.

    Raises CertificateError for what is damaged or unknown.
    """
    try:
        document = read(content)
        for subject in document.subjects:
            for data in subject.claims:
                kernel.read_claim(data, document.model)
    except Refused as error:
        raise CertificateError(
            "certificate",
            value=str(error),
            limit="as docs/certificate-format.md says",
            remedy="It was edited or damaged, or is of another version: certify again",
        ) from error
    return document


def law_objects(law: Law) -> tuple[Surface, ReachingLaw]:
    """Return a law of a file as the objects that it was written from."""
    surface = Surface(
        *([[float(v) for v in row] for row in block]
          for block in (law.alpha_a, law.lambda_a, law.alpha_u, law.lambda_u))
    )  # fmt: skip
    eta, layer = (tuple(map(float, v)) for v in (law.eta, law.layer))
    one = len(eta) == 1
    return surface, ReachingLaw(
        eta[0] if one else eta, layer[0] if one else layer, cast(Any, law.switching)
    )


def decide_document(
    document: Document, progress: Callable[[str, float], None] | None = None
) -> list[tuple[Law, kernel.Claim, Verdict]]:
    """Decide all claims of a file: from the file alone."""
    decided = []
    for law, claim, answer in kernel.check(document, progress):
        decided.append((law, claim, verdict_on(claim, document.model, answer)))
    return decided
