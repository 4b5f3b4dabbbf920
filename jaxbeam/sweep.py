"""Many cases at once: any addresses, over grids or paired lists of values."""

import hashlib
import importlib.metadata
import json
import os
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray
from tqdm import tqdm

from jaxbeam import sweep_store
from jaxbeam.blocks import RUNS, Work
from jaxbeam.case import Case, replace, value_at
from jaxbeam.casefile import case_to_dict
from jaxbeam.checks import check
from jaxbeam.lanes import LANES, Tasks, arrange
from jaxbeam.plan import TOLERANCE, sample_times
from jaxbeam.record import sensor_labels

# Whether these are right depends on each other: places, and entries of a list.
TOGETHER = re.compile(
    r"beam\.length|(supports|actuators|sensors)\.\d+\.(position|start|end)|.*\.\d+"
)

# What decides when a controller acts and its sensors are read.
CLOCK = re.compile(
    r"run\.(duration|sample_rate)|controller\.(period|delay|times\.\d+)"
    r"|sensors\.\d+\.(sampling_period|delay)"
)


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
) -> xarray.Dataset:
    """Simulate a case for many values of the numbers at some addresses.

    `over` gives each address a list of values (SI units): all combinations, with a dimension for
    each address, or with `paired` the first of each, the second of each, and so on along `run`.
    The dataset holds `peak_deflection` (..., sensor) in m with its time, the lowest contact force
    and the first time at which a load would have to pull (..., load), and `failed`: a run whose
    result is not finite is marked there, holds NaN, and touches no other. With a controller,
    `controller_failures` counts the steps at which it found no solution. With `histories`, also
    `deflection` (..., time, sensor) at the run's sample rate.

    Runs are computed in blocks on all cores, compiled once, each with the longest time step that
    keeps errors of peaks below `tolerance` (relative; `error_estimate` tells what was seen on runs
    drawn at random). With a `store` every block is kept in a zarr store as soon as it is done;
    with `resume` a killed sweep continues from there, to bit-identical results.

    Raises ValueError for an unknown address, faulty values, or a case without sensors;
    FileExistsError if the store exists and neither `resume` nor `overwrite` is set; RuntimeError if
    no time step meets the tolerance.
    """
    axes = _axes(case, over, paired, histories)
    runs = _runs(case, axes, paired)
    path = None if store is None else Path(store)
    mark = _fingerprint(case, axes, paired, histories, tolerance)
    state = "new" if path is None else sweep_store.prepare(path, mark, resume, overwrite)
    if path is not None and state == "complete":
        return sweep_store.read(path)

    alone = case.controller is not None and case.controller.knows_loads
    tasks = arrange(list(axes), runs, alone)
    work = Work(case, tasks, histories, tolerance)
    if path is not None and state == "resume":
        keeper = sweep_store.reopen(path)
        steps, error = keeper.steps[:-1], float(keeper.steps[-1])
    else:
        steps, error = work.steps()
        if path is None:
            keeper = sweep_store.Memory(work.blocks)
        else:
            kept = np.append(steps, error)
            keeper = sweep_store.create(path, mark, work.blocks, kept, overwrite)
    todo = keeper.missing()
    bar = tqdm(
        total=len(runs),
        initial=len(runs) - sum(work.runs(block) for block in todo),
        unit="run",
        disable=not progress,
        file=sys.stderr,
    )
    with ThreadPoolExecutor(os.cpu_count()) as pool, bar:
        results = pool.map(lambda block: (block, work.block(block, steps)), todo)
        # Closed early, by an error or the keyboard, blocks not yet begun are called off.
        with closing(results):  # type: ignore[type-var]
            for block, result in results:
                keeper.write(block, result)
                bar.update(work.runs(block))
    dataset = _label(case, axes, paired, tasks, keeper.collect())
    dataset.attrs |= {"error_estimate": error, sweep_store.FINGERPRINT: mark}
    keeper.finish(dataset)
    return dataset


def _axes(case: Case, over: dict[str, Any], paired: bool, histories: bool) -> dict[str, np.ndarray]:
    """The values of each address, as far as they can be checked one by one."""
    check(case)
    if not over:
        raise ValueError("give at least one address to sweep over, with a list of values")
    if not case.sensors:
        raise ValueError("the case has no sensors, and peaks are taken there; add one to `sensors`")
    axes = {}
    for address, given in over.items():
        if np.ndim(value_at(case, address)):
            raise ValueError(f"{address} is a list; sweep over one of its entries, {address}.0")
        try:
            values = np.atleast_1d(np.asarray(given, float))
        except (TypeError, ValueError):
            raise ValueError(f"{address} takes a list of numbers, not {given!r}") from None
        if values.ndim != 1 or values.size == 0:
            raise ValueError(f"{address} takes a list of values, not one of shape {values.shape}")
        if case.controller is not None and CLOCK.fullmatch(address):
            raise ValueError(
                f"{address} sets the clock of the run, which all runs with a controller share:"
                " make a sweep for each of its values"
            )
        if histories and address in ("run.duration", "run.sample_rate"):
            raise ValueError(
                f"histories of different length do not fit together: leave out {address}"
            )
        if not TOGETHER.fullmatch(address):
            # What is allowed is a range, from which zero may be left out.
            odd = values[~np.isfinite(values) | (values == 0)]
            for value in {values.min(), values.max(), *odd[:1]}:
                check(replace(case, {address: value}))
        axes[address] = values
    sizes = {address: values.size for address, values in axes.items()}
    if paired and len(set(sizes.values())) > 1:
        raise ValueError(f"paired values must be equally many, not {sizes}")
    return axes


def _runs(case: Case, axes: dict[str, np.ndarray], paired: bool) -> np.ndarray:
    """The values of every run (run, address), those that depend on each other checked."""
    columns = axes.values() if paired else np.meshgrid(*axes.values(), indexing="ij")
    runs = np.stack([column.ravel() for column in columns], axis=-1)
    names = list(axes)
    joint = [i for i, name in enumerate(names) if TOGETHER.fullmatch(name)]
    for row in np.unique(runs[:, joint], axis=0):
        check(replace(case, dict(zip([names[i] for i in joint], row, strict=True))))
    return runs


def _fingerprint(case, axes, paired, histories, tolerance) -> str:
    content = {
        "case": case_to_dict(case),
        "axes": {address: values.tolist() for address, values in axes.items()},
        "settings": [paired, histories, tolerance, RUNS, LANES],
        "versions": [importlib.metadata.version("jaxbeam"), jax.__version__],
    }
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


_UNITS = {
    "peak_deflection": ("m", "largest absolute deflection", ("sensor",)),
    "peak_time": ("s", "time of the largest absolute deflection", ("sensor",)),
    "lowest_contact_force": ("N", "smallest contact force", ("load",)),
    "contact_lost_time": ("s", "first time at which the load would have to pull", ("load",)),
    "controller_failures": ("1", "steps at which the controller found no solution", ()),
    "deflection": ("m", "deflection", ("time", "sensor")),
}


def _label(case, axes, paired, tasks: Tasks, results) -> xarray.Dataset:
    """Results of all tasks as a dataset labelled by address."""
    real = tasks.index >= 0
    count = int(real.sum())
    dims = ("run",) if paired else tuple(axes)
    shape = (count,) if paired else tuple(values.size for values in axes.values())
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
        address: ("run" if paired else address, values) for address, values in axes.items()
    }
    coordinates["sensor"] = ("sensor", sensor_labels(case))
    if "deflection" in flat:
        coordinates["time"] = ("time", np.asarray(sample_times(case)), {"units": "s"})
    attributes = {
        "title": case.title,
        "case": json.dumps(case_to_dict(case)),
    }
    return xarray.Dataset(variables, coordinates, attributes)
