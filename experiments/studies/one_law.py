"""One law from the sensors alone on plants of other filters, delays and rigidities; held-out loads.

    python -m experiments.studies.one_law           # prints; with --pages writes docs/_static too

`internal-model-scheduled` with its own numbers runs on both patch rigs behind filters of tenth
order from 5 to 40 Hz, with delays up to 40 ms, on beams 20 % softer to 20 % stiffer, with noise of
4 um and steps of 10 mV. It knows the numbers of its plant, but neither mass nor speed of the load.
Beside it stand the table tuned for each rig (with 10 or 20 Hz, 20 ms and the rigidity as printed)
and the one drawn by hand, which know their plant, too. The worst and mean of the shares of the
attainable reduction (linear program, full knowledge) are over all rigidities and loads.

A last row gives the scheduled law wrong numbers of its plant: the filter 5 % off, and the rigidity
10 % off, with commands that come half a period later.
"""

import dataclasses
import itertools
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

import jaxbeam as jb
from experiments.studies.held_out import PERIOD, held_out_loads
from experiments.studies.sensor_feedback import bench_case, drawn_table, with_cutoff
from experiments.studies.tuned_feedforward import COMMAND_RESOLUTION, MODES
from experiments.thesis.cases import with_modes
from jaxbeam.case.library import rigs
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.printer import markdown_table
from jaxbeam.simulation.simulate import ContactLossWarning
from tuning.control.objective import with_fixed_design
from tuning.control.run_set import AddressValues

TABLE_FILE = Path(__file__).parents[2] / "docs" / "_static" / "one_law.md"
CUTOFFS, DELAYS, FACTORS = (5.0, 10.0, 20.0, 40.0), (0.0, 0.02, 0.04), (0.8, 1.0, 1.2)  # Hz, s, -
RIGIDITY, TOLERANCE = "beam.flexural_rigidity", 1e-4
ONE_LAW, TUNED, DRAWN = "one law for all", "tuned for its rig", "drawn by hand"
LAWS: dict[str, Callable[[str, jb.Case], jb.Case]] = {
    ONE_LAW: lambda rig, case: scheduled(case),
    TUNED: lambda rig, case: case,
    DRAWN: lambda rig, case: dataclasses.replace(case, controller=drawn_table(rig)),
}
FILTER_ERROR, DELAY_ERROR, RIGIDITY_ERROR = 0.05, PERIOD / 2, 0.1
NO_GAIN = "worse than no control"
SPANS = {"B": "one span", "C": "two spans"}


def scheduled(case: jb.Case) -> jb.Case:
    """The case under the scheduled law."""
    law = jb.ScheduledInternalModel(period=PERIOD, resolution=COMMAND_RESOLUTION)
    return dataclasses.replace(case, controller=law)


def plant_case(rig: str, law: str, cutoff: float, delay: float, factor: float) -> jb.Case:
    """A rig under a law, with the cutoff of its filters (Hz), the delay (s) and a rigidity."""
    case = LAWS[law](rig, with_modes(bench_case(rig, rigs.load(rig)), MODES))
    case = with_cutoff(case, cutoff)
    rigidity = factor * float(case.beam.flexural_rigidity)
    law_with_delay = dataclasses.replace(case.controller, delay=np.asarray(delay))
    return jb.replace(dataclasses.replace(case, controller=law_with_delay), {RIGIDITY: rigidity})


def misinformed(case: jb.Case, sign: int) -> jb.Case:
    """The case whose law is designed for other numbers than those of its plant."""
    nominal = {
        f"sensors.{i}.filter.cutoff": (1 + sign * FILTER_ERROR) * float(sensor.filter.cutoff)
        for i, sensor in enumerate(case.sensors)
    }
    nominal[RIGIDITY] = (1 + sign * RIGIDITY_ERROR) * float(case.beam.flexural_rigidity)
    delay = np.asarray(case.controller.delay + DELAY_ERROR)
    late = dataclasses.replace(case, controller=dataclasses.replace(case.controller, delay=delay))
    return with_fixed_design(late, nominal, mesh_layout(late))


class Shares:
    """Shares of the attainable reduction by load; bounds are kept, one for each plant and load."""

    def __init__(self):
        self.bounds: dict[tuple, jb.Bound] = {}

    def __call__(self, rig: str, case: jb.Case, loads: tuple[AddressValues, ...]) -> np.ndarray:
        found = []
        for load in loads:
            run = jb.replace(case, load)
            key = rig, float(case.beam.flexural_rigidity), *load.values()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ContactLossWarning)
                if key not in self.bounds:
                    self.bounds[key] = jb.bound(run)
                found.append(float(self.bounds[key].share(jb.simulate(run, tolerance=TOLERANCE))))
        return np.array(found)


def cell(shares: np.ndarray) -> str:
    """Worst and mean of shares in words of the page."""
    if shares.min() < 0:
        return NO_GAIN
    return f"{100 * shares.min():.1f} % ({100 * shares.mean():.1f} %)"


def rows(shares: Shares) -> list[tuple[str, ...]]:
    """Rows of the table: filter, delay, and a cell for each law and rig."""
    found = []
    all_shares = {key: [] for key in itertools.product("BC", LAWS)}
    for cutoff, delay in itertools.product(CUTOFFS, DELAYS):
        for key in all_shares:
            values = [
                shares(key[0], plant_case(*key, cutoff, delay, factor), held_out_loads(key[0]))
                for factor in FACTORS
            ]
            all_shares[key].append(np.concatenate(values))
        cells = [cell(values[-1]) for values in all_shares.values()]
        found.append((f"{cutoff:g} Hz, {1e3 * delay:g} ms", *cells))
        print(" | ".join(found[-1]), flush=True)
    found.append(("all", *(cell(np.concatenate(values)) for values in all_shares.values())))
    wrong = []
    for rig in "BC":
        values = [
            shares(
                rig, misinformed(plant_case(rig, ONE_LAW, *plant, 1.0), sign), held_out_loads(rig)
            )
            for plant in ((5.0, 0.02), (20.0, 0.02))
            for sign in (-1, 1)
        ]
        wrong += [cell(np.concatenate(values)), "", ""]
    found.append(("5 and 20 Hz, 20 ms, given wrong numbers", *wrong))
    print(" | ".join(found[-2]), " | ".join(found[-1]), sep="\n", flush=True)
    return found


def main(arguments: list[str]) -> None:
    """Print the table, and write it for the page with `--pages`."""
    header = ("filter, delay", *(f"{law}, {SPANS[rig]}" for rig in "BC" for law in LAWS))
    text = "\n".join(markdown_table(header, rows(Shares()), right_from=1))
    if "--pages" in arguments:
        TABLE_FILE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
