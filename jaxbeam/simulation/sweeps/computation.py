"""Computation of a sweep of numbers, block by block, into a store and a labelled dataset.

And its warnings: failed runs, strokes, and errors of its peaks from truncated modes.
"""

import collections
import importlib
import itertools
import json
import os
import sys
import threading
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Shaped

from jaxbeam.case.case import Case, address_words, concrete_case, replace, structure_of, unit_at
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.model.deflection_lines import unchecked_influence_line
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling, modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.static_correction import is_supported, modal_influence_line
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.memory import remembered, size_text
from jaxbeam.runtime.printer import labelled_dataset
from jaxbeam.runtime.progress import ProgressBar
from jaxbeam.simulation.errors import truncation_changes
from jaxbeam.simulation.integration_plan import sample_times
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.integrator.step_size import (
    check_step_count,
    longest_stable_step,
    max_concurrent_loads,
    trial_run,
    without_later_vibration,
)
from jaxbeam.simulation.section_forces import motion_at, motion_of_forces
from jaxbeam.simulation.sweeps import cluster, store as sweep_store
from jaxbeam.simulation.sweeps.batches import PROFILE_NUMBER
from jaxbeam.simulation.sweeps.specification import AnyRunner, SweepSpecification, is_corrected
from jaxbeam.simulation.sweeps.store import BlockStore, MemoryStore
from jaxbeam.simulation.views import SWEEP_VARIABLES, sensor_coordinates

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX


SAMPLES = 200  # at least, of the run from which errors of corrected quantities are estimated
ROUNDING = 1e-12  # of L^3 / E I, below which the deflection of a held point under a force is zero


class FailedRunsWarning(UserWarning):
    """Warning of runs of a sweep whose peaks are not finite."""


def failure_sentence(dataset: "xarray.Dataset") -> str:
    """Sentence on the failed runs of the dataset of a sweep, and the first of them; "" without any.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingForce(force=5.0, speed=2.0)]
    ... )
    >>> runs = jb.sweep(case, {"loads.0.speed": [1.0, 2.0]}, progress=False)
    >>> print(runs.failed_runs, failure_sentence(runs) == "")
    0 True
    """
    failed = dataset["failed"]
    count, of_all = int(failed.values.sum()), failed.values.size
    if not count:
        return ""
    place = dict(zip(failed.dims, np.argwhere(failed.values)[0], strict=True))
    numbers = []
    for name, values in dataset.coords.items():
        if "." in str(name) and set(values.dims) <= set(failed.dims):
            value = values.values[tuple(place[dim] for dim in values.dims)]
            numbers.append(f"{name} = {value if isinstance(value, str) else f'{value:.6g}'}")
    which = f"all {of_all} runs" if count == of_all else f"{count} of {of_all} runs"
    first = f", the first at {', '.join(numbers)}" if numbers else ""
    return (
        f"{which} failed{first}: their motion is not finite, and their results are NaN; check"
        " controllers, stiffnesses, masses and damping there"
    )


def warn_of_failures(dataset: "xarray.Dataset") -> None:
    """Warn of failed runs of the dataset of a sweep."""
    sentence = failure_sentence(dataset)
    if sentence:
        warnings.warn(sentence, FailedRunsWarning, stacklevel=3)


class StrokeWarning(UserWarning):
    """Warning of absorbers whose strokes exceed the largest allowed in runs of a sweep."""


def warn_of_strokes(case: Case, dataset: "xarray.Dataset") -> None:
    """Warn of absorbers of a case whose strokes exceed `max_stroke` in runs of its sweep."""
    for i, absorber in enumerate(case.absorbers):
        swept = f"absorbers.{i}.max_stroke", "absorbers.*.max_stroke"
        name = next((name for name in swept if name in dataset.coords), None)
        if name is None and absorber.max_stroke is None:
            continue
        strokes = dataset["peak_stroke"].isel(absorber=i)
        limit = float(concrete(absorber.max_stroke)) if name is None else dataset[name]
        above = (strokes > limit).values
        if above.any():
            warnings.warn(
                f"the stroke of absorber {i} exceeds its max_stroke in {above.sum()} of"
                f" {above.size} runs; the largest stroke is {strokes.max().item():.4g} m",
                StrokeWarning,
                stacklevel=3,
            )


class TruncationWarning(UserWarning):
    """Warning of a quantity whose peaks have an error from truncated modes."""


def warn_of_truncation(case: Case) -> None:
    """Warn of sensors of curvature, strain or moment whose peaks cannot be corrected."""
    uncorrected = [i for i, sensor in enumerate(case.sensors) if sensor.bends]
    if not uncorrected or is_corrected(case):
        return
    names = ", ".join(f"sensors.{i} ({case.sensors[i].quantity})" for i in uncorrected)
    reason = "wheels run on a rail" if case.on_rail else "the beam can move as a rigid body"
    warnings.warn(
        f"peaks of {names} are sums of {case.beam.modes} modes and not statically corrected, as"
        f" {reason}: keep more modes (beam.modes), and compare",
        TruncationWarning,
        stacklevel=3,
    )


def static_missed_fractions(case: Case) -> dict[str, float]:
    """Largest fraction of static deflections and rotations that the modes miss, by quantity.

    A deflection is taken under a load at the sensor, but at rigid supports; a rotation, which may
    be zero there, under a load at a quarter of the span.
    """
    return dict(_static_missed_fractions(structure_of(concrete_case(case))))


@remembered
def _static_missed_fractions(structure: Case) -> dict[str, float]:
    static = [
        sensor
        for sensor in structure.sensors
        if not (QUANTITIES[sensor.quantity].bends or QUANTITIES[sensor.quantity].time_derivative)
    ]
    layout, fractions = mesh_layout(structure), {}
    if not static or not is_supported(structure, layout):
        return fractions
    for quantity in dict.fromkeys(sensor.quantity for sensor in static):
        derivative = QUANTITIES[quantity].x_derivative
        x = np.stack([sensor.position for sensor in static if sensor.quantity == quantity])
        at = x if derivative == 0 else np.full(x.size, structure.beam.length / 4)
        exact, of_modes = (
            np.diagonal(line(structure, layout, x, at, derivative))
            for line in (unchecked_influence_line, modal_influence_line)
        )
        beam = structure.beam
        compliance = beam.length ** (3 - derivative) / beam.bending_stiffness
        moves = np.abs(exact) > ROUNDING * concrete(compliance)
        missing = np.where(moves, exact - of_modes, 0.0)
        fractions[quantity] = float(np.max(np.abs(missing / np.where(moves, exact, 1.0))))
    return fractions


class WorstRun(NamedTuple):
    """Numbers of the run with the largest peak of a quantity, and the peaks of all its sensors."""

    numbers: dict[str, float]
    peaks: Float[np.ndarray, " sensor"]


def estimated_errors(case: Case, worst: dict[str, WorstRun]) -> dict[str, float]:
    """Truncation errors of peaks relative to the largest, by quantity, where they are estimated.

    `worst` is the run with the largest peak of each quantity. Deflections and rotations have their
    static error; errors of others are estimated from the worst run (see `truncation_changes`), if
    it has no controller.
    """
    errors, found_before = static_missed_fractions(case), {}
    quantities = [sensor.quantity for sensor in case.sensors]
    if case.controller is not None:
        return errors
    for quantity, run in worst.items():
        if quantity in errors:
            continue
        own = np.array([one == quantity for one in quantities])
        key = tuple(run.numbers.items())
        if key not in found_before:
            found_before[key] = _changes_in_run(concrete_case(replace(case, run.numbers)), errors)
        if found_before[key] is None:
            continue
        peaks = run.peaks[own]
        found = np.where(peaks == 0, 0.0, found_before[key][own] / np.where(peaks == 0, 1, peaks))
        if np.isfinite(found).any():
            errors[quantity] = float(np.nanmax(found))
    return errors


def _changes_in_run(case: Case, estimated: Collection[str]) -> Float[np.ndarray, " sensor"] | None:
    """Truncation errors at the sensors; NaN at sensors of quantities `estimated` before.

    None where no step is found.
    """
    asked = np.array([sensor.quantity not in estimated for sensor in case.sensors])
    sensors = tuple(
        sensor for sensor, is_asked in zip(case.sensors, asked, strict=True) if is_asked
    )
    found = _truncation_of(eqx.tree_at(lambda c: c.sensors, case, sensors))
    if found is None:
        return None
    changes = np.full(asked.size, np.nan)
    changes[asked] = found
    return changes


def _truncation_of(case: Case) -> Float[Array, " sensor"] | None:
    """Truncation errors at all sensors of a case in one run; None where no step is found."""
    loads, model = load_set(case), modal_model(case, mesh_layout(case), has_coupling(case))
    case = without_later_vibration(case, model, loads)
    duration = float(case.run.duration)
    found = motion_of_forces(case, model, loads, np.linspace(0.0, duration, SAMPLES))
    if found is not None:
        return truncation_changes(case, model.modes, found)
    if model.modes.has_repeated:
        model = modal_model(case, model.modes.layout)
    # The longest stable step: an estimate needs no search for the step of an error.
    step = min(duration / SAMPLES, float(longest_stable_step(case, model, loads)))
    try:
        check_step_count(duration / step, step)
    except RuntimeError:
        return None
    most = max_concurrent_loads(np.asarray(loads.entry_exit_times()))
    times, states = trial_run(case, model, loads, most, step)
    motion, _ = motion_at(case, model, loads, times, states)
    return truncation_changes(case, model.modes, motion)


def compute_sweep(
    specification: SweepSpecification,
    path: Path | None,
    state: str,
    client: Any,
    progress_bar: ProgressBar,
    estimates: bool = True,
) -> "xarray.Dataset":
    """Dataset of a sweep, with `estimates` of its truncation errors.

    Blocks are written to the store at a path, unless it is None.

    `state` of the store is "new" or "resume" (see `Writing`); blocks of a resumed store are not
    computed again, and count in the progress bar as done before. With a `client` of Dask its
    workers compute all blocks but the first.
    """
    fingerprint = specification.fingerprint()
    runner, steps, error, block_store = _begun(specification, path, state, progress_bar)
    missing = block_store.missing(range(runner.block_count))
    remaining = sum(runner.run_count(block) for block in missing)
    progress_bar.skip(specification.count - remaining)
    if missing:
        within = size_text(specification.block_bytes)
        progress_bar.set_postfix_str(f"blocks of {runner.run_count(0)}, each within {within}")
    # The first block is always computed here: a fault of the case is found before it is sent.
    computed_locally = missing if client is None else missing[:1]
    for block in _compute(runner, computed_locally, steps, block_store):
        progress_bar.update(runner.run_count(block))
    if client is not None:
        for block in cluster.compute_blocks(client, fingerprint, path, missing[1:]):
            progress_bar.update(runner.run_count(block))
    flat = block_store.collect(runner.block_count, runner.batches.run_index)
    dataset = _to_dataset(specification, flat)
    dataset.attrs |= {"error_estimate": error, sweep_store.FINGERPRINT_ATTRIBUTE: fingerprint}
    if estimates:
        worst = worst_runs(specification, dataset)
        for quantity, truncation in estimated_errors(specification.case, worst).items():
            dataset[f"peak_{quantity}"].attrs["truncation_error"] = truncation
    block_store.finish(dataset)
    return dataset


def peaks_in_memory(specification: SweepSpecification) -> "xarray.Dataset":
    """Dataset of a sweep computed in memory, without a store or estimated truncation errors."""
    with ProgressBar(specification.count, "run", shown=False) as progress_bar:
        return compute_sweep(specification, None, "new", None, progress_bar, estimates=False)


def _begun(
    specification: SweepSpecification, path: Path | None, state: str, progress_bar: ProgressBar
) -> "tuple[AnyRunner, Float[np.ndarray, ' path'], float, BlockStore]":
    """Runner, step sizes (s), estimated error and store of a sweep, new or resumed."""
    if path is not None and state == "resume":
        stored = sweep_store.ZarrStore(path)
        runner = specification.resumed_runner(stored.specification())
        return runner, stored.steps[:-1], float(stored.steps[-1]), stored
    progress_bar.set_description("compiling")
    if "xarray" not in sys.modules:
        # Compilers leave a core free, on which to import what the dataset needs.
        threading.Thread(target=importlib.import_module, args=["xarray"]).start()
    runner, native = _new_runner(specification)
    steps, error = runner.choose_step_sizes()
    progress_bar.set_description(None)
    if path is None:
        return runner, steps, error, MemoryStore()
    content, given = specification.to_dict() | {"native": native}, np.append(steps, error)
    new = path, specification.fingerprint(), content, given
    return runner, steps, error, sweep_store.create_store(*new)


def _new_runner(specification: SweepSpecification) -> tuple[AnyRunner, bool]:
    """Runner of a new sweep, and whether it takes its steps in C.

    The C integrator is compiled while programs are traced, which saves a third of a second. The
    steps are taken without it if that fails.
    """
    if specification.uses_c():
        with native_peaks.LIBRARY.built_meanwhile():
            runner = specification.runner(native=True)
        if native_peaks.available():
            return runner, True
    return specification.runner(native=False), False


def _compute(runner: AnyRunner, blocks: list[int], steps, block_store: BlockStore) -> Iterator[int]:
    """Yield the number of each block when it is stored; blocks are computed on all cores."""
    # A resumed sweep has no trial results. A new stored sweep does not use its own either, so that
    # both are bit-identical.
    trials = runner.trials if isinstance(block_store, MemoryStore) else None
    compute = runner.block_function(steps, trials)
    waiting, left = collections.deque(), iter(blocks)
    try:
        # No more than one result waits to be written for each that is computed.
        for block in itertools.islice(left, 2 * (os.cpu_count() or 1)):
            waiting.append((block, runner.pool.submit(compute, block)))
        while waiting:
            block, future = waiting.popleft()
            block_store.write(block, future.result())
            for following in itertools.islice(left, 1):
                waiting.append((following, runner.pool.submit(compute, following)))
            yield block
    finally:  # an error or an interrupt cancels blocks not yet started
        for _, future in waiting:
            future.cancel()


def _to_dataset(
    specification: SweepSpecification, flat: dict[str, Shaped[np.ndarray, "run ..."]]
) -> "xarray.Dataset":
    """Dataset of the results of all runs, with a dimension for each address, or `run`."""
    case, dims, shape = specification.case, specification.dims, specification.shape
    failed = ~np.all(np.isfinite(flat["peak_deflection"]), axis=1)
    if case.absorbers:  # which hold on to the beam
        of_wheels = [name for name in flat if SWEEP_VARIABLES[name][0] == ("load",)]
        flat |= {name: flat[name][:, : -len(case.absorbers)] for name in of_wheels}
        sensors = len(case.sensors)
        ends = sensors, sensors + len(case.absorbers)
        names = "peak_deflection", "peak_stroke", "peak_absorber_force"
        flat |= zip(names, np.split(flat["peak_deflection"], ends, axis=1), strict=True)
        flat["peak_time"] = flat["peak_time"][:, :sensors]
    variables: dict[str, Any] = {
        "failed": (dims, failed.reshape(shape), {"long_name": "whether the run failed"})
    }
    for name, values in flat.items():
        own_dims, unit, words = SWEEP_VARIABLES[name]
        values = values.astype(np.result_type(values, np.float32), copy=False)
        values[failed] = np.nan
        attributes = {"units": unit, "long_name": words}
        if name == "peak_deflection":
            variables |= _peak_variables(case, dims, values.reshape(*shape, values.shape[1]))
            continue
        variables[name] = (
            (*dims, *own_dims),
            values.reshape(*shape, *values.shape[1:]),
            attributes,
        )
    coordinates: dict[str, Any] = {
        address: (
            "run" if specification.paired else address,
            values,
            {"units": unit_at(case, address) or "1", "long_name": address_words(case, address)},
        )
        for address, values in specification.axes.items()
        if address != PROFILE_NUMBER
    }
    coordinates |= sensor_coordinates(case)
    if "deflection" in flat:
        coordinates["time"] = ("time", np.asarray(sample_times(case)), {"units": "s"})
    attributes = {
        "title": case.title,
        "case": json.dumps(specification.case_dict),
        "failed_runs": int(failed.sum()),
    }
    return labelled_dataset(variables, coordinates, attributes)


def worst_runs(specification: SweepSpecification, dataset) -> dict[str, WorstRun]:
    """Run with the largest peak of each quantity; quantities whose runs all failed are left out."""
    runs, worst = specification.runs(), {}
    quantities = [sensor.quantity for sensor in specification.case.sensors]
    peaks = {q: dataset[f"peak_{q}"].values.reshape(len(runs), -1) for q in set(quantities)}
    for quantity, values in peaks.items():
        if np.isfinite(values).any():
            row = np.nanargmax(values) // values.shape[1]
            numbers = dict(zip(specification.axes, map(float, runs[row]), strict=True))
            of_sensors = [peaks[name][row, i] for i, name in enumerate(quantities)]
            worst[quantity] = WorstRun(numbers, np.array(of_sensors, float))
    return worst


def _peak_variables(case: Case, dims: tuple[str, ...], peaks) -> dict[str, tuple]:
    """Dataset variable of the peaks (..., sensor) of each quantity, NaN at other sensors."""
    quantities = np.array([sensor.quantity for sensor in case.sensors])
    variables = {}
    corrected = any(sensor.bends for sensor in case.sensors) and is_corrected(case)
    for quantity in dict.fromkeys(quantities.tolist()):
        entry, own = QUANTITIES[quantity], quantities == quantity
        words = f"largest absolute {quantity}"
        if entry.bends:
            modes = f"sum of {case.beam.modes} modes"
            words += ", statically corrected" if corrected else f", {modes}"
        values = np.where(own, peaks, np.nan).astype(peaks.dtype)
        attributes = {"units": entry.unit, "long_name": words}
        variables[f"peak_{quantity}"] = ((*dims, "sensor"), values, attributes)
    return variables
