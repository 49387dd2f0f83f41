"""How often the bring-up wizard's 95 % intervals hold the truth, over many simulated rigs."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.stats

from undertow.base import ArtefactError, parse_json, read_file, versions
from undertow.bring_up.identify import identify
from undertow.bring_up.motion import doublets, perform
from undertow.bring_up.rest import rest_state
from undertow.mechanisms import rotary_pendulum
from undertow.models import Mechanism
from undertow.plants import Bench, Encoder, Friction, RealisticRig, Timing

__all__ = ["NOISES", "CoverageRow", "coverage", "deviations", "rig_in_the_class"]

#: Noise of the positions before they are counted, rad, standard deviation: with some, the
#: errors of the counts are nearly independent; without, they hang together for many samples.
NOISES = (1e-3, 0.0)

#: Largest file of rigs that is read, bytes.
LARGEST = 1 << 28

#: What a motion with pushes of this voltage and these widths, s, is identified from.
PUSH, WIDTHS, PAUSE = 2.5, (0.05, 0.1, 0.2, 0.1, 0.05, 0.2, 0.15), 0.3


def rig_in_the_class(
    seed: int, noise: float = NOISES[0]
) -> tuple[Mechanism, RealisticRig, dict[str, float]]:
    """Return a belief, a rig that the wizard's model class contains, and what is true of it.

    Counted and noisy positions, dry friction, a delay, and parameters up to 10 % off.

    Parameters
    ----------
    seed
        Of parameters, noise and encoder zeros.
    noise
        Of the positions, rad.
    """
    rng = np.random.default_rng([seed, 7])
    belief = rotary_pendulum()
    truth = {"I_e": 0.0036, "d_e": 0.073, "a_e": 0.1285}
    truth = {k: v * (1 + 0.1 * rng.uniform(-1, 1)) for k, v in truth.items()}
    friction = {"theta": 0.03, "phi": 0.0003}
    bench = Bench(
        belief.with_parameters(**truth),
        friction={name: Friction(level) for name, level in friction.items()},
        encoders=dict.fromkeys(friction, Encoder(2 * math.pi / 4096, noise=noise)),
        timing=Timing(0.001, measurement_delay=0.002, steps=2),
    )
    known = truth | {"delay": 0.002, "l": 0.1675, "r_o": 0.215}
    known |= {f"friction_{name}": level for name, level in friction.items()}
    return belief, RealisticRig(bench, rest_state(belief), seed), known


def deviations(seed: int, noise: float) -> dict[str, float]:
    """Return (estimate − truth)/(standard error) of every quantity that is known."""
    belief, rig, known = rig_in_the_class(seed, noise)
    u = doublets(PUSH, WIDTHS, PAUSE, rig.period)[:, None]
    found = identify(belief, rest_state(belief), perform(rig, u, [3.0, 3.0])).estimates
    return {k: (found[k].value - v) / found[k].error for k, v in known.items() if k in found}


@dataclass(frozen=True)
class CoverageRow:
    """One quantity at one noise; ``name`` is empty for all quantities together.

    Attributes
    ----------
    noise
        Of the positions, rad.
    name
        Of the quantity.
    count, covered
        Intervals, and those that hold the truth.
    error
        Standard error of the share that does: of a quantity, what chance makes of 95 % in so
        many rigs; of all together, by the spread from rig to rig, whose intervals hang together.
    mean, deviation
        Of (estimate − truth)/(standard error): 0 and 1 where intervals are as they should be.
    """

    noise: float
    name: str
    count: int
    covered: int
    error: float
    mean: float
    deviation: float


def coverage(
    seeds: int,
    *,
    keep: Path | None = None,
    progress: Callable[[str, float], None] = lambda _what, _part: None,
) -> list[CoverageRow]:
    """Identify many rigs and count how often 95 % intervals hold the truth.

    Parameters
    ----------
    seeds
        Rigs for each of ``NOISES``.
    keep
        A file that keeps every rig as it is done: what it holds already is not done again.
    progress
        Called with what is being done and the part done.

    Raises
    ------
    ArtefactError
        When the file is of other versions.
    """
    known = _kept(keep)
    rows = []
    for number, noise in enumerate(NOISES):
        every: dict[str, list[float]] = {}
        shares = []
        for seed in range(seeds):
            progress(f"noise {1e3 * noise:g} mrad", (number + seed / seeds) / len(NOISES))
            if (noise, seed) not in known:
                known[noise, seed] = deviations(seed, noise)
                if keep is not None:
                    with keep.open("a", encoding="utf-8") as file:
                        file.write(json.dumps([noise, seed, known[noise, seed]]) + "\n")
            found = known[noise, seed]
            shares.append(_covered(found.values()) / len(found))
            for name, value in found.items():
                every.setdefault(name, []).append(value)
        together = [value for values in every.values() for value in values]
        for name, values in every.items():
            chance = math.sqrt(0.95 * 0.05 / len(values))
            rows.append(_row(noise, name, values, chance))
        rows.append(_row(noise, "", together, _deviation(shares) / math.sqrt(seeds)))
    return rows


def _covered(values: Collection[float]) -> int:
    quantile = float(scipy.stats.norm.ppf(0.975))
    return sum(abs(value) <= quantile for value in values)


def _deviation(values: list[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def _row(noise: float, name: str, values: list[float], error: float) -> CoverageRow:
    mean = float(np.mean(values))
    return CoverageRow(noise, name, len(values), _covered(values), error, mean, _deviation(values))


def _kept(path: Path | None) -> dict[tuple[float, int], Mapping[str, float]]:
    """Read what was done already, and begin the file where there is none."""
    if path is None:
        return {}
    if not os.path.lexists(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(versions()) + "\n", encoding="utf-8")
        return {}
    try:
        head, *lines = read_file(path, "rigs done in", most=LARGEST).decode("utf-8").splitlines()
        if parse_json(head) == versions():
            rows = [parse_json(line) for line in lines]
            return {
                (float(noise), int(seed)): {str(k): float(v) for k, v in found.items()}
                for noise, seed, found in rows
            }
        why = "of other versions"
    except ArtefactError:
        raise
    except (OSError, ValueError, TypeError, AttributeError, OverflowError) as error:
        why = f"{type(error).__name__}: {error}"
    raise ArtefactError(
        f"rigs done in '{path}'",
        value=why,
        limit="a file of this build",
        remedy="Name another folder, or remove the file",
    )
