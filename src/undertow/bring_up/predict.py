"""What a bench model says that a recorded motion should have been."""

from __future__ import annotations

import numpy as np

from undertow.bring_up.motion import Record
from undertow.models import FloatArray, Mechanism
from undertow.plants.stepping import stepping

__all__ = ["Predictor"]

#: Integration steps per sample.
STEPS = 2

#: Speed at which breaking away turns into sliding, rad/s or m/s.
STRIBECK = 0.05


class Predictor:
    """Plays recorded inputs on a mechanism with joint friction, from rest.

    Parameters
    ----------
    mechanism
        The model; parameters and frictions are given to each call.
    x0
        Where it rests, (2n,).
    """

    def __init__(self, mechanism: Mechanism, x0: FloatArray) -> None:
        self.mechanism, self.x0 = mechanism, np.array(x0, dtype=float)
        self._module = stepping(mechanism)
        n, m = mechanism.n, mechanism.m
        limits = mechanism.input_limits
        self._amplifier = np.array([[v, 0.0, 0.0, 0.0] for v in limits])
        self._gap = np.tile([0.0, 1.0], (m, 1))
        self._stops = np.tile([-np.inf, np.inf], (n, 1))
        self._encoder, self._phase, self._noise = np.zeros((n, 2)), np.zeros(n), np.zeros(n)
        self._pushes, self._delays = np.zeros((0, 1 + n)), np.zeros(2, dtype=np.int64)

    def states(
        self,
        record: Record,
        parameters: FloatArray,
        coulomb: FloatArray,
        viscous: FloatArray,
        gain: FloatArray,
        start: FloatArray | None = None,
    ) -> FloatArray:
        """Return the states at the times of the record, (N, 2n).

        Parameters
        ----------
        record
            Whose times and inputs are played.
        parameters
            Of the mechanism, in its order.
        coulomb
            Dry friction of the joints, (2, n): when sliding and when breaking away.
        viscous
            Damping of the joints besides the mechanism's own, (n,).
        gain
            Factor of each input, (m,).
        start
            State at the first sample, (2n,); at rest by default.
        """
        n, m = self.mechanism.n, self.mechanism.m
        friction = np.column_stack([*coulomb, np.full(n, STRIBECK), viscous])
        x = np.array(self.x0 if start is None else start)
        q, applied = np.zeros(n), np.zeros(m)
        counts = np.array([0, STEPS, 0], dtype=np.int64)
        drive, held = np.zeros((3, m)), np.zeros((1, m))
        past, work = np.tile(x[:n], (1, 1)), np.zeros((8, max(n * n, 2 * n)))
        rows = np.empty((len(record), 2 * n))
        self._module.play(
            record.t, record.u * gain, rows, counts, x, drive, held, past, self._delays,
            parameters, friction, self._stops, self._amplifier, self._gap, self._encoder,
            self._phase, self._pushes, self._noise, q, applied, work,
        )  # fmt: skip
        return rows

    def positions(self, record: Record, states: FloatArray, delay: float) -> FloatArray:
        """Return what is measured a delay late, (N, n): cubic between the samples."""
        n = self.mechanism.n
        at = record.t - delay
        k = np.clip(np.searchsorted(record.t, at, side="right") - 1, 0, len(record) - 2)
        h = record.t[k + 1] - record.t[k]
        part = np.clip((at - record.t[k]) / h, 0.0, 1.0)[:, None]
        a, b = states[k, :n], states[k + 1, :n]
        da, db = states[k, n:] * h[:, None], states[k + 1, n:] * h[:, None]
        c = b - a
        return np.asarray(a + part * (da + part * (3 * c - 2 * da - db + part * (da + db - 2 * c))))
