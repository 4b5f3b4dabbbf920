"""Profile likelihood: how much worse the fit gets as one number is moved and the rest follow."""

import dataclasses

import numpy as np
from jaxtyping import Float

from tuning.fit.identify import Fit
from tuning.fit.uncertainty.covariance import reach

STRAIGHT = 0.25  # share by which profile and linear interval may differ to be called alike
MOST = 12  # steps to either side, each at most twice as long as the one before


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """A profile: `values` in SI, and how much -2 ln L `rises` above its least there.

    `interval` is where it stays below what 95 % confidence allows; infinite on a side on which it
    was not seen to rise so far. `linear` is the interval of the linearised fit.
    """

    address: str
    unit: str
    values: Float[np.ndarray, " point"]
    rises: Float[np.ndarray, " point"]
    allowed: float
    interval: tuple[float, float]
    linear: tuple[float, float]

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
        told = f"{self.address} is between {low:.5g} and {high:.5g}{unit}"
        ends = np.abs(np.array(self.interval) - self.linear)
        if not np.all(np.isfinite(self.linear)):
            return f"{told}, though the linearised fit could not tell"
        if np.all(ends < STRAIGHT * (high - low) / 2):
            return f"{told}, as the linearised fit says"
        return f"{told}; the linearised interval is misleading, use this one"


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
    allowed = reach(fit.freedom) ** 2
    noise = np.where(np.isnan(fit.noise), 1.0, fit.noise * np.sqrt(fit.colour))
    # With weights widened channel by channel the least is not quite where the fit is.
    centre = _refit(fit, _point(fit), noise)
    least = fit.search.values_at(centre)
    number, value = fit.numbers[index], float(least[index])
    best = fit.search.cost(least, noise, fit.campaign.measured)
    error = fit.errors[index]
    size = number.size_at(value)
    step = min(error, size / 2) * np.sqrt(allowed) / points
    values, rises = [value], [0.0]
    for side in (-1.0, 1.0):
        at, stride, rise, point = value, side * step, 0.0, centre
        for _ in range(MOST):
            if not number.low < at + stride < number.high:
                break
            at += stride
            point, before = np.array(point), rise
            point[index] = number.inward(at)
            point = _refit(fit, point, noise, index)
            cost = fit.search.cost(fit.search.values_at(point), noise, fit.campaign.measured)
            rise = 2 * (cost - best)
            values.append(at)
            rises.append(rise)
            if rise > 1.3 * allowed or not np.isfinite(rise):
                break
            if rise - before < allowed / points**2:
                stride *= 2
    order = np.argsort(values)
    values, rises = np.array(values)[order], np.array(rises)[order]
    interval = tuple(_crossing(values, rises, value, allowed, side) for side in (-1, 1))
    linear = tuple(map(float, fit.intervals[index]))
    return Profile(address, number.unit, values, rises, allowed, interval, linear)


def _point(fit: Fit) -> Float[np.ndarray, " free"]:
    """The search point of the fitted values."""
    pairs = zip(fit.numbers, fit.values, strict=True)
    return np.array([number.inward(float(value)) for number, value in pairs])


def _refit(fit: Fit, point, noise, held: int | None = None) -> Float[np.ndarray, " free"]:
    """The search point from some start on, with one number held and the others fitted."""
    free = np.arange(point.size) != (-1 if held is None else held)
    if not free.any():
        return point
    search = fit.search
    scale = search.scale(point, noise)
    found, _ = search.minimise(
        point[None], scale[None], search.weights(noise), fit.campaign.measured, free
    )
    return found[0]


def _crossing(values, rises, best: float, allowed: float, side: int) -> float:
    """Where the root of the rise, which is nearly straight, passes what is allowed."""
    mine = side * (values - best) >= 0
    places = values[mine][::side]
    roots = np.maximum.accumulate(np.sqrt(np.maximum(rises[mine][::side], 0.0)))
    finite = np.isfinite(roots)
    if not np.any(roots[finite] > np.sqrt(allowed)):
        return side * np.inf
    return float(np.interp(np.sqrt(allowed), roots[finite], places[finite]))
