"""Sweeps over words, as names of trains, and counts, as seeds: a sweep of numbers for each, joined.

A word or a count may change the structure of a case, so that each combination is a case of its own,
with its own sweep of numbers and, in a store, a store of its own within `blocks`. Cases that have
equal structures once the words are written out as numbers share compiled programs: trains with as
many axles, roads of several seeds.
"""

import dataclasses
import hashlib
import itertools
import json
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxbeam.case.case import ALL, Case, address_words, addresses
from jaxbeam.case.former_words import attribute_address
from jaxbeam.case.profiles.spectra import profiles_of_runs
from jaxbeam.files.case_file import case_to_dict, with_settings
from jaxbeam.runtime.progress import ProgressBar
from jaxbeam.sweeps import MAX_RUNS, MAX_WORDS, store as sweep_store
from jaxbeam.sweeps.batches import PROFILE_NUMBER
from jaxbeam.sweeps.computation import compute_sweep, worst_runs
from jaxbeam.sweeps.quality import estimated_errors
from jaxbeam.sweeps.specification import SweepSpecification, sweep_specification
from jaxbeam.sweeps.step_size import largest_error
from jaxbeam.sweeps.store import (
    BLOCKS_GROUP,
    FINGERPRINT_ATTRIBUTE,
    new_store,
    replace_blocks,
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

    def join(self, datasets: "Sequence[xarray.Dataset]") -> "xarray.Dataset":
        """Dataset with a dimension for each address, from those of all combinations of words.

        `cases` along the words has their cases as text; the attribute `case` that of the sweep.
        """
        import xarray

        wheels = max(part.sizes.get("load", 0) for part in datasets)
        datasets = [part.pad(load=(0, wheels - part.sizes.get("load", 0))) for part in datasets]
        sizes = tuple(len(words) for words in self.words.values())
        variables = {}
        for name, first in datasets[0].data_vars.items():
            values = np.stack([part[name].values for part in datasets])
            values = values.reshape(*sizes, *values.shape[1:])
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
    joined = plan.join(datasets)
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
    found = None if path is None else sweep_store.status(path)
    if path is not None and found == ("complete", part.fingerprint()):
        progress_bar.skip(part.count)
        return sweep_store.read_dataset(path)
    if found and found[1] != part.fingerprint():
        raise ValueError(f"{path} is not the part of its sweep that its place says")
    state = "new" if found is None else "resume"
    return compute_sweep(part, path, state, client, progress_bar, estimates=False)
