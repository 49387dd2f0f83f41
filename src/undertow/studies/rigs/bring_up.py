"""What a bring-up found, for a terminal and for files; how often its intervals hold the truth."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.stats
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from undertow.base import manifest, number, table, to_csv
from undertow.bring_up import BringUp, Identification, doublets, identify, perform, rest_state
from undertow.closed_loop.figures import figure_bytes, label_of, style
from undertow.mechanisms import rotary_pendulum
from undertow.models import FloatArray, Mechanism
from undertow.plants import Bench, Encoder, Friction, RealisticRig, Timing
from undertow.studies.experiment import Experiment, grouped
from undertow.studies.ledger import Key

#: Noise of the positions before they are counted, rad, standard deviation: with some, the
#: errors of the counts are nearly independent; without, they hang together for many samples.
NOISES = (1e-3, 0.0)

#: Quantities that are named of those that a held parameter changes.
SHOWN = 6

#: (estimate − truth)/(standard error), by quantity.
Deviations = dict[str, float]

#: What a motion with pushes of this voltage and these widths, s, is identified from.
PUSH, WIDTHS, PAUSE = 2.5, (0.05, 0.1, 0.2, 0.1, 0.05, 0.2, 0.15), 0.3


def rig_in_the_class(
    seed: int, noise: float = NOISES[0]
) -> tuple[Mechanism, RealisticRig, dict[str, float]]:
    """Return a belief, a rig that the wizard's model class contains, and what there is to find.

    Counted and noisy positions, dry friction, a delay, and parameters up to 10 % off, mass and
    lengths up to 5 %. ``seed``: of parameters, noise and encoder zeros. ``noise``: of the
    positions, rad.
    """
    rng = np.random.default_rng([seed, 7])
    belief = rotary_pendulum()
    off = {"I_e": 0.1, "d_e": 0.1, "a_e": 0.1, "m": 0.05, "l": 0.05, "r_o": 0.05}
    values = {p.name: p.value for p in belief.parameters}
    truth = {k: values[k] * (1 + most * rng.uniform(-1, 1)) for k, most in off.items()}
    friction = {"theta": 0.03, "phi": 0.0003}
    bench = Bench(
        belief.with_parameters(**truth),
        friction={name: Friction(level) for name, level in friction.items()},
        encoders=dict.fromkeys(friction, Encoder(2 * math.pi / 4096, noise=noise)),
        timing=Timing(0.001, measurement_delay=0.002, steps=2),
    )
    known = truth | {"delay": 0.002}
    known |= {f"friction_{name}": level for name, level in friction.items()}
    return belief, RealisticRig(bench, rest_state(belief), seed), known


def in_proportion(known: Mapping[str, float], mass: float) -> dict[str, float]:
    """Return what there is to find with a mass of the pendulum that is held, kg: without the mass.

    The motion is the same where torques, inertias and friction are so many times as large.
    """
    share = mass / known["m"]
    same = {"delay", "l", "r_o"}
    return {k: v if k in same else share * v for k, v in known.items() if k != "m"}


def deviations(seed: int, noise: float) -> Deviations:
    """Return (estimate − truth)/(standard error) of every quantity that is known.

    Of what is in proportion to the mass: in proportion to the one that was held or identified.
    """
    belief, rig, known = rig_in_the_class(seed, noise)
    u = doublets(PUSH, WIDTHS, PAUSE, rig.period)[:, None]
    identified = identify(belief, rest_state(belief), perform(rig, u, [3.0, 3.0]))
    found, mass = identified.estimates, {p.name: p.value for p in identified.mechanism.parameters}
    known = in_proportion(known, mass["m"])
    return {k: (found[k].value - v) / found[k].error for k, v in known.items() if k in found}


@dataclass(frozen=True)
class CoverageRow:
    """One quantity at one noise; ``name`` is empty for all quantities together.

    ``noise``: of the positions, rad. ``count``, ``covered``: intervals, and those that hold the
    truth. ``error``: standard error of the share that does: of a quantity, what chance makes of 95
    % in so many rigs; of all together, by the spread from rig to rig, whose intervals hang
    together. ``mean``, ``deviation``: of (estimate − truth)/(standard error): 0 and 1 where
    intervals are as they should be.
    """

    noise: float
    name: str
    count: int
    covered: int
    error: float
    mean: float
    deviation: float


def coverage(seeds: int = 20) -> Experiment[Deviations, list[CoverageRow]]:
    """Return the experiment that counts how often 95 % intervals hold the truth.

    Of ``seeds`` rigs for each of ``NOISES``.
    """
    return Experiment(
        "coverage",
        tuple[float, int, Deviations],
        {(noise, k): partial(deviations, k, noise) for noise in NOISES for k in range(seeds)},
        {},
        lambda rows: [coverage_table(rows)],
        gather=coverage_rows,
        whole=True,
    )


def coverage_rows(found: Mapping[Key, Deviations]) -> list[CoverageRow]:
    """Return how often intervals hold the truth, by noise and quantity."""
    rows = []
    for noise, rigs in grouped(found).items():
        every: dict[str, list[float]] = {}
        for name, value in (item for some in rigs for item in some.items()):
            every.setdefault(name, []).append(value)
        for name, values in every.items():
            chance = math.sqrt(0.95 * 0.05 / len(values))
            rows.append(_row(noise, name, values, chance))
        together = [value for values in every.values() for value in values]
        shares = [_covered(some.values()) / len(some) for some in rigs]
        rows.append(_row(noise, "", together, _deviation(shares) / math.sqrt(len(rigs))))
    return rows


def _covered(values: Collection[float]) -> int:
    quantile = float(scipy.stats.norm.ppf(0.975))
    return sum(abs(value) <= quantile for value in values)


def _deviation(values: list[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def _row(noise: float, name: str, values: list[float], error: float) -> CoverageRow:
    mean = float(np.mean(values))
    return CoverageRow(noise, name, len(values), _covered(values), error, mean, _deviation(values))


_STYLES = {"right": "green", "wrong": "bold red", "unclear": "yellow"}


def findings_table(found: BringUp) -> Table:
    """Return the checks as a table, but for parameters that are right."""
    rows = [
        (f.check, f.part, f.measured, f.expected, Text(f.verdict, style=_STYLES[f.verdict]))
        for f in found.findings
        if f.check != "parameter" or f.verdict != "right"
    ]
    heads = ("check", "part", "measured", "expected", "verdict")
    return table(heads, rows, left=heads, whole=("part", "verdict"))


def parameter_table(found: Identification) -> Table:
    """Return the identified quantities with half the width of their 95 % intervals."""
    rows = [
        (
            e.name,
            plus_minus(e.value, e.high - e.value),
            e.unit,
            number(e.nominal, ".4g", ""),
            e.description,
        )
        for e in found.estimates.values()
    ]
    heads = ("identified", "value, 95 %", "unit", "model", "what it is")
    note = "95 %: of noise and counting. What the model leaves out comes on top"
    return table(heads, rows, left=("unit", "what it is"), whole=heads[:4], note=note)


def coverage_table(rows: Sequence[CoverageRow]) -> Table:
    """Return how often intervals hold the truth, see :func:`undertow.studies.rigs.bring_up`."""
    cells = [
        (
            row.name or "all",
            f"{1e3 * row.noise:g}",
            str(row.count),
            f"{100 * row.covered / row.count:.1f} ± {100 * row.error:.1f} %",
            f"{row.mean:+.2f}",
            f"{row.deviation:.2f}",
        )
        for row in rows
    ]
    return table(
        ("", "noise\nmrad", "intervals", "hold the truth", "mean", "deviation"),
        cells,
        title="95 % intervals of the bring-up wizard\nSRV02 rigs that its model contains",
        note="hold the truth: ± standard error of the share\nmean, deviation: of (estimate − "
        "truth)/(standard error)\nnoise: before counting, at 1.53 mrad per count",
        ruled=True,
    )


def plus_minus(value: float, half: float) -> str:
    """Return value ± half, to two digits of the latter."""
    if not half > 0 or not math.isfinite(half):
        return f"{value:.4g}"
    power = math.floor(math.log10(max(abs(value), half)))
    shift = power if not -3 <= power < 5 else 0
    digits = max(0, 1 + shift - math.floor(math.log10(half)))
    text = f"{value / 10**shift:.{digits}f} ± {half / 10**shift:.{digits}f}"
    return f"({text})e{shift:+03d}" if shift else text


def summary(found: BringUp) -> tuple[str, ...]:
    """Return what is wrong and what to do, in lines."""
    lines = [""]
    identified = found.identification
    if identified is not None and identified.held:
        lines.append(
            f"Held at the model's values, for the motion does not tell them apart: "
            f"{', '.join(identified.held)}. The intervals are for these values."
        )
        for name, elasticity in identified.elasticities.items():
            felt = sorted(elasticity, key=lambda k: -abs(elasticity[k]))[:SHOWN]
            words = [f"{k} {elasticity[k]:+.1f} %" for k in felt if abs(elasticity[k]) >= 0.05]
            lines.append(f"  With {name} 1 % larger: {', '.join(words) or 'the same'}.")
    if not found.wrong:
        looked = (
            "" if identified is not None else " so far: delay and parameters were not looked at"
        )
        lines.append(f"Nothing is wrong{looked}.")
    lines += [f"Wrong: {f.check} of {f.part}: {f.measured}. {f.remedy}." for f in found.wrong]
    return tuple(lines)


def handed_on(
    name: str, rig: str, found: BringUp, given: Mapping[str, float] | None = None
) -> tuple[str, ...]:
    """Return the command that runs a rig with what was identified, and what the driver is to do.

    Parameters that were ``given`` a value, SI units, keep it where none was identified. Empty where
    something is wrong, which is to be mended first, or nothing was identified.
    """
    identified = found.identification
    if found.wrong or identified is None:
        return ()
    estimates, mechanism = identified.estimates, identified.mechanism
    words = ["undertow", "run", name, "--rig", rig]
    for parameter in mechanism.parameters:
        one, known = estimates.get(parameter.name), (given or {}).get(parameter.name)
        if one is not None or known is not None:
            value = f"{known!r}" if one is None else f"{one.value:.5g}"
            words += ["--set", f"{parameter.name}={value}"]
    if (late := estimates.get("delay")) is not None:
        words += ["--delay", f"{max(0.0, late.value):.2g}"]
    lines = [f"Run it with what was found: {shlex.join(words)}"]
    for channel in mechanism.inputs:
        gain = estimates.get(f"gain_{channel.name}")
        if gain is not None and not gain.low <= 1.0 <= gain.high:
            lines.append(
                f"{channel.name} comes out {gain.value:.3g} times: divide by that in the driver"
            )
    return tuple(lines)


def files(
    request: Mapping[str, object], belief: Mechanism, rest: FloatArray, found: BringUp
) -> dict[str, bytes]:
    """Return ``findings.json`` and, where there was a motion, ``motion.csv`` and its picture."""
    identified = found.identification
    estimates = {} if identified is None else identified.estimates
    facts = {
        "findings": [vars(f) for f in found.findings],
        "identified": {
            name: {"value": e.value, "low": e.low, "high": e.high, "unit": e.unit}
            for name, e in estimates.items()
        },
        "held": {} if identified is None else dict(identified.elasticities),
    }
    written = {"findings.json": manifest("undertow bench", request, **facts)}
    record = found.record
    if record is not None and identified is not None:
        names = [c.name for c in belief.coordinates]
        head = ["t", *names, *(f"{n}_predicted" for n in names), *(i.name for i in belief.inputs)]
        rows = np.column_stack([record.t, record.moved, identified.predicted, record.u])
        written["motion.csv"] = to_csv(head, rows.tolist())
        written["motion.png"] = _picture(belief, found)
    return written


def _picture(belief: Mechanism, found: BringUp) -> bytes:
    record, identified = found.record, found.identification
    assert record is not None  # the caller has looked
    assert identified is not None
    with style():
        figure = Figure(figsize=(7.0, 1.9 * (belief.n + 1)), layout="constrained")
        axes = figure.subplots(belief.n + 1, 1, sharex=True)
        t = record.t - record.t[0]
        for i, (axis, c) in enumerate(zip(axes, belief.coordinates, strict=False)):
            factor, label = label_of(c)
            axis.plot(t, factor * record.moved[:, i], lw=2.4, alpha=0.45, label="measured")
            axis.plot(t, factor * identified.predicted[:, i], lw=1.0, label="identified model")
            axis.set_ylabel(label)
        for j, channel in enumerate(belief.inputs):
            axes[-1].step(t, record.u[:, j], where="post", lw=1.0, label=channel.name)
        axes[0].legend(loc="upper right", ncols=2)
        axes[-1].set_ylabel(f"input ({belief.inputs[0].unit})")
        axes[-1].set_xlabel("time (s)")
        if belief.m > 1:
            axes[-1].legend(loc="upper right", ncols=belief.m)
        figure.align_ylabels(axes)
        return figure_bytes(figure)
