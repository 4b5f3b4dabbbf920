"""Sets of runs on which a controller is judged, on one plant or several."""

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.analysis.bound.bound import DEFAULT_PERIOD, least_achievable_peak, no_bound
from jaxbeam.case.case import Case, crossing_times, replace, stack_cases, value_at
from jaxbeam.case.fields import refuses_traced
from jaxbeam.control.feedforward import without_control
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled, compiled_if_traced
from jaxbeam.runtime.memory import block_memory
from jaxbeam.simulation.integration_plan import (
    IntegrationPlan,
    common_plan,
    integration_plan,
    sample_times,
)
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import Histories, simulate, simulate_histories
from tuning.control.load_cases import PLANT_PREFIXES, AddressValues, run_cases
from tuning.control.objective import Sharpness, run_metrics, with_fixed_design
from tuning.fit.result import Fit
from tuning.fit.uncertainty import Posterior

MAX_DRAWS_PER_PLANT = 100  # draws from which each plant within the bounds is selected


@refuses_traced("a plant of a fit")
def with_identified_plant(case: Case, found: Fit | Posterior) -> Case:
    """The case with the identified parameters of beam, supports, actuators and sensors.

    Parameters of loads and of single logs stay as they are in the case. Raises ValueError if the
    case lacks an address, or if no parameter of the plant was identified.

    `found` is the identification, by likelihood or with its posterior.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> round(float(tuning.control.with_identified_plant(fit.case, fit).beam.flexural_rigidity), 2)
    12.02
    """
    values = found.means if isinstance(found, Posterior) else found.values
    return replace(case, _plant_values(found.addresses, values))


@refuses_traced("a plant of a fit")
def draw_plants(found: Fit | Posterior, count: int, seed: int = 0) -> tuple[AddressValues, ...]:
    """Parameters of plants, by address, drawn from the uncertainty of an identification.

    For a fit they are drawn from its covariance, with Student's distribution for its degrees of
    freedom, and lie within the bounds; for a posterior they are draws of it. Parameters of loads
    and of single logs are left out after drawing, so that the others keep their correlations.

    Raises ValueError for a fit with unidentifiable parameters, for a count below 1 or above the
    number of draws of the posterior, and if too few draws lie within the bounds.

    `found` is the identification; equal seeds give equal draws.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> plants = tuning.control.draw_plants(fit, 2, seed=1)
    >>> [round(one["beam.flexural_rigidity"], 2) for one in plants]
    [12.04, 12.0]
    """
    if count < 1:
        raise ValueError(f"the number of plants must be 1 or more, not {count}")
    rng = np.random.default_rng(seed)
    if isinstance(found, Posterior):
        rows = found.draws.reshape(-1, len(found.addresses))
        if count > len(rows):
            raise ValueError(f"{count} plants need as many draws; the posterior has {len(rows)}")
        rows = rows[rng.choice(len(rows), count, replace=False)]
    else:
        rows = _covariance_draws(found, count, rng)
    return tuple(_plant_values(found.addresses, row) for row in rows)


def _covariance_draws(fit: Fit, count: int, rng) -> np.ndarray:
    """Draws (count, parameter) from the covariance of a fit, within its bounds."""
    if not np.all(np.isfinite(fit.errors)):
        unidentifiable = [
            a for a, e in zip(fit.addresses, fit.errors, strict=True) if not np.isfinite(e)
        ]
        raise ValueError(
            f"not identifiable from the data: {', '.join(unidentifiable)}; to draw plants, fit with"
            " a prior, or hold parameters that are known otherwise"
        )
    covariance = fit.correlation * np.outer(fit.errors, fit.errors)
    # Correlations of nearly one lead to negative eigenvalues of rounding size.
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    low, high = (np.array([getattr(n, side) for n in fit.parameters]) for side in ("low", "high"))
    tries = MAX_DRAWS_PER_PLANT * count
    t_scale = np.sqrt(fit.degrees_of_freedom / rng.chisquare(fit.degrees_of_freedom, tries))
    drawn = fit.values + t_scale[:, None] * (rng.normal(size=(tries, len(values))) @ root.T)
    inside = drawn[np.all((drawn >= low) & (drawn <= high), axis=1)]
    if len(inside) < count:
        raise ValueError(
            f"of {tries} plants drawn only {len(inside)} lie within the bounds of the fit: its"
            " errors are too large for them; sample its posterior instead"
        )
    return inside[:count]


def _plant_values(addresses: list[str], row) -> AddressValues:
    """Values of the parameters of the plant. Raises ValueError if there are none."""
    pairs = zip(addresses, map(float, row), strict=True)
    found = {address: value for address, value in pairs if address.startswith(PLANT_PREFIXES)}
    if not found:
        raise ValueError(f"no parameter of the plant was identified, only {', '.join(addresses)}")
    return found


PEAK_TOLERANCE = 1e-4  # of the largest deflection
# Largest number of runs without control that are not compiled: each takes 0.03 to 0.14 s (3 and 6
# modes), their program 5 s to compile.
MAX_UNCOMPILED_RUNS = 60
STATE_COPIES = 4  # of the states of all steps of a run, while its history is computed


class RunSet(eqx.Module):
    """Runs of one case, simulated as a batch with one integration plan.

    `stacked` is the case with the numbers of all runs along a first axis, `error` the relative
    error of their peaks with the `plan`, `sensor_errors` those at each sensor. `uncontrolled`
    holds, by run, the peak and RMS deflection (m) without control ("peak", "rms"), the least
    achievable peak ("least", m; NaN if not computed), and the largest absolute value of each of the
    `quantities` of sensors. `positions` (m) are where deflections count; `nominal` has the
    parameters of the plant, by address, that controllers are designed for where those of the runs
    differ.

    Pass a run set as an argument to compiled functions, never by closure: its arrays would become
    constants that XLA works on for seconds.
    """

    runs: Sequence[AddressValues]
    stacked: Case
    plan: IntegrationPlan
    error: Float[np.ndarray, ""]
    sensor_errors: Float[np.ndarray, " sensor"]
    times: Float[Array, " time"]
    positions: Float[Array, " position"]
    uncontrolled: dict[str, Float[np.ndarray, " run"]]
    after_exit: Float[np.ndarray, "run time"]
    command_ranges: Float[np.ndarray, " actuator"]
    nominal: dict[str, Float[np.ndarray, ""]]
    quantities: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def cases(self) -> list[Case]:
        """The cases of the runs, one by one."""
        leaves, treedef = jax.tree.flatten(jax.tree.map(np.asarray, self.stacked))
        return [jax.tree.unflatten(treedef, row) for row in zip(*leaves, strict=True)]

    def histories(self, values: Mapping[str, Any]) -> Histories:
        """Histories of all runs, along a first axis, with other values at some addresses."""

        def single(case):
            varied = self._case_with_values(case, values)
            wanted = self.times, self.plan, self.positions, self.quantities
            return simulate_histories(varied, *wanted)

        return jax.vmap(single)(self.stacked)

    def metrics_of(
        self, found: Histories, sharpness: Sharpness = None
    ) -> dict[str, Float[Array, " run"]]:
        """Metrics of all runs from their histories; differentiable."""
        weights = jax.vmap(lambda case: load_set(case).weight[:, 0])(self.stacked)
        ranges = jnp.asarray(self.command_ranges)

        def single(found, uncontrolled, after_exit, weights):
            return run_metrics(found, uncontrolled, after_exit, ranges, weights, sharpness)

        return jax.vmap(single)(found, self.uncontrolled, jnp.asarray(self.after_exit), weights)

    def metrics(
        self, values: Mapping[str, Any], sharpness: Sharpness = None
    ) -> dict[str, Float[Array, " run"]]:
        """Metrics of all runs with other values at some addresses."""
        return self.metrics_of(self.histories(values), sharpness)

    def records(self, values: Mapping[str, Any]) -> list[Record]:
        """Records of all runs, with peaks between samples, too."""
        errors = float(self.error), tuple(self.sensor_errors.tolist())
        plan = dataclasses.replace(self.plan, error=errors[0], sensor_errors=errors[1])
        return [simulate(self._case_with_values(case, values), plan=plan) for case in self.cases]

    def subset(self, rows: Int[Array, " some"]) -> "RunSet":
        """The run set with some of its runs only."""
        parts = self.stacked, self.uncontrolled, self.after_exit
        some = jax.tree.map(lambda leaf: jnp.asarray(leaf)[rows], parts)
        return eqx.tree_at(lambda own: (own.stacked, own.uncontrolled, own.after_exit), self, some)

    def _case_with_values(self, case: Case, values: Mapping[str, Any]) -> Case:
        return with_fixed_design(replace(case, values), self.nominal, self.plan.shapes.layout)


def make_run_set(
    case: Case,
    runs: Sequence[AddressValues],
    positions=None,
    least_peaks: bool = False,
    quantities: Sequence[str] = (),
) -> RunSet:
    """Run set of a case; the runs are simulated once without control.

    `positions` (m) are where deflections count, those of the sensors if left out. With
    `least_peaks` the least achievable peak of each run is computed, unless limits of a voltage
    allow none (see `jaxbeam.bound`). `quantities` of sensors are metrics.

    Raises ValueError for an unknown address, a faulty run or one that ends too early, and for a
    case without controller and absorbers, without positions, or without a sensor of one of the
    quantities.
    """
    if case.controller is None and not case.absorbers:
        raise ValueError(
            "there is nothing to tune: the case has neither a controller nor absorbers; add one"
        )
    if positions is None:
        positions = [float(sensor.position) for sensor in case.sensors]
    positions = jnp.asarray(positions, float).reshape(-1)
    if positions.size == 0:
        raise ValueError("there is no deflection to reduce: add a sensor, or give positions (m)")
    for name in quantities:
        if all(sensor.quantity != name for sensor in case.sensors):
            raise ValueError(
                f"the metric {name!r} is the largest {name} at the sensors that measure it, and no"
                f' sensor does: add one with quantity = "{name}"'
            )
    cases = run_cases(case, runs)
    times = sample_times(case)
    # Most of the time goes into compiling programs that do not depend on each other.
    with ThreadPoolExecutor(3) as pool:
        plan_future = pool.submit(_integration_plan, cases)
        wanted = times, positions, tuple(quantities)
        uncontrolled_future = pool.submit(_uncontrolled_histories, cases, *wanted)
        bounded = least_peaks and case.controller is not None and not no_bound(case)
        least_future = pool.submit(_least_peaks, cases, positions) if bounded else None
    plan = plan_future.result()
    uncontrolled = uncontrolled_future.result()
    deflection = uncontrolled.deflection
    varied = dict.fromkeys(a for run in runs for a in run if a.startswith(PLANT_PREFIXES))
    exit_times = np.array([crossing_times(own)[:, 1].max(initial=0.0) for own in cases])
    command_limits = [actuator.command_limits() for actuator in case.actuators]
    return RunSet(
        runs=runs,
        stacked=stack_cases(cases),
        plan=plan.without_statements(),
        error=np.asarray(plan.error),
        sensor_errors=np.array(plan.sensor_errors),
        times=times,
        positions=positions,
        uncontrolled={
            "peak": np.abs(deflection).max(axis=(1, 2)),
            "rms": np.sqrt((deflection**2).mean(axis=(1, 2))),
            "least": np.full(len(runs), np.nan) if least_future is None else least_future.result(),
            **{name: np.abs(h).max(axis=(1, 2)) for name, h in uncontrolled.measured.items()},
        },
        after_exit=(np.asarray(times) > exit_times[:, None]).astype(float),
        command_ranges=np.array(
            [1.0 if pair is None else np.abs(pair).max() for pair in command_limits]
        ),
        nominal={address: np.asarray(value_at(case, address)) for address in varied},
        quantities=tuple(quantities),
    )


def uncontrolled(case: Case) -> Case:
    """The case without its controller; without its absorbers, if it has no controller."""
    if case.controller is None:
        return dataclasses.replace(case, absorbers=())
    return without_control(case)


def _integration_plan(cases: list[Case]) -> IntegrationPlan:
    """Integration plan of all cases."""
    return common_plan([integration_plan(case, tolerance=PEAK_TOLERANCE) for case in cases], "runs")


def _uncontrolled_histories(cases: list[Case], times, positions, quantities) -> Histories:
    """Histories of runs without their controllers, or else absorbers, along a first axis."""
    without_controller = [uncontrolled(case) for case in cases]
    plan = _integration_plan(without_controller).without_statements()
    wanted = times, plan, positions, quantities
    if len(cases) <= MAX_UNCOMPILED_RUNS:
        found = [_direct_histories(case, *wanted) for case in without_controller]
        return jax.tree.map(lambda *runs: np.stack(runs), *found)
    at_once = runs_at_once(without_controller[0], times, plan)
    parts = [without_controller[first : first + at_once] for first in range(0, len(cases), at_once)]
    parts[-1] += parts[0][: len(parts[0]) - len(parts[-1])]  # all of one shape, for one program
    found = [jax.tree.map(np.asarray, _histories(stack_cases(part), *wanted)) for part in parts]
    return jax.tree.map(lambda *some: np.concatenate(some)[: len(cases)], *found)


def runs_at_once(case: Case, times, plan: IntegrationPlan) -> int:
    """Number of runs of a case whose histories are computed together, as memory allows it."""
    run_bytes = 8.0 * STATE_COPIES * len(times) * plan.substeps * 2 * case.beam.modes
    return max(1, int(block_memory() / run_bytes))


_direct_histories = compiled_if_traced(simulate_histories)


@compiled
def _histories(
    stacked: Case, times, plan: IntegrationPlan, positions, quantities: tuple[str, ...]
) -> Histories:
    wanted = times, plan, positions, quantities
    return jax.vmap(lambda own: simulate_histories(own, *wanted))(stacked)


def _least_peaks(cases: list[Case], positions) -> Float[np.ndarray, " run"]:
    period = cases[0].controller.period
    hold_period = DEFAULT_PERIOD if period is None else float(period)
    return np.array([least_achievable_peak(case, positions, hold_period) for case in cases])
