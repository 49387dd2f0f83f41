"""What a push on an input does: measured, and as the model has it with more or less friction."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from undertow.bring_up.motion import Record
from undertow.bring_up.predict import Predictor
from undertow.bring_up.wiring import Wiring, explained
from undertow.models import FloatArray

__all__ = ["Response", "Understood", "respond", "understand"]

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

    Attributes
    ----------
    moved
        Measured, (N, n), about its start.
    predicted
        The model's, by level of dry friction, (L, N, n), about its start.
    """

    moved: FloatArray
    predicted: FloatArray

    @classmethod
    def none(cls, n: int) -> Self:
        """Return the response to a push that was not made."""
        return cls(np.zeros((1, n)), np.zeros((1, 1, n)))

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


def respond(predictor: Predictor, record: Record, i: int, calm: FloatArray) -> Response:
    """Return measured and predicted motion of a push on input i.

    Where nothing moves much more than while it was watched before, ``calm``, (n,), the push has
    not moved it.
    """
    belief, n = predictor.mechanism, predictor.mechanism.n
    full = np.abs(np.array(belief.input_matrix.subs(belief.substitution), dtype=float)).diagonal()
    full = full * belief.input_limits
    push = float(np.abs(record.u[:, i]).max()) / belief.input_limits[i]
    predicted = []
    for shares in itertools.product(LEVELS, repeat=belief.m):
        coulomb = np.zeros((2, n))
        coulomb[:, : belief.m] = push * full * shares
        states = predictor.states(
            record, belief.parameter_values, coulomb, np.zeros(n), np.ones(belief.m)
        )
        late = 1.5 * float(np.median(np.diff(record.t)))
        predicted.append(predictor.positions(record, states, late) - predictor.x0[:n])
    stirred = np.abs(record.moved).max(axis=0) > STIRRED * calm
    return Response(record.moved * stirred, np.array(predicted))


@dataclass(frozen=True, eq=False)
class Understood:
    """What the pushes say of the wiring.

    Attributes
    ----------
    wiring
        Order, signs and scales.
    ratio
        Measured over predicted motion with this wiring undone, (m, n).
    known
        Whether the prediction is large enough to compare with, (m, n).
    """

    wiring: Wiring
    ratio: FloatArray
    known: FloatArray


def understand(responses: Sequence[Response], enough: FloatArray) -> Understood:
    """Return the wiring that explains the responses to pushes, one of each input.

    Encoders may be plugged in any order: the fewest faults are looked for over all of them,
    where an order that is not the model's is one, and a motion whose shape is not as predicted
    counts against the order.  Of the levels of friction the one is taken whose motion is most
    alike in shape.
    """
    n = len(enough)
    best: tuple[float, Understood] | None = None
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
            known[i] = np.abs(predicted).max(axis=0) > LEAST * enough
            power = np.maximum((predicted**2).sum(axis=0), 1e-300)
            gain[i] = (moved * predicted).sum(axis=0) / power
            unlike += float((1 - alike[level, far]).sum()) / len(responses)
        cost, wiring = explained(gain, known)
        cost += SHAPE * unlike + (order != tuple(range(n)))
        if best is None or cost < best[0] - 1e-9:
            wiring = Wiring(wiring.inputs, wiring.encoders, order)
            outer = wiring.inputs[:, None] * wiring.encoders[None, :]
            best = cost, Understood(wiring, gain / np.where(outer == 0, np.nan, outer), known)
    assert best is not None  # the model's own order is one
    return best[1]
