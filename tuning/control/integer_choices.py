"""Integer parameters of a controller, such as horizons: the case is tuned with each choice."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.runtime.printer import text_table
from tuning.control.load_cases import LoadCases
from tuning.control.objective import Objective
from tuning.control.tune import ParameterBounds, tune
from tuning.control.tuning_result import TuningResult


@dataclasses.dataclass(frozen=True, eq=False)
class IntegerSearchResult:
    """Tuning results by choice of integers."""

    choices: tuple[dict[str, int], ...]
    tuned: tuple[TuningResult, ...]

    @property
    def best(self) -> TuningResult:
        """The result with the lowest objective on training runs; stable ones come first."""
        ranks = [
            (found.stability_violation > 0, found.run_sets[0].objective[1]) for found in self.tuned
        ]
        return self.tuned[min(range(len(ranks)), key=ranks.__getitem__)]

    def __str__(self) -> str:
        names = list(self.choices[0])
        header = [*names, *(run_set.name for run_set in self.tuned[0].run_sets), ""]
        rows = []
        for choice, found in zip(self.choices, self.tuned, strict=True):
            objectives = [f"{run_set.objective[1]:.5g}" for run_set in found.run_sets]
            mark = "(best)" if found is self.best else ""
            rows.append([*(f"{choice[name]:d}" for name in names), *objectives, mark])
        lines = text_table(header, rows, ">" * (len(header) - 1) + "<")
        return "\n".join(["objective by choice", *lines, "", str(self.best)])


def tune_integers(
    case: Case,
    choices: Mapping[str, Sequence[int]],
    free: ParameterBounds,
    cases: LoadCases,
    objective: Objective | None = None,
    **options: Any,
) -> IntegerSearchResult:
    """Tune a case with every combination of integers at some addresses.

    `choices` are lists by address, such as {"controller.horizon": [4, 6, 8]}. Integers decide array
    shapes and have no gradient, so that each combination is a search of its own; `options` are
    those of `tune`.

    Raises ValueError for an address without an integer, and as `tune` does.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3, limits=(-2.0, 2.0))],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    ...     controller=jb.MPC(horizon=4, moves=2, move_weight=1e-9, period=0.01),
    ...     run=jb.Run(0.3),
    ... )
    >>> loads = tuning.LoadCases(({"loads.0.mass": 0.2},), ({"loads.0.mass": 0.3},))
    >>> options = {"steps": 1, "least_peaks": False, "progress": False}
    >>> free = {"controller.move_weight": (1e-10, 1e-8)}
    >>> found = tuning.control.tune_integers(
    ...     case, {"controller.horizon": [2, 4]}, free, loads, **options
    ... )
    >>> print(found.choices)
    ({'controller.horizon': 2}, {'controller.horizon': 4})
    """
    rows = [dict(zip(choices, row, strict=True)) for row in itertools.product(*choices.values())]
    if not choices or not rows:
        raise ValueError("name at least one integer, with at least one value to try")
    chosen = [with_integers(case, row) for row in rows]
    found = [tune(own, free, cases, objective, **options) for own in chosen]
    return IntegerSearchResult(tuple(rows), tuple(found))


def with_integers(case: Case, values: Mapping[str, int]) -> Case:
    """The case with other integers at some addresses.

    Raises ValueError for an address at which there is no integer.
    """
    for address, value in values.items():
        case = _replace_integer(case, address.split("."), int(value), address)
    return case


def _replace_integer(part, path: list[str], value: int, address: str):
    """A part of a case with the integer at the path within it replaced."""
    step, *rest = path
    if isinstance(part, tuple):
        if not (step.isdigit() and int(step) < len(part)):
            raise ValueError(f"the case has nothing at {address}")
        entries = list(part)
        entries[int(step)] = _replace_integer(entries[int(step)], rest, value, address)
        return tuple(entries)
    names = (
        [field.name for field in dataclasses.fields(part)] if _is_dataclass_instance(part) else []
    )
    if step not in names:
        hint = f"; there it has {', '.join(names)}" if names else ""
        raise ValueError(f"the case has nothing at {address}{hint}")
    old = getattr(part, step)
    if rest:
        return dataclasses.replace(part, **{step: _replace_integer(old, rest, value, address)})
    if isinstance(old, bool) or not isinstance(old, (int, np.integer)):
        raise ValueError(f"{address} is no integer: tune it as a free parameter")
    return dataclasses.replace(part, **{step: value})


def _is_dataclass_instance(part) -> bool:
    return dataclasses.is_dataclass(part) and not isinstance(part, type)
