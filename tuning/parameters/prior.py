"""What is known of a free number before any log is looked at."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

SCALES = ("plain", "log", "logit")


@dataclasses.dataclass(frozen=True)
class Prior:
    """Bounds of a free number, the scale on which it is searched, and a prior; all optional.

    With `mean` and `deviation` (SI units) the number is believed to be so beforehand: normally
    distributed or, on a log scale, log-normally, with the mean as median and deviation / mean as
    standard deviation of the logarithm. The fit is then the maximum a posteriori. On the scale
    "log" or "logit", which need two bounds, values are spread evenly in the logarithm, or in the
    log-odds of the place between the bounds.

    Raises ValueError for a deviation that is not positive, a prior of which a half is missing, an
    unknown scale, and a scale or prior that needs other bounds or signs.
    """

    low: float | None = None
    high: float | None = None
    mean: float | None = None
    deviation: float | None = None
    scale: str = "plain"

    def __post_init__(self):
        if self.scale not in SCALES:
            raise ValueError(f"a scale is one of {', '.join(SCALES)}, not {self.scale!r}")
        if (self.mean is None) != (self.deviation is None):
            raise ValueError("a prior needs both a mean and a deviation")
        if self.deviation is not None and not 0 < self.deviation < np.inf:
            raise ValueError(f"the deviation of a prior must be positive, not {self.deviation:g}")
        if self.scale != "plain" and self.bounds is None:
            raise ValueError(f"the scale {self.scale!r} needs two bounds, low and high")
        if self.scale == "log" and not (self.low > 0 and (self.mean is None or self.mean > 0)):
            raise ValueError("on a log scale bounds and mean must be positive")

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Both bounds, an infinite one for one that is missing; None without any."""
        if self.low is None and self.high is None:
            return None
        low = -np.inf if self.low is None else float(self.low)
        return low, (np.inf if self.high is None else float(self.high))

    def prior_residual(self, value: Float[Array, ""]) -> Float[Array, ""]:
        """Distance of a value from the mean of the prior, in its deviations; 0 without a prior."""
        if self.mean is None:
            return jnp.zeros_like(value)
        if self.scale == "log":
            return jnp.log(value / self.mean) * self.mean / self.deviation
        return (value - self.mean) / self.deviation


def as_prior(bounds: Any) -> Prior:
    """A belief as it is, or what bounds (low, high) or None mean."""
    if isinstance(bounds, Prior):
        return bounds
    return Prior() if bounds is None else Prior(*(float(bound) for bound in bounds))
