"""Bring-up of a rig, step by step: listen, push a little, compare, correct, identify."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from undertow.base import Progress, no_progress, positive
from undertow.bring_up.identify import Identification, identify
from undertow.bring_up.motion import (
    GuardError,
    MotionRecord,
    Predictor,
    doublets,
    perform,
    ramp,
    rest_state,
)
from undertow.bring_up.wiring import (
    KNOWN,
    Response,
    Wiring,
    WiringEstimate,
    estimate_wiring,
    known_factor,
    push_response,
)
from undertow.models import FloatArray, Mechanism
from undertow.plants import Measurement, Rig, RigWrapper, control_loop
from undertow.plants.interface import copied, driver_errors

#: Shares of an input's limit that are tried, from the smallest, until something moves.
SHARES = (0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5)

#: Motion that is enough to compare, and the most that is allowed, rad and m.
ENOUGH = {"rad": 0.2, "m": 0.08}
MOST = {"rad": 2.0, "m": 0.6}

#: A push goes on to so many times of what is enough: what dry friction does is small then.
FAR = 2.5

#: A parameter is called wrong where it changes the motion by more than this part of it.
MATTERS = 0.05

#: How long nothing must move before it counts as at rest, s.
LOOK = 1.0

#: Longest wait for rest between two motions, s: a good joint swings for minutes.
CALM = 240.0

#: A wait ends, too, where what moves falls by less than this part from one span, s, to the next.
FALLS, SPAN = 0.1, 15.0

#: What is not measured for no longer than this, s, is taken to be as it was.
GAP = 0.02

Assessment = Literal["right", "wrong", "unclear"]


@dataclass(frozen=True)
class RigFinding:
    """What one check found.

    ``measured`` and ``expected`` are words, with units; the verdict is ``"unclear"`` where the
    motion does not tell; the remedy says what to do about it.
    """

    check: str
    part: str
    measured: str
    expected: str
    verdict: Assessment
    remedy: str = ""


@dataclass(frozen=True, eq=False)
class BringUp:
    """All that a bring-up found.

    Findings are in the order of the checks; the parameters were identified, where the wiring
    allowed it, from the record, in the model's signs and scales.
    """

    findings: tuple[RigFinding, ...]
    wiring: Wiring | None
    identification: Identification | None
    record: MotionRecord | None

    @property
    def wrong(self) -> tuple[RigFinding, ...]:
        """What is wrong."""
        return tuple(f for f in self.findings if f.verdict == "wrong")


def bring_up(
    rig: Rig,
    belief: Mechanism,
    *,
    delay: float | None = None,
    rest: FloatArray | None = None,
    learn: bool = True,
    progress: Progress = no_progress,
) -> BringUp:
    """Check a rig against its model by small safe motions from rest.

    The rig is at rest, nothing else moving it; it rests at ``rest``, (2n,), found from the model by
    default. ``delay``: from a write to its effect in a reading, s, as it should be; ``None``: not
    compared. ``learn``: also a longer motion, from which delay, friction and parameters are
    identified.

    Raises
    ------
    InfeasibleError
        When the model has no rest to start from.
    InvalidInputError
        For a delay that is negative or no number, and for readings of another number than the
        coordinates.
    ArtefactError
        When a driver fails, or a coordinate is lost during a motion: the inputs are zero then.
    """
    if delay is not None:
        positive("delay of the loop as it should be, s", delay, "0.002 is 2 ms", zero=True)
    wizard = _Wizard(rig, belief, rest_state(belief) if rest is None else rest, progress)
    wizard.begin("listening", 0.0)
    if not wizard.listen():
        return wizard.result()
    if not wizard.push():
        return wizard.result()
    wizard.break_away()
    if not learn:
        return wizard.result()
    wizard.begin("a longer motion", 0.3)
    wizard.learn(delay, lambda what, part: progress(what, 0.35 + 0.65 * part))
    return wizard.result()


class _Driver(RigWrapper):
    """A driver of one's own: what is not measured for a moment is as it was; errors in words."""

    def __init__(self, rig: Rig, n: int) -> None:
        super().__init__(rig)
        self._last, self._gap = np.full(n, np.nan), np.zeros(n)

    def _said(self, call: str) -> AbstractContextManager[None]:
        remedy = "The inputs were set to zero, if it took that: look at the driver"
        return driver_errors(f"{call} of the rig", "a rig that does what it is asked", remedy)

    def read(self) -> Measurement:
        """Return the measurement, without the gaps that are shorter than ``GAP``."""
        with self._said("read()"):
            measured = copied(self.rig.read(), len(self._last))
        missing = ~np.isfinite(measured.q)
        self._gap = np.where(missing, self._gap + self.period, 0.0)
        measured.q[missing] = np.where(self._gap > GAP, np.nan, self._last)[missing]
        self._last = measured.q.copy()
        return measured

    def write(self, u: FloatArray) -> None:
        """Apply the inputs u, (m,)."""
        with self._said("write()"):
            self.rig.write(u)


class _Wizard:
    """The state of one bring-up: findings so far, the rig as it is understood."""

    def __init__(self, rig: Rig, belief: Mechanism, rest: FloatArray, progress: Progress) -> None:
        self.rig, self.belief, self.rest = _Driver(rig, belief.n), belief, rest
        self.progress, self.at = progress, ("", 0.0)
        self.findings: list[RigFinding] = []
        self.wiring: Wiring | None = None
        self.identification: Identification | None = None
        self.record: MotionRecord | None = None
        self.share, self.breakaway = np.full(belief.m, SHARES[0]), np.zeros(belief.m)
        self.predictor = Predictor(belief, rest)
        units = [c.unit for c in belief.coordinates]
        room = np.array([c.high - c.low for c in belief.coordinates])
        self.enough = np.minimum([ENOUGH[u] for u in units], 0.2 * room)
        self.guard = np.minimum([MOST[u] for u in units], 0.6 * room)

    def begin(self, what: str, part: float) -> None:
        """Say what is done now, and what part of all is done before it."""
        self.at = what, part
        self.progress(what, part)

    def result(self) -> BringUp:
        """Return what was found."""
        return BringUp(tuple(self.findings), self.wiring, self.identification, self.record)

    def _add(
        self, check: str, part: str, measured: str, expected: str, verdict: Assessment | bool,
        remedy: str,
    ) -> None:  # fmt: skip
        """Add a finding; True is right, False wrong, and what is right needs no remedy."""
        said: Assessment = verdict if isinstance(verdict, str) else "right" if verdict else "wrong"
        remedy = "" if said == "right" else remedy
        self.findings.append(RigFinding(check, part, measured, expected, said, remedy))

    def _wait_for_rest(self, rig: Rig) -> FloatArray:
        """Leave the inputs at zero until nothing moves, for as long as that helps, (n,).

        Return how far each coordinate moved while it was watched last: once nothing moves, in
        ``LOOK``; where it goes on swinging, the most in any ``LOOK`` of the last ``SPAN``.
        """
        count, span = round(LOOK / rig.period), round(SPAN / LOOK)
        seen: list[FloatArray] = []
        while len(seen) < round(CALM / LOOK):
            loop = control_loop(rig, lambda _: np.zeros(self.belief.m), count)
            rows = [np.array(measured.q, dtype=float) for measured, _ in loop]
            seen.append(np.ptp(np.array(rows), axis=0))
            if not (seen[-1] > self.enough / 40).any():
                return seen[-1]
            self.progress(f"{self.at[0]}: it still moves", self.at[1])
            if len(seen) >= 2 * span:
                before = (np.array(seen[-2 * span : -span]) / self.enough).max()
                if (np.array(seen[-span:]) / self.enough).max() > (1 - FALLS) * before:
                    break
        return np.asarray(np.max(seen[-span:], axis=0))

    # -- listening ---------------------------------------------------------------------------

    def listen(self) -> bool:
        """Whether every encoder answers and nothing moves by itself."""
        good = True
        for c, moved, enough in zip(
            self.belief.coordinates, self._wait_for_rest(self.rig), self.enough, strict=True
        ):
            if np.isnan(moved):
                good = False
                self._add(
                    "signal", c.name, "readings that are no numbers", "all numbers", False,
                    "Look at the encoder's cable and supply",
                )  # fmt: skip
                continue
            calm = bool(moved < enough / 4)
            good &= calm
            self._add(
                "at rest", c.name, f"moves by {_quantity(moved, c.unit)} in {LOOK:g} s",
                f"below {_quantity(enough / 4, c.unit)}", calm,
                "Let it come to rest, with the inputs at zero",
            )  # fmt: skip
        return good

    # -- pushes: signs and scales -------------------------------------------------------------

    def _one(self, i: int, values: FloatArray) -> FloatArray:
        u = np.zeros((len(values), self.belief.m))
        u[:, i] = values
        return u

    def _respond(self, rig: Rig, inputs: FloatArray) -> list[Response]:
        """Push every input, through factors of the inputs, until something moves enough."""
        belief, responses = self.belief, []
        driven = np.arange(belief.n) < belief.m
        for i, channel in enumerate(belief.inputs):
            most = SHARES[-1] * min(1.0, abs(inputs[i]) or 1.0)
            response = Response.none(belief.n)
            shares = [s for s in SHARES if s <= most] or [most]
            for k, share in enumerate(shares):
                which = f"{channel.name}, {k + 1} of at most {len(shares)}"
                part = 0.1 + 0.15 * (i + k / len(shares)) / belief.m
                self.begin(f"small pushes of {which}", part)
                calm = self._wait_for_rest(rig)
                push = doublets(share * channel.limit, [0.1], 0.15, self.rig.period)
                try:
                    record = perform(rig, self._one(i, push), 30.0 * self.guard)
                except GuardError:
                    break
                self.share[i] = share
                response = push_response(self.predictor, record, i, calm)
                far = np.abs(response.moved).max(axis=0) > FAR * self.enough
                if far[driven].any() or (response.reach > self.guard).any():
                    break
            responses.append(response)
        return responses

    def push(self) -> bool:
        """Whether every input moves something and every encoder follows; else what is wrong."""
        found = estimate_wiring(self._respond(self.rig, np.ones(self.belief.m)), self.enough)
        if found.wiring.scaled:
            # A wrong scale also misleads about what is motion enough: once more without it.
            behind = found.wiring.corrected(self.rig)
            again = estimate_wiring(self._respond(behind, found.wiring.inputs), self.enough)
            found = replace(again, wiring=found.wiring.then(again.wiring))
        self.wiring = found.wiring
        self._tell(found)
        whole = bool((self.wiring.inputs != 0).all() and (self.wiring.encoders != 0).all())
        if not whole:
            self._add(
                "identification", "the rig", "left out", "every input and encoder at work",
                "unclear", "Mend what is wrong above, and come again",
            )  # fmt: skip
        return whole

    def _tell(self, found: WiringEstimate) -> None:
        names = [c.name for c in self.belief.coordinates]
        moved = [j for j, k in enumerate(found.wiring.order) if j != k]
        if moved:
            here, there = (", ".join(names[k] for k in row) for row in
                           (moved, [found.wiring.order[j] for j in moved]))  # fmt: skip
            self._add(
                "encoder order", here, f"come in as {there}", f"as {here}", False,
                f"Swap the plugs of {here}, or the readings in the driver",
            )  # fmt: skip
        parts = [("input", i.name, f, "amplifier and motor") for i, f in
                 zip(self.belief.inputs, found.wiring.inputs, strict=True)]  # fmt: skip
        parts += [("encoder", name, f, "encoder") for name, f in
                  zip(names, found.wiring.encoders, strict=True)]  # fmt: skip
        reached = np.asarray(found.known.any(axis=0))
        for index, (kind, name, factor, what) in enumerate(parts):
            j = index - self.belief.m
            if factor == 0.0:
                verb = "does not move"
                if j < 0:
                    channel = self.belief.inputs[index]
                    tried = self.share[index] * channel.limit
                    verb = f"moves nothing with {tried:.3g} {channel.unit}".rstrip()
                self._add(
                    kind, name, verb, "moves", False,
                    f"Look at cable, supply and enable of the {what}, and for what holds the joint "
                    "fast, dry friction too",
                )  # fmt: skip
                continue
            if j >= 0 and not reached[j]:
                by_hand = "No push moves it, beside how it sways: check it by hand"
                self._add(kind, name, "nothing reaches it", "moves", "unclear", by_hand)
                continue
            seen = abs(factor) * self._typical(found, index)
            sign = "as the model" if factor > 0 else "reversed"
            swap = f"Swap the leads of {name}, or negate it in the driver"
            self._add(f"{kind} sign", name, sign, "as the model", bool(factor > 0), swap)
            words = known_factor(factor) if kind == "encoder" else ""
            times = f"{abs(seen):.3g} times the model's"
            by = abs(factor if words else seen)
            divide = f"Divide by {by:.3g}" + f": it looks like {words}" * bool(words)
            right = abs(factor) == 1.0
            self._add(f"{kind} scale", name, times, "1 within 45 %", bool(right), divide)

    def _typical(self, found: WiringEstimate, index: int) -> float:
        """The measured factor of a part that is within tolerance."""
        m = self.belief.m
        at = (index,) if index < m else (slice(None), index - m)
        values = found.ratio[at][found.known[at]]
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
            most = 0.3 * channel.limit * min(1.0, abs(self.wiring.inputs[i]))
            for k, side in enumerate((1.0, -1.0), start=2 * i):
                which = f"{k + 1} of {2 * self.belief.m}"
                self.begin(f"slow ramps, {which}", 0.25 + 0.05 * k / (2 * self.belief.m))
                self._wait_for_rest(rig)
                rise = ramp(side * most, 1.5, self.rig.period)
                record = perform(rig, self._one(i, rise), 30 * self.guard, until=until)
                levels.append(abs(float(record.u[-1, i])))
            up, down = levels
            self.breakaway[i] = level = 0.5 * (up + down)
            even = max(up, down) < 2.0 * min(up, down) + 0.02 * channel.limit
            light = level < 0.25 * channel.limit
            self._add(
                "breakaway", channel.name,
                f"{up:.3g} to, {down:.3g} {channel.unit} fro",
                f"alike, below {0.25 * channel.limit:.3g} {channel.unit}",
                light and ("right" if even else "unclear"),
                "Look for what rubs, for a cable that pulls, or for a load that still swings",
            )  # fmt: skip

    def _modest(self, u: FloatArray) -> FloatArray:
        """Return inputs small enough for what the model says they do: within half the guards."""
        belief, n = self.belief, self.belief.n
        coulomb = np.zeros((2, n))
        coulomb[:, : belief.m] = np.abs(belief.B) @ self.breakaway
        t = np.arange(len(u), dtype=np.float64) * self.rig.period
        for _ in range(20):
            states = self.predictor.states(
                MotionRecord(t, np.zeros((len(u), n)), u), belief.parameter_values, coulomb,
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
            most = 0.6 * min(1.0, abs(self.wiring.inputs[i]))
            level = min(1.6 * self.share[i], most) * channel.limit
            parts.append(self._one(i, doublets(level, widths, 0.3, self.rig.period)))
        u = self._modest(np.vstack(parts))
        for _ in range(6):
            self._wait_for_rest(rig)
            try:
                self.record = perform(rig, u, self.guard)
                break
            except GuardError:
                u = 0.6 * u
        if self.record is None:
            far = "identification", "the rig", "went too far", "a small motion"
            self._add(*far, "unclear", "Give it more room")
            return
        found = identify(self.belief, self.rest, self.record, progress=progress)
        self.identification = found
        late = found.estimates.get("delay")
        if late is not None and delay is not None:
            room = max(0.4 * delay, 0.5 * self.rig.period, 2 * (late.high - late.value))
            good = abs(late.value - delay) <= room
            times = f"{late.value / delay:.1f} times what" if delay > 0 else "more than"
            self._add(
                "delay", "the loop", f"{1e3 * late.value:.2f} ms", f"{1e3 * delay:.2f} ms", good,
                f"It is {times} is expected: look for a buffer, a filter, a slower bus",
            )  # fmt: skip
        for c, part in zip(self.belief.coordinates, found.explained, strict=True):
            self._add(
                "model", c.name, f"explains {100 * part:.2f} %", "95 % or more", bool(part > 0.95),
                "Something moves that the model does not have",
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
                    "right" if good else "wrong" if apart else "unclear",
                    "Weigh and measure it again, or take the identified one",
                )  # fmt: skip


def _quantity(value: float, unit: str) -> str:
    return f"{1e3 * value:.2g} m{unit}" if value < 0.1 else f"{value:.2g} {unit}"
