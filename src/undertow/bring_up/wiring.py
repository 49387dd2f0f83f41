"""Signs and scales: what is wired the wrong way round, and the fewest faults that explain it.

The response of coordinate j to input i, measured over predicted, is a number g_ij ≈ k_i c_j:
k_i is the factor of the input, c_j that of the encoder, 1 for both where all is well.  A common
factor of all inputs and encoders cannot be told apart; the explanation with the fewest faults
is taken.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from undertow.bring_up.motion import MotionRecord, Predictor
from undertow.models import FloatArray
from undertow.plants import Measurement, Rig, RigWrapper, full_forces

#: A factor within this ratio of 1 is within the tolerance of parameters and friction.
TOLERANCE = 1.45

#: A factor within this ratio of a known one is taken for it: they are twice as far apart.
NEAR = 1.41

#: A response below this share of the predicted one is none.
DEAD = 0.01

#: Factors that come from a setting: name to number.
KNOWN = {
    "degrees for radians": 180 / np.pi,
    "turns for radians": 1 / (2 * np.pi),
    "a quadrature count of 4 for 1": 4.0,
    "a quadrature count of 2 for 1": 2.0,
    "a quadrature count of 1 for 2": 0.5,
    "a quadrature count of 1 for 4": 0.25,
    "radians for degrees": np.pi / 180,
    "millimetres for metres": 1000.0,
}


@dataclass(frozen=True, eq=False)
class Wiring:
    """What lies between a rig and the model: factors of 1, in order, where all is well.

    ``inputs``: factor of each input, (m,); 0: it does nothing. ``encoders``: factor of each
    coordinate's encoder, (n,); 0: it never moves. ``order``: which of the rig's readings is that of
    each coordinate; empty: as they come.
    """

    inputs: FloatArray
    encoders: FloatArray
    order: tuple[int, ...] = ()

    @property
    def scaled(self) -> bool:
        """Whether a factor is another number than 0, 1 and −1."""
        factors = np.abs(np.concatenate([self.inputs, self.encoders]))
        return bool(((factors != 0.0) & (factors != 1.0)).any())

    def then(self, other: Wiring) -> Wiring:
        """Return this wiring and what was found behind it, as one."""
        first = self.order or tuple(range(len(self.encoders)))
        second = other.order or tuple(range(len(first)))
        return Wiring(
            self.inputs * other.inputs,
            self.encoders[list(second)] * other.encoders,
            tuple(first[j] for j in second),
        )

    def corrected(self, rig: Rig) -> Corrected:
        """Return the rig as it were with these factors undone."""
        return Corrected(rig, self)


class Corrected(RigWrapper):
    """A rig behind a wiring that is undone in software: signs and scales as in the model."""

    def __init__(self, rig: Rig, wiring: Wiring) -> None:
        super().__init__(rig)
        self.wiring = wiring
        self._home: FloatArray | None = None

    def _factors(self, values: FloatArray) -> FloatArray:
        return np.where(np.abs(values) > 0, values, 1.0)

    def read(self) -> Measurement:
        """Return the measurement, relative to the first one, in the model's scale."""
        measured = self.rig.read()
        order = list(self.wiring.order) or slice(None)
        q = np.asarray(measured.q, dtype=float)[order]
        if self._home is None:
            self._home = q.copy()
        factors = self._factors(self.wiring.encoders)
        v = None if measured.v is None else np.asarray(measured.v)[order] / factors
        return Measurement(measured.t, (q - self._home) / factors + self._home, v)

    def write(self, u: FloatArray) -> None:
        """Write the inputs in the rig's scale."""
        self.rig.write(np.asarray(u) / self._factors(self.wiring.inputs))


def explain(gain: FloatArray, known: FloatArray) -> tuple[float, Wiring]:
    """Return the number of faults, and parts of one for what they leave, with the wiring.

    It is the wiring with the fewest faults that explains measured gains.

    g, (m, n), is the response of coordinate j to input i, measured over predicted, near 0 where
    nothing moved that should have; ``known``, (m, n), whether the prediction is large enough to
    compare with. Factors within a ratio of 1.45 of ±1 are ±1; scales of encoders near a known one
    are that.
    """
    m, n = gain.shape
    dead = np.array([not (np.abs(gain[i][known[i]]) > DEAD).any() for i in range(m)])
    live = known & ~dead[:, None]
    choices = []
    for i in range(m):
        moved = [g for g in gain[i][live[i]].tolist() if abs(g) > DEAD]
        choices.append([1.0] if dead[i] else [1.0, -1.0, *moved, *_between(moved)])
    best: tuple[float, FloatArray, FloatArray] | None = None
    for k in itertools.product(*choices):
        encoders = np.ones(n)
        misfit = 0.0
        for j in range(n):
            rows = np.flatnonzero(live[:, j])
            if len(rows) == 0:
                continue
            ratios = gain[rows, j] / np.array(k)[rows]
            c = float(np.median(ratios))
            encoders[j] = _settled(c) if abs(c) > DEAD else 0.0
            misfit += float(np.abs(ratios - c).sum())
        faults = sum(map(_faults, (*map(_rounded, k), *encoders)))
        cost = faults + 0.5 * min(misfit, 1.8)
        if best is None or cost < best[0] - 1e-9:
            best = cost, np.array(k), encoders
    assert best is not None  # there is one choice at least
    inputs = np.array([_rounded(v) for v in best[1]])
    inputs[dead] = 0.0
    return best[0], Wiring(inputs, best[2])


def _between(gains: list[float]) -> list[float]:
    """Return the factor in the middle of the gains of one input, of either sign, if it is wrong.

    One factor explains gains on either side of it by the tolerance.
    """
    middle = math.exp(float(np.mean(np.log(np.abs(gains))))) if gains else 1.0
    return [middle, -middle] if abs(_rounded(middle)) != 1.0 else []


def _faults(factor: float) -> int:
    """Return how many faults a factor is: a sign and a scale are two."""
    return int(abs(factor) != 1.0) + int(factor < 0.0)


def _rounded(factor: float) -> float:
    """Return ±1 for a factor within tolerance of it, else the factor."""
    return math.copysign(1.0, factor) if 1 / TOLERANCE < abs(factor) < TOLERANCE else factor


def _settled(factor: float) -> float:
    """Return ±1 for the scale of an encoder within tolerance, else a known one near it."""
    words = known_factor(factor)
    within = _rounded(factor)
    return math.copysign(KNOWN[words], factor) if words and abs(within) != 1.0 else within


def known_factor(value: float) -> str:
    """Return what a factor looks like, in words, where it is near a known one."""
    apart = {words: abs(math.log(abs(value) / factor)) for words, factor in KNOWN.items() if value}
    words = min(apart, key=apart.__getitem__, default="")
    return words if words and apart[words] < math.log(NEAR) else ""


#: Levels of dry friction of a driven joint that are compared, as shares of the push.
LEVELS = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.75)

#: A predicted motion is compared where it is larger than this share of what is enough.
LEAST = 0.1

#: What a push moves goes so many times as far as it did before.
STIRRED = 3.0

#: Faults that a motion of another shape than predicted is worth.
SHAPE = 5.0


@dataclass(frozen=True, eq=False)
class Response:
    """The motion that a push makes.

    ``moved``: measured, (N, n), and ``predicted``: the model's, by level of dry friction, (L, N,
    n), each about its start.  ``sway``: how large a predicted motion of each coordinate has to be
    to show beside what moved before the push, (n,).
    """

    moved: FloatArray
    predicted: FloatArray
    sway: FloatArray

    @classmethod
    def none(cls, n: int) -> Self:
        """Return the response to a push that was not made."""
        return cls(np.zeros((1, n)), np.zeros((1, 1, n)), np.zeros(n))

    @cached_property
    def likeness(self) -> FloatArray:
        """How alike in shape measured j and predicted k are, whatever sign and scale, (L, n, n)."""
        power = np.sqrt((self.moved**2).sum(axis=0))[:, None]
        power = power * np.sqrt((self.predicted**2).sum(axis=1))[:, None, :]
        both = np.abs(np.einsum("tj,ltk->ljk", self.moved, self.predicted))
        return np.asarray(both / np.maximum(power, 1e-300))

    @property
    def reach(self) -> FloatArray:
        """How far each coordinate goes without friction, (n,)."""
        return np.asarray(np.abs(self.predicted[0]).max(axis=0))


def push_response(predictor: Predictor, record: MotionRecord, i: int, calm: FloatArray) -> Response:
    """Return measured and predicted motion of a push on input i.

    Where nothing moves much more than while it was watched before, ``calm``, (n,), the push has
    not moved it: a fault only where twice as much was predicted, for a joint may still swing.
    """
    belief, n = predictor.mechanism, predictor.mechanism.n
    push = float(np.abs(record.u[:, i]).max()) / belief.input_limits[i]
    predicted = []
    for shares in itertools.product(LEVELS, repeat=belief.m):
        coulomb = np.zeros((2, n))
        coulomb[:, : belief.m] = push * full_forces(belief) * shares
        states = predictor.states(
            record, belief.parameter_values, coulomb, np.zeros(n), np.ones(belief.m)
        )
        late = 1.5 * float(np.median(np.diff(record.t)))
        predicted.append(predictor.positions(record, states, late) - predictor.x0[:n])
    stirred = np.abs(record.moved).max(axis=0) > STIRRED * calm
    sway = np.where(stirred, 0.0, 2 * STIRRED * calm)
    return Response(record.moved * stirred, np.array(predicted), sway)


@dataclass(frozen=True, eq=False)
class WiringEstimate:
    """What the pushes say of the wiring.

    ``ratio``: measured over predicted motion with this wiring undone, (m, n); ``known``: whether
    the prediction is large enough to compare with, (m, n).
    """

    wiring: Wiring
    ratio: FloatArray
    known: FloatArray


def estimate_wiring(responses: Sequence[Response], enough: FloatArray) -> WiringEstimate:
    """Return the wiring that explains the responses to pushes, one of each input.

    Encoders may be plugged in any order: the fewest faults are looked for over all of them,
    where an order that is not the model's is one, and a motion whose shape is not as predicted
    counts against the order.  Of the levels of friction the one is taken whose motion is most
    alike in shape.
    """
    n = len(enough)
    best: tuple[float, WiringEstimate] | None = None
    seen = all(any(response.moved[:, j].any() for response in responses) for j in range(n))
    # Where a reading never moves, the others fit in more than one order: theirs is not doubted.
    for order in itertools.permutations(range(n)) if seen else [tuple(range(n))]:
        gain, unlike = np.zeros((len(responses), n)), 0.0
        known = np.zeros((len(responses), n), dtype=bool)
        for i, response in enumerate(responses):
            alike = response.likeness[:, order, range(n)]
            far = response.reach > LEAST * enough
            level = int(np.argmax(alike[:, far].sum(axis=1)))
            moved, predicted = response.moved[:, order], response.predicted[level]
            enough_to_tell = np.maximum(LEAST * enough, response.sway[list(order)])
            known[i] = np.abs(predicted).max(axis=0) > enough_to_tell
            power = np.maximum((predicted**2).sum(axis=0), 1e-300)
            gain[i] = (moved * predicted).sum(axis=0) / power
            unlike += float((1 - alike[level, far]).sum()) / len(responses)
        cost, wiring = explain(gain, known)
        cost += SHAPE * unlike + (order != tuple(range(n)))
        if best is None or cost < best[0] - 1e-9:
            wiring = Wiring(wiring.inputs, wiring.encoders, order)
            outer = wiring.inputs[:, None] * wiring.encoders[None, :]
            best = cost, WiringEstimate(wiring, gain / np.where(outer == 0, np.nan, outer), known)
    assert best is not None  # the model's own order is one
    return best[1]
