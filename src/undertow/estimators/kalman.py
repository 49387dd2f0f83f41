"""An extended Kalman filter on the mechanism's own model, compiled for it.

The mean moves by a Runge-Kutta step of the model; the covariance by the step's Jacobian,
``I + hA + ½h²A²`` with A from differences of the compiled dynamics; positions come in one
by one, so that nothing is inverted and a missing one is left out.  Optionally a matched
disturbance d, in the units of the inputs, is estimated with the state as a random walk:
a disturbance observer, whose estimate the controller can take off its output.  So are, where a
belief says that they are uncertain, parameters: the filter moves with what it has learnt of them.

A knock changes velocities at once, which no parameter explains.  A reading that is off by more than
the filter's own statistics allow is left out, if it is the only one in a row: it was bad.  The next
one means that the velocities have jumped: their covariance takes in as large a jump as the readings
show, and neither parameters nor a delay are learnt for a while (a test of the innovations, and a
reset of the covariance; Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, 2001, 11.6).

A delay τ that is not known for sure is estimated, too: inputs change all the time, and how soon the
motion shows it tells when they act (∂q̈/∂τ = −∂q̈/∂u u̇).  Dry friction turns over with its joint,
which looks like a delay as well: at such a turn the variance of the disturbance takes in twice what
is felt of it.

An encoder's error is no white noise: while a joint moves by less than a count, one reading after
the other has the same.  Of parameters, which add up what each reading says, so many of them say no
more than one does: each moves them by its share alone (a partial update; Brink, *J. Guidance,
Control, and Dynamics* 40(9), 2017).  State and disturbance, which are soon forgotten, are not held
up by that.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, between, checked, one_for_each, positive
from undertow.estimators.belief import EVEN, Belief, ParameterEstimate
from undertow.estimators.interface import Estimator
from undertow.models import (
    FloatArray,
    Mechanism,
    fastest_rate,
    full_accelerations,
    require_smooth,
)
from undertow.plants import Measurement
from undertow.plants.interface import copy_numbers
from undertow.plants.stepping import compiled_module
from undertow.symbolic import BRIEF, COMPILED, Workspace, brief, unpacked

#: Parameters are learnt while some acceleration is larger than this part of what the full inputs do
#: to it at the target, and than what the estimated disturbance does besides: what the model leaves
#: out, dry friction, is small beside it.
EXCITED = 0.1

#: Longest delay, with what one that is estimated may be longer, periods.
MOST_PERIODS = 10_000

#: Standard deviation of a matched disturbance before anything moves, as a part of the input's
#: limit: half of it, two deviations, is what a controller makes up for.  With less, dry friction
#: looks like wrong parameters, and those are learnt.
DISTURBED = 0.25

#: Time over which the size of the disturbance is averaged, s.
AVERAGED = 1.0

#: Standard deviations beyond which an innovation is none of noise and model: of 10⁹ samples that
#: are, two.
JUMP = 6.0

#: Time after a jump in which neither parameters nor the delay are learnt, s: the velocities have to
#: be found first.
SETTLES = 0.02

#: A jump of a velocity is a knock, after which what was planned is for another motion, if the full
#: inputs take longer than this for as much, s.  What is less is not told from a delay or friction
#: that the model does not know, and no plan is lost to it.
KNOCK = 0.005


@brief()
def predict_covariance(
    F: FloatArray, P: FloatArray, A: FloatArray, noise: FloatArray, h: float, moving: int
) -> None:
    """Turn P into F P Fᵀ + h diag(noise), exactly symmetric; A, of P's size, is scratch.

    Numbers from ``moving`` on have no noise.
    """
    size = P.shape[0]
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += F[i, k] * P[k, j]
            A[i, j] = total
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += A[i, k] * F[j, k]
            P[i, j] = total
            P[j, i] = total
        if i < moving:
            P[i, i] += h * noise[i]


@brief()
def measurement_update(
    x: FloatArray, P: FloatArray, q: FloatArray, variance: FloatArray, column: FloatArray,
    learnt: int, share: FloatArray,
) -> None:  # fmt: skip
    """Take in positions one by one, nothing inverted; a missing one (NaN) is left out.

    Numbers from ``learnt`` on are moved by a ``share``, (n,), of what a reading says of them; with
    0 they are considered and stay as they are (Schmidt's filter).
    """
    size = x.shape[0]
    for i in range(q.shape[0]):
        if q[i] != q[i]:
            continue
        spread = P[i, i] + variance[i]
        error = q[i] - x[i]
        both = share[i] * (2.0 - share[i])
        for k in range(size):
            column[k] = P[k, i]
        for k in range(size):
            x[k] += column[k] * (error / spread) * (1.0 if k < learnt else share[i])
            for j in range(size):
                part = 1.0 if min(k, j) < learnt else both
                P[k, j] -= column[k] * column[j] / spread * part


@brief()
def repeated(count: float, h: float, speed: float, spread: float, noise: float) -> float:
    """Return how many readings in a row have the same error of rounding to a ``count``.

    As many as a count is wider than what moves from one to the next, h later: the joint with its
    speed, as far as that is known, of variance ``spread``, and ``noise``, a variance.  At least 1.
    """
    moves = math.sqrt(h * h * (speed * speed + spread) + noise)
    return max(1.0, count / moves) if moves > 0.0 else 1.0


@brief()
def readings_after_jump(
    x: FloatArray, P: FloatArray, q: FloatArray, variance: FloatArray, h: float,
    knock: FloatArray, odd: FloatArray, taken: FloatArray,
) -> bool:  # fmt: skip
    """Write the positions to be taken in into ``taken``; whether the velocities have jumped.

    x and P are predicted.  ``odd`` is for how long readings have been off, s, how many in a row,
    and how often so far a velocity has jumped by more than ``knock``, (n,).  A jump at the
    beginning of that time widens P.
    """
    n, off, knocked = q.shape[0], False, False
    for i in range(n):
        error = q[i] - x[i]
        taken[i] = q[i]
        if error * error > JUMP * JUMP * (P[i, i] + variance[i]):
            off, taken[i] = True, math.nan
    if not off:
        odd[0] = odd[1] = 0.0
        return False
    odd[0] += h
    odd[1] += 1.0
    if odd[1] < 2.0:
        return False
    for i in range(n):
        taken[i] = math.nan
        if abs(q[i]) < math.inf:
            taken[i] = q[i]
            knocked = knocked or abs(q[i] - x[i]) > knock[i] * odd[0]
            way = (q[i] - x[i]) ** 2
            P[i, i] += way
            P[i, n + i] += way / odd[0]
            P[n + i, i] += way / odd[0]
            P[n + i, n + i] += way / odd[0] ** 2
    if knocked and odd[1] == 2.0:
        odd[2] += 1.0
    odd[0] = 0.0
    return True


#: Density of the drift of an estimated delay, in its tolerances per √s, and how many of them it is
#: longer at most than it was told.
DELAY_DRIFT, LONGEST = 0.25, 8.0

#: A joint has turned when its velocity is so many standard deviations the other way; the variance
#: of a disturbance at it takes in (so many times its size)², then.
TURNED, REVERSED = 2.0, 2.0

#: What the filter remembers: ``size`` numbers are estimated, state, disturbance, delay, and the
#: last ``known`` of them offsets of parameters, in tolerances; ``past``: inputs of the last
#: ``room`` periods; ``told``: delay, period and what the delay is longer at most, s; ``fastest``:
#: rate of a mode, 1/s.
_LAYOUT = {
    "x": "size", "out": "size", "noise": "size", "variance": "n", "limits": "m",
    "counts": "n", "late": "1", "now": "n", "share": "n",
    "parameters": "p", "count": "1", "past": "room, m", "P": "size, size",
    "F": "size, size", "A": "size, size", "work": "9, size", "odd": "4",
    "place": "known", "nominal": "known", "tolerance": "known", "reach": "known",
    "excited": "n", "knock": "n", "felt": "m", "fastest": "1",
    "told": "3", "way": "m",
}  # fmt: skip

_BODY = f"""
{COMPILED}
def move(h, x, u, n, m, disturbed, parameters, stage, total, qdd, viscous, driven):
    # Runge-Kutta's step of the mean; with ``disturbed``, x goes on with the estimated disturbance.
    for i in range(m):
        driven[i] = u[i] + (x[2 * n + i] if disturbed else 0.0)
    rk4_step(0.0, h, 0.0, n, x, driven, viscous, parameters, stage, total, qdd)


{COMPILED}
def jacobian(
    h, x, u, change, n, m, disturbed, parameters, place, tolerance, F, A, qdd, base, viscous, driven
):
    # I + hA + h²A²/2, A by differences of the accelerations.
    size = x.shape[0]
    learnt = size - place.shape[0]
    for i in range(m):
        driven[i] = u[i] + (x[2 * n + i] if disturbed else 0.0)
    forward(0.0, x, driven, viscous, parameters, base)
    A[:] = 0.0
    for i in range(n):
        A[i, n + i] = 1.0
    for j in range(size):
        small = 1e-6
        if j < 2 * n:
            kept = x[j]
            x[j] = kept + small
            forward(0.0, x, driven, viscous, parameters, qdd)
            x[j] = kept
        elif j >= learnt:
            at = int(place[j - learnt])
            kept = parameters[at]
            parameters[at] = kept + small * tolerance[j - learnt]
            forward(0.0, x, driven, viscous, parameters, qdd)
            parameters[at] = kept
        elif disturbed and j < 2 * n + m:
            kept = driven[j - 2 * n]
            driven[j - 2 * n] = kept + small
            forward(0.0, x, driven, viscous, parameters, qdd)
            driven[j - 2 * n] = kept
        else:  # the delay
            for i in range(m):
                driven[i] = driven[i] + small * change[i]
            forward(0.0, x, driven, viscous, parameters, qdd)
            for i in range(m):
                driven[i] = driven[i] - small * change[i]
        for i in range(n):
            A[n + i, j] = (qdd[i] - base[i]) / small
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(2 * n):
                total += A[i, k] * A[k, j]
            F[i, j] = (1.0 if i == j else 0.0) + h * A[i, j] + 0.5 * h * h * total


{BRIEF}
def estimate(h, q, u, block, size, room, known, delayed):
{unpacked(_LAYOUT)}
    learnt = size - known
    disturbed = learnt - delayed > 2 * n
    start = int(count[0])
    stage, total, qdd, base, viscous, driven, taken, acting, change = (
        work[0], work[1], work[2], work[3], work[4], work[5], work[6], work[7], work[8]
    )
    for i in range(m):
        past[start % room, i] = max(-limits[i], min(limits[i], u[i]))
    period = told[1]
    wait = (told[0] + (x[learnt - 1] if delayed else 0.0)) / period
    whole = int(wait + 1e-6)
    rest = max(0.0, wait - whole)  # of a period, during which the input before acts
    for i in range(m):
        newer, older = past[(start - whole) % room, i], past[(start - whole - 1) % room, i]
        acting[i] = newer + rest * (older - newer)
        change[i] = (older - newer) / period
    parts = max(1, math.ceil(h * fastest[0] - 1e-9))  # of a period: short beside the fastest mode
    part = h / parts
    for _ in range(parts):
        jacobian(
            part, x, acting, change, n, m, disturbed, parameters, place, tolerance, F, A, qdd, base,
            viscous, driven
        )
        move(part, x, acting, n, m, disturbed, parameters, stage, total, qdd, viscous, driven)
        moving, louder = learnt, 0.0
        for i in range(m if disturbed else 0):
            louder = max(louder, abs(x[2 * n + i]) / limits[i])
        for i in range(n):
            if abs(base[i]) > excited[i] * (1.0 + louder / {EXCITED}):
                moving = size
        predict_covariance(F, P, A, noise, part, moving)
    for i in range(n):
        now[i] = variance[i] + (x[n + i] * late[0]) ** 2
        share[i] = 0.0
        if moving > learnt:
            new = now[i] - counts[i] * counts[i] / 12.0
            share[i] = 1.0 / repeated(counts[i], h, x[n + i], P[n + i, n + i], new)
    if readings_after_jump(x, P, q, now, h, knock, odd, taken):
        odd[3] = {SETTLES}
    surely = learnt  # so many numbers are moved by all that a reading says
    if odd[3] > 0.0:
        share[:], surely = 0.0, learnt - delayed
        odd[3] = odd[3] - h
    measurement_update(x, P, taken[:n], now, total, surely, share)
    if delayed:
        x[learnt - 1] = max(-told[0], min(told[2], x[learnt - 1]))
    for i in range(m if disturbed else 0):
        if x[n + i] ** 2 > {TURNED**2} * P[n + i, n + i]:
            if x[n + i] * way[i] < 0.0:
                P[2 * n + i, 2 * n + i] = P[2 * n + i, 2 * n + i] + ({REVERSED} * felt[i]) ** 2
            way[i] = x[n + i]
    for j in range(known):
        x[learnt + j] = max(-reach[j], min(reach[j], x[learnt + j]))
        parameters[int(place[j])] = nominal[j] + tolerance[j] * x[learnt + j]
    for i in range(m if disturbed else 0):
        felt[i] += (abs(x[2 * n + i]) - felt[i]) * min(1.0, h / {AVERAGED})
    count[0] = start + 1.0
    for i in range(x.shape[0]):
        out[i] = x[i]
    for k in range(whole + 1):
        span = period * (1.0 if k else rest)
        then = past[(start - whole + k) % room]
        parts = math.ceil(span * fastest[0] - 1e-9) if span * fastest[0] > 1.0 else 1
        for _ in range(parts if span > 0.0 else 0):
            move(
                span / parts, out, then, n, m, disturbed, parameters, stage, total, qdd, viscous,
                driven
            )
"""


@lru_cache(maxsize=64)
def _module(mechanism: Mechanism) -> Any:
    parts = "from undertow.estimators.kalman import predict_covariance, measurement_update\n"
    parts += "from undertow.estimators.kalman import readings_after_jump, repeated\n"
    return compiled_module(mechanism, "kalman", "Kalman filter", _BODY, parts)


class KalmanFilter(Estimator):
    """Extended Kalman filter on the mechanism's own model, positions measured only.

    Parameters
    ----------
    mechanism
        The controller's belief.
    period
        Usual time between samples, s.
    position_noise
        Standard deviation of a position, rad or m, one or one per coordinate, that each reading
        has anew.
    acceleration_noise
        Density of what the model does not know of the accelerations, rad/s²/√Hz or
        m/s²/√Hz, one or one per coordinate.
    resolution
        One count of an encoder, rad or m, one or one per coordinate; 0: there is none.  Rounding
        to counts is off by a count/√12, and by the same until the next count: readings of one
        count teach parameters as much as one does.
    time_noise
        Standard deviation of the moment that a reading is of, s: of a joint that moves it is one of
        its position.
    disturbance_drift
        Density of the drift of a matched disturbance, in units of the input per √s; 0:
        no disturbance is estimated.
    delay
        Known delay of measurement and input together, s, rounded to periods: the estimate is
        for the moment when the answer to it acts.
    delay_tolerance
        Standard deviation of that delay, s, which is then estimated, too: from none to 8 of them
        longer than it is told; 0: it is exact.
    belief
        What is not known of the mechanism's parameters, which are then estimated with the state;
        ``None``: they are exact.  A belief with a bound is refused: a covariance rules nothing out.
    parameter_drift
        Density of the drift of uncertain parameters, in their tolerances per √s: how fast what was
        learnt is forgotten.

    Attributes
    ----------
    disturbance
        The estimated matched disturbance, in units of the inputs, (m,); written over.
    felt
        Its size, averaged over the last second, (m,); written over.
    parameters
        Values of all parameters of the mechanism that it moves with, (P,), SI units; written over.

    Raises
    ------
    InvalidInputError
        For noises that are not positive, and for a belief with a bound.
    ModelError
        For a model that is not smooth: the covariance moves by its derivatives.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> KalmanFilter(rig, position_noise=4e-4).disturbance.tolist()
    [0.0]
    """

    @checked
    def __init__(
        self,
        mechanism: Mechanism,
        period: float = 0.001,
        *,
        position_noise: ArrayLike = 5e-4,
        acceleration_noise: ArrayLike = 0.5,
        resolution: ArrayLike = 0.0,
        time_noise: float = 0.0,
        disturbance_drift: float = 0.0,
        delay: float = 0.0,
        delay_tolerance: float = 0.0,
        belief: Belief | None = None,
        parameter_drift: float = 0.1,
    ) -> None:
        require_smooth(
            f"a Kalman filter's model, M or f of '{mechanism.name}',",
            [*mechanism.force, *mechanism.mass_matrix],
            mechanism.x,
        )
        super().__init__(mechanism, period)
        n, m = mechanism.n, mechanism.m
        positive(
            "time_noise, disturbance_drift, delay, delay_tolerance and parameter_drift of a "
            "Kalman filter",
            (time_noise, disturbance_drift, delay, delay_tolerance, parameter_drift),
            "0 turns each off",
            zero=True,
        )
        if belief is not None and belief.mechanism.fingerprint != mechanism.fingerprint:
            raise InvalidInputError(
                "belief of a Kalman filter",
                value=f"about another '{belief.mechanism.name}'",
                limit="about the filter's own mechanism",
            )
        if belief is not None and belief.bound is not None:
            raise InvalidInputError(
                "belief of a Kalman filter",
                value=f"one with a bound, {belief.bound}",
                limit="without one: the filter's covariance rules nothing out",
                remedy="Write belief=dataclasses.replace(belief, bound=None), or learn with "
                "Belief.learn from exact states",
            )
        self._arguments: dict[str, Any] = {
            "mechanism": mechanism, "period": period, "position_noise": position_noise,
            "acceleration_noise": acceleration_noise, "resolution": resolution,
            "time_noise": time_noise, "disturbance_drift": disturbance_drift,
            "delay": delay, "delay_tolerance": delay_tolerance, "belief": belief,
            "parameter_drift": parameter_drift,
        }  # fmt: skip
        self._known = known = 0 if belief is None else len(belief.tolerances)
        self._moved = 2 * n + (m if disturbance_drift > 0 else 0)
        self._delayed = int(delay_tolerance > 0)
        self._learnt = self._moved + self._delayed
        size = self._learnt + known
        self._size, self._lead = size, round(delay / period)
        longest = LONGEST * delay_tolerance
        most = round((delay + longest) / period)
        between("delay of a Kalman filter", most, 0, MOST_PERIODS, "periods", "Give it in seconds")
        self._room = self._lead + math.ceil(longest / period) + 2
        memory = Workspace(
            _LAYOUT, n=n, m=m, p=len(mechanism.parameters), size=size, room=self._room, known=known
        )
        memory["told"][:] = self._lead * period, period, longest
        self._block, self._count, self._past = memory.block, memory["count"], memory["past"]
        self._x, self._out = memory["x"], memory["out"]
        self._P: FloatArray = memory["P"]
        self._odd: FloatArray = memory["odd"]
        self.felt, self._way = memory["felt"], memory["way"]
        self._variance, self._F = memory["variance"], memory["F"]
        counts = memory["counts"]
        counts[:] = one_for_each("resolution", resolution, n, zero=True)
        noise = one_for_each("position_noise", position_noise, n)
        self._variance[:] = noise**2 + counts**2 / 12.0
        memory["late"][0], memory["fastest"][0] = time_noise, fastest_rate(mechanism)
        self._parts = max(1, math.ceil(period * memory["fastest"][0] - 1e-9))
        unknown = one_for_each("acceleration_noise", acceleration_noise, n)
        memory["noise"][n : 2 * n] = unknown**2
        memory["noise"][2 * n : self._moved] = disturbance_drift**2
        memory["noise"][self._moved : self._learnt] = (DELAY_DRIFT * delay_tolerance) ** 2
        self._delay_variance = delay_tolerance**2
        memory["limits"][:] = self._limits = mechanism.input_limits
        full = full_accelerations(mechanism)
        memory["knock"][:] = KNOCK * full
        self.parameters = memory["parameters"]
        if belief is not None:
            memory["noise"][self._learnt :] = parameter_drift**2
            memory["place"][:] = belief.places
            memory["nominal"][:] = mechanism.parameter_values[belief.places]
            memory["tolerance"][:] = list(belief.tolerances.values())
            memory["reach"][:] = belief.room
            memory["excited"][:] = EXCITED * full
        self.belief = belief
        self._state: FloatArray = self._out[: 2 * n]
        if disturbance_drift > 0:
            self.disturbance = self._x[2 * n : self._moved]
        self._estimate = _module(mechanism).estimate
        self.reset(np.zeros(2 * n))

    def reset(self, x0: ArrayLike, spread: float = 1.0) -> None:
        """Start again from the state x0, (2n,), at rest as far as is known.

        ``spread`` is the standard deviation of the velocities, rad/s or m/s; that of the
        positions is a measurement's, that of the disturbance a quarter of its limit.  What was
        learnt of parameters and of the delay is forgotten.
        """
        n, moved, learnt = self.mechanism.n, self._moved, self._learnt
        x = self.mechanism.check_state(x0)
        self._x[:] = 0.0
        self._x[: 2 * n] = x
        self._P[:] = 0.0
        variances = np.zeros(len(self._x))
        variances[:n], variances[n : 2 * n] = self._variance, spread**2
        if moved > 2 * n:
            known = np.isfinite(self._limits)
            variances[2 * n : moved] = np.where(known, DISTURBED * self._limits, 1.0) ** 2
        variances[moved:learnt] = self._delay_variance
        variances[learnt:] = EVEN**2
        np.fill_diagonal(self._P, variances)
        self.parameters[:] = self.mechanism.parameter_values
        self._past[:], self._count[0], self._t = 0.0, 0, math.nan
        self._odd[:] = self.felt[:] = self._way[:] = 0.0
        self._out[:] = self._x

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """Return the state after a measurement, (2n,); see :class:`Estimator`."""
        q, h = self._positions(measurement), self._elapsed(measurement.t)
        copy_numbers(u, self._u, "inputs written last")
        self._estimate(
            h, q, self._u, self._block, self._size, self._room, self._known, self._delayed
        )
        return self._state

    @property
    def jumps(self) -> int:
        """How often velocities have been knocked: what was planned is for another motion."""
        return int(self._odd[2])

    @property
    def estimated_delay(self) -> float:
        """From a measurement to the moment when the answer to it acts, s, as far as is known.

        Dry friction that the model leaves out moves it by a millisecond or two.
        """
        return self._lead * self.period + float(self._x[self._moved : self._learnt].sum())

    @property
    def learnt(self) -> ParameterEstimate | None:
        """What is known by now of the uncertain parameters; ``None`` without a belief."""
        if self.belief is None or not self._known:
            return None
        place = slice(self._learnt, self._size)
        information = np.linalg.inv(self._P[place, place])
        information = 0.5 * (information + information.T)
        return ParameterEstimate(self._x[place].copy(), information, int(self._count[0]))

    def _at_rest(self) -> KalmanFilter:
        """Return a filter like this one, after half a second at rest at the target."""
        double = KalmanFilter(**self._arguments)
        n, m = self.mechanism.n, self.mechanism.m
        double.reset(np.zeros(2 * n))
        for k in range(round(0.5 / self.period)):
            double.estimate(Measurement(k * self.period, np.zeros(n)), np.zeros(m))
        return double

    def steady_covariance(self) -> FloatArray:
        """Return the state's covariance that a filter like this one comes to at rest, (2n, 2n)."""
        size = 2 * self.mechanism.n
        return self._at_rest().covariance[:size, :size]

    def noise_covariance(self) -> FloatArray:
        """Return what the sensors' noise alone makes of the estimate at the target, (2n, 2n).

        The filter's own covariance counts besides what the model may leave out.  With the gain L of
        the filter at rest, e⁺ = (I − L C) F e + L v, and the estimate runs ahead by the delay.
        """
        rest, n = self._at_rest(), self.mechanism.n
        size = self._learnt  # parameters stay as they are at rest
        F, P = np.linalg.matrix_power(rest._F[:size, :size], self._parts), rest._P[:size, :size]
        R = np.diag(rest._variance)
        gain = P[:, :n] @ np.linalg.inv(R)  # of a covariance after its update
        ahead = np.linalg.matrix_power(F, self._lead)
        step, error = F - gain @ F[:n], gain @ R @ gain.T
        for _ in range(30):  # Σ stepᵏ L R Lᵀ stepᵏᵀ of twice as many samples each time
            error, step = error + step @ error @ step.T, step @ step
        return np.asarray((ahead @ error @ ahead.T)[: 2 * n, : 2 * n])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the state (disturbance, delay, parameters) at the measurement."""
        return self._P.copy()
