"""Estimators: states from measured positions, parameters from motions.

:mod:`.interface` says what an estimator is and has those without a model; :mod:`.kalman` is the
extended Kalman filter that runs take. :mod:`.belief` is what is known of the parameters, and how
a motion narrows it; :mod:`.recorded_run` tries an estimator in simulated time.
"""

from undertow.estimators.belief import Belief, ParameterEstimate
from undertow.estimators.interface import (
    Estimator,
    FilteredDerivative,
    MakeEstimator,
    Measured,
    SuperTwisting,
)
from undertow.estimators.kalman import KalmanFilter
from undertow.estimators.recorded_run import Record, StateFeedback, compensated, run_recorded

__all__ = [
    "Belief",
    "Estimator",
    "FilteredDerivative",
    "KalmanFilter",
    "MakeEstimator",
    "Measured",
    "ParameterEstimate",
    "Record",
    "StateFeedback",
    "SuperTwisting",
    "compensated",
    "run_recorded",
]
