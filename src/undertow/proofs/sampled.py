"""Sampled regions: what random trials say of a closed loop, with their confidence.

No proof.  N independent starts, k of which fail to converge, bound the probability p of failure
under the distribution of starts: p ≤ the Clopper-Pearson bound, the quantile of a beta
distribution, with the stated confidence, whatever p is.  It says nothing of any single start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from undertow.base.arguments import require
from undertow.base.verdict import Verdict
from undertow.closed_loop.rollout import ClosedLoop
from undertow.closed_loop.trajectory import Event
from undertow.law import Surface
from undertow.models.mechanism import FloatArray, Mechanism

#: Draws starts x0, (N, 2n), from a generator.
Sampler = Callable[[np.random.Generator, int], FloatArray]


def failure_bound(failures: int, trials: int, confidence: float = 0.999) -> float:
    """Return the one-sided Clopper-Pearson upper bound on a probability of failure.

    ``failures``, ``trials``: 0 ≤ failures ≤ trials, trials ≥ 1. ``confidence``: in (0, 1). Raises
    InvalidInputError for numbers outside these ranges.

    Examples
    --------
    >>> round(failure_bound(0, 3000, 0.95), 5)  # about 3 / N
    0.001
    """
    good = 0 <= failures <= trials and trials >= 1
    require(good, "trials", f"{failures} of {trials}", "0 ≤ k ≤ N, N ≥ 1")
    require(0 < confidence < 1, "confidence", confidence, "in (0, 1)")
    if failures == trials:
        return 1.0
    import scipy.stats  # takes half a second

    return float(scipy.stats.beta.ppf(confidence, failures + 1, trials - failures))


def box_starts(mechanism: Mechanism, **ranges: tuple[float, float]) -> Sampler:
    """Return a uniform distribution of starts over named states, the others at the target.

    Raises
    ------
    InvalidInputError
        For an unknown state or an empty range.
    """
    names = mechanism.state_names
    low, high = np.zeros(2 * mechanism.n), np.zeros(2 * mechanism.n)
    for name, (a, b) in ranges.items():
        limit = f"one of {', '.join(names)}"
        require(name in names and a <= b, "range of starts", f"{name}: {(a, b)}", limit)
        low[names.index(name)], high[names.index(name)] = a, b
    return lambda rng, count: rng.uniform(low, high, (count, len(low)))


def sampled_region(
    loop: ClosedLoop,
    surface: Surface,
    starts: Sampler,
    *,
    trials: int = 10_000,
    confidence: float = 0.999,
    seed: int = 0,
    what: str = "random starts",
) -> Verdict:
    """Decide by random trials whether starts converge.

    Parameters
    ----------
    loop
        The closed loop with its plant, input limits, hold, constraints and horizon: a trial
        succeeds if its terminal set is reached within the horizon.
    starts
        The distribution of starts.
    trials, confidence, seed
        Number of trials, confidence of the bound, seed.
    what
        The starts in words, for the claim.

    Returns
    -------
    Verdict
        ``sampled``: no trial failed; the margin is the bound's complement, the least
        probability of convergence; the witness is the start that took longest.
        ``refuted``: the witness is a start that failed, the margin −(share that failed).
    """
    x0 = starts(np.random.default_rng(seed), trials)
    batch = loop.batch(x0, surface)
    failed = ~batch.reached
    count = int(failed.sum())
    worst = int(np.argmax(batch.time + np.where(failed, 1e9, 0.0)))
    bound = failure_bound(count, trials, confidence)
    witness = dict(zip(loop.mechanism.state_names, x0[worst].tolist(), strict=True))
    horizon = f"{loop.objective.horizon:g} s"
    claim = f"{what} arrive within {horizon} under the clipped law, constraints and travel kept"
    details = {
        "trials": trials,
        "failures": count,
        "confidence": confidence,
        "failure_bound": bound,
        "event": Event(int(batch.event[worst])).name,
        "time": float(batch.time[worst]),
        "seed": seed,
    }
    method = f"{trials} random rollouts, Clopper-Pearson bound at confidence {confidence:g}"
    if count:
        return Verdict(claim, "refuted", -count / trials, "", witness, method, details)
    return Verdict(claim, "sampled", 1 - bound, "", witness, method, details)


def sampled_extent(
    loop: ClosedLoop,
    surface: Surface,
    coordinate: str,
    reach: float,
    *,
    grid: int = 400,
    trials: int = 10_000,
    confidence: float = 0.999,
    seed: int = 0,
) -> Verdict:
    """Find how far a coordinate may be off the target, at rest, by random trials.

    A grid finds the first start that fails; then fresh random starts within the last good one
    make the statement.

    Returns
    -------
    Verdict
        As :func:`sampled_region`, with ``details["extent"]`` the largest |coordinate|.

    Raises
    ------
    InvalidInputError
        For an unknown coordinate.
    """
    names: Mapping[str, int] = {c.name: i for i, c in enumerate(loop.mechanism.coordinates)}
    require(coordinate in names, "coordinate", coordinate, f"one of {', '.join(names)}")
    x0 = np.zeros((grid, 2 * loop.mechanism.n))
    x0[:, names[coordinate]] = np.linspace(reach / grid, reach, grid)
    reached = loop.batch(x0, surface).reached
    last = grid if reached.all() else int(np.argmin(reached))
    extent = last * reach / grid
    starts = box_starts(loop.mechanism, **{coordinate: (-extent, extent)})
    what = f"starts at rest with |{coordinate}| ≤ {extent:.6g}"
    verdict = sampled_region(
        loop, surface, starts, trials=trials, confidence=confidence, seed=seed, what=what
    )
    return replace(verdict, details={**verdict.details, "extent": extent})
