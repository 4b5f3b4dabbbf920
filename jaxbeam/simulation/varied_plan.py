"""Integration plans for ranges of the numbers of a case: declared, traced, or assumed.

Steps are chosen for the ends of each range. Of a traced number the range is that of its values, if
`vmap` or `grad` has them; under `jit`, `scan` and `lax.map` it is assumed for those few on which
steps depend little, and must be declared for all others.
"""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from jaxbeam.case.case import (
    Case,
    check_distinct,
    leaves_by_address,
    own_addresses,
    replace,
    unit_at,
    value_at,
)
from jaxbeam.case.fields import concrete, is_concrete, real_numbers
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.simulation.integration_plan import IntegrationPlan, common_plan, integration_plan

Range = tuple[Any, Any]  # lowest and highest value, arrays of the shape of the number
MARGIN = 2.0  # a number without a range is within this factor of that of the case
MOST_ENDS = 8  # of ranges that are tried one by one; of more, all lower and all upper ends
STEPS_OF_MANY = 2  # times as many steps where ends are tried together
UNTRIED = 2.0  # errors within ranges over those at the numbers that are tried
SPEED_MARGIN = 4.0  # a traced speed, over the slowest that crosses within the run


def varied_plan(
    case: Case,
    ranges: Mapping[str, Range],
    times,
    tolerance: float,
    plan_of: Callable[..., IntegrationPlan] = integration_plan,
) -> IntegrationPlan:
    """Plan for all cases whose numbers at some addresses are within ranges.

    The error is twice the largest of those at the middle and the ends of the ranges, for which
    `plan_of` gives plans: it is larger at other numbers. Raises ValueError as `integration_plan`
    does, and if positions along the beam change their order within the ranges.
    """
    ends = [(address, end) for address, both in ranges.items() for end in both]
    tried = [{address: end} for address, end in ends]
    if many := len(ends) > MOST_ENDS:
        tried = [{address: both[i] for address, both in ranges.items()} for i in (0, 1)]
    middle = {address: (low + high) / 2 for address, (low, high) in ranges.items()}
    base = replace(case, middle)
    several = any(np.any(low < high) for low, high in ranges.values())
    margin, cases = UNTRIED if several else 1.0, (replace(base, one) for one in (middle, *tried))
    plans = [plan_of(one, times, tolerance / margin) for one in cases]
    plan = common_plan(plans, "cases at the ends of the ranges")
    return dataclasses.replace(
        plan,
        substeps=(STEPS_OF_MANY if many else 1) * plan.substeps,
        error=margin * plan.error,
        sensor_errors=tuple(margin * error for error in plan.sensor_errors),
        origin=None,
    )


def declared_ranges(case: Case, vary) -> dict[str, Range]:
    """Ranges of addresses that vary: as given, or a margin around the numbers of the case.

    Raises ValueError for an unknown address, and for a range that is none.
    """
    if isinstance(vary, str):
        vary = (vary,)
    if not isinstance(vary, Iterable) or not all(isinstance(one, str) for one in vary):
        raise ValueError(
            f"vary lists addresses, such as 'loads.0.mass', or maps each to its range, not {vary!r}"
        )
    check_distinct({address: own_addresses(case, address) for address in vary})
    given = dict(vary) if isinstance(vary, Mapping) else dict.fromkeys(vary)
    ranges = {}
    for address, both in given.items():
        value = concrete(value_at(case, address))
        if both is None:
            ends = value / MARGIN, value * MARGIN
        else:
            given_ends = both if isinstance(both, list | tuple) or np.ndim(both) else ()
            unit = unit_at(case, address)
            ends = tuple(
                np.broadcast_to(real_numbers(f"the range of {address}", end, unit), value.shape)
                for end in given_ends
            )
            if len(ends) != 2 or not np.all(ends[0] <= ends[1]):
                raise ValueError(f"the range of {address} must be (low, high), not {both}")
        ranges[address] = np.minimum(*ends), np.maximum(*ends)
    return ranges


def traced_ranges(case: Case) -> tuple[Case, dict[str, Range]]:
    """Concrete case in the middle of the ranges of a traced case's numbers, and the ranges.

    Raises ValueError for a traced number without values on which steps depend.
    """
    structure, by_address = jax.tree.structure(case), leaves_by_address(case)
    names, leaves = by_address.keys(), by_address.values()
    found: dict[str, Range] = {}
    for name, leaf in zip(names, leaves, strict=True):
        if isinstance(leaf, jax.core.Tracer):
            found[name] = _values_of(leaf) or _assumed_range(case, name)
    middle = [
        sum(found[name]) / 2 if name in found else np.asarray(leaf, float)
        for name, leaf in zip(names, leaves, strict=True)
    ]
    return structure.unflatten(middle), found


def _values_of(value: Any) -> Range | None:
    """Smallest and largest value of a traced number, if a transformation has its values."""
    if not isinstance(value, jax.core.Tracer):
        return np.asarray(value, float), np.asarray(value, float)
    if is_concrete(value):
        return concrete(value), concrete(value)
    if hasattr(value, "batch_dim"):  # of vmap
        both = _values_of(value.val)
        if both is None or value.batch_dim is None:
            return both
        return np.min(both[0], axis=value.batch_dim), np.max(both[1], axis=value.batch_dim)
    return _values_of(value.primal) if hasattr(value, "primal") else None  # of grad and jvp


def _assumed_range(case: Case, address: str) -> Range:
    """Assumed range of a traced number without values, on which steps depend little."""
    shape = np.shape(value_at(case, address))
    beam = case.beam

    def of(low, high) -> Range:
        return np.full(shape, float(low)), np.full(shape, float(high))

    plain_load = re.fullmatch(r"loads\.(\d+)\.(\w+)", address)
    name = plain_load.group(2) if plain_load else address
    vehicle = plain_load and bool(case.loads[int(plain_load.group(1))].vehicle(np.ones(())).names)
    needed = [beam.length, case.run.duration, beam.linear_density]
    if all(map(is_concrete, needed)) and not vehicle:
        length, duration, density = (float(concrete(one)) for one in needed)
        if name in ("mass", "masses"):
            return of(0.0 if name == "masses" else 1e-3 * density * length, density * length)
        if name in ("force", "forces", "weight"):
            return of(density * length, 2 * density * length)
        if name == "speed":
            return of(length / duration, SPEED_MARGIN * length / duration)
    if name == "run.gravity":
        return of(1.0, 10.0)
    raise ValueError(
        f"{address} is traced by jax.jit, jax.lax.map or scan, so that its value is unknown, and"
        f" the time steps depend on it: make sim = jb.Simulator(case, vary={{{address!r}: (low,"
        " high)}) outside, and call sim(values)"
    )


@compiled_if_traced
def within(case: Case, ranges: Mapping[str, Range]) -> Bool[Array, ""]:
    """Whether all numbers of a case are within their ranges."""
    inside: Any = np.ones((), bool)
    for address, (low, high) in ranges.items():
        for own in own_addresses(case, address):
            value = value_at(case, own)
            inside = inside & xp.all((value >= low) & (value <= high))
    return inside
