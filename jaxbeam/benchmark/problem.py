"""Problems of the benchmark: a case with a baseline controller, and the loads that cross it."""

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case, replace
from jaxbeam.case.controller import commanded
from jaxbeam.files.case_file import load_case
from jaxbeam.numerics.normal_samples import uniform_samples
from jaxbeam.runtime.arrays import Array, xp

VERSION = "v1"  # of problems, seeds and score; what belongs to it does not change any more
TEST_SEEDS = (1, 2, 3, 4, 5)  # published, with their bounds
LOAD_STREAM = 2**20  # of random numbers: those of the sensors' noise are numbered from 0


@dataclasses.dataclass(frozen=True, eq=False)
class BenchmarkProblem:
    """Problem: a case, whose controller is the baseline, and the loads that differ between runs.

    `vary` maps addresses of the case to the lowest and highest number (SI units). The score counts
    the deflection at `positions` (m) at the samples of the run. `training` are the numbers of loads
    for training. If the load is `told`, a law is designed for the load of the run, else for that of
    the case. At most `max_loads` wheels are on the beam at once.
    """

    name: str
    case: Case
    vary: Mapping[str, tuple[float, float]]
    positions: tuple[float, ...]
    told: bool
    training: Float[np.ndarray, "load number"]
    max_loads: int

    @property
    def driven(self) -> tuple[int, ...]:
        """Indices of the actuators that take commands."""
        return commanded(self.case.actuators)

    @property
    def period(self) -> float:
        """Time (s) for which commands are held."""
        controller = self.case.controller
        assert controller is not None
        return float(controller.period)

    def numbers(self, shares: Float[Array, " number"]) -> Float[Array, " number"]:
        """Numbers of a load (SI units) at fractions (`shares`, 0 to 1) of their ranges."""
        low, high = np.array(list(self.vary.values())).T
        return low + (high - low) * shares

    def shares(self, numbers: Float[Array, " number"]) -> Float[Array, " number"]:
        """Fractions of the ranges, 0 to 1, at which the numbers of a load are."""
        low, high = np.array(list(self.vary.values())).T
        return (numbers - low) / (high - low)

    def test_load(self, seed: int) -> Float[np.ndarray, " number"]:
        """Numbers of the test load of a seed, uniformly distributed over their ranges."""
        return np.asarray(self.numbers(uniform_samples(seed, (LOAD_STREAM,), len(self.vary))))

    def with_load(self, case: Case, numbers: Float[Array, " number"]) -> Case:
        """A case with the numbers of a load."""
        return replace(case, dict(zip(self.vary, xp.asarray(numbers), strict=True)))

    def run_case(self, numbers: Float[Array, " number"], seed: int = 0) -> Case:
        """Case of a run: the load, and the seed of the noise; the controller is the baseline."""
        run = dataclasses.replace(self.case.run, seed=seed)
        return self.with_load(dataclasses.replace(self.case, run=run), numbers)


def names() -> tuple[str, ...]:
    """Names of the problems.

    >>> import jaxbeam as jb
    >>> print(len(jb.benchmark.names()))
    10
    """
    return tuple(_tables())


@checks_classes
@functools.cache
def load(name: str) -> BenchmarkProblem:
    """Benchmark problem of a name.

    Raises ValueError for an unknown name.

    >>> import jaxbeam as jb
    >>> problem = jb.benchmark.load("unknown_mass")
    >>> print(problem.vary, problem.told)
    {'loads.0.mass': (0.05, 1.0)} False
    """
    table: Any = _tables().get(name)
    if table is None:
        listed = ", ".join(names())
        raise ValueError(f"there is no problem {name!r} in the benchmark; it has {listed}")
    with resources.as_file(resources.files("jaxbeam.benchmark") / f"problems/{name}.toml") as path:
        case = load_case(path)
    return BenchmarkProblem(
        name=name,
        case=case,
        vary={address: tuple(both) for address, both in table["vary"].items()},
        positions=tuple(table["positions"]),
        told=table["told"],
        training=np.array(table["training"], float),
        max_loads=table["max_loads"],
    )


@functools.cache
def _tables() -> dict[str, Any]:
    text = (resources.files("jaxbeam.benchmark") / "problems.toml").read_text("utf-8")
    return tomllib.loads(text)
