"""Estimators: from positions, measured one sample after another, to states."""

from undertow.estimators.compensation import compensated
from undertow.estimators.differentiators import FilteredDerivative, SuperTwisting
from undertow.estimators.drive import Controller, Record, drive
from undertow.estimators.interface import Estimator, Measured
from undertow.estimators.kalman import KalmanFilter

__all__ = [
    "Controller",
    "Estimator",
    "FilteredDerivative",
    "KalmanFilter",
    "Measured",
    "Record",
    "SuperTwisting",
    "compensated",
    "drive",
]
