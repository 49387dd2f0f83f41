"""Claims, runs and verifications as tables for the terminal, and their files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from undertow.base import Verdict, inward, mark
from undertow.base import artefacts as results
from undertow.cascade import Run
from undertow.models import Mechanism
from undertow.proofs import Certificate, Checked, StatedClaim, Subject
from undertow.proofs.claims.document import document_bytes
from undertow.proofs.claims.verify import CLAIMS
from undertow.proofs.kernel import claims as kernel
from undertow.studies.certification.decide import Certified
from undertow.studies.motion import evidence_counts

_STYLES = {"proved": "green", "sampled": "yellow", "refuted": "red", "undecided": "red"}


def _table(*heads: str) -> Table:
    table = Table(box=None, header_style="dim", padding=(0, 2, 1, 0))
    for head in heads:
        table.add_column(head, vertical="top", overflow="fold")
    return table


def _claims_table() -> Table:
    table = _table("verdict", "claim", "margin")
    table.columns[0].no_wrap = True
    table.columns[2].max_width = 24
    return table


def _kind(verdict: Verdict) -> Text:
    return Text(verdict.kind, style=_STYLES[verdict.kind])


def _margin(verdict: Verdict) -> str:
    if not math.isfinite(verdict.margin):
        return ""
    return f"{inward(verdict.margin)} {verdict.unit}".rstrip()


def _witness(verdict: Verdict) -> str:
    return ", ".join(f"{k} = {v:.4g}" for k, v in verdict.witness.items())


def _claims(certified: Certified) -> Table:
    """Verdict and margin beside each claim; its worst point and its method below it."""
    table = _claims_table()
    subject = certified.subject
    for verdict in (*(c.verdict for c in subject.claims), *subject.remarks):
        words = Text(verdict.claim)
        if verdict.witness:
            words.append(f"\nat {_witness(verdict)}", style="dim")
        words.append(f"\n{verdict.method}", style="dim")
        table.add_row(_kind(verdict), words, _margin(verdict))
    return table


def subject_report(mechanism: Mechanism, certified: Certified) -> RenderableType:
    """Return all claims of one surface with verdict, margin, witness and method."""
    head = Text(f"{mechanism.name}, {certified.subject.surface}")
    seconds = Text(f"{certified.seconds:.1f} s", style="dim")
    return Group(head, "", _claims(certified), seconds)


def appendix_report(cases: Sequence[Certified]) -> RenderableType:
    """Return the appendix's five cases, one line each."""
    loops = any(c.kind == "closed loop" for case in cases for c in case.subject.claims)
    table = _table(
        "case", "stable at", "R ≻ 0 on Ĩ with our P", "terminal ball", "region on the surface",
        *(["full loop from rest"] if loops else []),
    )  # fmt: skip
    for case in cases:
        known = {c.kind: c.verdict for c in case.subject.claims}

        def cell(kind: str, known: Mapping[str, Verdict] = known) -> Text:
            if kind not in known:
                return Text("not proved", style="red")
            return Text(f"proved, {_margin(known[kind])}", style="green")

        ellipsoid = known.get("terminal ellipsoid")
        ball = "not proved"
        if ellipsoid is not None:
            ball = f"‖x‖ ≤ {inward(ellipsoid.details['ball'] * (1 - 1e-12), 2)}"
        region = cell("surface region") if case.region is not None else Text("not asked for")
        more = [region, cell("closed loop")] if loops else [region]
        table.add_row(case.title, cell("stability"), cell("appendix interval"), ball, *more)
    return table


#: Most decisions of a run that are shown one by one.
SHOWN = 12


def run_report(run: Run) -> RenderableType:
    """Return the decisions of a run with the evidence for the plan in use after each."""
    table = _table("t, s", "decision", "evidence, its margin, and the reason")
    table.columns[0].no_wrap = table.columns[1].no_wrap = True
    updates = run.updates
    shown = updates if len(updates) <= SHOWN + 1 else (*updates[:SHOWN], updates[-1])
    for update in shown:
        verdict = update.admission.verdict
        evidence = Text("none", style="red")
        if verdict is not None:
            name = verdict.details.get("evidence") or "none"
            evidence = Text(f"{name}, ") + _kind(verdict)
            if margin := _margin(verdict):
                evidence.append(f", {margin}")
        evidence.append(f"\n{update.admission.reason}", style="dim")
        decision = "admitted" if update.admission.accepted else "kept the old"
        table.add_row(f"{update.t:.2f}", decision, evidence)
    lines: list[RenderableType] = [table]
    if len(shown) < len(updates):
        lines.append(Text(f"{len(updates) - len(shown)} decisions not shown", style="dim"))
    kinds = ("region", "dual", "sampled", "local")
    counts = evidence_counts(run, dict(zip(kinds, kinds, strict=True)))
    lines.append(Text(f"{len(updates)} decisions: {counts}"))
    if np.isfinite(run.lemma3_slack).any():
        smallest = float(np.nanmin(run.lemma3_slack))
        slack = f"J̃_k − spent − J̃_k+1 = {smallest:.1e}"
        lines.append(Text(f"Lemma 3: smallest slack {slack} (≥ 0 wanted, to rounding)"))
    return Group(*lines)


def _law(subject: Subject) -> str:
    """Surface and reaching law with every digit."""
    surface, law = subject.surface, subject.reaching
    blocks = {
        k: getattr(surface, k).tolist() for k in ("alpha_a", "lambda_a", "alpha_u", "lambda_u")
    }
    return ", ".join(f"{k} = {v!r}" for k, v in blocks.items()) + (
        f"; eta = {law.eta!r}, layer = {law.layer!r}, {law.switching}"
    )


def verification_report(certificate: Certificate, checked: Sequence[Checked]) -> RenderableType:
    """Return every claim of a certificate as it was decided again, and the sum."""
    table = _claims_table()
    law = ""
    for item in checked:
        if _law(item.subject) != law:
            law = _law(item.subject)
            table.add_row("", Text(law, style="bold"), "")
        words = Text(item.verdict.claim)
        words.append(f"\n{item.claim.kind}", style="dim")
        if not item.verdict:
            words.append(f"\n{item.verdict.method}", style="red")
        table.add_row(_kind(item.verdict), words, _margin(item.verdict))
    held = sum(bool(item.verdict) for item in checked)
    values = ", ".join(f"{k} = {v!r}" for k, v in certificate.parameters.items())
    others = sum(item.reworded for item in checked)
    remarks = sum(len(s.remarks) for s in certificate.subjects)
    lines: list[RenderableType] = [
        table,
        Text(f"{certificate.name} with {values}", style="dim"),
        mark(held == len(checked)) + Text(f" {held} of {len(checked)} claims proved again"),
    ]
    if certificate.document is not None:
        alone = all(item.model == certificate.structure for item in checked)
        whose = "not compared with another" if alone else f"made again from {certificate.name}"
        lines.append(Text(f"the model is the file's own, {whose}", style="dim"))
    if others:
        note = f"the file words {others} of them otherwise: what is said here was decided"
        lines.append(Text(note, style="yellow"))
    if remarks:
        lines.append(Text(f"{remarks} remarks that are no proofs were not checked", style="dim"))
    return Group(*lines)


def certificate_files(
    mechanism: Mechanism,
    certified: Sequence[Certified],
    figures: Mapping[str, bytes] | None = None,
) -> dict[str, bytes]:
    """Return the files: ``certificate.json``, what the kernel decides; figures; ``drafts.json``.

    ``drafts.json`` is of version 1: claims of kinds that the kernel does not decide yet, and the
    remarks.  It is left out where there are none.
    """
    versions = results.versions()
    proved, drafts = [], []
    for item in certified:
        subject, known = item.subject, list[kernel.Claim]()
        rest = list[StatedClaim]()
        for claim in subject.claims:
            own = CLAIMS[claim.kind].from_dict(claim.data).stated(mechanism, claim.verdict)
            known += [] if own is None else [own]
            rest += [claim] if own is None else []
        if known:
            proved.append((subject.surface, subject.reaching, known))
        if rest:
            drafts.append(replace(subject, claims=tuple(rest)))
    files = dict(figures or {})
    if proved:
        files["certificate.json"] = document_bytes(mechanism, proved, versions)
    if drafts:
        files["drafts.json"] = Certificate.of(mechanism, drafts, versions).to_bytes()
    return files
