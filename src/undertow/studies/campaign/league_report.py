"""The league table: who wins where, at what cost, with confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from undertow.base import number, table
from undertow.models import FloatArray

#: Of the normal distribution, two-sided 95 %; draws of the bootstrap.
Z95, DRAWS = 1.959963984540054, 2000


def wilson(won: int, runs: int) -> tuple[float, float]:
    """Return the 95 % interval of a probability after so many of so many runs (Wilson 1927).

    >>> [round(p, 3) for p in wilson(9, 10)]
    [0.596, 0.982]
    """
    if not runs:
        return 0.0, 1.0
    z2 = Z95**2 / runs
    middle = (won / runs + z2 / 2) / (1 + z2)
    half = math.sqrt(z2 * (won / runs * (1 - won / runs) + z2 / 4)) / (1 + z2)
    return max(0.0, middle - half), min(1.0, middle + half)


def median_interval(values: FloatArray) -> tuple[float, float, float]:
    """Return the median and its 95 % interval by the bootstrap; NaN of nothing."""
    if not len(values):
        return math.nan, math.nan, math.nan
    draws = np.random.default_rng(0).choice(values, (DRAWS, len(values)))
    low, high = np.quantile(np.median(draws, axis=1), [0.025, 0.975])
    return float(np.median(values)), float(low), float(high)


def words(data: Any, name: str) -> list[str]:
    """Return what the numbers along a dimension stand for."""
    found: list[str] = data[name].attrs["flag_meanings"].split()
    return found


def tables(data: Any) -> list[RenderableType]:
    """Return the league table of a store, an ``xarray.Dataset``: of what is finished."""
    mechanisms, entrants, tasks = (words(data, k) for k in ("mechanism", "entrant", "task"))
    won = np.asarray(data.won.values)
    cost = np.asarray(data.cost.values)
    # Entrant 0 is hindsight; a cost counts where the run was won.
    ratio = np.where(won[:, 1:] == 1, cost[:, 1:] / cost[:, :1], np.nan)
    won = won[:, 1:]
    names = entrants[1:]
    total = _scores(names, won, ratio, data)
    return [
        total,
        _shares("Runs won, %, by task", tasks, names, won.transpose(2, 1, 0, 3)),
        _shares("Runs won, %, by mechanism", mechanisms, names, won),
        _best(mechanisms, tasks, names, won, ratio),
    ]


def _scores(names: list[str], won: NDArray[Any], ratio: FloatArray, data: Any) -> RenderableType:
    """Return the table of all runs, the most won first."""
    mean, most = (np.asarray(data[k].values)[:, 1:] for k in ("step_mean", "step_most"))
    fault = np.asarray(data.fault.values)[:, 1:]
    rows, forfeits = [], dict[str, int]()
    for k, name in enumerate(names):
        runs, wins = int((won[:, k] >= 0).sum()), int((won[:, k] == 1).sum())
        low, high = wilson(wins, runs)
        good = ratio[:, k][np.isfinite(ratio[:, k])]
        middle, least, largest = median_interval(good)
        forfeits[name] = int((fault[:, k] > 0).sum())
        rows.append((
            -wins / max(runs, 1), middle if len(good) else math.inf,
            [
                name, f"{wins} of {runs}", f"{100 * low:.0f}-{100 * high:.0f}",
                number(middle, ".2f"), f"{least:.2f}-{largest:.2f}" if len(good) else "—",
                number(_over(good, np.max), ".2f"), number(1e6 * _over(mean[:, k], np.mean), ".0f"),
                number(1e3 * _over(most[:, k], np.max), ".1f"),
            ],
        ))  # fmt: skip
    gave_none = ", ".join(f"{name} in {count}" for name, count in forfeits.items() if count)
    heads = ["entrant", "won", "95 %", "cost", "95 %", "worst", "step, µs", "most, ms"]
    return table(
        heads,
        [cells for *_, cells in sorted(rows, key=lambda row: row[:2])],
        whole=heads,
        title=f"Entrants: {len(names)}. Mechanisms: {data.sizes['mechanism']}",
        note="cost: of won runs, over the plant's own bound: median, 95 % of it, worst\n"
        "step: processor time of a call, one a millisecond; mean, and the longest"
        + (f"\nforfeited runs: {gave_none}; --shard says why" if gave_none else ""),
    )


def _shares(title: str, names: list[str], heads: list[str], won: NDArray[Any]) -> RenderableType:
    """Return shares of won runs; ``won`` is (name, head, …)."""
    rows = []
    for name, line in zip(names, won, strict=True):
        runs, wins = (line >= 0).sum(axis=(1, 2)), (line == 1).sum(axis=(1, 2))
        parts = [100 * w / r if r else None for w, r in zip(wins, runs, strict=True)]
        rows.append([name.replace("_", " "), *(number(part, ".0f") for part in parts)])
    return table(["", *heads], rows, title=title)


def _best(
    mechanisms: list[str], tasks: list[str], names: list[str], won: NDArray[Any], ratio: FloatArray
) -> RenderableType:
    """Return who is first in each cell: most runs won, then least cost of those."""
    rows = []
    for i, mechanism in enumerate(mechanisms):
        cells = []
        for j in range(len(tasks)):
            places = []
            for k, name in enumerate(names):
                good = ratio[i, k, j][np.isfinite(ratio[i, k, j])]
                middle = float(np.median(good)) if len(good) else math.inf
                places.append((-int((won[i, k, j] == 1).sum()), middle, name))
            wins, middle, name = min(places)
            cells.append(name if wins else "—")
        rows.append([mechanism.replace("_", " "), *cells])
    return table(
        ["", *tasks], rows, title="First in each cell",
        note="most runs won, among those the least cost; —: nobody won", left=tasks,
    )  # fmt: skip


def _over(values: FloatArray, what: Callable[[FloatArray], Any]) -> float:
    """Return the mean, say, of the values that are known; NaN of none."""
    good = values[np.isfinite(values)]
    return float(what(good)) if len(good) else math.nan
