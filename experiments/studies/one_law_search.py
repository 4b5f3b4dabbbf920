"""Search for the table of the scheduled internal model, on all plants at once and on each alone.

    python -m experiments.studies.one_law_search [generations]    # an hour for 40
    python -m experiments.studies.one_law_search per-plant        # with --pages for the page, too

A law for all rigs has one table and one reference filter. They are sought by an evolution strategy
with a covariance matrix (rank-mu update; Hansen and Ostermeier, Evolutionary Computation 9, 2001),
for the worst and the mean share of the attainable reduction over both rigs, delays of 0 and 40 ms,
beams 20 % softer and stiffer, and the lightest and heaviest of the training loads at several
speeds. Filters need no search: the law makes them all alike. The defaults of the law were found by
this search over the same equations with fixed steps of 1 ms, in 40 generations, and rounded.

What the one law loses against the same law tuned for each plant alone: plants differ by rig, delay
and rigidity, so its table and its reference are sought anew for each of the eight outermost, from
where the first search ended; a quarter of an hour on two cores. Worst and mean shares over the
held-out loads are printed, of the one law and of that tuned for the plant. One that is worse on
them has met its training loads too closely.
"""

import dataclasses
import itertools
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float

import jaxbeam as jb
from experiments.studies.held_out import held_out_loads, training_loads
from experiments.studies.one_law import ONE_LAW, SPANS, Shares, cell, plant_case
from jaxbeam.control.internal_model import ORDER, REFERENCE, SHARES, VALUES
from jaxbeam.runtime.printer import markdown_table

SPEEDS = {"B": (0.35, 0.6, 1.0), "C": (0.5, 1.0)}  # m/s
CUTOFF, DELAYS, FACTORS = 10.0, (0.0, 0.04), (0.8, 1.2)  # Hz, s, -
POPULATION, PARENTS, RATE, SHRINKING = 14, 5, 0.2, 0.985
DEVIATIONS = np.array([0.2] * 3 + [0.1] * 7 + [0.06])  # of the values but the zero; the reference
LOWEST, HIGHEST = np.array([0.0] * 10 + [0.25]), np.array([1.0] * 10 + [0.9])
WORST_RUNS, MEAN_WEIGHT = 4, 0.15


def law(numbers: np.ndarray) -> jb.ScheduledInternalModel:
    """The law with sizes of its values, below zero and above, and its reference."""
    values = np.concatenate([-numbers[:3], [0.0], numbers[3:10]])
    return jb.ScheduledInternalModel(SHARES, values, numbers[10], ORDER)


def numbers_of(values, reference) -> np.ndarray:
    """The numbers searched for, of a table and a reference."""
    return np.concatenate([np.abs(np.delete(values, 3)), [reference]])


def with_numbers(case: jb.Case, numbers: np.ndarray) -> jb.Case:
    """The case under the law with the numbers searched for, and the timing of its own."""
    timing = {name: getattr(case.controller, name) for name in ("period", "delay", "resolution")}
    return dataclasses.replace(case, controller=dataclasses.replace(law(numbers), **timing))


def mean_and_worst(shares: np.ndarray) -> float:
    """Weighted worst, worst few and mean of shares."""
    found = np.sort(shares)
    return float(0.6 * found[0] + 0.4 * found[:WORST_RUNS].mean() + MEAN_WEIGHT * found.mean())


def merit(numbers: np.ndarray, shares: Shares) -> float:
    """Weighted worst, worst few and mean of the shares of all runs."""
    found = []
    for rig, delay, factor in itertools.product("BC", DELAYS, FACTORS):
        case = with_numbers(plant_case(rig, ONE_LAW, CUTOFF, delay, factor), numbers)
        found.append(shares(rig, case, training_loads(SPEEDS[rig])))
    return mean_and_worst(np.concatenate(found))


def search(
    start: np.ndarray, generations: int, merit_of, seed: int = 0, quiet: bool = False
) -> np.ndarray:
    """The best numbers found by the evolution strategy, which prints them unless it is `quiet`."""
    rng = np.random.default_rng(seed)
    weights = np.log(PARENTS + 0.5) - np.log(np.arange(1, PARENTS + 1))
    weights /= weights.sum()
    mean, covariance, size = start, np.eye(len(start)), 1.0
    best, best_merit = start, merit_of(start)
    for generation in range(generations):
        normal = rng.standard_normal((POPULATION, len(start)))
        steps = size * DEVIATIONS * (normal @ np.linalg.cholesky(covariance).T)
        points = np.clip(mean + steps, LOWEST, HIGHEST)
        merits = np.array([merit_of(point) for point in points])
        order = np.argsort(-merits)[:PARENTS]
        if merits[order[0]] > best_merit:
            best, best_merit = points[order[0]], merits[order[0]]
        scaled = (points[order] - mean) / (size * DEVIATIONS)
        covariance = (1 - RATE) * covariance + RATE * (scaled.T * weights) @ scaled
        covariance += 1e-6 * np.eye(len(start))
        mean, size = mean + weights @ (points[order] - mean), size * SHRINKING
        if not quiet:
            print(generation, f"{best_merit:.4f}", np.round(best, 3).tolist(), flush=True)
    return best


GENERATIONS = 8  # for a plant alone
TABLE_FILE = Path(__file__).parents[2] / "docs" / "_static" / "one_law_per_plant.md"
HEADER = "rig", "delay", "rigidity", "one law for all", "the same law, tuned for the plant"


def losses(rig: str, delay: float, factor: float) -> Float[np.ndarray, "law load"]:
    """Shares of the one law and of one tuned for a plant, over the held-out loads."""
    case, shares = plant_case(rig, ONE_LAW, CUTOFF, delay, factor), Shares()
    start = numbers_of(VALUES, REFERENCE)

    def merit(numbers: np.ndarray) -> float:
        loads = training_loads(SPEEDS[rig])
        return mean_and_worst(shares(rig, with_numbers(case, numbers), loads))

    tuned = search(start, GENERATIONS, merit, quiet=True)
    laws = [with_numbers(case, numbers) for numbers in (start, tuned)]
    return np.stack([shares(rig, one, held_out_loads(rig)) for one in laws])


def search_each(arguments: list[str]) -> None:
    """Print a row for each plant, and the losses; write them for the page with `--pages`."""
    plants = list(itertools.product("BC", DELAYS, FACTORS))
    rows, lost = [], []
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for plant, found in zip(plants, pool.map(losses, *zip(*plants, strict=True)), strict=True):
            rig, delay, factor = plant
            numbers = SPANS[rig], f"{1e3 * delay:g} ms", f"{factor:g}"
            rows.append((*numbers, *(cell(one) for one in found)))
            lost.append([found[1].min() - found[0].min(), found[1].mean() - found[0].mean()])
            print(" | ".join(rows[-1]), flush=True)
    worst, mean = 100 * np.max(lost, axis=0)
    print(f"the one law loses at most {worst:.1f} points at worst, {mean:.1f} in the mean")
    if "--pages" in arguments:
        text = "\n".join(markdown_table(HEADER, rows, right_from=1))
        TABLE_FILE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    if "per-plant" in sys.argv:
        search_each(sys.argv[1:])
    else:
        kept = Shares()
        generations = int(sys.argv[1]) if len(sys.argv) > 1 else 40
        search(numbers_of(VALUES, REFERENCE), generations, lambda numbers: merit(numbers, kept))
