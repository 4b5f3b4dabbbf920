"""Which numbers are free in a fit, and how each is mapped to a variable without bounds."""

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.case.fields import known
from jaxbeam.case.sensors import QUANTITIES, Sensor
from tuning.parameters.prior import Belief, as_belief

OF_LOG = re.compile(r"logs\.(\d+)\.(.+)")
INSIDE = 1e-3  # of the distance between bounds: a start on a bound is moved in by so much


@dataclasses.dataclass(frozen=True)
class Free:
    """A free number: its address, unit, start, bounds (either may be infinite), and typical size.

    With two bounds the number is low + (high - low) (1 + sin y) / 2 in the search variable y,
    which can reach both; with one it is the bound plus or minus an exponential; else y itself.
    The scales "log" and "logit" of a `belief` change the first of these.
    """

    address: str
    unit: str
    start: float
    low: float
    high: float
    size: float
    belief: Belief = Belief()

    def inward(self, value: float) -> float:
        """Search variable of a value; one on a bound is moved in a little."""
        least = INSIDE * self.size
        if np.isfinite(self.high - self.low):
            if self.belief.scale == "log":
                least = min(least, INSIDE * self.low)
            inner = np.clip(value, self.low + least, self.high - least)
            return float(self.at_share(np.asarray(self._share(inner))))
        if np.isfinite(self.low):
            return float(np.log(max(value - self.low, least)))
        if np.isfinite(self.high):
            return float(-np.log(max(self.high - value, least)))
        return value

    def at_share(self, share: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
        """Search variable at a share (0 to 1) of the way between two bounds, on the scale."""
        if self.belief.scale == "logit":
            return np.asarray(np.log(share / (1 - share)))
        return np.asarray(np.arcsin(2 * share - 1))

    def _share(self, value: float) -> float:
        """How far between its two bounds a value is; on the log scale, its logarithm."""
        if self.belief.scale == "log":
            return np.log(value / self.low) / np.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def at_bound(self, value: float) -> bool:
        """Whether a value lies on a bound, as good as."""
        return bool(min(value - self.low, self.high - value) <= INSIDE * self.size)

    @property
    def search_size(self) -> float:
        """A large change of the search variable: one, or the typical size where it is the value."""
        return self.size if np.isinf(self.low) and np.isinf(self.high) else 1.0

    def size_at(self, value: float) -> float:
        """Typical size once a value is fitted: one that came close to zero is itself small."""
        one_sided = np.isfinite(self.low) != np.isfinite(self.high)
        distance = min(value - self.low, self.high - value)
        return float(np.clip(distance, 1e-9 * self.size, self.size)) if one_sided else self.size

    def outward(self, y: Float[Array, ""]) -> Float[Array, ""]:
        """Value of a search variable."""
        if np.isfinite(self.high - self.low):
            share = (1 + jnp.sin(y)) / 2
            if self.belief.scale == "log":
                return self.low * (self.high / self.low) ** share
            if self.belief.scale == "logit":
                share = jax.nn.sigmoid(y)
            return self.low + (self.high - self.low) * share
        if np.isfinite(self.low):
            return self.low + jnp.exp(y)
        if np.isfinite(self.high):
            return self.high - jnp.exp(-y)
        return y


def free_numbers(
    cases: list[Case], bounds: dict[str, tuple[float, float] | Belief | None], reading: float
) -> list[Free]:
    """Look up the free numbers in the cases of the logs.

    An address is that of the case, shared by all logs, or `logs.1.loads.0.speed` for a number of
    one log, or `logs.*.loads.0.speed` for one of each log. Each has bounds, None or a `Belief`.
    Without bounds a number stays on its side of zero, but for offsets and entry times.
    The typical size of a number is the distance of its bounds, or else itself; that of an offset
    is the largest `reading`, that of an entry time the duration.

    Raises ValueError for an unknown address, a list, a number that is free twice, bounds that do
    not hold the start, or a start of zero that says nothing about the size.
    """
    if not bounds:
        raise ValueError("name at least one address as free")
    bounds = _each_log(bounds, len(cases))
    _check_once(list(bounds))
    return [_free_number(cases, address, pair, reading) for address, pair in bounds.items()]


def _each_log(bounds: dict[str, Any], logs: int) -> dict[str, Any]:
    """Addresses with `logs.*` in front, written out for each log."""
    spread = {}
    for address, pair in bounds.items():
        rest = address.removeprefix("logs.*.")
        for own in [address] if rest == address else [f"logs.{i}.{rest}" for i in range(logs)]:
            if own in spread:
                raise ValueError(f"{own} is free twice; name it once")
            spread[own] = pair
    return spread


def _check_once(addresses: list[str]) -> None:
    """A number cannot be shared by all logs and be that of one log as well."""
    for address in addresses:
        own = OF_LOG.fullmatch(address)
        if own and own[2] in addresses:
            raise ValueError(
                f"{address} is free twice, as {own[2]} is free for all logs together; "
                "leave one of them out"
            )


def _free_number(cases: list[Case], address: str, pair, reading: float) -> Free:
    case, rest = _place(cases, address)
    value = known(value_at(case, rest))
    if value.ndim:
        raise ValueError(f"{address} is a list; free its entries, {address}.0 and so on")
    start = float(value)
    try:
        belief = as_belief(pair)
    except ValueError as error:
        raise ValueError(f"{address}: {error}") from None
    pair = belief.bounds
    low, high = (-np.inf, np.inf) if pair is None else pair
    signed = rest.endswith((".offset", ".entry_time"))
    if pair is None and not signed:
        low, high = (0.0, np.inf) if start > 0 else (-np.inf, 0.0)
    if not low < high:
        raise ValueError(f"{address}: the lower bound {low:g} is not below the upper, {high:g}")
    if not low <= start <= high:
        raise ValueError(
            f"{address} starts at {start:g}, outside its bounds {low:g} to {high:g}: change "
            "the number in the case, or the bounds"
        )
    if np.isfinite(high - low):
        size = high - low
    elif rest.endswith(".offset"):
        size = reading
    elif rest.endswith(".entry_time"):
        size = float(known(case.run.duration))
    else:
        size = abs(start)
    if size == 0.0:
        raise ValueError(
            f"{address} starts at 0, which does not say how large it may be: give it bounds, such "
            f"as {address}=0:1, or another start"
        )
    return Free(address, unit_at(case, rest), start, low, high, size, belief)


def _place(cases: list[Case], address: str) -> tuple[Case, str]:
    """The case of the log that an address is about, and the address within it."""
    own = OF_LOG.fullmatch(address)
    if own:
        if int(own[1]) >= len(cases):
            last = len(cases) - 1
            known_ones = "the only log is logs.0" if last == 0 else f"the last log is logs.{last}"
            raise ValueError(f"{address}: there is no such log; {known_ones}")
        return cases[int(own[1])], own[2]
    values = [known(value_at(case, address)) for case in cases]
    if any(np.any(value != values[0]) for value in values):
        raise ValueError(
            f"{address} differs between the logs; say which one, as in logs.0.{address}"
        )
    return cases[0], address


def unit_at(case: Case, address: str) -> str:
    """The SI unit of the number at an address; "" or "1" if it has none."""
    unit, part = "", case
    for step in address.split("."):
        if isinstance(part, tuple):
            part = part[int(step)]
        elif dataclasses.is_dataclass(part):
            unit = type(part).__dataclass_fields__[step].metadata.get("unit", "")
            if isinstance(part, Sensor) and unit == "unit of quantity":
                unit = QUANTITIES[part.quantity]
            part = getattr(part, step)
    return unit


def insert(case: Case, number: int, values: dict[str, Any]) -> Case:
    """The case of one log with values at the addresses that concern it."""
    own = {}
    for address, value in values.items():
        match = OF_LOG.fullmatch(address)
        if match is None:
            own[address] = value
        elif int(match[1]) == number:
            own[match[2]] = value
    return replace(case, own)
