"""Loss of the one law against the same law tuned for each plant alone; held-out loads.

    python -m experiments.studies.one_law.per_plant   # prints; with --pages writes docs/_static too

The law makes all filters alike, so that plants differ by rig, delay and rigidity: its table and its
reference are sought anew for each of the eight outermost, by the search of `tune` and from
where that ended; a quarter of an hour on two cores. Worst and mean shares of the attainable
reduction over the held-out loads are printed, of the one law and of that tuned for the plant. One
that is worse on them has met its training loads too closely.
"""

import itertools
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float

from experiments.studies.held_out import held_out_loads, training_loads
from experiments.studies.one_law.plants import ONE_LAW, SPANS, Shares, cell, plant_case
from experiments.studies.one_law.tune import (
    CUTOFF,
    DELAYS,
    FACTORS,
    SPEEDS,
    mean_and_worst,
    numbers_of,
    search,
    with_numbers,
)
from jaxbeam.control.internal_model import REFERENCE, VALUES
from jaxbeam.runtime.printer import markdown_table

GENERATIONS = 8
TABLE_FILE = Path(__file__).parents[3] / "docs" / "_static" / "one_law_per_plant.md"
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


def main(arguments: list[str]) -> None:
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
    main(sys.argv[1:])
