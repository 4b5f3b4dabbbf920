"""Stability limits: the value of a number of the case at which its loop turns unstable."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy

from jaxbeam.analysis.stability import frozen_poles, stream
from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import concrete

# Function of a case that is positive if its loop is unstable.
StabilityMeasure = Callable[[Case], float]


class LoadStabilityLimits(NamedTuple):
    """Mass (kg) and speed (m/s, absolute) of a load above which a loop is unstable.

    Infinite if no limit was found, zero if all values tried are unstable, None if the load has no
    mass (or speed).
    """

    mass: float | None
    speed: float | None


def largest_frozen_pole(case: Case) -> float:
    """Largest real part (1/s) of the frozen poles over the crossing."""
    return float(frozen_poles(case).largest_real_part.max())


def stream_excess(spacing: float) -> StabilityMeasure:
    """Stability measure: largest Floquet multiplier less one, with loads a `spacing` (s) apart."""
    return lambda case: stream(case, spacing).largest_multiplier - 1


def stability_limit(
    case: Case,
    address: str,
    low: float,
    high: float,
    measure: StabilityMeasure = largest_frozen_pole,
    points: int = 25,
) -> float | None:
    """Smallest value of a number of the case at which its loop turns unstable; None without one.

    `measure` is positive for an unstable case: `largest_frozen_pole`, `stream_excess(spacing)`, or
    a function such as `lambda case: growth(case).factor.max() - 10`. It is evaluated at `points`
    values from `low` to `high` in equal ratios; its first change of sign is then refined to 1e-6
    (relative). Negative bounds are given by increasing size. Raises ValueError for an unknown
    address, for bounds that do not ascend, and if the loop is unstable at `low`.
    """
    if not 0 < low < high and not high < low < 0:
        raise ValueError(f"low and high must be positive and ascend; they are {low:g}, {high:g}")

    def measure_at(value):
        return measure(replace(case, {address: float(value)}))

    values = np.geomspace(low, high, points)
    if measure_at(values[0]) > 0:
        raise ValueError(f"the loop is unstable already at {address} = {low:g}; start lower")
    for lower, upper in zip(values[:-1], values[1:], strict=True):
        if measure_at(upper) > 0:
            return float(scipy.optimize.brentq(measure_at, lower, upper, rtol=1e-6))
    return None


def load_stability_limits(
    case: Case,
    measure: StabilityMeasure = largest_frozen_pole,
    factor: float = 10.0,
    points: int = 12,
) -> LoadStabilityLimits:
    """Mass and speed of the first load above which a loop is unstable, each with the other kept.

    The search goes up to `factor` times the value of the case, or from a `factor` below up to it if
    the case is unstable. The law is designed anew for each value. Raises ValueError for a case
    without loads, and as `measure`.
    """
    if not case.loads:
        raise ValueError("there is no load whose mass or speed could have a limit; add one")
    unstable = measure(case) > 0

    def limit_of(name):
        value = getattr(case.loads[0], name)
        if value is None or concrete(value) == 0:
            return None
        value, address = float(concrete(value)), f"loads.0.{name}"
        low, high = (value / factor, value) if unstable else (value, value * factor)
        if unstable and measure(replace(case, {address: low})) > 0:
            return 0.0
        found = stability_limit(case, address, low, high, measure, points)
        return np.inf if found is None else abs(found)

    return LoadStabilityLimits(limit_of("mass"), limit_of("speed"))
