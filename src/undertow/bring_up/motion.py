"""Small safe motions from rest: played on a rig and recorded, and as a bench model has them."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undertow.base import ArtefactError, InfeasibleError, UndertowError
from undertow.models import FloatArray, Mechanism, steps_in
from undertow.plants import Rig, control_loop
from undertow.plants.stepping import RIG_LAYOUT, stepping
from undertow.symbolic import Workspace


def rest_state(mechanism: Mechanism) -> FloatArray:
    """Return the state, (2n,), in which a mechanism stays with its inputs at zero.

    Angles are tried at 0 and π, slides at 0, for an equilibrium without a growing mode: a
    pendulum hangs.

    Raises
    ------
    InfeasibleError
        When there is none: a ball rolls off its beam.

    Examples
    --------
    >>> import undertow as ut
    >>> rest_state(ut.mechanisms.rotary_pendulum()).round(3).tolist()
    [0.0, 3.142, 0.0, 0.0]
    """
    n = mechanism.n
    choices = [(0.0, math.pi) if c.unit == "rad" else (0.0,) for c in mechanism.coordinates]
    for q in itertools.product(*choices):
        x = np.concatenate([q, np.zeros(n)])
        inside = all(c.low <= v <= c.high for c, v in zip(mechanism.coordinates, q, strict=True))
        still = np.abs(mechanism.accelerations(0.0, x, np.zeros(mechanism.m))).max() < 1e-6
        if inside and still and _growth(mechanism, x) < 1e-3:
            return x
    raise InfeasibleError(
        f"rest of '{mechanism.name}'",
        value="no equilibrium without a growing mode",
        limit="one at angles of 0 or π",
        remedy="Such a mechanism cannot be left alone: hold it, or check it in parts",
    )


def _growth(mechanism: Mechanism, x: FloatArray) -> float:
    """Largest real part of the eigenvalues at an equilibrium, 1/s, by differences."""
    n, step = mechanism.n, 1e-5
    rows = np.vstack([x + step * np.eye(2 * n), x - step * np.eye(2 * n)])
    a = mechanism.accelerations(0.0, rows, np.zeros(mechanism.m))
    below = ((a[: 2 * n] - a[2 * n :]) / (2 * step)).T
    A = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), below])
    return float(np.linalg.eigvals(A).real.max())


class GuardError(UndertowError):
    """A coordinate left the range that was allowed to it; the inputs were set to zero."""


@dataclass(frozen=True, eq=False)
class MotionRecord:
    """What was written to a rig and what it measured.

    Samples were taken at t, (N,), s; ``q[k]`` of the positions, (N, n), was read before ``u[k]`` of
    the inputs, (N, m), was written.
    """

    t: FloatArray
    q: FloatArray
    u: FloatArray

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.t)

    @property
    def moved(self) -> FloatArray:
        """Positions relative to their mean before the first input, (N, n)."""
        driven = np.flatnonzero(np.abs(self.u).max(axis=1) > 0)
        still = max(1, int(driven[0]) if len(driven) else len(self))
        return np.asarray(self.q - self.q[:still].mean(axis=0))


def perform(
    rig: Rig, u: FloatArray, guard: Sequence[float] | FloatArray, until: FloatArray | None = None
) -> MotionRecord:
    """Write a sequence of inputs, (N, m), and record what is measured.

    ``guard``: how far each coordinate may go from where it is now, (n,); ``until``: stop once one
    has gone so far, (n,).

    Raises
    ------
    GuardError
        When one goes further: the inputs are zero then.
    ArtefactError
        When one is not measured any more: so they are then.
    """
    times: list[float] = []
    positions: list[FloatArray] = []
    inputs = iter(u)
    try:
        for measured, _ in control_loop(rig, lambda _: next(inputs), len(u)):
            times.append(measured.t)
            positions.append(np.array(measured.q, dtype=float))
            away = np.abs(positions[-1] - positions[0])
            if np.isnan(away).any():
                raise ArtefactError(
                    f"reading of coordinate {int(np.argmax(np.isnan(away)))} of the rig",
                    value="no number",
                    limit="a position in rad or m",
                    remedy="The inputs are zero now: look at the encoder's cable and supply",
                )
            if (away > guard).any():
                worst = int(np.argmax(away > guard))
                raise GuardError(
                    f"coordinate {worst} of the rig",
                    value=f"{away[worst]:.3g} from where it began",
                    limit=f"up to {guard[worst]:.3g}",
                    remedy="The inputs are zero now: look at the rig before going on",
                )
            if until is not None and (away > until).any():
                rig.write(np.zeros(u.shape[1]))
                break
    except BaseException:  # a guard, a driver that fails, Ctrl-C
        with contextlib.suppress(Exception):
            rig.write(np.zeros(u.shape[1]))
        raise
    count = len(positions)
    return MotionRecord(np.array(times), np.array(positions), np.array(u[:count]))


def doublets(amplitude: float, widths: Sequence[float], pause: float, period: float) -> FloatArray:
    """Return pushes to and fro, each of some width with a pause after it, (N,).

    A doublet of width w is +A for w, −A for w: it moves the joint and brings it to rest again
    near where it was.  Every second one begins the other way.
    """
    still = np.zeros(round(pause / period))
    parts = [still]
    for k, width in enumerate(widths):
        side = amplitude * (1 if k % 2 == 0 else -1)
        half = np.full(max(1, round(width / period)), side)
        parts += [half, -half, still]
    return np.concatenate(parts)


def ramp(level: float, seconds: float, period: float) -> FloatArray:
    """Return a slow rise from nothing to a level, (N,)."""
    return np.linspace(0.0, level, max(2, round(seconds / period)))


#: Integration steps per sample; each is divided where a mode of the mechanism is fast.
STEPS = 2

#: Speed at which breaking away turns into sliding, rad/s or m/s.
STRIBECK = 0.05


class Predictor:
    """Plays recorded inputs on a mechanism with joint friction, from rest.

    Parameters and frictions are given to each call; it rests at ``x0``, (2n,).
    """

    def __init__(self, mechanism: Mechanism, x0: FloatArray) -> None:
        self.mechanism, self.x0 = mechanism, np.array(x0, dtype=float)
        self._module, n = stepping(mechanism), mechanism.n
        self._sizes = {"late": 0, "old": 0, "seen": n, "knocks": 0}
        p = len(mechanism.parameters)
        self._memory = memory = Workspace(RIG_LAYOUT, n=n, m=mechanism.m, p=p, **self._sizes)
        memory["amplifier"][:, 0] = mechanism.input_limits
        memory["gap"][:], memory["stops"][:] = (0.0, 1.0), (-np.inf, np.inf)

    def states(
        self,
        record: MotionRecord,
        parameters: FloatArray,
        coulomb: FloatArray,
        viscous: FloatArray,
        gain: FloatArray,
        start: FloatArray | None = None,
    ) -> FloatArray:
        """Return the states at the times of the record, (N, 2n).

        ``coulomb``: dry friction of the joints, (2, n): when sliding and when breaking away;
        ``viscous``: damping besides the mechanism's own, (n,); ``gain``: factor of each input,
        (m,); ``start``: state at the first sample, (2n,), at rest by default.
        """
        n, memory = self.mechanism.n, self._memory
        memory["x"][:] = self.x0 if start is None else start
        memory["past"][:], memory["drive"][:] = memory["x"][:n], 0.0
        step = float(np.diff(record.t).max()) / STEPS
        fine = steps_in(self.mechanism, step, step)
        memory["counts"][:], memory["parameters"][:] = (0, STEPS, 0, fine), parameters
        memory["friction"][:] = np.column_stack([*coulomb, np.full(n, STRIBECK), viscous])
        rows, noise = np.empty((len(record), 2 * n)), np.zeros(n)
        self._module.play(
            record.t, record.u * gain, rows, noise, memory.block, *self._sizes.values()
        )
        return rows

    def positions(self, record: MotionRecord, states: FloatArray, delay: float) -> FloatArray:
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
