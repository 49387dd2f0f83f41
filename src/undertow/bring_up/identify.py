"""Parameters from a recorded motion: output error, least squares, confidence intervals.

The model is simulated under the recorded inputs and its positions compared with the measured
ones (output error: noise on the measurement does not bias it; Ljung, *System Identification*,
2nd ed., sec. 7.3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.stats

from undertow.base import Progress, no_progress
from undertow.bring_up.fit import Fit, clustered, correlated, counted
from undertow.bring_up.motion import MotionRecord
from undertow.models import FloatArray, Mechanism


@dataclass(frozen=True)
class Estimate:
    """One identified quantity.

    ``error``: its standard error; ``low``, ``high``: its 95 % confidence interval. ``nominal``:
    what the model says; NaN where it says nothing. ``matters``: how much the motion would differ if
    this were as the model says and all else were fitted again, to first order, as a share of the
    motion.
    """

    name: str
    unit: str
    description: str
    value: float
    error: float
    low: float
    high: float
    nominal: float = math.nan
    matters: float = math.nan


@dataclass(frozen=True, eq=False)
class Identification:
    """What a motion says of its mechanism.

    ``held``: parameters kept at their nominal values: the motion does not tell them apart.
    ``elasticities``: by parameter that is held, but gravity, and by quantity whose estimate is at
    least three times its uncertainty: by how many per cent that estimate would be larger if the
    former were held at 1 % more.
    ``residual``: RMS of measured less predicted, (n,), rad or m; ``before``: the same with the
    nominal model. ``explained``: share of the motion that is explained, (n,), 1 for all of it.
    ``predicted``: what the identified model says of the motion, (N, n), about the same zero as
    measured. ``mechanism``: with the identified parameters.
    """

    estimates: Mapping[str, Estimate]
    held: tuple[str, ...]
    elasticities: Mapping[str, Mapping[str, float]]
    residual: FloatArray
    before: FloatArray
    explained: FloatArray
    predicted: FloatArray
    mechanism: Mechanism


def identify(
    mechanism: Mechanism, x0: FloatArray, record: MotionRecord, *, progress: Progress = no_progress
) -> Identification:
    """Identify parameters of a mechanism from a motion that begins at rest.

    The model's parameter values are the first guess; it rests at ``x0``, (2n,); the record is wired
    as the model.

    Returns
    -------
    Identification
        Estimates by least squares in which every reading counts for what it is worth
        (:func:`undertow.bring_up.fit.readings`), with 95 % confidence intervals from the
        Jacobian, corrected for residuals that are correlated from sample to sample (Newey and
        West, *Econometrica* 55(3), 1987) and within a part of the motion, and no narrower than
        what the counting of the encoders alone would make them.  They are for a rig that the
        model describes, and for what is held at the model's value: what leaves no trace in the
        record, or none that other quantities could not have left; see
        :attr:`Identification.elasticities`.

    Raises
    ------
    InvalidInputError
        When nothing moved.
    """
    fit = Fit(mechanism, x0, record)
    free, z = fit.search(progress)
    z = fit.weigh(free, z)
    J, r = fit.jacobian(free, z), fit.residual(free, z)
    predicted = fit.moved - fit.difference(free, z)
    variances = np.max(
        [
            correlated(J, r, mechanism.n),
            clustered(J, r, mechanism.n),
            counted(predicted, fit.noise, fit.sigma, fit.variance, J),
        ],
        axis=0,
    )
    quantile = float(scipy.stats.norm.ppf(0.975))
    estimates = {}
    spread = np.diag(np.linalg.pinv(J.T @ J))  # 0 of what leaves no trace in the record
    motion = float(np.linalg.norm((fit.moved - fit.moved.mean(axis=0)) / np.sqrt(fit.variance)))
    for v, scaled, variance, share in zip(free, z, variances, spread, strict=True):
        if v.name.startswith("_") or not share > 0.0:
            continue
        value, error = float(scaled * v.scale), float(math.sqrt(variance) * v.scale)
        estimates[v.name] = Estimate(
            v.name,
            v.unit,
            v.description,
            value,
            error,
            value - quantile * error,
            value + quantile * error,
            v.nominal,
            abs(value - v.nominal) / v.scale / math.sqrt(share) / motion,
        )
    known = {p.name for p in mechanism.parameters}
    changed = {k: e.value for k, e in estimates.items() if k in known}
    held = tuple(p.name for p in mechanism.parameters if p.name not in changed)
    offered = [v for v in fit.candidates if v.name in held]
    changes = fit.shifts(free, z, offered)
    elasticities = {
        v.name: {
            one.name: float(change * quantity.scale / one.value)
            for quantity, change in zip(free, column, strict=True)
            if (one := estimates.get(quantity.name)) and one.value > 3 * (one.high - one.value)
        }
        for v, column in zip(offered, changes.T, strict=True)
    }
    return Identification(
        estimates,
        held,
        elasticities,
        fit.difference(free, z).std(axis=0),
        fit.difference([], np.zeros(0)).std(axis=0),
        fit.explained(free, z),
        predicted,
        mechanism.with_parameters(**changed),
    )
