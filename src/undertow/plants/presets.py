"""Benches with published numbers."""

from __future__ import annotations

import math

from undertow.mechanisms import rotary_pendulum
from undertow.models import Mechanism, Parameter
from undertow.plants.bench import Amplifier, Bench, Encoder, Friction, Timing

__all__ = ["bench_for", "plausible_rig", "srv02_rig"]

SRV02 = "Quanser, SRV02 Rotary Servo Base Unit User Manual: specifications"
PENDULUM = "Quanser, SRV02 Rotary Pendulum User Manual: specifications"
AMPLIFIER = "Quanser, Universal Power Module UPM-1503 data sheet: ±15 V"
CHOSEN = "chosen: no public number"

#: One count of a 1024-line encoder read in quadrature, rad.
COUNT = 2 * math.pi / 4096


def srv02_rig() -> Bench:
    """Return the paper's bench: Quanser's SRV02 with its pendulum, at 1 kHz.

    The paper's own numbers for the mechanism (d_e = 0.073 N m s/rad, ±15 V), and around them
    those of the maker's manuals: 4096 counts per turn on both axes; motor constant and
    resistance within ±12 % each, gearbox efficiency ±10 % and motor efficiency ±5 %, of which
    the torque per volt and the damping take 12 %.  The Coulomb friction of the arm is the
    0.03 N m (0.23 V) that the repeats of Figure 3 assume; breakaway a third above it.

    Examples
    --------
    >>> srv02_rig().mechanism.inputs[0].limit
    15.0
    """
    return Bench(
        rotary_pendulum(),
        friction={
            "theta": Friction(0.03, 0.04, 0.05, source=CHOSEN),
            "phi": Friction(0.0002, 0.0003, 0.05, viscous=0.0001, source=CHOSEN),
        },
        encoders={
            "theta": Encoder(COUNT, source=SRV02 + ", 4096 counts per turn"),
            "phi": Encoder(COUNT, source=PENDULUM + ", 4096 counts per turn"),
        },
        amplifiers={
            "voltage": Amplifier(
                15.0, 20.0 / 4096, 0.0, 0.18e-3 / 2.6, source=f"{AMPLIFIER}; 12 bits; {SRV02}: L/R"
            )
        },
        timing=Timing(0.001, 1e-4, 1e-3, 0.5e-3, source=CHOSEN + ": a PC with a USB card"),
        tolerance={"a_e": 0.12, "d_e": 0.12, "m": 0.02, "l": 0.02, "r_o": 0.01, "I_e": 0.05},
        hand={"phi": math.radians(1.0), "theta": math.radians(1.0)},
        source=f"{SRV02}; {PENDULUM}",
    )


def plausible_rig(mechanism: Mechanism) -> Bench:
    """Return a bench of usual quality for any mechanism: encoders, friction, delay, spread.

    4096 counts per turn or 20 µm per count; Coulomb friction of the actuated joints 2 % of
    the input's limit, breakaway a third above; 1 ms from measurement to action with 0.1 ms
    of jitter; a 12-bit converter; every parameter but gravity within ±3 %.
    """
    loads = {
        c.name: 0.02 * i.limit * abs(float(b))
        for c, i, b in zip(
            mechanism.coordinates,
            mechanism.inputs,
            mechanism.input_matrix.subs(mechanism.substitution).diagonal(),
            strict=False,
        )
        if math.isfinite(i.limit)
    }
    return Bench(
        mechanism,
        friction={
            name: Friction(load, 4 / 3 * load, 0.05, source=CHOSEN) for name, load in loads.items()
        },
        encoders={
            c.name: Encoder(COUNT if c.unit == "rad" else 2e-5, source=CHOSEN)
            for c in mechanism.coordinates
        },
        amplifiers={
            i.name: Amplifier(i.limit, i.limit / 2048, source=CHOSEN)
            for i in mechanism.inputs
            if math.isfinite(i.limit)
        },
        timing=Timing(0.001, 1e-4, 0.5e-3, 0.5e-3, source=CHOSEN),
        tolerance={p.name: _spread(p) for p in mechanism.parameters if p.name != "g" and p.value},
        hand={c.name: math.radians(0.5) for c in mechanism.coordinates if c.unit == "rad"},
        source=CHOSEN,
    )


def bench_for(mechanism: Mechanism) -> Bench:
    """Return the bench with published numbers where there is one, else one of usual quality."""
    published = srv02_rig()
    same = mechanism.fingerprint == published.mechanism.fingerprint
    return published if same else plausible_rig(mechanism)


def _spread(parameter: Parameter) -> float:
    """Return 3 %, or what room the parameter's bounds leave: no efficiency exceeds 1."""
    room = min(parameter.high - parameter.value, parameter.value - parameter.low)
    return min(0.03, 0.99 * room / abs(parameter.value))
