"""Bounds, scale and prior distribution of a free parameter."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, xp

SCALES = ("linear", "log", "logit")


@dataclasses.dataclass(frozen=True)
class Prior:
    """Bounds of a free parameter, the scale of its search, and a prior distribution; all optional.

    `mean` and `deviation` (SI units) are those of a normal prior or, on the scale "log", of a
    log-normal one with the mean as median and deviation / mean as standard deviation of the
    logarithm. The fit is then the maximum a posteriori. The scales "log" and "logit" need two
    bounds: starts are drawn evenly in the logarithm, or in the log-odds of the share between them.

    Raises ValueError for an unknown scale, a prior without mean or deviation, a deviation that is
    not positive, and a scale or prior that does not fit the bounds.

    >>> import tuning
    >>> prior = tuning.Prior(low=5.0, high=20.0, mean=12.0, deviation=1.0)
    >>> print(prior)
    Prior(low=5.0, high=20.0, mean=12.0, deviation=1.0, scale='linear')
    """

    low: float | None = None
    high: float | None = None
    mean: float | None = None
    deviation: float | None = None
    scale: str = "linear"

    def __post_init__(self):
        if self.scale not in SCALES:
            raise ValueError(f"a scale is one of {', '.join(SCALES)}, not {self.scale!r}")
        if (self.mean is None) != (self.deviation is None):
            raise ValueError("a prior needs both a mean and a deviation")
        if self.deviation is not None and not 0 < self.deviation < np.inf:
            raise ValueError(f"the deviation of a prior must be positive, not {self.deviation:g}")
        if self.scale != "linear" and self.bounds is None:
            raise ValueError(f"the scale {self.scale!r} needs two bounds, low and high")
        if self.scale == "log" and not (self.low > 0 and (self.mean is None or self.mean > 0)):
            raise ValueError("on a log scale bounds and mean must be positive")

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Both bounds, infinite where one is missing; None without any."""
        if self.low is None and self.high is None:
            return None
        low = -np.inf if self.low is None else float(self.low)
        return low, (np.inf if self.high is None else float(self.high))

    def prior_residual(self, value: Float[Array, ""]) -> Float[Array, ""]:
        """Deviation of a value from the mean of the prior, over the prior's; 0 without a prior."""
        if self.mean is None:
            return xp.zeros_like(value)
        if self.scale == "log":
            return xp.log(value / self.mean) * self.mean / self.deviation
        return (value - self.mean) / self.deviation

    def residual_slope(self, value: float) -> float:
        """Derivative of `prior_residual` by the value."""
        if self.mean is None:
            return 0.0
        return (self.mean / value if self.scale == "log" else 1.0) / self.deviation


def as_prior(bounds: Any) -> Prior:
    """A `Prior` as it is, or one with the bounds (low, high) or, for None, without any."""
    if isinstance(bounds, Prior):
        return bounds
    return Prior() if bounds is None else Prior(*(float(bound) for bound in bounds))
