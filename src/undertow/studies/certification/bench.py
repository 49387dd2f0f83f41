"""The loop that `undertow run` closes on a bench: what its proof leaves out, and trials with that.

The filter predicts the state to the moment when its answer acts, τ after the reading. Where that
prediction is exact, the input from t_k + τ to t_k+1 + τ is the law's at x(t_k + τ): the held loop
of the format page's 5.6, begun when the first input acts. What makes the prediction wrong is not in
the proof; all of it is in the trials, which bound the share of rigs that are lost.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from undertow.base import Progress, UndertowError, Verdict, each, no_progress, require
from undertow.estimators import Belief, Estimator, Record
from undertow.export import Build, EmbeddedController, KalmanStep, run_on_rig
from undertow.law import ReachingLaw, Surface
from undertow.models import FloatArray, Mechanism
from undertow.plants import Bench, RealisticRig
from undertow.proofs import LoopClaim
from undertow.proofs.claims.claim import Box
from undertow.proofs.sampled import failure_bound
from undertow.runtime import estimator_for, reaching_for
from undertow.studies.certification.decide import Certified, Kept, certify_surface, no_keeping
from undertow.studies.trials.steering import keeping
from undertow.studies.trials.trial import trial

#: How long the law is tried in all, and its exported C, s of simulated time: 300 and 60 runs of the
#: shortest length, a rig each.
TRIED, EXPORTED = 2400.0, 480.0

#: States at which the two are compared; confidence of the bound on the share of rigs that are lost.
COMPARED, CONFIDENCE = 10_000, 0.999

#: Process time of the search for starts of the closed loop, s: with its proof and the trials it
#: takes less than ten minutes.
SEARCH = 150.0

#: Length of a trial, s: at least, at most, and in time constants of the slowest motion on the
#: surface; and the time in which the filter finds the velocities.
SHORTEST, LONGEST, DECAYS, FOUND = 8.0, 30.0, 10.0, 0.5


def certify_bench(
    bench: Bench,
    surface: Surface,
    start: FloatArray,
    *,
    reaching_law: ReachingLaw | None = None,
    seconds: float = 0.0,
    loop_seconds: float = SEARCH,
    uncertain: Box | None = None,
    trials: tuple[float, float] = (TRIED, EXPORTED),
    kept: Kept = no_keeping,
    progress: Progress = no_progress,
) -> Certified:
    """Decide what can be said of the loop that a run closes on a bench, keeping one surface.

    The proofs are those of :func:`certify_surface` for the input held over the bench's period, with
    the reaching law of a run by default, whose boundary layer suits the bench. Then the law and its
    exported C are tried (sampled), with all that the bench has, from the starts that are proved, or
    up to the ``start`` where none are.

    Raises
    ------
    InvalidInputError
        For a period that is not whole ms, 1 to 100.
    """
    began, mechanism, hold = time.perf_counter(), bench.mechanism, 1e3 * bench.timing.period
    whole = 1 <= round(hold) <= 100 and abs(hold - round(hold)) < 1e-9
    require(whole, "period of the bench", f"{hold:g} ms", "whole ms, 1 to 100")
    law = reaching_for(estimator_for(mechanism, bench)) if reaching_law is None else reaching_law
    box = np.column_stack([-np.abs(start), np.abs(start)])
    loop = BenchLoop(bench, surface, law, box)
    missing = left_out(loop, uncertain or {})
    base = certify_surface(
        mechanism, surface, start, reaching_law=law, seconds=seconds, loop=True,
        loop_seconds=loop_seconds, hold=round(hold), uncertain=uncertain,
        kept=lambda one: kept(replace(one, left_out=missing)), progress=progress,
    )  # fmt: skip
    found = replace(base, left_out=missing)
    proved = {c.kind: c for c in found.subject.claims}
    if "stability" not in proved:
        return found
    if "closed loop" in proved:
        box = LoopClaim.of(proved["closed loop"].claim).box(mechanism)
    slow = float(np.ceil(DECAYS / proved["stability"].verdict.margin))
    loop = replace(loop, starts=box, seconds=min(LONGEST, max(SHORTEST, slow)))
    for tried, most in zip((loop.tried, loop.exported_tried), trials, strict=True):
        remarks = (*found.subject.remarks, tried(most, progress))
        seconds = time.perf_counter() - began
        found = replace(found, subject=replace(found.subject, remarks=remarks), seconds=seconds)
        kept(found)
    return found


@dataclass(frozen=True, eq=False)
class BenchLoop:
    """The loop of a bench that keeps one surface; the bench's mechanism is the controller's model.

    ``starts``: the box of states, (2n, 2), in which trials begin. ``seconds``: of a trial, s.
    """

    bench: Bench
    surface: Surface
    law: ReachingLaw
    starts: FloatArray
    seconds: float = SHORTEST

    @property
    def mechanism(self) -> Mechanism:
        """The controller's model."""
        return self.bench.mechanism

    def _estimator(self) -> Estimator:
        return estimator_for(self.mechanism, self.bench, known=Belief.usual(self.mechanism))

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance that the filter states of its estimate at rest, (2n, 2n)."""
        return self._estimator().steady_covariance()

    @property
    def stated(self) -> FloatArray:
        """Its standard deviations, (2n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def _runs(self, most: float) -> int:
        """How many trials take so long in all, s; one at least."""
        return max(1, int(most / self.seconds))

    @property
    def _words(self) -> str:
        size = np.abs(self.starts).max(axis=1)
        names = zip(self.mechanism.state_names, size.tolist(), strict=True)
        ranges = ", ".join(f"|{name}| ≤ {most:.4g}" for name, most in names if most)
        return f"from {ranges or 'the target'}, the rest of the state 0"

    def tried(self, most: float, progress: Progress = no_progress) -> Verdict:
        """Decide by trials, of so long in all, s, whether starts come home in time and stay.

        The controller is that of `undertow run` with no other surface: filter, law, the estimated
        disturbance taken off the output. Each trial has a rig of its own.
        """
        make = keeping(self.mechanism, self.surface, self.law)
        bench, off, lost = replace(self.bench, hand={}), list[FloatArray](), list[FloatArray]()
        count = self._runs(most)
        for seed in each(range(count), progress, lambda _: "runs on random rigs"):
            x0 = self._start(seed)
            run = trial(
                self.mechanism, bench, make, x0, self.seconds, seed, estimator=self._estimator()
            )
            if run.balanced:
                off.append(self._error(run.record))
            else:
                lost.append(x0)
        words = (
            f"{self._words}, the law of a run with its filter, delay and disturbance estimate "
            f"brings random rigs of the bench home within {self.seconds:g} s, for a second"
        )
        ratio = np.mean(off, axis=0) / self.stated if off else np.full(len(self.stated), np.nan)
        errors = ", ".join(
            f"{name} {value:.2g}"
            for name, value in zip(self.mechanism.state_names, ratio.tolist(), strict=True)
        )
        more = (
            "; root mean square of what the estimate was off, in deviations that are stated at "
            f"rest: {errors}"
        )
        return self._verdict(words, count, lost, more)

    def exported_tried(self, most: float, progress: Progress = no_progress) -> Verdict:
        """Decide the same of the exported C, compiled here, beside how far its law differs."""
        words = f"{self._words}, the exported C holds random rigs of the bench"
        bench, lost = replace(self.bench, hand={}), list[FloatArray]()
        count = self._runs(most)
        try:
            controller = EmbeddedController(
                self.mechanism, self.surface, self.law, self.bench.timing.period, KalmanStep()
            )
            with tempfile.TemporaryDirectory(prefix="undertow-") as folder:
                build = Build(controller, Path(folder))
                near = build.agreement(COMPARED)
                for seed in each(range(count), progress, lambda _: "runs of the C"):
                    x0 = self._start(seed)
                    with build.start() as process:
                        rig = RealisticRig(bench, x0, seed)
                        if not run_on_rig(process, rig, self.seconds).held:
                            lost.append(x0)
        except UndertowError as error:
            return Verdict(words, "undecided", method=str(error))
        more = (
            f"; its law at {COMPARED} random states is Python's to within {near.output:.1e} of the "
            f"input limit; {controller.differentiator.description}, which predicts no delay"
        )
        return self._verdict(words, count, lost, more)

    def _start(self, seed: int) -> FloatArray:
        return np.asarray(np.random.default_rng([seed, 1]).uniform(*self.starts.T))

    def _error(self, record: Record) -> FloatArray:
        """Root mean square of what the estimate is off the state at the moment it is for."""
        late = record.t > FOUND
        acts = record.t[late] + self.bench.timing.delay
        then = np.array([np.interp(acts, record.t, column) for column in record.truth.T]).T
        return np.asarray(np.sqrt(np.mean((record.x[late] - then) ** 2, axis=0)))

    def _verdict(self, words: str, count: int, lost: list[FloatArray], more: str) -> Verdict:
        bound = failure_bound(len(lost), count, CONFIDENCE)
        method = (
            f"{count - len(lost)} of {count} simulated runs; the share that is lost is at most "
            f"{bound:.2g}, Clopper-Pearson bound at confidence {CONFIDENCE:g}{more}"
        )
        details = {"trials": count, "failures": len(lost), "failure_bound": bound}
        if lost:
            where = dict(zip(self.mechanism.state_names, lost[0].tolist(), strict=True))
            return Verdict(words, "refuted", -len(lost) / count, "", where, method, details)
        return Verdict(words, "sampled", 1 - bound, "", {}, method, details)


def left_out(loop: BenchLoop, uncertain: Box) -> Mapping[str, str]:
    """Return what the bench has and the proof has not; ``uncertain`` parameters it has."""
    bench, mechanism = loop.bench, loop.mechanism
    names, states = [c.name for c in mechanism.coordinates], mechanism.state_names
    units = dict(zip(states, mechanism.state_units, strict=True))
    forces = dict(zip(names, mechanism.force_units, strict=True))
    errors = zip(states, loop.stated.tolist(), strict=True)
    stated = ", ".join(f"{name} {value:.2g} {units[name]}" for name, value in errors)
    timing, rows = bench.timing, loop.surface.matrix
    share = np.sqrt(np.diag(rows @ loop.covariance @ rows.T))
    layer = loop.law.per_surface(mechanism.m)[1]
    of_layer = ", ".join(f"{part:.0%}" for part in share / layer)
    known = {name: width for name, width in bench.tolerance.items() if name not in uncertain}
    found = {
        "the estimate": f"it is exact in the proof. The filter states a standard deviation at rest "
        f"of {stated}, which moves s by {of_layer} of the layer",
        "the delay": f"{1e3 * timing.delay:g} ms from reading to action, ± "
        f"{1e3 * timing.jitter:g} ms. The filter predicts to the moment when its answer acts; with "
        "exact predictions the loop is the one that is proved, begun when the first input acts",
        "parameters": ", ".join(f"{name} ± {100 * width:g} %" for name, width in known.items()),
        "dry friction": ", ".join(
            f"{name} {one.coulomb:.3g}, to break away {one.F_s:.3g} {forces[name]}"
            for name, one in bench.friction.items()
        ),
        "backlash": ", ".join(bench.backlash),
        "encoders": ", ".join(
            f"{name} {one.resolution:.2g} {units[name]} a count"
            for name, one in bench.encoders.items()
        ),
        "amplifiers": ", ".join(
            f"{name} in steps of {one.resolution:.2g}"
            + f", time constant {1e3 * one.time_constant:.2g} ms" * (one.time_constant > 0)
            for name, one in bench.amplifiers.items()
        ),
        "what is learnt": "the estimated disturbance, which a run takes off the output, and "
        "parameters",
        "rounding": "the law of the proof is exact; that of Python and of the exported C is in "
        "doubles",
        "other surfaces": "a cascade changes surfaces: each is certified by itself "
        "(undertow certify --run)",
    }  # fmt: skip
    return {what: said for what, said in found.items() if said}
