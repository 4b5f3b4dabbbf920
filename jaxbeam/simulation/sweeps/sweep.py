"""Sweep of a case over the values at any addresses, in a grid or paired, as an xarray dataset.

A word, as the name of a train, or a count, as a seed, may change the structure of a case, so that
each combination is a case of its own, with its own sweep of numbers and, in a store, a store of its
own within `blocks`. Cases that have equal structures once the words are written out as numbers
share compiled programs: trains with as many axles, roads of several seeds.
"""

import dataclasses
import hashlib
import itertools
import json
import math
import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbeam.case.case import ALL, Case, address_words, addresses, unit_at
from jaxbeam.case.fields import OUTSIDE, refuses_traced
from jaxbeam.case.profiles.spectra import profiles_of_runs
from jaxbeam.case.toml_file import attribute_address, in_si
from jaxbeam.files.case_file import case_to_dict, with_settings
from jaxbeam.model.plausibility.check import warn_if_implausible_sweep
from jaxbeam.runtime.interrupts import keeping
from jaxbeam.runtime.progress import ProgressBar
from jaxbeam.simulation.integration_plan import TOLERANCE
from jaxbeam.simulation.sweeps import MAX_RUNS, MAX_WORDS, store as sweep_store
from jaxbeam.simulation.sweeps.batches import PROFILE_NUMBER
from jaxbeam.simulation.sweeps.computation import (
    compute_sweep,
    estimated_errors,
    warn_of_failures,
    warn_of_strokes,
    warn_of_truncation,
    worst_runs,
)
from jaxbeam.simulation.sweeps.specification import SweepSpecification, sweep_specification
from jaxbeam.simulation.sweeps.step_size import largest_error
from jaxbeam.simulation.sweeps.store import (
    BLOCKS_GROUP,
    FINGERPRINT_ATTRIBUTE,
    kept_blocks,
    new_store,
    read_dataset,
    replace_blocks,
    writing,
)

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

MOST_UNCOMPILED = 2  # sweeps of a few runs each that NumPy computes sooner than a program compiles
Words = tuple[str, ...] | tuple[int, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class WordSweep:
    """Words and counts at addresses of a case, and the sweep of numbers for each combination.

    `cases` have the words, `sweeps` the same cases with numbers in their place, both in the order
    of all combinations, the last word first. `dims` are the dimensions of the results.
    """

    case: Case
    words: dict[str, Words]
    dims: tuple[str, ...]
    cases: list[Case]
    sweeps: list[SweepSpecification]

    @property
    def count(self) -> int:
        """Number of runs."""
        return sum(part.count for part in self.sweeps)

    def fingerprint(self) -> str:
        """SHA-256 of all that determines the results: words, and the sweep of numbers of each."""
        content = [self.words, self.dims, [part.fingerprint() for part in self.sweeps]]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def join(
        self, datasets: "Sequence[xarray.Dataset]", folder: Path | None = None
    ) -> "xarray.Dataset":
        """Dataset with a dimension for each address, from those of all combinations of words.

        With a `folder` it is in files there, as histories may be larger than the memory. `cases`
        along the words has their cases as text; the attribute `case` that of the sweep.
        """
        import xarray

        wheels = max(part.sizes.get("load", 0) for part in datasets)
        datasets = [part.pad(load=(0, wheels - part.sizes.get("load", 0))) for part in datasets]
        sizes = tuple(len(words) for words in self.words.values())
        variables = {}
        for name, first in datasets[0].data_vars.items():
            shape, dtype = (len(datasets), *first.shape), first.dtype
            path = None if folder is None else folder / f"{name}{sweep_store.ROWS_FILE}"
            values = (
                np.empty(shape, dtype)
                if path is None
                else sweep_store.file_array(path, shape, dtype)
            )
            for own, part in zip(values, datasets, strict=True):
                rows = part[name].encoding.get("chunks", first.shape)[0]  # that are read at once
                for i in range(0, len(own), rows):
                    own[i : i + rows] = part[name][i : i + rows].values
            values = values.reshape(*sizes, *first.shape)
            variables[name] = ((*self.words, *first.dims), values, first.attrs)
        coordinates: dict[str, Any] = {
            address: (address, list(words), {"long_name": address_words(self.case, address)})
            for address, words in self.words.items()
        }
        texts = [json.dumps(case_to_dict(case)) for case in self.cases]
        coordinates["cases"] = (tuple(self.words), np.reshape(texts, sizes))
        joined = xarray.Dataset(variables, coordinates | dict(datasets[0].coords))
        for address in set(self.dims) - set(self.words):  # of a train that is written as numbers
            joined[address].attrs["long_name"] = address_words(self.case, address)
        return joined.transpose(*self.dims, ...).assign_attrs(
            title=self.case.title,
            case=json.dumps(case_to_dict(self.case)),
            error_estimate=largest_error([part.error_estimate for part in datasets]),
            failed_runs=sum(int(part.failed_runs) for part in datasets),
        )


def split_words(case: Case, over: dict[str, Any]) -> tuple[dict[str, Words], dict[str, Any]]:
    """Words by address, in present words, and values by address of the others.

    Words are values that are text, at an address that has no number; counts are among them. Raises
    ValueError for numbers among words, and for counts that are not whole.
    """
    numbers_of_case = addresses(case)
    words: dict[str, Words] = {}
    others: dict[str, Any] = {}
    for address, given in over.items():
        values = np.atleast_1d(np.asarray(given, object)).ravel()
        current = attribute_address(address)
        is_word = [isinstance(value, str) for value in values]
        first = current.replace(ALL, "0")
        if first in numbers_of_case:
            others[address] = given
        elif all(is_word):
            words[current] = tuple(map(str, values))
        elif any(is_word):
            raise ValueError(f"{address} takes a list of words or of numbers, not both in one")
        elif _is_count(case, first):
            parts = [value for value in values if not float(value).is_integer()]
            if parts:
                raise ValueError(f"{address} takes whole numbers, not {parts[0]:g}")
            words[current] = tuple(map(int, values))
        else:
            others[address] = given
    return words, others


def _is_count(case: Case, address: str) -> bool:
    """Whether an address of a case is a count, as a seed: an integer outside its equations."""
    entry: Any = case_to_dict(case, whole=True)
    for key in address.split("."):
        if isinstance(entry, list):
            entry = entry[int(key)] if key.isdigit() and int(key) < len(entry) else None
        else:
            entry = entry.get(key) if isinstance(entry, dict) else None
    return isinstance(entry, int) and not isinstance(entry, bool)


def word_sweep(
    case: Case,
    words: dict[str, Words],
    over: dict[str, Any],
    order: Sequence[str],
    paired: bool,
    histories: bool,
    tolerance: float,
    precision: str,
    memory: float | str | None = None,
) -> WordSweep:
    """Sweep over all combinations of words and numbers; `order` is that of the addresses.

    Raises ValueError for words that the case cannot have, paired values, words that change the
    sensors, and as `sweep_specification`, with the words.
    """
    if paired:
        raise ValueError(
            f"words at {', '.join(words)} are combined with all numbers; they cannot be paired"
        )
    if (combinations := math.prod(map(len, words.values()))) > MAX_WORDS:
        raise ValueError(
            f"{combinations:.1e} combinations of words and counts at {', '.join(words)} are more"
            f" than {MAX_WORDS:.0e}, as each is a case of its own: split the sweep"
        )
    cases, sweeps = [], []
    for combination in itertools.product(*words.values()):
        settings = dict(zip(words, combination, strict=True))
        named = ", ".join(f"{address} = {word}" for address, word in settings.items())
        changed = with_settings(case, settings)
        numbers = over or {"run.gravity": [float(case.run.gravity)]}
        try:
            sweeps.append(
                sweep_specification(
                    with_numbers(changed, over),
                    numbers,
                    False,
                    histories,
                    tolerance,
                    precision,
                    memory,
                )
            )
        except ValueError as error:
            raise ValueError(f"with {named}: {error}") from None
        if [str(s.quantity) for s in changed.sensors] != [str(s.quantity) for s in case.sensors]:
            raise ValueError(f"{named} changes the sensors, which all runs share: make two sweeps")
        cases.append(changed)
    if len(sweeps) > MOST_UNCOMPILED:
        sweeps = [dataclasses.replace(part, several=True) for part in sweeps]
    dims = tuple(attribute_address(address) for address in order)
    plan = WordSweep(case, words, dims, cases, sweeps)
    if plan.count > MAX_RUNS:
        raise ValueError(
            f"{plan.count:.1e} combinations of values are more than the {MAX_RUNS:.0e} runs of a"
            " sweep: split it"
        )
    return plan


def with_numbers(case: Case, over: Collection[str] = ()) -> Case:
    """The case with numbers in place of names of the library and seeds, where they mean the same.

    Not those of a profile with swept numbers, which are `over` its own addresses.
    """
    loads, profile = tuple(load.by_numbers() for load in case.loads), case.profile
    if profile is not None and not any(address.startswith("profile.") for address in over):
        profile = profile.by_numbers()
    return dataclasses.replace(case, loads=loads, profile=profile)


def compute_word_sweep(
    plan: WordSweep,
    path: Path | None,
    state: str,
    client: Any,
    progress_bar: ProgressBar,
) -> "xarray.Dataset":
    """Dataset of a sweep over words, one word after the other (see `compute_sweep`)."""
    fingerprint = plan.fingerprint()
    if path is not None and state == "new":
        with new_store(path, fingerprint):
            pass
    computed: dict[int, xarray.Dataset] = {}
    if path is None:
        for group in _alike_but_for_profiles(plan.sweeps):
            found = _computed_together([plan.sweeps[i] for i in group], progress_bar)
            computed |= zip(group, found, strict=False)
    for i, part in enumerate(plan.sweeps):
        part_path = None if path is None else path / BLOCKS_GROUP / str(i)
        if i not in computed:
            computed[i] = _compute_part(part, part_path, client, progress_bar)
    datasets = [computed[i] for i in range(len(plan.sweeps))]
    joined = plan.join(datasets, None if path is None else path / BLOCKS_GROUP)
    for quantity, error in _estimates(plan, datasets).items():
        joined[f"peak_{quantity}"].attrs["truncation_error"] = error
    if set(plan.sweeps[0].dims) - set(plan.dims):  # words alone
        joined = joined.isel({dim: 0 for dim in plan.sweeps[0].dims}, drop=True)
    joined.attrs[FINGERPRINT_ATTRIBUTE] = fingerprint
    if path is not None:
        replace_blocks(path, joined)
    return joined


def _alike_but_for_profiles(sweeps: Sequence[SweepSpecification]) -> list[list[int]]:
    """Groups of numbers of sweeps that differ only in profiles which the C integrator takes."""
    groups: dict[str, list[int]] = {}
    for i, part in enumerate(sweeps):
        if profiles_of_runs([part.case.profile]) is not None:
            level = dataclasses.replace(part.case, profile=None)
            alike = dataclasses.replace(part, case=level).fingerprint()
            groups.setdefault(alike, []).append(i)
    return [group for group in groups.values() if len(group) > 1]


def _computed_together(
    parts: Sequence[SweepSpecification], progress_bar: ProgressBar
) -> "list[xarray.Dataset]":
    """Datasets of sweeps that differ only in profiles, computed as one sweep; none without C.

    Matrices that depend on the paths of the loads are computed once for all.
    """
    first = parts[0]
    profiles = [part.case.profile for part in parts]
    if profiles_of_runs(profiles) is None:
        return []
    axes = {PROFILE_NUMBER: np.arange(float(len(parts)))} | first.axes
    together = dataclasses.replace(first, axes=axes, profiles=tuple(profiles))
    if not together.uses_c():
        return []
    joined = compute_sweep(together, None, "new", None, progress_bar, estimates=False)
    found = []
    for i in range(len(parts)):
        own = joined.isel({PROFILE_NUMBER: i}, drop=True)
        found.append(own.assign_attrs(failed_runs=int(own.failed.sum())))
    return found


def _estimates(plan: WordSweep, datasets: "Sequence[xarray.Dataset]") -> dict[str, float]:
    """Truncation error of each quantity, of the combination of words with its largest peak."""
    errors = {}
    for quantity in {sensor.quantity for sensor in plan.case.sensors}:
        peaks = [part[f"peak_{quantity}"].max().item() for part in datasets]
        worst = int(np.argmax(np.nan_to_num(peaks)))
        part, run = plan.sweeps[worst], worst_runs(plan.sweeps[worst], datasets[worst])
        of_quantity = {q: run[q] for q in run if q == quantity}
        found = estimated_errors(part.case, of_quantity)
        errors |= {q: error for q, error in found.items() if q == quantity}
    return errors


def _compute_part(part, path, client, progress_bar) -> "xarray.Dataset":
    """Dataset of the sweep of numbers for one combination of words."""
    if path is None:
        return compute_sweep(part, None, "new", client, progress_bar, estimates=False)
    found = sweep_store.status(path)
    if found and found[1] != part.fingerprint():
        raise ValueError(f"{path} is not the part of its sweep that its place says")
    if found and found[0] == "complete":
        progress_bar.skip(part.count)
    else:
        state = "new" if found is None else "resume"
        compute_sweep(part, path, state, client, progress_bar, estimates=False)
    return read_dataset(path)


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
    quarter of what is free; the progress line says how many. Results in memory are not counted;
    with a `store` histories stay in its files, from which the dataset reads what is used, so that
    they may be larger than the memory.

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

            def kept() -> str:
                again = "the same command goes on" if overwrite else "resume it, with --resume"
                unfinished = (place.folder / "zarr.json").exists()
                return f"{kept_blocks(place.folder)} in {path}: {again}" if unfinished else ""

            if place.state == "complete":
                read_dataset(place.folder)  # a damaged one is refused before it replaces another
            else:
                with keeping(kept):
                    computed(*place)
        return read_dataset(path)

    dataset = computed(None, "new") if store is None else stored(Path(store))
    warn_of_failures(dataset)
    warn_of_strokes(case, dataset)
    return dataset
