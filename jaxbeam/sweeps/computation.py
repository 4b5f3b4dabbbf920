"""Computation of a sweep of numbers, block by block, into a store and a labelled dataset."""

import collections
import importlib
import itertools
import json
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, address_words, unit_at
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.integrator import native_peaks
from jaxbeam.runtime.arrays import collapse
from jaxbeam.runtime.memory import size_text
from jaxbeam.runtime.printer import labelled_dataset
from jaxbeam.runtime.progress import ProgressBar
from jaxbeam.simulation.integration_plan import sample_times
from jaxbeam.simulation.labels import SWEEP_VARIABLES, sensor_coordinates
from jaxbeam.sweeps import cluster, store as sweep_store
from jaxbeam.sweeps.batches import PROFILE_NUMBER, Batches
from jaxbeam.sweeps.quality import WorstRun, estimated_errors, is_corrected
from jaxbeam.sweeps.specification import AnyRunner, SweepSpecification
from jaxbeam.sweeps.store import BlockStore, MemoryStore

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX


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
    dataset = _to_dataset(specification, runner.batches, block_store.collect(runner.block_count))
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
    specification: SweepSpecification, batches: Batches, results: dict[str, np.ndarray]
) -> "xarray.Dataset":
    """Dataset of the results of all batches, with a dimension for each address, or `run`."""
    case, dims, shape = specification.case, specification.dims, specification.shape
    index = batches.run_index.reshape(-1)
    rows = np.empty(specification.count, int)
    rows[index[index >= 0]] = np.flatnonzero(index >= 0)
    flat = {
        name: collapse(values, 0, 2)[rows]  # padding is at the end, or left out
        for name, values in results.items()
    }
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
