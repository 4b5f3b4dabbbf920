"""Which numbers are free in a fit, and how each is mapped to a variable without bounds."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case import Case, replace, value_at
from jaxbeam.fields import known

OF_LOG = re.compile(r"logs\.(\d+)\.(.+)")
INSIDE = 1e-3  # of the distance between bounds: a start on a bound is moved in by so much


@dataclasses.dataclass(frozen=True)
class Free:
    """A free number: its address, start, bounds (either may be infinite), and a typical size.

    With two bounds the number is low + (high - low) (1 + sin y) / 2 in the search variable y,
    which can reach both; with one it is the bound plus or minus an exponential; else y itself.
    """

    address: str
    start: float
    low: float
    high: float
    size: float

    def inward(self, value: float) -> float:
        """Search variable of a value."""
        if np.isfinite(self.high - self.low):
            share = np.clip((value - self.low) / (self.high - self.low), INSIDE, 1 - INSIDE)
            return float(np.arcsin(2 * share - 1))
        if np.isfinite(self.low):
            return float(np.log(value - self.low))
        if np.isfinite(self.high):
            return float(-np.log(self.high - value))
        return value

    def at_bound(self, value: float) -> bool:
        """Whether a value lies on a bound, as good as."""
        reach = INSIDE * (self.high - self.low if np.isfinite(self.high - self.low) else 0.0)
        return bool(value - self.low <= reach or self.high - value <= reach)

    def outward(self, y: Float[Array, ""]) -> Float[Array, ""]:
        """Value of a search variable."""
        if np.isfinite(self.high - self.low):
            return self.low + (self.high - self.low) * (1 + jnp.sin(y)) / 2
        if np.isfinite(self.low):
            return self.low + jnp.exp(y)
        if np.isfinite(self.high):
            return self.high - jnp.exp(-y)
        return y


def free_numbers(
    cases: list[Case], bounds: dict[str, tuple[float, float] | None], reading: float
) -> list[Free]:
    """Look up the free numbers in the cases of the logs.

    The typical size of a number is the distance of its bounds, or else itself; that of an offset
    is the largest `reading`, that of a time the duration.

    An address is that of the case, shared by all logs, or `logs.1.loads.0.speed` for a number of
    one log. Without bounds a number that stands for a size stays on its side of zero. Raises
    ValueError for an unknown address, a list, or bounds that do not hold the start.
    """
    if not bounds:
        raise ValueError("name at least one address as free")
    found = []
    for address, pair in bounds.items():
        start = _start(cases, address)
        low, high = (-np.inf, np.inf) if pair is None else pair
        if pair is None and start > 0 and not address.endswith((".offset", ".entry_time")):
            low = 0.0
        if not low < high:
            raise ValueError(f"{address}: the lower bound {low:g} is not below the upper, {high:g}")
        if not low <= start <= high:
            raise ValueError(
                f"{address} starts at {start:g}, outside its bounds {low:g} to {high:g}: change "
                "the number in the case, or the bounds"
            )
        if np.isfinite(high - low):
            size = high - low
        elif address.endswith(".offset"):
            size = reading
        elif address.endswith(".entry_time"):
            size = float(known(cases[0].run.duration))
        else:
            size = abs(start) or 1.0
        found.append(Free(address, start, float(low), float(high), float(size)))
    return found


def _start(cases: list[Case], address: str) -> float:
    own = OF_LOG.fullmatch(address)
    if own:
        number, rest = int(own[1]), own[2]
        if number >= len(cases):
            raise ValueError(f"{address}: there are {len(cases)} logs, counted from 0")
        value = known(value_at(cases[number], rest))
    else:
        values = [known(value_at(case, address)) for case in cases]
        value = values[0]
        if any(np.any(other != value) for other in values):
            raise ValueError(
                f"{address} differs between the logs; say which one, as in logs.0.{address}"
            )
    if value.ndim:
        raise ValueError(f"{address} is a list; free its entries, {address}.0 and so on")
    return float(value)


def insert(case: Case, number: int, values: dict[str, Float[Array, ""]]) -> Case:
    """The case of one log with values at the addresses that concern it."""
    own = {}
    for address, value in values.items():
        match = OF_LOG.fullmatch(address)
        if match is None:
            own[address] = value
        elif int(match[1]) == number:
            own[match[2]] = value
    return replace(case, own)
