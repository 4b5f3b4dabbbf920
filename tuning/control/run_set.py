"""Load cases of a tuning, training and held out, and their runs on one plant or several."""

import dataclasses
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.stats.qmc import LatinHypercube

from jaxbeam.analysis.bound.bound import DEFAULT_PERIOD, least_achievable_peak, no_bound
from jaxbeam.case.arguments import checks_classes, describe_value
from jaxbeam.case.case import Case, crossing_times, replace, stack_cases, unit_at, value_at
from jaxbeam.case.fields import OUTSIDE, concrete, refuse_traced, refuses_traced
from jaxbeam.case.tables import COUNT, NUMBERS, TABLE, check_entry, check_table
from jaxbeam.case.toml_file import in_si, is_quantity, read_toml
from jaxbeam.case.trajectory import NEVER
from jaxbeam.control.feedforward import without_control
from jaxbeam.files.case_file import with_settings
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled, compiled_if_traced
from jaxbeam.runtime.memory import block_memory
from jaxbeam.runtime.printer import counted
from jaxbeam.simulation.integration_plan import (
    IntegrationPlan,
    common_plan,
    integration_plan,
    sample_times,
)
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import Histories, simulate, simulate_histories
from tuning.control.objective import Sharpness, run_metrics, with_fixed_design
from tuning.fit.result import Fit
from tuning.fit.uncertainty import Posterior

AddressValues = dict[str, float]  # values of the case by address
TABLES = ("training", "held_out")
VALUES = NUMBERS._replace(description='a list of numbers, such as "loads.0.mass" = [0.2, 0.5]')
COUNTS = ("seed", "count", "waves")  # names of whole numbers, which are not numbers of a case
MAX_LOAD_CASES = 100_000
# Addresses of the plant begin with these.
PLANT_PREFIXES = ("beam.", "supports.", "actuators.", "sensors.")


@dataclasses.dataclass(frozen=True)
class LoadCases:
    """Training and held-out runs: values of the case by address, which differ from run to run.

    Vehicles and profiles are numbers like others, `loads.0.body_mass`; `profile.seed` is another
    realisation of a random profile.

    The tuning minimises the objective of the `training` runs; `held_out` runs are simulated with
    its result only.

    Raises ValueError without training runs, and for a held-out run that is a training run.

    >>> import tuning
    >>> loads = tuning.LoadCases(
    ...     ({"loads.0.mass": 0.2}, {"loads.0.mass": 0.5}), ({"loads.0.mass": 0.4},)
    ... )
    >>> stiff = [{"beam.flexural_rigidity": 12.0}, {"beam.flexural_rigidity": 13.0}]
    >>> print(len(loads.across(stiff).training), "training runs")
    4 training runs
    """

    training: tuple[AddressValues, ...]
    held_out: tuple[AddressValues, ...] = ()

    def __post_init__(self):
        refuse_traced("a set of load cases", OUTSIDE, self.training, self.held_out)
        if not self.training:
            raise ValueError("there is nothing to tune on: give at least one training case")
        repeated = [run for run in self.held_out if run in self.training]
        if repeated:
            raise ValueError(
                f"held-out cases must not be trained on, but {_describe(repeated[0])} is"
            )

    @checks_classes
    def across(
        self, plants: Sequence[AddressValues], others: Sequence[AddressValues] = ()
    ) -> "LoadCases":
        """Every training run on each of the plants, every held-out run on each of the `others`.

        Plants are values by address, as `tuning.control.draw_plants` returns them; without
        `others`, held-out runs have the plant of the case.
        """
        held_out = _all_pairs(self.held_out, others) if others else self.held_out
        return LoadCases(_all_pairs(self.training, plants), held_out)


def _all_pairs(
    runs: Sequence[AddressValues], plants: Sequence[AddressValues]
) -> tuple[AddressValues, ...]:
    return tuple({**run, **plant} for run in runs for plant in plants)


@refuses_traced("a set of load cases", "give known numbers")
def full_grid(values: Mapping[str, Sequence[float | int]]) -> tuple[AddressValues, ...]:
    """Full grid: every combination of the values given by address.

    Raises ValueError where the values at an address are no list.

    >>> import tuning
    >>> print(*tuning.full_grid({"loads.0.mass": [0.2, 0.4]}))
    {'loads.0.mass': 0.2} {'loads.0.mass': 0.4}
    """
    for address, listed in values.items():
        if np.ndim(listed) != 1:
            raise ValueError(f"{address}: give a list of numbers, not {describe_value(listed)}")
    rows = itertools.product(*values.values())
    return tuple(dict(zip(values, map(float, row), strict=True)) for row in rows)


@refuses_traced("a set of load cases", "give known numbers")
def latin_hypercube(
    ranges: Mapping[str, Sequence[float | int]], count: int, seed: int = 0
) -> tuple[AddressValues, ...]:
    """Latin hypercube: `count` draws of values, evenly spread over a range for each address.

    Raises ValueError for a count below 1 or a range that does not ascend.

    >>> import tuning
    >>> len(tuning.latin_hypercube({"loads.0.mass": (0.2, 0.4)}, count=5))
    5
    """
    if count < 1:
        raise ValueError(f"the number of draws must be 1 or more, not {count}")
    for address, (low, high) in ranges.items():
        if not low < high:
            raise ValueError(f"{address}: a range must ascend, but it is {low:g} to {high:g}")
    shares = LatinHypercube(len(ranges), rng=np.random.default_rng(seed)).random(count)
    low, high = np.array(list(ranges.values()), float).T
    rows = low + (high - low) * shares
    return tuple(dict(zip(ranges, map(float, row), strict=True)) for row in rows)


@checks_classes
def read_load_cases(path: str | os.PathLike, case: Case | None = None) -> LoadCases:
    r"""Read load cases from a TOML file with tables [training] and [held_out].

    Each table has lists of values by address in quotes, such as "loads.0.mass" = [0.2, 0.5]; its
    runs are all combinations. With `draws = 12` (and `seed = 1`, 0 if left out) the lists are
    ranges, low and high, of which the runs are a Latin hypercube. With the `case` whose values they
    are, entries may have units: "loads.0.speed" = ["60 km/h", "90 km/h"].

    Raises ValueError, naming the file and the key, for faulty content; OSError if the file cannot
    be read.

    >>> from pathlib import Path
    >>> import tuning
    >>> tables = '[training]\n"loads.0.mass" = [0.2, 0.5]\n[held_out]\n"loads.0.mass" = [0.4]\n'
    >>> _ = Path("loads.toml").write_text(tables)
    >>> tuning.read_load_cases("loads.toml").held_out
    ({'loads.0.mass': 0.4},)
    """
    content = read_toml(path, "file of load cases")
    try:
        return _load_cases(content, case)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _load_cases(content: dict[str, Any], case: Case | None) -> LoadCases:
    """Load cases from the tables of their file."""
    unknown = set(content) - set(TABLES)
    if unknown:
        raise ValueError(f"there is no table [{min(unknown)}]; it has [training], [held_out]")
    check_table("", content, dict.fromkeys(TABLES, TABLE))
    runs = {}
    for name in TABLES:
        table = dict(content.get(name, {}))
        draw_options = {key: table.pop(key) for key in ("draws", "seed") if key in table}
        for address, entries in table.items():
            if case is not None and isinstance(entries, list) and any(map(is_quantity, entries)):
                value_at(case, address)  # says what is wrong with the address
                entries = in_si(entries, unit_at(case, address), f"{name}.{address}")
                table[address] = entries
            check_entry(f"{name}.{address}", entries, VALUES)
        runs[name] = _table_runs(table, draw_options, name)
    return LoadCases(**runs)


def _table_runs(table, draw_options, where: str) -> tuple[AddressValues, ...]:
    """Runs of a table: the full grid of its lists, or draws from its ranges."""
    check_table(where, draw_options, {"draws": COUNT, "seed": COUNT})
    count = draw_options.get("draws", math.prod(map(len, table.values())))
    if count > MAX_LOAD_CASES:
        raise ValueError(f"{where} has {count:.3g} runs, more than {MAX_LOAD_CASES}: take fewer")
    if "draws" not in draw_options:
        if draw_options:
            raise ValueError(f"{where}.seed is for drawing: say how many with draws = 12")
        return full_grid(table) if table else ()
    if not table:
        raise ValueError(f'{where}.draws needs ranges, such as "loads.0.mass" = [0.2, 0.5]')
    for address, entries in table.items():
        if len(entries) != 2:
            raise ValueError(
                f"{where}.{address} must be a range, low and high, to draw from; it has"
                f" {counted(len(entries), 'entry', 'entries')}"
            )
    try:
        return latin_hypercube(table, draw_options["draws"], draw_options.get("seed", 0))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def run_case(case: Case, run: AddressValues) -> Case:
    """The case of a run, with the seed of a random profile, say, as well as numbers.

    Raises ValueError if it ends before its loads have left the beam, and for a count that is not
    whole.
    """
    changed = replace(case, {a: v for a, v in run.items() if not _is_count(case, a)})
    counts = {address: value for address, value in run.items() if _is_count(case, address)}
    for address, value in counts.items():
        if value != round(value):
            raise ValueError(f"{address} takes a whole number, not {value:g}")
    if counts:
        changed = with_settings(changed, {a: round(value) for a, value in counts.items()})
    last = crossing_times(changed)[:, 1].max(initial=0.0)
    duration = float(concrete(changed.run.duration))
    if last < NEVER and last > duration:
        raise ValueError(
            f"run.duration is {duration:g} s, but with {_describe(run)} the last load leaves only"
            f" at {last:.4g} s: simulate longer"
        )
    return changed


def run_cases(case: Case, runs: Sequence[AddressValues]) -> list[Case]:
    """The cases of some runs, alike in structure: see `run_case`.

    Where a count differs, as the seed of a profile, profiles are sums of given waves.

    Raises ValueError as `run_case`, and for a count that changes the structure.
    """
    cases = [run_case(case, run) for run in runs]
    counts = dict.fromkeys(a for run in runs for a in run if _is_count(case, a))
    if not counts:
        return cases
    if case.profile is not None:
        cases = [dataclasses.replace(own, profile=own.profile.by_numbers()) for own in cases]
    shapes = {str(jax.tree.map(np.shape, own)) for own in cases}
    if len(shapes) > 1:
        raise ValueError(
            f"runs that differ in {', '.join(counts)} cannot be simulated together, as their cases"
            " have different structures: tune for one value of it"
        )
    return cases


def _is_count(case: Case, address: str) -> bool:
    """Whether the entry of a case at an address is a whole number such as a seed."""
    name = address.rpartition(".")[2]
    return name in COUNTS and address.startswith(("profile.", "run.", "loads."))


def _describe(run: AddressValues) -> str:
    return ", ".join(f"{address} = {value:g}" for address, value in run.items())


def value_columns(runs: Sequence[AddressValues]) -> dict[str, np.ndarray]:
    """Values of some runs by address (run,), NaN where a run has the value of the case."""
    names = dict.fromkeys(address for run in runs for address in run)
    return {name: np.array([run.get(name, np.nan) for run in runs]) for name in names}


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
