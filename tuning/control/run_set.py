"""All runs of a tuning, simulated side by side and compiled once."""

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.analysis.bound.bound import DEFAULT_PERIOD, least_achievable_peak
from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.model.contact import traffic
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import IntegrationPlan, integration_plan, sample_times
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import Histories, simulate, simulate_histories
from tuning.control.fixed_design import with_fixed_design
from tuning.control.load_cases import PLANT_PREFIXES, AddressValues, run_case
from tuning.control.objective import Sharpness, run_merits

PEAK_TOLERANCE = 1e-4  # of the largest deflection: what tuning needs; verdicts are simulated finer


class RunSet(eqx.Module):
    """Runs of one case that differ in numbers only, and what they are without control (`uncontrolled_peaks`).

    `stacked` is the case with the numbers of all runs along a first axis, `error` the relative
    error of their peaks with the `plan`. `positions` (m) are where deflections count: the sensors', or
    given ones. Laws are designed for the plant of the case: where runs have other plants, `nominal`
    holds its numbers. What is compiled should take the bench as an argument: closed over, its
    arrays would be constants that XLA works on for seconds.
    """

    runs: Sequence[AddressValues]
    stacked: Case
    plan: IntegrationPlan
    error: Float[np.ndarray, ""]
    times: Float[Array, " time"]
    positions: Float[Array, " place"]
    uncontrolled: dict[str, Float[np.ndarray, " run"]]
    after_exit: Float[np.ndarray, "run time"]
    command_ranges: Float[np.ndarray, " actuator"]
    nominal: dict[str, Float[np.ndarray, ""]]

    @property
    def cases(self) -> list[Case]:
        """The cases of the runs, one by one."""
        leaves, treedef = jax.tree.flatten(jax.tree.map(jnp.asarray, self.stacked))
        return [jax.tree.unflatten(treedef, row) for row in zip(*leaves, strict=True)]

    def histories(self, values: Mapping[str, Any]) -> Histories:
        """Histories of all runs, along a first axis, with other numbers at some addresses."""

        def single(case):
            return simulate_histories(
                self._case_with_values(case, values), self.times, self.plan, self.positions
            )

        return jax.vmap(single)(self.stacked)

    def merits_of(
        self, found: Histories, sharpness: Sharpness = None
    ) -> dict[str, Float[Array, " run"]]:
        """Figures of merit of all runs; differentiable."""
        weights = jax.vmap(lambda case: traffic(case).weight[:, 0])(self.stacked)
        ranges = jnp.asarray(self.command_ranges)

        def single(found, free, after, weights):
            return run_merits(found, free, after, ranges, weights, sharpness)

        return jax.vmap(single)(found, self.uncontrolled, jnp.asarray(self.after_exit), weights)

    def merits(
        self, values: Mapping[str, Any], sharpness: Sharpness = None
    ) -> dict[str, Float[Array, " run"]]:
        """Figures of merit of all runs with other numbers at some addresses."""
        return self.merits_of(self.histories(values), sharpness)

    def records(self, values: Mapping[str, Any]) -> list[Record]:
        """Records of all runs, with true peaks between and at samples."""
        plan = dataclasses.replace(self.plan, error=float(self.error))
        return [simulate(self._case_with_values(case, values), plan=plan) for case in self.cases]

    def subset(self, rows: Int[Array, " some"]) -> "RunSet":
        """The bench with some of its runs only."""
        parts = self.stacked, self.uncontrolled, self.after_exit
        some = jax.tree.map(lambda leaf: jnp.asarray(leaf)[rows], parts)
        return eqx.tree_at(lambda b: (b.stacked, b.free, b.after), self, some)

    def _case_with_values(self, case: Case, values: Mapping[str, Any]) -> Case:
        return with_fixed_design(replace(case, values), self.nominal, self.plan.shapes.layout)


def make_run_set(
    case: Case, runs: Sequence[AddressValues], positions=None, least_peaks: bool = False
) -> RunSet:
    """Prepare the runs of a case; peaks without control are simulated once.

    With `least_peaks` the least peak that is possible is found for each, else it is NaN.

    Raises ValueError for an address that is not there, a run that is too short or faulty, and
    without a controller or anywhere to look at the deflection.
    """
    if case.controller is None:
        raise ValueError("there is no controller to tune: give the case one")
    if positions is None:
        positions = [float(sensor.position) for sensor in case.sensors]
    positions = jnp.asarray(positions, float).reshape(-1)
    if positions.size == 0:
        raise ValueError("nowhere to look at the deflection: add a sensor, or give places (m)")
    cases = [run_case(case, run) for run in runs]
    times = sample_times(case)
    # What takes long is compiling programs that have nothing to do with each other.
    with ThreadPoolExecutor(3) as pool:
        plan_future = pool.submit(_common_plan, cases)
        deflection_future = pool.submit(_uncontrolled_deflections, cases, times, positions)
        least_future = pool.submit(_least_peaks, cases, positions) if least_peaks else None
    plan, error = plan_future.result()
    deflection = deflection_future.result()
    varied = dict.fromkeys(a for run in runs for a in run if a.startswith(PLANT_PREFIXES))
    exit_times = np.array([_last_exit(own) for own in cases])
    command_limits = [actuator.command_limits() for actuator in case.actuators]
    return RunSet(
        runs=runs,
        stacked=stacked_cases(cases),
        plan=plan,
        error=np.asarray(error),
        times=times,
        positions=positions,
        uncontrolled={
            "peak": np.abs(deflection).max(axis=(1, 2)),
            "rms": np.sqrt((deflection**2).mean(axis=(1, 2))),
            "least": np.full(len(runs), np.nan) if least_future is None else least_future.result(),
        },
        after_exit=(np.asarray(times) > exit_times[:, None]).astype(float),
        command_ranges=np.array(
            [1.0 if pair is None else np.abs(pair).max() for pair in command_limits]
        ),
        nominal={address: np.asarray(value_at(case, address)) for address in varied},
    )


def _uncontrolled_deflections(
    cases: list[Case], times, positions
) -> Float[np.ndarray, "run time place"]:
    """Deflections (m) of runs without their controllers."""
    without_controller = [dataclasses.replace(own, controller=None) for own in cases]
    plan, _ = _common_plan(without_controller)
    return np.asarray(_deflections(stacked_cases(without_controller), times, plan, positions))


def _least_peaks(cases: list[Case], positions) -> Float[np.ndarray, " run"]:
    period = cases[0].controller.period
    hold_period = DEFAULT_PERIOD if period is None else float(period)
    return np.array([least_achievable_peak(own, positions, hold_period) for own in cases])


def stacked_cases(cases: list[Case]) -> Case:
    """One case with the numbers of several, alike in structure, along a first axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *cases)


@compiled
def _deflections(
    stacked: Case, times, plan: IntegrationPlan, positions
) -> Float[Array, "run time place"]:
    return jax.vmap(lambda own: simulate_histories(own, times, plan, positions).deflection)(stacked)


def _common_plan(cases: list[Case]) -> tuple[IntegrationPlan, float]:
    """One plan for cases alike in structure, fine enough for each, and its error apart from it.

    Runs whose plans differ in nothing but the error share what is compiled.

    Raises ValueError if they differ in more than numbers.
    """
    plans = [integration_plan(own, tolerance=PEAK_TOLERANCE) for own in cases]
    if len({plan.shapes.layout for plan in plans}) > 1:
        raise ValueError("the runs differ in the order of places along the beam; tune them apart")
    max_loads = max(plan.shapes.max_loads for plan in plans)
    common = dataclasses.replace(
        plans[0],
        shapes=dataclasses.replace(plans[0].shapes, slots=max_loads),
        substeps=max(plan.substeps for plan in plans),
        error=0.0,
    )
    return common, max(plan.error for plan in plans)


def _last_exit(case: Case) -> float:
    windows = [path.window()[1] for path in traffic(case).motions]
    return max((float(leave) for leave in windows), default=0.0)
