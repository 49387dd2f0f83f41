"""Estimators: states from measured positions, parameters from motions."""

from undertow.estimators.belief import Belief, ParameterEstimate
from undertow.estimators.interface import Estimator, FilteredDerivative, Measured, SuperTwisting
from undertow.estimators.kalman import KalmanFilter
from undertow.estimators.recorded_run import Record, StateFeedback, compensated, run_recorded

__all__ = [
    "Belief",
    "Estimator",
    "FilteredDerivative",
    "KalmanFilter",
    "Measured",
    "ParameterEstimate",
    "Record",
    "StateFeedback",
    "SuperTwisting",
    "compensated",
    "run_recorded",
]
