"""Who enters the league: a small protocol, the library's own controllers, and those of others."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from undertow.base import InvalidInputError, a_kind, error_text
from undertow.cascade import Cascade
from undertow.estimators import Belief, Estimator, StateFeedback
from undertow.law import first_surface
from undertow.models import FloatArray, Mechanism
from undertow.models.importers.python_file import in_a_file, named_in_file
from undertow.objective import Objective
from undertow.plants.bench import bench_for
from undertow.runtime import estimator_for
from undertow.studies.trials.steering import (
    cascade_and_kept,
    clipped_regulator,
    keeping,
    predictive,
)
from undertow.studies.trials.trial import MakeController, introduce

#: Settings of a controller by name: what it is made with besides mechanism and objective.
Setting = Mapping[str, Any]


class Entrant(Protocol):
    """A controller in the league, made by a class or function: ``NAME(mechanism, objective)``.

    It knows the mechanism as it is in the library and the objective that is scored.  What makes it
    may have an attribute ``settings``, a list of keyword arguments to choose from: the league tries
    at most :data:`MOST_SETTINGS` of them on plants that are not scored, and takes the best.  One
    that is a :class:`undertow.studies.trials.trial.TakesEstimator` is given the estimator.
    """

    def reset(self, x0: FloatArray) -> None:
        """Begin a run: the estimated start is (q, q̇), (2n,), SI units."""

    def step(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input, (m,), at the time t, s, and the estimated state, (2n,); every 1 ms."""


#: What makes an entrant.
Maker = Callable[..., Entrant]

#: Settings that are tried for each entrant and mechanism: the same budget for all.
MOST_SETTINGS = 4

#: Why an entrant forfeits a run.
FAULTS = ("none", "raised", "wrong_shape", "not_finite")


class ForfeitError(Exception):
    """An entrant gave no input."""

    def __init__(self, fault: int, words: str) -> None:
        super().__init__(words)
        self.fault = fault


class Refereed:
    """An entrant in a run: its inputs are checked, its processor time is counted.

    ``seconds`` has the processor time of every step, s. Raises ForfeitError when the entrant
    raises, or has not both methods of an :class:`Entrant`.
    """

    def __init__(self, entrant: Entrant, x0: FloatArray, m: int) -> None:
        self.entrant, self.m = entrant, m
        self.seconds: list[float] = []
        for method in ("reset", "step"):
            if not callable(getattr(entrant, method, None)):
                raise ForfeitError(1, f"{type(entrant).__name__} has no method {method}")
        self._call(entrant.reset, x0.copy())

    def listen(self, estimator: Estimator) -> None:
        """Hand the estimator to an entrant that listens."""
        self._call(introduce, self.entrant, estimator)

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x).

        Raises ForfeitError when the entrant raises, or its answer is no input.
        """
        began = time.process_time()
        answer = self._call(self.entrant.step, t, x.copy())
        self.seconds.append(time.process_time() - began)
        try:
            if np.iscomplexobj(answer):  # NumPy would drop the imaginary part
                raise TypeError("complex numbers")
            u = np.asarray(answer, dtype=float).reshape(-1)
        except (TypeError, ValueError) as error:
            raise ForfeitError(2, f"no numbers: {str(answer)[:80]}") from error
        if u.shape != (self.m,):
            raise ForfeitError(2, f"{u.size} inputs for {self.m}")
        if not np.isfinite(u).all():
            raise ForfeitError(3, f"input {u} at {t:g} s")
        return u

    @staticmethod
    def _call(what: Callable[..., Any], *given: Any) -> Any:
        try:
            return what(*given)
        except (Exception, SystemExit) as error:
            raise ForfeitError(1, error_text(error)) from error


class Feedback:
    """An entrant made of a state feedback that is begun anew for each run."""

    def __init__(self, begin: MakeController) -> None:
        self.begin = begin

    def reset(self, x0: FloatArray) -> None:
        """Begin a run."""
        self._feedback = self.begin(x0)

    def listen(self, estimator: Estimator) -> None:
        """Hand the estimator to a state feedback that listens."""
        introduce(self._feedback, estimator)

    def step(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x)."""
        return self._feedback(t, x)


@dataclass(frozen=True)
class _Told:
    """An estimator, which is like another one where its noise is."""

    noise: bytes
    estimator: Estimator = field(compare=False)


@lru_cache(maxsize=4)
def _optimised(
    mechanism: Mechanism, objective: Objective, told: _Told
) -> tuple[MakeController, MakeController]:
    cascade = Cascade(mechanism, objective)
    return cascade_and_kept(cascade, told.estimator, mechanism.usual_start)


class Optimised:
    """The cascade as ``undertow run`` makes it for its estimator, or its first optimum kept.

    Where none is handed over, that is the estimator of the usual bench.
    """

    def __init__(self, mechanism: Mechanism, objective: Objective, *, kept: bool) -> None:
        self.mechanism, self.objective, self.kept = mechanism, objective, kept

    def reset(self, x0: FloatArray) -> None:
        """Begin a run."""
        self._x0 = x0
        self._feedback: StateFeedback | None = None

    def listen(self, estimator: Estimator) -> None:
        """Hand the estimator over."""
        self._feedback = self._made_for(estimator)
        introduce(self._feedback, estimator)

    def step(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x)."""
        if self._feedback is None:
            mechanism = self.mechanism
            known = Belief.usual(mechanism)
            usual = estimator_for(mechanism, bench_for(mechanism), known=known)
            self._feedback = self._made_for(usual)
        return self._feedback(t, x)

    def _made_for(self, estimator: Estimator) -> StateFeedback:
        told = _Told(estimator.noise_covariance().tobytes(), estimator)
        return _optimised(self.mechanism, self.objective, told)[self.kept](self._x0)


def steered(mechanism: Mechanism, objective: Objective) -> Optimised:
    """Return the cascade as ``undertow run`` makes it."""
    return Optimised(mechanism, objective, kept=False)


def kept(mechanism: Mechanism, objective: Objective) -> Optimised:
    """Return the cascade's first optimum, kept."""
    return Optimised(mechanism, objective, kept=True)


def designed(mechanism: Mechanism, objective: Objective) -> Feedback:
    """Return sliding mode on the designed surface, which nothing optimises."""
    return Feedback(keeping(mechanism, first_surface(mechanism)))


def regulator(mechanism: Mechanism, objective: Objective, free: float) -> Feedback:
    """Return a linear-quadratic regulator, its output clipped; ``free`` weighs q_u."""
    return Feedback(clipped_regulator(mechanism, free=free))


def predictive_at_10_hz(mechanism: Mechanism, objective: Objective, horizon: float) -> Feedback:
    """Return nonlinear model-predictive control, IPOPT, open loop between two solutions."""
    return Feedback(predictive(mechanism, objective.on(mechanism), horizon=horizon))


@dataclass(frozen=True)
class Entry:
    """An entrant's name, what makes it, and the settings to choose from."""

    name: str
    make: Maker
    settings: Sequence[Setting] = ({},)

    @classmethod
    def of(cls, name: str) -> Entry:
        """Return the entry of a name of the library, or of ``FILE.py:NAME``.

        Raises InvalidInputError when it cannot be called, or its settings are none.
        """
        if not in_a_file(name):
            return OURS[name]
        make = named_in_file(name, "entrant")
        if not callable(make):
            raise InvalidInputError(
                f"entrant '{name}'",
                value=a_kind(make),
                limit="a class or function of (mechanism, objective)",
            )
        settings = getattr(make, "settings", [{}])
        good = isinstance(settings, list | tuple) and all(isinstance(s, Mapping) for s in settings)
        if not good or not 1 <= len(settings) <= MOST_SETTINGS:
            raise InvalidInputError(
                f"settings of entrant '{name}'",
                value=str(settings)[:80],
                limit=f"a list of 1 to {MOST_SETTINGS} mappings of keyword arguments",
            )
        return cls(name.rpartition(":")[2], make, list(settings))


#: The library's entrants by name.
OURS = {
    entry.name: entry
    for entry in (
        Entry("cascade", steered),
        Entry("kept", kept),
        Entry("designed", designed),
        Entry("lqr", regulator, [{"free": weight} for weight in (1.0, 10.0, 100.0, 1000.0)]),
        Entry("nmpc", predictive_at_10_hz, [{"horizon": s} for s in (0.8, 1.2, 2.0, 3.0)]),
    )
}


def spent(seconds: list[float]) -> tuple[float, float]:
    """Return the mean and the longest of the times of steps, but for the first, s."""
    later = seconds[1:]
    return (float(np.mean(later)), float(np.max(later))) if later else (math.nan, math.nan)
