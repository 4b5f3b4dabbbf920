"""Sweep of a case over the values at any addresses, in a grid or paired, as an xarray dataset."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbeam.case.case import Case, unit_at
from jaxbeam.case.fields import OUTSIDE, refuses_traced
from jaxbeam.case.toml_file import in_si
from jaxbeam.files.case_file import with_settings
from jaxbeam.model.plausibility.check import warn_if_implausible_sweep
from jaxbeam.runtime.interrupts import keeping
from jaxbeam.runtime.progress import ProgressBar
from jaxbeam.simulation.integration_plan import TOLERANCE
from jaxbeam.sweeps.computation import compute_sweep
from jaxbeam.sweeps.quality import warn_of_failures, warn_of_strokes, warn_of_truncation
from jaxbeam.sweeps.specification import sweep_specification
from jaxbeam.sweeps.store import kept_blocks, read_dataset, writing
from jaxbeam.sweeps.words import compute_word_sweep, split_words, word_sweep

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

SINGLE_RUNS = f"{OUTSIDE}, or differentiate jaxbeam.simulate of each run"


def first_and_last(case: Case, over: dict[str, Any]) -> list[Case]:
    """The cases of the first and the last values of a sweep; none for values that it refuses."""
    ends = []
    for end in (0, -1):
        try:
            settings = {
                address: in_si(np.asarray(values)[end].item(), unit_at(case, address), address)
                for address, values in over.items()
            }
            ends.append(with_settings(case, settings))
        except (ValueError, TypeError, IndexError, KeyError, AttributeError):
            return []
    return ends


@refuses_traced("a sweep", SINGLE_RUNS)
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
    memory: float | str | None = None,
) -> "xarray.Dataset":
    """Simulate a case for many values of the numbers, and for words, at given addresses.

    `over` maps each address to a list of values (SI units, or text with units, as
    "60 km/h"): all combinations, with a dimension per
    address, or with `paired` the first of each, the second, and so on along `run`. An address such
    as `loads.*.speed` is the speed of all loads. A list of words, as trains of the library at
    `loads.0.train` or models of vehicles at `loads.0.model`, makes a case of each, and a dimension
    with the words as labels; wheels that a train does not have are NaN. So do whole numbers, as
    seeds at `profile.seed`. The dataset has
    `peak_deflection` (..., sensor) in m and its time in s (for sensors of other quantities
    `peak_acceleration` and so on, each NaN at the others), the smallest contact force in N and the
    time of its first negative value in s (..., load), and `failed`, which marks runs that are not
    finite; their results are NaN. With absorbers it has `peak_stroke` in m and
    `peak_absorber_force` in N (..., absorber); runs whose stroke exceeds `max_stroke` are warned
    of. There is a warning of failed runs, the attribute `failed_runs` is
    their number, and `error_estimate` is NaN where all runs fail. With a controller,
    `controller_failures` counts its steps without a solution. With `histories`, `deflection`
    (..., time, sensor) in m is at the run's sample rate.

    Runs are computed in blocks on all cores, compiled once, with the longest time steps whose
    relative errors of peaks are below `tolerance`. On up to 16 paths, or 256 with a run each, each
    run is repeated with finer steps, whose results are given: `error_estimate` is twice the largest
    difference, or three tenths of the tolerance, if that is more. On more paths errors are measured
    on a stratified random sample of the runs, where they are at most a sixth of the tolerance; then
    it is six times the largest of these, as errors of other runs may be larger: one run in
    thousands exceeds it, near the critical speed of a heavy mass. Runs that differ in seeds of the
    profile share all that depends on their paths, where there is a C compiler.

    In `precision` "single" models and propagators are made in float64 and runs are integrated in
    float32, which is faster where arithmetic dominates, as on a GPU. Results are then float32, and
    the rounding error of peaks, a few parts in a million, is measured and included in
    `error_estimate`.

    Blocks have as many runs as `memory` allows, in bytes or with a unit ("2 GB"), by default a
    quarter of what is free; the progress line says how many. Results in memory are not counted.

    With a `store` each block is written to a zarr store when it is done; with `resume` an
    interrupted sweep continues from there, with bit-identical results. With a `client` of Dask
    (`distributed.Client`) its workers compute the blocks and write them to the store, in a folder
    that they share. One sweep at a time writes to a store; its lock, `.NAME.lock` beside it, ends
    with the process. With `overwrite` the new sweep is written to a folder `.NAME.new` beside the
    old one, which it replaces when it is complete; interrupted, it continues there when repeated.

    Raises ValueError for an unknown address, invalid values, a case without sensors, a controller
    in single precision, a client without a store, or numbers that are traced by JAX;
    FileExistsError if the store exists, without `resume` or `overwrite`; OSError if it cannot be
    written, or another process writes it (an `InUseError`, which says which); RuntimeError if no
    time step meets the tolerance or workers keep dying.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> runs = jb.sweep(case, {"loads.0.speed": [1.0, 2.0]}, progress=False)
    >>> print(dict(runs.peak_deflection.sizes))
    {'loads.0.speed': 2, 'sensor': 1}
    """
    if client is not None and store is None:
        raise ValueError("workers write their blocks to a store; name one")
    words, numbers = split_words(case, over)
    settings = paired, histories, tolerance, precision, memory
    if words:
        plan = word_sweep(case, words, numbers, list(over), *settings)
    else:
        plan = sweep_specification(case, over, *settings)
    warn_if_implausible_sweep([case, *first_and_last(case, over)], over)
    warn_of_truncation(case)
    compute = compute_word_sweep if words else compute_sweep

    def computed(folder: Path | None, state: str) -> "xarray.Dataset":
        with ProgressBar(plan.count, "run", shown=progress) as bar:
            return compute(plan, folder, state, client, bar)

    def stored(path: Path) -> "xarray.Dataset":
        with writing(path.absolute(), plan.fingerprint(), resume, overwrite) as place:
            if place.state == "complete":
                return read_dataset(place.folder)

            def kept() -> str:
                again = "the same command goes on" if overwrite else "resume it, with --resume"
                unfinished = (place.folder / "zarr.json").exists()
                return f"{kept_blocks(place.folder)} in {path}: {again}" if unfinished else ""

            with keeping(kept):
                return computed(*place)

    dataset = computed(None, "new") if store is None else stored(Path(store))
    warn_of_failures(dataset)
    warn_of_strokes(case, dataset)
    return dataset
