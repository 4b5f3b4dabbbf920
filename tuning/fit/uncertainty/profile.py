"""Profile likelihood: how much worse the fit gets as one number is moved and the rest follow."""

import dataclasses

import numpy as np
from jaxtyping import Float

from tuning.fit.identify import Fit
from tuning.fit.uncertainty.covariance import t_quantile

LINEAR_AGREEMENT = 0.25  # share by which profile and linear interval may differ to be called alike
MAX_STEPS_PER_SIDE = 12  # steps to either side, each at most twice as long as the one before


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """A profile: `values` in SI, and how much -2 ln L `deviance` above its least there.

    `interval` is where it stays below what 95 % confidence allows; infinite on a side on which it
    was not seen to rise so far. `linear_interval` is the interval of the linearised fit.
    """

    address: str
    unit: str
    values: Float[np.ndarray, " point"]
    deviance: Float[np.ndarray, " point"]
    critical_deviance: float
    interval: tuple[float, float]
    linear_interval: tuple[float, float]

    @property
    def verdict(self) -> str:
        """What the profile says, in a sentence."""
        low, high = self.interval
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        if np.isinf(low) and np.isinf(high):
            return f"the data cannot tell {self.address}: the fit is as good wherever it is"
        if np.isinf(high):
            return f"the data only say that {self.address} is above {low:.5g}{unit}"
        if np.isinf(low):
            return f"the data only say that {self.address} is below {high:.5g}{unit}"
        statement = f"{self.address} is between {low:.5g} and {high:.5g}{unit}"
        ends = np.abs(np.array(self.interval) - self.linear_interval)
        if not np.all(np.isfinite(self.linear_interval)):
            return f"{statement}, though the linearised fit could not tell"
        if np.all(ends < LINEAR_AGREEMENT * (high - low) / 2):
            return f"{statement}, as the linearised fit says"
        return f"{statement}; the linearised interval is misleading, use this one"


def profile(fit: Fit, address: str, points: int = 4) -> Profile:
    """Move one number away from its fitted value, to either side, and fit the others anew.

    The noise stays that of the fit, widened where residuals are coloured. Steps are such that
    some `points` lie on either side of the value within the interval, and lengthen as long as
    nothing happens. Nothing is compiled anew.

    Raises ValueError if the number is not free.
    """
    if address not in fit.addresses:
        raise ValueError(f"{address} is not free in this fit; free are {', '.join(fit.addresses)}")
    index = fit.addresses.index(address)
    critical_deviance = t_quantile(fit.degrees_of_freedom) ** 2
    noise = np.where(np.isnan(fit.noise), 1.0, fit.noise * np.sqrt(fit.autocorrelation_factor))
    # With weights widened channel by channel the least is not quite where the fit is.
    centre = _refit(fit, _unbounded_point(fit), noise)
    least = fit.least_squares.values_at(centre)
    number, value = fit.parameters[index], float(least[index])
    best = fit.least_squares.cost(least, noise, fit.dataset.measured)
    error = fit.errors[index]
    size = number.typical_size_at(value)
    step = min(error, size / 2) * np.sqrt(critical_deviance) / points
    values, deviance = [value], [0.0]
    for side in (-1.0, 1.0):
        moved_value, stride, rise, point = value, side * step, 0.0, centre
        for _ in range(MAX_STEPS_PER_SIDE):
            if not number.low < moved_value + stride < number.high:
                break
            moved_value += stride
            point, before = np.array(point), rise
            point[index] = number.to_unbounded(moved_value)
            point = _refit(fit, point, noise, index)
            cost = fit.least_squares.cost(
                fit.least_squares.values_at(point), noise, fit.dataset.measured
            )
            rise = 2 * (cost - best)
            values.append(moved_value)
            deviance.append(rise)
            if rise > 1.3 * critical_deviance or not np.isfinite(rise):
                break
            if rise - before < critical_deviance / points**2:
                stride *= 2
    order = np.argsort(values)
    values, deviance = np.array(values)[order], np.array(deviance)[order]
    interval = tuple(
        _interval_end(values, deviance, value, critical_deviance, side) for side in (-1, 1)
    )
    linear = tuple(map(float, fit.intervals[index]))
    return Profile(address, number.unit, values, deviance, critical_deviance, interval, linear)


def _unbounded_point(fit: Fit) -> Float[np.ndarray, " free"]:
    """The search point of the fitted values."""
    pairs = zip(fit.parameters, fit.values, strict=True)
    return np.array([number.to_unbounded(float(value)) for number, value in pairs])


def _refit(fit: Fit, point, noise, held: int | None = None) -> Float[np.ndarray, " free"]:
    """The search point from some start on, with one number held and the others fitted."""
    free = np.arange(point.size) != (-1 if held is None else held)
    if not free.any():
        return point
    search = fit.least_squares
    scale = search.step_scale(point, noise)
    found, _ = search.minimise(
        point[None], scale[None], search.weights(noise), fit.dataset.measured, free
    )
    return found[0]


def _interval_end(values, deviance, best: float, critical_deviance: float, side: int) -> float:
    """Where the root of the rise, which is nearly straight, passes what is allowed."""
    on_side = side * (values - best) >= 0
    side_values = values[on_side][::side]
    roots = np.maximum.accumulate(np.sqrt(np.maximum(deviance[on_side][::side], 0.0)))
    finite = np.isfinite(roots)
    if not np.any(roots[finite] > np.sqrt(critical_deviance)):
        return side * np.inf
    return float(np.interp(np.sqrt(critical_deviance), roots[finite], side_values[finite]))
