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
from jaxbeam.sweeps.batches import Tasks
from jaxbeam.sweeps.blocks import Work
from jaxbeam.sweeps.specification import Order, make_order

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
    order = make_order(case, over, paired, histories, tolerance, precision)
    path = None if store is None else Path(store).absolute()
    mark = order.fingerprint()
    state = "new" if path is None else sweep_store.prepare(path, mark, resume, overwrite)
    if path is not None and state == "complete":
        return sweep_store.read(path)

    work = order.work()
    if path is not None and state == "resume":
        keeper = sweep_store.Disk(path)
        steps, error = keeper.steps[:-1], float(keeper.steps[-1])
    else:
        steps, error = work.steps()
        if path is None:
            keeper = sweep_store.Memory(work.blocks)
        else:
            kept = np.append(steps, error)
            content = order.to_dict()
            keeper = sweep_store.create(path, mark, content, work.blocks, kept, overwrite)
    todo = keeper.missing()
    # The first block is always computed here: the arrays of the store are made for it.
    here = todo if client is None else todo[:1]
    with _progress(work, todo, progress) as bar:
        for block in _compute(work, here, steps, keeper):
            bar.update(work.runs(block))
        if client is not None:
            for block in cluster.compute(client, mark, path, todo[1:]):
                bar.update(work.runs(block))
    dataset = _label(order, work.tasks, keeper.collect())
    dataset.attrs |= {"error_estimate": error, sweep_store.FINGERPRINT: mark}
    keeper.finish(dataset)
    return dataset


def _progress(work: Work, todo: list[int], shown: bool) -> tqdm:
    """A bar that counts runs, those that are done already among them."""
    count = int(np.sum(work.tasks.index >= 0))
    left = sum(work.runs(block) for block in todo)
    return tqdm(total=count, initial=count - left, unit="run", disable=not shown, file=sys.stderr)


def _compute(work: Work, blocks: list[int], steps, keeper: sweep_store.Keeper) -> Iterator[int]:
    """Compute blocks on all cores and keep them, giving the number of each that is done."""
    results = work.pool.map(lambda block: (block, work.block(block, steps)), blocks)
    # Closed early, by an error or the keyboard, blocks not yet begun are called off.
    with closing(results):  # type: ignore[type-var]
        for block, result in results:
            keeper.write(block, result)
            yield block


_UNITS = {
    "peak_deflection": ("m", "largest absolute deflection", ("sensor",)),
    "peak_time": ("s", "time of the largest absolute deflection", ("sensor",)),
    "lowest_contact_force": ("N", "smallest contact force", ("load",)),
    "contact_lost_time": ("s", "first time at which the load would have to pull", ("load",)),
    "controller_failures": ("1", "steps at which the controller found no solution", ()),
    "deflection": ("m", "deflection", ("time", "sensor")),
}


def _label(order: Order, tasks: Tasks, results: dict[str, np.ndarray]) -> "xarray.Dataset":
    """Results of all tasks as a dataset labelled by address."""
    import xarray

    case, dims, shape = order.case, order.dims, order.shape
    real = tasks.index >= 0
    flat = {}
    for name, values in results.items():
        values = values[: tasks.index.shape[0]][real]
        flat[name] = np.empty_like(values)
        flat[name][tasks.index[real]] = values
    peaks = flat["peak_deflection"]
    failed = ~np.all(np.isfinite(peaks), axis=1)
    variables: dict[str, Any] = {
        "failed": (dims, failed.reshape(shape), {"long_name": "whether the run failed"})
    }
    for name, values in flat.items():
        unit, words, own = _UNITS[name]
        values = np.where(failed.reshape(-1, *(1,) * (values.ndim - 1)), np.nan, values)
        attributes = {"units": unit, "long_name": words}
        variables[name] = ((*dims, *own), values.reshape(*shape, *values.shape[1:]), attributes)
    coordinates: dict[str, Any] = {
        address: ("run" if order.paired else address, values)
        for address, values in order.axes.items()
    }
    coordinates["sensor"] = ("sensor", sensor_labels(case))
    if "deflection" in flat:
        coordinates["time"] = ("time", np.asarray(sample_times(case)), {"units": "s"})
    attributes = {
        "title": case.title,
        "case": json.dumps(order.words),
    }
    return xarray.Dataset(variables, coordinates, attributes)
