"""Tuning by gradients beside differential evolution: the same loop, at equal cost.

    python -m experiments.benchmarks.tuning_methods

A table of commands (11 breakpoints and the lead) on rig B is tuned for the worst peak of four
loads. All methods start from the same trapezium and search within the same limits. Differential
evolution (scipy) is given the time that Adam takes (without compiling on both sides), the
evaluations that the gradients are worth (one in reverse mode counted as four), and ten times as
many. Worst peaks, relative to no control: 0.825 at the start, 0.7923 by 80 gradients of each method
(2 s); 0.807 by evolution in the same 2 s, 0.815 by as many evaluations, 0.7924 by ten times as many
(10 s).
"""

import dataclasses
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution

import jaxbeam as jb
import tuning
from experiments.studies.loads import ENTRY_TIME, PERIOD
from experiments.studies.tune_feedforward import COMMAND_LIMITS, GATES, INITIAL_TABLES, LEAD
from jaxbeam import rigs
from jaxbeam.case.case import value_at
from jaxbeam.runtime.compiling import compiled
from tuning.control.optimisers import METHODS
from tuning.control.run_set import make_run_set

BREAKPOINTS, STEPS, SEED = 11, 80, 0
GRADIENT_COST, EVALUATION_FACTOR = 4, 10  # evaluations of a gradient; factor of the longest search
LOADS = tuning.full_grid({"loads.0.mass": [0.261, 0.509], "loads.0.speed": [0.5, 1.0]})


class SearchResult(NamedTuple):
    """Worst peak (relative to no control) at the end of a search, wall time (s), evaluations."""

    peak: float
    seconds: float
    evaluations: int

    def __str__(self) -> str:
        return f"{self.peak:.4f} after {self.evaluations} evaluations in {self.seconds:.1f} s"


def tuning_problem() -> tuple[jb.Case, dict[str, tuple[float, float]]]:
    """The case to tune, and its free values with their bounds."""
    shares = np.linspace(0.0, 1.0, BREAKPOINTS)
    values = [np.interp(shares, *table) for table in INITIAL_TABLES["B"]]
    law = jb.Feedforward(gates=GATES, shares=shares, values=values, period=PERIOD, lead=LEAD)
    case = jb.replace(rigs.load("B"), {"loads.0.entry_time": ENTRY_TIME})
    case = dataclasses.replace(case, controller=law, run=jb.Run(duration=1.4, sample_rate=200.0))
    free = {f"controller.values.0.{k}": COMMAND_LIMITS for k in range(BREAKPOINTS)}
    return case, free | {"controller.lead": (0.0, 0.1)}


def run_evolution(
    case: jb.Case, free: dict, evaluations: int, seconds: float = np.inf
) -> SearchResult:
    """Search by differential evolution, of so many evaluations or seconds (without compiling).

    It ends after the generation in which either is reached.
    """
    run_set = make_run_set(case, LOADS)

    @compiled
    def worst_peaks(points, run_set):
        def worst_peak(point):
            return jnp.max(run_set.metrics(dict(zip(free, point, strict=True)))["peak"])

        return jax.lax.map(worst_peak, points)

    def objective(points):
        return np.nan_to_num(worst_peaks(jnp.asarray(points.T), run_set), nan=1e3)

    population = 4 * len(free)
    objective(np.array(list(free.values())).mean(axis=1)[:, None] * np.ones(population))
    began = time.perf_counter()
    solution = differential_evolution(
        objective,
        list(free.values()),
        maxiter=max(evaluations // population - 1, 1),
        popsize=4,
        tol=0.0,
        polish=False,
        rng=SEED,
        vectorized=True,
        updating="deferred",
        x0=[float(value_at(case, address)) for address in free],
        callback=lambda intermediate_result: time.perf_counter() - began > seconds,
    )
    return SearchResult(
        float(solution.fun), time.perf_counter() - began, int(solution.nfev) * population
    )


def run_gradients(case: jb.Case, free: dict, method: str) -> tuple[float, SearchResult]:
    """Worst peak at the start, and a search by gradients, timed after everything is compiled."""
    loads = tuning.LoadCases(LOADS)
    options = {"steps": STEPS, "method": method, "least_peaks": False, "progress": False}
    tuning.tune(case, free, loads, **options)
    began = time.perf_counter()
    tuned = tuning.tune(case, free, loads, **options)
    start, end = tuned.run_sets[0].objective
    return start, SearchResult(end, time.perf_counter() - began, GRADIENT_COST * STEPS)


def main() -> None:
    """Run all searches and print their worst peaks."""
    case, free = tuning_problem()
    searches = {method: run_gradients(case, free, method) for method in METHODS}
    print(f"worst peak, relative to no control: {searches['adam'][0]:.4f} at the start")
    for method, (_, result) in searches.items():
        print(f"{method}, {STEPS} gradients: {result}")
    seconds = searches["adam"][1].seconds
    result = run_evolution(case, free, 10**6, seconds)
    print(f"differential evolution, as long as adam: {result}")
    for factor in (1, EVALUATION_FACTOR):
        result = run_evolution(case, free, GRADIENT_COST * STEPS * factor)
        print(f"differential evolution: {result}")


if __name__ == "__main__":
    main()
