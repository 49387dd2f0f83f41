"""Claims, runs and verifications as tables for the terminal, and their files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from undertow.base import Verdict, facts, inward, mark
from undertow.base import artefacts as results
from undertow.cascade import Run
from undertow.models import Mechanism
from undertow.proofs import Certificate, Checked, Subject
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


def _claims(certified: Certified) -> Table:
    """Verdict and margin beside each claim; its worst point and its method below it."""
    table = _claims_table()
    subject = certified.subject
    for verdict in (*(c.verdict for c in subject.claims), *subject.remarks):
        words = Text(verdict.claim)
        if verdict.witness:
            where = ", ".join(f"{k} = {v:.4g}" for k, v in verdict.witness.items())
            words.append(f"\nat {where}", style="dim")
        words.append(f"\n{verdict.method}", style="dim")
        table.add_row(_kind(verdict), words, _margin(verdict))
    return table


def subject_report(mechanism: Mechanism, certified: Certified) -> RenderableType:
    """Return all claims of one surface with verdict, margin, witness and method.

    What they leave out of a bench stands above them.
    """
    lines: list[RenderableType] = [Text(f"{mechanism.name}, {certified.subject.surface}"), ""]
    if certified.left_out:
        lines += [
            Text("In no proof below. Runs on random rigs, sampled, have all but other surfaces:"),
            facts(certified.left_out.items()), "",
        ]  # fmt: skip
    spent = f"{certified.seconds:.1f} s"
    if certified.region is not None:
        search = certified.region.search_seconds
        proof = certified.region_seconds - search
        spent += f", of which {search:.1f} s searched for the region and {proof:.1f} s proved it"
    return Group(*lines, _claims(certified), Text(spent, style="dim"))


def appendix_report(cases: Sequence[Certified]) -> RenderableType:
    """Return the appendix's five cases, one line each."""
    loops = any(c.kind == "closed loop" for case in cases for c in case.subject.claims)
    table = _table(
        "case", "stable at", "R ≻ 0 on Ĩ with our P", "terminal ball", "region on the surface",
        *(["full loop from rest"] if loops else []),
    )  # fmt: skip
    for case in cases:
        known = {c.kind: c.verdict for c in case.subject.claims}

        def cell(verdict: Verdict | None) -> Text:
            if not verdict:
                return Text("not proved", style="red")
            return Text(f"proved, {_margin(verdict)}", style="green")

        ellipsoid = known.get("terminal ellipsoid")
        ball = "not proved"
        if ellipsoid is not None:
            ball = f"‖x‖ ≤ {inward(ellipsoid.details['ball'] * (1 - 1e-12), 2)}"
        region = (
            cell(known.get("surface region")) if case.region is not None else Text("not asked for")
        )
        more = [region, cell(known.get("closed loop"))] if loops else [region]
        table.add_row(case.title, cell(known.get("stability")), cell(case.interval), ball, *more)
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
    lines: list[RenderableType] = [
        table,
        Text(f"{certificate.name} with {values}", style="dim"),
        mark(held == len(checked)) + Text(f" {held} of {len(checked)} claims proved again"),
    ]
    alone = all(item.model == certificate.document.model_hash for item in checked)
    whose = "not compared with another" if alone else f"made again from {certificate.name}"
    lines.append(Text(f"the model is the file's own, {whose}", style="dim"))
    return Group(*lines)


def certificate_files(
    mechanism: Mechanism, certified: Sequence[Certified], figures: Mapping[str, bytes] | None = None
) -> dict[str, bytes]:
    """Return the files: ``certificate.json``, where a claim is proved, and the figures."""
    certificate = Certificate.of(mechanism, [c.subject for c in certified], results.versions())
    files = dict(figures or {})
    if certificate.content:
        files["certificate.json"] = certificate.content
    return files
