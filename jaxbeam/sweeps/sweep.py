"""Many cases at once: any addresses, over grids or paired lists of values."""

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
from jaxbeam.simulation.integration_plan import TOLERANCE, sample_times
from jaxbeam.simulation.record import sensor_labels
from jaxbeam.sweeps import cluster, store as sweep_store
from jaxbeam.sweeps.batches import Batches
from jaxbeam.sweeps.blocks import Runner
from jaxbeam.sweeps.specification import SweepSpecification, sweep_specification

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
    """Simulate a case for many values of the numbers at some addresses.

    `over` gives each address a list of values (SI units): all combinations, with a dimension for
    each address, or with `paired` the first of each, the second of each, and so on along `run`.
    The dataset holds `peak_deflection` (..., sensor) in m with its time, the lowest contact force
    and the first time at which a load would have to pull (..., load), and `failed`: a run whose
    result is not finite is marked there, holds NaN, and touches no other. With a controller,
    `controller_failures` counts the steps at which it found no solution. With `histories`, also
    `deflection` (..., time, sensor) at the run's sample rate.

    Runs are computed in blocks on all cores, compiled once, with time steps as long as errors of
    peaks below `tolerance` (relative) allow. Errors are measured on some of the runs, drawn at
    random, where a sixth of that is the most; `error_estimate` is the largest seen. Others may err
    ten times as much, and more, near critical speeds of heavy masses. In `precision` "single"
    rigs and propagators are still made in double, but runs are integrated in half the bits, which
    is faster where arithmetic is what costs, most of all on a GPU. Results are float32 then; what
    rounding does to peaks, a few parts in a million, is measured and part of `error_estimate`.

    With a `store` every block is kept in a zarr store as soon as it is done; with `resume` a killed
    sweep continues from there, to bit-identical results. With a `client` of Dask
    (`distributed.Client`) the blocks are computed by its workers, each of which writes its own to
    the store; the folder of the store must be one that all of them see.

    Raises ValueError for an unknown address, faulty values, a case without sensors, or a controller
    in single precision;
    FileExistsError if the store exists and neither `resume` nor `overwrite` is set; OSError if it
    cannot be written; RuntimeError if no time step meets the tolerance or workers keep dying.
    """
    if client is not None and store is None:
        raise ValueError("workers write their blocks to a store; name one")
    specification = sweep_specification(case, over, paired, histories, tolerance, precision)
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
            block_store = sweep_store.MemoryStore(runner.block_count)
        else:
            step_sizes_and_error = np.append(steps, error)
            content = specification.to_dict()
            block_store = sweep_store.create_store(
                path, fingerprint, content, runner.block_count, step_sizes_and_error, overwrite
            )
    missing = block_store.missing()
    # The first block is always computed here: the arrays of the store are made for it.
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
    """A bar that counts runs, those that are done already among them."""
    count = int(np.sum(runner.batches.run_index >= 0))
    left = sum(runner.run_count(block) for block in missing)
    return tqdm(total=count, initial=count - left, unit="run", disable=not visible, file=sys.stderr)


def _compute(
    runner: Runner, blocks: list[int], steps, block_store: sweep_store.BlockStore
) -> Iterator[int]:
    """Compute blocks on all cores and keep them, giving the number of each that is done."""
    results = runner.pool.map(lambda block: (block, runner.compute_block(block, steps)), blocks)
    # Closed early, by an error or the keyboard, blocks not yet begun are called off.
    with closing(results):  # type: ignore[type-var]
        for block, result in results:
            block_store.write(block, result)
            yield block


_VARIABLES = {
    "peak_deflection": ("m", "largest absolute deflection", ("sensor",)),
    "peak_time": ("s", "time of the largest absolute deflection", ("sensor",)),
    "lowest_contact_force": ("N", "smallest contact force", ("load",)),
    "contact_lost_time": ("s", "first time at which the load would have to pull", ("load",)),
    "controller_failures": ("1", "steps at which the controller found no solution", ()),
    "deflection": ("m", "deflection", ("time", "sensor")),
}


def _to_dataset(
    specification: SweepSpecification, batches: Batches, results: dict[str, np.ndarray]
) -> "xarray.Dataset":
    """Results of all tasks as a dataset labelled by address."""
    import xarray

    case, dims, shape = specification.case, specification.dims, specification.shape
    mask = batches.run_index >= 0
    flat = {}
    for name, values in results.items():
        values = values[: batches.run_index.shape[0]][mask]
        flat[name] = np.empty_like(values)
        flat[name][batches.run_index[mask]] = values
    peaks = flat["peak_deflection"]
    failed = ~np.all(np.isfinite(peaks), axis=1)
    variables: dict[str, Any] = {
        "failed": (dims, failed.reshape(shape), {"long_name": "whether the run failed"})
    }
    for name, values in flat.items():
        unit, words, dims_of_variable = _VARIABLES[name]
        values = np.where(failed.reshape(-1, *(1,) * (values.ndim - 1)), np.nan, values)
        attributes = {"units": unit, "long_name": words}
        variables[name] = (
            (*dims, *dims_of_variable),
            values.reshape(*shape, *values.shape[1:]),
            attributes,
        )
    coordinates: dict[str, Any] = {
        address: ("run" if specification.paired else address, values)
        for address, values in specification.axes.items()
    }
    coordinates["sensor"] = ("sensor", sensor_labels(case))
    if "deflection" in flat:
        coordinates["time"] = ("time", np.asarray(sample_times(case)), {"units": "s"})
    attributes = {
        "title": case.title,
        "case": json.dumps(specification.case_dict),
    }
    return xarray.Dataset(variables, coordinates, attributes)
