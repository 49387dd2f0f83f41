"""The rig that a word of ``undertow bench`` means; wired wrongly, to see whether that is found."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from undertow.base import InvalidInputError
from undertow.models import FloatArray, Mechanism
from undertow.models.importers.python_file import in_a_file
from undertow.plants import (
    IdealRig,
    Measurement,
    Paced,
    RealisticRig,
    Rig,
    RigWrapper,
    rig_from_file,
)
from undertow.plants.bench import Bench, bench_for

#: Longest delay that is put into a rig, s, and how many times its friction.
LATEST, ROUGHEST = 1.0, 1000.0


class Miswired(RigWrapper):
    """A rig with factors on its inputs and encoders, in another order, and late.

    ``inputs``, ``encoders``: factors, (m,) and (n,): −1 is a swapped sign, 0 a cable that is off.
    ``delay``: further one of the inputs, s; whole periods. ``order``: which encoder is plugged in
    where each coordinate is read; empty: as it should be.
    """

    def __init__(
        self,
        rig: Rig,
        inputs: Sequence[float] | FloatArray,
        encoders: Sequence[float] | FloatArray,
        delay: float = 0.0,
        order: Sequence[int] = (),
    ) -> None:
        super().__init__(rig)
        self._order = list(order) or slice(None)
        self._inputs, self._encoders = np.asarray(inputs), np.asarray(encoders)
        late = round(delay / rig.period)
        self._queue = deque([np.zeros(len(self._inputs))] * late)

    def read(self) -> Measurement:
        """Return what the wrong wiring says."""
        measured = self.rig.read()
        order = self._order
        v = None if measured.v is None else (measured.v * self._encoders)[order]
        return Measurement(measured.t, (measured.q * self._encoders)[order], v)

    def write(self, u: FloatArray) -> None:
        """Write what the wrong wiring lets through."""
        self._queue.append(np.asarray(u) * self._inputs)
        self.rig.write(self._queue.popleft())


def miswired(rig: Rig, mechanism: Mechanism, faults: Sequence[str]) -> Rig:
    """Return a rig with faults given in words, ``part=value``.

    They are ``voltage=-1`` (factor of an input), ``theta=2`` (factor of an encoder; 0: cable off),
    ``swap=theta,phi`` (the plugs of two encoders), ``delay=0.002`` (s, besides the rig's own, whole
    periods). Friction is the bench's: see :func:`rubbing`.

    Raises
    ------
    InvalidInputError
        For a part that the mechanism does not have or that is named twice, for what is no number,
        and for a delay that is not so many periods of the rig.
    """
    factors, order = _read(mechanism, faults)
    late = factors["delay"] / rig.period
    if late > LATEST / rig.period or abs(late - round(late)) > 1e-6:
        raise InvalidInputError(
            "fault",
            value=f"delay={factors['delay']:g}",
            limit=f"whole periods of the rig, {rig.period:g} s each, {LATEST:g} s in all",
            remedy=f"Write for instance --fault delay={2 * rig.period:g}",
        )
    if all(word.startswith("friction=") for word in faults):
        return rig
    return Miswired(
        rig,
        [factors[i.name] for i in mechanism.inputs],
        [factors[c.name] for c in mechanism.coordinates],
        factors["delay"],
        order,
    )


def rubbing(bench: Bench, faults: Sequence[str]) -> Bench:
    """Return a bench with as many times the dry friction as faults say: ``friction=10``.

    Raises
    ------
    InvalidInputError
        See :func:`miswired`.
    """
    factors, _ = _read(bench.mechanism, faults)
    return bench.with_friction(factors["friction"])


def _read(mechanism: Mechanism, faults: Sequence[str]) -> tuple[dict[str, float], list[int]]:
    """Return the factors of all parts, and the order of the encoders."""
    names = [c.name for c in mechanism.coordinates]
    factors = dict.fromkeys([*(i.name for i in mechanism.inputs), *names], 1.0)
    factors |= {"delay": 0.0, "friction": 1.0}
    limit = f"part=number, the part one of {', '.join(factors)}, each once, or swap=" + (
        ",".join(names[:2]) if mechanism.n == 2 else "COORDINATE,COORDINATE"
    )
    remedy = f"Write for instance --fault {names[0]}=-1; delay is ≥ 0, friction 0 to {ROUGHEST:g}"
    order, left = list(range(mechanism.n)), set(factors)
    for word in faults:
        part, _, value = word.partition("=")
        plugs = value.split(",")
        if part == "swap" and len(set(plugs)) == len(plugs) == 2 and set(plugs) <= set(names):
            i, k = map(names.index, plugs)
            order[i], order[k] = order[k], order[i]
            continue
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        least = 0.0 if part in ("delay", "friction") else -math.inf
        most = ROUGHEST if part == "friction" else math.inf
        if part not in left or not (math.isfinite(number) and least <= number <= most):
            raise InvalidInputError("fault", value=repr(word), limit=limit, remedy=remedy)
        left.remove(part)
        factors[part] = number
    return factors, order


def rig_named(
    word: str,
    belief: Mechanism,
    truth: Mechanism,
    rest: FloatArray,
    faults: Sequence[str] = (),
    seed: int = 0,
) -> Rig:
    """Return a simulated rig, or the driver of one's own, to be closed by who asks.

    The word is ``realistic``, ``ideal`` or ``FILE.py:NAME``; a simulated one moves as ``truth``
    says and begins at rest, (2n,), and friction among the faults is put into its bench, see
    :func:`.faults.rubbing`; the seed is a realistic one's. Raises InvalidInputError for another
    word, for faults on a rig of one's own, and for friction on the ideal one.
    """
    if in_a_file(word):
        if faults:
            raise InvalidInputError(
                "--fault",
                value=", ".join(faults),
                limit="a simulated rig",
                remedy="Leave it out: undertow bench finds what is wrong with your own rig",
            )
        return Paced(rig_from_file(word, belief))
    if word == "realistic":
        return RealisticRig(rubbing(bench_for(truth), faults), rest, seed)
    if word == "ideal":
        if any(fault.startswith("friction=") for fault in faults):
            raise InvalidInputError(
                "--fault friction",
                value="the ideal rig",
                limit="the realistic rig, which has dry friction",
                remedy="Leave --rig out",
            )
        return IdealRig(truth, rest)
    raise InvalidInputError(
        "rig",
        value=repr(word),
        limit="realistic, ideal or FILE.py:NAME",
        remedy="A driver of your own: see examples/serial_rig.py",
    )
