"""What of a rig may be identified from a motion: quantities, and the order of preference."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from undertow.bring_up.motion import Record
from undertow.models import FloatArray, Mechanism, Parameter

__all__ = ["RATE", "START", "Quantity", "candidates"]

#: Names of what a record begins with: fitted, not reported.
START, RATE = "_start", "_rate"


@dataclass(frozen=True)
class Quantity:
    """A free quantity: scaled by ``scale``, counted from ``start``."""

    name: str
    unit: str
    description: str
    start: float
    scale: float
    low: float
    high: float
    nominal: float


def _beginning(record: Record) -> tuple[FloatArray, FloatArray]:
    """Return where a motion begins about its middle, and how fast, (n,) each: a first guess."""
    late = min(len(record), 20)
    slope = np.polyfit(record.t[:late] - record.t[0], record.q[:late], 1)[0]
    return record.q[:late].mean(axis=0) - record.q.mean(axis=0), slope


def candidates(mechanism: Mechanism, coulomb: float, record: Record) -> list[Quantity]:
    """Return what may be free, in order of preference.

    Delay, dry friction, damping, inertias and motor constants first; then damping that the
    model leaves out, factors of the inputs, lengths, and masses last.
    """
    levels = (
        np.abs(np.array(mechanism.input_matrix.subs(mechanism.substitution), dtype=float))
        @ mechanism.input_limits
    )
    variables = [
        Quantity("delay", "s", "from a write to its effect in a reading", 1e-3, 1e-3, 0, 0.1,
                  math.nan)
    ]  # fmt: skip
    for i, c in enumerate(mechanism.coordinates):
        unit = "N m" if c.unit == "rad" else "N"
        size = 0.01 * float(levels[i]) if i < mechanism.m else coulomb
        what = f"dry friction of {c.name}"
        variables.append(
            Quantity(f"friction_{c.name}", unit, what, 0.3 * size, size, 0, np.inf, math.nan)
        )
        if i < mechanism.m:
            what = f"what it takes besides to break {c.name} away"
            variables.append(
                Quantity(f"breakaway_{c.name}", unit, what, 0.1 * size, size, 0, np.inf, math.nan)
            )

    def of(p: Parameter) -> Quantity:
        scale = abs(p.value) or 1e-3
        return Quantity(p.name, p.unit, p.description, p.value, scale, p.low, p.high, p.value)

    ranks = {"m": 1, "kg": 2, "m/s²": 3, "": 3}
    named = [
        [of(p) for p in mechanism.parameters if ranks.get(p.unit, 0) == rank and p.value]
        for rank in range(3)
    ]
    gains = [
        Quantity(f"gain_{i.name}", "", f"factor of {i.name}", 1.0, 1.0, 0.0, np.inf, 1.0)
        for i in mechanism.inputs
    ]
    dampers = [
        Quantity(
            f"damping_{c.name}",
            "N m s/rad" if c.unit == "rad" else "N s/m",
            f"damping of {c.name} besides the model's",
            0.0,
            coulomb,
            0,
            np.inf,
            0.0,
        )
        for c in mechanism.coordinates[mechanism.m :]
    ]
    # A passive joint may still swing when the record begins.
    place, speed = _beginning(record)
    begins = [
        Quantity(f"{stem}_{c.name}", c.unit + unit, "", guess[i], scale, -np.inf, np.inf, 0.0)
        for i, c in enumerate(mechanism.coordinates)
        for stem, unit, scale, guess in ((START, "", 0.01, place), (RATE, "/s", 0.05, speed))
        if i >= mechanism.m
    ]
    motors = {str(symbol) for symbol in mechanism.input_matrix.free_symbols}
    named[0].sort(key=lambda v: v.name not in motors)
    return [*begins, *variables, *named[0], *dampers, *gains, *named[1], *named[2]]
