"""Simulated rigs: the mechanism's own model, and a bench with all that a model leaves out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, at_least
from undertow.models import FloatArray, Mechanism
from undertow.plants.bench import Amplifier, Backlash, Bench, Encoder, Friction, Timing
from undertow.plants.interface import Measurement
from undertow.plants.stepping import measure, stepping

#: Periods for which noise is drawn at once.
_BLOCK = 4096


class RealisticRig:
    """A simulated bench: the same seed and the same inputs give the same bits.

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
        self._x = bench.released(self.mechanism.check_state(start), draw)
        self._phase = draw.uniform(0.0, 1.0, n)
        self._module = stepping(self.mechanism)
        self._parameters = self.mechanism.parameter_values
        self._tables()
        late = [
            round(delay / timing.step) for delay in (timing.input_delay, timing.measurement_delay)
        ]
        self._delays = np.array(late, dtype=np.int64)
        self._counts = np.array([0, timing.steps, 0], dtype=np.int64)
        self._drive, self._held = np.zeros((5, m)), np.zeros((late[0] + 1, m))
        # Positions, and velocities too where they are measured.
        seen = self._x[:n] if self._rates is None else self._x
        self._past = np.tile(seen, (late[1] + 1, 1))
        self._applied, self._u = np.zeros(m), np.zeros(m)
        self._work = np.zeros((8, max(n * n, 2 * n)))
        self._t, self._lateness, self._samples = 0.0, 0.0, 0
        self._row = _BLOCK
        self._q = np.zeros(n)
        measure(0, self._past, 0, self._encoder, self._phase, self._draw()[1:], self._q)

    def _tables(self) -> None:
        """Lay the bench out in arrays, in the order of coordinates and inputs."""
        bench, mechanism = self.bench, self.mechanism
        coordinates = mechanism.coordinates
        friction = [bench.friction.get(c.name, Friction()) for c in coordinates]
        self._friction = np.array(
            [[f.coulomb, f.F_s, f.stribeck_speed, f.viscous] for f in friction], dtype=float
        )
        self._stops = np.array([[c.low, c.high] for c in coordinates])
        encoders = [bench.encoders.get(c.name, Encoder()) for c in coordinates]
        self._encoder = np.array([[e.resolution, e.noise] for e in encoders])
        amplifiers = [bench.amplifiers.get(i.name, Amplifier()) for i in mechanism.inputs]
        self._amplifier = np.array(
            [
                [min(a.limit, i.limit), a.resolution, a.dead_band, a.time_constant]
                for a, i in zip(amplifiers, mechanism.inputs, strict=True)
            ]
        )
        gaps = [bench.backlash.get(c.name, Backlash(0.0, 1.0)) for c in coordinates[: mechanism.m]]
        self._gap = np.array([[g.gap, g.inertia] for g in gaps])
        names = [c.name for c in coordinates]
        self._pushes = np.zeros((1 + len(bench.pushes), 1 + mechanism.n))
        self._pushes[0, 0] = math.inf  # a knock that is given while it runs
        for row, push in zip(self._pushes[1:], bench.pushes, strict=True):
            row[0] = push.t if push.t >= 0.0 else math.inf
            row[1 + names.index(push.coordinate)] = push.impulse
        self._refuse_heavy_rotors()
        self._rates = None
        if bench.tachometers is not None:
            self._rates = np.array([bench.tachometers.get(name, 0.0) for name in names])

    def _refuse_heavy_rotors(self) -> None:
        """A rotor behind a gap is part of its joint's inertia, wherever the mechanism is."""
        places = np.vstack([self._x[: self.mechanism.n], np.zeros(self.mechanism.n)])
        for i in np.flatnonzero(self._gap[:, 0] > 0):
            own = 1.0 / np.linalg.inv(self.mechanism.M(places))[:, i, i].max()
            if not self._gap[i, 1] < own:
                name = self.mechanism.coordinates[i].name
                raise InvalidInputError(
                    f"inertia of the backlash of '{name}'",
                    value=f"{self._gap[i, 1]:g}",
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
        return self._applied.copy()

    @property
    def stops_hit(self) -> int:
        """How often an end stop was run into."""
        return int(self._counts[2])

    def read(self) -> Measurement:
        """Return the present measurement."""
        if self._rates is None:
            return Measurement(self._t, self._q.copy())
        n = self.mechanism.n
        noise = self._noise[self._row - 1, 1 + n :]
        row = max(0, int(self._counts[0]) - int(self._delays[1])) % len(self._past)
        return Measurement(self._t, self._q.copy(), self._past[row, n:] + self._rates * noise)

    def write(self, u: ArrayLike) -> None:
        """Apply the inputs u, (m,), and advance to the next sample.

        Raises
        ------
        InvalidInputError
            For an input that is not a number: no amplifier has a voltage for that.
        """
        self._u[:] = u
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
        self._module.advance(
            self._t, length, self._counts, self._x, self._u, self._drive, self._held, self._past,
            self._delays, self._parameters, self._friction, self._stops, self._amplifier, self._gap,
            self._encoder, self._phase, self._pushes, noise[1:], self._q, self._applied, self._work,
        )  # fmt: skip
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
        self._pushes[0, 0], self._pushes[0, 1:] = self._t, impulse

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
        Runge-Kutta steps per period.

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
