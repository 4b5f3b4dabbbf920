"""Load cases of a tuning: training runs, and held-out runs on which the result is checked."""

import dataclasses
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from scipy.stats.qmc import LatinHypercube

from jaxbeam.case.arguments import describe_value
from jaxbeam.case.case import Case, crossing_times, replace, unit_at, value_at
from jaxbeam.case.fields import OUTSIDE, concrete, refuse_traced, refuses_traced
from jaxbeam.case.tables import COUNT, NUMBERS, TABLE, check_entry, check_table
from jaxbeam.case.toml_file import in_si, is_quantity, read_toml
from jaxbeam.case.trajectory import NEVER
from jaxbeam.files.case_file import with_settings

AddressValues = dict[str, float]  # values of the case by address
TABLES = ("training", "held_out")
VALUES = NUMBERS._replace(description='a list of numbers, such as "loads.0.mass" = [0.2, 0.5]')
COUNTS = ("seed", "count", "waves")  # names of whole numbers, which are not numbers of a case
MAX_LOAD_CASES = 100_000
# Addresses of the plant begin with these.
PLANT_PREFIXES = ("beam.", "supports.", "actuators.", "sensors.")


@dataclasses.dataclass(frozen=True)
class LoadCases:
    """Training and held-out runs: values of the case by address, which differ from run to run.

    Vehicles and profiles are numbers like others, `loads.0.body_mass`; `profile.seed` is another
    realisation of a random profile.

    The tuning minimises the objective of the `training` runs; `held_out` runs are simulated with
    its result only.

    Raises ValueError without training runs, and for a held-out run that is a training run.

    >>> import tuning
    >>> loads = tuning.LoadCases(
    ...     ({"loads.0.mass": 0.2}, {"loads.0.mass": 0.5}), ({"loads.0.mass": 0.4},)
    ... )
    >>> stiff = [{"beam.flexural_rigidity": 12.0}, {"beam.flexural_rigidity": 13.0}]
    >>> print(len(loads.across(stiff).training), "training runs")
    4 training runs
    """

    training: tuple[AddressValues, ...]
    held_out: tuple[AddressValues, ...] = ()

    def __post_init__(self):
        refuse_traced("a set of load cases", OUTSIDE, self.training, self.held_out)
        if not self.training:
            raise ValueError("there is nothing to tune on: give at least one training case")
        repeated = [run for run in self.held_out if run in self.training]
        if repeated:
            raise ValueError(
                f"held-out cases must not be trained on, but {_describe(repeated[0])} is"
            )

    def across(
        self, plants: Sequence[AddressValues], others: Sequence[AddressValues] = ()
    ) -> "LoadCases":
        """Every training run on each of the plants, every held-out run on each of the `others`.

        Plants are values by address, as `tuning.control.draw_plants` returns them; without
        `others`, held-out runs have the plant of the case.
        """
        held_out = _all_pairs(self.held_out, others) if others else self.held_out
        return LoadCases(_all_pairs(self.training, plants), held_out)


def _all_pairs(
    runs: Sequence[AddressValues], plants: Sequence[AddressValues]
) -> tuple[AddressValues, ...]:
    return tuple({**run, **plant} for run in runs for plant in plants)


@refuses_traced("a set of load cases", "give known numbers")
def full_grid(values: Mapping[str, Sequence[float | int]]) -> tuple[AddressValues, ...]:
    """Full grid: every combination of the values given by address.

    Raises ValueError where the values at an address are no list.

    >>> import tuning
    >>> print(*tuning.full_grid({"loads.0.mass": [0.2, 0.4]}))
    {'loads.0.mass': 0.2} {'loads.0.mass': 0.4}
    """
    for address, listed in values.items():
        if np.ndim(listed) != 1:
            raise ValueError(f"{address}: give a list of numbers, not {describe_value(listed)}")
    rows = itertools.product(*values.values())
    return tuple(dict(zip(values, map(float, row), strict=True)) for row in rows)


@refuses_traced("a set of load cases", "give known numbers")
def latin_hypercube(
    ranges: Mapping[str, Sequence[float | int]], count: int, seed: int = 0
) -> tuple[AddressValues, ...]:
    """Latin hypercube: `count` draws of values, evenly spread over a range for each address.

    Raises ValueError for a count below 1 or a range that does not ascend.

    >>> import tuning
    >>> len(tuning.latin_hypercube({"loads.0.mass": (0.2, 0.4)}, count=5))
    5
    """
    if count < 1:
        raise ValueError(f"the number of draws must be 1 or more, not {count}")
    for address, (low, high) in ranges.items():
        if not low < high:
            raise ValueError(f"{address}: a range must ascend, but it is {low:g} to {high:g}")
    shares = LatinHypercube(len(ranges), rng=np.random.default_rng(seed)).random(count)
    low, high = np.array(list(ranges.values()), float).T
    rows = low + (high - low) * shares
    return tuple(dict(zip(ranges, map(float, row), strict=True)) for row in rows)


def read_load_cases(path: str | os.PathLike, case: Case | None = None) -> LoadCases:
    r"""Read load cases from a TOML file with tables [training] and [held_out].

    Each table has lists of values by address in quotes, such as "loads.0.mass" = [0.2, 0.5]; its
    runs are all combinations. With `draws = 12` (and `seed = 1`, 0 if left out) the lists are
    ranges, low and high, of which the runs are a Latin hypercube. With the `case` whose values they
    are, entries may have units: "loads.0.speed" = ["60 km/h", "90 km/h"].

    Raises ValueError, naming the file and the key, for faulty content; OSError if the file cannot
    be read.

    >>> from pathlib import Path
    >>> import tuning
    >>> tables = '[training]\n"loads.0.mass" = [0.2, 0.5]\n[held_out]\n"loads.0.mass" = [0.4]\n'
    >>> _ = Path("loads.toml").write_text(tables)
    >>> tuning.read_load_cases("loads.toml").held_out
    ({'loads.0.mass': 0.4},)
    """
    content = read_toml(path, "file of load cases")
    try:
        return _load_cases(content, case)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _load_cases(content: dict[str, Any], case: Case | None) -> LoadCases:
    """Load cases from the tables of their file."""
    unknown = set(content) - set(TABLES)
    if unknown:
        raise ValueError(f"there is no table [{min(unknown)}]; it has [training], [held_out]")
    check_table("", content, dict.fromkeys(TABLES, TABLE))
    runs = {}
    for name in TABLES:
        table = dict(content.get(name, {}))
        draw_options = {key: table.pop(key) for key in ("draws", "seed") if key in table}
        for address, entries in table.items():
            if case is not None and isinstance(entries, list) and any(map(is_quantity, entries)):
                value_at(case, address)  # says what is wrong with the address
                entries = in_si(entries, unit_at(case, address), f"{name}.{address}")
                table[address] = entries
            check_entry(f"{name}.{address}", entries, VALUES)
        runs[name] = _table_runs(table, draw_options, name)
    return LoadCases(**runs)


def _table_runs(table, draw_options, where: str) -> tuple[AddressValues, ...]:
    """Runs of a table: the full grid of its lists, or draws from its ranges."""
    check_table(where, draw_options, {"draws": COUNT, "seed": COUNT})
    count = draw_options.get("draws", math.prod(map(len, table.values())))
    if count > MAX_LOAD_CASES:
        raise ValueError(f"{where} has {count:.3g} runs, more than {MAX_LOAD_CASES}: take fewer")
    if "draws" not in draw_options:
        if draw_options:
            raise ValueError(f"{where}.seed is for drawing: say how many with draws = 12")
        return full_grid(table) if table else ()
    if not table:
        raise ValueError(f'{where}.draws needs ranges, such as "loads.0.mass" = [0.2, 0.5]')
    for address, entries in table.items():
        if len(entries) != 2:
            raise ValueError(
                f"{where}.{address} must be a range, low and high, to draw from; it has"
                f" {len(entries)} entries"
            )
    try:
        return latin_hypercube(table, draw_options["draws"], draw_options.get("seed", 0))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def run_case(case: Case, run: AddressValues) -> Case:
    """The case of a run, with the seed of a random profile, say, as well as numbers.

    Raises ValueError if it ends before its loads have left the beam, and for a count that is not
    whole.
    """
    changed = replace(case, {a: v for a, v in run.items() if not _is_count(case, a)})
    counts = {address: value for address, value in run.items() if _is_count(case, address)}
    for address, value in counts.items():
        if value != round(value):
            raise ValueError(f"{address} takes a whole number, not {value:g}")
    if counts:
        changed = with_settings(changed, {a: round(value) for a, value in counts.items()})
    last = crossing_times(changed)[:, 1].max(initial=0.0)
    duration = float(concrete(changed.run.duration))
    if last < NEVER and last > duration:
        raise ValueError(
            f"run.duration is {duration:g} s, but with {_describe(run)} the last load leaves only"
            f" at {last:.4g} s: simulate longer"
        )
    return changed


def run_cases(case: Case, runs: Sequence[AddressValues]) -> list[Case]:
    """The cases of some runs, alike in structure: see `run_case`.

    Where a count differs, as the seed of a profile, profiles are sums of given waves.

    Raises ValueError as `run_case`, and for a count that changes the structure.
    """
    cases = [run_case(case, run) for run in runs]
    counts = dict.fromkeys(a for run in runs for a in run if _is_count(case, a))
    if not counts:
        return cases
    if case.profile is not None:
        cases = [dataclasses.replace(own, profile=own.profile.by_numbers()) for own in cases]
    shapes = {str(jax.tree.map(np.shape, own)) for own in cases}
    if len(shapes) > 1:
        raise ValueError(
            f"runs that differ in {', '.join(counts)} cannot be simulated together, as their cases"
            " have different structures: tune for one value of it"
        )
    return cases


def _is_count(case: Case, address: str) -> bool:
    """Whether the entry of a case at an address is a whole number such as a seed."""
    name = address.rpartition(".")[2]
    return name in COUNTS and address.startswith(("profile.", "run.", "loads."))


def _describe(run: AddressValues) -> str:
    return ", ".join(f"{address} = {value:g}" for address, value in run.items())


def value_columns(runs: Sequence[AddressValues]) -> dict[str, np.ndarray]:
    """Values of some runs by address (run,), NaN where a run has the value of the case."""
    names = dict.fromkeys(address for run in runs for address in run)
    return {name: np.array([run.get(name, np.nan) for run in runs]) for name in names}
