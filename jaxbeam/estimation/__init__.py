"""Estimators, one family a file, behind the interface in `estimator`."""

from jaxbeam.estimator import AbstractEstimator

KINDS: dict[str, type[AbstractEstimator]] = {}

__all__ = ["KINDS"]
