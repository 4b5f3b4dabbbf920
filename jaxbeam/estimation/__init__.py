"""Estimators, one family a file, behind the interface in `estimator`."""

from jaxbeam.case.estimator import AbstractEstimator
from jaxbeam.estimation.gains import kalman_gain, placed_gain, sampled_kalman_gain
from jaxbeam.estimation.inversion import Inversion
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.estimation.observability import ConditioningWarning, conditioning
from jaxbeam.estimation.observer import Observer

KINDS: dict[str, type[AbstractEstimator]] = {
    "inversion": Inversion,
    "kalman": Kalman,
    "observer": Observer,
}

__all__ = [
    "KINDS",
    "ConditioningWarning",
    "Inversion",
    "Kalman",
    "Observer",
    "conditioning",
    "kalman_gain",
    "placed_gain",
    "sampled_kalman_gain",
]
