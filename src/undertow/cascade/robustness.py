"""What a surface must bear before a bench may meet it: delay, noise, and a weaker actuator.

Inside the boundary layer the law is smooth; at the target it is a state feedback u = k x.
Held from sample to sample and applied d samples late it closes a discrete loop whose
spectral radius says whether it is stable.  A surface can be excellent on the model and yet
bear no delay: near-singular ones (37) have the largest gains.  And far from the target the
cheapest motion uses all of the actuator, so that a motor a little weaker than its data sheet
loses it.  The same gains turn what an estimator does not know of the state, one count of an
encoder, into input: of a near-singular surface more than the actuator has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from undertow.base import InvalidInputError
from undertow.closed_loop import INADMISSIBLE, ClosedLoop, Ensemble, Event
from undertow.closed_loop.gate import Admission, cost_gate, gate_words
from undertow.law import Plan, ReachingLaw, Surface, feedback_at_target
from undertow.models import FloatArray, Mechanism, linearise


def _exponential(A: FloatArray) -> FloatArray:
    """Return e^A by Taylor's series and squaring.

    SciPy's, in a process that may have no thread more, waits for ever.
    """
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(A).sum(axis=1).max()), 1e-300))) + 2)
    part = A / 2.0**halvings
    term = total = np.eye(len(A))
    for k in range(1, 15):
        term = term @ part / k
        total = total + term
    return np.asarray(np.linalg.matrix_power(total, 2**halvings))


@lru_cache(maxsize=32)
def _sampled(mechanism: Mechanism, period: float) -> tuple[FloatArray, FloatArray]:
    """Return the linear model at the target with its input held for a period."""
    lin = linearise(mechanism)
    A, B = lin.A, lin.input
    size = A.shape[0] + B.shape[1]
    whole = np.zeros((size, size))
    whole[: len(A)] = np.hstack([A, B])
    held = _exponential(whole * period)
    return held[: len(A), : len(A)], held[: len(A), len(A) :]


def _stable(A: FloatArray, B: FloatArray, k: FloatArray, late: int) -> bool:
    """Whether u = k x, applied ``late`` samples after x, holds the sampled system."""
    size, m = B.shape
    loop = np.zeros((size + late * m, size + late * m))
    loop[:size, :size] = A
    if late == 0:
        loop[:size, :size] += B @ k
    else:
        loop[:size, size : size + m] = B
        shift = (late - 1) * m
        loop[size : size + shift, size + m :] = np.eye(shift)
        loop[size + shift :, :size] = k
    return bool(np.abs(np.linalg.eigvals(loop)).max() < 1.0)


def delay_margin(
    mechanism: Mechanism,
    surface: Surface,
    reaching: ReachingLaw | None = None,
    *,
    period: float = 0.001,
    longest: float = 0.05,
) -> float:
    """Return the longest delay, s, in whole periods, that the loop at the target bears.

    Parameters
    ----------
    mechanism
        The model.
    surface, reaching
        The law; the paper's gains by default.
    period
        Sampling period, s.
    longest
        Where to stop looking, s.

    Returns
    -------
    float
        Stable up to and including this delay; −period where the sampled loop is unstable
        without any.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> round(delay_margin(rig, ut.first_surface(rig)), 3)
    0.007
    """
    if not (0 < period < math.inf and 0 <= longest <= 1000 * period):
        raise InvalidInputError(
            "period and longest delay",
            value=(period, longest),
            limit="0 < period, 0 ≤ longest ≤ 1000 periods",
        )
    A, B = _sampled(mechanism, period)
    k = feedback_at_target(mechanism, surface, reaching)
    late = 0
    while late * period <= longest and _stable(A, B, k, late):
        late += 1
    return (late - 1) * period


def noise_share(
    mechanism: Mechanism,
    surface: Surface,
    covariance: FloatArray,
    reaching: ReachingLaw | None = None,
) -> float:
    """Return the standard deviation of the input at the target that is noise alone.

    With u = k x̂ near the target and an error of the estimate with covariance P it is
    √(k P kᵀ)_ii, as a part of the input's limit; of several inputs the largest part.

    Parameters
    ----------
    mechanism
        The model; an input without a limit does not count.
    surface, reaching
        The law; the paper's gains by default.
    covariance
        P of the estimated state, (2n, 2n).

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> noise_share(rig, ut.first_surface(rig), np.zeros((4, 4)))
    0.0
    """
    k = feedback_at_target(mechanism, surface, reaching)
    variances = np.einsum("ij,jk,ik->i", k, covariance, k)
    return float((np.sqrt(np.maximum(variances, 0.0)) / mechanism.input_limits).max())


def sticking_distance(
    mechanism: Mechanism,
    surface: Surface,
    disturbance: FloatArray,
    reaching: ReachingLaw | None = None,
) -> float:
    """Return how far free joints are off at least before a driven joint that sticks moves again.

    Near the target u = k x.  Where a driven joint turns round, friction turns with it, and what was
    taken off for it before adds to it: until k_u q_u is more than both the joint stands, and the
    free ones fall.  ‖q_u‖ = 2 |d_i| / ‖k_u,i‖ for the input i, rad or m; of several inputs the
    largest.  A soft law sways so far from side to side for ever, however well it does without
    friction.  0 where the free joints do not fall while the driven ones stand, as one that hangs.

    Parameters
    ----------
    mechanism
        The model.
    surface, reaching
        The law; the paper's gains by default.
    disturbance
        Size of the matched disturbance, (m,), in the inputs' units.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> round(sticking_distance(rig, ut.first_surface(rig), np.array([2.0])), 3)
    0.027
    """
    sizes = np.abs(np.asarray(disturbance, dtype=float))
    if sizes.shape != (mechanism.m,) or not np.isfinite(sizes).all():
        raise InvalidInputError(
            "disturbance that holds a joint",
            value=disturbance,
            limit=f"{mechanism.m} finite numbers, one for each input",
        )
    if not sizes.any() or not _falls(mechanism):
        return 0.0
    k = feedback_at_target(mechanism, surface, reaching)
    gains = np.linalg.norm(k[:, mechanism.m : mechanism.n], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.where(sizes > 0, 2.0 * sizes / gains, 0.0).max())


@lru_cache(maxsize=32)
def _falls(mechanism: Mechanism) -> bool:
    """Whether free joints leave the target while the driven ones stand."""
    lin, n, m = linearise(mechanism), mechanism.n, mechanism.m
    A, B = lin.A[n:], lin.input[n:]
    held = A[m:] - B[m:] @ np.linalg.solve(B[:m], A[:m])  # what holds the driven ones moves these
    free = np.r_[m:n, n + m : 2 * n]
    block = np.vstack([np.eye(2 * (n - m))[n - m :], held[:, free]])
    return bool(np.linalg.eigvals(block).real.max() > 1e-9)


@dataclass(frozen=True)
class DelayGate:
    """A gate that, besides the cost, asks every surface to bear a delay.

    Parameters
    ----------
    least
        Smallest :func:`delay_margin` that is admitted, s: three times what is known of the
        delays leaves room for what is not.
    period
        Sampling period of the inner loop, s.
    """

    least: float
    period: float = 0.001

    @property
    def words(self) -> str:
        """What it asks for."""
        return f"{gate_words(cost_gate)}, bears {1e3 * self.least:.3g} ms of delay"

    def __call__(
        self, loop: ClosedLoop, old: Plan, new: Plan, x: FloatArray, horizon: float
    ) -> Admission:
        """Decide on a plan, as :func:`undertow.cascade.cost_gate` does."""
        limits = {"period": self.period, "longest": self.least}
        laws = zip(new.surfaces, new.laws(loop.reaching), strict=True)
        for surface, law in () if new == old else laws:
            margin = delay_margin(loop.mechanism, surface, law, **limits)
            if margin < self.least - 1e-9:
                wanted = f"wanted {1e3 * self.least:.3g} ms"
                reason = f"bears {1e3 * margin:.3g} ms of delay, {wanted}"
                return _refused(loop, old, x, horizon, reason)
        return cost_gate(loop, old, new, x, horizon)


def _refused(loop: ClosedLoop, old: Plan, x: FloatArray, horizon: float, why: str) -> Admission:
    """Return a refusal with the cost of the plan that stays."""
    score = float(loop.batch(x, old, duration=horizon, precise=True).score(horizon)[0])
    return Admission(False, why, score if score < INADMISSIBLE else math.inf)


def derate_actuator(loop: ClosedLoop, reserve: float) -> ClosedLoop:
    """Return the loop on the believed plant with input limits that are lower by a part of them.

    An ensemble becomes that plant alone: the kernels stay, and nothing has to be looked up.
    """
    if loop.plant is not None:
        loop = replace(loop, plant=None)
    weak = loop.mechanism.with_input_limit(*(1.0 - reserve) * loop.mechanism.input_limits)
    ensemble = None
    if loop.ensemble is not None:
        ensemble = Ensemble(loop.ensemble.plant, weak.parameter_values[None])
    return loop.believing(weak, ensemble).with_steps(loop.step, 0.0)


@dataclass(frozen=True, eq=False)
class BenchGate:
    """The gate that :func:`robustness_gate` returns; a plain record, so it can be pickled."""

    late: DelayGate
    reserve: float
    seconds: float
    covariance: FloatArray | None
    noise: float

    @property
    def words(self) -> str:
        """What it asks for."""
        quiet = f", at most {100 * self.noise:g} % of the input is noise"
        return (
            f"{self.late.words}, does with {100 * self.reserve:g} % less input"
            f"{'' if self.covariance is None else quiet}"
        )

    def _noisiest(self, loop: ClosedLoop, plan: Plan) -> float:
        if self.covariance is None:
            return 0.0
        pairs = zip(plan.surfaces, plan.laws(loop.reaching), strict=True)
        return max(noise_share(loop.mechanism, s, self.covariance, law) for s, law in pairs)

    def __call__(
        self, loop: ClosedLoop, old: Plan, new: Plan, x: FloatArray, horizon: float
    ) -> Admission:
        """Decide on a plan, as :func:`undertow.cascade.cost_gate` does."""
        admission = self.late(loop, old, new, x, horizon)
        if not admission.accepted or new == old:
            return admission
        share = self._noisiest(loop, new)
        if share > max(self.noise, self._noisiest(loop, old)):
            most = f"{100 * self.noise:g} % at most"
            why = f"{100 * share:.3g} % of the input would be noise, {most}"
            return _refused(loop, old, x, horizon, why)
        weak = derate_actuator(loop, self.reserve)
        event = Event(int(weak.batch(x, new, duration=min(self.seconds, horizon)).event[0]))
        if event in (Event.HORIZON, Event.REACHED):
            return admission
        why = f"with {100 * self.reserve:g} % less input: {event.name.lower()}"
        return _refused(loop, old, x, horizon, why)


def robustness_gate(
    least: float,
    reserve: float = 0.15,
    *,
    period: float = 0.001,
    seconds: float = 4.0,
    covariance: FloatArray | None = None,
    noise: float = 0.2,
) -> BenchGate:
    """Return a gate that asks for a delay margin, little noise, and a reserve of the actuator.

    Parameters
    ----------
    least
        Smallest :func:`delay_margin`, s.
    reserve
        Part of the inputs' limits that may be missing: a new plan must stay in the region
        where its law exists, and not diverge, on a plant whose limits are lower by this.
    period
        Sampling period of the inner loop, s.
    seconds
        How far that is looked ahead.
    covariance
        Of what an estimator does not know of the state, (2n, 2n); ``None``: nothing.
    noise
        Largest :func:`noise_share` that this may cause, where the old plan causes less.
    """
    return BenchGate(DelayGate(least, period), reserve, seconds, covariance, noise)
