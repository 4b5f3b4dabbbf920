"""Free parameters of a fit or tuning: bounds, scales, priors, search variables, and readings.

Search variables have no bounds. Readings of several logs are a function of the parameters, with
their derivatives.
"""

import dataclasses
import functools
import os
import re
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import (
    ALL,
    Case,
    check_distinct,
    each_address,
    list_sizes,
    replace,
    stack_cases,
    unit_at,
    value_at,
)
from jaxbeam.case.fields import concrete
from jaxbeam.case.toml_file import attribute_address
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.compiling import compiled, xla_options
from jaxbeam.simulation.integration_plan import IntegrationPlan
from jaxbeam.simulation.integrator.time_grid import EventSchedule
from jaxbeam.simulation.simulate import simulate_readings

SCALES = ("linear", "log", "logit")


@dataclasses.dataclass(frozen=True)
class Prior:
    """Bounds of a free parameter, the scale of its search, and a prior distribution; all optional.

    `mean` and `deviation` (SI units) are those of a normal prior or, on the scale "log", of a
    log-normal one with the mean as median and deviation / mean as standard deviation of the
    logarithm. The fit is then the maximum a posteriori. The scales "log" and "logit" need two
    bounds: starts are drawn evenly in the logarithm, or in the log-odds of the place between them.

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
    """A `Prior` as it is, or one with the bounds (low, high) or, for None, without any.

    Raises ValueError for bounds that are not two numbers.
    """
    if isinstance(bounds, Prior):
        return bounds
    if bounds is None:
        return Prior()
    try:
        low, high = map(float, bounds)
    except (TypeError, ValueError):
        raise ValueError(f"bounds are two numbers, (low, high), not {bounds!r}") from None
    return Prior(low, high)


# Numbers that decide when samples are taken, or when commands begin or bend.
SAMPLING = re.compile(
    r"run\.(duration|sample_rate)|(vehicle_)?sensors\.[^.]+\.(sampling_period|dropout|jitter)"
    r"|controller\.(period|delay|dropout|jitter|times\.\d+)"
)
SENSOR_DELAY = re.compile(r"sensors\.[^.]+\.delay")
# Numbers with which laws compare something at samples (`deciding`).
DECIDING = re.compile(
    r"controller\.(confirmation|(load_identification\.)?until|load_identification\.threshold)"
)
LOG_ADDRESS = re.compile(r"logs\.(\d+)\.(.+)")
BOUND_MARGIN = 1e-3  # of the typical size: how far a start on a bound is moved in


@dataclasses.dataclass(frozen=True)
class FreeParameter:
    """A free parameter: address, unit, start, bounds (either may be infinite) and typical size.

    With two bounds the value is low + (high - low) (1 + sin y) / 2 of the search variable y, which
    reaches both; with one bound it is that bound plus or minus an exponential of y; else y itself.
    The scales "log" and "logit" of the `prior` change the first of these.
    """

    address: str
    unit: str
    start: float
    low: float
    high: float
    typical_size: float
    prior: Prior = Prior()

    def to_unbounded(self, value: float) -> float:
        """Search variable of a value; a value on a bound is moved inwards by `BOUND_MARGIN`."""
        least = BOUND_MARGIN * self.typical_size
        if np.isfinite(self.high - self.low):
            if self.prior.scale == "log":
                least = min(least, BOUND_MARGIN * self.low)
            inside = np.clip(value, self.low + least, self.high - least)
            return float(
                self.unbounded_at_fraction(np.asarray(self._fraction_between_bounds(inside)))
            )
        if np.isfinite(self.low):
            return float(np.log(max(value - self.low, least)))
        if np.isfinite(self.high):
            return float(-np.log(max(self.high - value, least)))
        return value

    def unbounded_at_fraction(
        self, fraction: Float[np.ndarray, "*any"]
    ) -> Float[np.ndarray, "*any"]:
        """Search variable at a fraction (0 to 1) of the way between two bounds, on the scale."""
        if self.prior.scale == "logit":
            return np.asarray(np.log(fraction / (1 - fraction)))
        return np.asarray(np.arcsin(2 * fraction - 1))

    def _fraction_between_bounds(self, value: float) -> float:
        """Fraction of the distance between both bounds (of logarithms, on the scale "log")."""
        if self.prior.scale == "log":
            return np.log(value / self.low) / np.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def at_bound(self, value: float) -> bool:
        """Whether a value lies within `BOUND_MARGIN` of a bound."""
        return bool(min(value - self.low, self.high - value) <= BOUND_MARGIN * self.typical_size)

    @property
    def unbounded_size(self) -> float:
        """A large change of the search variable: 1, or the typical size without any bounds."""
        return self.typical_size if np.isinf(self.low) and np.isinf(self.high) else 1.0

    def typical_size_at(self, value: float) -> float:
        """Typical size at a value: smaller close to the only bound of a parameter."""
        one_sided = np.isfinite(self.low) != np.isfinite(self.high)
        distance = min(value - self.low, self.high - value)
        return (
            float(np.clip(distance, 1e-9 * self.typical_size, self.typical_size))
            if one_sided
            else self.typical_size
        )

    def from_unbounded(self, unbounded: Float[Array, ""]) -> Float[Array, ""]:
        """Value of a search variable."""
        if np.isfinite(self.high - self.low):
            fraction = (1 + xp.sin(unbounded)) / 2
            if self.prior.scale == "log":
                return self.low * (self.high / self.low) ** fraction
            if self.prior.scale == "logit":
                fraction = (1 + xp.tanh(unbounded / 2)) / 2
            return self.low + (self.high - self.low) * fraction
        if np.isfinite(self.low):
            return self.low + xp.exp(unbounded)
        if np.isfinite(self.high):
            return self.high - xp.exp(-unbounded)
        return unbounded

    def slope(self, unbounded: float) -> float:
        """Derivative of `from_unbounded`."""
        if np.isfinite(self.high - self.low):
            if self.prior.scale == "logit":
                return (self.high - self.low) / 4 / np.cosh(unbounded / 2) ** 2
            fraction_slope = np.cos(unbounded) / 2
            if self.prior.scale == "log":
                value = float(self.from_unbounded(np.float64(unbounded)))
                return value * np.log(self.high / self.low) * fraction_slope
            return (self.high - self.low) * fraction_slope
        if np.isfinite(self.low):
            return np.exp(unbounded)
        return np.exp(-unbounded) if np.isfinite(self.high) else 1.0


def to_unbounded(
    parameters: Sequence[FreeParameter], values: Iterable[float]
) -> Float[np.ndarray, " parameter"]:
    """Search variables of values."""
    pairs = zip(parameters, values, strict=True)
    return np.array([parameter.to_unbounded(float(value)) for parameter, value in pairs])


def free_parameters(
    cases: list[Case],
    bounds: dict[str, tuple[float, float] | Prior | None],
    largest_reading: float,
) -> list[FreeParameter]:
    """Free parameters at addresses in the cases of some logs.

    An address is that of the case, shared by all logs, or `logs.1.loads.0.speed` for a parameter of
    one log, or `logs.*.loads.0.speed` for one of each log. Each has bounds, None or a `Prior`.
    Without bounds a parameter keeps its sign, but for offsets and entry times. The typical size is
    the distance of the bounds, or else the start itself; that of an offset is the
    `largest_reading`, that of an entry time the duration.

    Raises ValueError for an unknown address, a list, an address that is free twice or decides when
    samples are taken, bounds that exclude the start, or a start of zero without bounds.
    """
    if not bounds:
        raise ValueError("name at least one address as free")
    bounds = _expand_log_addresses(bounds, len(cases))
    _check_unique(list(bounds), cases)
    for address in bounds:
        case, local_address = _locate(cases, address)
        check_continuous(case, local_address)
    return [
        _free_parameter(cases, address, pair, largest_reading) for address, pair in bounds.items()
    ]


def check_continuous(case: Case, address: str) -> None:
    """Raises ValueError for a number that a search by derivatives cannot change.

    It decides when samples are taken, which a search keeps, how they are rounded, or what a law
    does at samples.
    """
    own_delay = SENSOR_DELAY.fullmatch(address)
    sampled = case.controller is not None and case.controller.period is not None
    if SAMPLING.fullmatch(address) or (own_delay and sampled):
        raise ValueError(
            f"{address} cannot be free: it decides when samples are taken or commands begin, which"
            " a search keeps; compare several of its values"
        )
    if address.endswith(".resolution"):
        raise ValueError(
            f"{address} cannot be free: what is rounded to it jumps, so that it has no derivative;"
            " compare several of its values"
        )
    stepped = getattr(case.controller, "between", None) == "stepped"
    if DECIDING.fullmatch(address) or (stepped and address.startswith("controller.masses.")):
        raise ValueError(
            f"{address} cannot be free: it decides at samples, so that commands jump with it and it"
            " has no derivative; compare several of its values"
        )


def _expand_log_addresses(bounds: dict[str, Any], logs: int) -> dict[str, Any]:
    """Bounds by address, with `logs.*` in front written out for each log."""
    expanded = {}
    for address, pair in bounds.items():
        rest = address.removeprefix("logs.*.")
        for own in [address] if rest == address else [f"logs.{i}.{rest}" for i in range(logs)]:
            if own in expanded:
                raise ValueError(f"{own} is free twice; name it once")
            expanded[own] = pair
    return expanded


def _check_unique(addresses: list[str], cases: list[Case]) -> None:
    """Refuse a number that is free twice: for all logs and for one, or for all loads and one."""
    for i, case in enumerate(cases):
        local = {}
        for address in addresses:
            own = LOG_ADDRESS.fullmatch(address)
            if own is None or int(own[1]) == i:
                within = attribute_address(own[2] if own else address)
                local[address] = each_address(within, list_sizes(case))
        check_distinct(local)


def _free_parameter(
    cases: list[Case], address: str, bounds, largest_reading: float
) -> FreeParameter:
    case, local_address = _locate(cases, address)
    if ALL in local_address and local_address.endswith(".offset"):
        raise ValueError(
            f"{address}: sensors have offsets of their own; free sensors.0.offset and so on"
        )
    value = concrete(value_at(case, local_address))
    if value.ndim:
        raise ValueError(f"{address} is a list; free its entries, {address}.0 and so on")
    start = float(value)
    try:
        prior = as_prior(bounds)
    except ValueError as error:
        raise ValueError(f"{address}: {error}") from None
    bounds = prior.bounds
    low, high = (-np.inf, np.inf) if bounds is None else bounds
    any_sign = local_address.endswith((".offset", ".entry_time"))
    if bounds is None and not any_sign:
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
    elif local_address.endswith(".offset"):
        size = largest_reading
    elif local_address.endswith(".entry_time"):
        size = float(concrete(case.run.duration))
    else:
        size = abs(start)
    if size == 0.0:
        raise ValueError(
            f"{address} starts at 0, which does not say how large it may be: give it bounds, such "
            f"as {address}=0:1, or another start"
        )
    return FreeParameter(address, unit_at(case, local_address), start, low, high, size, prior)


def _locate(cases: list[Case], address: str) -> tuple[Case, str]:
    """The case of the log that an address belongs to, and the address within it."""
    match = LOG_ADDRESS.fullmatch(address)
    if match:
        if int(match[1]) >= len(cases):
            last = len(cases) - 1
            existing = "the only log is logs.0" if last == 0 else f"the last log is logs.{last}"
            raise ValueError(f"{address}: there is no such log; {existing}")
        return cases[int(match[1])], match[2]
    values = [concrete(value_at(case, address)) for case in cases]
    if any(np.any(value != values[0]) for value in values):
        raise ValueError(
            f"{address} differs between the logs; say which one, as in logs.0.{address}"
        )
    return cases[0], address


def with_values(case: Case, log_index: int, values: dict[str, Any]) -> Case:
    """The case of one log with the values at the addresses that belong to it."""
    own = {}
    for address, value in values.items():
        match = LOG_ADDRESS.fullmatch(address)
        if match is None:
            own[address] = value
        elif int(match[1]) == log_index:
            own[match[2]] = value
    return replace(case, own)


OFFSET_ADDRESS = re.compile(r"(vehicle_)?sensors\.\d+\.offset")


@runtime_checkable
class SamplePrediction(Protocol):
    """Samples as a function of the parameters of a fit."""

    def predict(self, values: Float[Array, " parameter"]) -> Float[Array, "log time channel"]:
        """Samples, traced by JAX."""
        ...

    def linearised(
        self, values: Float[np.ndarray, " parameter"]
    ) -> tuple[
        Float[np.ndarray, "log time channel"], Float[np.ndarray, "log time channel parameter"]
    ]:
        """Samples and their derivatives by the values."""
        ...


class FunctionPrediction:
    """Prediction by one function of all values, which JAX can trace."""

    def __init__(self, predict: Callable):
        self.predict = predict
        self._program = jax.jit(
            lambda values: _forward_mode(predict, values), compiler_options=xla_options()
        )

    def linearised(self, values):
        """Samples and their derivatives by the values, by a program compiled at the first call."""
        return tuple(map(np.asarray, self._program(jnp.asarray(values))))


class LogPrediction:
    """Readings of logs, whose cases are alike in structure, from values at addresses.

    Each log has a table row of the values at its own addresses: those of all logs, and those that
    begin with its number. It is differentiated by these only. Offsets of sensors are added to the
    simulated readings.
    """

    def __init__(
        self,
        cases: list[Case],
        times: Float[np.ndarray, "log time"],
        plan: IntegrationPlan,
        schedule: EventSchedule | None,
        addresses: list[str],
    ):
        own, self.which = log_addresses(addresses, len(cases))
        self.given = np.array([[value_at(case, a) for a in own] for case in cases], float)
        self.simulated_addresses = tuple(a for a in own if not OFFSET_ADDRESS.fullmatch(a))
        self.columns = [own.index(address) for address in self.simulated_addresses]
        self.offset_addresses = tuple(_offset_addresses(cases[0]))
        # Ones where a column of the table is the offset of a channel.
        self.shifts = np.array([[a == o for o in self.offset_addresses] for a in own], float)
        fixed = np.array([[s.offset for s in case.all_sensors] for case in cases], float)
        self.fixed_offsets = fixed * (1 - self.shifts.sum(axis=0))
        # Ones where a column of the table is a parameter.
        self.selection = (self.which[..., None] == np.arange(len(addresses))).astype(float)
        self.plan = plan.without_statements()  # so that fits share compiled programs
        self.runs = stack_cases(cases), jnp.asarray(times), schedule

    def predict(self, values: Float[Array, " parameter"]) -> Float[Array, "log time channel"]:
        """Readings of all logs, differentiable at the cost of `linearised`."""
        table = self._table(values)
        return self._simulated_readings(table[:, self.columns]) + self._offsets(table)[:, None]

    def linearised(
        self, values: Float[np.ndarray, " parameter"]
    ) -> tuple[
        Float[np.ndarray, "log time channel"], Float[np.ndarray, "log time channel parameter"]
    ]:
        """Readings of all logs and their derivatives; as many logs at once as there are cores.

        The three logs of the demo take 0.45 s on two cores, 0.54 s one after the other.
        """
        table = self._table(np.asarray(values))
        offsets = self._offsets(table)

        readings_with_slopes.precompile(*self._log(0, table))()  # once, not in each thread

        def of_log(i):
            simulated, by_column = map(np.asarray, readings_with_slopes(*self._log(i, table)))
            slopes = by_column @ self.selection[i, self.columns]
            return simulated + offsets[i], slopes + self.shifts.T @ self.selection[i]

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            readings, slopes = zip(*pool.map(of_log, range(len(table))), strict=True)
        return np.stack(readings), np.stack(slopes)

    def _table(self, values):
        """Values at the own addresses of each log, (log, own)."""
        return xp.where(self.which < 0, self.given, values[self.which])

    def _offsets(self, table):
        """Offset of each channel in each log."""
        return self.fixed_offsets + table @ self.shifts

    def _arguments(self, case_times_schedule, values):
        """Arguments of `readings_with_slopes` for a log, at values of the simulated addresses."""
        case, times, schedule = case_times_schedule
        plan = dataclasses.replace(self.plan, schedule=schedule)
        return case, plan, times, values, self.simulated_addresses, self.offset_addresses

    def _log(self, i: int, table):
        """Arguments of `readings_with_slopes` for log i."""
        run = jax.tree.map(lambda leaf: leaf[i], self.runs)
        return self._arguments(run, np.asarray(table[i, self.columns]))

    @functools.cached_property
    def _simulated_readings(self):
        """Function from the simulated columns of the table to readings without offsets.

        Logs follow one another: as a batch they would not share what is the same at all times.
        """

        @jax.custom_jvp
        def readings(columns):
            return jax.lax.map(
                lambda part: _readings(*self._arguments(*part)), (self.runs, columns)
            )

        # A jitted function is traced once for all programs that it is part of.
        @jax.jit
        def with_slopes(runs, columns):
            return jax.lax.map(
                lambda part: readings_with_slopes(*self._arguments(*part)), (runs, columns)
            )

        @readings.defjvp
        def _(primals, tangents):
            samples, slopes = with_slopes(self.runs, *primals)
            return samples, jnp.einsum("ltca,la->ltc", slopes, *tangents)

        return readings


def _readings(
    case: Case,
    plan: IntegrationPlan,
    times: Float[Array, " time"],
    values: Float[Array, " own"],
    addresses: tuple[str, ...],
    offset_addresses: tuple[str, ...],
) -> Float[Array, "time channel"]:
    """Readings of one log without offsets, from values at addresses of its case."""
    changes = dict(zip(addresses, values, strict=True)) | dict.fromkeys(offset_addresses, 0.0)
    return simulate_readings(replace(case, changes), times, plan)


@compiled
def readings_with_slopes(
    case: Case,
    plan: IntegrationPlan,
    times: Float[Array, " time"],
    values: Float[Array, " own"],
    addresses: tuple[str, ...],
    offset_addresses: tuple[str, ...],
) -> tuple[Float[Array, "time channel"], Float[Array, "time channel own"]]:
    """Readings of one log without offsets, and their derivatives by the values at addresses.

    One program for all logs, fits and processes with cases of one structure: `case`, `plan` and
    `times` are arguments of it.
    """
    return _forward_mode(
        lambda values: _readings(case, plan, times, values, addresses, offset_addresses), values
    )


def _forward_mode(function: Callable, values: Float[Array, " value"]) -> tuple[Array, Array]:
    """Result of a function and its derivatives, along the last axis.

    `jax.linearize` would take half as long again to trace.
    """

    def along(direction):
        return jax.jvp(function, (values,), (direction,))

    return jax.vmap(along, out_axes=(None, -1))(jnp.eye(values.size))


def log_addresses(addresses: list[str], logs: int) -> tuple[list[str], np.ndarray]:
    """Addresses within a log, and the index of the parameter at each (log, address).

    The index is -1 where the parameter belongs to another log.
    """
    inner = list(dict.fromkeys(LOG_ADDRESS.sub(r"\2", address) for address in addresses))
    which = np.full((logs, len(inner)), -1)
    for i, address in enumerate(addresses):
        own = LOG_ADDRESS.fullmatch(address)
        rows = slice(None) if own is None else int(own[1])
        which[rows, inner.index(own[2] if own else address)] = i
    return inner, which


def _offset_addresses(case: Case) -> list[str]:
    """Addresses of the offsets of all sensors, in the order of the channels."""
    on_beam = [f"sensors.{i}.offset" for i in range(len(case.sensors))]
    return on_beam + [f"vehicle_sensors.{i}.offset" for i in range(len(case.vehicle_sensors))]
