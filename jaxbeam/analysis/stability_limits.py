"""At which value of a number a loop turns unstable: margins in mass and in speed, by search."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy

from jaxbeam.analysis.stability import frozen_poles, stream
from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import concrete

# What is above zero for an unstable case.
StabilityMeasure = Callable[[Case], float]


class LoadStabilityLimits(NamedTuple):
    """From which mass (kg) and which speed (m/s, its size) of its load a loop is unstable.

    Infinite where no limit was found, zero where all that was tried is unstable; None where the
    load has no such number.
    """

    mass: float | None
    speed: float | None


def largest_frozen_pole(case: Case) -> float:
    """The largest real part (1/s) of the frozen poles over the crossing."""
    return float(frozen_poles(case).largest_real_part.max())


def stream_excess(spacing: float) -> StabilityMeasure:
    """By how much the largest multiplier of a stream, loads a `spacing` (s) apart, exceeds one."""
    return lambda case: stream(case, spacing).largest_multiplier - 1


def stability_limit(
    case: Case,
    address: str,
    low: float,
    high: float,
    measure: StabilityMeasure = largest_frozen_pole,
    points: int = 25,
) -> float | None:
    """The least value of a number of the case between two at which the loop turns unstable.

    For the margin in mass or speed give `loads.0.mass` or `loads.0.speed`. `measure` is above
    zero for an unstable case: `largest_frozen_pole`, `streaming(spacing)`, or any other, such as
    `lambda case: growth(case).factor.max() - 10` (by choice). Values at `points` steps are tried,
    then the first change is bracketed to 1e-6. The bounds have the sign of the number, the larger
    size last. None if there is no such value. Raises ValueError for an address that is not there,
    and if the case is unstable already at `low`.
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
    """From which mass and which speed of its first load a loop is unstable, all else kept.

    Tried are values up to `factor` times as large as that of the case, or, where the case is unstable
    as it is, down to as many times smaller ones. Laws are designed anew for each. Raises ValueError
    for a case without loads, and as `measure`.
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
