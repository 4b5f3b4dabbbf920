"""Search for the table of the scheduled internal model on both patch rigs at once.

    python -m experiments.studies.one_law.tune [generations]    # an hour for 40

A law for all rigs has one table and one reference filter. They are sought by an evolution strategy
with a covariance matrix (rank-mu update; Hansen and Ostermeier, Evolutionary Computation 9, 2001),
for the worst and the mean share of the attainable reduction over both rigs, delays of 0 and 40 ms,
beams 20 % softer and stiffer, and the lightest and heaviest of the training loads at several
speeds. Filters need no search: the law makes them all alike. The defaults of the law were found by
this search over the same equations with fixed steps of 1 ms, in 40 generations, and rounded.
"""

import dataclasses
import itertools
import sys

import numpy as np

import jaxbeam as jb
from experiments.studies.held_out import training_loads
from experiments.studies.one_law.plants import ONE_LAW, Shares, plant_case
from jaxbeam.control.internal_model import ORDER, REFERENCE, SHARES, VALUES

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


if __name__ == "__main__":
    kept = Shares()
    generations = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    search(numbers_of(VALUES, REFERENCE), generations, lambda numbers: merit(numbers, kept))
