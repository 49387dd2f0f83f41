"""What makes a bench differ from its model, as data: every number with its source.

A :class:`Bench` is the truth that a controller meets: a mechanism, and what stands between
it and the numbers that a computer reads and writes.  It holds no state: a
:class:`undertow.plants.RealisticRig` runs it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from undertow.base import (
    InvalidInputError,
    ReadOnly,
    at_least,
    between,
    checked_names,
    one_of,
    positive,
    require,
)
from undertow.mechanisms import rotary_pendulum
from undertow.models import FloatArray, Mechanism, Parameter


def _at_least_zero(what: str, owner: Any, names: Iterable[str], *, infinite: bool = False) -> None:
    for name in names:
        value = getattr(owner, name)
        positive(f"{name} of {what}", value, "0 turns it off", zero=True, infinite=infinite)


@checked_names
@dataclass(frozen=True)
class Friction:
    """Friction of a joint: Coulomb, breakaway (Stribeck's curve), viscous.

    At velocity v the joint resists with up to ``F_c + (F_s − F_c) exp(−(v/v_s)²)``, as far
    as that is needed to hold it, and with ``b v`` besides (Armstrong-Hélouvry, Dupont,
    Canudas de Wit, *Automatica* 30(7), 1994).

    Parameters
    ----------
    coulomb
        F_c, N m (N for a slide joint).
    breakaway
        F_s ≥ F_c, N m or N; equal to ``coulomb`` where left out.
    stribeck_speed
        v_s, rad/s or m/s.
    viscous
        b, N m s/rad or N s/m, besides what the mechanism has itself.
    source
        Where the numbers come from.
    """

    coulomb: float = 0.0
    breakaway: float | None = None
    stribeck_speed: float = 0.05
    viscous: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse negative numbers, and a breakaway below Coulomb's level."""
        _at_least_zero("friction", self, ("coulomb", "viscous"))
        positive("stribeck_speed of friction", self.stribeck_speed)
        least = "A joint breaks away at no less than it slides with"
        at_least("breakaway of friction", self.F_s, self.coulomb, least)

    @property
    def F_s(self) -> float:
        """Level at standstill, N m or N."""
        return self.coulomb if self.breakaway is None else self.breakaway


@checked_names
@dataclass(frozen=True)
class Encoder:
    """A position sensor.

    Parameters
    ----------
    resolution
        One count, rad or m; 0 reads continuously.  Where zero lies within a count is drawn
        by the rig's seed.
    noise
        Standard deviation before counting, rad or m.
    source
        Where the numbers come from.
    """

    resolution: float = 0.0
    noise: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse negative numbers."""
        _at_least_zero("an encoder", self, ("resolution", "noise"))


@checked_names
@dataclass(frozen=True)
class Amplifier:
    """What stands between the number written and what drives the joint.

    Parameters
    ----------
    limit
        Largest magnitude, in the input's unit; the input's own limit applies besides.
    resolution
        One step of the converter, in the input's unit; 0 is continuous.
    dead_band
        Magnitudes up to here give nothing.
    time_constant
        First-order lag of amplifier and motor winding, s.
    source
        Where the numbers come from.
    """

    limit: float = math.inf
    resolution: float = 0.0
    dead_band: float = 0.0
    time_constant: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse negative numbers."""
        _at_least_zero("an amplifier", self, ("resolution", "dead_band", "time_constant"))
        _at_least_zero("an amplifier", self, ("limit",), infinite=True)


@checked_names
@dataclass(frozen=True)
class Backlash:
    """Play between motor and joint.

    Rotor and joint are two bodies.  While the rotor crosses the gap, the joint feels neither
    the motor nor the rotor's inertia; on landing they share their momentum, without a
    rebound, and they stay together for as long as the rotor presses.

    Parameters
    ----------
    gap
        Whole play at the joint, rad or m.
    inertia
        Of the motor as felt at the joint, kg m² or kg; the mechanism's own inertia holds it.
    source
        Where the numbers come from.
    """

    gap: float
    inertia: float
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse negative numbers, and a motor without inertia."""
        _at_least_zero("a backlash", self, ("gap",))
        positive(
            "inertia of a backlash",
            self.inertia,
            "η_g K_g² J_m of the motor, see DCMotor.reflected_inertia",
        )


@checked_names
@dataclass(frozen=True)
class Push:
    """A knock: an impulse on one coordinate.

    Parameters
    ----------
    t
        When, s on the rig's clock.
    coordinate
        Its name.
    impulse
        Generalised impulse, N m s or N s.
    """

    t: float
    coordinate: str
    impulse: float


@checked_names
@dataclass(frozen=True)
class Timing:
    """When things happen.

    Parameters
    ----------
    period
        Of the inner loop, s.
    jitter
        Samples come late by up to this, uniformly, s; lateness does not add up.
    input_delay
        From a write to the amplifier, s.
    measurement_delay
        Age of what is read, s.
    steps
        Integration steps per period; delays are rounded to one of these.  Each is divided where a
        mode of the mechanism is fast.
    source
        Where the numbers come from.
    """

    period: float = 0.001
    jitter: float = 0.0
    input_delay: float = 0.0
    measurement_delay: float = 0.0
    steps: int = 4
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse a period that is not positive, jitter that overtakes it, endless delays."""
        _at_least_zero("the timing", self, ("jitter", "input_delay", "measurement_delay"))
        positive("period of a rig, s", self.period, "1 ms is usual")
        at_least("steps of a period of a rig", self.steps, 1, "4 are usual")
        if self.jitter >= self.period:
            limit = f"below the period, {self.period:g} s"
            raise InvalidInputError("jitter of a rig", value=f"{self.jitter:g} s", limit=limit)
        late = max(self.input_delay, self.measurement_delay) / self.period
        between("delay of a rig", late, 0, 1000, "periods", "Give delays in seconds")

    @property
    def step(self) -> float:
        """Integration step, s."""
        return self.period / self.steps

    @property
    def delay(self) -> float:
        """From what is read to the action of the answer to it, s."""
        return self.input_delay + self.measurement_delay


@checked_names
@dataclass(frozen=True)
class Bench:
    """A mechanism with everything that its model leaves out.

    Parameters
    ----------
    mechanism
        The truth, with its equations and mean parameters.
    friction, backlash
        By coordinate; what is not named has none.
    encoders
        By coordinate; what is not named is read as it is.
    amplifiers
        By input.
    tachometers
        Standard deviation of measured velocities by coordinate, rad/s or m/s; ``None``:
        positions alone are measured.
    timing
        Sampling, jitter, delays.
    pushes
        Impulses.
    tolerance
        Parameter name to the relative half-width within which the seed draws its value.
    hand
        State name to the standard deviation of where a hand lets go, SI units.
    source
        Where the whole comes from.

    Raises
    ------
    InvalidInputError
        For a name that the mechanism does not have.

    Examples
    --------
    >>> import undertow as ut
    >>> bench = Bench(ut.mechanisms.cart_pendulum(), friction={"x": Friction(coulomb=0.5)})
    >>> bench.timing.period
    0.001
    """

    mechanism: Mechanism
    friction: Mapping[str, Friction] = field(default_factory=dict)
    backlash: Mapping[str, Backlash] = field(default_factory=dict)
    encoders: Mapping[str, Encoder] = field(default_factory=dict)
    amplifiers: Mapping[str, Amplifier] = field(default_factory=dict)
    tachometers: Mapping[str, float] | None = None
    timing: Timing = Timing()
    pushes: tuple[Push, ...] = ()
    tolerance: Mapping[str, float] = field(default_factory=dict)
    hand: Mapping[str, float] = field(default_factory=dict)
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse names that the mechanism does not have; keep copies."""
        for name, given in vars(self).items():
            if isinstance(given, Mapping):
                object.__setattr__(self, name, ReadOnly(given))
        mechanism = self.mechanism
        coordinates = [c.name for c in mechanism.coordinates]
        for what, names, known in (
            ("friction", self.friction, coordinates),
            ("backlash", self.backlash, coordinates[: mechanism.m]),
            ("encoders", self.encoders, coordinates),
            ("amplifiers", self.amplifiers, [i.name for i in mechanism.inputs]),
            ("tachometers", self.tachometers or {}, coordinates),
            ("pushes", [p.coordinate for p in self.pushes], coordinates),
            ("tolerance", self.tolerance, [p.name for p in mechanism.parameters]),
            ("hand", self.hand, list(mechanism.state_names)),
        ):
            for name in names:
                one_of(f"{what} of a bench of '{mechanism.name}'", name, known)
        wild = {k: v for k, v in self.tolerance.items() if not 0 <= v < 1}
        require(not wild, "tolerance of a bench", wild, "in [0, 1)", "0.05 is 5 %")

    def drawn(self, rng: np.random.Generator) -> Mechanism:
        """Return the mechanism with parameters drawn within their tolerances."""
        values = {p.name: p.value for p in self.mechanism.parameters}
        return self.mechanism.with_parameters(
            **{
                name: values[name] * (1.0 + width * rng.uniform(-1.0, 1.0))
                for name, width in sorted(self.tolerance.items())
            }
        )

    def released(self, x0: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return where the hand lets go when it means x0, (2n,)."""
        x = np.array(x0, dtype=float)
        for name, spread in sorted(self.hand.items()):
            x[self.mechanism.state_names.index(name)] += spread * rng.standard_normal()
        return x

    def with_friction(self, factor: float, joints: Collection[str] | None = None) -> Self:
        """Return the bench with so many times the friction, in all joints or in these."""
        changed = {
            name: replace(
                f, coulomb=factor * f.coulomb, breakaway=factor * f.F_s, viscous=factor * f.viscous
            )
            if joints is None or name in joints
            else f
            for name, f in self.friction.items()
        }
        return replace(self, friction=changed)

    def with_timing(self, **changes: Any) -> Self:
        """Return the bench with another period, jitter or delay."""
        return replace(self, timing=replace(self.timing, **changes))

    def with_delay(self, delay: float) -> Self:
        """Return the bench with a delay, s: three fifths at the inputs, two in the readings."""
        return self.with_timing(input_delay=0.6 * delay, measurement_delay=0.4 * delay)

    def with_encoders(self, counts: Mapping[str, float]) -> Self:
        """Return the bench with other counts of its encoders: of each that is named, rad or m."""
        others = {
            name: replace(self.encoders.get(name, Encoder()), resolution=count, source="")
            for name, count in counts.items()
        }
        return replace(self, encoders={**self.encoders, **others})


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


def full_forces(mechanism: Mechanism) -> FloatArray:
    """Return what the full inputs do at most to each driven joint, (m,), N or N m.

    An input without a limit does not count.
    """
    limits = mechanism.input_limits
    forces: FloatArray = np.abs(mechanism.B) @ np.where(np.isfinite(limits), limits, 0.0)
    return forces


def plausible_rig(mechanism: Mechanism) -> Bench:
    """Return a bench of usual quality for any mechanism: encoders, friction, delay, spread.

    4096 counts per turn or 20 µm per count; Coulomb friction of the actuated joints 2 % of
    what their inputs can do, breakaway a third above; 1 ms from measurement to action with 0.1 ms
    of jitter; a 12-bit converter; every parameter but gravity within ±3 %, or its own tolerance
    where that is less.
    """
    loads = {
        c.name: 0.02 * float(load)
        for c, load in zip(mechanism.coordinates, full_forces(mechanism), strict=False)
        if load > 0.0
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
        tolerance={p.name: _spread(p) for p in mechanism.parameters if p.value and _spread(p)},
        hand={c.name: math.radians(0.5) for c in mechanism.coordinates if c.unit == "rad"},
        source=CHOSEN,
    )


def bench_for(mechanism: Mechanism) -> Bench:
    """Return the bench with published numbers where there is one, else one of usual quality."""
    published = srv02_rig()
    same = mechanism.fingerprint == published.mechanism.fingerprint
    return published if same else plausible_rig(mechanism)


def _spread(parameter: Parameter) -> float:
    """Return 3 %, or what tolerance and bounds of the parameter leave: no efficiency exceeds 1."""
    if parameter.is_gravity:
        return 0.0
    room = 0.99 * min(parameter.high - parameter.value, parameter.value - parameter.low)
    known = math.inf if parameter.tolerance is None else parameter.tolerance
    return min(0.03, min(room, known) / abs(parameter.value))
