"""Many cases at once: any addresses, over grids or paired lists of values."""

import dataclasses
import hashlib
import importlib.metadata
import itertools
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray
from tqdm import tqdm

from jaxbeam import sweep_store
from jaxbeam.case import Case, replace, value_at
from jaxbeam.casefile import case_to_dict
from jaxbeam.checks import check
from jaxbeam.dynamics import Traffic, traffic
from jaxbeam.exponentials import LONGEST, norm
from jaxbeam.grid import even_grid, sampled_grid
from jaxbeam.integrate import march, trace
from jaxbeam.lanes import Tasks, arrange
from jaxbeam.loads import motion
from jaxbeam.modes import Layout, lay_out
from jaxbeam.pacing import choose_steps
from jaxbeam.plan import TOLERANCE, Form, most_at_once, sample_times
from jaxbeam.record import never_as_nan, sensor_labels
from jaxbeam.rig import couples, rig

RUNS = 256  # in a block, about: its states stay in the cache, its results are one write
PLACES = ("beam.length", ".position", ".start", ".end")


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
    result is not finite is marked there, holds NaN, and touches no other. With `histories`, also
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
    combine = zip(*axes.values(), strict=True) if paired else itertools.product(*axes.values())
    runs = np.array(list(combine), float)
    tasks = arrange(list(axes), runs)
    mark = _fingerprint(case, axes, paired, histories, tolerance)
    path = None if store is None else Path(store)
    state = "new"
    if path is not None:
        state = sweep_store.prepare(path, mark, resume, overwrite)
    if path is not None and state == "complete":
        return sweep_store.read(path).assign_coords(sensor=("sensor", sensor_labels(case)))

    work = _Work(case, tasks, histories, tolerance)
    if path is None:
        steps, error = work.steps()
        keeper = sweep_store.Memory(work.blocks)
    elif state == "resume":
        keeper = sweep_store.reopen(path)
        steps, error = keeper.steps[:-1], float(keeper.steps[-1])
    else:
        steps, error = work.steps()
        keeper = sweep_store.create(path, mark, work.blocks, np.append(steps, error))
    todo = keeper.missing()
    bar = tqdm(
        total=work.blocks * work.size,
        initial=(work.blocks - len(todo)) * work.size,
        unit="run",
        disable=not progress,
        file=sys.stderr,
    )
    with ThreadPoolExecutor(os.cpu_count()) as pool, bar:
        results = pool.map(lambda block: (block, work.block(block, steps)), todo)
        for block, result in results:
            keeper.write(block, result)
            bar.update(work.size)
    dataset = _label(case, axes, paired, tasks, keeper.collect(), error)
    keeper.finish(dataset)
    return dataset


def _axes(case: Case, over: dict[str, Any], paired: bool, histories: bool) -> dict[str, np.ndarray]:
    """The values of each address, checked one by one in the case."""
    check(case)
    if not over:
        raise ValueError("give at least one address to sweep over, with a list of values")
    if not case.sensors:
        raise ValueError("the case has no sensors, and peaks are taken there; add one to `sensors`")
    axes = {}
    for address, values in over.items():
        if np.ndim(value_at(case, address)):
            raise ValueError(f"{address} is a list; sweep over one of its entries, {address}.0")
        values = np.atleast_1d(np.asarray(values, float))
        if values.ndim != 1 or values.size == 0:
            raise ValueError(f"{address} takes a list of values, not one of shape {values.shape}")
        if histories and address in ("run.duration", "run.sample_rate"):
            raise ValueError(
                f"histories of different length do not fit together: leave out {address}"
            )
        for value in {values.min(), values.max(), *values[~np.isfinite(values)]}:
            check(replace(case, {address: value}))
        axes[address] = values
    sizes = {address: values.size for address, values in axes.items()}
    if paired and len(set(sizes.values())) > 1:
        raise ValueError(f"paired values must be equally many, not {sizes}")
    return axes


def _fingerprint(case, axes, paired, histories, tolerance) -> str:
    content = {
        "case": case_to_dict(case),
        "axes": {address: values.tolist() for address, values in axes.items()},
        "settings": [paired, histories, tolerance, RUNS],
        "version": importlib.metadata.version("jaxbeam"),
    }
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


class _Work:
    """All tasks of a sweep, cut into blocks of equal shape."""

    def __init__(self, case: Case, tasks: Tasks, histories: bool, tolerance: float):
        self.case, self.tasks, self.histories, self.tolerance = case, tasks, histories, tolerance
        count, lanes = tasks.index.shape
        self.each = min(count, max(1, RUNS // lanes))
        self.blocks = -(-count // self.each)
        self.size = self.each * lanes
        self.addresses = (tasks.heavy_addresses, tasks.light_addresses)
        layout = _common_layout(case, tasks)
        every = np.resize(np.arange(count), self.blocks * self.each).reshape(-1, self.each)
        found = [_survey(case, layout, self.addresses[0], tasks.heavy[part]) for part in every]
        norms, windows = (
            np.concatenate([np.asarray(part[i]) for part in found])[:count] for i in range(2)
        )
        slots = max(most_at_once(window) for window in windows)
        self.form = Form(layout, couples(case), slots)
        duration = _values(case, tasks, "run.duration")
        spans = np.minimum(windows[:, :, 1], duration[:, None]) - windows[:, :, 0]
        spans = np.where(spans > 0, spans, duration[:, None])
        crossing = np.min(spans, axis=1, initial=np.inf)
        crossing = np.where(np.isfinite(crossing), crossing, duration)
        self.paces = 1 / crossing
        self.limits = np.minimum(LONGEST / norms, duration)
        # As found for beams of 3 and 12 modes at fast and slow crossings.
        modes = case.beam.modes
        self.guesses = crossing / (15 * modes + 15 + 0.11 * norms * crossing / np.sqrt(modes))

    def steps(self):
        """Time steps of all tasks, and the error seen with them."""

        def measure(chosen, steps):
            return self._run(chosen, steps, None)["peak_deflection"]

        return choose_steps(
            measure, self.paces, self.guesses, self.limits, self.each, self.tolerance
        )

    def block(self, number: int, steps: np.ndarray) -> dict[str, np.ndarray]:
        """Results of a block of tasks, (task, lane, ...)."""
        count = self.tasks.index.shape[0]
        chosen = np.arange(number * self.each, (number + 1) * self.each) % count
        times = None
        if self.histories:
            times = sample_times(self.case)
            gap = float(times[1] - times[0])
            times = (times, max(1, int(np.ceil(gap / steps.min()))))
        return self._run(chosen, steps[chosen], times)

    def _run(self, chosen, steps, times):
        tasks = self.tasks
        results = _block(
            self.case,
            self.form,
            self.addresses,
            times,
            tasks.heavy[chosen],
            tasks.light[chosen],
            np.asarray(steps),
        )
        return {name: np.asarray(values) for name, values in results.items()}


def _values(case: Case, tasks: Tasks, address: str) -> np.ndarray:
    """A number of the case in every task."""
    if address in tasks.heavy_addresses:
        return tasks.heavy[:, tasks.heavy_addresses.index(address)]
    return np.full(tasks.heavy.shape[0], float(value_at(case, address)))


def _common_layout(case: Case, tasks: Tasks) -> Layout:
    """One layout for all tasks: the same order of places, degrees high enough for each.

    Raises ValueError if places change their order along the beam within the sweep.
    """
    moved = [i for i, name in enumerate(tasks.heavy_addresses) if name.endswith(PLACES)]
    values = np.unique(tasks.heavy[:, moved], axis=0)
    names = [tasks.heavy_addresses[i] for i in moved]
    layouts = [lay_out(replace(case, dict(zip(names, row, strict=True)))) for row in values]
    degrees = (
        np.max([layout.degrees for layout in layouts], axis=0)
        if len({len(layout.degrees) for layout in layouts}) == 1
        else layouts[0].degrees
    )
    common = {dataclasses.replace(layout, degrees=tuple(map(int, degrees))) for layout in layouts}
    if len(common) > 1:
        raise ValueError(
            f"places along the beam change their order over {', '.join(names)}: split the sweep "
            "where supports or patch edges meet"
        )
    return common.pop()


@eqx.filter_jit
def _survey(case, layout, addresses, heavy):
    """Norm of the rig (1/s) and times of entry and exit for each of some tasks."""

    def task(values):
        varied = replace(case, dict(zip(addresses, values, strict=True)))
        paths = [motion(load, varied.beam.length) for load in varied.loads]
        windows = jnp.array([path.window() for path in paths]).reshape(-1, 2)
        return norm(rig(varied, layout)), windows

    return jax.vmap(task)(heavy)


@eqx.filter_jit
def _block(case, form, addresses, times, heavy, light, longest):
    """Results of some tasks, one after the other, their lanes side by side."""
    heavy_addresses, light_addresses = addresses
    moving = all(name.startswith(("loads.", "run.")) for name in heavy_addresses)
    shared = rig(case, form.layout, form.coupled) if moving else None

    def task(values):
        heavy, light, longest = values
        varied = replace(case, dict(zip(heavy_addresses, heavy, strict=True)))
        assembled = rig(varied, form.layout, form.coupled) if shared is None else shared

        def press(values):
            loads = traffic(replace(varied, dict(zip(light_addresses, values, strict=True))))
            return loads.inertia[:, 0], loads.weight[:, 0]

        inertia, weight = jax.vmap(press, out_axes=1)(light)
        loads = Traffic(traffic(varied).motions, inertia, weight)
        watched = jnp.stack([sensor.position for sensor in varied.sensors])
        if times is None:
            grid = even_grid(varied, assembled, longest)
            best = march(assembled, loads, grid, watched, slots=form.slots)
            history = {}
        else:
            grid, where = sampled_grid(varied, assembled, times[0], times[1], True)
            count = grid.counts.shape[0] * times[1]
            best, states = trace(assembled, loads, grid, watched, slots=form.slots, steps=count)
            samples = states[:: times[1]][where][:, 0 : 2 * varied.beam.modes : 2]
            rows = assembled.shapes(watched, (0,))[0]
            history = {"deflection": jnp.einsum("sm,tml->lts", rows, samples)}
        peak, time = best.peak()
        return {
            "peak_deflection": peak.T,
            "peak_time": time.T,
            "lowest_contact_force": best.lowest.T,
            "contact_lost_time": never_as_nan(best.lost).T,
            **history,
        }

    return jax.lax.map(task, (heavy, light, longest))


_UNITS = {
    "peak_deflection": ("m", "largest absolute deflection", ("sensor",)),
    "peak_time": ("s", "time of the largest absolute deflection", ("sensor",)),
    "lowest_contact_force": ("N", "smallest contact force", ("load",)),
    "contact_lost_time": ("s", "first time at which the load would have to pull", ("load",)),
    "deflection": ("m", "deflection", ("time", "sensor")),
}


def _label(case, axes, paired, tasks: Tasks, results, error) -> xarray.Dataset:
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
        "error_estimate": error,
    }
    return xarray.Dataset(variables, coordinates, attributes)
