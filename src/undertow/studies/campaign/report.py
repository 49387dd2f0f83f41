"""What a store says, in words and numbers: read chunk by chunk, whatever its size."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import RenderableType

from undertow.base import duration, number, table
from undertow.studies.campaign.run import Campaign, CampaignResult, compute, study_of
from undertow.studies.campaign.store import Store, digest, loaded
from undertow.studies.campaign.study import Arrays
from undertow.symbolic import processor

#: Numbers of shards that a sentence lists.
LISTED = 8


def status(campaign: Campaign) -> list[str]:
    """Return how far a store is, which shards it has not, and which are damaged."""
    store = Store(campaign.path, campaign.key, campaign.about)
    marks, damaged = store.marks(), store.damaged(campaign.study)
    missing = np.flatnonzero(marks == 0).tolist()
    done = len(marks) - len(missing) - len(damaged)
    lines = [f"{campaign.path}: {done} of {len(marks)} shards", *_damage(damaged)]
    return [*lines, f"not in it: {_listed(missing)}"] if missing else lines


def _damage(shards: list[int]) -> list[str]:
    """Say which shards are damaged, and what to do."""
    words = f"damaged: shards {_listed(shards)}; --resume computes them again"
    return [words] if shards else []


def alone(campaign: Campaign, shard: int) -> list[str]:
    """Compute one shard in this process, and say whether the store has the same."""
    study = study_of(campaign.definition)
    study.notes.clear()
    arrays = compute(campaign.definition, shard)
    found = digest(campaign.study.same_bits(arrays))
    said = "there is no store"
    if campaign.path.exists():
        store = Store(campaign.path, campaign.key, campaign.about)
        mark = int(store.marks()[shard])
        said = "the same bits as in the store" if mark else "the store has it not"
        if mark == found and not store.has(campaign.study, shard, mark):
            said = "the store had the same bits, but is damaged there: go on with --resume"
        elif mark not in (0, found):
            said = f"the store has other bits: {_difference(campaign, store, shard, arrays)}"
    return [
        f"shard {shard} of {campaign.study.shards}, seed {campaign.study.seed}: "
        f"digest {found:016x}, {said}",
        *(f"  {name}: {_range(values)}" for name, values in arrays.items()),
        *study.notes,
    ]


def _difference(campaign: Campaign, store: Store, shard: int, arrays: Arrays) -> str:
    """Return where a shard is not what the store has, by how much, and on what processor."""
    there = campaign.study.same_bits(store.read(campaign.study, shard))
    parts = []
    for name, values in campaign.study.same_bits(arrays).items():
        here, other = values.astype(float), there[name].astype(float)
        unlike = ~((here == other) | (np.isnan(here) & np.isnan(other)))
        if unlike.any():
            most = np.abs(here - other)[unlike].max()
            parts.append(f"{name} at {unlike.sum()} of {unlike.size}, by {most:.2g} at most")
    begun, this = store.about.get("processor", "not recorded"), processor()["processor"]
    if begun != this:
        parts.append(f"it was begun on another processor, {begun}; this is {this}")
    return "; ".join(parts) or "its mark is not that of its arrays"


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
    data = loaded(campaign.path, campaign.dataset())
    parts = campaign.study.report(data) or [summary(campaign, data)]
    return [*parts, *_damage(Store(campaign.path).damaged(campaign.study))]


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
