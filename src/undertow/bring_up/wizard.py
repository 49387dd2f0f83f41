"""Bring-up of a rig, step by step: listen, push a little, compare, correct, identify."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from undertow.bring_up.identify import Identification, identify
from undertow.bring_up.motion import GuardError, Record, doublets, perform, ramp
from undertow.bring_up.predict import Predictor
from undertow.bring_up.rest import rest_state
from undertow.bring_up.wiring import KNOWN, Wiring, explain, known_factor
from undertow.mechanism import FloatArray, Mechanism
from undertow.rig.interface import Rig

__all__ = ["BringUp", "Finding", "bring_up"]

#: Shares of an input's limit that are tried, from the smallest, until something moves.
SHARES = (0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5)

#: Motion that is enough to compare, and the most that is allowed, rad and m.
ENOUGH = {"rad": 0.2, "m": 0.08}
MOST = {"rad": 2.0, "m": 0.6}

#: A parameter is called wrong where it changes the motion by more than this part of it.
MATTERS = 0.05

#: Longest wait for rest between two motions, s: a good joint swings for minutes.
CALM = 240.0

Verdict = Literal["right", "wrong", "unclear"]


@dataclass(frozen=True)
class Finding:
    """What one check found.

    Attributes
    ----------
    check, part
        What was checked, of which part.
    measured, expected
        In words, with units.
    verdict
        ``"right"``, ``"wrong"``, or ``"unclear"`` where the motion does not tell.
    remedy
        What to do about it.
    """

    check: str
    part: str
    measured: str
    expected: str
    verdict: Verdict
    remedy: str = ""


@dataclass(frozen=True, eq=False)
class BringUp:
    """All that a bring-up found.

    Attributes
    ----------
    findings
        In the order of the checks.
    wiring
        Factors between rig and model.
    identification
        Parameters, where the wiring allowed it.
    record
        The motion that they were identified from, in the model's signs and scales.
    """

    findings: tuple[Finding, ...]
    wiring: Wiring | None
    identification: Identification | None
    record: Record | None

    @property
    def wrong(self) -> tuple[Finding, ...]:
        """What is wrong."""
        return tuple(f for f in self.findings if f.verdict == "wrong")


def bring_up(
    rig: Rig,
    belief: Mechanism,
    *,
    delay: float | None = None,
    rest: FloatArray | None = None,
    learn: bool = True,
    progress: Callable[[str, float], None] | None = None,
) -> BringUp:
    """Check a rig against its model by small safe motions from rest.

    Parameters
    ----------
    rig
        At rest, nothing else moving it.
    belief
        The model.
    delay
        From a write to its effect in a reading, s, as it should be; ``None``: not compared.
    rest
        The state it rests in, (2n,); found from the model by default.
    learn
        Also a longer motion, from which delay, friction and parameters are identified.
    progress
        Told what is under way, and the fraction done.

    Raises
    ------
    InfeasibleError
        When the model has no rest to start from.
    """
    wizard = _Wizard(rig, belief, rest_state(belief) if rest is None else rest)
    tell = progress or (lambda _what, _fraction: None)
    tell("listening", 0.0)
    if not wizard.listen():
        return wizard.result()
    tell("small pushes", 0.1)
    if not wizard.push():
        return wizard.result()
    tell("slow ramps", 0.25)
    wizard.break_away()
    if not learn:
        return wizard.result()
    tell("a longer motion", 0.3)
    wizard.learn(delay, lambda what, part: tell(what, 0.35 + 0.65 * part))
    return wizard.result()


class _Wizard:
    """The state of one bring-up: findings so far, the rig as it is understood."""

    def __init__(self, rig: Rig, belief: Mechanism, rest: FloatArray) -> None:
        self.rig, self.belief, self.rest = rig, belief, rest
        self.findings: list[Finding] = []
        self.wiring: Wiring | None = None
        self.identification: Identification | None = None
        self.record: Record | None = None
        self.share, self.breakaway = np.zeros(belief.m), np.zeros(belief.m)
        self.predictor = Predictor(belief, rest)
        units = [c.unit for c in belief.coordinates]
        room = np.array([c.high - c.low for c in belief.coordinates])
        self.enough = np.minimum([ENOUGH[u] for u in units], 0.2 * room)
        self.guard = np.minimum([MOST[u] for u in units], 0.6 * room)

    def result(self) -> BringUp:
        """Return what was found."""
        return BringUp(tuple(self.findings), self.wiring, self.identification, self.record)

    def _add(
        self,
        check: str,
        part: str,
        measured: str,
        expected: str,
        *,
        verdict: Verdict,
        remedy: str = "",
    ) -> None:
        self.findings.append(Finding(check, part, measured, expected, verdict, remedy))

    def _settle(self, seconds: float = CALM) -> FloatArray:
        """Leave the inputs at zero until nothing moves, or for so long: the last motion, (n,)."""
        count = round(0.5 / self.rig.period)
        moved = np.full(self.belief.n, np.inf)
        for _ in range(max(1, round(seconds / 0.5))):
            rows = []
            for _ in range(count):
                rows.append(np.array(self.rig.read().q, dtype=float))
                self.rig.write(np.zeros(self.belief.m))
            moved = np.ptp(np.array(rows), axis=0)
            if not (moved > self.enough / 40).any():
                break
        return np.asarray(moved)

    # -- listening ---------------------------------------------------------------------------

    def listen(self) -> bool:
        """Whether every encoder answers and nothing moves by itself."""
        good = True
        for c, moved, enough in zip(
            self.belief.coordinates, self._settle(), self.enough, strict=True
        ):
            if np.isnan(moved):
                good = False
                self._add(
                    "signal", c.name, "readings that are no numbers", "all numbers",
                    verdict="wrong", remedy="Look at the encoder's cable and supply",
                )  # fmt: skip
                continue
            calm = bool(moved < enough / 4)
            good &= calm
            self._add(
                "at rest", c.name, f"moves by {_quantity(moved, c.unit)} in 0.5 s",
                f"below {_quantity(enough / 4, c.unit)}",
                verdict="right" if calm else "wrong",
                remedy="" if calm else "Let it come to rest, with the inputs at zero",
            )  # fmt: skip
        return good

    # -- pushes: signs and scales -------------------------------------------------------------

    def _one(self, i: int, values: FloatArray) -> FloatArray:
        u = np.zeros((len(values), self.belief.m))
        u[:, i] = values
        return u

    def _predicted(self, record: Record, i: int) -> FloatArray:
        """The motion that the model makes of a push of input i, (N, n), about its start.

        Of some levels of dry friction the one is taken whose motion is most alike in shape,
        whatever its signs and scales.
        """
        belief, n = self.belief, self.belief.n
        moved = record.moved
        level = abs(float(belief.input_matrix.subs(belief.substitution)[i, i]))
        level *= float(np.abs(record.u[:, i]).max())
        best, likest = np.zeros_like(moved), -1.0
        for share in (0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.75):
            coulomb = np.zeros((2, n))
            coulomb[:, : belief.m] = share * level
            states = self.predictor.states(
                record, belief.parameter_values, coulomb, np.zeros(n), np.ones(belief.m)
            )
            predicted = self.predictor.positions(record, states, 1.5 * self.rig.period)
            predicted -= self.rest[:n]
            power = np.sqrt((predicted**2).sum(axis=0) * (moved**2).sum(axis=0))
            alike = np.abs((predicted * moved).sum(axis=0)) / np.maximum(power, 1e-300)
            likeness = float(alike.sum())
            if likeness > likest:
                best, likest = predicted, likeness
        return best

    def push(self) -> bool:
        """Whether every input moves something and every encoder follows; else what is wrong."""
        belief = self.belief
        gain = np.zeros((belief.m, belief.n))
        known = np.zeros((belief.m, belief.n), dtype=bool)
        for i, channel in enumerate(belief.inputs):
            for share in SHARES:
                self._settle()
                self.share[i] = share
                push = doublets(share * channel.limit, [0.1], 0.15, self.rig.period)
                try:
                    record = perform(self.rig, self._one(i, push), 30.0 * self.guard)
                except GuardError:
                    break
                predicted, moved = self._predicted(record, i), record.moved
                size = np.abs(predicted).max(axis=0)
                known[i] = size > 0.1 * self.enough
                power = (predicted**2).sum(axis=0)
                gain[i] = (moved * predicted).sum(axis=0) / np.maximum(power, 1e-300)
                if (np.abs(moved[:, : belief.m]).max(axis=0) > self.enough[: belief.m]).any() or (
                    (size > self.guard).any()
                ):
                    break
        self.wiring = explain(gain, known)
        self._tell(gain, known)
        whole = bool((self.wiring.inputs != 0).all() and (self.wiring.encoders != 0).all())
        if not whole:
            self._add(
                "identification", "the rig", "left out", "every input and encoder at work",
                verdict="unclear", remedy="Mend what is wrong above, and come again",
            )  # fmt: skip
        return whole

    def _tell(self, gain: FloatArray, known: FloatArray) -> None:
        assert self.wiring is not None  # made by the caller
        parts = [("input", i.name, f, "amplifier and motor") for i, f in
                 zip(self.belief.inputs, self.wiring.inputs, strict=True)]  # fmt: skip
        parts += [("encoder", c.name, f, "encoder") for c, f in
                  zip(self.belief.coordinates, self.wiring.encoders, strict=True)]  # fmt: skip
        reached = np.asarray(known.any(axis=0))
        for index, (kind, name, factor, what) in enumerate(parts):
            j = index - self.belief.m
            if factor == 0.0:
                verb = "moves nothing" if kind == "input" else "does not move"
                self._add(
                    kind, name, verb, "moves", verdict="wrong",
                    remedy=f"Look at cable, supply and enable of the {what}",
                )  # fmt: skip
                continue
            if j >= 0 and not reached[j]:
                self._add(kind, name, "nothing reaches it", "moves", verdict="unclear",
                          remedy="No input moves it from rest: check it by hand")  # fmt: skip
                continue
            seen = abs(factor) * self._typical(gain, known, index)
            sign_right, scale_right = factor > 0, abs(factor) == 1.0
            self._add(f"{kind} sign", name, "as the model" if sign_right else "reversed",
                      "as the model", verdict="right" if sign_right else "wrong",
                      remedy="" if sign_right else f"Swap the leads of {name}, or negate it"
                      " in the driver")  # fmt: skip
            words = known_factor(factor)
            remedy = f"Divide by {abs(factor):.3g}" + f": it looks like {words}" * bool(words)
            self._add(f"{kind} scale", name, f"{abs(seen):.3g} of the model's", "1 within 45 %",
                      verdict="right" if scale_right else "wrong",
                      remedy="" if scale_right else remedy)  # fmt: skip

    def _typical(self, gain: FloatArray, known: FloatArray, index: int) -> float:
        """The measured factor of a part that is within tolerance."""
        assert self.wiring is not None  # made by the caller
        m = self.belief.m
        outer = self.wiring.inputs[:, None] * self.wiring.encoders[None, :]
        ratio = gain / np.where(outer == 0, np.nan, outer)
        values = (
            ratio[index][known[index]] if index < m else ratio[:, index - m][known[:, index - m]]
        )
        values = values[np.isfinite(values)]
        return float(np.median(values)) if len(values) else 1.0

    # -- friction, delay, parameters ------------------------------------------------------------

    def break_away(self) -> None:
        """How much each input must do before its joint moves, both ways."""
        assert self.wiring is not None  # push() came first
        rig = self.wiring.corrected(self.rig)
        until = np.where(np.arange(self.belief.n) < self.belief.m, self.enough / 20, np.inf)
        for i, channel in enumerate(self.belief.inputs):
            levels = []
            for side in (1.0, -1.0):
                self._settle()
                rise = ramp(side * 0.3 * channel.limit, 1.5, self.rig.period)
                record = perform(rig, self._one(i, rise), 30 * self.guard, until=until)
                levels.append(abs(float(record.u[-1, i])))
            up, down = levels
            self.breakaway[i] = 0.5 * (up + down)
            even = max(up, down) < 2.0 * min(up, down) + 0.02 * channel.limit
            level = 0.5 * (up + down)
            light = level < 0.25 * channel.limit
            self._add(
                "breakaway", channel.name,
                f"{up:.3g} one way, {down:.3g} {channel.unit} the other",
                f"alike, below {0.25 * channel.limit:.3g} {channel.unit}",
                verdict="wrong" if not light else "right" if even else "unclear",
                remedy=""
                if even and light
                else "Look for what rubs, for a cable that pulls, or for a load that still swings",
            )  # fmt: skip

    def _modest(self, u: FloatArray) -> FloatArray:
        """Return inputs small enough for what the model says they do: within half the guards."""
        belief, n = self.belief, self.belief.n
        gain = np.abs(np.array(belief.input_matrix.subs(belief.substitution), dtype=float))
        coulomb = np.zeros((2, n))
        coulomb[:, : belief.m] = gain @ self.breakaway
        t = np.arange(len(u), dtype=np.float64) * self.rig.period
        for _ in range(20):
            states = self.predictor.states(
                Record(t, np.zeros((len(u), n)), u), belief.parameter_values, coulomb,
                np.zeros(n), np.ones(belief.m),
            )  # fmt: skip
            if (np.abs(states[:, :n] - self.rest[:n]).max(axis=0) <= 0.5 * self.guard).all():
                break
            u = 0.85 * u
        return u

    def learn(self, delay: float | None, progress: Callable[[str, float], None]) -> None:
        """Identify delay, friction and parameters from a longer motion."""
        assert self.wiring is not None  # push() came first
        rig = self.wiring.corrected(self.rig)
        widths = [0.05, 0.1, 0.2, 0.1, 0.05, 0.2, 0.15, 0.3]
        parts = []
        for i, channel in enumerate(self.belief.inputs):
            factor = min(1.6, 0.6 / self.share[i])
            level = factor * self.share[i] * channel.limit / max(1.0, abs(self.wiring.inputs[i]))
            parts.append(self._one(i, doublets(level, widths, 0.3, self.rig.period)))
        u = self._modest(np.vstack(parts))
        for _ in range(6):
            self._settle()
            try:
                self.record = perform(rig, u, self.guard)
                break
            except GuardError:
                u = 0.6 * u
        if self.record is None:
            self._add("identification", "the rig", "went too far", "a small motion",
                      verdict="unclear", remedy="Give it more room")  # fmt: skip
            return
        found = identify(self.belief, self.rest, self.record, progress=progress)
        self.identification = found
        late = found.estimates.get("delay")
        if late is not None and delay is not None:
            room = max(0.4 * delay, 0.5 * self.rig.period, 2 * (late.high - late.value))
            good = abs(late.value - delay) <= room
            self._add(
                "delay", "the loop", f"{1e3 * late.value:.2f} ms", f"{1e3 * delay:.2f} ms",
                verdict="right" if good else "wrong",
                remedy="" if good else f"It is {late.value / delay:.1f} times what is expected: "
                "look for a buffer, a filter, a slower bus",
            )  # fmt: skip
        for c, part in zip(self.belief.coordinates, found.explained, strict=True):
            good = part > 0.95
            self._add(
                "model", c.name, f"explains {100 * part:.2f} % of the motion", "95 % or more",
                verdict="right" if good else "wrong",
                remedy="" if good else "Something moves that the model does not have",
            )  # fmt: skip
        # A scale that was only measured by small pushes is not exact enough to blame others.
        sure = all(
            abs(factor) in (0.0, 1.0, *KNOWN.values())
            for factor in (*self.wiring.inputs, *self.wiring.encoders)
        )
        for estimate in found.estimates.values():
            if math.isfinite(estimate.nominal) and estimate.nominal:
                low, high = 0.75 * estimate.nominal, 1.33 * estimate.nominal
                good = low < estimate.value < high
                apart = estimate.high < low or estimate.low > high
                apart = apart and sure and estimate.matters > MATTERS
                self._add(
                    "parameter", estimate.name,
                    f"{estimate.value:.4g} ± {estimate.high - estimate.value:.2g} {estimate.unit}",
                    f"{estimate.nominal:.4g} {estimate.unit}, within a third",
                    verdict="right" if good else "wrong" if apart else "unclear",
                    remedy="" if good else "Weigh and measure it again, or take the identified one",
                )  # fmt: skip


def _quantity(value: float, unit: str) -> str:
    return f"{1e3 * value:.2g} m{unit}" if value < 0.1 else f"{value:.2g} {unit}"
