"""Estimators: states from measured positions, parameters from motions."""

from undertow.estimators.belief import Belief, ParameterEstimate
from undertow.estimators.drive import Record, StateFeedback, compensated, drive
from undertow.estimators.interface import Estimator, FilteredDerivative, Measured, SuperTwisting
from undertow.estimators.kalman import KalmanFilter

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
    "drive",
]
