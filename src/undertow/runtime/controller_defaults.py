"""What a controller is set to where it meets a rig: one home for runs, drills and trials.

Nothing here is fitted to a rig.  Estimator, gate and reaching law follow from the limits of the
mechanism, from the sampling period, and from what a bench tells of its sensors and of its delays.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from undertow.cascade import Cascade, Gate, cost_gate, noise_share, robustness_gate
from undertow.cascade.robustness import delay_margin
from undertow.estimators import Belief, Estimator, KalmanFilter
from undertow.law import SUITED, ReachingLaw, first_surface, usual_reaching
from undertow.models import Mechanism, full_accelerations
from undertow.objective import finite_limits
from undertow.plants import Bench, Encoder

#: What every admitted surface must bear: periods of delay, of no more than ``SAMPLE``, s, each, and
#: ``LEAST`` whole ones; so much less of the input; and the part of the input that noise of the
#: sensors may take, standard deviation.
BEARS, LEAST, RESERVE, NOISE = 6, 2, 0.15, 0.2

#: The period that the paper's boundary layer, η/ε = 200 per second, is for, s; and how often it may
#: be doubled for the noise; for the delay once more with a period of twice that.
SAMPLE, DOUBLED = 0.001, 3

#: Density of the drift of a matched disturbance, parts of the smallest input limit per √s.
DRIFT = 0.1

#: Standard deviation of the delay as it is told, in periods of no more than ``SAMPLE``, s, each:
#: drivers, buses and amplifiers add to what the data sheets of cards and encoders say.
UNTOLD = 4.0

#: Standard deviation of a position that is read as it is, rad or m.
EXACT = 1e-6

#: Density of what the model leaves out of an acceleration, in parts per √Hz of what the full inputs
#: do to it at the target, and at most, rad/s²/√Hz or m/s²/√Hz: also where they do nothing to it.
LEFT_OUT, MOST_LEFT_OUT = 0.0014, 0.5


def estimator_for(
    belief: Mechanism, bench: Bench, drift: float | None = None, known: Belief | None = None
) -> KalmanFilter:
    """Return the Kalman filter that knows a bench's encoders, period, jitter and delays, no more.

    ``drift``: density of the matched disturbance's drift, input units per √s; ``DRIFT`` of the
    smallest limit by default, 0 estimates none. ``known``: what is not known of the model's
    parameters, which are then learnt, as is what the delay is longer or shorter than it is told.
    """
    encoders = [bench.encoders.get(c.name, Encoder()) for c in belief.coordinates]
    full, timing = full_accelerations(belief), bench.timing
    return KalmanFilter(
        belief,
        timing.period,
        position_noise=[max(encoder.noise, EXACT) for encoder in encoders],
        acceleration_noise=np.where(
            full > 0, np.minimum(LEFT_OUT * full, MOST_LEFT_OUT), MOST_LEFT_OUT
        ),
        resolution=[encoder.resolution for encoder in encoders],
        time_noise=timing.jitter / math.sqrt(12),
        disturbance_drift=DRIFT * float(finite_limits(belief).min()) if drift is None else drift,
        delay=timing.delay,
        delay_tolerance=0.0 if known is None else UNTOLD * min(SAMPLE, timing.period),
        belief=known,
    )


def default_gate(estimator: Estimator | None = None) -> Gate:
    """Return the gate that a surface must pass where nobody asks for another: everywhere.

    With exact states, :func:`undertow.cascade.cost_gate`: stable, feasible from here, the cost
    not raised.  Before a rig may meet a surface the same, and the surface must bear a delay of
    ``BEARS`` = 6 periods (6 ms where they are longer than 1 ms, and ``LEAST`` = 2 periods in any
    case), do with ``RESERVE`` = 15 % less input, and spend no more than ``NOISE`` = 20 % of the
    input on noise.

    The estimator is that of the rig: its period, and what it does not know of the state at the
    target; ``None``: states are exact, as in a simulation.
    """
    if estimator is None:
        return cost_gate
    return robustness_gate(
        _delay(estimator.period, BEARS),
        RESERVE,
        period=estimator.period,
        covariance=estimator.steady_covariance(),
        noise=NOISE,
    )


def _delay(period: float, periods: float) -> float:
    """So many periods, of no more than ``SAMPLE`` each, or ``LEAST`` whole ones, s."""
    return max(LEAST * period, periods * min(SAMPLE, period))


def for_rig(cascade: Cascade, estimator: Estimator) -> Cascade:
    """Return a cascade that suits a rig, where it is as it stands for exact states.

    The gate becomes :func:`default_gate`, the reaching law :func:`reaching_for`, the covariance
    that of the estimator's noise.  What was chosen stays.
    """
    gate, reaching, covariance = cascade.gate, cascade.reaching, cascade.covariance
    if gate is cost_gate:
        gate = default_gate(estimator)
    if reaching in (ReachingLaw(), replace(cascade, reaching=SUITED).reaching):
        reaching = reaching_for(estimator)
    if covariance is None:
        covariance = estimator.noise_covariance()
    return replace(cascade, gate=gate, reaching=reaching, covariance=covariance)


def reaching_for(estimator: Estimator) -> ReachingLaw:
    """Return the usual reaching law, its boundary layer as thick as samples and sensors need.

    The gains near the target go with η/ε: the layer of :func:`undertow.law.usual_reaching` is
    doubled until the first surface bears the delay that the gate asks for, less a period, and what
    the estimator does not know takes no more than ``NOISE`` of the input on it, for which it is
    doubled to ``DOUBLED`` times at most.  Where no layer bears that delay, noise alone decides.
    """
    mechanism, covariance = estimator.mechanism, estimator.steady_covariance()
    period, least = estimator.period, _delay(estimator.period, BEARS - 1)
    surface = first_surface(mechanism)
    most = DOUBLED + math.ceil(math.log2(max(1.0, period / SAMPLE)))
    usual = usual_reaching(mechanism, surface)
    thinnest = float(np.max(usual.layer))
    laws = [replace(usual, layer=thinnest * 2**k) for k in range(most + 1)]
    borne = [
        k
        for k, law in enumerate(laws)
        if delay_margin(mechanism, surface, law, period=period, longest=least) >= least - 1e-9
    ] or range(DOUBLED + 1)
    able = [laws[k] for k in borne if k <= max(DOUBLED, borne[0])]
    quiet = (law for law in able if noise_share(mechanism, surface, covariance, law) <= NOISE)
    return next(quiet, able[-1])
