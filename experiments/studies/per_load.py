"""One controller for all loads beside one that is tuned for each: what not knowing the load costs.

    python -m experiments.studies.per_load

On rig B, for loads on which the laws of `experiments.studies.tuned` (clocked by gates, no delay) and
`experiments.studies.sensed` (sensors only, as on the bench) were not tuned, each is tuned on for that load
alone, by the same gradients from the same tables. Shares of the attainable reduction, one table for
all loads and then its own: 97.7 to 99.7 % and 99.8 to 100 % by gates, 94.8 to 97.8 % and 99.8 to
100 % from sensors alone. So not knowing the load costs 2 % of what is possible, or 5 %.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies import sensed_search, tuned_search
from experiments.studies.sensed_search import on_bench
from experiments.studies.tuned import ENTRY
from experiments.studies.tuned_search import LIMITS, MODES
from jaxbeam import rigs

LOADS = tuning.grid(
    {"loads.0.mass": [0.322, 0.42], "loads.0.speed": [0.35, 0.95], "loads.0.entry_time": [ENTRY]}
)
RIG, STEPS = "B", 60


def problems() -> dict[str, tuple[jb.Case, dict]]:
    """By name a rig under the law for all loads, and what is free in its table."""
    case = rigs.load(RIG)
    slowest = float(case.beam.length) / 0.35 + ENTRY + 0.1
    beam = dataclasses.replace(case.beam, modes=MODES)
    case = dataclasses.replace(case, beam=beam, run=jb.Run(slowest, 200.0))
    gated = jb.load_case(tuned_search.FOLDER / f"{RIG}.toml").controller
    sensing = jb.load_case(sensed_search.FOLDER / f"{RIG}.toml").controller
    used = np.flatnonzero(np.asarray(sensing.readings) < 0)
    return {
        "clocked by gates": (
            dataclasses.replace(case, controller=gated),
            {f"controller.values.0.{k}": LIMITS for k in range(gated.values.shape[1])},
        ),
        "sensors only": (
            dataclasses.replace(on_bench(RIG, case, 1), controller=sensing),
            {f"controller.values.0.{k}": LIMITS for k in used},
        ),
    }


def compared(case: jb.Case, free: dict, load: dict[str, float]) -> tuple[float, float]:
    """Shares of the attainable reduction: of the law for all loads, and of one for this load."""
    found = tuning.tune(
        case,
        free,
        tuning.LoadCases((load,)),
        tuning.Objective({"shortfall": 1.0}),
        steps=STEPS,
        progress=False,
    )
    outcome = found.outcomes[0]
    return float(outcome.shares(outcome.before)[0]), float(outcome.shares(outcome.after)[0])


def main() -> None:
    """Print a line for each law and load."""
    for name, (case, free) in problems().items():
        for load in LOADS:
            one, own = compared(case, free, load)
            words = f"{load['loads.0.mass']:g} kg at {load['loads.0.speed']:g} m/s"
            print(f"{name}, {words}: {one:.1%} for all, {own:.1%} for this load", flush=True)


if __name__ == "__main__":
    main()
