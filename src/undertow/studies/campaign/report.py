"""What a store says, in words and numbers: read chunk by chunk, whatever its size."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import RenderableType

from undertow.base import duration, number, table
from undertow.studies.campaign.run import Campaign, CampaignResult, compute
from undertow.studies.campaign.store import Store, digest

#: Numbers of shards that a sentence lists.
LISTED = 8


def status(campaign: Campaign) -> list[str]:
    """Return how far a store is, and which shards it has not."""
    marks = Store(campaign.path, campaign.key).marks()
    missing = np.flatnonzero(marks == 0).tolist()
    lines = [f"{campaign.path}: {len(marks) - len(missing)} of {len(marks)} shards"]
    return [*lines, f"not in it: {_listed(missing)}"] if missing else lines


def alone(campaign: Campaign, shard: int) -> list[str]:
    """Compute one shard in this process, and say whether the store has the same."""
    arrays = compute(campaign.definition, shard)
    found = digest(campaign.study.same_bits(arrays))
    said = "there is no store"
    if campaign.path.exists():
        mark = int(Store(campaign.path, campaign.key).marks()[shard])
        said = "the same bits as in the store" if mark == found else "the store has other bits"
        said = said if mark else "the store has it not"
    return [
        f"shard {shard} of {campaign.study.shards}, seed {campaign.study.seed}: "
        f"digest {found:016x}, {said}",
        *(f"  {name}: {_range(values)}" for name, values in arrays.items()),
    ]


def report(campaign: Campaign, outcome: CampaignResult) -> list[RenderableType]:
    """Return what came of a run: numbers of every variable, and what failed."""
    parts = tables(campaign) if outcome.done else []
    repaired = f", {len(outcome.repaired)} because they were damaged" if outcome.repaired else ""
    parts.append(
        f"{outcome.done} of {outcome.shards} shards in {campaign.path}; {outcome.computed} of them "
        f"computed now{repaired}, in {duration(outcome.seconds)}"
    )
    for shard, words in sorted(outcome.failures.items()):
        parts.append(
            f"failed: shard {shard}, seed {campaign.study.seed}: {words}; alone: --shard {shard}"
        )
    return parts


def tables(campaign: Campaign) -> list[RenderableType]:
    """Return what the store has, of any version: the tables of its kind, or a summary."""
    data = campaign.dataset()
    return campaign.study.report(data) or [summary(campaign, data)]


def summary(campaign: Campaign, data: Any) -> RenderableType:
    """Return a table of what the store has: shares of words, or ranges of numbers."""
    rows = []
    for name in campaign.study.variables:
        values, facts = data[name], data[name].attrs
        if "flag_meanings" in facts:
            words = facts["flag_meanings"].split()
            known = int((values >= 0).sum())
            for flag, word in enumerate(words):
                count = int((values == flag).sum())
                if count:
                    share = 100 * count / known
                    rows.append([f"{name}: {word}", "%", number(share, ".2f"), "", "", f"{count}"])
            continue
        good = np.isfinite(values) if values.dtype.kind == "f" else values >= 0
        kept = values.where(good)
        low, mean, high = (float(getattr(kept, what)()) for what in ("min", "mean", "max"))
        cells = [number(v, ".4g") for v in (mean, low, high)]
        rows.append([name, facts["units"], *cells, str(int(good.sum()))])
    return table(
        ["", "unit", "mean", "least", "most", "entries"], rows, title=data.attrs["title"],
        left=["unit"],
    )  # fmt: skip


def _listed(shards: list[int]) -> str:
    more = f" and {len(shards) - LISTED} more" if len(shards) > LISTED else ""
    return ", ".join(map(str, shards[:LISTED])) + more


def _range(values: Any) -> str:
    good = values[np.isfinite(values)]
    if not len(good):
        return f"{values.size} entries, none of them a number"
    return f"{values.size} entries, {good.size} numbers from {good.min():.6g} to {good.max():.6g}"
