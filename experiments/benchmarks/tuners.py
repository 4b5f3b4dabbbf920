"""Tuning by gradients beside differential evolution: the same loop, evaluation for evaluation.

    python -m experiments.benchmarks.tuners

A table of commands (11 knots and the lead) on rig B is tuned for the worst peak of four loads. A
gradient in reverse mode is counted as four evaluations; differential evolution (scipy's) is given
as many evaluations as the gradient took, and then ten times as many. Both start from the same
trapezium and search within the same limits. Worst peaks, relative to no control: 0.825 at the
start, 0.792 by 80 gradients; 0.815 by 320 evaluations without, and 0.792 by 3200.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution

import jaxbeam as jb
import tuning
from experiments.tuned_search import ENTRY, GATES, LEAD, LIMITS, PERIOD, STARTS
from jaxbeam import rigs
from jaxbeam.case import value_at
from jaxbeam.compiling import compiled
from tuning.bench import make_bench

KNOTS, STEPS, COST, MORE, SEED = 11, 80, 4, 10, 0
LOADS = tuning.grid({"loads.0.mass": [0.261, 0.509], "loads.0.speed": [0.5, 1.0]})


def problem() -> tuple[jb.Case, dict[str, tuple[float, float]]]:
    """The case to tune, and what is free in it."""
    shares = np.linspace(0.0, 1.0, KNOTS)
    values = [np.interp(shares, *table) for table in STARTS["B"]]
    law = jb.Passage(gates=GATES, shares=shares, values=values, period=PERIOD, lead=LEAD)
    case = jb.replace(rigs.load("B"), {"loads.0.entry_time": ENTRY})
    case = dataclasses.replace(case, controller=law, run=jb.Run(duration=1.4, sample_rate=200.0))
    free = {f"controller.values.0.{k}": LIMITS for k in range(KNOTS)}
    return case, free | {"controller.lead": (0.0, 0.1)}


def evolved(case: jb.Case, free: dict, evaluations: int) -> float:
    """The worst peak (relative to no control) that differential evolution comes to."""
    bench = make_bench(case, LOADS)

    @compiled
    def worst(points, bench):
        def one(point):
            return jnp.max(bench.merits(dict(zip(free, point, strict=True)))["peak"])

        return jax.lax.map(one, points)

    population = 4 * len(free)
    found = differential_evolution(
        lambda points: np.nan_to_num(worst(jnp.asarray(points.T), bench), nan=1e3),
        list(free.values()),
        maxiter=max(evaluations // population - 1, 1),
        popsize=4,
        tol=0.0,
        polish=False,
        rng=SEED,
        vectorized=True,
        updating="deferred",
        x0=[float(value_at(case, address)) for address in free],
    )
    return float(found.fun)


def main() -> None:
    """Run all three and print what they come to."""
    case, free = problem()
    found = tuning.tune(
        case, free, tuning.LoadCases(LOADS), steps=STEPS, bounds=False, progress=False
    )
    start, end = found.outcomes[0].objective
    print(f"worst peak, relative to no control: {start:.4f} at the start")
    print(f"gradient, {STEPS} steps: {end:.4f}")
    for times in (1, MORE):
        count = COST * STEPS * times
        print(f"differential evolution, {count} evaluations: {evolved(case, free, count):.4f}")


if __name__ == "__main__":
    main()
