"""A comparison with an independent source: quantity, reference, error and tolerance."""

from typing import NamedTuple

import numpy as np


class Check(NamedTuple):
    """A quantity computed by jaxbeam, a reference, and the relative error beside its tolerance."""

    quantity: str
    reference: str
    error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance; NaN is not."""
        return self.error <= self.tolerance


def max_relative_error(computed, expected) -> float:
    """Largest difference over the largest expected value."""
    computed, expected = np.asarray(computed), np.asarray(expected)
    return float(np.max(np.abs(computed - expected)) / np.max(np.abs(expected)))


def max_entrywise_error(computed, expected) -> float:
    """Largest difference of any entry over that entry."""
    return float(np.max(np.abs(np.asarray(computed) / np.asarray(expected) - 1)))
