"""Simulated rigs: the mechanism's own model, and a bench with all that a model leaves out."""

from __future__ import annotations

import copy
import math
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, at_least
from undertow.models import FloatArray, Mechanism, steps_in
from undertow.plants.bench import Amplifier, Backlash, Bench, Encoder, Friction, Timing
from undertow.plants.interface import Measurement
from undertow.plants.stepping import RIG_LAYOUT, measure, stepping
from undertow.symbolic import Workspace

#: Periods for which noise is drawn at once.
_BLOCK = 4096


class RealisticRig:
    """A simulated bench: the same seed and inputs give the same bits on processors of one kind.

    Parameters
    ----------
    bench
        What it is like.
    x0
        Where the hand means to let go, (2n,); the mechanism's usual ``start`` by default.
    seed
        Of everything random: noise, jitter, parameters, encoder zeros, the hand.

    Attributes
    ----------
    period
        Period of the inner loop, s.
    mechanism
        The truth, with the parameters that were drawn.
    stops_hit
        How often an end stop was run into.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = RealisticRig(Bench(ut.mechanisms.rotary_pendulum()), seed=1)
    >>> rig.write([0.0])
    >>> rig.read().t
    0.001
    """

    def __init__(self, bench: Bench, x0: ArrayLike | None = None, seed: int = 0) -> None:
        at_least("seed of a rig", seed, 0)
        self.bench = bench
        self.period = bench.timing.period
        self._rng = np.random.default_rng([seed, 0])
        draw = np.random.default_rng([seed, 1])
        self.mechanism = bench.drawn(draw)
        n, m, timing = self.mechanism.n, self.mechanism.m, bench.timing
        start = self.mechanism.state(**self.mechanism.start) if x0 is None else x0
        x0 = bench.released(self.mechanism.check_state(start), draw)
        self._module = stepping(self.mechanism)
        self._rates = None
        if bench.tachometers is not None:
            names = (c.name for c in self.mechanism.coordinates)
            self._rates = np.array([bench.tachometers.get(name, 0.0) for name in names])
        # Positions are kept, and velocities too where they are measured.
        self._sizes = {
            "late": round(timing.input_delay / timing.step),
            "old": round(timing.measurement_delay / timing.step),
            "seen": n if self._rates is None else 2 * n,
            "knocks": 1 + len(bench.pushes),
        }
        self._use(Workspace(RIG_LAYOUT, n=n, m=m, p=len(self.mechanism.parameters), **self._sizes))
        memory = self._memory
        memory["x"][:], memory["past"][:] = x0, x0[: self._sizes["seen"]]
        fine = steps_in(self.mechanism, timing.step, timing.step)
        memory["counts"][1], memory["counts"][3] = timing.steps, fine
        memory["phase"][:] = draw.uniform(0.0, 1.0, n)
        memory["parameters"][:] = self.mechanism.parameter_values
        self._fill_tables()
        self._t, self._lateness, self._samples = 0.0, 0.0, 0
        self._row = _BLOCK
        measure(0, memory["past"], 0, memory["encoder"], memory["phase"], self._draw()[1:], self._q)
        if not self._module.advance.signatures:  # compiled before a period that has to be kept
            self.copied().write(np.zeros(m))

    def _use(self, memory: Workspace) -> None:
        """Work on a memory: what the rig is like, and where it is."""
        self._memory = memory
        self._x: FloatArray = memory["x"]
        self._q: FloatArray = memory["q"]
        self._u: FloatArray = memory["u"]

    def copied(self) -> Self:
        """Return the rig as it stands, to go on by itself."""
        twin, n, m = copy.copy(self), self.mechanism.n, self.mechanism.m
        twin._rng, p = copy.deepcopy(self._rng), len(self.mechanism.parameters)
        twin._use(Workspace(RIG_LAYOUT, n=n, m=m, p=p, **self._sizes))
        twin._memory.block[:] = self._memory.block
        return twin

    def _fill_tables(self) -> None:
        """Lay the bench out in the memory, in the order of coordinates and inputs."""
        bench, mechanism, memory = self.bench, self.mechanism, self._memory
        coordinates = mechanism.coordinates
        friction = [bench.friction.get(c.name, Friction()) for c in coordinates]
        memory["friction"][:] = [[f.coulomb, f.F_s, f.stribeck_speed, f.viscous] for f in friction]
        memory["stops"][:] = [[c.low, c.high] for c in coordinates]
        encoders = [bench.encoders.get(c.name, Encoder()) for c in coordinates]
        memory["encoder"][:] = [[e.resolution, e.noise] for e in encoders]
        amplifiers = [bench.amplifiers.get(i.name, Amplifier()) for i in mechanism.inputs]
        memory["amplifier"][:] = [
            [min(a.limit, i.limit), a.resolution, a.dead_band, a.time_constant]
            for a, i in zip(amplifiers, mechanism.inputs, strict=True)
        ]
        gaps = [bench.backlash.get(c.name, Backlash(0.0, 1.0)) for c in coordinates[: mechanism.m]]
        memory["gap"][:] = [[g.gap, g.inertia] for g in gaps]
        names = [c.name for c in coordinates]
        memory["pushes"][0, 0] = math.inf  # a knock that is given while it runs
        for row, push in zip(memory["pushes"][1:], bench.pushes, strict=True):
            row[0] = push.t if push.t >= 0.0 else math.inf
            row[1 + names.index(push.coordinate)] = push.impulse
        self._refuse_heavy_rotors()

    def _refuse_heavy_rotors(self) -> None:
        """A rotor behind a gap is part of its joint's inertia, wherever the mechanism is."""
        gap, places = self._memory["gap"], np.zeros((2, self.mechanism.n))
        places[0] = self._x[: self.mechanism.n]
        for i in np.flatnonzero(gap[:, 0] > 0):
            own = 1.0 / np.linalg.inv(self.mechanism.M(places))[:, i, i].max()
            if not gap[i, 1] < own:
                name = self.mechanism.coordinates[i].name
                raise InvalidInputError(
                    f"inertia of the backlash of '{name}'",
                    value=f"{gap[i, 1]:g}",
                    limit=f"below the joint's own, {own:.3g}",
                    remedy="The mechanism's inertia must hold its rotor's, felt at the joint",
                )

    def _draw(self) -> FloatArray:
        """Return the random numbers of one period: lateness in [0, 1), noise of positions."""
        if self._row == _BLOCK:
            n = self.mechanism.n
            width = n if self._rates is None else 2 * n
            self._noise = self._rng.standard_normal((_BLOCK, 1 + width))
            self._noise[:, 0] = self._rng.uniform(size=_BLOCK)
            self._row = 0
        row = self._noise[self._row]
        self._row += 1
        return np.asarray(row)

    @property
    def t(self) -> float:
        """Time on the rig's clock, s."""
        return self._t

    @property
    def truth(self) -> FloatArray:
        """The true state, (2n,), which no controller sees."""
        return self._x.copy()

    @property
    def applied(self) -> FloatArray:
        """What drove the joints in the last integration step, (m,)."""
        return np.array(self._memory["applied"])

    @property
    def stops_hit(self) -> int:
        """How often an end stop was run into."""
        return int(self._memory["counts"][2])

    def read(self) -> Measurement:
        """Return the present measurement."""
        if self._rates is None:
            return Measurement(self._t, self._q.copy())
        n = self.mechanism.n
        noise = self._noise[self._row - 1, 1 + n :]
        past, step = self._memory["past"], int(self._memory["counts"][0])
        row = max(0, step - self._sizes["old"]) % len(past)
        return Measurement(self._t, self._q.copy(), past[row, n:] + self._rates * noise)

    def write(self, u: ArrayLike) -> None:
        """Apply the inputs u, (m,), and advance to the next sample.

        Raises
        ------
        InvalidInputError
            For an input that is not a number: no amplifier has a voltage for that; for another
            shape.
        """
        try:
            self._u[:] = u
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                "input written to a rig",
                value=repr(u),
                limit=f"{len(self._u)} finite numbers",
                remedy="Give one for each input, in its unit",
            ) from error
        if not all(map(math.isfinite, self._u)):
            raise InvalidInputError(
                "input written to a rig",
                value=self._u.tolist(),
                limit="finite numbers",
                remedy="Guard the controller's output",
            )
        noise = self._draw()
        timing: Timing = self.bench.timing
        lateness = timing.jitter * float(noise[0])
        length = timing.period + lateness - self._lateness
        self._module.advance(self._t, length, noise[1:], self._memory.block, *self._sizes.values())
        self._samples += 1
        self._lateness = lateness
        self._t = self._samples * timing.period + lateness

    def knock(self, impulse: ArrayLike) -> None:
        """Give it a knock at the beginning of the next period.

        Parameters
        ----------
        impulse
            Generalised impulse on each coordinate, (n,), N m s or N s.
        """
        pushes = self._memory["pushes"]
        pushes[0, 0], pushes[0, 1:] = self._t, impulse

    def close(self) -> None:
        """Let go of the rig."""


class IdealRig(RealisticRig):
    """The mechanism's own model, positions and velocities measured exactly.

    Parameters
    ----------
    mechanism
        The model.
    x0
        Start, (2n,); the mechanism's usual ``start`` by default.
    period
        Period of the inner loop, s.
    steps
        Runge-Kutta steps per period; more where a mode of the model is fast.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = IdealRig(ut.mechanisms.rotary_pendulum())
    >>> rig.read().q.tolist() == rig.truth[:2].tolist()
    True
    """

    def __init__(
        self,
        mechanism: Mechanism,
        x0: ArrayLike | None = None,
        period: float = 0.001,
        steps: int = 1,
    ) -> None:
        bench = Bench(mechanism, tachometers={}, timing=Timing(period, steps=steps))
        super().__init__(bench, x0)
