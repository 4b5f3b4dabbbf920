"""Sweep of a case over the values at any addresses, in a grid or paired, as an xarray dataset."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from jaxbeam.case.case import Case
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.simulation.integration_plan import TOLERANCE, sample_times
from jaxbeam.simulation.result_variables import SWEEP_VARIABLES, sensor_coordinates
from jaxbeam.sweeps import cluster, store as sweep_store
from jaxbeam.sweeps.batches import Batches
from jaxbeam.sweeps.block_store import BlockStore, MemoryStore
from jaxbeam.sweeps.blocks import Runner
from jaxbeam.sweeps.specification import SweepSpecification, sweep_specification
from jaxbeam.sweeps.truncation import warn_of_truncation

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX


def sweep(
    case: Case,
    over: dict[str, Any],
    *,
    paired: bool = False,
    histories: bool = False,
    store: str | os.PathLike | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    tolerance: float = TOLERANCE,
    precision: str = "double",
    client: Any = None,
) -> "xarray.Dataset":
    """Simulate a case for many values of the numbers at given addresses.

    `over` maps each address to a list of values (SI units): all combinations, with a dimension per
    address, or with `paired` the first of each, the second, and so on along `run`. The dataset has
    `peak_deflection` (..., sensor) in m and its time in s (for sensors of other quantities
    `peak_acceleration` and so on, each NaN at the others), the smallest contact force in N and the
    time of its first negative value in s (..., load), and `failed`, which marks runs that are not
    finite; their results are NaN. With a controller, `controller_failures` counts its steps without
    a solution. With `histories`, `deflection` (..., time, sensor) in m is at the run's sample rate.

    Runs are computed in blocks on all cores, compiled once, with the longest time steps whose
    relative errors of peaks are below `tolerance`. Peaks are those of the modes: curvatures,
    strains and moments are low under a load, as a TruncationWarning says, and shear forces are
    refused; the records of `simulate` have both with static correction. Errors are measured on a
    stratified random sample of the runs, where they are at most a sixth of the tolerance;
    `error_estimate` is the largest of these. Other runs may have errors ten times as large, and
    more near critical speeds of heavy masses. In `precision` "single" models and propagators are
    made in float64 and runs are integrated in float32, which is faster where arithmetic dominates,
    as on a GPU. Results are then float32, and the rounding error of peaks, a few parts in a
    million, is measured and included in `error_estimate`.

    With a `store` each block is written to a zarr store when it is done; with `resume` an
    interrupted sweep continues from there, with bit-identical results. With a `client` of Dask
    (`distributed.Client`) its workers compute the blocks and write them to the store, in a folder
    that they share.

    Raises ValueError for an unknown address, invalid values, a case without sensors or with one of
    shear, a controller in single precision, or a client without a store; FileExistsError if the
    store exists, without `resume` or `overwrite`; OSError if it cannot be written; RuntimeError if
    no time step meets the tolerance or workers keep dying.
    """
    if client is not None and store is None:
        raise ValueError("workers write their blocks to a store; name one")
    specification = sweep_specification(case, over, paired, histories, tolerance, precision)
    warn_of_truncation(case)
    path = None if store is None else Path(store).absolute()
    fingerprint = specification.fingerprint()
    state = (
        "new" if path is None else sweep_store.resolve_action(path, fingerprint, resume, overwrite)
    )
    if path is not None and state == "complete":
        return sweep_store.read_dataset(path)

    runner = specification.runner()
    if path is not None and state == "resume":
        block_store = sweep_store.ZarrStore(path)
        steps, error = block_store.steps[:-1], float(block_store.steps[-1])
    else:
        steps, error = runner.choose_step_sizes()
        if path is None:
            block_store = MemoryStore(runner.block_count)
        else:
            step_sizes_and_error = np.append(steps, error)
            content = specification.to_dict()
            block_store = sweep_store.create_store(
                path, fingerprint, content, runner.block_count, step_sizes_and_error, overwrite
            )
    missing = block_store.missing()
    # The first block is always computed here, and creates the arrays of the store.
    computed_locally = missing if client is None else missing[:1]
    with _progress(runner, missing, progress) as progress_bar:
        for block in _compute(runner, computed_locally, steps, block_store):
            progress_bar.update(runner.run_count(block))
        if client is not None:
            for block in cluster.compute_blocks(client, fingerprint, path, missing[1:]):
                progress_bar.update(runner.run_count(block))
    dataset = _to_dataset(specification, runner.batches, block_store.collect())
    dataset.attrs |= {"error_estimate": error, sweep_store.FINGERPRINT_ATTRIBUTE: fingerprint}
    block_store.finish(dataset)
    return dataset


def _progress(runner: Runner, missing: list[int], visible: bool) -> tqdm:
    """Progress bar of the runs; those of stored blocks count as done."""
    count = int(np.sum(runner.batches.run_index >= 0))
    remaining = sum(runner.run_count(block) for block in missing)
    return tqdm(
        total=count, initial=count - remaining, unit="run", disable=not visible, file=sys.stderr
    )


def _compute(runner: Runner, blocks: list[int], steps, block_store: BlockStore) -> Iterator[int]:
    """Numbers of blocks as they are computed, on all cores, and stored."""
    results = runner.pool.map(lambda block: (block, runner.compute_block(block, steps)), blocks)
    # An error or an interrupt closes the iterator, which cancels blocks not yet started.
    with closing(results):  # type: ignore[type-var]
        for block, result in results:
            block_store.write(block, result)
            yield block


def _to_dataset(
    specification: SweepSpecification, batches: Batches, results: dict[str, np.ndarray]
) -> "xarray.Dataset":
    """Results of all batches as a dataset with a dimension per address, or `run`."""
    import xarray

    case, dims, shape = specification.case, specification.dims, specification.shape
    mask = batches.run_index >= 0
    flat, variables = {}, {}
    for name, values in results.items():
        values = values[: batches.run_index.shape[0]][mask]
        flat[name] = np.empty_like(values)
        flat[name][batches.run_index[mask]] = values
    peaks = flat["peak_deflection"]
    failed = ~np.all(np.isfinite(peaks), axis=1)
    variables["failed"] = (dims, failed.reshape(shape), {"long_name": "whether the run failed"})
    for name, values in flat.items():
        own_dims, unit, words = SWEEP_VARIABLES[name]
        values = np.where(failed.reshape(-1, *(1,) * (values.ndim - 1)), np.nan, values)
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
        address: ("run" if specification.paired else address, values)
        for address, values in specification.axes.items()
    }
    coordinates |= sensor_coordinates(case)
    if "deflection" in flat:
        coordinates["time"] = ("time", np.asarray(sample_times(case)), {"units": "s"})
    attributes = {
        "title": case.title,
        "case": json.dumps(specification.case_dict),
    }
    return xarray.Dataset(variables, coordinates, attributes)


def _peak_variables(case: Case, dims: tuple[str, ...], peaks) -> dict[str, tuple]:
    """Peaks (..., sensor) as a variable for each quantity, NaN at sensors of others."""
    quantities = np.array([sensor.quantity for sensor in case.sensors])
    variables = {}
    for sensor in case.sensors:
        entry, own = QUANTITIES[sensor.quantity], quantities == sensor.quantity
        words = f"largest absolute {sensor.quantity}"
        words += f", sum of {case.beam.modes} modes" if entry.bends else ""
        values = np.where(own, peaks, np.nan).astype(peaks.dtype)
        attributes = {"units": entry.unit, "long_name": words}
        variables[f"peak_{sensor.quantity}"] = ((*dims, "sensor"), values, attributes)
    return variables
