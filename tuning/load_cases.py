"""The load cases that a controller is tuned on, and those it is proven on."""

import dataclasses
import itertools
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxbeam.case import Case, replace
from jaxbeam.fields import known
from jaxbeam.loads import motion
from jaxbeam.motion import NEVER

Values = dict[str, float]  # numbers of the case by address
TABLES = ("training", "held_out")


@dataclasses.dataclass(frozen=True)
class LoadCases:
    """Numbers of the case, by address, that differ from run to run: loads, plants, anything.

    `training` runs are tuned on, `held_out` ones only looked at when all is done.
    """

    training: tuple[Values, ...]
    held_out: tuple[Values, ...] = ()

    def __post_init__(self):
        if not self.training:
            raise ValueError("there is nothing to tune on: give at least one training case")
        both = [run for run in self.held_out if run in self.training]
        if both:
            raise ValueError(f"held-out cases must not be trained on, but {_words(both[0])} is")


def grid(values: Mapping[str, Sequence[float]]) -> tuple[Values, ...]:
    """Every combination of the values given by address."""
    rows = itertools.product(*values.values())
    return tuple(dict(zip(values, map(float, row), strict=True)) for row in rows)


def read_load_cases(path: str | os.PathLike) -> LoadCases:
    """Read load cases from a TOML file with tables [training] and [held_out].

    Each holds lists of values by address in quotes, such as "loads.0.mass" = [0.2, 0.5], all
    combinations of which are run. Raises ValueError, naming the file and the key, for what it does
    not understand; OSError if it cannot be read.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(f"cannot read the load cases {path}: {reason}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not valid TOML: {error}") from None
    unknown = set(content) - set(TABLES)
    if unknown:
        raise ValueError(
            f"{path}: there is no table [{min(unknown)}]; it has [training], [held_out]"
        )
    runs = {}
    for name in TABLES:
        table = content.get(name, {})
        for address, entries in table.items():
            numbers = isinstance(entries, list) and entries
            if not numbers or not all(type(x) in (int, float) for x in entries):
                raise ValueError(
                    f"{path}: {name}.{address} must be a list of numbers, such as"
                    f' "loads.0.mass" = [0.2, 0.5]'
                )
        runs[name] = grid(table) if table else ()
    try:
        return LoadCases(**runs)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def apply(case: Case, run: Values) -> Case:
    """The case of a run. Raises ValueError if its loads have not left when the run ends."""
    own = replace(case, run)
    ends = [float(motion(load, own.beam.length).window()[1]) for load in own.loads]
    last, duration = max(ends, default=0.0), float(known(own.run.duration))
    if last < NEVER and last > duration:
        raise ValueError(
            f"run.duration is {duration:g} s, but with {_words(run)} the last load leaves only at"
            f" {last:.4g} s: simulate longer"
        )
    return own


def _words(run: Values) -> str:
    return ", ".join(f"{address} = {value:g}" for address, value in run.items())


def columns(runs: Sequence[Values]) -> dict[str, np.ndarray]:
    """Values of some runs by address, NaN where a run leaves the case's own."""
    names = dict.fromkeys(address for run in runs for address in run)
    return {name: np.array([run.get(name, np.nan) for run in runs]) for name in names}
