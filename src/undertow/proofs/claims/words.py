"""What a claim states, in words that are made of the numbers that the kernel decides.

The words of each kind are in its own file; here is what they have in common.  Extents, rates and
radii are rounded towards 0, ends of intervals inwards, so that no sentence says more than what is
decided; a file's own texts are never printed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import singledispatch
from typing import cast

from undertow.base.verdict import Kind, Verdict, exactly, inward, within
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.claims import Region
from undertow.proofs.kernel.model import Model, Quantity


def region_words(positions: Sequence[Quantity], box: Region) -> str:
    """Return a region of positions in words."""
    units = {p.name: p.unit for p in positions}
    parts = [
        f"|{k}| ≤ {inward(b, 6)} {units[k]}".rstrip() if a == -b
        else f"{k} in {within(a, b)} {units[k]}".rstrip()
        for k, (a, b) in box.items()
        if a != 0 or b != 0
    ]  # fmt: skip
    if not parts:
        return "at the target"
    rest = ", the other coordinates at the target" if len(parts) < len(positions) else ""
    return f"for {', '.join(parts)}{rest}"


def limits_words(model: Model) -> str:
    """Return the input limits in words, each as it is."""
    parts = [
        f"no limit on {i.name}"
        if i.value is None
        else f"|{i.name}| ≤ {exactly(i.value)} {i.unit}".rstrip()
        for i in model.inputs
    ]
    return ", ".join(parts)


@singledispatch
def sentence(claim: kernel.Claim, model: Model) -> str:
    """Return the statement of a claim about a model, in words: each kind's file has its own."""
    raise TypeError(f"no words for a claim of the kind {claim.kind!r}")


def verdict_on(
    claim: kernel.Claim,
    model: Model,
    found: kernel.Decision,
    margin: float = math.nan,
    unit: str = "",
) -> Verdict:
    """Return what the kernel said of a claim, with the sentence that it decided."""
    kind, said = cast(Kind, found.kind), sentence(claim, model)
    return Verdict(said, kind, margin, unit, found.witness, found.why, found.details)
