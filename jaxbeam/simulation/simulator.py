"""Simulator of one case, prepared once and called with many values of some of its numbers."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import numpy as np

from jaxbeam.case.case import Case, check_is_case, replace
from jaxbeam.case.fields import concrete, is_concrete, real_numbers
from jaxbeam.runtime.arrays import Module, any_traced, xp
from jaxbeam.simulation.integration_plan import TOLERANCE, IntegrationPlan
from jaxbeam.simulation.integrator.step_size import check_tolerance
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import plan_of_peaks, simulate_planned
from jaxbeam.simulation.varied_plan import Range, declared_ranges, varied_plan, within


@dataclasses.dataclass(frozen=True, eq=False)
class _Prepared:
    """What a simulator prepares: concrete numbers, whatever transformation it is given to.

    Compared by identity, so that it is a static part of programs.
    """

    case: Case
    ranges: dict[str, Range]
    plan: IntegrationPlan
    times: np.ndarray | None


class Simulator(Module):
    """Simulation of a case as a function of the numbers at some addresses.

    `vary` lists addresses, or maps each to its range (low, high) in SI units; without a range it is
    from half to twice the number of the case. Time steps are chosen once, for the middle and the
    ends of the ranges; the error that a record states is the largest of those runs. Called with
    values, as a mapping or in the order of `vary`, it returns the record of `jaxbeam.simulate`,
    under `jit`, `vmap`, `grad`, `jvp`, `hessian`, `lax.map` and inside `scan` too, also where it is
    an argument of them: it has no numbers that they trace. Whatever does not depend on traced
    values is computed in NumPy. `record.result` tells what is wrong with a
    run (see `jaxbeam.simulation.record.Result`).

    Raises ValueError for an invalid case, unknown addresses, ranges in which positions change their
    order, when called with too few or too many values or in single precision, and outside of
    transformations with values beyond their ranges.

    >>> import jax, jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> sim = jb.Simulator(case, vary={"loads.0.mass": (0.1, 0.5)})
    >>> print(f"{1e3 * sim([0.5]).peak_deflection[0]:.2f} mm")
    2.00 mm
    """

    prepared: _Prepared = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def __init__(self, case: Case, vary: Any = (), times=None, tolerance: float = TOLERANCE):
        if any_traced(case, vary, times, tolerance):
            raise ValueError(
                "a Simulator chooses time steps from the numbers of its case and from what else it"
                " is given: make it outside of jax.jit, vmap and grad, and call it with the traced"
                " values"
            )
        check_is_case(case)
        times = None if times is None else np.asarray(real_numbers("times", times, "s"))
        ranges = declared_ranges(case, vary)
        timing = [a for a in ranges if times is None and a in ("run.duration", "run.sample_rate")]
        if timing:
            raise ValueError(f"{timing[0]} fixes the number of samples: give times if it varies")
        check_tolerance(tolerance)
        self.tolerance = float(tolerance)
        plan = varied_plan(case, ranges, times, self.tolerance, plan_of_peaks)
        self.prepared = _Prepared(case, ranges, plan, times)

    def __repr__(self) -> str:
        varied = ", ".join(self.prepared.ranges) or "no number"
        return f"Simulator of {self.prepared.case.title!r}: varies {varied}"

    def __call__(self, values: Mapping[str, Any] | Any = ()) -> Record:
        """Record for some values in SI units, by address or in the order of the addresses."""
        case, ranges = self.prepared.case, self.prepared.ranges
        if not isinstance(values, Mapping):
            listed = isinstance(values, list | tuple) or xp.ndim(values) > 0
            values = list(values) if listed else [values]
            if len(values) != len(ranges):
                raise ValueError(
                    f"give as many values as numbers vary, {len(ranges)} ({', '.join(ranges)}),"
                    f" not {len(values)}"
                )
            values = dict(zip(ranges, values, strict=True))
        unknown = [address for address in values if address not in ranges]
        if unknown:
            raise ValueError(f"{unknown[0]} does not vary: it is none of {', '.join(ranges)}")
        case = replace(case, values)
        inside = within(case, ranges)
        if is_concrete(inside) and not concrete(inside):
            named = {a: both for a, both in ranges.items() if not within(case, {a: both})}
            address, (low, high) = next(iter(named.items()))
            raise ValueError(
                f"{address} is out of the range for which the steps were chosen, {low} to {high}:"
                f" give jb.Simulator a wider one"
            )
        plan, times = self.prepared.plan, self.prepared.times
        return simulate_planned(case, plan, times, self.tolerance, inside)
